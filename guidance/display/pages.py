"""Pages of a session: a text with keys, and a questionnaire."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import pygame

from airhockey_marl.envs.physics import LEFT
from airhockey_marl.envs.rendering import COLORS
from guidance.display.drawing import font, wrap, write, write_lines
from guidance.display.scene import GRAY, INK, PAPER
from guidance.haptics.texts import english

MARGIN, HEADER, TITLE, TEXT, KEY = 70, 84, 30, 19, 19  # px
FADED = (90, 96, 104)
POINTS = range(1, 8)  # of a rating
MIN_TEXT = 15  # px, minimum size of a text


@dataclass(frozen=True)
class Page:
    """A title, a text, and keys with their meanings.

    Attributes:
        texts: `key_names.<key>`, what a key is called, and `page.part` and `page.next`, for a long text.
    """

    title: str
    text: str
    keys: Mapping[str, str]
    texts: Mapping[str, str] = field(default_factory=english)

    def parts(self, size: tuple[int, int]) -> list["Page"]:
        """Split a text that does not fit on a surface of this size into several pages; the last one has the keys.

        Text is at least `MIN_TEXT` high.
        """
        lines = wrap(self.text, MIN_TEXT, size[0] - 2 * MARGIN)
        max_lines = int(self._room(size[1]) / (1.5 * MIN_TEXT))
        if len(lines) <= max_lines:
            return [self]
        texts, rest = [], self.text
        while rest:
            texts.append(_beginning(rest, MIN_TEXT, size[0] - 2 * MARGIN, max_lines))
            rest = rest[len(texts[-1]) :].lstrip()
        names = {"title": self.title, "parts": len(texts)}
        titles = [self.texts["page.part"].format(part=i, **names) for i in range(1, len(texts) + 1)]
        to_next = {"space": self.texts["page.next"]}
        keys = [*[to_next] * (len(texts) - 1), self.keys]
        return [Page(*part, self.texts) for part in zip(titles, texts, keys, strict=True)]

    def draw(self, surface: pygame.Surface, typed: str | None = None) -> None:
        """Draw the page on the whole surface, with an input line that shows `typed` unless it is None."""
        surface.fill(PAPER)
        width, line = surface.get_width() - 2 * MARGIN, MARGIN
        write(surface, self.title, (MARGIN, line), TITLE, INK, bold=True, width=width)
        line += 2 * TITLE
        room = surface.get_height() - line - MARGIN
        apart = min(round(1.9 * KEY), int(room / max(len(self.keys), 1)))
        size = self._size(width, self._room(surface.get_height()) - (3 * TEXT if typed is not None else 0))
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
            write(surface, self._name(key), (MARGIN, line), size, COLORS[LEFT], bold=True)
            write(surface, meaning, (MARGIN + column, line), size, INK, width=width - column)
            line += apart

    def _room(self, height: int) -> float:
        """Height of the text between title and keys."""
        return height - 1.5 * MARGIN - 2 * TITLE - round(1.9 * KEY) * max(len(self.keys), 1) - KEY

    def _name(self, key: str) -> str:
        return self.texts.get(f"key_names.{key}", key)

    def _columns(self, width: int) -> tuple[int, int]:
        """The largest text size, up to `KEY`, at which each key fits on a line, and the column of the meanings."""
        for size in range(KEY, 9, -1):
            names = map(self._name, self.keys)
            column = max((font(size, True, name).size(name)[0] for name in names), default=0) + 2 * size
            if all(column + font(size, False, meaning).size(meaning)[0] <= width for meaning in self.keys.values()):
                break
        return size, column

    def _size(self, width: int, height: float) -> int:
        """The largest text size, up to `TEXT`, at which the text fits."""
        sizes = range(TEXT, MIN_TEXT - 1, -1)
        return next((size for size in sizes if len(wrap(self.text, size, width)) * 1.5 * size <= height), sizes[-1])


def _beginning(text: str, size: int, width: float, max_lines: int) -> str:
    """The longest beginning of a text, up to a space or between two letters, that has at most so many lines."""
    least, most = 1, len(text)
    while least < most:  # the number of lines grows with the text
        middle = (least + most + 1) // 2
        least, most = (middle, most) if len(wrap(text[:middle], size, width)) <= max_lines else (least, middle - 1)
    if least == len(text) or text[least].isspace():
        return text[:least]
    return text[: max((i for i in range(least) if text[i].isspace()), default=least)] or text[:least]


@dataclass
class Items:
    """A questionnaire whose items are rated from 1 to 7.

    Attributes:
        items: name -> question.
        low, high: meanings of 1 and 7.
        texts: `items.hint` and `items.done`.
        answers: name -> answer, so far.
        at: index of the item that a key answers.
        is_confirmed: whether the person has confirmed a complete questionnaire.
    """

    title: str
    items: Mapping[str, str]
    low: str
    high: str
    texts: Mapping[str, str] = field(default_factory=english)
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
        width = size[0] - 2 * MARGIN
        write(surface, self.title, (MARGIN, MARGIN - 20), TITLE, INK, bold=True, width=width)
        for number, (name, text) in enumerate(self.items.items()):
            is_current = number == self.at
            first, last = self._box(number, 1, size), self._box(number, 7, size)
            row = self._row(size)
            room = pygame.Rect(MARGIN, first.bottom - row + 6, width, row - first.height - 8)
            write_lines(surface, text, room, TEXT, INK, is_current)
            if is_current:
                pygame.draw.rect(surface, COLORS[LEFT], (MARGIN - 18, room.top, 5, first.bottom - room.top))
            low = pygame.Rect(MARGIN, first.top, first.left - 14 - MARGIN, first.height)
            high = pygame.Rect(last.right + 14, last.top, size[0] - MARGIN // 2 - last.right - 14, last.height)
            write_lines(surface, self.low, low, 15, FADED, anchor="midright")
            write_lines(surface, self.high, high, 15, FADED)
            for point in POINTS:
                box, is_chosen = self._box(number, point, size), self.answers.get(name) == point
                pygame.draw.rect(surface, COLORS[LEFT] if is_chosen else PAPER, box, border_radius=8)
                pygame.draw.rect(surface, COLORS[LEFT] if is_chosen else GRAY, box, 2, border_radius=8)
                write(surface, str(point), box.center, KEY, PAPER if is_chosen else INK, is_chosen, "center")
        done = len(self.answers) == len(self.items)
        hint = self.texts["items.done" if done else "items.hint"]
        write(surface, hint, (MARGIN, size[1] - MARGIN // 2), TEXT, INK if done else FADED, done, width=width)

    def _row(self, size: tuple[int, int]) -> float:
        """Height of an item."""
        return (size[1] - HEADER - MARGIN) / len(self.items)

    def _box(self, item: int, point: int, size: tuple[int, int]) -> pygame.Rect:
        """Box of one point of one item."""
        width = size[0] - 2 * MARGIN
        side = min(46, width // 14)
        apart = min(64, (width - 260) // 7)
        left = MARGIN + (width - 6 * apart - side) // 2 + (point - 1) * apart
        return pygame.Rect(left, round(HEADER + (item + 1) * self._row(size)) - side, side, side)
