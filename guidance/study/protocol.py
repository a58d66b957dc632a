"""The protocol of section 4.2: rounds of a game, counterbalanced orders of conditions, random number streams."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from airhockey_marl.experiment.validation import check_counts, check_numbers, labeled


@dataclass(frozen=True)
class Protocol:
    """The length of a game (section 4.2).

    Attributes:
        familiarization: s of unscored play before each game.
        rounds: rounds of a game.
        extra_rounds: largest number of additional rounds, played while the game is shorter than `min_seconds`.
        min_seconds: s.
        round_seconds: s after which a round without a goal ends undecided.
    """

    familiarization: float
    rounds: int
    extra_rounds: int
    min_seconds: float
    round_seconds: float

    def __post_init__(self) -> None:
        for name, least in (("familiarization", 0), ("rounds", 1), ("extra_rounds", 0), ("min_seconds", 0)):
            check = check_counts if name.endswith("rounds") else check_numbers
            check(least, **labeled(self, "study", name))
        check_numbers(above=0.0, **labeled(self, "study", "round_seconds"))


class ProtocolState:
    """The progress of n games through the protocol, of which those that `begin` together are played side by side.

    Attributes:
        playing: (k,) int64, the games that have begun and are not over, ascending; a new array whenever one has ended.
        scored: whether their familiarization is over.
        rounds, ticks: (n,) finished rounds, and ticks of scored play.
    """

    def __init__(self, n: int, protocol: Protocol, tick_seconds: float) -> None:
        self.protocol, self.tick_seconds = protocol, tick_seconds
        self.unscored_ticks = round(protocol.familiarization / tick_seconds)
        self.rounds, self.ticks, self._round_ticks = np.zeros((3, n), dtype=np.int64)
        self.begin(np.arange(n))

    def begin(self, games: np.ndarray) -> None:
        """Begin the games (k,) int64, ascending, when no other is being played."""
        self.playing, self.scored, self._elapsed = games, False, 0

    def begin_scoring(self) -> bool:
        """Begin to score if the familiarization has just ended; whether it has. It ends for all games at once."""
        if self.scored or self._elapsed < self.unscored_ticks:
            return False
        self.scored = True
        self._round_ticks[:] = 0
        return True

    def tick(self, goals: np.ndarray) -> np.ndarray:
        """Advance by a tick with goals (n,) int, and return the mask (n,) of the rounds that ended with it."""
        games, protocol, seconds = self.playing, self.protocol, self.tick_seconds
        self._elapsed += 1
        self._round_ticks[games] += 1
        ended = np.zeros(len(goals), dtype=bool)
        ended[games] = (goals[games] != 0) | (self._round_ticks[games] * seconds >= protocol.round_seconds)
        if self.scored:
            self.ticks[games] += 1
        if ended.any():
            self._round_ticks[ended] = 0
            if self.scored:
                self.rounds += ended
                long_enough = self.ticks * seconds >= protocol.min_seconds
                long_enough |= self.rounds >= protocol.rounds + protocol.extra_rounds
                finished = ended & (self.rounds >= protocol.rounds) & long_enough
                if finished.any():
                    self.playing = games[~finished[games]]
        return ended


class RandomStream(IntEnum):
    """The independent random number streams of a game."""

    USER = 0
    TABLE = 1
    DEMONSTRATOR = 2
    DEMONSTRATION_TABLE = 3
    PRACTICE_TABLE = 4


def spawn_rng_states(seed: int, users: Sequence[int], game: int, stream: int) -> np.ndarray:
    """(users,) uint64: the initial state of a random number stream for each user's game.

    Args:
        game: the index of a condition, or `CALIBRATION_GAME`.
        stream: a `RandomStream`.
    """
    keys = [np.random.SeedSequence([seed, user, game, int(stream)]) for user in users]
    return np.array([key.generate_state(1, np.uint64)[0] for key in keys], dtype=np.uint64)


def user_and_table_states(seed: int, users: Sequence[int], game: int) -> tuple[np.ndarray, np.ndarray]:
    """`spawn_rng_states` of the users of a game, and of their tables."""
    user, table = (spawn_rng_states(seed, users, game, s) for s in (RandomStream.USER, RandomStream.TABLE))
    return user, table


CALIBRATION_GAME = 99  # the number of the unscored game in the seeds, beside the indices of the conditions


def williams_design(conditions: int) -> np.ndarray:
    """A Williams design: orders (rows) in which every condition follows every other equally often.

    Returns:
        (k, conditions) indices; k is the number of conditions if it is even, twice that if it is odd.
    """
    first = [0]
    for step in range(1, conditions):
        first.append((first[-1] + (step if step % 2 else -step)) % conditions)
    square = (np.array(first) + np.arange(conditions)[:, None]) % conditions
    return square if conditions % 2 == 0 else np.concatenate([square, square[:, ::-1]])


def is_balanced(users: int, conditions: int) -> bool:
    """Whether each order of the Williams design is used by equally many of the users."""
    return users % len(williams_design(conditions)) == 0


def balance_note(users: int, conditions: int, others: int = 0) -> str | None:
    """What is to be known of an order that is not balanced; None if it is, or if there is nothing to order.

    Args:
        others: the number of conditions that come after those in the order.
    """
    if conditions < 2 or is_balanced(users, conditions):
        return None
    after = ", and the others come after them" if others else ""
    people = len(williams_design(conditions))
    return f"the order of {conditions} conditions is balanced over multiples of {people} people{after}"


def counterbalanced_order(users: int, conditions: int, seed: int) -> np.ndarray:
    """(users, conditions): the position, from 1, of each condition in each user's order.

    Users get the rows of a Williams design in random order; see `is_balanced`.
    """
    design, rng = williams_design(conditions), np.random.default_rng([seed, users])
    rows = np.concatenate([rng.permutation(len(design)) for _ in range(-(-users // len(design)))])[:users]
    return np.argsort(design[rows], axis=1) + 1
