"""What all games of a study have in common, from its configuration, and the manifest that identifies a result."""

import hashlib
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.files import sha256
from airhockey_marl.experiment.registry import construct
from airhockey_marl.league.league import League
from airhockey_marl.players.inference import greedy_player
from airhockey_marl.players.players import Player
from guidance.forces.condition_specs import PAPER_LETTERS, ConditionSpec, select_specs
from guidance.forces.conditions import Condition, GuidanceSettings, build_condition
from guidance.forces.lookahead import Lookahead
from guidance.simulated_users import Advisors, SimulatedUsers, load_advisors
from guidance.simulated_users.adaptation import is_on
from guidance.simulated_users.force_response import check_variant
from guidance.study.metrics import EXTRA_METRICS
from guidance.study.models import Models, check_predictor
from guidance.study.protocol import Protocol

FROZEN = Path(__file__).parent / "frozen.json"
VERSIONS = ("torch", "tensordict", "torchrl", "numba", "numpy", "scipy", "pandas", "pingouin")
STUDY_KEYS = ("users", "guidance", "study", "participants", "opponent")  # these and the models define a study


@dataclass(frozen=True, kw_only=True)
class PlaySetup:
    """What simulated people play against, and how they respond.

    Attributes:
        opponent: the player at the right side of every table.
        variant: how people respond to a force, see `guidance.simulated_users.force_response`.
        advisors: the policies that skilled people learned from.
        adaptation: whether people learn what force to expect, see `guidance.simulated_users.adaptation`.
        table: the table's dimensions and physics.
    """

    opponent: Player
    variant: str
    advisors: Advisors
    adaptation: bool = True
    table: TableSpec = field(default_factory=TableSpec)

    def simulated_users(self, people: np.ndarray, rng_states: np.ndarray) -> SimulatedUsers:
        """Simulated participants (n,) with random number streams of these states (n,)."""
        return SimulatedUsers(people, rng_states, self.table, self.variant, self.advisors, self.adaptation)


@dataclass(frozen=True, kw_only=True)
class StudySetup(PlaySetup):
    """The conditions of a study, its models and protocol.

    Attributes:
        conditions: the conditions that are played.
        models: the models of the guidances.
        lookahead: T_lookahead of Eq. 4 and its reading.
        protocol: the course of a game.
        rating_scales: the scale of each signal of the rating proxies.
        extra_metrics: names of metrics of plug-ins, measured beside the paper's four.
    """

    conditions: Sequence[Condition]
    models: Models
    lookahead: Lookahead
    protocol: Protocol
    rating_scales: Mapping[str, float]
    extra_metrics: tuple[str, ...] = ()


def load_play_setup(cfg: DictConfig, device: str = "cpu") -> PlaySetup:
    """The opponent, evaluated on `device`, and how the people respond; see `load_setup`."""
    check_variant(cfg.users.variant)
    adaptation, advisors = is_on(cfg.users.adaptation), load_advisors(cfg.users.advisors)
    opponent = load_opponent(cfg, device)
    return PlaySetup(opponent=opponent, variant=cfg.users.variant, advisors=advisors, adaptation=adaptation)


def load_setup(cfg: DictConfig) -> StudySetup:
    """The setup of a configuration.

    Raises:
        ValueError: a value is not valid, or a file is missing or broken; the message names it.
    """
    metrics = tuple(cfg.get("metrics") or ())
    for name in metrics:
        EXTRA_METRICS.find(name, "metrics")
    device = cfg.get("compute", "cpu")
    return StudySetup(
        **vars(load_play_setup(cfg, device)),
        conditions=load_conditions(cfg),
        models=load_models(cfg, device),
        lookahead=load_lookahead(cfg),
        protocol=construct(Protocol, cfg.study, "study"),
        rating_scales=OmegaConf.to_container(cfg.users.scales),
        extra_metrics=metrics,
    )


def condition_specs(cfg: DictConfig, warn: Callable[[str], None] = lambda text: None) -> list[ConditionSpec]:
    """The condition of the configuration; without one the paper's nine, and those that `beyond` names."""
    return select_specs(cfg.get("condition"), cfg.get("beyond"), warn)


def load_conditions(cfg: DictConfig) -> list[Condition]:
    """The conditions of `condition_specs`, ready to be played."""
    settings = GuidanceSettings.from_config(cfg.guidance)
    specs = condition_specs(cfg, lambda text: print(f"note: {text}", file=sys.stderr))
    return [build_condition(spec, settings) for spec in specs]


def load_lookahead(cfg: DictConfig) -> Lookahead:
    """The look-ahead of the configuration."""
    return construct(Lookahead, cfg.guidance.lookahead, "guidance.lookahead")


def load_models(cfg: DictConfig, device: str = "cpu") -> Models:
    """The models of the configuration, evaluated on `device`."""
    check_predictor(cfg.guidance.predictor)
    files = cfg.models
    return Models.load(files.league, files.get("generation", -1), files.user, files.meta, device)


def load_opponent(cfg: DictConfig, device: str = "cpu") -> Player:
    """The opponent of the configuration, which plays its mean action, evaluated on `device`."""
    return greedy_player(League.load(cfg.models.opponents).player(cfg.opponent), device)


def file_hashes(cfg: DictConfig, models: Models) -> dict[str, str]:
    """SHA-256 of every file that a study depends on, by its purpose."""
    files = {"opponents": cfg.models.opponents, "advisors": cfg.users.advisors}
    return models.hashes | {name: sha256(path) for name, path in files.items() if path is not None}


def study_hash(cfg: DictConfig, hashes: dict[str, str]) -> str:
    """Hash of all that defines a study except its seed and conditions; runs with equal hashes may be merged."""
    config = OmegaConf.to_container(cfg, resolve=True)
    shared = {key: config[key] for key in STUDY_KEYS}
    shared["users"] = {key: value for key, value in shared["users"].items() if key != "advisors"}  # hashed as a file
    return hashlib.sha256(json.dumps([shared, hashes], sort_keys=True).encode()).hexdigest()


def frozen_study() -> dict[str, Any]:
    """The studies that were fixed before any condition was compared, by their guidance, and their `seed`.

    Each is given by its `study_hash`; the guidance is the pilot's (conf/guidance/default.yaml), or that of the former
    rule (stability.yaml).
    """
    return json.loads(FROZEN.read_text(encoding="utf-8"))


def manifest(cfg: DictConfig, hashes: dict[str, str], command_line: str, seconds: float) -> dict:
    """The origin of a result; `frozen`: its configuration, models and seed are those of a frozen study.

    People who adapt take what they learn from one condition into the next, so all nine of the paper's must be in it.
    """
    digest, fixed = study_hash(cfg, hashes), frozen_study()
    played = {spec.letter for spec in condition_specs(cfg)}
    complete = not is_on(cfg.users.adaptation) or played >= {*PAPER_LETTERS}
    return {
        "command": command_line,
        "seed": cfg.seed,
        "study_hash": digest,
        "frozen": complete and cfg.seed == fixed["seed"] and digest in fixed["studies"].values(),
        "models": hashes,
        "conditions": [
            {"name": s.name, "letter": s.letter, "label": s.label, "color": s.color, "against": list(s.against)}
            for s in condition_specs(cfg)
        ],
        "metrics": [
            {"name": name, "label": EXTRA_METRICS[name].label, "unit": EXTRA_METRICS[name].unit}
            for name in cfg.get("metrics") or ()
        ],
        "versions": {name: version(name) for name in VERSIONS},
        "seconds": round(seconds, 1),
        "config": OmegaConf.to_container(cfg, resolve=True),
    }
