"""Plans of poses and of acceptance tests as plain dictionaries with the unit in every key."""

from typing import Any

import numpy as np

from ..acceptance.procedure import Procedure
from ..acceptance.standards import PLANNED
from ..planning.design import Plan
from ..planning.kit import KitPlan
from ..planning.predictions import MORE, Prediction
from .calibration import reference_length_rows


def plan_summary(plan: Plan, arm: str) -> dict[str, Any]:
    """Positions of the sockets, how many poses each gets, and the predicted uncertainties."""
    counts = np.bincount(plan.owner, minlength=len(plan.sockets))
    return {
        "kind": "plan",
        "arm": arm,
        "criterion": plan.criterion,
        "poses": len(plan.q),
        "sockets": [
            {"socket": name, "position_mm": list(point), "poses": int(count)}
            for (name, point), count in zip(plan.sockets.items(), counts, strict=True)
        ],
        "lengths": reference_length_rows(plan.lengths),
        "check_length_mm": plan.check_length,
        "encoder_arcsec": np.asarray(plan.noise.encoder_arcsec).tolist(),
        "seating_mm": float(plan.noise.seating),
        "predicted": _prediction(plan.predicted),
        "loose": _prediction(plan.loose),
        "random": _prediction(plan.random),
        "more": _prediction(plan.more),
        "more_poses": MORE,
    }


def kit_plan_summary(plan: KitPlan, arm: str) -> dict[str, Any]:
    """Where everything is put, how many poses each gets, the predicted uncertainties, and what each part adds."""
    rows = []
    for simulated, one, part in zip(plan.kit, plan.observations, plan.parts, strict=True):
        held = plan.arm if simulated.offset is None else plan.arm.replace(probe=simulated.offset)
        tips = np.asarray(held.position(np.asarray(one.q)))
        places = one.places
        middles = [tips[places == i].mean(axis=0).tolist() for i in range(int(places.max()) + 1)]
        rows.append(
            {
                "observation": one.name,
                "kind": one.kind,
                "part": part,
                "poses": one.q.shape[0],
                "places": [
                    {"position_mm": middle, "poses": int(np.sum(places == i))} for i, middle in enumerate(middles)
                ],
            }
        )
    return {
        "kind": "kit plan",
        "arm": arm,
        "criterion": plan.criterion,
        "poses": plan.poses,
        "observations": rows,
        "check_length_mm": plan.check_length,
        "encoder_arcsec": np.asarray(plan.noise.encoder_arcsec).tolist(),
        "seating_mm": float(plan.noise.seating),
        **{name: _prediction(getattr(plan, name)) for name in ("predicted", "loose", "random", "more")},
        "without": {name: _prediction(one) if np.isfinite(one.largest) else None for name, one in plan.without.items()},
        "more_poses": MORE,
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
