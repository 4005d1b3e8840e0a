"""What a correction of commanded poses came to: what is reached, how far readings change, what is not reached."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ..core.text import pluralise, shorten
from ..core.units import DEG
from ..kinematics.arm import Arm, by_joint
from ..kinematics.inverse_kinematics import FULL_POSE, ReadingsAtPoses, least_motion

_SINGULAR = 3.0  # mm a rad: 1 mm takes 20 deg of the joints; axes of a wrist are within half a degree of each other
_LARGE_CHANGE = 5.0  # deg: ten times what link errors of 1 mm and 1 mrad take where no axes align


def correction_summary(
    nominal: Arm,
    calibrated: Arm,
    q: Float[np.ndarray, "N n"],
    found: ReadingsAtPoses,
    *,
    unit: str,
    of_readings: bool,
) -> dict[str, Any]:
    """Plain values for JSON and display; rows are counted from 1.

    Args:
        nominal: The arm that the controller has.
        calibrated: The calibrated arm.
        q: Commanded readings, or those that the search for a pose began with, rad and mm; perhaps with temperatures.
        found: The corrected readings.
        unit: Of readings in the tables, deg or rad.
        of_readings: Whether readings were commanded; of positions with orientations nothing is known of the arm
            without a correction.
    """
    reached = np.asarray(found.reached)
    summary: dict[str, Any] = {
        "rows": len(reached),
        "unit": unit,
        "position_only": nominal.joints < FULL_POSE,
        "largest_distance_before_mm": None,
        "largest_distance_mm": None,
        "largest_angle_deg": None,
        "largest_change": None,
        "largest_slide": None,
        "singular": [],
        "not_reached": [_missed(nominal, found, row) for row in np.flatnonzero(~reached).tolist()],
        "warnings": [],
    }
    if summary["position_only"]:
        summary["warnings"].append(
            f"the arm has {pluralise(nominal.joints, 'joint')}, fewer than six, so positions alone are corrected, not "
            "orientations."
        )
    if not reached.any():
        return summary
    summary["singular"] = _singular(nominal, q[:, : nominal.joints] if of_readings else np.asarray(found.q), reached)
    if summary["singular"]:
        rows = shorten([str(row) for row in summary["singular"]])
        summary["warnings"].append(
            f"In {pluralise(len(summary['singular']), 'row')} (row {rows}) the nominal arm is singular, or nearly so: "
            "axes align, or it is stretched. Its controller's inverse has no unique answer there, and may take other "
            "readings for such a pose than these; command readings there, not poses, or keep away from it."
        )
    summary["largest_distance_mm"] = float(np.asarray(found.distance)[reached].max())
    summary["largest_angle_deg"] = float(np.asarray(found.angle)[reached].max() / DEG)
    if of_readings:
        before = np.asarray(calibrated.position(q[reached]))
        q = q[:, : nominal.joints]
        before = before - np.asarray(nominal.position(q[reached]))
        summary["largest_distance_before_mm"] = float(np.linalg.norm(before, axis=1).max())
        moved = np.where(reached[:, None], np.abs(np.asarray(found.q) - q), 0.0)
        change, slide = (moved * np.array(by_joint(nominal, *of)) for of in ((1 / DEG, 0.0), (0.0, 1.0)))
        if len(nominal.prismatic) < nominal.joints:
            row, joint = divmod(int(np.argmax(change)), nominal.joints)
            summary["largest_change"] = {"row": row + 1, "joint": joint + 1, "change_deg": float(change[row, joint])}
        if nominal.prismatic:
            row, joint = divmod(int(np.argmax(slide)), nominal.joints)
            summary["largest_slide"] = {"row": row + 1, "joint": joint + 1, "change_mm": float(slide[row, joint])}
        large = np.flatnonzero(change.max(axis=1) > _LARGE_CHANGE) + 1
        if len(large):
            summary["warnings"].append(
                f"{pluralise(len(large), 'row')} (row {shorten([str(x) for x in large])}) changed a reading by more "
                f"than {_LARGE_CHANGE:g} deg: near there axes of the arm align, and small corrections take large "
                "motions; look at them before an arm is sent there."
            )
    return summary


def _singular(nominal: Arm, q: Float[np.ndarray, "N n"], reached: Bool[np.ndarray, " N"]) -> list[int]:
    """Rows, from 1, near a singular configuration."""
    near = least_motion(nominal, q) < _SINGULAR
    return (np.flatnonzero(near & reached) + 1).tolist()


def _missed(nominal: Arm, found: ReadingsAtPoses, row: int) -> dict[str, Any]:
    """How far a pose is missed, and which joints are at a limit where the search ended."""
    q = np.asarray(found.q)[row]
    at_limit = []
    if nominal.limits is not None:
        low, high = np.asarray(nominal.limits).T
        at_limit = (np.flatnonzero((q <= low) | (q >= high)) + 1).tolist()
    return {
        "row": row + 1,
        "distance_mm": float(np.asarray(found.distance)[row]),
        "angle_deg": float(np.asarray(found.angle)[row] / DEG),
        "joints_at_limit": at_limit,
    }
