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
from ..summaries.tables import METRICS, Cell, Table, by_columns, decimals_for, listed, number, numbers

DRAWN, _LISTED = 1000, 400  # most poses in a chart, and in its table


def metrics_table(
    caption: str, summary: Mapping[str, Any], stages: Mapping[str, str], *, fixed_scale: bool = False
) -> Table:
    """Repeatability and length errors, one column per arm.

    ``fixed_scale``: a single length fixed the scale of the last arm, so its error is zero by construction.
    """
    last = list(stages)[-1]

    def value(stage: str, key: str) -> Cell | str:
        by_construction = fixed_scale and stage == last and key.startswith("length")
        return "fixed the scale" if by_construction else number(summary[stage].get(key))

    rows = [(key, title) for key, title in METRICS if key in summary[next(iter(stages))]]
    columns = {words: lambda row, stage=stage: value(stage, row[0]) for stage, words in stages.items()}
    return listed(caption, rows, {"": lambda row: row[1]} | columns)


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
            "error, calibrated": lambda i: "fixed the scale" if i == fixed_scale else error(i, rows[i]["error_mm"]),
            "U of error": lambda i: with_u_digits(rows[i]["expanded_mm"]),
        },
    )


def with_u_digits(u: float | None, mark: str = "") -> Cell:
    """An uncertainty, to two digits."""
    return number(u, decimals_for(u), mark=mark)


def validation_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Cross-validation, pooled and group by group, the most improbable group first."""
    pooled = [
        (title, summary[value], summary[predicted])
        for title, value, predicted in (
            ("RMS distance of poses from their socket's centroid or geometry", "rms_mm", "rms_predicted_mm"),
            ("RMS error of reference lengths", "length_error_rms_mm", "length_u_mm"),
        )
        if summary[value] is not None
    ]
    caption = f"Cross-validated: each of {summary['groups']} groups held out once [mm]"
    columns = {"": lambda row: row[0], "residual": lambda row: row[1], "predicted by u": lambda row: row[2]}
    groups = {
        "group held out": "group",
        "poses": "poses",
        "RMS distance": "rms_mm",
        "predicted": "rms_predicted_mm",
        "RMS length error": "length_error_rms_mm",
        "u": "length_u_mm",
        "by chance [%]": lambda row: number(None if row["probability"] is None else 100 * row["probability"], 2),
        "": lambda row: "disagrees" if row["disagrees"] else "",
    }
    rows = summary.get("left_out")
    return [listed(caption, pooled, columns), *([listed("Groups held out [mm]", rows, groups)] if rows else [])]
