"""Executors of a study beyond threads: processes of this machine, or the workers of a Dask cluster."""

import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

from ..core.errors import InputError
from .local_processes import LocalProcesses

_RETRIES = 3  # of a block whose worker died


@contextmanager
def dask_executor(address: str, workers: int | None = None) -> Iterator[tuple[Executor, int]]:
    """Connect to a Dask cluster, or start processes on this machine; a context manager.

    A Dask scheduler runs whatever it is sent, with the rights of whoever started its workers, and a worker's answer is
    unpickled here. ``tcp://`` trusts everybody who can reach its port, every user of its machine included. ``tls://``
    asks both sides for a certificate, those that Dask's configuration names (``distributed.comm.tls``).

    Args:
        address: Of a scheduler (``tls://host:8786``, ``tcp://host:8786``, or a scheduler file); or ``local`` for
            processes on this machine, each on its part of the cores. These need no Dask and open no port.
        workers: Number of local processes; default: one a core.

    Returns:
        The executor for `run_study`, and its number of workers.

    Raises:
        InputError: Where Dask is not installed, no scheduler answers, or the cluster has no workers.

    Example:
        >>> with aj.study.dask_executor("local", workers=2) as (executor, workers):
        ...     print(workers)
        2
    """
    if address == "local":
        count = workers or _cores()
        processes = LocalProcesses(count)
        try:
            yield processes, count
        finally:
            processes.shutdown(wait=False)
        return
    if workers is not None:
        raise InputError("a running Dask cluster has its own workers; leave --workers out.")
    try:
        import distributed
    except ImportError as error:
        raise InputError("--dask needs Dask; install it with: pip install 'dask[distributed]'.") from error
    from .dask_plugin import CompilationCache

    with _client(distributed, address) as client:
        count = len(client.scheduler_info(n_workers=-1)["workers"])
        if not count:
            raise InputError(
                f"the Dask cluster at {address} has no workers; start some, for example: dask worker {address}"
            )
        client.register_plugin(CompilationCache())
        yield client.get_executor(retries=_RETRIES, pure=False), count


def _client(distributed: Any, address: str) -> Any:
    target = {"scheduler_file": address} if os.path.isfile(address) else {"address": address}
    try:
        return distributed.Client(**target, timeout=5)
    except Exception as error:  # of a dozen types: no such file or host, no answer, not a scheduler's file
        raise InputError(f"no Dask scheduler answers at {address}; start one, or use --dask local.") from error


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
