"""Parallel loops: compiled kernels over rows on all cores, and a Ray cluster for whole jobs.

The kernels run on Python threads, which sleep while they wait. The threads of numba's own work queue spin, which costs
more than it gains on few cores. numba and Ray are imported by the functions that use them.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

LOCAL_CLUSTER = "local"  # the address of a new cluster on this machine


def parallel_for(kernel: Callable[..., None], rows: np.ndarray, *arguments: object, least: int) -> None:
    """Call `kernel(chunk, *arguments)` in parallel over disjoint chunks of the row indices (n,).

    Args:
        kernel: compiled with nogil=True; its rows must be independent of each other.
        least: the smallest chunk that is worth a thread. There are at most as many threads as cores
            (NUMBA_NUM_THREADS).
    """
    import numba

    threads = numba.config.NUMBA_NUM_THREADS
    n_chunks = min(threads, len(rows) // least)
    if n_chunks < 2:
        kernel(rows, *arguments)
        return
    import numpy as np

    first, *others = np.array_split(rows, n_chunks)
    results = _pool(threads).map(lambda chunk: kernel(chunk, *arguments), others)
    kernel(first, *arguments)
    list(results)  # waits for them, and raises what they raised


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rows")


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked process has none of its parent's threads


def join_ray_cluster(address: str, cores: int | None = None) -> None:
    """Join the Ray cluster at "auto" or host:port, or start one, "local", of so many cores, unless this was done."""
    import ray  # an optional dependency

    if not ray.is_initialized():
        where = {"num_cpus": cores} if address == LOCAL_CLUSTER else {"address": address}
        ray.init(**where, include_dashboard=False, log_to_driver=False)
