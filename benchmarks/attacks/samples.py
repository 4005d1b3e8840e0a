"""One good file of every kind, small: what the attacks start from."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import aacmm_jax as aj
from aacmm_jax.study.blocks import computed_with
from aacmm_jax.study.store import write_block
from aacmm_jax.study.trials import run_block
from aacmm_jax.summaries.compared_models import compared_models_summary

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
_BOX, _FRAME = [[250, -200, 200], [550, 250, 450]], (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
_BAR = {"a": (0.0, 0.0, 0.0), "b": (200.0, 0.0, 0.0)}
BLOCK = 3  # trials in a block of the study


class Results(NamedTuple):
    """Results of every kind in Python, and functions that write each of them into a file."""

    arm: "aj.kinematics.ArmSpecification"
    recording: aj.Recording
    observed: aj.Recording  # of observations of every kind
    record: Any  # of the calibration
    writers: dict[str, Callable[[Path], Any]]


def simulated() -> list[Any]:
    """Observations of every kind, to simulate. Checking them computes in JAX, which `writes` must not have done."""
    return [
        aj.data.observations.SimulatedPoints("T", _BOX, 8, _FRAME, u=0.01, target="SMR", place=(10.0, 20.0, 60.0)),
        aj.data.observations.SimulatedTransforms("T6", _BOX, 8, (10, 20, 80, 0.1, 0.2, 0.3), _FRAME, u=0.01),
        aj.data.observations.SimulatedSphere("sphere", (400, 0, 300), 50.0, 8, u=0.001, stylus=6.0),
        aj.data.observations.SimulatedCylinder("ring", [(400, 0, 300), (410, 0, 340)], 80.0, 8, u=0.001, inside=True),
        aj.data.observations.SimulatedPlanes("wall", (300, -200, 200), [(0, 300, 0), (0, 0, 200)], 8),
        aj.data.observations.SimulatedPlanes("block", (300, -200, 200), [(200, 0, 0), (0, 300, 0)], 5, 80.0, 0.001),
        aj.data.observations.SimulatedArtefact("bar", _BAR, 5, (0, 0, 0.3, 350, -100, 250), u=0.001, index="1"),
        aj.data.observations.SimulatedDistances("wire", _BOX, 8, (900, 300, 100), u=0.003),
    ]


def results() -> Results:
    """A capture of three sockets and one of every kind of observation, their calibrations, and what is made of them."""
    arm = aj.files.load_specification("cheng2018-simulation")
    sockets = {"A": (400, 200, 300), "B": (300, 350, 300), "C": (300, -350, 400)}
    capture = aj.simulate(arm.arm, sockets, poses=14, lengths=[("A", "B", 0.002)], encoder_arcsec=2.0, seed=1)
    recording = aj.Recording(capture, arm, arm, seed=1)
    record = aj.calibration.record_of(aj.calibrate(arm.arm, capture, arm.bounds()), recording)
    evaluation = aj.evaluate_capture(record, recording, maxima={"rms_mm": 0.1})
    noise = aj.Noise(encoder_arcsec=2.0, seating=0.005)
    points = {"A": sockets["A"]}
    observed = aj.simulate(arm.arm, points, poses=8, observations=simulated(), noise=noise, seed=1)
    observed_recording = aj.Recording(observed, arm, arm, seed=1)
    few = aj.Parameters(arm.arm, ("a_2", "d_4", "theta_2", "theta_3"))
    found = aj.calibrate(arm.arm, observed, aj.Bounds.around(arm.arm, few), noise=noise)
    observed_record = aj.calibration.record_of(found, observed_recording)
    tips = {name: np.asarray(arm.arm.position(q)) for name, q in capture.sockets.items()}
    measured = aj.acceptance.PointsRecord(aj.acceptance.Measured(tips, capture.lengths, ()))
    models = aj.compare_models(arm.arm, capture, arm.bounds(), models=["dh", "harmonics=1"])
    compared = compared_models_summary(models, arm.name) | {"poses": sum(map(len, capture.sockets.values()))}
    writers = {
        "capture": lambda path: aj.files.save_capture(path, recording),
        "calibration": lambda path: aj.files.save_calibration(path, record),
        "observations": lambda path: aj.files.save_capture(path, observed_recording),
        "calibration from observations": lambda path: aj.files.save_calibration(path, observed_record),
        "evaluation": lambda path: aj.files.save_evaluation(path, evaluation),
        "points": lambda path: aj.files.save_evaluation(path, measured),
        "compared models": lambda path: aj.files.save_compared_models(path, compared, ["capture.h5"], 1),
    }
    return Results(arm, recording, observed_recording, record, writers)


READERS: dict[str, Callable[[Path], Any]] = {
    "capture": aj.files.load_capture,
    "calibration": aj.files.load_calibration,
    "observations": aj.files.load_capture,
    "calibration from observations": aj.files.load_calibration,
    "evaluation": aj.files.load_evaluation,
    "points": aj.files.load_evaluation,
    "compared models": aj.files.load_compared_models,
}


def study_results(path: Path) -> Any:
    """All results of a study: whether it is finished, and every column of every cell."""
    results = aj.study.Results.of(path)
    cells = range(len(results.study.cells))
    return results.finished, [results.columns(cell) for cell in cells], [list(results.errors(cell)) for cell in cells]


def make(folder: Path) -> None:
    """One file of each kind, in a folder; a small study runs twice: to its end, and with its blocks kept."""
    for kind, write in results().writers.items():
        write(folder / f"{kind}.h5")
    (folder / "study.toml").write_text(STUDY)
    study = aj.study.read_study(folder / "study.toml")
    aj.study.run_study(study, folder / "study.h5", chunk=BLOCK)
    (folder / "parts").mkdir()
    stored = aj.study.Results(folder / "parts" / "study.h5", study, BLOCK, computed_with())
    stored.create()
    for block in stored.blocks:
        write_block(stored.file_of(block), run_block(study, block))


def studies(folder: Path) -> dict[str, tuple[Path, Path]]:
    """Those studies: for each kind the file that is attacked, and the study that is read with it."""
    whole, parts = folder / "study.h5", folder / "parts" / "study.h5"
    block = min(parts.with_name("study.h5.parts").glob("*.npz"))
    return {"study": (whole, whole), "study in blocks": (parts, parts), "block": (block, parts)}
