"""Tables and charts of reports that are made of captures and evaluations, not of summaries."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.record import CalibrationRecord
from ..data.capture import Capture
from ..diagnostics.pose_residuals import distances_of, observation_residuals
from ..model.sockets import pose_outliers
from ..plot.charts import Chart
from ..plot.residuals import Groups, distances_in, pose_chart
from ..summaries.observations import capture_observations
from ..summaries.result_tables import BY_CONSTRUCTION, with_u_digits
from ..summaries.tables import (
    Cell,
    Table,
    by_columns,
    decimals_for,
    format_number,
    listed,
    number,
    numbers,
    quantity_words,
)

DRAWN = 1000  # most poses in a chart


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
    return pose_chart("residuals", title, groups, {"calibrated": distances}, far=(says, far), most=DRAWN)


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


def observation_tables(record: CalibrationRecord) -> list[Table]:
    """What was observed besides sockets and lengths, what is certified of it, and what else was stated."""
    capture = record.recording.capture
    if not capture.observations:
        return []
    u = {part.observation.name: part.u for part in observation_residuals(record)}
    rows = capture_observations(capture)
    certified = [{"observation": row["observation"]} | quantity for row in rows for quantity in row["certified"]]
    columns = {
        "observation": "observation",
        "kind": "kind",
        "tip": lambda row: row["target"] or "own probe",
        "poses": "poses",
        "unknown geometry": lambda row: ", ".join(row["unknowns"]),
        "u of what was measured [mm]": lambda row: number(u[row["observation"]] or None),
        "stated": lambda row: "; ".join(f"{quantity['quantity']} {_words(quantity)}" for quantity in row["stated"]),
    }
    if not any(row["stated"] for row in rows):
        del columns["stated"]
    if not any(u[row["observation"]] for row in rows):
        del columns["u of what was measured [mm]"]
    of_certified = {
        "observation": "observation",
        "quantity": "quantity",
        "certified value": _words,
        "u [mm]": lambda quantity: "taken as exact" if quantity["u"] == 0 else number(quantity["u"]),
    }
    tables = [listed("Observations", rows, columns)]
    return [*tables, *([listed("Certified values", certified, of_certified)] if certified else [])]


def removed_tables(record: CalibrationRecord) -> list[Table]:
    """What was left out because it contradicts the rest, why, and what that changed."""
    columns = {
        "group": lambda left_out: left_out.group,
        "kind": lambda left_out: left_out.kind,
        "its sockets and observations": lambda left_out: ", ".join(left_out.members),
        "F": lambda left_out: number(left_out.ratio, 1),
        "degrees of freedom": lambda left_out: "{} and {}".format(*left_out.degrees_of_freedom),
        "p": lambda left_out: left_out.probability if left_out.probability >= 1e-4 else "< 0.0001",
        "RMS of the rest, with it [mm]": lambda left_out: left_out.rms_with,
        "without it [mm]": lambda left_out: left_out.rms_without,
        "changed most": lambda left_out: f"{left_out.changed_most}, by {format_number(left_out.change, 1)} u",
    }
    caption = "Left out, because it contradicts the rest"
    return [listed(caption, record.removed, columns)] if record.removed else []


def _words(quantity: dict[str, Any]) -> str:
    return quantity_words(quantity, u=False).replace("-", "−")
