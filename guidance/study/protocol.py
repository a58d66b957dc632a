"""The protocol of section 4.2: counterbalanced orders, rounds of a game, random streams."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from airhockey_marl.experiment.validation import check_counts, check_numbers, kind_of, labeled


@dataclass(frozen=True)
class Protocol:
    """How long a game is (section 4.2).

    Attributes:
        familiarization: s of unscored play before each game.
        rounds: rounds of a game.
        extra_rounds: at most so many more, while the game is shorter than `min_seconds`.
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
    """Where n games are in the protocol.

    Attributes:
        playing: (k,) int64, the games that are on, ascending; a new array whenever one has ended.
        scored: whether the familiarization is over.
        rounds, ticks: (n,) rounds that are over, and ticks of scored play.
    """

    def __init__(self, n: int, protocol: Protocol, tick_seconds: float) -> None:
        check_counts(n=n)
        check_numbers(above=0.0, tick_seconds=tick_seconds)
        self.protocol, self.tick_seconds = protocol, tick_seconds
        self.unscored_ticks = round(protocol.familiarization / tick_seconds)
        self.playing, self.scored, self._elapsed = np.arange(n), False, 0
        self.rounds, self.ticks, self._round_ticks = np.zeros((3, n), dtype=np.int64)

    def begins(self) -> bool:
        """Whether the scored game begins now, for everyone at once."""
        if self.scored or self._elapsed < self.unscored_ticks:
            return False
        self.scored = True
        self._round_ticks[:] = 0
        return True

    def tick(self, goals: np.ndarray) -> np.ndarray:
        """A tick has been played, with these goals (n,): the mask (n,) of the rounds that have ended with it."""
        if np.shape(goals) != self.rounds.shape or goals.dtype.kind != "i":
            raise ValueError(f"goals: {kind_of(goals)}, must be whole numbers of shape {self.rounds.shape}")
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
                over = ended & (self.rounds >= protocol.rounds) & long_enough
                if over.any():
                    self.playing = games[~over[games]]
        return ended


def spawn_rng_states(seed: int, users: Sequence[int], condition: int, purpose: int) -> np.ndarray:
    """(users,) uint64: a stream for each user's game in a condition; purpose 0 is the person, 1 the table."""
    check_counts(0, seed=seed, condition=condition, purpose=purpose)
    for user in users:
        check_counts(0, users=user)
    keys = [np.random.SeedSequence([seed, user, condition, purpose]) for user in users]
    return np.array([key.generate_state(1, np.uint64)[0] for key in keys], dtype=np.uint64)


CALIBRATION_GAME = 99  # in the seeds, the unscored game counts as a condition of its own
PAPER_LETTERS = "abcdefghi"  # the letters of the paper's conditions


def williams_design(conditions: int) -> np.ndarray:
    """A Williams design: orders (rows) in which each condition follows each other one equally often.

    Returns:
        (k, conditions) indices; k = conditions if their number is even, twice that if it is odd.
    """
    check_counts(conditions=conditions)
    first = [0]
    for step in range(1, conditions):
        first.append((first[-1] + (step if step % 2 else -step)) % conditions)
    square = (np.array(first) + np.arange(conditions)[:, None]) % conditions
    return square if conditions % 2 == 0 else np.concatenate([square, square[:, ::-1]])


def is_balanced(users: int, conditions: int) -> bool:
    """Whether so many users can play so many conditions in the orders of a Williams design, each equally often."""
    check_counts(users=users)
    return users % len(williams_design(conditions)) == 0


def counterbalanced_order(users: int, conditions: int, seed: int) -> np.ndarray:
    """(users, conditions) the position, from 1, at which each user plays each condition.

    Users get the rows of a Williams design in random order; it is balanced where their number is a multiple of its.
    """
    check_counts(users=users)
    check_counts(0, seed=seed)
    design, rng = williams_design(conditions), np.random.default_rng([seed, users])
    rows = np.concatenate([rng.permutation(len(design)) for _ in range(-(-users // len(design)))])[:users]
    return np.argsort(design[rows], axis=1) + 1
