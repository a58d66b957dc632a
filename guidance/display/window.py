"""One pygame window: its frames, its keys and its pages."""

from collections.abc import Callable, Mapping
from math import hypot
from typing import Self

import numpy as np
import pygame

from airhockey_marl.envs.physics import LEFT, RIGHT, TableSpec
from airhockey_marl.envs.rendering import COLORS
from guidance.display.arena import Arena
from guidance.display.drawing import forget, letters, veil, write
from guidance.display.film import FORCE, GRAY, INK, PAPER
from guidance.display.pages import Items, Page
from guidance.haptics.clock import Clock
from guidance.haptics.seat import DisplayState, Quit

HINT = "h help   space pause   esc leave"  # at the foot
BAR, FOOT, EDGE = 54, 54, 16  # px
NARROWEST = 800  # px: there, the longest texts still fit
FADED = (90, 96, 104)
PRESSES = (pygame.KEYDOWN, pygame.MOUSEBUTTONDOWN, pygame.JOYBUTTONDOWN)
HELD_BACK = {pygame.K_LSHIFT, pygame.K_RSHIFT, pygame.K_LCTRL, pygame.K_RCTRL, pygame.K_LALT, pygame.K_RALT}


class Window:
    """What a person looks at, and whose keys they press.

    Args:
        width: of the table, pixels.
        frames_per_second: pictures drawn.
        shows_force: whether the force and its weights are to be seen; in an experiment they are to be felt.
        keys: what the keys do, for the help; `o` (targets) does something only if it is among them.

    Attributes:
        pointed: is told the action (2,) under the pointer.
        unplugged: is told the number of a gamepad that is gone.
        next_frame, cost, attentive: as `guidance.haptics.seat.Screen` has them.
        overlay: whether the models' targets are shown.
        frame_times: s between one picture and the next.
    """

    def __init__(
        self,
        title: str,
        table: TableSpec,
        width: int,
        frames_per_second: int,
        clock: Clock,
        keys: Mapping[str, str],
        shows_force: bool = True,
    ) -> None:
        pygame.display.init()
        pygame.font.init()
        pygame.joystick.init()
        pygame.display.set_caption(title)
        pygame.display.set_mode((width, width // 2))  # colors are of a display: there must be one to draw with
        self.arena = Arena(table, width)
        self.size = (width, BAR + self.arena.size[1] + FOOT)
        self.surface = self._open(fullscreen=False)
        self._table_surface = self.surface.subsurface((0, BAR, *self.arena.size))
        self.clock, self.keys, self.shows_force = clock, keys, shows_force
        self.pointed: Callable[[np.ndarray], None] = lambda action: None
        self.unplugged: Callable[[int], None] = lambda number: None
        self.interval = 1.0 / frames_per_second
        self.next_frame, self.cost = clock.now(), 0.0
        self.overlay, self.helping, self.frame_times = False, False, []
        self._last_frame, self._pressed, self._leave, self._focused = None, [], False, True
        self._early: list[str] = []  # pressed before the page was there that they are for

    def _open(self, fullscreen: bool) -> pygame.Surface:
        full = pygame.FULLSCREEN | pygame.SCALED if fullscreen else 0
        surface = pygame.display.set_mode(self.size, full)
        pygame.mouse.set_visible(not fullscreen)
        return surface

    @property
    def attentive(self) -> bool:
        """Whether the window has the keyboard, and the help does not cover the game."""
        return self._focused and not self.helping

    def poll(self) -> None:
        """Take note of what was pressed, and of where the pointer is."""
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self._leave = True
            elif event.type in (pygame.WINDOWFOCUSLOST, pygame.WINDOWFOCUSGAINED):
                self._focused = event.type == pygame.WINDOWFOCUSGAINED
            elif event.type == pygame.JOYDEVICEREMOVED:
                self.unplugged(event.instance_id)
            elif event.type in PRESSES and getattr(event, "key", None) not in HELD_BACK:
                self._pressed.append(event)
        x, y = pygame.mouse.get_pos()
        self.pointed(self.arena.action_at((x, y - BAR)))

    def frame(self, moment: DisplayState) -> list[str]:
        """Show a moment; returns the keys pressed since the last one, but those that are the window's own.

        Raises:
            Leave: the window was closed, or escape pressed.
        """
        began = self.clock.now()
        keys = [key for key in self._take() if not self._own(key)]
        self.surface.fill(PAPER)
        self.arena.draw(self._table_surface, moment, self.overlay, self.shows_force)
        self._draw_bar(moment)
        self._draw_foot(moment)
        if moment.note:
            self._draw_note(moment.note)
        if self.helping:
            Page("Keys", "", self.keys).draw(self.surface)
        self._flip(began)
        return keys

    def page(self, page: Page) -> str:
        """Show a page, a long one in parts, until one of its keys is pressed; returns it.

        Raises:
            Leave: the window was closed, or escape pressed.
        """
        for part in page.parts(self.size):
            key = self._part(part)
        return key

    def _part(self, page: Page) -> str:
        while True:
            self._wait()
            names = self._take()
            for nth, key in enumerate(names):
                if key in page.keys:
                    self._early = names[nth + 1 :]
                    return key
                self._own(key)
            page.draw(self.surface)
            self._flip(self.clock.now())

    def ask(self, items: Items) -> dict[str, int]:
        """Show a questionnaire until every item is answered and confirmed; returns the answers."""
        pygame.mouse.set_visible(True)
        while True:
            self._wait()
            self.poll()
            for event in self._events():
                if event.type == pygame.MOUSEBUTTONDOWN:
                    items.click(event.pos, self.surface.get_size())
                elif event.type == pygame.KEYDOWN:
                    items.press(pygame.key.name(event.key))
            if items.confirmed:
                pygame.mouse.set_visible(not pygame.display.is_fullscreen())
                return items.answers
            items.draw(self.surface)
            self._flip(self.clock.now())

    def write_down(self, page: Page) -> str:
        """Show a page with a line to write on, until return is pressed; returns what was written.

        Raises:
            Leave: the window was closed, or escape pressed on an empty line; on another it empties it.
        """
        text = ""
        while True:
            self._wait()
            self.poll()
            for event in self._events(escape=False):
                if event.type != pygame.KEYDOWN:
                    continue
                if event.key == pygame.K_ESCAPE:
                    if not text:
                        raise Quit
                    text = ""
                    continue
                if event.key in (pygame.K_RETURN, pygame.K_KP_ENTER):
                    return text.strip()
                text = text[:-1] if event.key == pygame.K_BACKSPACE else text + event.unicode
                text = "".join(letter for letter in text if letter.isprintable())
            page.draw(self.surface, typed=text)
            self._flip(self.clock.now())

    def screenshot(self) -> np.ndarray:
        """(height, width, 3) uint8."""
        return pygame.surfarray.array3d(self.surface).swapaxes(0, 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Shut it; no other window is open then."""
        forget()
        pygame.quit()

    def _events(self, escape: bool = True) -> list[pygame.event.Event]:
        pressed, self._pressed = self._pressed, []
        away = escape and any(event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE for event in pressed)
        if self._leave or away:
            self._leave = False
            raise Quit
        return pressed

    def _take(self) -> list[str]:
        """Names of the keys that were pressed; the first button of a gamepad is space, both enters are return."""
        self.poll()
        names, self._early = self._early, []
        for event in self._events():
            if event.type == pygame.KEYDOWN:
                name = pygame.key.name(event.key)
                names.append("return" if name == "enter" else name)
            elif event.type == pygame.JOYBUTTONDOWN:
                names.append("space" if event.button == 0 else f"button {event.button}")
        return names

    def _own(self, key: str) -> bool:
        if key == "o" and "o" in self.keys:
            self.overlay = not self.overlay
        elif key in ("h", "f1") or (key == "space" and self.helping):
            self.helping = not self.helping
        elif key in ("f", "f11"):
            self.toggle_fullscreen()
        else:
            return False
        return True

    def toggle_fullscreen(self) -> None:
        """Fill the screen, or be a window again; where a display can do neither, nothing happens."""
        fullscreen = not pygame.display.is_fullscreen()
        try:
            self.surface = self._open(fullscreen)
        except pygame.error:
            self.surface = self._open(False)
        self._table_surface = self.surface.subsurface((0, BAR, *self.arena.size))

    def _wait(self) -> None:
        self.clock.wait(self.next_frame - self.clock.now())

    def _flip(self, began: float) -> None:
        pygame.display.flip()
        now = self.clock.now()
        self.cost += 0.1 * (now - began - self.cost)
        if self._last_frame is not None:
            self.frame_times.append(now - self._last_frame)
        self._last_frame = now
        self.next_frame += self.interval
        if self.next_frame < now:  # pictures that were missed are not made up for
            self.next_frame = now

    def _draw_bar(self, moment: DisplayState) -> None:
        middle, line = self.size[0] / 2, BAR / 2
        write(self.surface, moment.title, (EDGE, line), 19, INK, bold=True)
        write(self.surface, str(moment.won), (middle - 16, line), 26, COLORS[LEFT], True, "midright")
        write(self.surface, ":", (middle, line), 26, INK, True, "center")
        write(self.surface, str(moment.lost), (middle + 16, line), 26, COLORS[RIGHT], True, "midleft")
        left = middle + 70
        for model, mark in self.arena.marks.items() if self.overlay else ():
            left = self.surface.blit(mark, mark.get_rect(midleft=(left, line))).right + 2
            left = write(self.surface, model, (left, line), 14, INK).right + 10
        minutes, seconds = divmod(int(moment.seconds), 60)
        write(self.surface, f"{minutes}:{seconds:02d}", (self.size[0] - EDGE, line), 19, INK, True, "midright")

    def _draw_foot(self, moment: DisplayState) -> None:
        line, left, newtons = self.size[1] - FOOT / 2, EDGE + 110, hypot(*moment.force)
        if self.shows_force:
            write(self.surface, f"force {newtons:.1f} N", (EDGE, line), 14, FORCE if newtons else FADED, bold=True)
        for name, weight in moment.weights.items() if self.shows_force else ():
            left = write(self.surface, name, (left, line), 14, INK).right + 6
            for share, color in ((1.0, GRAY), (weight, FORCE)):
                pygame.draw.rect(self.surface, color, (left, line - 6, 70 * share, 12))
            left += 70 + EDGE
        write(self.surface, HINT, (self.size[0] - EDGE, line), 14, FADED, anchor="midright")

    def _draw_note(self, note: str) -> None:
        room = self.size[0] - 4 * EDGE
        size = next((size for size in range(20, 9, -1) if letters(note, size, INK, True).get_width() <= room), 10)
        box = letters(note, size, INK, True).get_rect().inflate(2 * EDGE, 24)
        box.center = (self.size[0] // 2, BAR + self.arena.size[1] // 2)
        veil(self.surface, box, (*PAPER, 225))
        write(self.surface, note, box.center, size, INK, True, "center")
