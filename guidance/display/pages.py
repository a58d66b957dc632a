"""Pages of a study: a text with keys to go on, and a questionnaire."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import pygame

from airhockey_marl.envs.physics import LEFT
from airhockey_marl.envs.rendering import COLORS
from guidance.display.drawing import font, wrapped, write
from guidance.display.film import GRAY, INK, PAPER

MARGIN, TITLE, TEXT, KEY = 70, 30, 19, 19  # px
FADED = (90, 96, 104)
POINTS = range(1, 8)  # of a rating
READABLE = 15  # px, the smallest letters of a text
NEXT = {"space": "next page"}


@dataclass(frozen=True)
class Page:
    """A title, a text, and the keys that one can press, with what they mean."""

    title: str
    text: str
    keys: Mapping[str, str]

    def parts(self, size: tuple[int, int]) -> list["Page"]:
        """Itself, or if its text is too long for a surface of this size, several pages; the last has the keys.

        No letters are smaller than can be read.
        """
        width = size[0] - 2 * MARGIN
        room = size[1] - 2 * MARGIN - 2 * TITLE - round(1.9 * KEY) * max(len(self.keys), 1) - 3 * KEY
        lines, most = wrapped(self.text, READABLE, width), int(room / (1.5 * READABLE))
        if len(lines) <= most:
            return [self]
        texts = ["\n".join(lines[i : i + most]).strip("\n") for i in range(0, len(lines), most)]
        titles = [f"{self.title} ({i} of {len(texts)})" for i in range(1, len(texts) + 1)]
        first = [Page(title, text, NEXT) for title, text in zip(titles[:-1], texts[:-1], strict=True)]
        return [*first, Page(titles[-1], texts[-1], self.keys)]

    def draw(self, surface: pygame.Surface, typed: str | None = None) -> None:
        """Draw the page over everything; with `typed`, also a line on which that is written."""
        surface.fill(PAPER)
        width, line = surface.get_width() - 2 * MARGIN, MARGIN
        write(surface, self.title, (MARGIN, line), TITLE, INK, bold=True)
        line += 2 * TITLE
        room = surface.get_height() - line - MARGIN
        apart = min(round(1.9 * KEY), int(room / max(len(self.keys), 1)))
        size = self._size(width, room - apart * len(self.keys) - 2 * KEY)
        for text in wrapped(self.text, size, width):
            write(surface, text, (MARGIN, line), size, INK)
            line += round(1.5 * size)
        if typed is not None:
            line += TEXT
            shown = wrapped(typed, TEXT, width)[-1] if typed else ""
            end = write(surface, shown, (MARGIN, line), TEXT, INK).right
            pygame.draw.line(surface, COLORS[LEFT], (end + 2, line - 12), (end + 2, line + 12), 2)
            pygame.draw.line(surface, GRAY, (MARGIN, line + 18), (MARGIN + width, line + 18), 2)
            line += 2 * TEXT
        line += KEY
        size, column = self._columns(width)
        for key, what in self.keys.items():
            write(surface, key, (MARGIN, line), size, COLORS[LEFT], bold=True)
            write(surface, what, (MARGIN + column, line), size, INK)
            line += apart

    def _columns(self, width: int) -> tuple[int, int]:
        """The largest size of letters, up to `KEY`, in which each key fits on a line, and where what it does begins."""
        for size in range(KEY, 9, -1):
            column = max((font(size, True).size(key)[0] for key in self.keys), default=0) + 2 * size
            if all(column + font(size).size(what)[0] <= width for what in self.keys.values()):
                break
        return size, column

    def _size(self, width: int, height: float) -> int:
        """The largest size of letters, up to `TEXT`, in which the text fits."""
        sizes = range(TEXT, READABLE - 1, -1)
        return next((size for size in sizes if len(wrapped(self.text, size, width)) * 1.5 * size <= height), sizes[-1])


@dataclass
class Items:
    """A questionnaire of items that are rated from 1 to 7.

    Attributes:
        items: what is asked, by name.
        low, high: what 1 and 7 mean.
        answers: so far, by name.
        at: number of the item that a key answers.
        confirmed: everything is answered, and the person has said so.
    """

    title: str
    items: Mapping[str, str]
    low: str
    high: str
    answers: dict[str, int] = field(default_factory=dict)
    at: int = 0
    confirmed: bool = False

    def press(self, key: str) -> None:
        """A digit answers the present item and goes on to the next, the arrows choose one, return confirms."""
        names = list(self.items)
        key = key.strip("[]")  # of the number pad
        if key.isdigit() and int(key) in POINTS:
            self.answers[names[self.at]] = int(key)
            self.at = min(self.at + 1, len(names) - 1)
        elif key in ("up", "down"):
            self.at = min(max(self.at + (1 if key == "down" else -1), 0), len(names) - 1)
        elif key in ("return", "enter"):
            self.confirmed = len(self.answers) == len(names)

    def click(self, place: tuple[int, int], size: tuple[int, int]) -> None:
        """A click on a point answers its item."""
        for number, name in enumerate(self.items):
            for point in POINTS:
                if self._box(number, point, size).inflate(10, 10).collidepoint(place):
                    self.answers[name], self.at = point, number

    def draw(self, surface: pygame.Surface) -> None:
        """Draw the items over everything."""
        surface.fill(PAPER)
        size = surface.get_size()
        write(surface, self.title, (MARGIN, MARGIN), TITLE, INK, bold=True)
        for number, (name, text) in enumerate(self.items.items()):
            here = number == self.at
            first, last = self._box(number, 1, size), self._box(number, 7, size)
            write(surface, text, (MARGIN, first.top - 26), TEXT, INK, bold=here)
            if here:
                pygame.draw.rect(surface, COLORS[LEFT], (MARGIN - 18, first.top - 38, 5, 84))
            write(surface, self.low, (first.left - 14, first.centery), 15, FADED, anchor="midright")
            write(surface, self.high, (last.right + 14, last.centery), 15, FADED)
            for point in POINTS:
                box, chosen = self._box(number, point, size), self.answers.get(name) == point
                pygame.draw.rect(surface, COLORS[LEFT] if chosen else PAPER, box, border_radius=8)
                pygame.draw.rect(surface, COLORS[LEFT] if chosen else GRAY, box, 2, border_radius=8)
                write(surface, str(point), box.center, KEY, PAPER if chosen else INK, chosen, "center")
        done = len(self.answers) == len(self.items)
        how = "return: done" if done else "1 to 7 or the mouse answer; the arrows go back"
        write(surface, how, (MARGIN, size[1] - MARGIN), TEXT, INK if done else FADED, bold=done)

    def _box(self, item: int, point: int, size: tuple[int, int]) -> pygame.Rect:
        """Of one point of one item."""
        rows, width = len(self.items), size[0] - 2 * MARGIN
        row = (size[1] - 3 * MARGIN - 20) / rows
        side = min(46, width // 14)
        apart = min(64, (width - 260) // 7)
        left = MARGIN + (width - 6 * apart - side) // 2 + (point - 1) * apart
        return pygame.Rect(left, round(MARGIN + 70 + item * row + 30), side, side)
