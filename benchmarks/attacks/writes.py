"""Files of every kind while they are written: the process is killed, or runs out of space.

Whatever happens, the file is afterwards what it was before, or the new one, whole; running out of space is one
sentence; and the next write leaves no temporary file. Every write runs in a fork of this process, which JAX
only survives where it has computed nothing before: so this process computes nothing.
"""

import contextlib
import os
import pickle
import resource
import select
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import aacmm_jax as aj
from aacmm_jax.study.blocks import computed_with
from aacmm_jax.study.store import Results

from .outcomes import LOST, REFUSED, SAME, UNEXPECTED, Attempt, ending, exact
from .samples import BLOCK, READERS, make, study_results

SECONDS = 120  # of wall time: making all files, on a busy machine
LOADING = 600  # of wall time: importing and loading, on a very busy machine
DISK = 2**20  # bytes of the disk that is filled
PAGE = 4096  # by which it is filled


class Target(NamedTuple):
    """How a file is made ready to be written, written and read, and how its folder is before."""

    load: Callable[[], Any]  # what `write` writes
    write: Callable[[Any, Path], Any]
    read: Callable[[Path], Any]
    prepare: Callable[[Path], Any] = lambda path: path.write_bytes(b"old")


def targets(folder: Path) -> dict[str, Target]:
    """A writer for each kind of file; all are made in a fork."""
    assert forked(nothing, lambda _: make(folder))[0] == "written"

    def save(kind: str) -> Callable[[Any, Path], Any]:
        what = {"observations": "capture", "calibration from observations": "calibration"}.get(kind, kind)
        return lambda loaded, path: getattr(aj.files, f"save_{what.replace(' ', '_')}")(path, loaded)

    def in_blocks_at(path: Path) -> None:
        shutil.copy(folder / "parts" / "study.h5", path)
        shutil.copytree(folder / "parts" / "study.h5.parts", f"{path}.parts", dirs_exist_ok=True)

    def finish(study: Any, path: Path) -> None:
        Results(path, study, BLOCK, computed_with()).finish()

    load_arm = partial(aj.load_arm, "cheng2018-simulation")
    return {
        **{kind: Target(partial(load, folder / f"{kind}.h5"), save(kind), load) for kind, load in READERS.items()},
        "arm": Target(load_arm, aj.files.save_arm, aj.load_arm),
        "study": Target(partial(aj.study.read_study, folder / "study.toml"), finish, study_results, in_blocks_at),
    }


def forked(load: Callable[[], Any], work: Callable[[Any], Any], delay: float | None = None) -> tuple[str, Any]:
    """Load something in a fork and work with it, killed after some time: "killed", or the outcome and the result."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            loaded = load()
            os.write(writing, b".")
            outcome, found = ending(lambda: work(loaded), SECONDS)
            os.write(writing, pickle.dumps((outcome or "written", found if outcome else exact(found))))
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as stream:
        if not select.select([stream], [], [], LOADING)[0]:
            os.kill(child, signal.SIGKILL)
            raise AssertionError("a fork hangs while it loads; has this process computed in JAX?")
        assert stream.read(1), "nothing could be loaded"
        if delay is not None:
            time.sleep(delay)
            os.kill(child, signal.SIGKILL)
        content = stream.read()
    os.waitpid(child, 0)
    return pickle.loads(content) if content else ("killed", None)


def nothing() -> None:
    """What is loaded where there is nothing to load."""


def limited(write: Callable[[Any, Path], Any], path: Path, size: int, loaded: Any) -> None:
    """Write with a limit on the size of files, which fails as a full disk does."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    write(loaded, path)


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[bool]:
    """A small disk of its own at a folder, which takes the right to mount; whether there is one."""
    folder.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(folder)]
    there = shutil.which("mount") is not None and not subprocess.run(mounted, capture_output=True).returncode
    try:
        yield there
    finally:
        if there:
            subprocess.run(["umount", "-l", str(folder)], check=True)


def filled(folder: Path, free: int) -> None:
    """Leave so many free bytes on the disk of a folder."""
    with open(folder / "filler", "wb", buffering=0) as filler, contextlib.suppress(OSError):
        while True:
            filler.write(bytes(PAGE))
    size = (folder / "filler").stat().st_size
    os.truncate(folder / "filler", max(0, size - size % PAGE - free // PAGE * PAGE))


def judged(target: Target, path: Path, before: bytes, expected: Any, outcome: str, message: Any) -> tuple[str, str]:
    """The outcome of one write, from what is there afterwards."""
    if outcome not in ("killed", "written", REFUSED):
        return UNEXPECTED, message
    content = path.read_bytes() if path.exists() else b""
    if content != before:
        found = forked(nothing, lambda _: target.read(path))
        if found != ("written", expected):
            return LOST, f"{outcome}; read again: {str(found)[:200]}"
    elif outcome == "written":
        return LOST, "written, but the old file is there"
    path.with_name("filler").unlink(missing_ok=True)
    left = {item.name for item in path.parent.iterdir()} - {path.name, f"{path.name}.parts"}
    if left and outcome != "killed":
        return LOST, f"{outcome}, and left {sorted(left)}"
    if content == before:  # then the next write succeeds, and leaves nothing else
        found = forked(target.load, lambda loaded: (target.write(loaded, path), target.read(path))[1])
        left = {item.name for item in path.parent.iterdir()} - {path.name, f"{path.name}.parts"}
        if left or found != ("written", expected):
            return LOST, f"{outcome}; written again: {str(found)[:200]}, left {sorted(left)}"
    return (REFUSED, message) if outcome == REFUSED else (SAME, "")


def attack(folder: Path, seed: int, count: int) -> Iterator[Attempt]:
    """So many writes: killed, with a limit on the size of files, and on a disk that fills where one can be mounted."""
    random = np.random.default_rng(seed)
    found = targets(folder)
    with small_disk(folder / "disk") as mounted:
        ways = ("killed", "size limit", "full disk") if mounted else ("killed", "size limit")
        usual = {}
        for kind, target in found.items():
            path = folder / f"usual-{kind}"
            target.prepare(path)
            outcome, seconds = forked(target.load, lambda loaded: timed(target.write, loaded, path))  # noqa: B023
            assert outcome == "written", seconds
            usual[kind] = (np.frombuffer(seconds[2])[0], path.stat().st_size)
            usual[kind] += (forked(nothing, lambda _: target.read(path))[1],)  # noqa: B023
        for number in range(count):
            way, kind = ways[number % len(ways)], list(found)[number // len(ways) % len(found)]
            target, (seconds, size, expected) = found[kind], usual[kind]
            place = folder / ("disk" if way == "full disk" else "folder")
            place.mkdir(exist_ok=True)
            path = place / f"{kind}.file"
            target.prepare(path)
            before, delay, write = path.read_bytes(), None, lambda loaded: target.write(loaded, path)  # noqa: B023
            if way == "killed":
                delay = random.uniform(0, 1.2 * seconds)
            elif way == "size limit":
                write = partial(limited, target.write, path, int(random.integers(0, int(1.1 * size))))
            else:
                filled(place, int(random.integers(0, int(1.1 * size) + PAGE)))
            yield Attempt(f"{kind}: {way}", *judged(target, path, before, expected, *forked(target.load, write, delay)))
            shutil.rmtree(f"{path}.parts", ignore_errors=True)
            for item in place.iterdir():
                item.unlink()


def timed(write: Callable[[Any, Path], Any], loaded: Any, path: Path) -> float:
    """Seconds that a write takes."""
    began = time.perf_counter()
    write(loaded, path)
    return time.perf_counter() - began
