"""Many tables: serves, the referee, and that a batch is so many single tables."""

import subprocess
import sys

import numpy as np
import pytest

from airhockey_marl.envs.physics import PUCK, VX, VY, TableSpec, X, Y
from airhockey_marl.envs.world import World

TABLE = TableSpec()


def test_a_stalled_puck_is_served_again_and_one_kept_too_long_too():
    stay = np.zeros((1, 2, 2))
    for puck, seconds in (((0.5, 0.3, 0.0, 0.0), TABLE.stall_seconds), (None, TABLE.possession_seconds)):
        tables = World(1)
        tables.new_rounds()
        ticks = 0
        while not tables.served[0]:
            tables.bodies[0, PUCK] = puck or (0.5, 0.4, 0.0, 0.1)  # held in place
            tables.step(stay)
            ticks += 1
            assert ticks < 1000
        assert ticks * TABLE.tick == pytest.approx(seconds, abs=2.5 * TABLE.tick)
        assert tables.bodies[0, PUCK, X] == 0.0


def test_a_batch_plays_like_single_tables_whichever_loop_runs_it():
    n, rng = World.PARALLEL_FROM, np.random.default_rng(0)
    batch, singles = World(n), [World(1) for _ in range(n)]
    batch.seed(7)
    for i, single in enumerate(singles):
        single.seed(7 + i)
    for tables in (batch, *singles):
        tables.new_rounds()
    for _ in range(100):
        actions = rng.uniform(-1, 1, (n, 2, 2))
        batch.step(actions)
        for i, single in enumerate(singles):
            single.step(actions[i : i + 1])
            if single.goals[0]:
                single.new_rounds()
        batch.new_rounds(batch.goals != 0)
        assert np.array_equal(batch.bodies, np.concatenate([single.bodies for single in singles]))


def test_serves_differ_between_tables_and_go_to_both_sides():
    tables = World(1000)
    tables.new_rounds()
    puck = tables.bodies[:, PUCK]
    assert len(np.unique(puck[:, Y])) == 1000
    assert 0.4 < (puck[:, VX] > 0).mean() < 0.6
    speed = np.hypot(puck[:, VX], puck[:, VY])
    assert TABLE.serve_speed_low <= speed.min() and speed.max() <= TABLE.serve_speed_high


def test_the_first_parallel_step_leaves_torchs_threads_alone():
    """In a process of its own, where no step has been made: numba and torch must not share a thread pool."""
    script = (
        "import numpy as np, torch; from airhockey_marl.envs.world import World;"
        "torch.set_num_threads(1); before = torch.get_num_threads();"
        f"n = {World.PARALLEL_FROM}; World(n).step(np.zeros((n, 2, 2), dtype=np.float32));"
        "print(before, torch.get_num_threads())"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout.split() == ["1", "1"]
