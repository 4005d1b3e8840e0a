"""Models of the joints: how they compare, and what each joint does besides its reading."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ..calibration.joint_model import function_of_joint
from ..calibration.record import CalibrationRecord
from ..core.errors import InputError
from ..core.units import DEG
from ..diagnostics.pose_residuals import observation_residuals
from ..kinematics.corrections import Term
from ..pipeline.model_ladder import ComparedModels
from ..summaries.compared_models import compared_models_summary
from ..summaries.tables import format_number
from .charts import Chart, Marks, Plot, borders, level, linear, names
from .figures import TONES, draw

_IN_A_BIN, _MOST_BINS = 8, 80  # poses, and bins of a joint's travel
_MRAD = 1e-3
_WIDTH = 0.38  # of a bar


def models_chart(summary: Mapping[str, Any]) -> Chart:
    """RMS errors of models inside and outside what they were fitted to, with the standard error outside; mm."""
    labels = [row["model"] for row in summary["models"]]
    inside, outside, u = (
        np.array([row[key] for row in summary["models"]], dtype=float)
        for key in ("rms_inside", "rms_outside", "u_outside")
    )
    words = [
        f"{label}: inside {format_number(a)} mm, outside {format_number(b)} ± {format_number(c)} mm"
        for label, a, b, c in zip(labels, inside.tolist(), outside.tolist(), u.tolist(), strict=True)
    ]
    left, box = np.arange(len(labels)) - _WIDTH / 2, (_WIDTH, 0.0)
    low, high, right = outside - u, outside + u, left + _WIDTH
    marks = (
        Marks("poses that were fitted", left, inside, "boxes", "soft", words, box=box),
        Marks("regions left out, ± one standard error", right, outside, "boxes", "main", words, low, high, box=box),
    )
    named = [f"{label} (recommended)" if label == summary["recommended"] else label for label in labels]
    y = linear("RMS distance from the geometry [mm]", inside, outside, high, [0.0], zero=True)
    description = "The RMS distance of poses from their geometry, from the simplest model to the richest."
    return Chart("models", "Errors by model", description, (Plot(names("", named), y, marks, height=260),))


def model_comparison(compared: ComparedModels, axes: Any = None) -> Any:
    """Plot the errors of compared models inside and outside what they were fitted to, mm.

    Bars with the standard error of `ComparedModel.u_outside`; the recommended model is marked.

    Args:
        compared: What `compare_models` returned.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Example:
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> axes = aj.plot.model_comparison(compared)
        >>> print(len(axes.patches), "bars")
        4 bars
    """
    return draw(models_chart(compared_models_summary(compared, "")).plots[0], axes)


def functions_chart(record: CalibrationRecord) -> Chart | None:
    """What each joint does besides its reading; None for an arm whose joints do what they read."""
    corrections = record.calibrated.arm.corrections
    plots = [plot for joint in range(1, record.calibrated.arm.joints + 1) if (plot := joint_plot(record, joint, True))]
    if not plots or corrections is None:
        return None
    kinds = {
        term.kind.description: term.kind.of_own_reading
        for term in corrections.functions.terms
        if isinstance(term, Term)
    }
    drawn, others = ([words for words, own_reading in kinds.items() if own_reading is by] for by in (True, False))
    description = (
        f"The curve: corrections of each joint by its own reading ({', '.join(drawn)}), less their mean"
        + (f"; without {', '.join(others)}" if others else "")
        + ". Marks: the curve and what the residuals of neighbouring poses ask besides, with twice its standard error. "
        "Dashed lines are the ends of the travel that was measured."
    )
    return Chart("functions", "What the joints do besides their readings", description, tuple(plots))


def joint_function(
    record: CalibrationRecord, joint: int, axes: Any = None, *, label: str | None = None, color: str = TONES["main"]
) -> Any:
    """Plot what a joint does besides its reading, against its reading; mrad, or mm of a prismatic joint.

    Marks are means over neighbouring poses, with twice their standard error: the change of this joint that alone would
    explain most of their residuals, added to the calibrated function. That function is the curve, with its expanded
    uncertainty (95 %): harmonics and gear ratio of the arm, less their mean over the poses, which a zero offset takes
    up. It goes a little beyond the travel of the poses (between the dashed lines), within the limits of the joint.
    Marks off the curve, or a pattern of marks without a curve, are errors that the model lacks.

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
        reading of joint 2 [deg]
    """
    joints = record.calibrated.arm.joints
    if not 1 <= joint <= joints:
        raise InputError(f"joint is {joint}; the arm has joints 1 to {joints}.")
    plot = joint_plot(record, joint)
    assert plot is not None
    marks = [part._replace(tone=color) if part.tone == "main" else part for part in plot.marks]
    points = next(i for i, part in enumerate(marks) if part.symbol == "dot")
    marks[points] = marks[points]._replace(name=label or "")
    return draw(plot._replace(marks=tuple(marks)), axes, legend=False)


def joint_plot(record: CalibrationRecord, joint: int, only_corrected: bool = False) -> Plot | None:
    """The function of one joint, and what residuals ask of it; ``only_corrected``: None where it has no function."""
    residuals = observation_residuals(record)
    q = np.concatenate([np.asarray(part.observation.q) for part in residuals])
    curve = function_of_joint(record, joint, q)
    if curve is None and only_corrected:
        return None
    asked = np.concatenate([part.by_joint[joint - 1] for part in residuals])
    lever = np.concatenate([part.lever[joint - 1] for part in residuals])
    slides, travel = joint in record.calibrated.arm.prismatic, q[:, joint - 1]
    unit, reading = (1.0, 1.0) if slides else (_MRAD, DEG)
    marks: list[Marks] = []
    if curve is not None:
        x, value, expanded = curve.reading / reading, curve.value / unit, curve.expanded / unit
        low, high = value - expanded, value + expanded
        marks = [Marks("", x, value, "band", low=low, high=high), Marks("", x, value, "line"),
                 borders([travel.min() / reading, travel.max() / reading])]  # fmt: skip
        asked = asked + curve.at_poses
    means, values, u = _binned(travel, asked, lever)
    y, u, tone = values / unit, u / unit, "main" if curve is None else "accent"
    marks.append(Marks("", means / reading, y, "dot", tone, low=y - 2 * u, high=y + 2 * u, size=4))
    axes = (
        linear(f"reading of joint {joint} [{'mm' if slides else 'deg'}]", *(mark.x for mark in marks), margin=0.02),
        linear(f"joint {joint} [{'mm' if slides else 'mrad'}]", *(end for mark in marks for end in (mark.low, mark.high)
               if end is not None), [0.0]),
    )  # fmt: skip
    return Plot(*axes, (*marks, level(0.0)), height=150)


def _binned(
    reading: Float[np.ndarray, " M"], asked: Float[np.ndarray, " M"], lever: Float[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
    """Means over poses with neighbouring readings, weighted by how far the joint moves the tip, and their standard
    errors by the scatter."""
    means, values, u = [], [], []
    for members in np.array_split(np.argsort(reading), np.clip(len(reading) // _IN_A_BIN, 1, _MOST_BINS)):
        weight = lever[members] ** 2 / max(np.sum(lever[members] ** 2), 1e-300)
        means.append(reading[members].mean())
        values.append(weight @ asked[members])
        u.append(np.sqrt(np.sum((weight * (asked[members] - values[-1])) ** 2)))
    return np.array(means), np.array(values), np.array(u)
