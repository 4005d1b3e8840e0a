"""Tables and charts of repeatability and of lengths, common to reports of calibrations and of evaluations."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..calibration.evaluation import Evaluation
from ..data.capture import Capture
from ..diagnostics.pose_residuals import distances_of
from ..model.metrics import pose_outliers
from ..summaries.tables import METRICS, decimals_for
from . import charts
from .elements import Cell, Chart, ReportTable, format_number, number_cell, text_cell

_DRAWN, _LISTED = 1000, 400  # most poses in a chart, and in its table
_NAMED = 16  # most sockets or observations that are named along an axis
_LEAST = 1e-5  # a residual of zero on a logarithmic axis, mm


class Groups(NamedTuple):
    """Poses in groups, the sockets or observations of a capture, one after the other."""

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    word: str = "socket"  # what a group is

    @classmethod
    def of(cls, capture: Capture) -> "Groups":
        """The sockets of a capture, then its other observations."""
        if not capture.observations:
            return cls(capture.names, capture.sizes)
        others = capture.observations
        sizes = (len(observation.q) for observation in others)
        names = (observation.name for observation in others)
        return cls((*capture.names, *names), (*capture.sizes, *sizes), "observation")

    @property
    def owner(self) -> np.ndarray:
        """Index of the group of each pose."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)

    def parts(self) -> tuple[tuple[tuple[float, str], ...], np.ndarray]:
        """Names at the middle of each group, or of those that share a folder ("monday/"), and the borders between them;
        without names where even these are too many."""
        ends = np.cumsum(self.sizes)
        for depth in range(max(name.count("/") for name in self.names), -1, -1):
            names = ["/".join(name.split("/")[: depth + 1]) for name in self.names]
            last = [i for i in range(len(names)) if i + 1 == len(names) or names[i] != names[i + 1]]
            if 1 < len(last) <= _NAMED:
                borders = np.array([0, *ends[last]]) + 0.5
                middle = (borders[:-1] + borders[1:]) / 2
                return tuple((float(x), names[i]) for x, i in zip(middle, last, strict=True)), borders[1:-1]
        return (), ends[:-1] + 0.5 if len(ends) <= 60 else np.zeros(0)

    @property
    def numbers(self) -> np.ndarray:
        """Number of each pose within its group, from 1."""
        return np.concatenate([np.arange(1, size + 1) for size in self.sizes])


def metrics_table(
    caption: str, summary: Mapping[str, Any], stages: Mapping[str, str], *, fixed_scale: bool = False
) -> ReportTable:
    """Repeatability and length errors, one column per arm.

    ``fixed_scale``: a single length fixed the scale of the last arm, so its error is zero by construction.
    """
    first, last = next(iter(stages)), list(stages)[-1]

    def cell(stage: str, key: str) -> Cell:
        if fixed_scale and stage == last and key.startswith("length"):
            return text_cell("fixed the scale")
        return number_cell(summary[stage].get(key))

    rows = [
        [text_cell(title), *(cell(stage, key) for stage in stages)] for key, title in METRICS if key in summary[first]
    ]
    return ReportTable(caption, ("", *stages.values()), rows)


def pose_distances(capture: Capture, evaluation: Evaluation) -> np.ndarray:
    """Distances of all poses from their socket's centroid or their observation's geometry, mm; NaN for the only pose of
    a socket, which shows no scatter."""
    distances, sizes = np.concatenate(distances_of(capture, evaluation)), Groups.of(capture).sizes
    single = np.repeat(np.asarray(sizes) == 1, sizes) & (np.arange(len(distances)) < sum(capture.sizes))
    return np.where(single, np.nan, distances)


