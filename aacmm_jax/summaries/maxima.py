"""Decisions on the limits of ``aacmm evaluate --max-...``: passed, failed or undecided, and what would decide.

By JCGM 106:2012, a value passes where the probability that the quantity is over its limit, the specific risk of a false
acceptance, is at most 5 %, and fails where the probability that it is within is at most that. The quantity has no
prior.

An RMS distance v of f degrees of freedom says of the arm's own RMS s that f v^2 / s^2 is chi-square distributed; the
error of a length is Student's t distributed about the value found, with its u. Deltam is a largest value of the very
poses that were taken: it is compared as it is.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..acceptance.judgement import Decision
from ..acceptance.record import EvaluationRecord
from ..core.distributions import chi_square_tail, student_tail
from ..core.units import DEG
from ..kinematics.arm import joint_limits

_LIMITED = {"rms_mm": "RMS distance", "deltam_mm": "Deltam", "length_error_largest_mm": "largest length error"}
_RISK = 0.05  # of a false acceptance, and of a false rejection
_MOST = 100.0  # times as many data: more is no advice
_STEP = 1.05  # factor by which the number of data is raised in search of a decision
_GAP = 0.1  # part of a joint's travel that poses may leave out
_GROUPS = {"held_out": "held-out data", "identified_from": "the data used for identification"}


class Judged(NamedTuple):
    """A decision on one limit, in a sentence."""

    decision: Decision
    says: str


def judged_maxima(summary: Mapping[str, Any], record: EvaluationRecord) -> list[Judged]:
    """Decisions on the limits of an evaluation: of the calibrated arm, on held-out data if there are any."""
    decisions = []
    for name, limit in record.maxima.items():
        for group, where in _GROUPS.items():
            rows = summary[group] or {}
            values = rows.get("calibrated", {})
            # Of a capture with observations besides sockets, the RMS distance is that of all poses.
            key = "observed_rms_mm" if name == "rms_mm" and "observed_rms_mm" in values else name
            if key in values:
                chance, more = 1.0 if values[key] <= limit else 0.0, ""
                if name == "rms_mm":
                    chance, more = _of_rms(values[key], limit, rows, record)
                elif name == "length_error_largest_mm":
                    chance, more = _of_lengths(limit, rows, record, chance)
                decisions.append(_judged(f"{_LIMITED[name]} on {where} is {values[key]:.4f} mm", limit, chance, more))
                break
        else:
            says = f"{_LIMITED[name]} has a limit of {limit:g} mm, but cannot be determined from these data."
            decisions.append(Judged("fails", says))
    return decisions


def failed_before(summary: Mapping[str, Any], maxima: Mapping[str, float], stage: str) -> list[str]:
    """Limits that the nominal arm, or the arm as found, does not meet: on held-out data if there are any."""
    names = []
    for name, limit in maxima.items():
        for group in _GROUPS:
            values = (summary[group] or {}).get(stage, {})
            key = "observed_rms_mm" if name == "rms_mm" and "observed_rms_mm" in values else name
            if key in values:
                names += [f"{_LIMITED[name]}: {values[key]:.3g} mm"] if values[key] > limit else []
                break
    return names


def _judged(subject: str, limit: float, chance: float, more: str) -> Judged:
    if chance >= 1 - _RISK:
        return Judged("conforms", f"{subject}, within the limit of {limit:g} mm.")
    if chance <= _RISK:
        return Judged("fails", f"{subject}, over the limit of {limit:g} mm.")
    says = f"{subject}, and within the limit of {limit:g} mm with a probability of {100 * chance:.0f} %."
    return Judged("undecided", f"{says} {more}")


def _of_rms(value: float, limit: float, rows: Mapping[str, Any], record: EvaluationRecord) -> tuple[float, str]:
    """Probability that the arm's RMS distance is within its limit, and how many more poses would decide, and where."""
    counted = [row["poses"] for row in rows["sockets"] if row["poses"] > 1]
    poses = sum(counted) + sum(row["poses"] for row in rows["observations"])
    predicted = ((rows.get("predicted") or {}).get("poses") or {}).get("degrees_of_freedom")
    # Errors of the calibration move neighbouring poses alike, which makes fewer degrees of freedom.
    freedom = predicted or 3.0 * max(poses - len(counted), 1)

    def within(times: float) -> float:
        return chi_square_tail(times * freedom * (value / limit) ** 2, times * freedom) if limit else 0.0

    times = 1.0
    while _RISK < within(times) < 1 - _RISK and times < _MOST:
        times *= _STEP
    if times >= _MOST:
        return within(1.0), "It is so near the limit that no reasonable number of poses decides."
    more = math.ceil(poses * (times - 1))
    return within(1.0), f"About {more} further poses would decide if they agree as well, {_where(record)}."


def _of_lengths(limit: float, rows: Mapping[str, Any], record: EvaluationRecord, as_found: float) -> tuple[float, str]:
    """Probability that the length that is least likely within the limit is so, and what would decide."""
    lengths, freedom = rows["lengths"], 3.0 * max(sum(row["poses"] - 1 for row in rows["sockets"]), 1)
    stated = {(length.start, length.end): float(length.u) for length in record.recording.capture.lengths}
    known = [row for row in lengths if row["error_u_mm"]]
    if len(known) < len(lengths):  # nothing shows how the poses scatter
        return as_found, ""

    def within(row: Mapping[str, Any]) -> float:
        over, under = ((sign * limit - row["error_mm"]) / row["error_u_mm"] for sign in (1, -1))
        above, below = (student_tail(np.array([over, under]), np.full(2, freedom)) / 2).tolist()
        return (1 - above if over > 0 else above) - (below if under < 0 else 1 - below)

    row = min(known, key=within)
    ends, u_length = f"{row['from']} - {row['to']}", stated[row["from"], row["to"]]
    # One-sided, normal: the limit that is nearer.
    needed = abs(limit - abs(row["error_mm"])) / 1.645
    scatter = row["error_u_mm"] ** 2 - u_length**2
    if needed**2 <= u_length**2 + scatter / _MOST:
        return within(row), f"Only a smaller u of the length {ends} itself would decide (at most {needed:.2g} mm)."
    times = scatter / (needed**2 - u_length**2)
    return within(row), f"About {times:.2g} times as many poses at the ends of {ends} would decide."


def _where(record: EvaluationRecord) -> str:
    """Where further poses say most: where the largest part of a joint's travel is not covered."""
    arm, q = record.calibrated.arm, np.asarray(record.recording.capture.readings)
    gaps = []
    for joint, (low, high) in enumerate(np.asarray(joint_limits(arm, None)).tolist()):
        least, largest = float(q[:, joint].min()), float(q[:, joint].max())
        gaps += [
            ((end - begin) / (high - low), joint + 1, begin, end) for begin, end in ((low, least), (largest, high))
        ]
    size, joint, begin, end = max(gaps)
    if size < _GAP:
        return "anywhere in the working volume (see aacmm plan)"
    unit, scale = ("mm", 1.0) if joint in arm.prismatic else ("deg", 1 / DEG)
    span = f"{scale * begin:.0f} to {scale * end:.0f} {unit}"
    return f"above all with joint {joint} at {span}, where these data have no pose (see aacmm plan)"
