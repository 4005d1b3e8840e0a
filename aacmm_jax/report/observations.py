"""Tables of the report of a calibration from observations: what was observed and left out, residuals, the geometry."""

from typing import Any

from ..calibration.record import CalibrationRecord
from ..diagnostics.pose_residuals import observation_residuals
from ..summaries.observations import capture_observations
from ..summaries.tables import Table, format_number, listed, number, quantity_words


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
