"""The texts of a session with a person, as `conf/questions` has them: checked, and with their placeholders filled.

`en.yaml` is the reference: a translation has the same texts, and no other placeholders.
"""

import unicodedata
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any

import yaml

from airhockey_marl.experiment.config import CONF, flatten_settings
from airhockey_marl.experiment.registry import did_you_mean

CONSENT_PLACEHOLDERS = {"games"}


def flatten_texts(content: Mapping[str, Any]) -> dict[str, Any]:
    """The items, the ends of the scale and the texts of a configuration, by their dotted names."""
    texts = {key: content.get(key) or {} for key in ("questions", "scale", "texts")}
    if isinstance(texts["scale"], list):
        texts["scale"] = dict(enumerate(texts["scale"]))
    return flatten_settings({key: value if isinstance(value, Mapping) else {} for key, value in texts.items()})


@cache
def _reference() -> dict[str, str]:
    return flatten_texts(yaml.safe_load((CONF / "questions" / "en.yaml").read_text(encoding="utf-8")))


def english() -> dict[str, str]:
    """The texts in English by their dotted names below `texts`, such as `practice.title`."""
    return {key.removeprefix("texts."): text for key, text in _reference().items() if key.startswith("texts.")}


def placeholders(text: str) -> set[str]:
    """The names in braces in a text; a ValueError if a brace is open or a name has a format."""
    names = set()
    for _, name, spec, conversion in Formatter().parse(text):
        if name is not None:
            names.add(name + (f"!{conversion}" if conversion else "") + (f":{spec}" if spec else ""))
    return names


def check_texts(texts: Mapping[str, Any], place: Callable[[str], str]) -> None:
    """Raise a ValueError unless the result of `flatten_texts` has the texts and placeholders of the reference.

    Args:
        place: a key, and the file in which it stands, for messages.
    """
    reference = _reference()
    for key in texts:
        if key not in reference:
            raise ValueError(f"{place(key)}: no such text{did_you_mean(key, reference)}")
    for key, original in reference.items():
        if key not in texts:
            raise ValueError(f"{place(key)} is missing")
        if not isinstance(texts[key], str) or not texts[key].strip():
            raise ValueError(f"{place(key)} = {texts[key]!r} must be a text")
        _check_placeholders(texts[key], placeholders(original), place(key))


def _check_placeholders(text: str, allowed: set[str], place: str) -> None:
    try:
        unknown = placeholders(text) - allowed
    except ValueError as error:
        raise ValueError(f"{place}: {error}; braces hold a placeholder, a brace itself is written twice") from error
    if unknown:
        names = ", ".join(f"{{{name}}}" for name in sorted(allowed)) or "there are none"
        raise ValueError(f"{place}: {{{min(unknown)}}} must be one of the placeholders: {names}")


def read_consent(file: Path, games: int) -> str:
    """The text of a consent file, with composed characters, line feeds and the number of games.

    Raises:
        ValueError: there is no text, it is not UTF-8, or it has an unknown placeholder; names key and file.
    """
    place = f"consent = {file}"
    if not file.is_file():
        raise ValueError(f"{place} must be a file with a text")
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ValueError(
            f"{place} must be saved as UTF-8: line {line} has the byte 0x{error.object[error.start]:02x}"
        ) from error
    text = unicodedata.normalize("NFC", text.replace("\r\n", "\n").replace("\r", "\n"))
    if not text.strip():
        raise ValueError(f"{place} must hold a text")
    _check_placeholders(text, CONSENT_PLACEHOLDERS, place)
    return text.format(games=games)


def unshaped(text: str) -> Iterator[str]:
    """The characters that must be ordered or joined to be read, or that are invisible: a window only draws a row."""
    for character in text:
        kind, direction = unicodedata.category(character), unicodedata.bidirectional(character)
        if direction in ("R", "AL") or kind[0] == "M" or (kind in ("Cc", "Cf") and character not in "\n\t"):
            yield character
