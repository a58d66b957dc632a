"""Whatever runs on several threads also runs in a process forked from one in which these threads were started."""

from multiprocessing import get_context

import numpy as np
import pytest
import torch
from numba import config

from airhockey_marl.envs.world import World
from airhockey_marl.players.inference import make_inference
from airhockey_marl.players.networks import GaussianPolicy
from guidance.simulated_users import SimulatedUsers, sample_people
from guidance.study.protocol import spawn_rng_states

N = 600  # enough for two threads


def step_tables():
    World(N).step(np.zeros((N, 2, 2)))


def step_users():
    users = SimulatedUsers(sample_people(N, 0), spawn_rng_states(0, range(N), 0, 0))
    users.new_game(np.ones(N, dtype=bool))
    users.step(np.zeros((N, 12)), np.zeros((N, 2)), np.arange(N))


def infer():
    torch.manual_seed(0)
    make_inference(GaussianPolicy([4]))(np.zeros((N, 12)))


@pytest.mark.parametrize("work", [step_tables, step_users, infer])
def test_a_forked_process_does_not_wait_for_threads_that_it_lacks(monkeypatch, work):
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", 2)
    work()
    child = get_context("fork").Process(target=work)
    child.start()
    child.join(30)
    waits = child.is_alive()
    child.kill()
    assert not waits and child.exitcode == 0
