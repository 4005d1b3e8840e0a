"""Plans of poses and of acceptance tests as plain dictionaries with the unit in every key."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..acceptance.procedure import Procedure
from ..acceptance.standards import PLANNED
from ..data.noise import linear_encoder_mm
from ..kinematics.collisions import Cell
from ..planning.design import Plan
from ..planning.kit import KitPlan
from ..planning.motion import Motion
from ..planning.problem import MORE, Prediction
from .calibration import reference_length_rows


def plan_summary(plan: Plan, arm: str) -> dict[str, Any]:
    """Positions of the sockets, how many poses each gets, and the predicted uncertainties."""
    rows = [
        {
            "socket": name,
            "position_mm": list(point),
            "poses": int(np.sum(plan.owner == i)),
            "normal": plan.cones.normals[i].tolist(),
            "cone_deg": math.degrees(float(plan.cones.half_angles[i])),
            "largest_tilt_deg": math.degrees(float(plan.motion.tilt[plan.owner == i].max())),
        }
        for i, (name, point) in enumerate(plan.sockets.items())
    ]
    stated = _plan_rows(plan, arm, [plan.motion], list(plan.sockets), plan.owner)
    return {"kind": "plan", **stated, "sockets": rows, "lengths": reference_length_rows(plan.lengths)}


def kit_plan_summary(plan: KitPlan, arm: str) -> dict[str, Any]:
    """Where everything is put, how many poses each gets, the predicted uncertainties, and what each part adds."""
    rows = []
    for simulated, observation, part in zip(plan.kit, plan.observations, plan.parts, strict=True):
        held = plan.arm if simulated.offset is None else plan.arm.replace(probe=simulated.offset)
        tips, places = np.asarray(held.position(np.asarray(observation.q))), observation.places
        put = [
            {"position_mm": tips[places == i].mean(axis=0).tolist(), "poses": int(np.sum(places == i))}
            for i in range(int(places.max()) + 1)
        ]
        row = {"observation": observation.name, "kind": observation.kind, "part": part}
        rows.append(row | {"poses": observation.q.shape[0], "places": put})
    names = [row["observation"] for row in rows]
    owner = np.repeat(np.arange(len(rows)), [row["poses"] for row in rows])
    without = {name: _prediction(u) if np.isfinite(u.largest) else None for name, u in plan.without.items()}
    stated = _plan_rows(plan, arm, list(plan.motions), names, owner)
    return {"kind": "kit plan", **stated, "observations": rows, "without": without}


def _plan_rows(
    plan: Plan | KitPlan, arm: str, motions: Sequence[Motion], names: Sequence[str], owner: np.ndarray
) -> dict[str, Any]:
    """What both kinds of plans state: the noise assumed, how the arm moves, and the predicted uncertainties."""
    return {
        "arm": arm,
        "criterion": plan.criterion,
        "poses": len(owner),
        "check_length_mm": plan.check_length,
        "encoder_arcsec": np.asarray(plan.noise.encoder_arcsec).tolist(),
        "linear_encoder_mm": linear_encoder_mm(plan.noise, plan.arm),
        "seating_mm": float(plan.noise.seating),
        "unconstrained": None if plan.unconstrained is None else _prediction(plan.unconstrained),
        **_motion_summary(motions, plan.cell, plan.retract, names, owner),
        **{name: _prediction(getattr(plan, name)) for name in ("predicted", "loose", "random", "more")},
        "more_poses": MORE,
    }


def _motion_summary(
    motions: Sequence[Motion], cell: Cell | None, retract: float, names: Sequence[str], owner: np.ndarray
) -> dict[str, Any]:
    """How the arm moves: largest tilt, smallest clearance, travel, and moves that hit something, by pose number."""
    first = np.cumsum([0, *(len(motion.tilt) for motion in motions)])
    blocked = [
        {"before_pose": int(start) + index + 1, "at": names[owner[int(start) + index]], "between": [one, other]}
        for start, motion in zip(first[:-1], motions, strict=True)
        for index, one, other in motion.blocked
    ]
    tilts = np.concatenate([np.zeros(0), *(motion.tilt[np.isfinite(motion.tilt)] for motion in motions)])
    clearances = [motion.clearance.min() for motion in motions if motion.clearance is not None]
    return {
        "largest_tilt_deg": float(np.degrees(tilts.max())) if len(tilts) else None,
        "retract_mm": retract if any(motion.approach is not None for motion in motions) else 0.0,
        "travel_deg": math.degrees(sum(motion.travel for motion in motions)),
        "unordered_travel_deg": math.degrees(sum(motion.unordered for motion in motions)),
        "collisions": None
        if cell is None
        else {
            "smallest_clearance_mm": float(min(clearances)),
            "allowed_clearance_mm": cell.clearance,
            "obstacles": [obstacle.name for obstacle in cell.obstacles],
            "unchecked": [list(pair) for pair in cell.unchecked],
            "blocked_moves": blocked,
        },
    }


def _prediction(prediction: Prediction) -> dict[str, float]:
    return {"median_mm": prediction.median, "largest_mm": prediction.largest}


def procedure_summary(procedure: Procedure, arm: str) -> dict[str, Any]:
    """A planned acceptance test: what to set up, and how many poses to take."""
    lengths: dict[float, int] = {}
    for *_, value in procedure.lengths:
        lengths[value] = lengths.get(value, 0) + 1
    return {
        "kind": "acceptance plan",
        "arm": arm,
        "standard": PLANNED[procedure.standard],
        "poses": procedure.poses,
        "reach_mm": procedure.reach.radius,
        "measuring_range_mm": procedure.measuring_range,
        "measuring_range_stated": procedure.range_stated,
        "shoulder_mm": procedure.reach.shoulder.tolist(),
        "bars": [{"length_mm": value, "positions": count} for value, count in lengths.items()],
        "spheres": [
            {
                "name": sphere.name,
                "test": sphere.test,
                "diameter_mm": sphere.diameter,
                "centre_mm": sphere.centre.tolist(),
            }
            for sphere in procedure.spheres
        ],
        "items": [
            {
                "test": item.test,
                "name": item.name,
                "group": item.group,
                "position_mm": item.points.mean(axis=0).tolist(),
                "poses": len(item.q),
            }
            for item in (*procedure.sockets, *procedure.touches)
        ],
        "warnings": list(procedure.left_out),
    }
