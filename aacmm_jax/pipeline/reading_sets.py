"""Whether commanded or measured readings fit an arm better, where the tables of a manifest hold both."""

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord
from ..calibration.results import Calibration, Identification
from ..core.errors import IdentifiabilityWarning, InputError
from ..core.text import shorten
from ..data.capture import Capture
from ..data.recording import ReadingSet, Recording
from .single import calibrate, identify

_COMPUTED = 1e-3  # mm: no instrument measures so well
_APART = 3.0  # standard errors by which two residuals differ


def compare_reading_sets(recording: Recording) -> list[dict[str, Any]]:
    """Both sets of readings, calibrated; nothing where there is one.

    Each has the ``role``, the ``lines`` that make the manifest pick it, one for each kind of table, the RMS of all
    poses from their geometry (``rms_mm``), and whether it is ``taken`` by the manifest.
    """
    other = recording.other_readings
    if other is None:
        return []
    bounds = recording.nominal.bounds()

    def rms(capture: Capture) -> float:
        if capture.lengths or any(item.fixes_scale for item in capture.observations):
            options: dict[str, Any] = {"shared_errors": False, "undetermined": "ignore"}
            return calibrate(bounds.space.base, capture, bounds, **options).observed.rms
        return identify(bounds.space.base, capture, bounds).observed.rms

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", IdentifiabilityWarning)
            return _rows(recording, rms(recording.capture), rms(other.capture))
    except InputError:  # neither can be calibrated
        return []


def compare_points(recording: Recording, others: Sequence[ReadingSet]) -> list[dict[str, Any]]:
    """The measured points as the manifest has them, and other ways to read them, calibrated; the best first. Nothing
    where there are no others, or none can be calibrated. ``computed`` are those that agree with the arm to rounding."""
    if not others:
        return []
    bounds, rows = recording.nominal.bounds(), []
    options: dict[str, Any] = {"shared_errors": False, "undetermined": "ignore"}
    for role, capture, lines in (("points", recording.capture, ()), *others):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", IdentifiabilityWarning)
                rms = float(calibrate(bounds.space.base, capture, bounds, **options).observed.rms)
        except InputError:
            continue
        rows.append(
            {"says": role, "lines": list(lines), "rms_mm": rms, "computed": rms < _COMPUTED, "taken": not lines}
        )
    measured = sorted((row for row in rows if not row["computed"]), key=lambda row: row["rms_mm"])
    poses = len(recording.capture.readings)
    return [
        row | {"fits": not row["computed"] and not _differ(measured[0]["rms_mm"], row["rms_mm"], poses)}
        for row in [*measured, *(row for row in rows if row["computed"])]
    ]


def points_sentence(rows: Sequence[dict[str, Any]]) -> str:
    """Which points are measured, and what to write; empty where there is one way to read them."""
    if not rows:
        return ""
    texts = [f"{row['says']}: {row['rms_mm']:.3g} mm RMS" for row in rows]
    says = f"Calibrations with the columns of positions and deviations leave {'; '.join(texts)}."
    computed = next((row for row in rows if row["computed"]), None)
    if computed is not None:
        says += (
            f" Those of '{computed['says']}' agree with the arm to {computed['rms_mm']:.1g} mm: they were computed "
            "from the readings, not measured."
        )
    fitting = [row for row in rows if row["fits"]]
    if len(fitting) > 1:
        says += (
            f" {len(fitting)} ways fit equally well, but only one is right: with the wrong sign of the deviations, "
            "corrections double the errors. If their sign is not stated, correct one pose, command and measure it: its "
            "deviation must become smaller."
        )
    if fitting and not fitting[0]["taken"]:
        says += f" Write in the table of the points: {' or '.join(row['lines'][0] for row in fitting if row['lines'])}."
    return says


def _rows(recording: Recording, taken: float, other: float) -> list[dict[str, Any]]:
    """By the RMS distance of the poses from their geometry with each set, mm."""
    others = recording.other_readings
    assert others is not None
    role = "measured" if others.role == "commanded" else "commanded"
    rows = [
        {"role": role, "lines": [], "rms_mm": taken, "taken": True},
        {"role": others.role, "lines": list(others.lines), "rms_mm": other, "taken": False},
    ]
    return sorted(rows, key=lambda row: row["role"])


def reading_sets_sentence(rows: Sequence[dict[str, Any]], poses: int) -> str:
    """Which of the sets fits better, with both figures, and what to write; empty where there is one."""
    if len(rows) < 2:
        return ""
    best, other = sorted(rows, key=lambda row: row["rms_mm"])
    figures = (
        f"a calibration with the {best['role']} readings leaves residuals of {best['rms_mm']:.3g} mm RMS, and a "
        f"calibration with the {other['role']} readings leaves {other['rms_mm']:.3g} mm RMS"
    )
    if not _differ(best["rms_mm"], other["rms_mm"], poses):
        verdict = f", and both fit equally well: {figures}"
    elif best["taken"]:
        verdict = f", and the manifest uses the readings that fit better: {figures}"
    else:
        verdict = f": {figures}. To use the {best['role']} readings, write {shorten(best['lines'], 3)}"
    return f"The tables contain both commanded and measured readings{verdict}."


def _differ(best: float, other: float, poses: int) -> bool:
    """Whether residuals differ by more than chance explains."""
    # Each residual has a relative standard error of about 1 / sqrt(2 m) of m coordinates.
    return math.log(other / max(best, 1e-12)) > _APART * math.sqrt(2 / (2 * 3 * poses))


def with_other_readings(
    record: CalibrationRecord, solve: Callable[[Recording], Calibration | Identification]
) -> CalibrationRecord:
    """The calibration with a sentence on the other readings that its tables hold, where they fit better. Which ones are
    used is for the manifest to say."""
    recording = record.recording
    other = recording.other_readings
    if other is None or len(other.capture.readings) != len(recording.capture.readings):  # some are held out
        return record
    try:
        rms = float(np.asarray(solve(recording._replace(capture=other.capture, other_readings=None)).observed.rms))
    except InputError:  # the manifest's are the only ones of the arm
        return record
    if not _differ(rms, record.observed.rms, len(recording.capture.readings)):
        return record
    says = reading_sets_sentence(_rows(recording, record.observed.rms, rms), len(recording.capture.readings))
    return record._replace(decisions=(*record.decisions, says))
