"""Worker processes of this machine, reached through pipes: there is no port that another user could connect to."""

import atexit
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

from .worker_setup import CacheSettings, use_compilation_cache

_SAFE_PATH, _STARTING = "PYTHONSAFEPATH", threading.Lock()
_TRIES = 4  # of a task whose process died
THREADS = "aacmm-study"  # beginning of the names of threads that may still compute when an interrupt is answered


class LocalProcesses(ThreadPoolExecutor):
    """An executor of processes, each on its part of the cores; every thread of it waits for one process.

    A process that dies is replaced, and its task runs again. `concurrent.futures.ProcessPoolExecutor` would be broken
    from then on, with all that it was given.
    """

    def __init__(self, count: int):
        super().__init__(count, thread_name_prefix=THREADS)
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        settings = CacheSettings.current()
        self._stopped = False
        self._workers = [_Worker(_part(cores, number, count), settings) for number in range(count)]
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
            result, error = self._answer(worker, task)
        finally:
            self._idle.put(worker)
        if error is not None:
            raise error
        return result

    def _answer(self, worker: "_Worker", task: Callable) -> tuple[Any, BaseException | None]:
        for _ in range(_TRIES):
            try:
                return worker.answer(task)
            except (EOFError, OSError):
                if self._stopped:
                    raise
                worker.restart()
        raise RuntimeError(
            f"its process died {_TRIES} times: for lack of memory, or since a script starts processes outside "
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


def _part(cores: list[int], number: int, count: int) -> list[int]:
    """The cores of one of the processes; otherwise each would use all, and wait for the others."""
    return cores[number * len(cores) // count : (number + 1) * len(cores) // count] or cores


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
        except (EOFError, OSError):
            return
        try:
            answer = (pickle.loads(content)(), None)
        except BaseException as error:
            answer = (None, error)
        try:
            connection.send(answer)
        except (OSError, EOFError):
            return
        except Exception as error:  # an answer that cannot be pickled
            connection.send((None, RuntimeError(f"{type(error).__name__}: {error}")))
