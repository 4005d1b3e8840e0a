"""Figures of an arm in space, and of its reach."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers
from ..core.errors import InputError
from ..kinematics.arm import Arm, checked_readings, joint_limits, with_chains, without_corrections
from ..kinematics.axes_to_dh import dh_frames, geometry_of
from ..kinematics.robots import chains_of
from ..kinematics.workspace import arm_reach, skeleton
from .charts import Marks, Plot, linear
from .figures import TONES, draw, new_figure, save_figure

_DARK, _ACCENT, _LIGHT = TONES["main"], TONES["accent"], TONES["soft"]
_TIPS = 4000  # of the picture of the reach
_ZOOM = 0.88  # so that labels in space stay within the figure
_NUMBERS = 5  # along the longest axis in space


def arm_poses(arm: Arm, q: Numbers, axes: Any = None) -> Any:
    """Plot an arm in its poses as lines from joint to joint, mm; the first pose is dark.

    Args:
        arm: The arm.
        q: Joint readings, rad, of shape ``(poses, joints)`` or ``(joints,)``.
        axes: Three-dimensional axes to plot into, which are returned; new ones if None.

    Example:
        >>> aj.plot.arm_poses(result.arm, capture.q[:5]).figure.savefig("poses.svg")
    """
    axes = _axes_in_space(axes)
    configurations = np.atleast_2d(np.asarray(checked_readings(arm, q)))
    first = {"color": _DARK, "linewidth": 3, "marker": "o", "markersize": 4}
    others = {"color": _LIGHT, "linewidth": 0.8}
    for index, line in reversed(list(enumerate(skeleton(arm, configurations)))):
        axes.plot(*line.T, **(others if index else first))
    tips = np.asarray(arm.position(configurations))
    axes.plot(*tips.T, linestyle="none", marker="+", color=_ACCENT, markersize=8)
    _label_space(axes)
    return axes


def arm_at_zero(arm: Arm, axes: Any = None, *, base: Float[np.ndarray, "4 4"] | None = None) -> Any:
    """Plot an arm, or all chains of a robot, at readings of zero, with the axis of each joint as a numbered arrow, mm.

    Args:
        arm: The arm.
        axes: Three-dimensional axes to plot into, which are returned; new ones if None.
        base: The first frame in a robot's base link, mm; the plot is in the base link then.

    Example:
        >>> aj.plot.arm_at_zero(result.arm).figure.savefig("arm.svg")
    """
    axes = _axes_in_space(axes)
    base = np.eye(4) if base is None else base
    plain = without_corrections(arm)
    chains = [(chain.arm, base @ chain.base, chain.joints) for chain in chains_of(plain).values()]
    chains = chains or [(plain, base, tuple(range(1, arm.joints + 1)))]
    lines = [skeleton(one, np.zeros((1, one.joints)))[0] @ on[:3, :3].T + on[:3, 3] for one, on, _ in chains]
    points = np.concatenate(lines)
    size, drawn = 0.12 * max(np.ptp(points, axis=0).max(), 1e-9), set[int]()
    for line, (one, on, numbers) in zip(lines, chains, strict=True):
        axes.plot(*line.T, color=_DARK, linewidth=3, marker="o", markersize=3)
        axes.plot(*line[-1:].T, linestyle="none", marker="+", color=_ACCENT, markersize=10)
        frames = zip(numbers, dh_frames(geometry_of(one), on)[:-1], strict=True)
        for number, frame in (pair for pair in frames if pair[0] not in drawn):
            origin, end = frame[:3, 3], frame[:3, 3] + size * frame[:3, 2]
            axes.quiver(*origin, *(end - origin), color=_ACCENT, linewidth=1.2, arrow_length_ratio=0.25)
            axes.text(*(end + 0.4 * size * frame[:3, 2]), f"  {number}", color=_ACCENT, fontsize=9, va="center")
        drawn |= set(numbers)
    # A flat arm in a box of its own size would be a line.
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.6 * np.maximum(high - low, 0.6 * np.ptp(points, axis=0).max())[:, None] * [-1, 1]
    ends = ((low + high) / 2)[:, None] + half
    axes.set(xlim=ends[0], ylim=ends[1], zlim=ends[2])
    _label_space(axes)
    return axes


def arm_workspace(arm: Arm, axes: Any = None) -> Any:
    """Plot where random readings within the limits put the tip: distance from the first axis and height, mm.

    Args:
        arm: The arm.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> aj.plot.arm_workspace(arm).figure.savefig("figure.svg")
    """
    limits = np.asarray(joint_limits(arm, None))
    q = with_chains(arm, np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (_TIPS, arm.joints)))
    tips, reach = np.asarray(arm.position(q)), arm_reach(arm)
    radius, shoulder = np.hypot(tips[:, 0], tips[:, 1]), float(reach.shoulder[2])
    angles = np.linspace(-np.pi / 2, np.pi / 2, 181)
    across, up = reach.radius * np.cos(angles), shoulder + reach.radius * np.sin(angles)
    marks = (
        Marks("", radius, tips[:, 2], "dot", "soft", size=1.5),
        Marks("", across, up, "line"),
        Marks("", [0.0], [shoulder], "dot", size=5),
    )
    plot = Plot(linear("distance from the first axis [mm]", across), linear("height [mm]", up), marks, square=True)
    return draw(plot, axes, (4.6, 5.4))


def save_arm_figure(arm: Arm, path: Path, *, title: str = "", base: Float[np.ndarray, "4 4"] | None = None) -> None:
    """Write a picture of an arm at zero readings and of its reach, in the format that the name of the file ends in.

    Args:
        arm: The arm.
        path: The file to write (.png, .svg or .pdf).
        title: What the arm is called.
        base: The first frame in a robot's base link, mm.

    Example:
        >>> from pathlib import Path
        >>> aj.plot.save_arm_figure(arm, Path("arm.svg"), title="The nominal arm")
    """
    figure = new_figure((10.4, 5.4))
    parts: Any = figure.subfigures(1, 2, width_ratios=(6, 4.4))
    left, right = parts
    arm_at_zero(arm, left.add_subplot(projection="3d"), base=base).set_title("at zero readings", fontsize=10)
    arm_workspace(arm, right.subplots()).set_title(f"reach {arm_reach(arm).radius:.0f} mm", fontsize=10)
    figure.suptitle(title)
    save_figure(figure, Path(path))


def _label_space(axes: Any) -> None:
    """Equal scales, labels, and as many numbers along each axis as its length has room for."""
    axes.set(xlabel="x [mm]", ylabel="y [mm]")
    axes.set_zlabel("z [mm]", labelpad=8)
    axes.set_aspect("equal")
    all_axes = (axes.xaxis, axes.yaxis, axes.zaxis)
    lengths = [abs(np.subtract(*axis.get_view_interval())) for axis in all_axes]
    axes.set_box_aspect(lengths, zoom=_ZOOM)
    for axis, length in zip(all_axes, lengths, strict=True):
        axis.get_major_locator().set_params(nbins=max(2, round(_NUMBERS * length / max(lengths))))


def _axes_in_space(axes: Any) -> Any:
    if axes is None:
        return new_figure((6, 5.4)).add_subplot(projection="3d")
    if getattr(axes, "name", "") != "3d":
        raise InputError("an arm is drawn in three dimensions; give axes made with projection='3d'.")
    return axes
