"""Patterns in the residuals of a calibration: what warnings of a wrong model speak of, to be seen."""

import math
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.errors import InputError
from ..core.units import DEG
from ..diagnostics.pose_residuals import SignedResiduals, signed_residuals
from ..kinematics.arm import by_joint
from .charts import Chart, Marks, Plot, level, linear, thinned
from .figures import draw_all

_DRAWN = 400  # most poses in one plot of a page
_FEWEST = 12  # poses: fewer show no pattern
_BINS = (4, 12)  # least and most of them; a band needs some 15 poses in each
_INSIDE = 0.995  # of the residuals lie within the axis; the others are drawn at its edge
_COLUMNS = 4  # of panels in a figure


def residual_patterns(record: CalibrationRecord) -> Any:
    """Plot the residuals with their sign, mm: along what each joint does to the tip against its reading, and along x, y
    and z in the order of the poses; and their histogram, in standard deviations.

    Noise scatters evenly about zero; the means of neighbouring poses, with twice their standard errors, show what the
    model lacks: a wave is an eccentric encoder or a bending link, a slope a wrong gear ratio, a step something that
    moved.

    Args:
        record: The calibration.

    Returns:
        The figure.

    Raises:
        InputError: If no pose has a residual with a direction.

    Example:
        >>> figure = aj.plot.residual_patterns(record)
        >>> figure.savefig("residuals.svg")
    """
    residuals = signed_residuals(record)
    if residuals is None:
        raise InputError("no pose has a residual with a direction, as no socket has several poses; record more poses.")
    charts = _charts(record, residuals, len(residuals.poses))
    return draw_all([plot for chart in charts for plot in chart.plots], _COLUMNS)


def pattern_charts(record: CalibrationRecord) -> list[Chart]:
    """Residuals with their sign: against the reading of each joint, in the order of the poses, and their histogram."""
    residuals = signed_residuals(record)
    if residuals is None or len(residuals.poses) < _FEWEST:
        return []
    return _charts(record, residuals, _DRAWN)


def _charts(record: CalibrationRecord, residuals: SignedResiduals, most: int) -> list[Chart]:
    q = np.asarray(record.recording.capture.readings)[residuals.poses]
    order = np.arange(1, len(residuals.poses) + 1)
    units = by_joint(record.calibrated.arm, (DEG, "deg"), (1.0, "mm"))
    limit = _limit(residuals.along_joint)
    by_reading = tuple(
        _plot(q[:, i] / unit, residuals.along_joint[:, i], f"reading of joint {i + 1} [{name}]", "", limit, most)
        for i, (unit, name) in enumerate(units)
    )
    limit = _limit(residuals.vector)
    by_order = tuple(
        _plot(order, residuals.vector[:, i], "pose, in the order of the capture", f"along {axis}", limit, most)
        for i, axis in enumerate("xyz")
    )
    return [
        Chart(
            "by-joint",
            "Residuals against the readings",
            "The component of each residual along which the joint would move the tip, mm, against its reading. A wave "
            "is an eccentric encoder or a bending link, a slope a wrong gear ratio or zero.",
            by_reading,
        ),
        Chart(
            "by-order",
            "Residuals along x, y and z",
            "The residual in the base frame, mm, pose after pose as the capture holds them. A step between sockets or "
            "placements, or a slope, is something that moved, warmed or wore meanwhile.",
            by_order,
        ),
        Chart(
            "histogram",
            "Histogram of the residuals",
            "All coordinates of all poses; those beyond 4.5 standard deviations stand in the outermost boxes.",
            (_histogram(residuals.normalised[np.isfinite(residuals.normalised)]),),
        ),
    ]


def _histogram(values: np.ndarray) -> Plot:
    edges = np.linspace(-4.5, 4.5, 31)
    width = edges[1] - edges[0]
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    fine = np.linspace(edges[0], edges[-1], 121)
    normal = len(values) * width * np.exp(-(fine**2) / 2) / math.sqrt(2 * math.pi)
    words = [f"{a:+.1f} to {a + width:+.1f}: {count}" for a, count in zip(edges, counts, strict=False)]
    marks = (
        Marks("residuals", (edges[:-1] + edges[1:]) / 2, counts, "boxes", "soft", words, box=(width, 0.0)),
        Marks("normal distribution", fine, normal, "line", "accent"),
    )
    x = linear("residual [standard deviations]", edges, margin=0.0)
    return Plot(x, linear("coordinates", counts, normal, zero=True), marks, height=220)


def _plot(x: np.ndarray, y: np.ndarray, x_title: str, title: str, limit: float, most: int) -> Plot:
    """Residuals, and the band of their means; the axis is symmetric, and what lies beyond it is drawn at its edge."""
    known = np.flatnonzero(np.isfinite(y))
    drawn = known[thinned(len(known), most)] if len(known) else known
    points = Marks("pose", x[drawn], np.clip(y[drawn], -limit, limit), "dot", "soft", size=3.5)
    y_axis = linear("residual [mm]", [-limit, limit], margin=0.0)
    marks = (level(0.0), points, *_mean_band(x[known], y[known]))
    return Plot(linear(x_title, x, margin=0.02), y_axis, marks, title=title, height=150)


def _mean_band(x: np.ndarray, y: np.ndarray) -> list[Marks]:
    """The mean of neighbouring poses, and twice its standard error to both sides."""
    bins = min(max(len(x) // 15, _BINS[0]), _BINS[1])
    if len(x) < 3 * bins:
        return []
    parts = np.array_split(np.argsort(x, kind="stable"), bins)
    middle, mean = (np.array([values[part].mean() for part in parts]) for values in (x, y))
    twice = np.array([2 * y[part].std(ddof=1) / math.sqrt(len(part)) for part in parts])
    name = "mean of neighbours, ± 2 of its u"
    return [Marks(name, middle, mean, "band", low=mean - twice, high=mean + twice), Marks("", middle, mean, "line")]


def _limit(values: np.ndarray) -> float:
    known = np.abs(values[np.isfinite(values)])
    return 1.15 * float(np.quantile(known, _INSIDE)) or 1.0
