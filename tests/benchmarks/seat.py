"""Punctuality of a game at the window: frames, and the latency from state to force."""

import os
import tempfile
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir

from airhockey_marl.envs.physics import TableSpec
from airhockey_marl.experiment.command import CONF
from airhockey_marl.league.league import League
from guidance.display.window import Window
from guidance.forces.lookahead import Lookahead
from guidance.haptics.devices.simulated import Simulated
from guidance.haptics.safety import SafetyLimits
from guidance.haptics.screen import WallClock
from guidance.haptics.seat import RealTimePlayer
from guidance.haptics.servo import InProcessServo
from guidance.sessions.free_play import FreePlay
from guidance.simulated_users import SimulatedUsers, sample_people
from guidance.study.models import Models
from guidance.study.protocol import spawn_rng_states
from guidance.study.setup import load_conditions

WARM_UP = 100  # first ticks and frames, which compile and are not counted


def seat_punctuality(seconds: float = 20.0) -> dict[str, float]:
    """Play CombHG (UT+UA+SC), which evaluates two models, on a dummy screen.

    Returns:
        Median and 99th percentile in ms of the time between frames, from reading the state to the force, and between
        forces; and the number of ticks that came more than a tick late.
    """
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    torch.set_num_threads(1)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("evaluate")
    models = Models.load(cfg.models.league, cfg.models.generation, cfg.models.user, cfg.models.meta)
    conditions = {condition.letter: condition for condition in load_conditions(cfg)}
    clock, table = WallClock(), TableSpec()
    person = SimulatedUsers(sample_people(1, 0), spawn_rng_states(0, [0], 0, 0), table)
    window = Window("benchmark", table, 1100, 60, clock, {"o": "targets"})
    window.overlay = True
    seat = RealTimePlayer(
        InProcessServo(Simulated(person), SafetyLimits()), window, clock, table.tick, breath=0.0, person=person
    )
    pushes, push = [], seat.hand.push
    seat.hand.push = lambda force, is_held=True: (pushes.append(clock.now()), push(force, is_held))
    try:
        with tempfile.TemporaryDirectory() as folder:
            how = Lookahead(0.1), 60.0, seat, spawn_rng_states(0, [0], 0, 1), Path(folder)
            play = FreePlay(conditions, models, League.load(cfg.models.opponents), cfg.opponent, *how)
            play.adapted = models.adapted_to([(torch.randn(500, 12), torch.randn(500, 2))])
            play.run(conditions["i"], seconds)
    finally:
        window.close()
    times = {"frame": window.frame_times, "force_latency": seat.latencies, "force_period": np.diff(pushes)}
    figures = {"late_ticks": seat.late_ticks}
    for name, values in times.items():
        p50, p99 = np.percentile(1000 * np.array(values[WARM_UP:]), (50, 99))
        figures |= {f"{name}_p50_ms": round(float(p50), 2), f"{name}_p99_ms": round(float(p99), 2)}
    return figures
