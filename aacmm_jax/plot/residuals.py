"""Residuals pose by pose, by arm or by kind of observation; and patterns in them, of which warnings of a wrong model
speak."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.record import CalibrationRecord
from ..core.errors import InputError
from ..core.units import DEG
from ..data.capture import Capture
from ..diagnostics.pose_residuals import (
    ObservationResiduals,
    SignedResiduals,
    distances_of,
    observation_residuals,
    rms,
    signed_residuals,
)
from ..kinematics.arm import by_joint
from ..summaries.tables import Cell, Table, by_columns, format_number, numbers
from .charts import SERIES, Chart, Marks, Plot, borders, histogram, level, linear, logarithmic, runs, thinned
from .figures import draw, draw_all, save_figure
from .parameters import error_plot

_NAMED = 16  # most sockets or observations that are named along an axis
_SEPARATED = 60  # most of them with lines between them
_LISTED = 400  # most poses in the table of a chart
_LEAST = 1e-5  # a residual of zero on a logarithmic axis, mm
Marked = tuple[str, Sequence[int] | np.ndarray]  # why poses are marked, and their indices
_OF_ARMS: tuple[dict[str, Any], ...] = ({"symbol": "square", "tone": "soft"}, SERIES[0])  # nominal, calibrated
# Of residuals in each unit: identity and title of the chart, and what of the poses of an observation.
_UNITS: dict[str, tuple[str, str, Callable[[ObservationResiduals], Any]]] = {
    "mm": ("residuals", "Residuals in mm", lambda part: part.distance),
    "standard deviations": ("normalised", "Residuals in standard deviations", lambda part: part.normalised),
    "deg": ("angles", "Residuals of angles", lambda part: part.other["rad"] / DEG),
    "px": ("pixels", "Residuals in pixels", lambda part: part.other["px"]),
}
_DRAWN = 400  # most poses in one plot of a pattern in a page
_FEWEST = 12  # poses: fewer show no pattern
_BINS = (4, 12)  # least and most of them; a band needs some 15 poses in each
_INSIDE = 0.995  # of the residuals lie within the axis; the others are drawn at its edge


class Groups(NamedTuple):
    """Poses in groups, the sockets or observations of a capture, one after the other."""

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    kinds: tuple[str, ...]
    word: str  # what a group is

    @classmethod
    def of(cls, capture: Capture) -> "Groups":
        """The sockets of a capture, then its other observations."""
        others = capture.observations
        names = (*capture.names, *(observation.name for observation in others))
        sizes = (*capture.sizes, *(len(observation.q) for observation in others))
        kinds = (*("socket" for _ in capture.names), *(observation.kind for observation in others))
        return cls(names, sizes, kinds, "observation" if others else "socket")

    @property
    def centre(self) -> str:
        """What the distance of a pose is from."""
        return "geometry" if self.word == "observation" else "socket's centroid"

    @property
    def owner(self) -> np.ndarray:
        """Index of the group of each pose."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)

    @property
    def labels(self) -> list[str]:
        """What each pose is called: its group, and its number in it from 1."""
        pairs = zip(self.names, self.sizes, strict=True)
        return [f"{name}, pose {number}" for name, size in pairs for number in range(1, size + 1)]

    def parts(self) -> tuple[tuple[tuple[float, str], ...], np.ndarray]:
        """Names at the middle of each group, or of those that share a folder ("monday/"), and the borders between them;
        without names where even these are too many."""
        for depth in range(max(name.count("/") for name in self.names), -1, -1):
            names = ["/".join(name.split("/")[: depth + 1]) for name in self.names]
            ticks, edges = runs(np.repeat(names, self.sizes).tolist(), 1.0)
            if 1 < len(ticks) <= _NAMED:
                return ticks, edges
        return (), np.cumsum(self.sizes)[:-1] + 0.5 if len(self.sizes) <= _SEPARATED else np.zeros(0)


