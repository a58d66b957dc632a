"""A simulated person as the participant of a session: reads the pages, plays and rates without anybody present."""

import numpy as np
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.envs.physics import TableSpec
from guidance.display.pages import Items, Page
from guidance.haptics.seat import RealTimePlayer
from guidance.sessions.session import SKIP
from guidance.simulated_users import SimulatedUsers, load_advisors
from guidance.simulated_users.adaptation import is_on
from guidance.simulated_users.ratings import RATINGS
from guidance.study.protocol import CALIBRATION_GAME, spawn_rng_states


class SimulatedParticipant:
    """An `ExperimenterUI` whose pages are answered by a simulated person, who is the same as in a simulated study.

    With adaptation the person begins a game with what they learned in those before; if a session is interrupted, they
    go on without it.

    Args:
        people: (participants,) parameters of the study's simulated people, see `guidance.simulated_users`.
        place: index of this person, which also is their row in the counterbalanced orders.
        seed: of the study.
        cfg: the section `users` of the configuration.

    Attributes:
        users: the person in the current game.
    """

    def __init__(self, people: np.ndarray, place: int, seed: int, cfg: DictConfig) -> None:
        self._person, self._place, self._seed, self._cfg = people[place : place + 1], place, seed, cfg
        self._advisors = load_advisors(cfg.advisors)
        self.users = self._in_game(CALIBRATION_GAME)

    def _in_game(self, game: int) -> SimulatedUsers:
        """The person with the random numbers that a simulated study uses in this game."""
        rng_states = spawn_rng_states(self._seed, [self._place], game, 0)
        adaptation = is_on(self._cfg.adaptation)
        return SimulatedUsers(self._person, rng_states, TableSpec(), self._cfg.variant, self._advisors, adaptation)

    def begin_game(self, player: RealTimePlayer, game: int) -> None:
        """Start a game with a fresh copy of the person at the device, who knows what the last one has learned."""
        users = self._in_game(game)
        users.carry_over(np.arange(1), self.users, np.arange(1))
        self.users = player.person = player.hand.device.users = users

    def page(self, page: Page) -> str:
        """Skip the page if possible, else press its first key."""
        return SKIP if SKIP in page.keys else next(iter(page.keys))

    def ask(self, items: Items) -> dict[str, int]:
        """The person's ratings of the last game, from 1 to 7."""
        ratings = self.users.ratings(OmegaConf.to_container(self._cfg.scales))
        return {name: int(ratings[name][0]) for name in RATINGS}

    def write_down(self, page: Page) -> str:
        """An empty note."""
        return ""
