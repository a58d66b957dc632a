"""`parallel_for` runs every row once, for any number of rows and threads, and raises the errors of its chunks."""

import numpy as np
import pytest
from numba import config, njit

from airhockey_marl.experiment.parallel import parallel_for


@njit(nogil=True)
def increment(rows, counts):
    for row in rows:
        counts[row] += 1


@pytest.mark.parametrize("threads", [1, 2, 7])
@pytest.mark.parametrize("n", [0, 1, 9, 10, 11, 100])
def test_every_row_is_processed_once(monkeypatch, threads, n):
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", threads)
    counts = np.zeros(200, dtype=np.int64)
    rows = np.arange(n) * 2
    parallel_for(increment, rows, counts, least=5)
    assert (counts[rows] == 1).all() and counts.sum() == n


def test_an_error_in_a_chunk_is_raised(monkeypatch):
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", 4)

    def fails(rows):
        if 99 in rows:
            raise ValueError("row 99")

    with pytest.raises(ValueError, match="row 99"):
        parallel_for(fails, np.arange(100), least=10)
