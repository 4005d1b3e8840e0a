"""A study is killed by SIGKILL at random moments, resumed each time, and compared to the bit with one that was not.

The command runs in a process of its own. ``calibrate``, ``report`` and ``export`` are killed as well: the output of
each is then what it was before, or what the command makes when it is not killed, but for the time of writing.
"""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

import aacmm_jax as aj

from .outcomes import HANG, LOST, SAME, SILENT, UNEXPECTED, Attempt

SECONDS = 600

# Commands, the last words of which are their outputs.
COMMANDS = {
    "calibrate": ("calibrate", "capture.h5", "-o", "killed.h5"),
    "report": ("report", "result.h5", "-o", "killed.html"),
    "export": ("export", "result.h5", "-o", "killed.toml"),
}


def started(folder: Path, *arguments: object) -> subprocess.Popen:
    """The command ``study`` as a process of its own."""
    return command(folder, "study", "bound-sensitivity", *arguments)


def command(folder: Path, *arguments: object) -> subprocess.Popen:
    """A command as a process of its own."""
    line = [sys.executable, "-m", "aacmm_jax", *map(str, arguments)]
    return subprocess.Popen(line, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def differences(one: Path, other: Path) -> list[str]:
    """The arrays of two studies that are not the same to the bit."""
    with h5py.File(one) as a, h5py.File(other) as b:
        groups = sorted({*a, *b})
        pairs = ((f"{group}/{name}", a[group].get(name), b[group].get(name)) for group in groups for name in a[group])
        return [name for name, x, y in pairs if x is None or y is None or _bytes(x) != _bytes(y)]


def _bytes(item: h5py.Dataset) -> object:
    values = np.asarray(item[()])
    return values.tolist() if values.dtype.kind == "O" else (values.dtype.str, values.shape, values.tobytes())


def killed(process: subprocess.Popen, path: Path, blocks: int, delay: float) -> None:
    """Kill a study when so many blocks are kept and some time has passed, or when it has ended."""
    folder, deadline = path.with_name(path.name + ".parts"), time.monotonic() + SECONDS
    while process.poll() is None and time.monotonic() < deadline and len(list(folder.glob("*.npz"))) < blocks:
        time.sleep(0.005)
    time.sleep(delay)
    process.kill()
    process.communicate()


def attack(folder: Path, seed: int, count: int, trials: int = 1000, chunk: int = 125) -> Iterator[Attempt]:
    """So many kills; one attempt is a kill after which the file still reads, or the end of a study."""
    random = np.random.default_rng(seed)
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "cache"))
    whole, arguments = folder / "whole.h5", ("--trials", trials, "--chunk", chunk)
    started(folder, "-o", whole, *arguments).communicate()
    blocks = 20 * trials // chunk
    path = folder / "killed" / "study.h5"
    path.parent.mkdir()
    for number in range(count):
        process = started(folder, "-o", path, *arguments)
        killed(process, path, blocks * number // count, random.uniform(0, 0.3))
        if not path.exists():
            yield Attempt("killed", SAME if number == 0 else LOST, "no file")
            continue
        try:
            kept = int((aj.study.open_study(path).converged.values >= 0).sum())
            yield Attempt("killed", SAME, f"{kept} trials kept")
        except Exception as error:
            yield Attempt("killed", LOST, f"{type(error).__name__}: {error}")
    yield _resumed(whole, path, started(folder, "-o", path, *arguments), "study")
    yield from commands(folder / "commands", random, max(count // 4, 1))


def commands(folder: Path, random: np.random.Generator, count: int) -> Iterator[Attempt]:
    """So many kills of each of the other commands."""
    folder.mkdir()
    sockets = ("--socket", "A=400,200,300", "--socket", "B=600,200,300", "--length", "A,B,0.002", "--poses", 30)
    command(folder, "simulate", "cheng2018-simulation", "-o", "capture.h5", *sockets).communicate()
    command(folder, "calibrate", "capture.h5", "-o", "result.h5").communicate()
    inputs = {item.name for item in folder.iterdir()}
    for name, words in COMMANDS.items():
        output, begun = folder / words[-1], time.monotonic()
        command(folder, *words).communicate()
        whole, lasted = _content(output), time.monotonic() - begun
        for _ in range(count):
            output.write_bytes(b"old")
            process = command(folder, *words)
            time.sleep(random.uniform(0.5, 1.1) * lasted)  # before, it imports
            process.kill()
            process.communicate()
            found = b"old" if output.exists() and output.read_bytes() == b"old" else _content(output)
            yield Attempt(f"{name}: killed", SAME if found in (b"old", whole) else LOST, str(output))
        command(folder, *words).communicate()
        left = {item.name for item in folder.iterdir()} - inputs
        same = left == {output.name} and _content(output) == whole
        yield Attempt(f"{name}: run again", SAME if same else LOST, f"left: {sorted(left)}")
        output.unlink()


def _content(path: Path) -> object:
    """What a file holds, but for the time of writing; an HDF5 file is verified, and its arrays and attributes taken."""
    if path.suffix != ".h5":
        return re.sub(rb"20\d\d-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?", b"", path.read_bytes())
    aj.files.load_calibration(path)
    with h5py.File(path) as file:
        items = {"": file}
        file.visititems(items.__setitem__)
        attributes = {
            f"{name}@{key}": str(value)
            for name, item in items.items()
            for key, value in item.attrs.items()
            if key not in ("created", "content_sha256", "DIMENSION_LIST", "REFERENCE_LIST")
        }
        return attributes | {name: _bytes(item) for name, item in items.items() if isinstance(item, h5py.Dataset)}


def _resumed(whole: Path, path: Path, process: subprocess.Popen, way: str) -> Attempt:
    try:
        _, errors = process.communicate(timeout=SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        return Attempt(f"{way}: resumed", HANG)
    if process.returncode:
        return Attempt(f"{way}: resumed", UNEXPECTED, errors)
    left = sorted(item.name for item in path.parent.iterdir() if item != path)
    if left:
        return Attempt(f"{way}: resumed", LOST, f"left: {left}")
    different = differences(whole, path)
    return Attempt(f"{way}: resumed", SILENT if different else SAME, str(different))
