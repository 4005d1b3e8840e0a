"""A plan as a plain dictionary with the unit in every key."""

from typing import Any

import numpy as np

from ..planning.design import MORE, Plan, Prediction


def plan_summary(plan: Plan, arm: str) -> dict[str, Any]:
    """Where sockets stand, how many poses each gets, and the predictions; the unit in every key."""
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
        "lengths": [
            {"from": length.start, "to": length.end, "value_mm": float(length.value), "u_mm": float(length.u)}
            for length in plan.lengths
        ],
        "check_length_mm": plan.check_length,
        "encoder_arcsec": np.asarray(plan.noise.encoder_arcsec).tolist(),
        "seating_mm": float(plan.noise.seating),
        "predicted": _prediction(plan.predicted),
        "loose": _prediction(plan.loose),
        "random": _prediction(plan.random),
        "more": _prediction(plan.more),
        "more_poses": MORE,
    }


def _prediction(prediction: Prediction) -> dict[str, float]:
    return {"median_mm": prediction.median, "largest_mm": prediction.largest}
