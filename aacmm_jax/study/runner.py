"""Running a study: blocks in an executor, each kept when it ends; a stopped or killed run can be continued."""

import itertools
import os
import platform
import shutil
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from filelock import FileLock, Timeout

from ..core._compat import reset_compilation_cache
from ..core.errors import InputError, require
from ..core.jax_setup import set_up
from ..files.outputs import OutputFile
from .blocks import Block, check_same, computed_with
from .configuration_pool import check_reach
from .definition import Setting, Study, equal_study
from .store import Results, check_owners, parts_of, read, write_block
from .trials import run_block

_CHUNK_CPU, _CHUNK_ELSEWHERE = 1000, 65_536
_QUEUED = 2  # blocks running or waiting, for each worker
_RETRIES = 3  # of a block whose worker died
THREADS = "aacmm-study"  # beginning of the names of threads that may still compute when an interrupt is answered


class StudyProgress(NamedTuple):
    """Progress of a study, for the callback of `run_study`."""

    done: int  # trials kept, those of earlier runs included
    total: int
    programs: int = 0  # compiled programs that this run needs, one for each setting of the study
    compiling: int = 0  # those that have not computed their first block yet
    stopping: bool = False  # after an interrupt: the running blocks end


class Outcome(NamedTuple):
    """Outcome of one run of a study."""

    path: Path
    done: int
    total: int
    ran: int  # trials of this run

    @property
    def finished(self) -> bool:
        """Whether every trial has run."""
        return self.done == self.total


def run_study(
    study: Study,
    path: str | os.PathLike,
    *,
    executor: Executor | None = None,
    workers: int | None = None,
    chunk: int | None = None,
    shards: bool = False,
    watch: Callable[[StudyProgress], None] | None = None,
) -> Outcome:
    """Run a study into an HDF5 file, or continue the one that the file contains.

    The first block of every setting runs before all others: it takes the time to compile, which then is known to be
    over. An interrupt (Ctrl-C, SIGTERM) in that time returns at once; later it lets the submitted blocks end and keeps
    them, and a second one does not wait for them. What does not end is left to its thread, and its result discarded. A
    kill at any moment loses only the running blocks.

    Args:
        study: The study.
        path: The file; its folder must exist.
        executor: Any `concurrent.futures.Executor` whose workers have this package. By default threads in this process,
            on all its cores and devices. JAX does not survive a fork: a `ProcessPoolExecutor` needs
            ``mp_context=multiprocessing.get_context("spawn")``.
        workers: Number of workers of the executor.
        chunk: Trials in a block, which is one call of `identify_many`; default 1,000 (65,536 on a GPU). It changes no
            number, and stays what it was when the file was begun.
        shards: Let workers write their blocks themselves, into ``FILE.parts`` in a folder that all of them share.
        watch: Called with a `StudyProgress` at the beginning, after every block, and when an interrupt has come.

    Returns:
        Numbers of trials, and whether the study is ``finished``.

    Raises:
        InputError: For a file of another study, a file that another process is writing, and a full disk; finished
            blocks are kept.

    Example:
        >>> outcome = aj.study.run_study(study, "study.h5")
        >>> print(outcome.total, outcome.finished)
        80 True
    """
    output = OutputFile(path)
    path, total, tell = output.target, len(study.cells) * study.trials, watch or (lambda _: None)
    _check_arguments(executor, workers=workers, chunk=chunk)
    with _locked(output):
        check_owners(path)
        for left in parts_of(path).glob(".*.????????.part"):  # of killed processes
            left.unlink(missing_ok=True)
        results = _opened(study, path, chunk, executor)
        if results.finished:
            shutil.rmtree(parts_of(path), ignore_errors=True)  # left by a killed process
            return Outcome(path, total, total, 0)
        # Blocks of earlier runs are read completely: a damaged one runs again.
        kept = {block for block in results.finished_blocks() if results.is_readable(block)}
        missing = [block for block in results.blocks if block not in kept]
        done = before = total - sum(block.size for block in missing)
        # The first block of every setting compiles its program. Blocks of one setting run consecutively, so that few
        # pools are needed at a time.
        by_setting: dict[Setting, list[Block]] = {}
        for block in missing:
            by_setting.setdefault(study.settings[block.first_cell], []).append(block)
        first = [blocks[0] for blocks in by_setting.values()]
        others = [block for blocks in by_setting.values() for block in blocks[1:]]
        progress = StudyProgress(done, total, len(first), len(first))
        tell(progress)
        with _stop_on_interrupt() as stopped:
            with _pool(executor, workers) as (pool, count, devices):

                def submit(block: Block) -> Future:
                    file = results.file_of(block) if shards else None
                    return pool.submit(_run, study, results.computed_with, block, file, next(devices))

                for block, arrays in _completed(submit, (first, others), _QUEUED * count, stopped):
                    if block is None:
                        tell(progress := progress._replace(stopping=True))
                        continue
                    if arrays is not None:
                        write_block(results.file_of(block), arrays)
                    done, compiling = done + block.size, max(progress.compiling - 1, 0)
                    tell(progress := progress._replace(done=done, compiling=compiling))
            if done == total:  # interrupts are still caught: one within HDF5 could damage the file
                results.finish()
        return Outcome(path, done, total, done - before)


