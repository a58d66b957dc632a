"""Rows on all cores: each once, whatever their number, and errors come back."""

import numpy as np
import pytest
from numba import njit

from airhockey_marl.experiment import parallel
from airhockey_marl.experiment.parallel import parallel_for


@njit(nogil=True)
def count(rows, counted):
    for row in rows:
        counted[row] += 1


@pytest.mark.parametrize("threads", [1, 2, 7])
@pytest.mark.parametrize("n", [0, 1, 9, 10, 11, 100])
def test_every_row_is_done_once(monkeypatch, threads, n):
    monkeypatch.setattr(parallel.config, "NUMBA_NUM_THREADS", threads)
    counted = np.zeros(200, dtype=np.int64)
    rows = np.arange(n) * 2
    parallel_for(count, rows, counted, least=5)
    assert (counted[rows] == 1).all() and counted.sum() == n


def test_an_error_in_a_part_is_raised(monkeypatch):
    monkeypatch.setattr(parallel.config, "NUMBA_NUM_THREADS", 4)

    def fails(rows):
        if 99 in rows:
            raise ValueError("row 99")

    with pytest.raises(ValueError, match="row 99"):
        parallel_for(fails, np.arange(100), least=10)
