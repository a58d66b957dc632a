"""A pygame window: frames of a game, keys and pages."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import hypot
from pathlib import Path
from typing import Self

import numpy as np
import pygame

from airhockey_marl.envs.physics import LEFT, RIGHT, TableSpec
from airhockey_marl.envs.rendering import COLORS
from airhockey_marl.experiment.config import InputError
from guidance.display.arena import Arena
from guidance.display.drawing import clear_caches, font, use_font, write, write_weight
from guidance.display.pages import Items, Page
from guidance.display.scene import FORCE, HAND, INK, PAPER
from guidance.haptics.screen import Clock, DisplayState, Quit
from guidance.haptics.texts import english

BAR, NOTE, FOOT, EDGE = 54, 40, 54, 16  # px
MIN_WIDTH = 800  # px, minimum width at which the longest texts fit
FADED = (90, 96, 104)
PRESSES = (pygame.KEYDOWN, pygame.MOUSEBUTTONDOWN, pygame.JOYBUTTONDOWN)
INVISIBLE = ("dummy", "offscreen", "evdev")  # drivers of SDL, which it falls back to without a display
IGNORED_KEYS = {pygame.K_LSHIFT, pygame.K_RSHIFT, pygame.K_LCTRL, pygame.K_RCTRL, pygame.K_LALT, pygame.K_RALT}


@contextmanager
def named_display_errors() -> Iterator[None]:
    """Raise an error of pygame within the block as an InputError of one line."""
    try:
        yield
    except pygame.error as error:
        asked = os.environ.get("SDL_VIDEODRIVER")
        driver = f" with SDL_VIDEODRIVER={asked}" if asked else ""
        raise InputError(f"window: it cannot be opened{driver}: {error}") from error


@contextmanager
def silent_libraries() -> Iterator[None]:
    """Within the block nothing reaches the process's standard error: libraries of displays write to it themselves."""
    stderr, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(nowhere)


