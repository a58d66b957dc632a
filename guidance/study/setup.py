"""What all games of a study have in common, from its configuration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.registry import construct
from airhockey_marl.players.players import Player
from guidance.forces.conditions import Condition
from guidance.simulated_users import Advisors, SimulatedUsers, load_advisors
from guidance.simulated_users.force_response import check_variant
from guidance.study.metrics import EXTRA_METRICS
from guidance.study.models import Models
from guidance.study.protocol import Protocol
from guidance.study.provenance import load_conditions, load_models, load_opponent


@dataclass(frozen=True)
class StudySetup:
    """The conditions of a study, its models and protocol, and how its simulated people respond.

    Attributes:
        conditions: the conditions that are played.
        models: the models of the guidances.
        opponent: the player at the right side of every table.
        lookahead_seconds: T_lookahead of Eq. 4.
        protocol: the course of a game.
        variant: how people respond to a force, see `guidance.simulated_users.force_response`.
        advisors: the policies that skilled people learned from.
        rating_scales: the scale of each signal of the rating proxies.
        table: the table's dimensions and physics.
        extra_metrics: names of metrics of plug-ins, measured beside the paper's four.
    """

    conditions: Sequence[Condition]
    models: Models
    opponent: Player
    lookahead_seconds: float
    protocol: Protocol
    variant: str
    advisors: Advisors
    rating_scales: Mapping[str, float]
    table: TableSpec = field(default_factory=TableSpec)
    extra_metrics: tuple[str, ...] = ()

    def simulated_users(self, people: np.ndarray, rng_states: np.ndarray) -> SimulatedUsers:
        """Simulated participants (n,) with random number streams of these states (n,)."""
        return SimulatedUsers(people, rng_states, self.table, self.variant, self.advisors)


def load_setup(cfg: DictConfig) -> StudySetup:
    """The setup of a configuration.

    Raises:
        ValueError: a value is not valid, or a file is missing or broken; the message names it.
    """
    check_variant(cfg.users.variant)
    metrics = tuple(cfg.get("metrics") or ())
    for name in metrics:
        EXTRA_METRICS.find(name, "metrics")
    device = cfg.get("compute", "cpu")
    return StudySetup(
        conditions=load_conditions(cfg),
        models=load_models(cfg, device),
        opponent=load_opponent(cfg, device),
        lookahead_seconds=cfg.guidance.lookahead,
        protocol=construct(Protocol, cfg.study, "study"),
        variant=cfg.users.variant,
        advisors=load_advisors(cfg.users.advisors),
        rating_scales=OmegaConf.to_container(cfg.users.scales),
        extra_metrics=metrics,
    )
