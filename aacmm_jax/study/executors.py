"""Executors of a study beyond threads: processes of this machine, or the workers of a Dask cluster.

Processes of this machine are reached through pipes: there is no port that another user could connect to.
"""

import atexit
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, NamedTuple

import jax

from ..core._compat import reset_compilation_cache
from ..core.compilation_cache import set_up
from ..core.errors import InputError
from ..core.extras import require

_RETRIES = 3  # of a block whose worker died
_SAFE_PATH, _STARTING = "PYTHONSAFEPATH", threading.Lock()
THREADS = "aacmm-study"  # beginning of the names of threads that may still compute when an interrupt is answered


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
        count = workers or len(available_cores())
        processes = LocalProcesses(count)
        try:
            yield processes, count
        finally:
            processes.shutdown(wait=False)
        return
    if workers is not None:
        raise InputError("a running Dask cluster has its own workers; leave --workers out.")
    require("dask", "a study on a Dask cluster")
    import distributed

    target: dict[str, Any] = {"scheduler_file": address} if os.path.isfile(address) else {"address": address}
    try:
        connected: Any = distributed.Client(**target, timeout=5)
    except Exception as error:  # of a dozen types: no such file or host, no answer, not a scheduler's file
        raise InputError(f"no Dask scheduler answers at {address}; start one, or use --dask local.") from error
    with connected as client:
        count = len(client.scheduler_info(n_workers=-1)["workers"])
        if not count:
            raise InputError(
                f"the Dask cluster at {address} has no workers; start some, for example: dask worker {address}"
            )
        client.register_worker_callbacks(use_compilation_cache)  # of workers that join later, too
        yield client.get_executor(retries=_RETRIES, pure=False), count


def available_cores() -> list[int]:
    """Numbers of the cores that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


class CacheSettings(NamedTuple):
    """JAX's settings of the cache of compiled programs."""

    folder: str | None
    least_seconds: float  # shorter compilations are not kept

    @classmethod
    def current(cls) -> "CacheSettings":
        """Those of this process."""
        config: Any = jax.config
        return cls(config.jax_compilation_cache_dir, config.jax_persistent_cache_min_compile_time_secs)


def use_compilation_cache(settings: CacheSettings | None = None) -> None:
    """Use the cache of these settings in a worker, where JAX may have been imported before anybody said where it is; by
    default that of the environment, or else the user's own folder."""
    if settings is None:
        set_up()
        current = CacheSettings.current()
        seconds = os.environ.get("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", current.least_seconds)
        settings = CacheSettings(current.folder, float(seconds))
    jax.config.update("jax_compilation_cache_dir", settings.folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", settings.least_seconds)
    reset_compilation_cache()  # a process that has compiled without a cache would never look for one again


class LocalProcesses(ThreadPoolExecutor):
    """An executor of processes, each on its part of the cores; every thread of it waits for one process.

    A process that dies is replaced, and its task runs again. `concurrent.futures.ProcessPoolExecutor` would be broken
    from then on, with all that it was given, and its processes would outlive this one where it is killed.
    """

    def __init__(self, count: int):
        super().__init__(count, thread_name_prefix=THREADS)
        cores, settings = available_cores(), CacheSettings.current()
        self._stopped = False
        # Each has a part of the cores; otherwise all would use all of them, and wait for each other.
        parts = [cores[i * len(cores) // count : (i + 1) * len(cores) // count] or cores for i in range(count)]
        self._workers = [_Worker(part, settings) for part in parts]
        self._idle: SimpleQueue[_Worker] = SimpleQueue()
        for worker in self._workers:
            self._idle.put(worker)
        atexit.register(self._kill)  # multiprocessing would ask by SIGTERM, which they do not see

    def submit(self, fn: Callable, /, *args: Any, **kwargs: Any) -> Future:
        """Run a picklable function in one of the processes."""
        return super().submit(self._in_a_process, partial(fn, *args, **kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes; with ``wait``, once what was submitted has ended."""
        if wait:
            super().shutdown(wait=True, cancel_futures=cancel_futures)
        self._kill()
        super().shutdown(wait=wait, cancel_futures=True)
        atexit.unregister(self._kill)

    def _kill(self) -> None:
        self._stopped = True
        for worker in self._workers:
            worker.process.kill()

    def _in_a_process(self, task: Callable) -> Any:
        worker = self._idle.get()
        try:
            for _ in range(_RETRIES + 1):
                try:
                    result, error = worker.answer(task)
                except (EOFError, OSError):  # it died
                    if self._stopped:
                        raise
                    worker.restart()
                    continue
                if error is not None:
                    raise error
                return result
        finally:
            self._idle.put(worker)
        raise RuntimeError(
            f"its process died {_RETRIES + 1} times: for lack of memory, or since a script starts processes outside "
            "'if __name__ == \"__main__\":'"
        )


class _Worker:
    """One process, and this end of its pipe."""

    def __init__(self, cores: list[int], settings: CacheSettings):
        self._arguments = (cores, settings)
        self.restart()

    def restart(self) -> None:
        context = multiprocessing.get_context("spawn")  # JAX does not survive a fork
        self._connection, other_end = context.Pipe()
        self.process = context.Process(target=_serve, args=(other_end, *self._arguments), daemon=True)
        with _safe_path(), _signals_blocked():
            self.process.start()
        other_end.close()

    def answer(self, task: Callable) -> tuple[Any, BaseException | None]:
        """The result of a task, or its exception. Raises EOFError or OSError where the process died."""
        self._connection.send(task)
        return self._connection.recv()


@contextmanager
def _safe_path() -> Iterator[None]:
    """A process started within imports nothing from its working folder, where others may have put modules.

    multiprocessing starts its processes by ``python -c``, which looks there first, until they have the path of searches
    of this process.
    """
    with _STARTING:
        former = os.environ.get(_SAFE_PATH)
        os.environ[_SAFE_PATH] = "1"
        try:
            yield
        finally:
            if former is None:
                del os.environ[_SAFE_PATH]
            else:
                os.environ[_SAFE_PATH] = former


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """A process started within never sees Ctrl-C or SIGTERM, which reach all processes of a terminal or batch job.

    It ends when the process that started it says so, or has ended.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # multiprocessing starts it with the first process, and then unblocks them
    former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def _serve(connection: Connection, cores: list[int], settings: CacheSettings) -> None:
    """What a process does: tasks, until the pipe is closed."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    if cores and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)
    use_compilation_cache(settings)
    while True:
        try:
            content = connection.recv_bytes()
            try:
                answer = (pickle.loads(content)(), None)
            except BaseException as error:
                answer = (None, error)
            try:
                connection.send(answer)
            except (EOFError, OSError):
                return
            except Exception as error:  # an answer that cannot be pickled
                connection.send((None, RuntimeError(f"{type(error).__name__}: {error}")))
        except (EOFError, OSError):
            return
