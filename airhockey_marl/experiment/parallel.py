"""Compiled loops over rows on all cores.

By threads that sleep while they wait: numba's own work queue spins, and takes from few cores what it gives.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
from numba import config


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(config.NUMBA_NUM_THREADS, thread_name_prefix="rows")


def parallel_for(kernel: Callable[..., None], rows: np.ndarray, *arguments: object, least: int) -> None:
    """Call `kernel(some of the rows, *arguments)` until all rows (n,) have been done, each once.

    Args:
        kernel: compiled with nogil=True; what it does for a row must not touch what it does for another.
        least: rows that are worth a thread. The threads are as many as the cores, or NUMBA_NUM_THREADS.
    """
    parts = min(config.NUMBA_NUM_THREADS, len(rows) // least)
    if parts < 2:
        kernel(rows, *arguments)
        return
    mine, *others = np.array_split(rows, parts)
    waiting = [_pool().submit(kernel, part, *arguments) for part in others]
    kernel(mine, *arguments)
    for part in waiting:
        part.result()


LOCAL_CLUSTER = "local"  # a cluster of this machine, for the purpose


def join_ray_cluster(address: str, cores: int | None = None) -> None:
    """Join a Ray cluster, unless this process has joined one already.

    Args:
        address: "local", "auto" or host:port.
        cores: that a cluster started here has; all of this machine if None.
    """
    import ray  # an extra

    if not ray.is_initialized():
        where = {"num_cpus": cores} if address == LOCAL_CLUSTER else {"address": address}
        ray.init(**where, include_dashboard=False, log_to_driver=False)
