"""An arm looked at before its first calibration: joints, reach, what data determine, what a first capture needs."""

from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..core.text import pluralise, shorten
from ..core.units import ARCSEC
from ..data.noise import ArmNoise
from ..kinematics.arm import Arm, correction_names, joint_limits, without_corrections
from ..kinematics.axes_to_dh import Transform, dh_frames, geometry_of, tip_frame
from ..kinematics.corrected_arm import function_values, loads_of
from ..kinematics.corrections import terms_of
from ..kinematics.parameters import ArmSpecification, Parameters
from ..kinematics.workspace import arm_reach, closest_approach, total_link_length
from ..planning.first_capture import U_LENGTH, U_TRACKER, Expected, determined_by, first_capture, still_joints
from ..uncertainty.identifiability import Observability
from .calibration import arm_summary
from .tables import attributes, plain

_SHORTEST, _LONGEST = 20.0, 20_000.0  # mm: of an arm's links together
_SHOWN = (15, 30, 60, 120)  # poses
_NO_MOMENT = (
    "Gravity has no moment about joint {joint}, because the axis of this joint is vertical or passes through the "
    "load; left out: {names}."
)
_OTHERS = "Functions left out, because each is constant or a combination of other functions of the same joint: {names}."


def arm_survey(
    specification: ArmSpecification, usual: ArmNoise, *, base: Transform | None = None, model: str | None = None
) -> dict[str, Any]:
    """Plain values for JSON and display.

    ``base``: the first frame in a robot's base link, mm; frames are in the base link then. ``model``: that the arm's
    corrections are of, where one was named.
    """
    arm: Arm = to_numpy(specification.arm)
    plain_arm, links = without_corrections(arm), total_link_length(arm)
    reach = arm_reach(plain_arm)
    base = np.eye(4) if base is None else base
    geometry = geometry_of(plain_arm)
    # Where the axis of each joint is at readings of zero, and the tip.
    frames = [*dh_frames(geometry, base)[:-1], tip_frame(geometry, base)]
    summary = arm_summary(specification) | {
        "frames": [
            {"joint": joint, "origin_mm": frame[:3, 3].tolist(), "axis": (np.round(frame[:3, 2], 12) + 0.0).tolist()}
            for joint, frame in zip([*range(1, arm.joints + 1), None], frames, strict=True)
        ],
        "reach_mm": {
            "shoulder": (base[:3, :3] @ reach.shoulder + base[:3, 3]).tolist(),
            "farthest": reach.radius,
            "nearest": closest_approach(plain_arm),
            "links": links,
        },
        "corrections_left_out": _left_out(arm, model),
        **{name: [] for name in ("redundant", "weak", "parallel", "free", "fixed", "determined", "still", "needed")},
        "advice": "",
        "warnings": [],
    }
    if not _SHORTEST <= links <= _LONGEST:
        summary["warnings"].append(
            f"The total length of the links is {links:.4g} mm, which is implausible; check the unit of the lengths."
        )
    if arm.limits is None:
        summary["warnings"].append(
            "No joint limits are given, so joints are assumed to move from -180 to 180 deg; add the limits."
        )
    try:
        best, chosen, still = determined_by(arm), Parameters.independent(arm), still_joints(arm)
        seen = best["sockets and a reference length"]
        summary |= {
            "parameters": len(seen.names),
            # What no data on the tip can separate, whatever is recorded.
            "redundant": [text for text, always in zip(seen.undetermined, seen.structural, strict=True) if always],
            "weak": [trade_off.text for trade_off in seen.trade_offs],
            "parallel": list(seen.parallel),
            "free": list(chosen.names),
            "fixed": [name for name in chosen.held if not name.startswith("beta_")],
            "determined": [_determined_row(data, row) for data, row in best.items()],
            "still": [
                {"joint": joint, "lost": None if lost is None else list(lost)} for joint, lost in enumerate(still, 1)
            ],
        }
        u_reading, expected = first_capture(arm, usual.noise)
        moving = [str(joint) for joint, lost in enumerate(still, 1) if lost is None or lost]
        needed = _needed(usual, u_reading, expected)
        summary |= {"needed": [needed], "advice": _advice(expected, moving, arm.joints)}
    except InputError as error:
        summary["warnings"].append(
            f"The amount of data that a calibration needs cannot be computed for this arm: {error}"
        )
    return summary


def _left_out(arm: Arm, model: str | None) -> list[str]:
    """Terms of a model that the arm's corrections leave out, and why."""
    if model is None or arm.corrections is None:
        return []
    loads, left = loads_of(arm), correction_names(arm)
    gone = [term for term in terms_of(model, arm.joints, loads) if term.name not in left]
    if not gone:
        return []
    limits = joint_limits(arm, None)
    q = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (50, arm.joints))
    values = function_values(arm, gone, q)
    why: dict[tuple[int, str], list[str]] = {}
    for term, row in zip(gone, values, strict=True):
        reason = _OTHERS if np.abs(row).max() > 1e-9 else _NO_MOMENT
        why.setdefault((0 if reason == _OTHERS else term.joint, reason), []).append(term.name)
    return [reason.format(joint=joint, names=shorten(names)) for (joint, reason), names in why.items()]


def _determined_row(data: str, seen: Observability) -> dict[str, Any]:
    return {
        "data": data,
        "determined": seen.rank,
        "well_determined": seen.rank - len(seen.trade_offs),
        "scale": not any("the scale" in text for text in seen.undetermined),
        "undetermined": list(seen.undetermined),
        "corrections": list(seen.corrections),
        "poorly_determined": [trade_off.text for trade_off in seen.trade_offs],
    }


def _needed(usual: ArmNoise, u_reading: float, expected: list[Expected]) -> dict[str, Any]:
    return {
        "class": usual.arm_class,
        "u_reading_mm": u_reading,
        "noise_source": usual.source,
        "u_length_mm": U_LENGTH,
        "u_tracker_mm": U_TRACKER,
        "encoder_arcsec": float(np.max(np.asarray(usual.noise.encoder))) / ARCSEC,
        "seating_mm": float(usual.noise.seating),
        "rows": [
            {
                **attributes(row, "data", "sockets", enough_poses="enough"),
                "lengths": row.sockets // 2,
                "u_mm": {str(count): plain(row.u[count]) for count in _SHOWN},
            }
            for row in expected
        ],
    }


def _advice(expected: list[Expected], moving: list[str], joints: int) -> str:
    """What to record, in a sentence or two: the fewest sockets of which some number of poses is enough."""
    rows = [(row.enough, row.sockets, row) for row in expected if row.sockets and row.enough is not None]
    if not rows:
        return (
            "Random poses in sockets do not determine this arm well; use a tracker, or let aacmm plan choose the poses."
        )
    poses, _, best = min(rows, key=lambda row: row[:2])
    to_move = f"The following joints must move: {shorten(moving, 20)}." if moving else ""
    to_move = "Every joint must move." if len(moving) == joints else to_move
    tracked = "".join(
        f" With a tracker, record {pluralise(2 * row.enough, 'pose')} spread over the whole workspace."
        for row in expected
        if not row.sockets and row.enough is not None
    )
    return (
        f"Record {2 * poses} poses, as different as possible, in {best.data}. With {pluralise(poses, 'pose')} or "
        "more, the calibration contributes less to the uncertainty of a measured length than the noise of the "
        f"readings does; the remaining poses serve to check the calibration.{tracked} {to_move}"
    )
