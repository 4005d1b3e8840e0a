"""The interactive view of the arm in its poses."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray
from ..data.capture import Capture
from ..data.observations.observation import POINT, offset_of
from ..kinematics.arm import Arm
from ..kinematics.workspace import arm_reach, skeleton
from ..plot.charts import thinned
from ..plot.residuals import Groups
from .elements import ArmView

_MOST = 150  # poses in a page
_NO_GEOMETRY: Mapping[str, Any] = {}


def view_of_arm(
    arm: Arm,
    capture: Capture,
    distances: Float[np.ndarray, " m"],
    geometry: Mapping[str, Float[AnyArray, " _"]] = _NO_GEOMETRY,
) -> ArmView:
    """The calibrated arm in the poses of a capture: marks at sockets and at the points of the geometry (centres,
    pivots), and up to 150 poses as lines from joint to joint, mm, each with its residual.

    Args:
        arm: The calibrated arm.
        capture: Its poses.
        distances: Distance of every pose from its socket's centroid or its geometry, mm; NaN where there is none.
        geometry: The parts of the unknown geometry, mm and rad, of a capture with observations besides sockets.
    """
    groups, q = Groups.of(capture), np.asarray(capture.readings)
    owner, labels, chosen = groups.owner, groups.labels, thinned(len(q), _MOST)
    tips = np.asarray(arm.position(capture.q))
    marks = {name: tips[capture.owner == i].mean(axis=0) for i, name in enumerate(capture.names)}
    lines = skeleton(arm, q[chosen])
    for i, observation in enumerate(capture.observations, start=len(capture.names)):
        points = [part for part, units in observation.unknowns.items() if units == POINT]
        # A part with certified values has its numbers in a frame of its own.
        marks |= {part: geometry[part] for part in points if part not in observation.certified}
        if observation.target:
            of_target = owner[chosen] == i
            held = arm.replace(probe=geometry[offset_of(observation.target)])
            lines[of_target] = skeleton(held, q[chosen[of_target]])
    data: dict[str, Any] = {
        "marks": [{"name": name, "at": np.round(at, 1).tolist()} for name, at in marks.items()],
        "from": "geometry" if capture.observations else "socket's centroid",
        "poses": [
            {
                "label": labels[i],
                "points": np.round(line, 1).tolist(),
                "distance": float(f"{distances[i]:.4g}") if np.isfinite(distances[i]) else None,
            }
            for i, line in zip(chosen, lines, strict=True)
        ],
        "reach": round(arm_reach(arm).radius, 1),
    }
    description = (
        "Drag, or use the arrow keys, to rotate the view; plus and minus change its size. "
        "The slider goes through the poses."
    )
    points = f", its {'points' if capture.observations else 'sockets'}" if marks else ""
    title = f"The calibrated arm{points} and its poses"
    return ArmView("scene", title, description, data)