def pose_chart(
    id: str,
    title: str,
    groups: Groups,
    arms: Mapping[str, np.ndarray],
    *,
    unit: str = "mm",
    far: Marked = ("", ()),
    most: int | None = None,
    limit: float | None = None,
) -> Chart:
    """The residual of every pose on a logarithmic axis: of two arms, or of one arm by the kind of its observation.

    ``arms`` has the residuals of all poses by the name of the arm, NaN where there is none; ``unit`` is "mm", "deg" or
    "standard deviations", whose expectation of 1 is drawn, as a ``limit`` is; ``far`` marks poses; ``most`` poses are
    drawn besides those.
    """
    last_arm, last = list(arms.items())[-1]
    finite, marked = np.flatnonzero(np.isfinite(last)), np.asarray(far[1], dtype=int)
    if not len(finite):
        return Chart(id, title, "Every socket has only one pose, so there is no scatter to show.", ())
    drawn = np.union1d(finite[thinned(len(finite), most or len(finite))], marked)
    labels, kind = groups.labels, np.asarray(groups.kinds)[groups.owner]
    # Said of each mark, in the key, residuals, poses, and how they are drawn.
    if len(arms) > 1:
        series = [(arm, f"{arm}, RMS {format_number(rms(values[np.isfinite(values)]), 3)} {unit}", values, drawn, style)
                  for (arm, values), style in zip(arms.items(), _OF_ARMS, strict=True)]  # fmt: skip
    else:
        series = [(name, name, last, drawn[kind[drawn] == name], SERIES[i % len(SERIES)])
                  for i, name in enumerate(dict.fromkeys(groups.kinds))]  # fmt: skip
    marks = []
    for said, name, values, chosen, style in series:
        chosen = chosen[np.isfinite(values[chosen])]
        words = [f"{labels[i]}: {format_number(float(values[i]))} {unit} ({said})" for i in chosen]
        marks.append(Marks(name, chosen + 1, np.maximum(values[chosen], _LEAST), words=words, size=5, **style))
    if len(marked):
        marks.append(Marks(far[0], marked + 1, np.maximum(last[marked], _LEAST), "ring", "accent", size=11))
    if unit == "standard deviations":
        marks.append(level(1.0))
    if limit:
        marks.append(level(limit))
    ticks, edges = groups.parts()
    x = linear("pose" if len(groups.sizes) == 1 else f"pose, {groups.word} after {groups.word}",
               [0.0, len(last) + 1.0], margin=0.0)  # fmt: skip
    y = {"standard deviations": "residual", "deg": "residual angle", "px": "distance of an image's corners, RMS"}.get(
        unit, f"distance from the {groups.centre}"
    )
    plot = Plot(
        x._replace(ticks=ticks, named=True) if ticks else x,
        logarithmic(f"{y} [{unit}]", *(mark.y for mark in marks)),
        (*marks, borders(edges)),
    )
    median, largest = (format_number(float(value)) for value in (np.median(last[finite]), last[finite].max()))
    description = f"Median {median} {unit}, largest {largest} {unit} ({last_arm} arm)."
    description += " Poses that are the only pose of their socket are not drawn." if len(finite) < len(last) else ""
    description += f" The line is at {limit:g} {unit}." if limit else ""
    description += f" {len(drawn)} of {len(finite)} poses are drawn." if len(drawn) < len(finite) else ""
    return Chart(id, title, description, (plot,), None if len(arms) > 1 else _pose_table(groups, last, unit, far))


def _pose_table(groups: Groups, residuals: np.ndarray, unit: str, far: Marked) -> Table:
    """The residual of every pose, or of those of very many that have the largest; and which are marked, and why."""
    chosen, caption = np.arange(len(residuals)), "Every pose"
    if len(chosen) > _LISTED:
        chosen = np.argsort(-np.nan_to_num(residuals))[:_LISTED]
        caption = f"The {_LISTED} poses with the largest residuals, out of {len(residuals)} poses"
    owner, says = groups.owner, Cell(far[0], None, "outlier")
    columns = {
        groups.word: [groups.names[i] for i in owner[chosen]],
        "pose": [int(i - np.searchsorted(owner, owner[i]) + 1) for i in chosen],
        f"calibrated [{unit}]": numbers(residuals[chosen], 5),
        "marked": [says if marked else "" for marked in np.isin(chosen, far[1])],
    }
    return by_columns(caption, columns)


def distances_in(capture: Capture, evaluation: Evaluation) -> np.ndarray:
    """Distances of all poses from their socket's centroid or their observation's geometry, mm; NaN for the only pose of
    a socket, which shows no scatter."""
    distances, sizes = np.concatenate(distances_of(capture, evaluation)), Groups.of(capture).sizes
    single = np.repeat(np.asarray(sizes) == 1, sizes) & (np.arange(len(distances)) < sum(capture.sizes))
    return np.where(single, np.nan, distances)


def arms_chart(
    capture: Capture, arms: Mapping[str, np.ndarray], most: int | None = None, limit: float | None = None
) -> Chart:
    """Distances of all poses by the nominal and by the calibrated arm, mm; with a line at a limit."""
    groups = Groups.of(capture)
    return pose_chart(
        "stages", f"Distance of every pose from its {groups.centre}", groups, arms, most=most, limit=limit
    )


