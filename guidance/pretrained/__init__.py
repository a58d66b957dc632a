"""The shipped user models, beside the shipped league's last generation."""

from pathlib import Path
from typing import TYPE_CHECKING

from airhockey_marl import pretrained

if TYPE_CHECKING:
    from guidance.study.models import Models

FOLDER = Path(__file__).parent


def models() -> "Models":
    """The three models that the guidances ask."""
    from guidance.study.models import Models  # torch, only where models are loaded

    return Models.load(
        pretrained.FOLDER / "league.safetensors", -1, FOLDER / "user.safetensors", FOLDER / "meta.safetensors"
    )