def socket_table(capture: Capture, evaluation: Evaluation) -> ReportTable:
    """Repeatability and number of outliers, socket by socket."""
    found = evaluation.repeatability
    metrics = [np.asarray(column) for column in (found.socket_de, found.socket_deltam, found.socket_rms)]
    outliers, _ = pose_outliers(np.asarray(evaluation.distances), capture.sizes)
    far = np.bincount(capture.owner[outliers], minlength=len(capture.names))
    rows = [
        [
            text_cell(name),
            number_cell(size, 0),
            *(number_cell(float(column[i]) if size > 1 else None) for column in metrics),
            number_cell(int(far[i]), 0, mark="outlier" if far[i] else ""),
        ]
        for i, (name, size) in enumerate(zip(capture.names, capture.sizes, strict=True))
    ]
    return ReportTable("Repeatability by socket [mm]", ("socket", "poses", "DE", "Deltam", "RMS", "marked poses"), rows)


def residual_chart(
    id: str, title: str, capture: Capture, evaluations: Mapping[str, Evaluation], *, mark: bool = False
) -> Chart:
    """Distance of every pose from its socket's centroid, or the geometry of its observation, by arm; ``mark``: poses of
    the last arm that are far off are marked, and a table lists the distances."""
    groups = Groups.of(capture)
    last = np.concatenate(distances_of(capture, list(evaluations.values())[-1]))
    far = pose_outliers(last, groups.sizes)[0] if mark else None
    distances = {name: pose_distances(capture, evaluation) for name, evaluation in evaluations.items()}
    chart = pose_chart(id, title, groups, distances, far=far)
    return chart if mark else chart._replace(table=None)


def pose_chart(
    id: str,
    title: str,
    groups: Groups,
    residuals: Mapping[str, np.ndarray],
    *,
    unit: str = "mm",
    axis: str = "distance",
    far: Sequence[int] | np.ndarray | None = None,
    far_says: str = "far from its socket",
    normal: float | None = None,
) -> Chart:
    """The residual of every pose, by arm, on a logarithmic axis; the table lists at most the 400 largest.

    Args:
        id: Identifier of the chart.
        title: Its title.
        groups: What the poses belong to.
        residuals: Name of an arm -> residual of every pose, NaN where there is none.
        unit: Their unit.
        axis: What a residual is, on the axis.
        far: Indices of poses to mark; None where the table has no column of marks.
        far_says: Why they are marked.
        normal: A value to draw as a horizontal line.

    Returns:
        The chart with its table.
    """
    last_arm, last = list(residuals.items())[-1]
    known = np.flatnonzero(np.isfinite(last))
    if not len(known):
        return Chart(id, title, "Every socket has one pose only, so there is no scatter to show.", ())
    owner, numbers = groups.owner, groups.numbers
    labels = [f"{groups.names[group]}, pose {number}" for group, number in zip(owner, numbers, strict=True)]
    marked = np.asarray([] if far is None else far, dtype=int)
    drawn = known if len(known) <= _DRAWN else known[np.linspace(0, len(known) - 1, _DRAWN).round().astype(int)]
    drawn = np.union1d(drawn, marked)
    marks = []
    for number, (name, values) in enumerate(residuals.items(), start=2 - len(residuals)):
        hover = [f"{labels[i]}: {format_number(float(values[i]))} {unit} ({name})" for i in drawn]
        found = values[np.isfinite(values)]
        says = f"{name}, RMS {format_number(float(np.sqrt(np.mean(found**2))), 3)} {unit}"
        y = np.maximum(values[drawn], _LEAST)
        last_one = charts.Marks(says, drawn + 1, y, hover=hover, size=5)
        marks.append(last_one if number else last_one._replace(symbol="square", tone="soft"))
    if len(marked):
        marks.append(charts.Marks(far_says, marked + 1, np.maximum(last[marked], _LEAST), "diamond", "accent"))
    ticks, borders = groups.parts()
    axis_of_poses = charts.Axis(
        f"pose, {groups.word} after {groups.word}" if len(groups.sizes) > 1 else "pose",
        0.0,
        len(owner) + 1.0,
        ticks or charts.round_ticks(0, len(owner) + 1),
        named=bool(ticks),
    )
    y = charts.logarithmic(f"{axis} [{unit}]", *(mark.y for mark in marks), [] if normal is None else [normal])
    plot = charts.Plot(axis_of_poses, y, tuple(marks), borders, [] if normal is None else [normal])
    median, largest = (format_number(float(reduced)) for reduced in (np.median(last[known]), last[known].max()))
    description = f"Dotted lines separate the {groups.word}s. " if len(borders) else ""
    description += f"Median {median} {unit}, largest {largest} {unit} ({last_arm} arm)."
    description += " The only pose of a socket has no distance." if len(known) < len(owner) else ""
    description += f" {len(drawn)} of {len(known)} poses are drawn." if len(drawn) < len(known) else ""
    table = _pose_table(groups, residuals, unit, None if far is None else marked, far_says)
    return Chart(id, title, description, (plot,), table)


