"""Tables and charts of repeatability and of lengths, which reports of calibrations and of evaluations share."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..capture import Capture
from ..evaluate import Evaluation
from . import charts
from .parts import Cell, Chart, Table, number, shown, text

_FIGURES = (
    ("de_mm", "DE, mean distance of poses from their socket's centroid"),
    ("deltam_mm", "Δm, largest half range of a coordinate in a socket"),
    ("rms_mm", "RMS distance of poses from their socket's centroid"),
    ("length_error_mean_absolute_mm", "length error, mean absolute"),
    ("length_error_largest_mm", "length error, largest"),
)
_FAR = 4.0  # median distances
_LEAST = 1e-5  # mm: what a logarithmic axis shows of a distance of zero


def figures_table(caption: str, summary: Mapping[str, Any], stages: Mapping[str, str], *, fixed_scale: bool = False) -> Table:
    """Repeatability and length errors, one column an arm; the error of a single length that fixed the scale is none."""
    first, last = next(iter(stages)), list(stages)[-1]

    def cell(stage: str, key: str) -> Cell:
        if fixed_scale and stage == last and key.startswith("length"):
            return text("fixed the scale")
        return number(summary[stage].get(key))

    rows = [[text(title), *(cell(stage, key) for stage in stages)] for key, title in _FIGURES if key in summary[first]]
    return Table(caption, ("", *stages.values()), rows)


def outliers(distances: np.ndarray) -> np.ndarray:
    """Poses more than four times as far from their centroid as the median of all."""
    typical = float(np.median(distances))
    return np.flatnonzero(distances > _FAR * typical) if typical > 1e-6 else np.zeros(0, dtype=int)


def socket_table(capture: Capture, evaluation: Evaluation) -> Table:
    """Figures socket by socket."""
    spread = evaluation.repeatability
    far = np.bincount(capture.owner[outliers(np.asarray(evaluation.distances))], minlength=len(capture.names))
    rows = [
        [
            text(name),
            number(size, 0),
            *(number(float(np.asarray(figure)[i])) for figure in (spread.socket_de, spread.socket_deltam, spread.socket_rms)),
            number(int(far[i]), 0, mark="outlier" if far[i] else ""),
        ]
        for i, (name, size) in enumerate(zip(capture.names, capture.sizes, strict=True))
    ]
    return Table("Repeatability by socket [mm]", ("socket", "poses", "DE", "Δm", "RMS", "marked poses"), rows)


def residual_chart(
    id: str, title: str, capture: Capture, evaluations: Mapping[str, Evaluation], *, mark: bool = False
) -> Chart:
    """Distance of every pose from its socket's centroid, arm by arm, on a logarithmic axis."""
    owner = capture.owner
    first = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    labels = [f"{capture.names[i]}, pose {place - first[i] + 1}" for place, i in enumerate(owner)]
    poses = np.arange(1, len(owner) + 1)
    styles = [(charts.LIGHT, "circle-open"), (charts.DARK, "circle")][-len(evaluations) :]
    traces, far = [], np.zeros(0, dtype=int)
    for (name, evaluation), (color, symbol) in zip(evaluations.items(), styles, strict=True):
        distances = np.asarray(evaluation.distances)
        hover = [f"{label}: {shown(value)} mm ({name})" for label, value in zip(labels, distances, strict=True)]
        traces.append(charts.dots(name, poses.tolist(), np.maximum(distances, _LEAST), color, symbol, hover=hover, size=5))
        if mark:
            far = outliers(distances)
            marked = charts.dots(
                "far from its socket", poses[far].tolist(), distances[far], charts.WARM, "diamond-open", size=13
            )
            traces += [marked | {"text": [charts.plain(hover[i]) for i in far], "hoverinfo": "text"}] if len(far) else []
    borders = [] if len(capture.sizes) > 40 else charts.vertical((np.cumsum(capture.sizes)[:-1] + 0.5).tolist())
    x = "pose, socket after socket" if len(capture.sizes) > 1 else "pose"
    layout = charts.layout(x, "distance [mm]", yaxis=charts.logarithmic(*(trace["y"] for trace in traces)), shapes=borders)
    last = np.asarray(list(evaluations.values())[-1].distances)
    rows = [
        [
            text(capture.names[i]),
            number(int(place - first[i] + 1), 0),
            *(number(float(np.asarray(evaluation.distances)[place]), 5) for evaluation in evaluations.values()),
            *([text("far" if place in far else "", "outlier" if place in far else "")] if mark else []),
        ]
        for place, i in enumerate(owner)
    ]
    columns = ("socket", "pose", *(f"{name} [mm]" for name in evaluations), *(["marked"] if mark else []))
    words = "Dotted lines part the sockets. " if borders else ""
    words += f"Median as left {shown(float(np.median(last)))} mm, largest {shown(float(last.max()))} mm."
    return Chart(id, title, words, {"data": traces, "layout": layout}, Table("Every pose", columns, rows))


def length_rows(
    rows: Sequence[Mapping[str, Any]], factor: float, before: Mapping[str, np.ndarray], fixed_scale: bool = False
) -> list[list[Cell]]:
    """One row a length: value, errors by earlier arms, error as left (unless it fixed the scale), and U of it."""
    return [
        [
            text(f"{row['from']} – {row['to']}"),
            number(row["value_mm"]),
            *(number(float(errors[i]), signed=True) for errors in before.values()),
            text("fixed the scale") if fixed_scale else number(row["error_mm"], signed=True),
            number(None if row["error_u_mm"] is None else factor * row["error_u_mm"]),
        ]
        for i, row in enumerate(rows)
    ]
