"""Running a study: blocks through an executor, each kept as it ends; interrupted, killed and continued at will."""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
from filelock import FileLock, Timeout

from ..core.errors import InputError
from . import store
from .definition import Block, Study
from .pools import check_reach
from .store import Layout
from .trials import run_block

_CHUNK_CPU, _CHUNK_ELSEWHERE = 1000, 65_536
_AHEAD = 2  # blocks in work or waiting, for each worker


class Progress(NamedTuple):
    """How far a study is."""

    done: int  # trials kept, those of earlier runs included
    total: int
    before: int  # trials kept by earlier runs


class Outcome(NamedTuple):
    """How a run ended."""

    path: Path
    done: int
    total: int
    ran: int  # trials of this run

    @property
    def finished(self) -> bool:
        """Whether every trial is there."""
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
    watch: Callable[[Progress], None] | None = None,
) -> Outcome:
    """Run a study into an HDF5 file; where the file holds part of it already, go on from there.

    - ``executor``: any `concurrent.futures.Executor`, of ``workers`` workers (they need this package); by default threads
      in this process, on all its cores and devices. A block is one call of `identify_many`. (JAX does not survive a fork:
      a `ProcessPoolExecutor` needs ``mp_context=multiprocessing.get_context("spawn")``.)
    - ``chunk``: trials in a block, default 1,000 (65,536 on a GPU). It changes no number. What a file was begun with stays.
    - ``shards``: workers write their blocks themselves, into ``FILE.parts`` on a folder that all of them share.
    - ``keep_parts``: leave the blocks in their folder at the end; the file stays virtual. For results too large to copy.
    - ``watch``: called with a `Progress` after every block.

    An interrupt (Ctrl-C, SIGTERM) lets the blocks in work end, keeps them, and returns an `Outcome` that is not finished;
    a second one does not wait for them. Killed at any moment, nothing that was kept is lost. Raises `InputError` for a file of
    another study or one that another process is writing, and for a full disk; what is finished is then kept.
    """
    path = Path(path).resolve()
    for what, number in (("workers", workers), ("chunk", chunk)):
        if number is not None and (not isinstance(number, int) or number < 1):
            raise InputError(f"{what} is {number!r}; give a whole number of at least 1, or leave it out.")
    if executor is not None and not isinstance(executor, Executor):
        raise InputError(f"executor is a {type(executor).__name__}; give a concurrent.futures.Executor, or leave it out.")
    with _alone(path):
        store.tidy(path)
        layout, chunk, finished = _opened(study, path, chunk)
        total = layout.cells * layout.trials
        if finished and not store.parts_of(path).is_dir():
            return Outcome(path, total, total, 0)
        # Blocks of earlier runs are read through: one that the disk has spoilt runs again.
        kept = {block for block in store.finished_blocks(path, layout) if store.sound(path, block, layout)}
        missing = [block for block in layout.blocks() if block not in kept]
        if finished and not missing:
            return Outcome(path, total, total, 0)
        keep_parts = keep_parts or finished
        before = sum(block.size for block in kept)
        # Blocks of one setting follow one another, so that few pools are needed at a time.
        order = {setting: i for i, setting in enumerate(dict.fromkeys(study.settings))}
        missing.sort(key=lambda block: order[study.settings[block.first_cell]])
        done = before
        with _stopping() as stopped:
            with _executor(executor, workers) as (pool, count, place):
                task = partial(_work, study, layout, path if shards else None)
                for block, packed in _through(pool, task, missing, _AHEAD * count, stopped, place):
                    if packed is not None:
                        store.write_part(path, block, packed, layout)
                    done += block.size
                    if watch is not None:
                        watch(Progress(done, total, before))
            if done == total:  # still with interrupts kept away, since HDF5 does not bear them
                store.finish(path, study, layout, chunk, keep_parts)
        return Outcome(path, done, total, done - before)


def _work(study: Study, layout: Layout, shared: Path | None, block: Block, place: "_Place") -> store.Packed | None:
    """What a worker does with one block."""
    packed = store.pack(run_block(study, block, device=place.device, workers=place.threads), layout)
    if shared is None:
        return packed
    store.write_part(shared, block, packed, layout)
    return None


class _Place(NamedTuple):
    """Where in its process a block is run; None: the first device, all cores."""

    device: Any = None
    threads: int | None = None


