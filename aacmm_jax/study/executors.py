"""Dask as the executor of a study: a running scheduler, or a cluster of processes on this machine."""

import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

import jax

from ..core.errors import InputError

_RETRIES = 3  # of a block whose worker died


@contextmanager
def dask_executor(address: str, workers: int | None = None) -> Iterator[tuple[Executor, int]]:
    """Connect to a Dask cluster, or start one on this machine; a context manager.

    Args:
        address: Of a scheduler (``tcp://host:8786``, or a scheduler file); or ``local`` for processes on this machine,
            each restricted to its part of the cores.
        workers: Number of local processes; default: one a core.

    Returns:
        The executor for `run_study`, and its number of workers.

    Raises:
        InputError: Where Dask is not installed, no scheduler answers, or the cluster has no workers.
    """
    try:
        import distributed
    except ImportError as error:
        raise InputError("--dask needs Dask; install it with: pip install 'dask[distributed]'.") from error
    with _client(distributed, address, workers) as client:
        count = len(client.scheduler_info(n_workers=-1)["workers"])
        if not count:
            raise InputError(
                f"the Dask cluster at {address} has no workers; start some, for example: dask worker {address}"
            )
        yield client.get_executor(retries=_RETRIES, pure=False), count


@contextmanager
def _client(distributed: Any, address: str, workers: int | None) -> Iterator[Any]:
    if address != "local":
        if workers is not None:
            raise InputError("a running Dask cluster has its own workers; leave --workers out.")
        target = {"scheduler_file": address} if os.path.isfile(address) else {"address": address}
        try:
            client = distributed.Client(**target, timeout=5)
        except Exception as error:  # of a dozen types: no such file or host, no answer, not a scheduler's file
            raise InputError(f"no Dask scheduler answers at {address}; start one, or use --dask local.") from error
        with client:
            yield client
        return
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    count = workers or len(cores)
    environment = {}
    if jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        # Programs that this process compiled need not be compiled again by every worker.
        environment["JAX_COMPILATION_CACHE_DIR"] = jax.config.jax_compilation_cache_dir  # pyright: ignore
        environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    with _interrupts_ignored():
        cluster = distributed.LocalCluster(
            n_workers=count, threads_per_worker=1, dashboard_address=":0", env=environment
        )
    from .dask_affinity import Affinity

    with cluster, distributed.Client(cluster) as client:
        client.register_plugin(Affinity(cores, count))
        yield client


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Processes started within ignore Ctrl-C, which reaches all processes of a terminal; workers finish blocks."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)
