"""Running a study: blocks in an executor, each kept when it ends; a stopped or killed run can be continued."""

import itertools
import os
import platform
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from filelock import FileLock, Timeout

from ..core.errors import InputError
from ..files.outputs import OutputFile
from . import store
from .blocks import Block, Layout, parts_of
from .computed_with import check_same, computed_with
from .configuration_pool import check_reach
from .definition import Study
from .executors import THREADS, available_cores
from .settings import Setting
from .trials import run_block

_CHUNK_CPU, _CHUNK_ELSEWHERE = 1000, 65_536
_QUEUED = 2  # blocks running or waiting, for each worker


class StudyProgress(NamedTuple):
    """Progress of a study, for the callback of `run_study`."""

    done: int  # trials kept, those of earlier runs included
    total: int
    before: int  # trials kept by earlier runs
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
    keep_parts: bool = False,
    watch: Callable[[StudyProgress], None] | None = None,
) -> Outcome:
    """Run a study into an HDF5 file, or continue the one that the file contains.

    The first block of every setting runs before all others: it takes the time to compile, which then is known to be
    over. An interrupt (Ctrl-C, SIGTERM) in that time returns at once; later it lets the running blocks end and keeps
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
        keep_parts: Leave the blocks in their folder at the end: for results too large to copy.
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
    path = output.target
    for what, number in (("workers", workers), ("chunk", chunk)):
        if number is not None and (not isinstance(number, int) or number < 1):
            raise InputError(f"{what} is {number!r}; give a whole number of at least 1, or leave it out.")
    if executor is not None:
        _check_executor(executor)
    with _locked(output):
        store.check_ours(path)
        store.tidy(path)
        layout, finished = _opened(study, path, chunk, executor)
        total = layout.cells * layout.trials
        if finished and not parts_of(path).is_dir():
            return Outcome(path, total, total, 0)
        # Blocks of earlier runs are read completely: a damaged one runs again.
        kept = {block for block in store.finished_blocks(path, layout) if store.is_readable(path, block, layout)}
        missing = [block for block in layout.blocks() if block not in kept]
        if finished and not missing:
            return Outcome(path, total, total, 0)
        keep_parts = keep_parts or finished
        before = sum(block.size for block in kept)
        first, others = _in_order(study, missing)
        progress = StudyProgress(before, total, before, len(first), len(first))
        tell = watch or (lambda _: None)
        tell(progress)
        with _stop_on_interrupt() as stopped:
            with _executor(executor, workers) as (pool, count, resources):
                task = partial(_run, study, layout, path if shards else None)
                submit = lambda block: pool.submit(task, block, next(resources))  # noqa: E731
                waits_known = isinstance(pool, ThreadPoolExecutor | ProcessPoolExecutor)
                results = _completed(submit, (first, others), _QUEUED * count, stopped, waits_known)
                for block, kept_here in results:
                    if block is None:
                        tell(progress := progress._replace(stopping=True))
                        continue
                    if kept_here is not None:
                        store.write_part(path, block, kept_here, layout)
                    done, compiling = progress.done + block.size, max(progress.compiling - 1, 0)
                    tell(progress := progress._replace(done=done, compiling=compiling))
            done = progress.done
            if done == total:  # interrupts are still caught: one within HDF5 could damage the file
                store.finish(path, study, layout, keep_parts)
        return Outcome(path, done, total, done - before)


def _check_executor(executor: Any) -> None:
    if not isinstance(executor, Executor):
        raise InputError(
            f"executor is a {type(executor).__name__}; give a concurrent.futures.Executor, or leave it out."
        )
    context = getattr(executor, "_mp_context", None)
    if context is not None and context.get_start_method() == "fork":
        raise InputError(
            "the executor forks, which JAX does not survive; give it mp_context=multiprocessing.get_context('spawn')."
        )


def _run(
    study: Study, layout: Layout, shared: Path | None, block: Block, resources: "_Resources"
) -> dict[str, np.ndarray] | None:
    """The task of a worker: one block, computed with what the study was begun with; written in a shared folder."""
    check_same(layout.computed_with, f"on the worker {platform.node()}: the study", "leave that worker out")
    results = run_block(study, block, device=resources.device, workers=resources.threads)
    if shared is None:
        return results
    store.write_part(shared, block, results, layout)
    return None


class _Resources(NamedTuple):
    """What of its process a block uses; None: the first device, all cores."""

    device: Any = None
    threads: int | None = None


@contextmanager
def _executor(executor: Executor | None, workers: int | None) -> Iterator[tuple[Executor, int, Iterator[_Resources]]]:
    """The executor, its number of workers, and the resources of one block after another."""
    if executor is not None:
        count = workers or getattr(executor, "_max_workers", None) or len(available_cores())
        yield executor, count, itertools.repeat(_Resources())
        return
    devices = jax.local_devices()
    cores = len(available_cores()) if devices[0].platform == "cpu" else 0
    count = workers or max(cores, len(devices))
    threads = ThreadPoolExecutor(count, thread_name_prefix=THREADS)
    try:
        yield threads, count, itertools.cycle(_Resources(device, 1) for device in devices)
    finally:  # where a block is running still, an interrupt does not wait for it
        threads.shutdown(wait=False, cancel_futures=True)


def _in_order(study: Study, missing: list[Block]) -> tuple[list[Block], list[Block]]:
    """The first block of every setting, each of which compiles its program; and the others.

    Blocks of one setting run consecutively, so that few pools are needed at a time.
    """
    by_setting: dict[Setting, list[Block]] = {setting: [] for setting in study.settings}
    for block in missing:
        by_setting[study.settings[block.first_cell]].append(block)
    groups = [blocks for blocks in by_setting.values() if blocks]
    return [blocks[0] for blocks in groups], [block for blocks in groups for block in blocks[1:]]


def _completed(
    submit: Callable[[Block], Future],
    phases: tuple[list[Block], list[Block]],
    queued: int,
    stopped: threading.Event,
    waits_known: bool,
) -> Iterator[tuple[Block | None, Any]]:
    """Results of blocks as they end: first of those that compile, then of the others, at most ``queued`` at a time.

    ``waits_known``: whether a future can be cancelled only before it has begun. Dask's can always.

    Once ``stopped``, (None, None) and then those of blocks that are running; nothing more where programs compile.
    """
    submitted: dict[Future, Block] = {}
    try:
        for blocks, most in zip(phases, (len(phases[0]), queued), strict=True):
            waiting, told = deque(blocks), False
            while submitted or (waiting and not stopped.is_set()):
                while waiting and len(submitted) < most and not stopped.is_set():
                    block = waiting.popleft()
                    submitted[submit(block)] = block
                ended, _ = wait(submitted, timeout=0.2, return_when=FIRST_COMPLETED)
                # Successful blocks first: they are kept even where another block failed at the same moment.
                for future in sorted(ended, key=lambda future: future.exception() is not None):
                    yield (block := submitted.pop(future)), _result(future, f"block {block}")
                if not stopped.is_set():
                    continue
                if blocks is phases[0]:
                    return
                for future in [future for future in submitted if waits_known and future.cancel()]:
                    del submitted[future]  # those that have not begun
                if submitted and not told:
                    told = True
                    yield None, None
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
            f"{what} failed on its worker ({type(error).__name__}: {error}); finished blocks are kept, run "
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
                f"{output.named} is being written by another process; wait for it, or stop it first."
            ) from error
    try:
        yield
    finally:
        # Removed before it is released: otherwise a third process could lock a new file while a second has this one.
        Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()


def _opened(study: Study, path: Path, chunk: int | None, executor: Executor | None) -> tuple[Layout, bool]:
    """The layout of an existing or a new file, and whether it is finished."""
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
        layout = Layout.of(study, chunk, settings)
        store.create(path, study, layout)
        return layout, False
    stored = store.read(path)
    if stored.study != study:
        raise InputError(
            f"{path} holds another study ({_difference(stored.study, study)}); choose another output path."
        )
    store.check_parts(path, stored._replace(finished=False))
    if stored.finished and stored.parts is None:
        store.clean(path)  # left by a killed process
        return stored.layout, True
    begun = stored.layout
    if chunk not in (None, begun.chunk):
        raise InputError(f"{path} was begun with chunks of {begun.chunk} trials; leave the chunk out to continue.")
    if executor is None:
        check_same(begun.computed_with, str(path), "choose another output path")
    return begun, stored.finished


def _difference(one: Study, other: Study) -> str:
    """The first key in which two studies differ, in words."""
    begun, asked = (s.specification.model_dump(exclude={"name", "arm"}) for s in (one, other))
    for table, value in asked.items():
        if value != begun[table]:
            both = isinstance(value, dict) and isinstance(begun[table], dict)
            inner = [key for key in value if begun[table].get(key) != value[key]] if both else []
            return f"{table}{'.' + inner[0] if inner else ''} differs"
    return "its arm or its capture differs"
