"""`SimulatedUsers`: n simulated people side by side at their devices."""

from math import ceil

import numpy as np
from omegaconf import DictConfig

from airhockey_marl.envs.physics import TableSpec, check_table
from airhockey_marl.experiment.parallel import parallel_for
from airhockey_marl.experiment.registry import construct
from airhockey_marl.experiment.validation import check_rows
from guidance.simulated_users.adaptation import is_on
from guidance.simulated_users.advisors import NO_ADVISORS, Advisors
from guidance.simulated_users.arm import ARM_STATE
from guidance.simulated_users.force_response import Variant, check_variant
from guidance.simulated_users.intention import NO_INSTRUCTION, Intention
from guidance.simulated_users.population import USER_PARAMETERS, Population
from guidance.simulated_users.ratings import RATING_SIGNALS, SIGNALS, expected_points, likert_points, signals
from guidance.simulated_users.state import USER_STATE, Setting, UserArrays
from guidance.simulated_users.tick import reset_users, step_users


def load_population(users: DictConfig) -> Population:
    """The population of the section `users` of a configuration.

    Raises:
        ValueError: it, `variant` or `adaptation` is invalid.
    """
    check_variant(users.variant)
    is_on(users.adaptation)
    return construct(Population, users.population, "users.population")


class SimulatedUsers:
    """Simulated people who play by what they see and feel.

    `step` takes a game state and a force, never the guidance, its target, its weights or its name. The play of person i
    depends on their own parameters, random numbers, states and forces, not on the others of the batch.

    Args:
        people: (n,) structured array of dtype `USER_PARAMETERS`, see `sample_people`.
        streams: (n,) uint64, each person's random number generator, see `personal_streams`; copied.
        table: the `TableSpec` that they know by practice.
        variant: name of a `Variant` of the response to a force.
        advisors: players whose actions weigh in the choice of intentions; none if None.
        adaptation: whether they learn what force to expect, see `guidance.simulated_users.adaptation`.
    """

    def __init__(
        self,
        people: np.ndarray,
        streams: np.ndarray,
        table: TableSpec | None = None,
        variant: str = "comply_or_resist",
        advisors: Advisors | None = None,
        adaptation: bool = True,
    ) -> None:
        people = np.asarray(people)
        if people.dtype != USER_PARAMETERS or people.ndim != 1 or len(people) < 1:
            raise ValueError(f"people of shape {people.shape} must be an array (n,) of people, n at least 1")
        streams = np.asarray(streams)
        if streams.dtype != np.uint64 or streams.shape != people.shape:
            raise ValueError(f"streams {streams.dtype} {streams.shape} must be uint64 {people.shape}")
        check_variant(variant)
        self.n, self.people, self.streams = n, people, streams = len(people), people.copy(), streams.copy()
        self.table = check_table(table or TableSpec())
        self.variant, self.advisors = Variant[variant], advisors or NO_ADVISORS
        self._setting = Setting(self.table, int(self.variant), bool(adaptation), self.advisors)
        longest_memory = max(
            (people["tactile_delay"] + people["partner_lead_time"]).max(),
            *(people[name].max() for name in ("visual_delay", "proprioceptive_delay")),
        )
        ring = ceil(longest_memory / self.table.tick) + 2
        self._arrays = UserArrays(
            people=people,
            states=np.zeros(n, USER_STATE),
            arms=np.zeros((n, 4), ARM_STATE),
            sums=np.zeros(n, RATING_SIGNALS),
            observations=np.zeros((n, ring, 12)),
            forces=np.zeros((n, ring, 2)),
            prediction_errors=np.zeros((n, ring, 2, 4)),
            partner_goals=np.zeros((n, ring, 2)),
            velocities=np.zeros((n, ring, 2)),
            actions=np.zeros((n, 2)),
            streams=streams,
        )
        self._all_rows = np.arange(n)
        self._arrays.states["instruction"] = NO_INSTRUCTION
        self.new_game(np.ones(n, dtype=bool))

    def new_round(self, mask: np.ndarray) -> None:
        """Begin a round for the people of the boolean mask (n,): hand at the center, nothing perceived yet."""
        reset_users(self._arrays, self._checked(mask))

    def new_game(self, mask: np.ndarray) -> None:
        """Begin a round as `new_round`, and also reset trust, co-contraction, slacking and the rating signals.

        What people have learned stays: the same person plays the next game, and a motor memory outlasts a break.
        """
        mask, arrays = self._checked(mask), self._arrays
        arrays.states["trust"][mask] = self.people["initial_trust"][mask]
        arrays.states["co_contraction"][mask] = arrays.states["slacking"][mask] = 0.0
        arrays.sums[mask] = np.zeros((), RATING_SIGNALS)
        self.new_round(mask)

    def carry_over(self, rows: np.ndarray, source: "SimulatedUsers", source_rows: np.ndarray) -> None:
        """Give the people `rows` (k,) what the people `source_rows` (k,) of `source` have learned."""
        self._arrays.states["learned"][rows] = source.learned[source_rows]

    def _checked(self, mask: np.ndarray) -> np.ndarray:
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != (self.n,):
            raise ValueError(f"mask {mask.dtype} {mask.shape} must be bool ({self.n},)")
        return mask

    def instruct(self, intention: Intention | None) -> None:
        """Fix everyone's intention as an experimenter would: it begins with the next event. None: free choice."""
        self._arrays.states["instruction"] = NO_INSTRUCTION if intention is None else intention

    def step(self, state: np.ndarray, force: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Advance one tick.

        Args:
            state: (n, 12) float64 as `World.observe` writes it: own paddle, other paddle, puck, each x, y, vx, vy.
            force: (n, 2) float64, the device's force on the hand in N, held for the tick.
            rows: (k,) int64, the people who play, everyone if None; for the others time stands still.

        Returns:
            (n, 2) float64 action in [-1, 1]: the hand's position over its reach of 0.075 m. The same array each time.
        """
        for name, value, columns in (("state", state, 12), ("force", force, 2)):
            if np.shape(value) != (self.n, columns) or np.asarray(value).dtype.kind not in "fiu":
                raise ValueError(f"{name} of shape {np.shape(value)} must be numbers ({self.n}, {columns})")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} = {np.asarray(value)[~np.isfinite(value)][0]} must be finite")
        if rows is None:
            rows = self._all_rows
        else:
            check_rows("rows", rows, self.n)
        state, force = (np.ascontiguousarray(value, dtype=np.float64) for value in (state, force))
        parallel_for(step_users, rows, self._arrays, state, force, self._setting, least=128)
        return self._arrays.actions

    @property
    def action(self) -> np.ndarray:
        """(n, 2) the result of the last `step`."""
        view = self._arrays.actions.view()
        view.flags.writeable = False
        return view

    @property
    def hand(self) -> np.ndarray:
        """(n, 2) the hand's position, m."""
        return self._of_arm("hand")

    @property
    def hand_velocity(self) -> np.ndarray:
        """(n, 2) m/s."""
        return self._of_arm("hand_v")

    @property
    def goal(self) -> np.ndarray:
        """(n, 2) the hand's intended position, m. Private: for display, anchors and tests, never for guidance."""
        states = self._arrays.states
        return np.stack([states["goal_x"], states["goal_y"]], axis=1)

    @property
    def intention(self) -> np.ndarray:
        """(n,) int, members of `Intention`. Private, as `goal`."""
        return self._arrays.states["intention"].copy()

    @property
    def time_to_contact(self) -> np.ndarray:
        """(n,) s until the planned contact with the puck; infinite where none is planned. Private, as `goal`."""
        return self._arrays.states["time_to_contact"].copy()

    @property
    def learned(self) -> np.ndarray:
        """(n, 2, 2, 3) N s/m, see `guidance.simulated_users.adaptation`. Private, as `goal`."""
        return self._arrays.states["learned"].copy()

    def _of_arm(self, name: str) -> np.ndarray:
        arm = self._arrays.arms[:, 0]
        return np.stack([arm[name + "_x"], arm[name + "_y"]], axis=1)

    @property
    def signals(self) -> np.ndarray:
        """(n, 6) the rating signals since the game began, in the order and units of `ratings.SIGNALS`."""
        return signals(self._arrays.sums)

    def ratings(self, scales: dict[str, float]) -> dict[str, np.ndarray]:
        """PROXIES of the ratings of the game so far. They stay the same when asked for again.

        Args:
            scales: per signal its unit, see `rating_anchors.signal_units`.

        Returns:
            Helpfulness, naturalness, controllability and comfort, (n,) float64 each, whole numbers in 1..7.
        """
        if set(scales) != set(SIGNALS):
            raise ValueError(f"scales = {sorted(scales)} must be exactly {', '.join(SIGNALS)}")
        for name, value in scales.items():
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"scales.{name} = {value} must be a number above 0")
        expected = expected_points(self.signals, scales)
        return likert_points(self.people, expected, self.streams)
