"""Figures of models of the joints: how they compare, and what each joint does besides its reading."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ..calibration.joint_functions import function_of_joint
from ..calibration.record import CalibrationRecord
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..core.units import DEG
from ..diagnostics.pose_residuals import observation_residuals
from ..kinematics.arm import Arm
from ..pipeline.model_ladder import ComparedModels
from .style import ACCENT, DARK, LIGHT, axes_or_new, label_axes

_IN_A_BIN, _MOST_BINS = 8, 80  # poses, and bins of a joint's travel
_MRAD = 1e-3


def model_comparison(found: ComparedModels, axes: Any = None) -> Any:
    """Plot the errors of compared models inside and outside what they were fitted to, mm.

    Bars with the standard error of `ComparedModel.u_outside`; the recommended model is marked.

    Args:
        found: What `compare_models` returned.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Example:
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> axes = aj.plot.model_comparison(compared)
        >>> print(len(axes.patches), "bars")
        4 bars
    """
    axes = axes_or_new(axes)
    x, width = np.arange(len(found.models)), 0.38
    inside = [model.rms_inside for model in found.models]
    outside = [model.rms_outside for model in found.models]
    errors = [model.u_outside for model in found.models]
    axes.bar(x - width / 2, inside, width, color=LIGHT, label="poses that were fitted")
    axes.bar(x + width / 2, outside, width, yerr=errors, capsize=3, color=DARK, label="regions that were left out")
    names = [f"{model.model}\n(recommended)" if model is found.recommended else model.model for model in found.models]
    axes.set_xticks(x, [name.replace(",", ",\n") for name in names])
    label_axes(axes, "", "RMS distance from the geometry [mm]")
    axes.set_axisbelow(True)
    axes.legend(frameon=False, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return axes


def joint_function(
    record: CalibrationRecord, joint: int, axes: Any = None, *, label: str | None = None, color: str = DARK
) -> Any:
    """Plot what a joint does besides its reading, against its reading; mrad, or mm of a prismatic joint.

    Marks are means over neighbouring poses, with twice their standard error: the change of this joint that alone would
    explain most of their residuals, added to the calibrated function. That function is the curve, with its expanded
    uncertainty (95 %): harmonics and gear ratio of the arm, less their mean over the poses, which a zero offset takes
    up. It goes a little beyond the travel of the poses (dotted), within the limits of the joint. Marks off the curve,
    or a pattern of marks without a curve, are errors that the model lacks.

    Args:
        record: A calibration from observations or with a prior, the residuals of which are known pose by pose.
        joint: Number of the joint, from 1.
        axes: Axes to plot into; new ones if None. Several records may share axes.
        label: For the legend; by default none.
        color: Of marks and curve.

    Returns:
        The axes.

    Raises:
        InputError: If the arm has no such joint.

    Example:
        >>> robust = aj.calibrate(arm, two_bars, bounds, robust="huber")
        >>> by_pose = aj.calibration.record_of(robust, aj.Recording(two_bars, nominal), robust="huber")
        >>> axes = aj.plot.joint_function(by_pose, 2)
        >>> print(axes.get_xlabel())
        q_2 [deg]
    """
    arm: Arm = to_numpy(record.calibrated.arm)
    if not 1 <= joint <= arm.joints:
        raise InputError(f"joint is {joint}; the arm has joints 1 to {arm.joints}.")
    residuals = observation_residuals(record)
    axes = axes_or_new(axes)
    q = np.concatenate([np.asarray(one.observation.q) for one in residuals])
    asked = np.concatenate([one.by_joint[joint - 1] for one in residuals])
    lever = np.concatenate([one.lever[joint - 1] for one in residuals])
    slides = joint in arm.prismatic
    unit, reading = (1.0, 1.0) if slides else (_MRAD, DEG)
    curve = function_of_joint(record, joint, q)
    if curve is not None:
        at, value, expanded = curve.reading, curve.value, curve.expanded
        asked = asked + curve.at_poses
        low, high = q[:, joint - 1].min(), q[:, joint - 1].max()
        axes.fill_between(
            at / reading, (value - expanded) / unit, (value + expanded) / unit, color=color, alpha=0.2, linewidth=0
        )
        seen = (at >= low) & (at <= high)
        axes.plot(at[seen] / reading, value[seen] / unit, color=color, linewidth=1.2)
        for side in (at <= low, at >= high):
            axes.plot(at[side] / reading, value[side] / unit, color=color, linewidth=1.0, linestyle=":")
    means, values, u = _binned(q[:, joint - 1], asked, lever)
    style = {"fmt": "o", "markersize": 3, "elinewidth": 0.7, "color": color if curve is None else ACCENT}
    axes.errorbar(means / reading, values / unit, yerr=2 * u / unit, label=label, **style)
    axes.axhline(0, color="0.4", linewidth=0.8)
    label_axes(axes, f"q_{joint} [{'mm' if slides else 'deg'}]", f"joint {joint} [{'mm' if slides else 'mrad'}]")
    return axes


def _binned(
    reading: Float[np.ndarray, " M"], asked: Float[np.ndarray, " M"], lever: Float[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
    """Means over poses with neighbouring readings, weighted by how far the joint moves the tip, and their standard
    errors by the scatter."""
    bins = np.array_split(np.argsort(reading), np.clip(len(reading) // _IN_A_BIN, 1, _MOST_BINS))
    means, values, u = [], [], []
    for own in bins:
        weight = lever[own] ** 2 / max(np.sum(lever[own] ** 2), 1e-300)
        means.append(reading[own].mean())
        values.append(weight @ asked[own])
        u.append(np.sqrt(np.sum((weight * (asked[own] - values[-1])) ** 2)))
    return np.array(means), np.array(values), np.array(u)
