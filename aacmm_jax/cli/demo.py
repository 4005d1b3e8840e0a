"""The demonstration: the paper's arm with realistic noise, both stages, compared with the truth."""

import contextlib
import math
from pathlib import Path
from typing import Any

import numpy as np

from .. import data, files, kinematics, plot
from ..calibration.evaluation import evaluate
from ..calibration.record import CalibrationRecord
from ..core.errors import InputError, MissingExtra, require
from ..core.text import shorten
from ..files.inputs import fingerprint
from ..files.outputs import together
from ..pipeline.capture_calibration import calibrate_capture
from ..summaries.calibration import calibration_summary, capture_summary

_ARM, _TRUE = "cheng2018-simulation", ", true"  # what the name of the true arm ends in
_DEVIATION_MM, _DEVIATION_DEG = 1.0, 0.1
_NOISE = data.Noise(encoder_arcsec=2.0, seating=0.005)
_LENGTH_U_MM = 0.002
_SOCKETS, _POSES = {"A": (400.0, 200.0, 300.0), "B": (700.0, 500.0, 500.0)}, {"A": 70, "B": 10}
_CHECKS, _CHECK_MM = 30, 300.0
_CAPTURE, _CALIBRATION, _FIGURE, _REPORT = "capture.h5", "calibration.h5", "calibration.png", "report.html"
_EXTRAS = {_FIGURE: "plot", _REPORT: "report"}  # what these files need
_FILES = (_CAPTURE, _CALIBRATION, "nominal.toml", "true.toml", "calibrated.toml", *_EXTRAS)


def run(folder: Path, seed: int) -> dict[str, Any]:
    """Simulate, calibrate, compare, and leave capture, calibration, arms, a figure and a report in ``folder``; without
    the extra that figure or report need, the summary says so, and the rest is made."""
    from ..report import write_report

    nominal = files.load_specification(_ARM)
    true_name, left_out = nominal.name + _TRUE, {}
    _prepare(folder, true_name)
    for name, extra in _EXTRAS.items():
        try:
            require(extra, name)
        except MissingExtra as error:
            left_out[name] = str(error)
            (folder / name).unlink(missing_ok=True)  # of an earlier demonstration
    made = [name for name in _FILES if name not in left_out]
    with together(*(folder / name for name in made if name != _REPORT)):
        deviation = {"length": _DEVIATION_MM, "angle": math.radians(_DEVIATION_DEG)}
        true = nominal._replace(arm=kinematics.perturbed_arm(nominal.space(), **deviation, seed=seed), name=true_name)
        lengths = [("A", "B", _LENGTH_U_MM)]
        capture = data.simulate(true.arm, _SOCKETS, poses=_POSES, lengths=lengths, noise=_NOISE, seed=seed)
        recording = data.Recording(capture, nominal, true, seed, usual=files.usual_noise(_ARM))
        files.save_capture(folder / _CAPTURE, recording, capture_summary(recording))
        record = calibrate_capture(recording._replace(sources=(fingerprint(folder / _CAPTURE),)))
        whole = calibration_summary(record)
        files.save_calibration(folder / _CALIBRATION, record, whole)
        for name, specification in (("nominal", nominal), ("true", true), ("calibrated", record.calibrated)):
            files.save_arm(specification.arm, folder / f"{name}.toml", name=specification.name)
        if _FIGURE in made:
            plot.save_calibration_figure(record, folder / _FIGURE)
        checks = _checks(record, seed)
    if _REPORT in made:
        write_report(folder / _CALIBRATION, folder / _REPORT)  # of a file that has to be there
    return {
        "kind": "demo",
        "poses": capture.sizes[0],
        "more_poses": capture.sizes[1],
        "deviation_mm": _DEVIATION_MM,
        "deviation_deg": _DEVIATION_DEG,
        "encoder_arcsec": float(_NOISE.encoder_arcsec),
        "seating_um": 1e3 * float(_NOISE.seating),
        "length_mm": float(capture.lengths[0].value),
        "length_u_um": 1e3 * _LENGTH_U_MM,
        "checks": _CHECKS,
        "check_length_mm": _CHECK_MM,
        "scale_k": record.k,
        "scale_u": record.u_k,
        **{stage: whole[stage] | whole["truth"][stage] | {"check_rms_mm": rms} for stage, rms in checks.items()},
        "folder": str(folder),
        "files": made,
        "left_out": left_out,
    }


def _prepare(folder: Path, true_name: str) -> None:
    """Make the folder, or make sure that all that is in it was left by an earlier demonstration."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        there = sorted(item.name for item in folder.iterdir() if not item.name.endswith(".part"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{folder} cannot be used as a folder: {reason}; name another folder.") from error
    foreign = [name for name in there if name not in _FILES]
    if there and not foreign:
        with contextlib.suppress(InputError):
            true = files.load_capture(folder / _CAPTURE).true
            if true is not None and true.name == true_name:
                return
        foreign = there
    if foreign:
        raise InputError(
            f"{folder} contains files that aacmm demo did not write ({shorten(foreign)}); name a new or an empty "
            "folder."
        )


def _checks(record: CalibrationRecord, seed: int) -> dict[str, float]:
    """RMS error of lengths that were not used, all over the volume, measured with the same noise by each arm."""
    random = np.random.default_rng(seed)
    sockets = {}
    for i in range(_CHECKS):
        middle = np.array([500.0, 300.0, 400.0]) + random.uniform(-250, 250, 3)
        direction = random.normal(size=3)
        half = 0.5 * _CHECK_MM * direction / np.linalg.norm(direction)
        sockets[f"{i}-"], sockets[f"{i}+"] = tuple(middle - half), tuple(middle + half)
    pairs = [(f"{i}-", f"{i}+") for i in range(_CHECKS)]
    assert record.recording.true is not None
    true = record.recording.true.arm
    capture = data.simulate(true, sockets, poses=1, lengths=pairs, noise=_NOISE, seed=seed + 1)
    arms = {"nominal": record.recording.nominal, "stage1": record.stage1, "calibrated": record.calibrated}
    return {
        stage: float(np.sqrt(np.mean(np.asarray(evaluate(specification.arm, capture).error) ** 2)))
        for stage, specification in arms.items()
    }
