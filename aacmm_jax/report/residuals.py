"""Tables and charts of repeatability and of lengths, common to reports of calibrations and of evaluations."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..data.capture import Capture
from ..model.metrics import pose_outliers
from ..summaries.tables import METRICS
from . import charts
from .elements import Cell, Chart, ReportTable, format_number, number_cell, text_cell

_DRAWN, _LISTED = 2000, 1000  # most poses in a chart, and in its table
_LEAST = 1e-5  # mm: a distance of zero on a logarithmic axis


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


def _outliers(capture: Capture, evaluation: Evaluation) -> np.ndarray:
    return pose_outliers(np.asarray(evaluation.distances), capture.sizes)[0]


def pose_distances(capture: Capture, evaluation: Evaluation) -> np.ndarray:
    """Distances from the centroid, mm; NaN for a pose that is the only one of its socket, since it shows no scatter."""
    single = np.asarray(capture.sizes)[capture.owner] == 1
    return np.where(single, np.nan, np.asarray(evaluation.distances))


def socket_table(capture: Capture, evaluation: Evaluation) -> ReportTable:
    """Repeatability and number of outliers, socket by socket."""
    found = evaluation.repeatability
    metrics = [np.asarray(column) for column in (found.socket_de, found.socket_deltam, found.socket_rms)]
    far = np.bincount(capture.owner[_outliers(capture, evaluation)], minlength=len(capture.names))
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
    """Distance of every pose from its socket's centroid, by arm, on a logarithmic axis.

    ``mark``: outliers of the last arm are marked. The table lists at most the 1000 farthest poses.
    """
    owner = capture.owner
    first = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    labels = [f"{capture.names[socket]}, pose {i - first[socket] + 1}" for i, socket in enumerate(owner)]
    distances = {name: pose_distances(capture, evaluation) for name, evaluation in evaluations.items()}
    last = list(distances.values())[-1]
    known = np.flatnonzero(np.isfinite(last))
    if not len(known):
        empty = {"data": [], "layout": charts.layout("", "")}
        return Chart(id, title, "Every socket has one pose only, so there is no scatter to show.", empty)
    far = _outliers(capture, list(evaluations.values())[-1]) if mark else np.zeros(0, dtype=int)
    drawn = known if len(known) <= _DRAWN else known[np.linspace(0, len(known) - 1, _DRAWN).round().astype(int)]
    drawn = np.union1d(drawn, far)
    styles = [(charts.LIGHT, "circle-open"), (charts.DARK, "circle")][-len(evaluations) :]
    traces = []
    for (name, values), (color, symbol) in zip(distances.items(), styles, strict=True):
        hover = [f"{labels[i]}: {format_number(float(values[i]))} mm ({name})" for i in drawn]
        y = np.maximum(values[drawn], _LEAST)
        traces.append(charts.markers(name, (drawn + 1).tolist(), y, color, symbol, hover=hover, size=5))
    if len(far):
        hover = [f"{labels[i]}: {format_number(float(last[i]))} mm" for i in far]
        style = {"hover": hover, "size": 13}
        traces.append(
            charts.markers("far from its socket", (far + 1).tolist(), last[far], charts.WARM, "diamond-open", **style)
        )
    borders = [] if len(capture.sizes) > 40 else charts.vertical((np.cumsum(capture.sizes)[:-1] + 0.5).tolist())
    x = "pose, socket after socket" if len(capture.sizes) > 1 else "pose"
    axis = charts.logarithmic(*([y for y in trace["y"] if y is not None] for trace in traces))
    layout = charts.layout(x, "distance [mm]", yaxis=axis, shapes=borders)
    median, largest = (format_number(float(reduced)) for reduced in (np.median(last[known]), last[known].max()))
    description = "Dotted lines separate the sockets. " if borders else ""
    description += f"Median {median} mm, largest {largest} mm ({list(evaluations)[-1]} arm)."
    description += " The only pose of a socket has no distance." if len(known) < len(owner) else ""
    description += f" {len(drawn)} of {len(known)} poses are drawn." if len(drawn) < len(known) else ""
    table = _pose_table(capture, distances, far, mark)
    return Chart(id, title, description, {"data": traces, "layout": layout}, table)


def _pose_table(capture: Capture, distances: Mapping[str, np.ndarray], far: np.ndarray, mark: bool) -> ReportTable:
    """Every pose, or the farthest of very many."""
    last = list(distances.values())[-1]
    chosen, caption = np.arange(len(last)), "Every pose"
    if len(chosen) > _LISTED:
        chosen = np.argsort(-np.nan_to_num(last))[:_LISTED]
        caption = f"The {_LISTED} farthest of {len(last)} poses"
    first, marked = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]]), set(far.tolist())
    rows = [
        [
            text_cell(capture.names[capture.owner[i]]),
            number_cell(int(i - first[capture.owner[i]] + 1), 0),
            *(number_cell(float(values[i]), 5) for values in distances.values()),
            *([text_cell("far" if i in marked else "", "outlier" if i in marked else "")] if mark else []),
        ]
        for i in chosen.tolist()
    ]
    columns = ("socket", "pose", *(f"{name} [mm]" for name in distances), *(["marked"] if mark else []))
    return ReportTable(caption, columns, rows)


def length_rows(
    rows: Sequence[Mapping[str, Any]], factor: float, before: Sequence[np.ndarray], fixed_scale: int | None = None
) -> list[list[Cell]]:
    """Rows of a table of lengths: value, errors by earlier arms, error of the calibrated arm, and its U.

    ``fixed_scale``: index of the length that fixed the scale, so that its error is zero by construction.
    """
    return [
        [
            text_cell(f"{row['from']} – {row['to']}"),
            number_cell(row["value_mm"]),
            *(number_cell(float(errors[i]), signed=True) for errors in before),
            text_cell("fixed the scale") if i == fixed_scale else number_cell(row["error_mm"], signed=True),
            number_cell(None if row["error_u_mm"] is None else factor * row["error_u_mm"]),
        ]
        for i, row in enumerate(rows)
    ]
