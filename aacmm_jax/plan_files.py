"""A plan as CSV, for people and spreadsheets, and as a plain dictionary."""

import os
from typing import Any

import numpy as np

from . import storage
from .planning import MORE, Plan, Prediction


def save_plan(path: str | os.PathLike, plan: Plan) -> None:
    """Write a plan as CSV: a row a pose, with its socket, where that stands (mm), and the joints' readings (deg)."""
    storage.write_text(path, plan_csv(plan))


def plan_csv(plan: Plan) -> str:
    """The poses of a plan in the order in which to take them."""
    joints = plan.arm.joints
    lines = [",".join(["pose", "socket", "x_mm", "y_mm", "z_mm", *(f"q_{i}_deg" for i in range(1, joints + 1))])]
    names = list(plan.sockets)
    for number, (q, owner) in enumerate(zip(np.degrees(plan.q), plan.owner, strict=True), start=1):
        point = plan.sockets[names[owner]]
        label = names[owner]
        label = '"' + label.replace('"', '""') + '"' if any(c in label for c in ',"\n') else label
        lines.append(",".join([str(number), label, *(f"{x:.3f}" for x in point), *(f"{x:.4f}" for x in q)]))
    return "\n".join(lines) + "\n"


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