@contextmanager
def dask_executor(address: str) -> Iterator[tuple[Executor, int]]:
    """Connect to a Dask cluster; a context manager.

    A Dask scheduler runs whatever it is sent, with the rights of whoever started its workers, and a worker's answer is
    unpickled here. ``tcp://`` trusts everybody who can reach its port, every user of its machine included. ``tls://``
    asks both sides for a certificate, those that Dask's configuration names (``distributed.comm.tls``).

    Args:
        address: Of a scheduler (``tls://host:8786``, ``tcp://host:8786``, or a scheduler file).

    Returns:
        The executor for `run_study`, and its number of workers.

    Raises:
        InputError: Where Dask is not installed, no scheduler answers, or the cluster has no workers.

    Example:
        >>> with aj.study.dask_executor("tls://scheduler:8786") as (executor, workers):  # doctest: +SKIP
        ...     aj.study.run_study(study, "study.h5", executor=executor, workers=workers)
    """
    require("dask", "a study on a Dask cluster")
    import distributed

    target: dict[str, Any] = {"scheduler_file": address} if os.path.isfile(address) else {"address": address}
    try:
        connected: Any = distributed.Client(**target, timeout=5)
    except Exception as error:  # of a dozen types: no such file or host, no answer, not a scheduler's file
        raise InputError(
            f"no Dask scheduler answers at {address}; start a scheduler, or omit --dask to use the cores of this "
            "computer."
        ) from error
    with connected as client:
        count = len(client.scheduler_info(n_workers=-1)["workers"])
        if not count:
            raise InputError(
                f"the Dask cluster at {address} has no workers; start workers, for example: dask worker {address}"
            )
        client.register_worker_callbacks(use_compilation_cache)  # of workers that join later, too
        yield client.get_executor(retries=_RETRIES, pure=False), count


def use_compilation_cache() -> None:
    """Use the cache that the environment names, or else the user's own, in a worker: JAX may have been imported there
    before its environment was set."""
    set_up()
    least = os.environ.get("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    if least is not None:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", float(least))
    reset_compilation_cache()  # a process that has compiled without a cache would never look for one again


def _check_arguments(executor: Any, **numbers: Any) -> None:
    for what, number in numbers.items():
        if number is not None and (not isinstance(number, int) or number < 1):
            raise InputError(f"{what} is {number!r}; give a whole number of at least 1, or omit it.")
    if executor is not None and not isinstance(executor, Executor):
        raise InputError(f"executor is a {type(executor).__name__}; give a concurrent.futures.Executor, or omit it.")
    context = getattr(executor, "_mp_context", None)
    if context is not None and context.get_start_method() == "fork":
        raise InputError(
            "the executor forks its processes, which does not work with JAX; create the executor with "
            "mp_context=multiprocessing.get_context('spawn')."
        )


def _opened(study: Study, path: Path, chunk: int | None, executor: Executor | None) -> Results:
    """What an existing file holds, or a new one."""
    if not path.exists():
        # It may compile, which Ctrl-C cannot interrupt in the thread that does it.
        thread = ThreadPoolExecutor(1, thread_name_prefix=THREADS)
        try:
            thread.submit(check_reach, study).result()
        finally:
            thread.shutdown(wait=False)
        chunk = chunk or (_CHUNK_CPU if jax.local_devices()[0].platform == "cpu" else _CHUNK_ELSEWHERE)
        # With what a worker computes: it may be another machine, with other devices.
        settings = computed_with() if executor is None else _result(executor.submit(computed_with), "the first task")
        results = Results(path, study, chunk, settings)
        results.create()
        return results
    results = read(path)
    if results.study != study:
        raise InputError(
            f"{path} contains another study ({_difference(results.study, study)}); choose another output path."
        )
    if not results.finished and chunk not in (None, results.chunk):
        raise InputError(f"{path} was begun with chunks of {results.chunk} trials; omit the chunk size to continue.")
    if not results.finished and executor is None:
        check_same(results.computed_with, str(path), "choose another output path")
    return results


