"""What a correction of commanded poses came to: what is reached, how far readings change, what is not reached."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.text import pluralise, shorten
from ..core.units import DEG
from ..kinematics.arm import Arm, by_joint
from ..kinematics.inverse_kinematics import FULL_POSE, ReadingsAtPoses, free_joints, least_motion
from .tables import View, formatted, listed, plain, warnings_of, written_of

_SINGULAR = 3.0  # mm a rad: 1 mm takes 20 deg of the joints; axes of a wrist are within half a degree of each other
_LARGE_CHANGE = 5.0  # deg: ten times what link errors of 1 mm and 1 mrad take where no axes align
_OUTSIDE, _OUTSIDE_SLIDE = 5.0 * DEG, 20.0  # of the range of recorded readings, mm of a prismatic joint
_MOST_ROWS = 20  # that are printed


def correction_summary(
    nominal: Arm,
    calibrated: Arm,
    q: Float[np.ndarray, "N n"],
    corrected: ReadingsAtPoses,
    *,
    unit: str,
    of_readings: bool,
    targets: Float[np.ndarray, "N 4 4"] | None = None,
    recorded: Float[np.ndarray, "M m"] | None = None,
) -> dict[str, Any]:
    """Plain values for JSON and display; rows are counted from 1.

    ``q``: commanded readings, or those that the search for a pose began with, rad and mm; perhaps with temperatures.
    ``unit``: of readings in the tables. ``of_readings``: whether readings were commanded; of positions
    without readings nothing is known of the arm without a correction. ``targets``: poses wanted, mm, of a table with
    readings; by default those of the nominal arm at the readings. ``recorded``: the readings of the calibration.
    """
    reached, after = np.asarray(corrected.reached), np.asarray(corrected.q)
    n, kinds = nominal.joints, nominal.geometry.kinds
    moving = np.ones(n, dtype=bool) if kinds is None else kinds.read > 0
    commanded, distance, angle = q[:, :n], np.asarray(corrected.distance), np.asarray(corrected.angle)
    largest = ("distance_before_mm", "distance_mm", "angle_deg", "change", "slide")
    warnings: list[str] = []
    summary: dict[str, Any] = {
        "rows": len(reached),
        "unit": unit,
        "position_only": free_joints(nominal.geometry, q) < FULL_POSE,
        **dict.fromkeys((f"largest_{name}" for name in largest), None),
        "singular": [],
        "not_reached": [],
        "warnings": warnings,
    }
    at_limit = np.zeros(after.shape, dtype=bool)
    if nominal.limits is not None:
        low, high = np.asarray(nominal.limits).T
        at_limit = ((after <= low) | (after >= high)) & moving  # where the search ended
    for row in np.flatnonzero(~reached).tolist():
        missed = {"row": row + 1, "distance_mm": distance[row], "angle_deg": angle[row] / DEG}
        summary["not_reached"].append(plain(missed | {"joints_at_limit": np.flatnonzero(at_limit[row]) + 1}))
    if summary["position_only"]:
        warnings.append(
            f"The arm has {pluralise(free_joints(nominal.geometry, q), 'joint')}, fewer than six, so only positions "
            "are corrected, not orientations."
        )
    if not reached.any():
        return summary
    beside = q[:, n : nominal.beside.own]
    outside = np.zeros(after.shape) if recorded is None else _outside(nominal, after, recorded[:, :n])
    far = np.flatnonzero(reached & np.any((outside > 0) & moving, axis=1))
    if len(far):
        joint = int(np.argmax(np.where(moving, outside[far] / by_joint(nominal, DEG, 1.0), 0.0).max(axis=0)))
        amount = outside[far, joint].max() / (1.0 if joint + 1 in nominal.prismatic else DEG)
        warnings.append(
            f"In {pluralise(len(far), 'row')} (row {shorten([str(x + 1) for x in far])}) the arm is outside the poses "
            f"of the calibration (joint {joint + 1} by up to {amount:.0f} "
            f"{'mm' if joint + 1 in nominal.prismatic else 'deg'}). There the correction is extrapolated, and its "
            "error may be larger than U. Calibrate with poses in this region, or test the correction there."
        )
    near = least_motion(nominal, np.hstack([commanded if of_readings else after, beside])) < _SINGULAR
    summary["singular"] = (np.flatnonzero(near & reached) + 1).tolist()
    if summary["singular"]:
        rows = shorten([str(row) for row in summary["singular"]])
        warnings.append(
            f"In {pluralise(len(summary['singular']), 'row')} (row {rows}) the nominal arm is at a singularity, or "
            "close to one: axes align, or the arm is fully stretched. At a singularity, the inverse kinematics of "
            "the controller has no unique solution and may choose other joint readings than the corrected ones. In "
            "these rows, command joint readings instead of poses, or avoid the poses."
        )
    summary["largest_distance_mm"] = float(distance[reached].max())
    summary["largest_angle_deg"] = float(angle[reached].max() / DEG)
    if not of_readings and targets is None:
        return summary
    targets = np.asarray(nominal.pose(q[:, : nominal.beside.own])) if targets is None else targets
    before = np.asarray(calibrated.position(q[reached])) - targets[reached, :3, 3]
    summary["largest_distance_before_mm"] = float(np.linalg.norm(before, axis=1).max())
    moved = np.where(reached[:, None], np.abs(after - commanded), 0.0)
    change, slide = (moved * np.array(by_joint(nominal, *units)) for units in ((1 / DEG, 0.0), (0.0, 1.0)))
    slides, turns = bool(nominal.prismatic), len(nominal.prismatic) < nominal.joints
    for key, exists, values, in_unit in (("change", turns, change, "deg"), ("slide", slides, slide, "mm")):
        if exists:
            row, joint = divmod(int(np.argmax(values)), nominal.joints)
            amount = {f"change_{in_unit}": float(values[row, joint])}
            summary[f"largest_{key}"] = {"row": row + 1, "joint": joint + 1} | amount
    large = np.flatnonzero(change.max(axis=1) > _LARGE_CHANGE) + 1
    if len(large) and of_readings:
        warnings.append(
            f"In {pluralise(len(large), 'row')} (row {shorten([str(x) for x in large])}) the correction changes a "
            f"reading by more than {_LARGE_CHANGE:g} deg: axes of the arm nearly align in these poses, so small "
            "corrections need large motions. Check these rows before you send an arm to these poses."
        )
    return summary


def _outside(arm: Arm, q: Float[np.ndarray, "N n"], recorded: Float[np.ndarray, "M n"]) -> Float[np.ndarray, "N n"]:
    """How far readings are outside the range of the recorded ones, rad and mm, whole revolutions aside; 0 within it or
    near it."""
    low, high = recorded.min(axis=0), recorded.max(axis=0)
    apart = q - (low + high) / 2
    apart = np.abs(np.where(by_joint(arm, True, False), apart - 2 * np.pi * np.round(apart / (2 * np.pi)), apart))
    beyond = apart - (high - low) / 2
    return np.where(beyond > by_joint(arm, _OUTSIDE, _OUTSIDE_SLIDE), beyond, 0.0)


def corrections(summary: dict[str, Any]) -> View:
    """How far poses are reached with corrected readings, and how much readings change."""
    rows, missed = summary["rows"], summary["not_reached"]
    yield f"{rows - len(missed)} of {pluralise(rows, 'pose')} are reached with corrected readings."
    yield summary["targets"]
    yield from warnings_of(summary)
    meant, has = (", ".join(f"{x:.3f}" for x in probe) for probe in summary["probe_mm"])
    if meant == has:
        yield f"Position of the tip in the last frame: ({has}) mm."
    else:
        yield (
            f"Position of the tip in the last frame: ({meant}) mm in the controller, ({has}) mm on the calibrated "
            "arm. These positions apply to the probe of the calibration; for another tool, give --probe X,Y,Z."
        )
    if len(missed) < rows:
        # Of the arithmetic, not of the arm: how far it is really off is what an evaluation with unseen data says.
        distance = formatted(summary["largest_distance_mm"])
        yield (
            "Largest distance of the tip from the commanded pose with the corrected readings, if the arm is exactly "
            f"as calibrated: {distance} mm."
        )
    if summary["largest_distance_before_mm"] is not None:
        yield (
            "Largest distance of the tip from the commanded pose without the correction: "
            f"{formatted(summary['largest_distance_before_mm'])} mm."
        )
    for key, what, unit in (("largest_change", "reading", "deg"), ("largest_slide", "slide", "mm")):
        row = summary[key]
        if row is not None:
            where = f"(joint {row['joint']}, row {row['row']})"
            yield f"Largest change of a {what}: {row[f'change_{unit}']:.4f} {unit} {where}."
    if missed:
        first = f" (the first {_MOST_ROWS}; all: --json)" if len(missed) > _MOST_ROWS else ""
        yield listed(f"Poses that are not reached{first}", missed[:_MOST_ROWS], {
            "row": "row",
            "remaining distance [mm]": "distance_mm",
            "remaining angle [deg]": "angle_deg",
            "joints at a limit": lambda row: ", ".join(map(str, row["joints_at_limit"])) or "-",
        })  # fmt: skip
    yield from written_of(summary)