def _pose_table(
    groups: Groups, residuals: Mapping[str, np.ndarray], unit: str, far: np.ndarray | None, far_says: str
) -> ReportTable:
    """Every pose, or those of very many that have the largest residuals."""
    last = list(residuals.values())[-1]
    chosen, caption = np.arange(len(last)), "Every pose"
    if len(chosen) > _LISTED:
        chosen = np.argsort(-np.nan_to_num(last))[:_LISTED]
        caption = f"The {_LISTED} farthest of {len(last)} poses"
    owner, numbers, marked = groups.owner, groups.numbers, set([] if far is None else far.tolist())
    rows = [
        [
            text_cell(groups.names[owner[i]]),
            number_cell(int(numbers[i]), 0),
            *(number_cell(float(values[i]), 5) for values in residuals.values()),
            *([] if far is None else [text_cell(far_says if i in marked else "", "outlier" if i in marked else "")]),
        ]
        for i in chosen.tolist()
    ]
    columns = (groups.word, "pose", *(f"{name} [{unit}]" for name in residuals), *([] if far is None else ["marked"]))
    return ReportTable(caption, columns, rows)


def validation_tables(summary: Mapping[str, Any]) -> list[ReportTable]:
    """Cross-validation, pooled and group by group, the most improbable group first."""
    pooled = [
        [text_cell(title), number_cell(summary[value]), number_cell(summary[predicted])]
        for title, value, predicted in (
            ("RMS distance of poses from their socket's centroid or geometry", "rms_mm", "rms_predicted_mm"),
            ("RMS error of reference lengths", "length_error_rms_mm", "length_u_mm"),
        )
        if summary[value] is not None
    ]
    columns = ("group held out", "poses", "RMS distance", "predicted", "RMS length error", "u", "by chance [%]", "")
    caption = f"Cross-validated: each of {summary['groups']} groups held out once [mm]"
    tables = [ReportTable(caption, ("", "found", "predicted by u"), pooled)]
    # Files of earlier versions have no groups.
    if rows := summary.get("left_out"):
        tables.append(ReportTable("Groups held out [mm]", columns, [_held_out(row) for row in rows]))
    return tables


def _held_out(row: Mapping[str, Any]) -> list[Cell]:
    chance = row["probability"]
    return [
        text_cell(row["group"]),
        number_cell(row["poses"], 0),
        *(number_cell(row[key]) for key in ("rms_mm", "rms_predicted_mm", "length_error_rms_mm", "length_u_mm")),
        number_cell(None if chance is None else 100 * chance, 2),
        text_cell("disagrees" if row["disagrees"] else ""),
    ]


def length_rows(
    rows: Sequence[Mapping[str, Any]], before: Sequence[np.ndarray], fixed_scale: int | None = None
) -> list[list[Cell]]:
    """Rows of a table of lengths: value, errors by earlier arms, error of the calibrated arm, and its U.

    ``fixed_scale``: index of the length that fixed the scale, so that its error is zero by construction.
    """
    found = []
    for i, row in enumerate(rows):
        expanded = row["expanded_mm"]
        decimals = decimals_for(expanded)
        error = number_cell(row["error_mm"], decimals, signed=True)
        found.append([
            text_cell(f"{row['from']} – {row['to']}"),
            number_cell(row["value_mm"]),
            *(number_cell(float(errors[i]), decimals, signed=True) for errors in before),
            text_cell("fixed the scale") if i == fixed_scale else error,
            number_cell(expanded, decimals),
        ])  # fmt: skip
    return found
