"""The shipped league, and the league whose generations people play against."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from airhockey_marl.league.league import League

FOLDER = Path(__file__).parent


def league(name: str = "league") -> "League":
    """The league of `name`.safetensors: `league`, behind OAHG, or `opponents`."""
    from airhockey_marl.league.league import League  # torch, only where a league is loaded

    return League.load(FOLDER / f"{name}.safetensors")