def distances_by_arm(record: CalibrationRecord) -> dict[str, np.ndarray]:
    """Distances of all poses of a calibration by the nominal and by the calibrated arm, mm."""
    capture, evaluations = record.recording.capture, record.evaluations()
    distances = {arm: distances_in(capture, evaluations[arm]) for arm in ("nominal", "calibrated")}
    if not record.sockets_alone:  # with the geometry of the calibration
        distances["calibrated"] = np.concatenate([part.distance for part in observation_residuals(record)])
    return distances


def pose_distances(record: CalibrationRecord, axes: Any = None) -> Any:
    """Plot the distance of each pose's tip from its socket's centroid, or from the geometry of its observation, nominal
    and calibrated, mm (logarithmic).

    Args:
        record: The calibration.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> aj.plot.pose_distances(record).figure.savefig("figure.svg")
    """
    return draw(arms_chart(record.recording.capture, distances_by_arm(record)).plots[0], axes)


def residuals_by_kind(record: CalibrationRecord, unit: str = "mm", axes: Any = None) -> Any:
    """Plot the residual of every pose of a calibration by kind of observation (logarithmic).

    Poses that a robust loss took half of their weight from or more have a ring. `InputError` for a unit in which
    nothing was measured.

    Args:
        record: The calibration.
        unit: ``"mm"``, ``"standard deviations"``, or ``"deg"`` or ``"px"`` for what was measured in these units.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> robust = aj.calibrate(arm, capture, bounds, robust="huber")
        >>> axes = aj.plot.residuals_by_kind(aj.calibration.record_of(robust, recording, robust="huber"))
    """
    if unit not in _UNITS:
        raise InputError(f"unit is '{unit}'; it must be mm, standard deviations, deg or px.")
    chart = kinds_chart(record, unit)
    if chart is None:
        raise InputError(
            f"the calibration has no residuals in {unit}; draw its residuals in mm or in standard deviations."
        )
    return draw(chart.plots[0], axes)


def kinds_chart(
    record: CalibrationRecord, unit: str, far: Marked | None = None, most: int | None = None
) -> Chart | None:
    """Residuals of a calibration in a unit, by kind of observation; ``far`` marks poses, by default those that lost
    weight. None where nothing was measured in this unit."""
    measured = {"deg": "rad"}.get(unit, unit)
    every = unit in ("mm", "standard deviations")
    parts = [part for part in enumerate(observation_residuals(record)) if every or measured in part[1].other]
    if not parts:
        return None
    names, sizes, kinds, word = Groups.of(record.recording.capture)
    index = [i for i, _ in parts]
    names, sizes, kinds = (tuple(values[i] for i in index) for values in (names, sizes, kinds))
    values = np.concatenate([np.asarray(_UNITS[unit][2](part)) for _, part in parts])
    if far is None or not every:
        weights = np.concatenate([part.weight for _, part in parts])
        far = "half of the full weight or less", np.flatnonzero(weights <= 0.5)
    groups = Groups(names, sizes, kinds, word)  # type: ignore
    return pose_chart(*_UNITS[unit][:2], groups, {"calibrated": values}, unit=unit, far=far, most=most)


def save_calibration_figure(record: CalibrationRecord, path: Path) -> None:
    """Write the distances of the poses; of observations also the residuals in standard deviations and those of
    orientations; and, if the truth is known, the errors of the length parameters.

    Args:
        record: The calibration.
        path: The file to write, whole or not at all; its name ends in ``.png``, ``.svg`` or ``.pdf``.

    Example:
        >>> from pathlib import Path
        >>> aj.plot.save_calibration_figure(record, Path("calibration.svg"))
    """
    charts = [arms_chart(record.recording.capture, distances_by_arm(record))]
    charts += [] if record.sockets_alone else [kinds_chart(record, "standard deviations")]
    charts += [kinds_chart(record, "deg"), kinds_chart(record, "px")]
    plots = [chart.plots[0] for chart in charts if chart is not None]
    plots += [] if record.recording.true is None else [error_plot(record)]
    save_figure(draw_all(plots, len(plots) if len(plots) <= 3 else 2, (5.5, 3.9), legends=True), path)


def residual_patterns(record: CalibrationRecord) -> Any:
    """Plot the residuals with their sign, mm: along what each joint does to the tip against its reading, and along x, y
    and z in the order of the poses; and their histogram, in standard deviations.

    Noise scatters evenly about zero; the means of neighbouring poses, with twice their standard errors, show what the
    model lacks: a wave is an eccentric encoder or a bending link, a slope a wrong gear ratio, a step something that
    moved. The figure is returned; `InputError` if no pose has a residual with a direction.

    Args:
        record: The calibration.

    Example:
        >>> aj.plot.residual_patterns(record).savefig("residuals.svg")
    """
    residuals = signed_residuals(record)
    if residuals is None:
        raise InputError(
            "there are no residuals to draw, because no socket has several poses; record several poses per socket."
        )
    charts = _pattern_charts(record, residuals, len(residuals.poses))
    return draw_all([plot for chart in charts for plot in chart.plots], 4)


