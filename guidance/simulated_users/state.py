"""What changes in a person from tick to tick, and the arrays of n people that the compiled tick works on."""

from typing import NamedTuple

import numpy as np

from airhockey_marl.envs.physics import TableSpec
from guidance.simulated_users.advisors import Advisors

# One record per person, apart from the arm's. Seconds, meters of the hand and newtons, unless said otherwise.
USER_STATE = np.dtype(
    [
        ("age", np.int64),  # ticks since the round began
        # intention
        ("instruction", np.int64),  # the intention that an experimenter asks for, or -1
        ("intention", np.int64),
        ("next_intention", np.int64),  # chosen, not yet effective
        ("time_to_switch", np.float64),  # until it is effective; < 0: none chosen
        ("time_to_reconsider", np.float64),  # until the next choice without an event
        ("situation", np.int64),
        ("goal_threatened", np.int64),  # expects the puck in the own goal
        ("aim_offset", np.float64),  # in the opponent's goal mouth, or from the middle at home, in -1..1
        ("depth_offset", np.float64),  # before or behind the usual position, in -1..1
        ("anticipates_bounces", np.int64),  # of this shot
        ("time_to_contact", np.float64),  # as planned; inf: no strike planned
        # errors of perception in this plan, each N(0, 1)
        ("speed_error", np.float64),
        ("heading_error", np.float64),
        ("bounce_error", np.float64),
        # plan
        ("time_to_replan", np.float64),
        ("goal_x", np.float64),  # own goal of the hand, before goal sharing
        ("goal_y", np.float64),
        ("time_to_noise_draw", np.float64),
        ("noise_along", np.float64),  # share of speed
        ("noise_across", np.float64),
        ("tremor_x", np.float64),  # m/s
        ("tremor_y", np.float64),
        # response to the force
        ("co_contraction", np.float64),  # 0..1
        ("push_x", np.float64),  # voluntary force
        ("push_y", np.float64),
        ("trust", np.float64),  # in the force's goals, 0..1
        # motor adaptation
        ("slacking", np.float64),  # how far own effort has given way to support, 0..1
        ("learned", np.float64, (2, 2, 3)),  # N s/m, see `guidance.simulated_users.adaptation`
    ]
)


class UserArrays(NamedTuple):
    """All arrays of n people. Histories are ring buffers: row `age % ring` is the present.

    Attributes:
        people: (n,) `USER_PARAMETERS`.
        states: (n,) `USER_STATE`.
        arms: (n, 4) `ARM_STATE`: the arm, the arm without the force, and the forward model of each.
        sums: (n,) `RATING_SIGNALS`.
        observations: (n, ring, 12).
        forces: (n, ring, 2) N.
        prediction_errors: (n, ring, 2, 4) of the two forward models, m and m/s.
        partner_goals: (n, ring, 2) m, read from the forces.
        velocities: (n, ring, 2) m/s of the hand when the force of the same row began to act.
        actions: (n, 2) the hand's position over its reach.
        streams: (n,) uint64, random number generators.
    """

    people: np.ndarray
    states: np.ndarray
    arms: np.ndarray
    sums: np.ndarray
    observations: np.ndarray
    forces: np.ndarray
    prediction_errors: np.ndarray
    partner_goals: np.ndarray
    velocities: np.ndarray
    actions: np.ndarray
    streams: np.ndarray


class Setting(NamedTuple):
    """What all people of a batch have in common.

    Attributes:
        table: the table.
        variant: the `Variant` as an integer.
        adapts: whether they learn what force to expect.
        advisors: see `guidance.simulated_users.advisors`.
    """

    table: TableSpec
    variant: int
    adapts: bool
    advisors: Advisors


class Scratch(NamedTuple):
    """Buffers of one person's tick: expected path (LOOK_AHEAD, 4), utilities (INTENTIONS,), perceived force (2,) N."""

    path: np.ndarray
    utilities: np.ndarray
    force: np.ndarray
