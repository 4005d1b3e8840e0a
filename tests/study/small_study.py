"""One small study for all tests, as every other number of poses, sockets or lengths would be compiled anew."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np

import aacmm_jax as aj
from aacmm_jax.study.blocks import VARIABLES, computed_with
from aacmm_jax.study.store import Results, parts_of, write_block

ROOT = Path(__file__).resolve().parents[2]
CAPTURE = {"positions_mm": [[400, 200, 300], [300, -300, 400]], "poses": 12, "pool": 4096}
REFERENCE = {"length_mm": 300, "positions": 2, "poses": 3, "u_mm": 0.01, "region": {"distance_mm": [300, 900]}}
NOISE = {"encoder_arcsec": 2.0, "seating_mm": 0.005}
DEVIATION = {"length_mm": 1.0, "angle_deg": 0.1}
CHUNK = 8  # trials in a block: 12 blocks
SPECIFICATION = """
name = "small"
arm = "cheng2018-simulation"
trials = 24
seed = 5
[deviation]
length_mm = 1.0
angle_deg = 0.1
[capture]
positions_mm = [[400, 200, 300], [300, -300, 400]]
poses = 12
pool = 4096
[reference]
length_mm = 300
positions = 2
poses = 3
u_mm = 0.01
region = { distance_mm = [300, 900] }
[noise]
encoder_arcsec = [1, 4]
[bounds]
length_mm = [2, 10]
"""


def made(**tables: object) -> "aj.study.Study":
    """The small study with other tables."""
    known = {"arm": "cheng2018-simulation", "trials": 64, "seed": 3, "capture": CAPTURE, "deviation": DEVIATION}
    tables = known | {"reference": REFERENCE} | tables
    return aj.study.make_study(**{name: table for name, table in tables.items() if table is not None})


def begun(path: Path, study: "aj.study.Study", chunk: int = CHUNK, settings: str | None = None) -> Results:
    """The file of a study that has just begun."""
    results = Results(path, study, chunk, settings or computed_with())
    results.create()
    return results


def written_in_blocks(home: Path, study: "aj.study.Study", path: Path, chunk: int) -> None:
    """A study with the results of the one that was run, each block in a file."""
    results = begun(path, study, chunk)
    with h5py.File(home / "whole.h5") as whole:
        for block in results.blocks:
            write_block(results.file_of(block), {name: whole["trials"][name][block.slices] for name in VARIABLES})


def same(one: Path, other: Path) -> None:
    """Every array of two studies, to the bit."""
    with h5py.File(one) as a, h5py.File(other) as b:
        assert set(a) == set(b)
        for group in a:
            assert list(a[group]) == list(b[group])
            for name in a[group]:
                x, y = a[group][name][()], b[group][name][()]
                np.testing.assert_array_equal(x, y, err_msg=f"{group}/{name}")
                assert dict(a[group][name].attrs).keys() == dict(b[group][name].attrs).keys()


def command(
    home: Path, *arguments: object, program: tuple[str, ...] = ("-m", "aacmm_jax"), **options
) -> subprocess.Popen:
    """The command ``study`` as a process of its own, in ``home``."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | options.pop("env", {})
    line = [sys.executable, *program, "study", "spec.toml", *map(str, arguments)]
    return subprocess.Popen(
        line, cwd=home, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )


def until(condition, process: subprocess.Popen) -> None:
    """Wait until something is so, or the process has ended."""
    deadline = time.monotonic() + 600
    while process.poll() is None and time.monotonic() < deadline and not condition():
        time.sleep(0.02)  # to look more often would take a second of CPU


def until_parts(path: Path, count: int, process: subprocess.Popen) -> None:
    """Wait until so many blocks are kept, or the process has ended."""
    until(lambda: len(list(parts_of(path).glob("*.npz"))) >= count, process)


def interrupted_at(count: int):
    """A callback for a study that interrupts it, once."""
    sent = []

    def watch(progress):
        if progress.done >= count and not sent:
            sent.append(True)
            os.kill(os.getpid(), signal.SIGINT)

    return watch
