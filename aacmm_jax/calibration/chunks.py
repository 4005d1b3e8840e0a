"""A batch in chunks, which the threads of a machine or its devices compute one after the other."""

import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import Empty, SimpleQueue
from typing import Any

import jax

from ..core.arguments import items_of
from ..core.errors import InputError

_ROUNDS = 64  # problems that a slot of one chunk takes at most, one after the other


def devices_of(given: Any) -> list[Any]:
    """The devices to use, by default all; or `InputError`."""
    devices = jax.local_devices() if given is None else items_of(given, "devices")
    if not devices:
        raise InputError("devices is empty; name at least one, or leave it out.")
    return list(devices)


def default_workers(devices: Sequence[Any]) -> int:
    """Chunks in work at the same time: one for each device; on a CPU, one for each core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return len(devices) if devices[0].platform != "cpu" else max(len(devices), cores)


def cut_into_chunks(size: int, slots: int, workers: int, chunk: int | None) -> list[range]:
    """The batch in chunks: of the given size, or as few as keep all workers busy, since slots idle at the end of
    each."""
    if chunk is None:
        rounds = -(-size // (slots * _ROUNDS))
        calls = min(-(-rounds // workers) * workers, -(-size // slots))
        chunk = -(-size // calls)
    return [range(first, min(first + chunk, size)) for first in range(0, size, chunk)]


def round_up(count: int, slots: int) -> int:
    """Whole rounds of the slots, their number a power of two: each size is compiled once, so there should be few."""
    return slots * 2 ** math.ceil(math.log2(-(-count // slots)))


def run_chunks(run: Callable, chunks: Sequence[range], devices: Sequence[Any], workers: int) -> list:
    """Results of all chunks in their order, computed by threads: XLA releases the interpreter's lock while it computes.

    The calling thread is one of the workers, since a new one takes a millisecond to start. A worker keeps its device.
    """
    # A queue and not a shared iterator, which two threads may advance at once where Python runs without its lock.
    numbers: SimpleQueue[int] = SimpleQueue()
    for i in range(len(chunks)):
        numbers.put(i)
    failed = threading.Event()
    results: list[Any] = [None] * len(chunks)

    def work(worker: int) -> None:
        while not failed.is_set():
            try:
                i = numbers.get_nowait()
            except Empty:
                return
            try:
                results[i] = run(chunks[i], devices[worker % len(devices)])
            except BaseException:
                failed.set()
                raise

    with ThreadPoolExecutor(workers) as pool:
        others = [pool.submit(work, worker) for worker in range(1, min(workers, len(chunks)))]
        work(0)
        for other in others:
            other.result()
    return results
