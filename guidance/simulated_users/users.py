"""`SimulatedUsers`: n simulated people side by side at their devices."""

from math import ceil

import numpy as np

from airhockey_marl.envs.physics import TableSpec, check_table
from airhockey_marl.experiment.parallel import parallel_for
from airhockey_marl.experiment.validation import check_rows
from guidance.simulated_users.advisors import NO_ADVISORS, Advisors
from guidance.simulated_users.arm import ARM_STATE
from guidance.simulated_users.force_response import Variant
from guidance.simulated_users.intention import NOTHING, Intention
from guidance.simulated_users.population import USER_PARAMETERS
from guidance.simulated_users.ratings import RATING_SIGNALS, SIGNALS, answers, appraisals, signals
from guidance.simulated_users.state import USER_STATE
from guidance.simulated_users.tick import begin_rounds, play


class SimulatedUsers:
    """Simulated people who play from what they see and what they feel, and from nothing else.

    They are never told the guidance, its target, its weights or its name: `step` takes a state and a force.
    What person i does depends on their own parameters, stream, states and forces, not on who else is there.

    Args:
        people: (n,) structured array of dtype `USER_PARAMETERS`, see `sample_people`.
        streams: (n,) uint64, one stream of random numbers each, see `personal_streams`; copied.
        table: the `TableSpec` they know by practice.
        variant: name of a `Variant` of the response to a force.
        advisors: the players whose judgment people have learned from; None for nobody's.

    Raises:
        ValueError: a shape, dtype or variant is wrong.
    """

    def __init__(
        self,
        people: np.ndarray,
        streams: np.ndarray,
        table: TableSpec | None = None,
        variant: str = "comply_or_resist",
        advisors: Advisors | None = None,
    ) -> None:
        people = np.asarray(people)
        if people.dtype != USER_PARAMETERS or people.ndim != 1 or len(people) < 1:
            raise ValueError(f"people of shape {people.shape} must be an array (n,) of people, n at least 1")
        streams = np.asarray(streams)
        if streams.dtype != np.uint64 or streams.shape != people.shape:
            raise ValueError(f"streams {streams.dtype} {streams.shape} must be uint64 {people.shape}")
        if variant not in Variant.__members__:
            raise ValueError(f"variant = {variant!r} must be one of {', '.join(Variant.__members__)}")
        self.n, self.people, self.table = len(people), people.copy(), check_table(table or TableSpec())
        self.variant, self.streams, self.advisors = Variant[variant], streams.copy(), advisors or NO_ADVISORS
        delays = ("sight_delay", "proprioceptive_delay", "hindsight_after")
        longest = max(
            (people["tactile_delay"] + people["believed_ahead"]).max(), *(people[name].max() for name in delays)
        )
        ring = ceil(longest / self.table.tick) + 2
        self._minds, self._arms = np.zeros(self.n, USER_STATE), np.zeros((self.n, 4), ARM_STATE)
        self._tallies = np.zeros(self.n, RATING_SIGNALS)
        self._off, self._minds["told"] = np.zeros((self.n, ring, 2, 4)), NOTHING
        self._seen, self._felt = np.zeros((self.n, ring, 12)), np.zeros((self.n, ring, 2))
        self._partner, self._trail = np.zeros((self.n, ring, 2)), np.zeros((self.n, ring, 4))
        self._all, self._action = np.arange(self.n), np.zeros((self.n, 2))
        self.new_game(np.ones(self.n, dtype=bool))

    def new_round(self, which: np.ndarray) -> None:
        """Those of the boolean mask `which` (n,) begin a round: the hand at the center, nothing seen or felt yet."""
        begin_rounds(self.people, self._minds, self._arms, self._tallies, self._action, self._mask(which))

    def new_game(self, which: np.ndarray) -> None:
        """As `new_round`, and trust, co-contraction and what the ratings rest on are forgotten as well."""
        which = self._mask(which)
        self._minds["trust"][which] = self.people["trust_at_first"][which]
        self._minds["co_contraction"][which] = 0.0
        self._tallies[which] = np.zeros((), RATING_SIGNALS)
        self.new_round(which)

    def _mask(self, which: np.ndarray) -> np.ndarray:
        which = np.asarray(which)
        if which.dtype != bool or which.shape != (self.n,):
            raise ValueError(f"which {which.dtype} {which.shape} must be bool ({self.n},)")
        return which

    def instruct(self, intention: Intention | None) -> None:
        """Have everyone do this, and nothing else, once they have seen something happen; None: as they like.

        So an experimenter would ask, and the response is prepared: there is nothing to choose.
        """
        self._minds["told"] = NOTHING if intention is None else intention

    def step(self, state: np.ndarray, force: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Live through one tick.

        Args:
            state: (n, 12) float64 as `tables.observe` writes it: own paddle, other paddle, puck, each x, y, vx, vy.
            force: (n, 2) float64, the device's force on the hand in N, held for the tick.
            rows: (k,) int64, who lives through it, everyone if None; for the others time stands still.

        Returns:
            (n, 2) float64 action in [-1, 1]: the hand's position over its reach of 0.075 m. The same array each time.

        Raises:
            ValueError: a shape is wrong or a value is not finite.
        """
        for name, value, columns in (("state", state, 12), ("force", force, 2)):
            if np.shape(value) != (self.n, columns) or np.asarray(value).dtype.kind not in "fiu":
                raise ValueError(f"{name} of shape {np.shape(value)} must be numbers ({self.n}, {columns})")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} = {np.asarray(value)[~np.isfinite(value)][0]} must be finite")
        if rows is None:
            rows = self._all
        else:
            check_rows("rows", rows, self.n)
        parallel_for(
            play,
            rows,
            self.people,
            self._minds,
            self._arms,
            self._tallies,
            self._seen,
            self._felt,
            self._off,
            self._partner,
            self._trail,
            self.advisors,
            np.ascontiguousarray(state, dtype=np.float64),
            np.ascontiguousarray(force, dtype=np.float64),
            int(self.variant),
            self.table,
            self.streams,
            self._action,
            least=128,
        )
        return self._action

    @property
    def action(self) -> np.ndarray:
        """(n, 2) what `step` has returned last."""
        return _locked(self._action)

    @property
    def hand(self) -> np.ndarray:
        """(n, 2) the hand's position, m."""
        return self._arm_pair("hand")

    @property
    def hand_velocity(self) -> np.ndarray:
        """(n, 2) m/s."""
        return self._arm_pair("hand_v")

    @property
    def goal(self) -> np.ndarray:
        """(n, 2) where the person wants the hand, m. Private: for watching, anchors and tests, never for guidance."""
        return _locked(np.stack([self._minds["goal_x"], self._minds["goal_y"]], axis=1))

    @property
    def intention(self) -> np.ndarray:
        """(n,) int, members of `Intention`. Private, as `goal`."""
        return _locked(self._minds["intention"].copy())

    @property
    def strike_in(self) -> np.ndarray:
        """(n,) s until the contact that is planned with the puck; infinite where none is. Private, as `goal`."""
        return _locked(self._minds["strike_left"].copy())

    def _arm_pair(self, name: str) -> np.ndarray:
        arm = self._arms[:, 0]
        return _locked(np.stack([arm[name + "_x"], arm[name + "_y"]], axis=1))

    @property
    def signals(self) -> np.ndarray:
        """(n, 8) what the ratings rest on since the game began, in the order and units of `rating.SIGNALS`."""
        return signals(self._tallies)

    def ratings(self, scales: dict[str, float]) -> dict[str, np.ndarray]:
        """PROXIES of the ratings of the game so far.

        Args:
            scales: per signal its value under its anchor force, see `anchors.anchor_scales`.

        Returns:
            Helpfulness, naturalness, controllability and comfort, (n,) float64 each, whole numbers in 1..7. Asking
            again gives the same answer.

        Raises:
            ValueError: a scale is missing, unknown or not above 0.
        """
        if set(scales) != set(SIGNALS):
            raise ValueError(f"scales = {sorted(scales)} must be exactly {', '.join(SIGNALS)}")
        for name, value in scales.items():
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"scales.{name} = {value} must be a number above 0")
        z = appraisals(self.signals / np.array([scales[name] for name in SIGNALS]))
        return answers(self.people, z, self.streams)


def _locked(view: np.ndarray) -> np.ndarray:
    view = view.view()
    view.flags.writeable = False
    return view
