"""The section on patterns in the residuals: what warnings of a wrong model speak of, to be seen."""

import math

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.units import DEG
from ..diagnostics.pose_residuals import SignedResiduals, signed_residuals
from . import charts
from .elements import Chart, Section

_DRAWN = 400  # most poses in one plot
_FEWEST = 12  # poses: fewer show no pattern
_BINS = (4, 12)  # least and most of them; a band needs some 15 poses in each
_INSIDE = 0.995  # of the residuals lie within the axis; the others are drawn at its edge


def patterns_sections(record: CalibrationRecord) -> list[Section]:
    """Residuals with their sign: against the reading of each joint, in the order of the poses, and their histogram."""
    found = signed_residuals(record)
    if found is None or len(found.poses) < _FEWEST:
        return []
    introduction = (
        "Residuals that scatter evenly about zero are noise; what the model lacks shows as a pattern. The band is the "
        "mean of neighbouring poses with twice its standard error: where it leaves zero, the residuals follow what is "
        "drawn along the axis."
    )
    return [Section("patterns", "Patterns in the residuals", [
        introduction, _by_joint(record, found), _by_order(found), _histogram(found)
    ])]  # fmt: skip


def _by_joint(record: CalibrationRecord, found: SignedResiduals) -> Chart:
    q = np.asarray(record.recording.capture.readings)[found.poses]
    slides = record.calibrated.arm.prismatic
    plots = []
    for joint in range(record.calibrated.arm.joints):
        slide = joint + 1 in slides
        x, title = (q[:, joint], "mm") if slide else (q[:, joint] / DEG, "deg")
        plots.append(_plot(x, found.along_joint[:, joint], f"reading of joint {joint + 1} [{title}]", ""))
    description = (
        "The component of each residual along which the joint would move the tip, mm, against its reading. A wave is "
        "an eccentric encoder or a bending link, a slope a wrong gear ratio or zero."
    )
    limit = _limit(found.along_joint)
    plots = [_limited(plot, limit) for plot in plots]
    return Chart("by-joint", "Residuals against the readings", description, tuple(plots))


def _by_order(found: SignedResiduals) -> Chart:
    order = np.arange(1, len(found.poses) + 1)
    plots = [_plot(order, found.vector[:, axis], "pose, in the order of the capture", f"along {name}")
             for axis, name in enumerate("xyz")]  # fmt: skip
    limit = _limit(found.vector)
    description = (
        "The residual in the base frame, mm, pose after pose as the capture holds them. A step between sockets or "
        "placements, or a slope, is something that moved, warmed or wore meanwhile."
    )
    return Chart("by-order", "Residuals along x, y and z", description, tuple(_limited(p, limit) for p in plots))


def _histogram(found: SignedResiduals) -> Chart:
    values = found.normalised[np.isfinite(found.normalised)]
    edges = np.linspace(-4.5, 4.5, 31)
    width = edges[1] - edges[0]
    middles = (edges[:-1] + edges[1:]) / 2
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    fine = np.linspace(edges[0], edges[-1], 121)
    normal = len(values) * width * np.exp(-(fine**2) / 2) / math.sqrt(2 * math.pi)
    hover = [f"{a:+.1f} to {a + width:+.1f}: {count}" for a, count in zip(edges, counts, strict=False)]
    marks = (
        charts.Marks("found", middles, counts, "boxes", "soft", hover, box=(width, 0.0)),
        charts.Marks("normal distribution", fine, normal, "line", "accent"),
    )
    axes = (
        charts.linear("residual [standard deviations]", edges, margin=0.0),
        charts.linear("coordinates", counts, normal, zero=True),
    )
    description = "All coordinates of all poses; those beyond 4.5 standard deviations stand in the outermost boxes."
    return Chart("histogram", "Histogram of the residuals", description, (charts.Plot(*axes, marks, height=220),))


def _plot(x: np.ndarray, y: np.ndarray, x_title: str, title: str) -> charts.Plot:
    known = np.flatnonzero(np.isfinite(y))
    drawn = known if len(known) <= _DRAWN else known[np.linspace(0, len(known) - 1, _DRAWN).round().astype(int)]
    marks = [charts.Marks("pose", x[drawn], y[drawn], "dot", "soft", size=3.5)]
    marks += _mean_band(x[known], y[known])
    return charts.Plot(
        charts.linear(x_title, x, margin=0.02), charts.linear("mm", y), tuple(marks), horizontal=[0.0], title=title,
        height=150,
    )  # fmt: skip


def _mean_band(x: np.ndarray, y: np.ndarray) -> list[charts.Marks]:
    """The mean of neighbouring poses, and twice its standard error to both sides."""
    bins = min(max(len(x) // 15, _BINS[0]), _BINS[1])
    if len(x) < 3 * bins:
        return []
    parts = np.array_split(np.argsort(x, kind="stable"), bins)
    middle = np.array([x[part].mean() for part in parts])
    mean = np.array([y[part].mean() for part in parts])
    twice = np.array([2 * y[part].std(ddof=1) / math.sqrt(len(part)) for part in parts])
    return [
        charts.Marks(
            "mean of neighbours, ± 2 of its u", middle, mean, "band", "main", low=mean - twice, high=mean + twice
        ),
        charts.Marks("", middle, mean, "line", "main"),
    ]


def _limit(values: np.ndarray) -> float:
    known = np.abs(values[np.isfinite(values)])
    return 1.15 * float(np.quantile(known, _INSIDE)) or 1.0


def _limited(plot: charts.Plot, limit: float) -> charts.Plot:
    """With a symmetric axis that all plots of a chart have in common, and what lies beyond it at its edge."""
    marks = tuple(
        one._replace(y=np.clip(np.asarray(one.y), -limit, limit)) if one.symbol == "dot" else one for one in plot.marks
    )
    return plot._replace(y=charts.linear("mm", [-limit, limit], margin=0.0), marks=marks)
