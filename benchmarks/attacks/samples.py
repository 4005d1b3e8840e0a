"""One good file of every kind, small: what the attacks start from."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import aacmm_jax as aj

STUDY = """
arm = "cheng2018-simulation"
trials = 6
seed = 3
[deviation]
length_mm = 1.0
[capture]
positions_mm = [[400, 200, 300]]
poses = 20
pool = 4096
[noise]
encoder_arcsec = [1, 4]
[bounds]
length_mm = 10
[identification]
method = "stage1"
"""
BLOCK = 3  # trials in a block of the study


class Results(NamedTuple):
    """Results of every kind in Python, and functions that write each of them into a file."""

    arm: "aj.kinematics.ArmSpecification"
    recording: aj.Recording
    record: Any  # of the calibration
    writers: dict[str, Callable[[Path], Any]]


def results() -> Results:
    """A capture of three sockets, its calibration, and what is made of them."""
    arm = aj.files.load_specification("cheng2018-simulation")
    sockets = {"A": (400, 200, 300), "B": (300, 350, 300), "C": (300, -350, 400)}
    capture = aj.simulate(arm.arm, sockets, poses=14, lengths=[("A", "B", 0.002)], encoder_arcsec=2.0, seed=1)
    recording = aj.Recording(capture, arm, arm, seed=1)
    record = aj.calibration.record_of(aj.calibrate(arm.arm, capture, arm.bounds()), recording)
    evaluation = aj.acceptance.evaluation_of(record, recording, maxima={"rms_mm": 0.1})
    tips = {name: np.asarray(arm.arm.position(q)) for name, q in capture.sockets.items()}
    points = aj.acceptance.PointsRecord(aj.acceptance.Measured(tips, capture.lengths, ()))
    writers = {
        "capture": lambda path: aj.files.save_capture(path, recording),
        "calibration": lambda path: aj.files.save_calibration(path, record),
        "evaluation": lambda path: aj.files.save_evaluation(path, evaluation),
        "points": lambda path: aj.files.save_points(path, points),
    }
    return Results(arm, recording, record, writers)


READERS: dict[str, Callable[[Path], Any]] = {
    "capture": aj.files.load_capture,
    "calibration": aj.files.load_calibration,
    "evaluation": aj.files.load_evaluation,
    "points": aj.files.load_points,
}


def study_results(path: Path) -> Any:
    """All results of a study: whether it is finished, and every column of every cell."""
    results = aj.study.Results.of(path)
    cells = range(len(results.study.cells))
    return results.finished, [results.columns(cell) for cell in cells], [list(results.errors(cell)) for cell in cells]


def studies(folder: Path) -> dict[str, tuple[Path, Path]]:
    """Studies in a folder: for each kind the file that is attacked, and the study that is read with it."""
    (folder / "study.toml").write_text(STUDY)
    study = aj.study.read_study(folder / "study.toml")
    whole, parts = folder / "study.h5", folder / "parts" / "study.h5"
    run = partial(aj.study.run_study, study, chunk=BLOCK)
    run(whole)
    parts.parent.mkdir()
    run(parts, keep_parts=True)
    block = min(parts.with_name("study.h5.parts").glob("*.h5"))
    return {"study": (whole, whole), "study in blocks": (parts, parts), "block": (block, parts)}
