"""The interactive view of the arm in its poses."""

from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..data.capture import Capture
from ..kinematics.arm import Arm
from ..kinematics.workspace import arm_reach, skeleton
from .elements import ArmView
from .residuals import pose_distances

_MOST = 150  # poses in a page


def view_of_arm(arm: Arm, capture: Capture, evaluation: Evaluation) -> ArmView:
    """The calibrated arm in the poses of a capture.

    The data are the sockets, and up to 150 poses as lines from joint to joint, mm, each with its tip's distance from
    the centroid of its socket (None for a single pose).
    """
    owner, distances = capture.owner, pose_distances(capture, evaluation)
    chosen = np.arange(len(owner))
    if len(chosen) > _MOST:
        chosen = np.unique(np.linspace(0, len(chosen) - 1, _MOST).round().astype(int))
    first = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    tips = np.asarray(arm.position(capture.q))
    data: dict[str, Any] = {
        "sockets": [
            {"name": name, "at": np.round(tips[owner == i].mean(axis=0), 1).tolist()}
            for i, name in enumerate(capture.names)
        ],
        "poses": [
            {
                "label": f"{capture.names[owner[i]]}, pose {i - first[owner[i]] + 1}",
                "points": np.round(line, 1).tolist(),
                "distance": float(f"{distances[i]:.4g}") if np.isfinite(distances[i]) else None,
            }
            for i, line in zip(chosen, skeleton(arm, np.asarray(capture.q)[chosen]), strict=True)
        ],
        "reach": round(arm_reach(arm).radius, 1),
        "all": len(capture.q),
    }
    description = (
        "Drag, or use the arrow keys, to rotate the view; plus and minus change its size. "
        "The slider goes through the poses."
    )
    return ArmView("scene", "The calibrated arm, its sockets and its poses", description, data)
