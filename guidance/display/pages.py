"""Pages of a session: a text with keys, and a questionnaire."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import pygame

from airhockey_marl.envs.physics import LEFT
from airhockey_marl.envs.rendering import COLORS
from guidance.display.drawing import font, wrap, write
from guidance.display.scene import GRAY, INK, PAPER

MARGIN, TITLE, TEXT, KEY = 70, 30, 19, 19  # px
FADED = (90, 96, 104)
POINTS = range(1, 8)  # of a rating
MIN_TEXT = 15  # px, minimum size of a text
NEXT = {"space": "next page"}


@dataclass(frozen=True)
class Page:
    """A title, a text, and keys with their meanings."""

    title: str
    text: str
    keys: Mapping[str, str]

    def parts(self, size: tuple[int, int]) -> list["Page"]:
        """Split a text that does not fit on a surface of this size into several pages; the last one has the keys.

        Text is at least `MIN_TEXT` high.
        """
        width = size[0] - 2 * MARGIN
        room = size[1] - 2 * MARGIN - 2 * TITLE - round(1.9 * KEY) * max(len(self.keys), 1) - 3 * KEY
        lines, max_lines = wrap(self.text, MIN_TEXT, width), int(room / (1.5 * MIN_TEXT))
        if len(lines) <= max_lines:
            return [self]
        texts = ["\n".join(lines[i : i + max_lines]).strip("\n") for i in range(0, len(lines), max_lines)]
        titles = [f"{self.title} ({i} of {len(texts)})" for i in range(1, len(texts) + 1)]
        first = [Page(title, text, NEXT) for title, text in zip(titles[:-1], texts[:-1], strict=True)]
        return [*first, Page(titles[-1], texts[-1], self.keys)]

    def draw(self, surface: pygame.Surface, typed: str | None = None) -> None:
        """Draw the page on the whole surface, with an input line that shows `typed` unless it is None."""
        surface.fill(PAPER)
        width, line = surface.get_width() - 2 * MARGIN, MARGIN
        write(surface, self.title, (MARGIN, line), TITLE, INK, bold=True)
        line += 2 * TITLE
        room = surface.get_height() - line - MARGIN
        apart = min(round(1.9 * KEY), int(room / max(len(self.keys), 1)))
        size = self._size(width, room - apart * len(self.keys) - 2 * KEY)
        for text in wrap(self.text, size, width):
            write(surface, text, (MARGIN, line), size, INK)
            line += round(1.5 * size)
        if typed is not None:
            line += TEXT
            shown = wrap(typed, TEXT, width)[-1] if typed else ""
            end = write(surface, shown, (MARGIN, line), TEXT, INK).right
            pygame.draw.line(surface, COLORS[LEFT], (end + 2, line - 12), (end + 2, line + 12), 2)
            pygame.draw.line(surface, GRAY, (MARGIN, line + 18), (MARGIN + width, line + 18), 2)
            line += 2 * TEXT
        line += KEY
        size, column = self._columns(width)
        for key, meaning in self.keys.items():
            write(surface, key, (MARGIN, line), size, COLORS[LEFT], bold=True)
            write(surface, meaning, (MARGIN + column, line), size, INK)
            line += apart

    def _columns(self, width: int) -> tuple[int, int]:
        """The largest text size, up to `KEY`, at which each key fits on a line, and the column of the meanings."""
        for size in range(KEY, 9, -1):
            column = max((font(size, True).size(key)[0] for key in self.keys), default=0) + 2 * size
            if all(column + font(size).size(meaning)[0] <= width for meaning in self.keys.values()):
                break
        return size, column

    def _size(self, width: int, height: float) -> int:
        """The largest text size, up to `TEXT`, at which the text fits."""
        sizes = range(TEXT, MIN_TEXT - 1, -1)
        return next((size for size in sizes if len(wrap(self.text, size, width)) * 1.5 * size <= height), sizes[-1])


@dataclass
class Items:
    """A questionnaire whose items are rated from 1 to 7.

    Attributes:
        items: name -> question.
        low, high: meanings of 1 and 7.
        answers: name -> answer, so far.
        at: index of the item that a key answers.
        is_confirmed: whether the person has confirmed a complete questionnaire.
    """

    title: str
    items: Mapping[str, str]
    low: str
    high: str
    answers: dict[str, int] = field(default_factory=dict)
    at: int = 0
    is_confirmed: bool = False

    def press(self, key: str) -> None:
        """Process a key: a digit answers the current item, the arrows change the item, return confirms."""
        names = list(self.items)
        key = key.strip("[]")  # of a number pad
        if key.isdigit() and int(key) in POINTS:
            self.answers[names[self.at]] = int(key)
            self.at = min(self.at + 1, len(names) - 1)
        elif key in ("up", "down"):
            self.at = min(max(self.at + (1 if key == "down" else -1), 0), len(names) - 1)
        elif key in ("return", "enter"):
            self.is_confirmed = len(self.answers) == len(names)

    def click(self, place: tuple[int, int], size: tuple[int, int]) -> None:
        """Process a click: on a point, it answers its item."""
        for number, name in enumerate(self.items):
            for point in POINTS:
                if self._box(number, point, size).inflate(10, 10).collidepoint(place):
                    self.answers[name], self.at = point, number

    def draw(self, surface: pygame.Surface) -> None:
        """Draw the items on the whole surface."""
        surface.fill(PAPER)
        size = surface.get_size()
        write(surface, self.title, (MARGIN, MARGIN), TITLE, INK, bold=True)
        for number, (name, text) in enumerate(self.items.items()):
            is_current = number == self.at
            first, last = self._box(number, 1, size), self._box(number, 7, size)
            write(surface, text, (MARGIN, first.top - 26), TEXT, INK, bold=is_current)
            if is_current:
                pygame.draw.rect(surface, COLORS[LEFT], (MARGIN - 18, first.top - 38, 5, 84))
            write(surface, self.low, (first.left - 14, first.centery), 15, FADED, anchor="midright")
            write(surface, self.high, (last.right + 14, last.centery), 15, FADED)
            for point in POINTS:
                box, is_chosen = self._box(number, point, size), self.answers.get(name) == point
                pygame.draw.rect(surface, COLORS[LEFT] if is_chosen else PAPER, box, border_radius=8)
                pygame.draw.rect(surface, COLORS[LEFT] if is_chosen else GRAY, box, 2, border_radius=8)
                write(surface, str(point), box.center, KEY, PAPER if is_chosen else INK, is_chosen, "center")
        done = len(self.answers) == len(self.items)
        hint = "return: done" if done else "1 to 7 or the mouse answer; the arrows go back"
        write(surface, hint, (MARGIN, size[1] - MARGIN), TEXT, INK if done else FADED, bold=done)

    def _box(self, item: int, point: int, size: tuple[int, int]) -> pygame.Rect:
        """Box of one point of one item."""
        rows, width = len(self.items), size[0] - 2 * MARGIN
        row = (size[1] - 3 * MARGIN - 20) / rows
        side = min(46, width // 14)
        apart = min(64, (width - 260) // 7)
        left = MARGIN + (width - 6 * apart - side) // 2 + (point - 1) * apart
        return pygame.Rect(left, round(MARGIN + 70 + item * row + 30), side, side)
