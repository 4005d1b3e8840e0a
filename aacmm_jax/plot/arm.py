"""The figure of an arm in space."""

from typing import Any

import numpy as np

from ..core.arrays import Numbers
from ..core.errors import InputError
from ..kinematics.arm import Arm
from ..kinematics.workspace import skeleton
from .style import ACCENT, DARK, LIGHT


def arm_poses(arm: Arm, q: Numbers, axes: Any = None) -> Any:
    """Plot an arm in its poses as lines from joint to joint, mm; the first pose is dark.

    Args:
        arm: The arm.
        q: Joint readings, rad, of shape ``(poses, joints)`` or ``(joints,)``.
        axes: Three-dimensional axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If the axes are not three-dimensional, or ``q`` does not fit the arm.
    """
    if axes is None:
        from matplotlib.figure import Figure

        axes = Figure(figsize=(6, 5.4), layout="constrained").add_subplot(projection="3d")
    elif getattr(axes, "name", "") != "3d":
        raise InputError("an arm is drawn in space; give axes made with projection='3d'.")
    configurations = np.atleast_2d(np.asarray(arm._checked(q)))
    first = {"color": DARK, "linewidth": 3, "marker": "o", "markersize": 4}
    others = {"color": LIGHT, "linewidth": 0.8}
    for index, line in reversed(list(enumerate(skeleton(arm, configurations)))):
        axes.plot(*line.T, **(others if index else first))
    tips = np.asarray(arm.position(configurations))
    axes.plot(*tips.T, linestyle="none", marker="+", color=ACCENT, markersize=8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    axes.set_aspect("equal")
    return axes
