"""A plan as CSV, for people and spreadsheets, and as a plain dictionary."""

import os

import numpy as np

from ..planning.design import Plan
from .whole_file import write_text

_DIRECTION = ("probe_direction_x", "probe_direction_y", "probe_direction_z")  # the last frame's z axis


def save_plan(path: str | os.PathLike, plan: Plan) -> None:
    """Write a plan as CSV: a row a pose, with its socket, where that stands (mm), the joints' readings (deg), and the direction in which
    the probe points."""
    write_text(path, plan_csv(plan))


def plan_csv(plan: Plan) -> str:
    """The poses of a plan in the order in which to take them."""
    joints = plan.arm.joints
    lines = [",".join(["pose", "socket", "x_mm", "y_mm", "z_mm", *(f"q_{i}_deg" for i in range(1, joints + 1)), *_DIRECTION])]
    names = list(plan.sockets)
    directions = np.asarray(plan.arm.pose(plan.q))[:, :3, 2]
    rows = zip(np.degrees(plan.q), plan.owner, directions, strict=True)
    for number, (q, owner, direction) in enumerate(rows, start=1):
        point = plan.sockets[names[owner]]
        label = names[owner]
        label = '"' + label.replace('"', '""') + '"' if any(c in label for c in ',"\n') else label
        lines.append(
            ",".join(
                [str(number), label, *(f"{x:.3f}" for x in point), *(f"{x:.3f}" for x in q), *(f"{x:.2f}" for x in direction)]
            )
        )
    return "\n".join(lines) + "\n"