class Window:
    """A `guidance.haptics.screen.Screen`, and an `ExperimenterUI` of a session.

    Args:
        width: pixels, of the table.
        frames_per_second: frames drawn per second.
        keys: key -> meaning, for the help; `o` toggles the overlay only if it is among them.
        shows_force: whether the force and its weights are shown; in an experiment they are only felt.
        texts: those below `texts` of `conf/questions`, by their dotted names; English by default.
        font_file: of a font for them; DejaVu Sans by default.
        fullscreen: whether to fill the screen from the beginning.

    Attributes:
        on_pointer: called with the action (2,) under the pointer.
        on_disconnect: called with the number of a gamepad that is disconnected.
        overlay: whether the predictions of the models are shown.
        frame_times: s between frames.

    Raises:
        InputError: there is no display, or it cannot show a window of this size or fill the screen.
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
        texts: Mapping[str, str] | None = None,
        font_file: Path | None = None,
        fullscreen: bool = False,
    ) -> None:
        self.texts = texts or english()
        with named_display_errors():
            with silent_libraries():
                pygame.display.init()
            self._require_screen()
            pygame.joystick.init()
            pygame.display.set_caption(title)
            pygame.display.set_mode((width, width // 2))  # surfaces need a display for their color format
        if font_file is not None:
            use_font(font_file)
        self.arena = Arena(table, width)
        self.size = (width, BAR + self.arena.size[1] + NOTE + FOOT)
        self._require_room()
        with named_display_errors():
            self.surface = self._open(fullscreen)
        self._table_surface = self.surface.subsurface((0, BAR, *self.arena.size))
        self.clock, self.keys, self.shows_force = clock, keys, shows_force
        self.on_pointer: Callable[[np.ndarray], None] = lambda action: None
        self.on_disconnect: Callable[[int], None] = lambda number: None
        self.interval = 1.0 / frames_per_second
        self.next_frame, self.frame_cost = clock.now(), 0.0
        self.overlay, self.shows_help, self.frame_times = False, False, []
        self._last_frame, self._pressed, self._quit_requested, self._has_keyboard = None, [], False, True
        self._early: list[str] = []  # pressed before their page was shown

    def _require_screen(self) -> None:
        """Raise an InputError if nobody could see the window, unless such a driver was asked for."""
        if pygame.display.get_driver() in INVISIBLE and not os.environ.get("SDL_VIDEODRIVER"):
            pygame.display.quit()
            raise InputError("window: there is no display here (SDL_VIDEODRIVER=dummy asks for an invisible window)")

    def _require_room(self) -> None:
        """Raise an InputError if the window is larger than every screen."""
        screens = pygame.display.get_desktop_sizes()
        if pygame.display.get_driver() in INVISIBLE or any(
            self.size[0] <= wide and self.size[1] <= high for wide, high in screens
        ):
            return
        wide, high = max(screens)
        pygame.display.quit()
        size = f"a window of {self.size[0]} by {self.size[1]} pixels does not fit on a screen of {wide} by {high}"
        raise InputError(f"width = {self.size[0]} must be smaller: {size}")

    def _open(self, fullscreen: bool) -> pygame.Surface:
        full = pygame.FULLSCREEN | pygame.SCALED if fullscreen else 0
        surface = pygame.display.set_mode(self.size, full)
        pygame.mouse.set_visible(not fullscreen)
        return surface

    @property
    def has_focus(self) -> bool:
        """Whether the window has the keyboard focus and the help does not cover the game."""
        return self._has_keyboard and not self.shows_help

    def poll(self) -> None:
        """Process the pressed keys and the position of the pointer."""
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self._quit_requested = True
            elif event.type in (pygame.WINDOWFOCUSLOST, pygame.WINDOWFOCUSGAINED):
                self._has_keyboard = event.type == pygame.WINDOWFOCUSGAINED
            elif event.type == pygame.JOYDEVICEREMOVED:
                self.on_disconnect(event.instance_id)
            elif event.type in PRESSES and getattr(event, "key", None) not in IGNORED_KEYS:
                self._pressed.append(event)
        x, y = pygame.mouse.get_pos()
        self.on_pointer(self.arena.action_at((x, y - BAR)))

    def frame(self, display: DisplayState) -> list[str]:
        """Draw a frame; returns the keys pressed since the last one, without those that the window handles."""
        start = self.clock.now()
        keys = [key for key in self._take() if not self._handle(key)]
        self.surface.fill(PAPER)
        self.arena.draw(self._table_surface, display, self.overlay, self.shows_force)
        self._draw_bar(display)
        self._draw_foot(display)
        self._draw_note(display)
        if self.shows_help:
            Page(self.texts["window.help"], "", self.keys, self.texts).draw(self.surface)
        self._flip(start)
        return keys

    def page(self, page: Page) -> str:
        """Show a page, in parts if it is long, until one of its keys is pressed; returns that key."""
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
                self._handle(key)
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
            if items.is_confirmed:
                pygame.mouse.set_visible(not pygame.display.is_fullscreen())
                return items.answers
            items.draw(self.surface)
            self._flip(self.clock.now())

    def write_down(self, page: Page) -> str:
        """Show a page with an input line until return is pressed; returns the text.

        Raises:
            Quit: the window was closed, or escape pressed on an empty line; otherwise escape clears the line.
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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the window and quit pygame."""
        clear_caches()
        pygame.quit()

    def _events(self, escape: bool = True) -> list[pygame.event.Event]:
        pressed, self._pressed = self._pressed, []
        is_escape = escape and any(event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE for event in pressed)
        if self._quit_requested or is_escape:
            self._quit_requested = False
            raise Quit
        return pressed

    def _take(self) -> list[str]:
        """Names of the pressed keys; a gamepad's first button counts as space, and both enter keys as return."""
        self.poll()
        names, self._early = self._early, []
        for event in self._events():
            if event.type == pygame.KEYDOWN:
                name = pygame.key.name(event.key)
                names.append("return" if name == "enter" else name)
            elif event.type == pygame.JOYBUTTONDOWN:
                names.append("space" if event.button == 0 else f"button {event.button}")
        return names

    def _handle(self, key: str) -> bool:
        """Handle a key of the window itself; returns whether it is one."""
        if key == "o" and "o" in self.keys:
            self.overlay = not self.overlay
        elif key in ("h", "f1") or (key == "space" and self.shows_help):
            self.shows_help = not self.shows_help
        elif key in ("f", "f11"):
            self.toggle_fullscreen()
        else:
            return False
        return True

    def toggle_fullscreen(self) -> None:
        """Switch between full screen and window, if the display can."""
        fullscreen = not pygame.display.is_fullscreen()
        try:
            self.surface = self._open(fullscreen)
        except pygame.error:
            self.surface = self._open(False)
        self._table_surface = self.surface.subsurface((0, BAR, *self.arena.size))

    def _wait(self) -> None:
        self.clock.wait(self.next_frame - self.clock.now())

    def _flip(self, start: float) -> None:
        pygame.display.flip()
        now = self.clock.now()
        self.frame_cost += 0.1 * (now - start - self.frame_cost)
        if self._last_frame is not None:
            self.frame_times.append(now - self._last_frame)
        self._last_frame = now
        self.next_frame += self.interval
        if self.next_frame < now:  # missed frames are skipped
            self.next_frame = now

    def _draw_bar(self, display: DisplayState) -> None:
        middle, line, texts = self.size[0] / 2, BAR / 2, self.texts
        left = middle + 70
        write(self.surface, display.title, (EDGE, line), 19, INK, bold=True, width=middle - EDGE - 60)
        write(self.surface, str(display.won), (middle - 16, line), 26, COLORS[LEFT], True, "midright")
        write(self.surface, ":", (middle, line), 26, INK, True, "center")
        write(self.surface, str(display.lost), (middle + 16, line), 26, COLORS[RIGHT], True, "midleft")
        pygame.draw.aacircle(self.surface, HAND, (left + 8, line), 7, 3)
        left = write(self.surface, texts["window.hand"], (left + 20, line), 14, INK).right + 10
        for model, mark in self.arena.marks.items() if self.overlay else ():
            left = self.surface.blit(mark, mark.get_rect(midleft=(left, line))).right + 2
            left = write(self.surface, texts[f"window.{model}"], (left, line), 14, INK).right + 10
        minutes, seconds = divmod(int(display.seconds), 60)
        write(self.surface, f"{minutes}:{seconds:02d}", (self.size[0] - EDGE, line), 19, INK, True, "midright")

    def _draw_foot(self, display: DisplayState) -> None:
        line, left, newtons = self.size[1] - FOOT / 2, EDGE + 110, hypot(*display.force)
        if self.shows_force:
            text = self.texts["window.force"].format(newtons=f"{newtons:.1f}")
            write(self.surface, text, (EDGE, line), 14, FORCE if newtons else FADED, bold=True)
        hint, right = self.texts["window.hint"], self.size[0] - EDGE
        hint = write(self.surface, hint, (right, line), 14, FADED, anchor="midright", width=right / 2)
        weights = display.weights if self.shows_force else {}
        room = hint.left - EDGE - left - sum(font(14).size(name)[0] + 6 + EDGE for name in weights)
        for name, weight in weights.items():
            left = write_weight(self.surface, name, weight, (left, line), 14, min(70, room / len(weights)), 12) + EDGE

    def _draw_note(self, display: DisplayState) -> None:
        """Write the note into a line below the table, where it covers nothing."""
        if not display.note:
            return
        note = display.note
        if display.next_action:
            note += "; " + self.texts["notes.then"].format(action=display.next_action)
        box = pygame.Rect(0, BAR + self.arena.size[1], self.size[0], NOTE)
        pygame.draw.rect(self.surface, INK, box)
        write(self.surface, note, box.center, 20, PAPER, True, "center", self.size[0] - 2 * EDGE)
