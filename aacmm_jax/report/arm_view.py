"""The arm in its poses, as points in space: what the report turns under the mouse."""

from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..data.capture import Capture
from ..kinematics.arm import Arm
from ..kinematics.workspace import arm_reach, skeleton
from .elements import Arms
from .residuals import shared_distances

_MOST = 150  # poses that a page holds


def arms_of(arm: Arm, capture: Capture, evaluation: Evaluation) -> Arms:
    """The calibrated arm in the poses of a capture, to be turned."""
    words = "Drag, or use the arrow keys, to turn it; plus and minus change its size. The slider goes through the poses."
    data = scene_of(arm, capture, shared_distances(capture, evaluation))
    return Arms("scene", "The calibrated arm, its sockets and its poses", words, data)


def scene_of(arm: Arm, capture: Capture, distances: np.ndarray) -> dict[str, Any]:
    """Sockets, and up to 150 poses as lines from joint to joint, mm; each with its tip's distance from its socket's centroid."""
    owner = capture.owner
    chosen = _chosen(np.asarray(capture.sizes))
    q = np.asarray(capture.q)[chosen]
    lines = skeleton(arm, q)
    first = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    tips = np.asarray(arm.position(capture.q))
    return {
        "sockets": [
            {"name": name, "at": np.round(tips[owner == i].mean(axis=0), 1).tolist()} for i, name in enumerate(capture.names)
        ],
        "poses": [
            {
                "label": f"{capture.names[owner[i]]}, pose {i - first[owner[i]] + 1}",
                "points": np.round(line, 1).tolist(),
                "distance": float(f"{distances[i]:.4g}") if np.isfinite(distances[i]) else None,  # None: alone in its socket
            }
            for i, line in zip(chosen, lines, strict=True)
        ],
        "reach": round(arm_reach(arm).radius, 1),
        "all": len(capture.q),
    }


def _chosen(sizes: np.ndarray) -> np.ndarray:
    """Which poses: all, or some evenly spread over them."""
    total = int(sizes.sum())
    if total <= _MOST:
        return np.arange(total)
    return np.unique(np.linspace(0, total - 1, _MOST).round().astype(int))