@contextmanager
def _executor(executor: Executor | None, workers: int | None) -> Iterator[tuple[Executor, int, Callable[[int], _Place]]]:
    """The executor, its number of workers, and the place of the block submitted as number i."""
    if executor is not None:
        context = getattr(executor, "_mp_context", None)
        if context is not None and context.get_start_method() == "fork":
            raise InputError(
                "the executor forks, which JAX does not survive; give it mp_context=multiprocessing.get_context('spawn')."
            )
        yield executor, workers or getattr(executor, "_max_workers", None) or os.cpu_count() or 1, lambda _: _Place()
        return
    devices = jax.local_devices()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = workers or (len(devices) if devices[0].platform != "cpu" else max(cores, len(devices)))
    threads = ThreadPoolExecutor(count)
    try:
        yield threads, count, lambda i: _Place(devices[i % len(devices)], 1)
    except BaseException:
        threads.shutdown(wait=False, cancel_futures=True)
        raise
    threads.shutdown()


def _through(
    pool: Executor,
    task: Callable,
    blocks: list[Block],
    ahead: int,
    stopped: threading.Event,
    place: Callable[[int], _Place],
) -> Iterator[tuple[Block, Any]]:
    """Results of blocks as they end, few in work at a time; once ``stopped``, only of those in work."""
    waiting, working = deque(enumerate(blocks)), dict[Future, Block]()
    try:
        while working or (waiting and not stopped.is_set()):
            while waiting and len(working) < ahead and not stopped.is_set():
                number, block = waiting.popleft()
                working[pool.submit(task, block, place(number))] = block
            if stopped.is_set() and isinstance(pool, ThreadPoolExecutor):
                # Those that have not begun. (Of a Dask future one cannot tell.)
                for future in [future for future in working if future.cancel()]:
                    del working[future]
            ended, _ = wait(working, timeout=0.2, return_when=FIRST_COMPLETED)
            # What has ended well is kept first, even where another block failed at the same moment.
            for future in sorted(ended, key=lambda future: future.exception() is not None):
                block = working.pop(future)
                try:
                    result = future.result()
                except InputError:
                    raise
                except Exception as error:
                    raise RuntimeError(
                        f"block {block} failed on its worker ({type(error).__name__}: {error}); finished blocks are kept, run again to go on"
                    ) from error
                yield block, result
    finally:
        for future in working:
            future.cancel()


@contextmanager
def _stopping() -> Iterator[threading.Event]:
    """An event that the first interrupt sets; the second interrupts as usual. In other threads than the main one, never set."""
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
def _alone(path: Path) -> Iterator[None]:
    """While this process writes a study no other may."""
    if not path.name or path.is_dir():
        raise InputError(f"{path} cannot be written: it is a folder; choose another output path.")
    if not path.parent.is_dir():
        raise InputError(
            f"{path} cannot be written: no such file or directory; make the folder, or choose another output path."
        )
    lock = FileLock(path.with_name(f".{path.name}.lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise InputError(f"{path} is being written by another process; wait for it, or stop it first.") from error
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{path} cannot be written: {reason}; choose another output path.") from error
    try:
        yield
    finally:
        # First removed, then released: the other way round, a third process could lock a new file while a second holds this one.
        Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()


def _opened(study: Study, path: Path, chunk: int | None) -> tuple[Layout, int, bool]:
    """The layout of a file that is there, or of one that is made; its chunk; and whether it is finished."""
    from importlib import metadata

    if not path.exists():
        check_reach(study)
        chunk = chunk or (_CHUNK_CPU if jax.local_devices()[0].platform == "cpu" else _CHUNK_ELSEWHERE)
        layout = Layout.of(study, chunk)
        store.create(path, study, layout, chunk)
        return layout, chunk, False
    kept = store.read(path)
    if kept.study != study:
        raise InputError(f"{path} holds another study ({_difference(kept.study, study)}); choose another output path.")
    store.check_parts(path, kept._replace(finished=False))
    if kept.finished and kept.parts is None:
        store.clean(path)  # a kill may have left it
        return Layout.of(study, kept.chunk), kept.chunk, True
    if chunk is not None and chunk != kept.chunk:
        raise InputError(f"{path} was begun with chunks of {kept.chunk} trials; leave the chunk out to go on with them.")
    if kept.package_version != metadata.version("aacmm_jax"):
        raise InputError(
            f"{path} was begun with aacmm_jax {kept.package_version}; go on with that version, or choose another output path."
        )
    return Layout.of(study, kept.chunk), kept.chunk, kept.finished


def _difference(one: Study, other: Study) -> str:
    """Where two studies differ first, in words."""
    known, asked = (s.specification.model_dump(exclude={"name", "arm"}) for s in (one, other))
    for table, value in asked.items():
        if value != known[table]:
            both = isinstance(value, dict) and isinstance(known[table], dict)
            inner = [key for key in value if known[table].get(key) != value[key]] if both else []
            return f"{table}{'.' + inner[0] if inner else ''} differs"
    return "its arm or its capture differs"