def pattern_charts(record: CalibrationRecord) -> list[Chart]:
    """Residuals with their sign: against the reading of each joint, in the order of the poses, and their histogram."""
    residuals = signed_residuals(record)
    if residuals is None or len(residuals.poses) < _FEWEST:
        return []
    return _pattern_charts(record, residuals, _DRAWN)


def _pattern_charts(record: CalibrationRecord, residuals: SignedResiduals, most: int) -> list[Chart]:
    q = np.asarray(record.recording.capture.readings)[residuals.poses]
    order = np.arange(1, len(residuals.poses) + 1)
    by_reading = [
        (q[:, i] / unit, f"reading of joint {i + 1} [{name}]", residuals.along_joint[:, i], "")
        for i, (unit, name) in enumerate(by_joint(record.calibrated.arm, (DEG, "deg"), (1.0, "mm")))
    ]
    by_order = [
        (order, "pose, in the order of the capture", residuals.vector[:, i], f"along {axis}")
        for i, axis in enumerate("xyz")
    ]
    values = residuals.normalised[np.isfinite(residuals.normalised)]
    edges, fine = np.linspace(-4.5, 4.5, 31), np.linspace(-4.5, 4.5, 121)
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    normal = len(values) * (edges[1] - edges[0]) * np.exp(-(fine**2) / 2) / math.sqrt(2 * math.pi)
    marks = histogram(counts, edges, "residuals"), Marks("normal distribution", fine, normal, "line", "accent")
    x = linear("residual [standard deviations]", edges, margin=0.0)
    rows = (
        (
            "by-joint",
            "Residuals against the readings",
            "The component of each residual, mm, along the direction in which the joint moves the tip, against the "
            "reading of the joint. A wave indicates an eccentric encoder or a bending link; a slope indicates a wrong "
            "gear ratio or zero.",
            _patterns(by_reading, most),
        ),
        (
            "by-order",
            "Residuals along x, y and z",
            "The residual of each pose in the base frame, mm, in the order of the capture. A step between sockets or "
            "placements, or a slope, shows that something moved, warmed up or wore during the recording.",
            _patterns(by_order, most),
        ),
        (
            "histogram",
            "Histogram of the residuals",
            "All coordinates of all poses; the outermost bars include all residuals beyond 4.5 standard deviations.",
            (Plot(x, linear("coordinates", counts, normal, zero=True), marks, height=220),),
        ),
    )
    return [Chart(*row) for row in rows]


def _patterns(panels: Sequence[tuple[np.ndarray, str, np.ndarray, str]], most: int) -> tuple[Plot, ...]:
    """Residuals, and the band of the means of neighbouring poses with twice their standard errors, on symmetric axes of
    equal length; what lies beyond is drawn at their edges. Panels: abscissas and their title, residuals, title."""
    all_residuals = np.abs(np.concatenate([y for _, _, y, _ in panels]))
    limit = 1.15 * float(np.quantile(all_residuals[np.isfinite(all_residuals)], _INSIDE)) or 1.0
    plots = []
    for x, x_title, y, title in panels:
        finite = np.flatnonzero(np.isfinite(y))
        drawn = finite[thinned(len(finite), most)] if len(finite) else finite
        points = Marks("pose", x[drawn], np.clip(y[drawn], -limit, limit), "dot", "soft", size=3.5)
        marks = [level(0.0), points]
        bins = min(max(len(finite) // 15, _BINS[0]), _BINS[1])
        if len(finite) >= 3 * bins:
            parts = np.array_split(finite[np.argsort(x[finite], kind="stable")], bins)
            middle, mean = (np.array([values[part].mean() for part in parts]) for values in (x, y))
            twice = np.array([2 * y[part].std(ddof=1) / math.sqrt(len(part)) for part in parts])
            name = "mean of neighbouring poses, ± 2 u"
            marks.append(Marks(name, middle, mean, "band", low=mean - twice, high=mean + twice))
            marks.append(Marks("", middle, mean, "line"))
        y_axis = linear("residual [mm]", [-limit, limit], margin=0.0)
        plots.append(Plot(linear(x_title, x, margin=0.02), y_axis, tuple(marks), title=title, height=150))
    return tuple(plots)
