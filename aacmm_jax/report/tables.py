"""Tables and charts that reports of calibrations and of evaluations have in common."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..data.capture import Capture
from ..diagnostics.pose_residuals import distances_of
from ..model.metrics import pose_outliers
from ..plot.charts import Chart
from ..plot.residuals import Groups, Marked, distances_in, pose_chart
from ..summaries.result_tables import BY_CONSTRUCTION, with_u_digits
from ..summaries.tables import Cell, Table, by_columns, decimals_for, listed, number, numbers

DRAWN, _LISTED = 1000, 400  # most poses in a chart, and in its table


def socket_table(capture: Capture, evaluation: Evaluation) -> Table:
    """Repeatability and number of outliers, socket by socket."""
    scatter = evaluation.repeatability
    outliers, _ = pose_outliers(np.asarray(evaluation.distances), capture.sizes)
    far = np.bincount(capture.owner[outliers], minlength=len(capture.names)).tolist()
    scattered = np.asarray(capture.sizes) > 1
    metrics = {"DE": scatter.socket_de, "Deltam": scatter.socket_deltam, "RMS": scatter.socket_rms}
    columns = {
        "socket": capture.names,
        "poses": capture.sizes,
        **{name: numbers(np.where(scattered, values, np.nan)) for name, values in metrics.items()},
        "marked poses": [number(count, 0, mark="outlier" if count else "") for count in far],
    }
    return by_columns("Repeatability by socket [mm]", columns)


def residual_chart(capture: Capture, evaluation: Evaluation) -> Chart:
    """Distances of all poses by the calibrated arm; those far off are marked, and a table lists the largest."""
    groups, distances = Groups.of(capture), distances_in(capture, evaluation)
    far = pose_outliers(np.concatenate(distances_of(capture, evaluation)), groups.sizes)[0]
    says = "far from its socket" if groups.word == "socket" else "far from its geometry"
    title = "Residuals of the calibrated arm"
    chart = pose_chart("residuals", title, groups, {"calibrated": distances}, far=(says, far), most=DRAWN)
    return chart._replace(table=pose_table(groups, distances, "mm", (says, far)))


def pose_table(groups: Groups, residuals: np.ndarray, unit: str, far: Marked | None = None) -> Table:
    """The residual of every pose, or of those of very many that have the largest; and which are marked, and why."""
    chosen, caption = np.arange(len(residuals)), "Every pose"
    if len(chosen) > _LISTED:
        chosen = np.argsort(-np.nan_to_num(residuals))[:_LISTED]
        caption = f"The {_LISTED} farthest of {len(residuals)} poses"
    owner, numbers = groups.owner, groups.numbers
    says, marked = ("", set()) if far is None else (far[0], set(np.asarray(far[1]).tolist()))
    return listed(
        caption,
        chosen.tolist(),
        {
            groups.word: lambda i: groups.names[owner[i]],
            "pose": lambda i: int(numbers[i]),
            f"calibrated [{unit}]": lambda i: number(float(residuals[i]), 5),
            "marked": None if far is None else lambda i: Cell(says, None, "outlier") if i in marked else "",
        },
    )


def length_table(
    caption: str,
    rows: Sequence[Mapping[str, Any]],
    before: Mapping[str, np.ndarray],
    fixed_scale: int | None = None,
) -> Table:
    """Lengths: value, errors by earlier arms, error of the calibrated arm, and its U.

    ``fixed_scale``: index of the length that fixed the scale, so that its error is zero by construction.
    """

    def error(i: int, value: float) -> Cell:
        return number(value, decimals_for(rows[i]["expanded_mm"]), signed=True)

    return listed(
        caption,
        range(len(rows)),
        {
            "between": lambda i: f"{rows[i]['from']} – {rows[i]['to']}",
            "value": lambda i: rows[i]["value_mm"],
            **{f"error, {arm}": lambda i, errors=errors: error(i, float(errors[i])) for arm, errors in before.items()},
            "error, calibrated": lambda i: BY_CONSTRUCTION if i == fixed_scale else error(i, rows[i]["error_mm"]),
            "U of error": lambda i: with_u_digits(rows[i]["expanded_mm"]),
        },
    )