def _difference(begun: Study, asked: Study) -> str:
    """The first key in which two studies differ, in words."""
    before, now = (study.specification.model_dump(exclude={"name", "arm"}) for study in (begun, asked))
    for table, value in now.items():
        if isinstance(value, dict) and isinstance(before[table], dict):
            for key in value:
                if before[table].get(key) != value[key]:
                    return f"{table}.{key} differs"
        elif value != before[table]:
            return f"{table} differs"
    return "the arm or the capture differs"


def _run(study: Study, begun: str, block: Block, file: Path | None, device: Any = None) -> dict[str, np.ndarray] | None:
    """The task of a worker: one block, computed with what the study was begun with; written to a shared folder."""
    check_same(begun, f"on the worker {platform.node()}: the study", "leave this worker out")
    results = run_block(equal_study(study), block, device=device)
    if file is None:
        return results
    write_block(file, results)
    return None


@contextmanager
def _pool(executor: Executor | None, workers: int | None) -> Iterator[tuple[Executor, int, Iterator[Any]]]:
    """The executor, its number of workers, and the device of one block after another; None: all that it has."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if executor is not None:
        yield executor, workers or getattr(executor, "_max_workers", None) or cores, itertools.repeat(None)
        return
    devices = jax.local_devices()
    count = workers or max(cores if devices[0].platform == "cpu" else 0, len(devices))
    threads = ThreadPoolExecutor(count, thread_name_prefix=THREADS)
    try:
        yield threads, count, itertools.cycle(devices)
    finally:  # where a block is running still, an interrupt does not wait for it
        threads.shutdown(wait=False, cancel_futures=True)


def _completed(
    submit: Callable[[Block], Future],
    phases: tuple[list[Block], list[Block]],
    queued: int,
    stopped: threading.Event,
) -> Iterator[tuple[Block | None, Any]]:
    """Results of blocks as they end: first of those that compile, then of the others, at most ``queued`` at a time.

    Once ``stopped``, (None, None) and then those of blocks that are submitted; nothing more where programs compile.
    """
    submitted: dict[Future, Block] = {}
    try:
        for blocks, most in zip(phases, (len(phases[0]), queued), strict=True):
            waiting = deque(blocks)
            while submitted or waiting:
                if stopped.is_set():
                    if blocks is phases[0]:
                        return
                    if waiting:
                        waiting.clear()
                        yield None, None
                while waiting and len(submitted) < most:
                    block = waiting.popleft()
                    submitted[submit(block)] = block
                ended, _ = wait(submitted, timeout=0.2, return_when=FIRST_COMPLETED)
                # Successful blocks first: they are kept even where another block failed at the same moment.
                for future in sorted(ended, key=lambda future: future.exception() is not None):
                    yield (block := submitted.pop(future)), _result(future, f"block {block}")
    finally:
        for future in submitted:
            future.cancel()


def _result(future: Future, what: object) -> Any:
    try:
        return future.result()
    except InputError:
        raise
    except Exception as error:
        raise RuntimeError(
            f"{what} failed on its worker ({type(error).__name__}: {error}); finished blocks are kept; run the study "
            "again to continue"
        ) from error


@contextmanager
def _stop_on_interrupt() -> Iterator[threading.Event]:
    """An event that the first interrupt sets; the second acts as usual. Signals reach the main thread only."""
    stopped = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stopped
        return
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def first(*_: object) -> None:
        stopped.set()
        for number, handler in former.items():
            signal.signal(number, handler)

    for number in former:
        signal.signal(number, first)
    try:
        yield stopped
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


@contextmanager
def _locked(output: OutputFile) -> Iterator[None]:
    """Keep other processes from writing the same study."""
    lock = FileLock(output.target.with_name(f".{output.target.name}.lock"))
    with output.refusing():
        output.check()
        try:
            lock.acquire(timeout=0)
        except Timeout as error:
            raise InputError(
                f"{output.named} is being written by another process; wait until that process ends, or stop it."
            ) from error
    try:
        yield
    finally:
        # Removed before it is released: otherwise a third process could lock a new file while a second has this one.
        # Windows refuses to remove an open file; there, the lock itself removes it when it is released.
        with suppress(PermissionError):
            Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()
