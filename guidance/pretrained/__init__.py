"""The shipped user models, in a folder per predictor, beside the shipped league's last generation.

`now` was trained to predict the action at the state's own time, as in the paper; `ahead_0.1` that of 0.1 s later.
`guidance.predictor` of a configuration chooses one.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import OmegaConf

from airhockey_marl import pretrained
from airhockey_marl.experiment.config import CONF

if TYPE_CHECKING:
    from guidance.study.models import Models

FOLDER = Path(__file__).parent


def models(predictor: str | None = None) -> "Models":
    """The three models of the guidances, with the user models of `predictor`, by default that of conf/guidance."""
    from guidance.study.models import Models, check_predictor  # torch, only where models are loaded

    name = OmegaConf.load(CONF / "guidance" / "default.yaml").predictor if predictor is None else predictor
    check_predictor(name)
    user, meta = (FOLDER / name / f"{model}.safetensors" for model in ("user", "meta"))
    return Models.load(pretrained.FOLDER / "league.safetensors", -1, user, meta)
