"""Tables and charts of repeatability and of lengths, which reports of calibrations and of evaluations share."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..data.capture import Capture
from . import charts
from .elements import Cell, Chart, Table, number, shown, text

_FIGURES = (
    ("de_mm", "DE, mean distance of poses from their socket's centroid"),
    ("deltam_mm", "Δm, largest half range of a coordinate in a socket"),
    ("rms_mm", "RMS distance of poses from their socket's centroid"),
    ("length_error_mean_absolute_mm", "length error, mean absolute"),
    ("length_error_largest_mm", "length error, largest"),
)
_FAR = 4.0  # median distances
_DRAWN, _LISTED = 2000, 1000  # poses in a chart, and in the table behind it
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
    """Poses more than four times as far from their centroid as the median of all; NaN: poses alone in their socket, which do not count."""
    known = distances[np.isfinite(distances)]
    typical = float(np.median(known)) if len(known) else 0.0
    return np.flatnonzero(distances > _FAR * typical) if typical > 1e-6 else np.zeros(0, dtype=int)


def shared_distances(capture: Capture, evaluation: Evaluation) -> np.ndarray:
    """Distances from the centroid; NaN where a pose is alone in its socket, since it shows no scatter."""
    alone = np.asarray(capture.sizes)[capture.owner] == 1
    return np.where(alone, np.nan, np.asarray(evaluation.distances))


def socket_table(capture: Capture, evaluation: Evaluation) -> Table:
    """Figures socket by socket."""
    spread = evaluation.repeatability
    far = np.bincount(capture.owner[outliers(shared_distances(capture, evaluation))], minlength=len(capture.names))
    rows = [
        [
            text(name),
            number(size, 0),
            *(
                number(float(np.asarray(figure)[i]) if size > 1 else None)
                for figure in (spread.socket_de, spread.socket_deltam, spread.socket_rms)
            ),
            number(int(far[i]), 0, mark="outlier" if far[i] else ""),
        ]
        for i, (name, size) in enumerate(zip(capture.names, capture.sizes, strict=True))
    ]
    return Table("Repeatability by socket [mm]", ("socket", "poses", "DE", "Δm", "RMS", "marked poses"), rows)


def residual_chart(
    id: str, title: str, capture: Capture, evaluations: Mapping[str, Evaluation], *, mark: bool = False
) -> Chart:
    """Distance of every pose from its socket's centroid, arm by arm, on a logarithmic axis; of very many the farthest as a table."""
    owner = capture.owner
    first = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    number_in = np.arange(len(owner)) - first[owner] + 1
    distances = {name: shared_distances(capture, evaluation) for name, evaluation in evaluations.items()}
    last = list(distances.values())[-1]
    known = np.flatnonzero(np.isfinite(last))
    if not len(known):
        return Chart(
            id,
            title,
            "Every socket was held in one pose only, so there is no scatter to show.",
            {"data": [], "layout": charts.layout("", "")},
        )
    drawn = known if len(known) <= _DRAWN else known[np.linspace(0, len(known) - 1, _DRAWN).round().astype(int)]
    far = outliers(last) if mark else np.zeros(0, dtype=int)
    drawn = np.union1d(drawn, far)
    styles = [(charts.LIGHT, "circle-open"), (charts.DARK, "circle")][-len(evaluations) :]
    traces = []
    for (name, values), (color, symbol) in zip(distances.items(), styles, strict=True):
        hover = [f"{capture.names[owner[i]]}, pose {number_in[i]}: {shown(float(values[i]))} mm ({name})" for i in drawn]
        traces.append(
            charts.dots(name, (drawn + 1).tolist(), np.maximum(values[drawn], _LEAST), color, symbol, hover=hover, size=5)
        )
    if len(far):
        hover = [f"{capture.names[owner[i]]}, pose {number_in[i]}: {shown(float(last[i]))} mm" for i in far]
        traces.append(
            charts.dots("far from its socket", (far + 1).tolist(), last[far], charts.WARM, "diamond-open", hover=hover, size=13)
        )
    borders = [] if len(capture.sizes) > 40 else charts.vertical((np.cumsum(capture.sizes)[:-1] + 0.5).tolist())
    x = "pose, socket after socket" if len(capture.sizes) > 1 else "pose"
    axis = charts.logarithmic(*([y for y in trace["y"] if y is not None] for trace in traces))
    layout = charts.layout(x, "distance [mm]", yaxis=axis, shapes=borders)
    words = "Dotted lines part the sockets. " if borders else ""
    words += f"Median as left {shown(float(np.median(last[known])))} mm, largest {shown(float(last[known].max()))} mm."
    words += " Poses alone in their socket have no distance." if len(known) < len(owner) else ""
    words += f" {len(drawn)} of {len(known)} poses are drawn." if len(drawn) < len(known) else ""
    return Chart(id, title, words, {"data": traces, "layout": layout}, _pose_table(capture, distances, number_in, far, mark))


def _pose_table(
    capture: Capture, distances: Mapping[str, np.ndarray], number_in: np.ndarray, far: np.ndarray, mark: bool
) -> Table:
    """Every pose, or of very many the farthest."""
    last = list(distances.values())[-1]
    chosen = np.arange(len(last))
    caption = "Every pose"
    if len(chosen) > _LISTED:
        chosen = np.argsort(-np.nan_to_num(last))[:_LISTED]
        caption = f"The {_LISTED} farthest of {len(last)} poses"
    marked = set(far.tolist())
    rows = [
        [
            text(capture.names[capture.owner[i]]),
            number(int(number_in[i]), 0),
            *(number(float(values[i]), 5) for values in distances.values()),
            *([text("far" if i in marked else "", "outlier" if i in marked else "")] if mark else []),
        ]
        for i in chosen.tolist()
    ]
    columns = ("socket", "pose", *(f"{name} [mm]" for name in distances), *(["marked"] if mark else []))
    return Table(caption, columns, rows)


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
