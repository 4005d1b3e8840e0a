"""Tables of the report of a calibration from observations: what was observed and left out, residuals, the geometry."""

from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.text import pluralise
from ..core.units import DEG
from ..diagnostics.pose_residuals import observation_residuals
from ..summaries.observations import capture_observations
from ..summaries.tables import Cell, Table, expanded_words, format_number, listed, number, quantity_words


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


def _words(quantity: dict[str, Any], coverage: float | None = None) -> str:
    return quantity_words(quantity, u=False, coverage=coverage).replace("-", "−")


def agreement_tables(summary: dict[str, Any]) -> list[Table]:
    """Root mean square residuals by kind and by observation, nominal and calibrated."""
    angles = any(row["rms_angle_rad"] is not None for row in summary["observations"])
    columns = {
        "poses": "poses",
        "nominal [mm]": "rms_before_mm",
        "calibrated [mm]": "rms_after_mm",
        "calibrated [deg]": _in_degrees if angles else None,
        "calibrated, in standard deviations": lambda row: number(row["reduced_chi"], 2),
    }
    by_kind, by_observation = (
        listed(f"RMS residuals by {first}", summary[f"{first}s"], {first: first, second: second} | columns)
        for first, second in (("kind", "observations"), ("observation", "kind"))
    )
    # Where each kind was observed once, both say the same.
    return [by_observation] if len(by_kind.rows) == len(by_observation.rows) else [by_kind, by_observation]


def _in_degrees(row: dict[str, Any]) -> Cell:
    angle = row["rms_angle_rad"]
    return number(None if angle is None else angle / DEG)


def other_poses_table(summary: dict[str, Any]) -> list[Table]:
    """How the calibrated arm agrees with poses that it was not calibrated with."""
    other = summary.get("other_poses")
    if other is None:
        return []
    caption = f"{pluralise(other['poses'], 'other pose')}, not calibrated with: RMS {format_number(other['rms_mm'])} mm"
    columns = {"observation": "observation", "poses": "poses", "RMS [mm]": "rms_mm", "RMS [deg]": _in_degrees}
    return [listed(caption, other["observations"], columns)]


def weights_table(summary: dict[str, Any]) -> Table:
    """The poses that a robust loss took weight from."""
    columns = {
        "observation": "observation",
        "pose": "pose",
        "weight": lambda row: number(row["weight"], 3),
        "residual [mm]": "residual_mm",
        "residual in standard deviations": lambda row: number(row["normalised"], 1),
    }
    caption = f"Poses that the robust loss ({summary['robust']}) took half of their weight from or more, and why"
    return listed(caption, summary["less_weight"], columns)


def geometry_table(summary: dict[str, Any]) -> Table:
    """Every part of the unknown geometry, beside what is certified of it."""
    rows, factor = [], summary["uncertainty"]["coverage_factor_geometry_95"]
    for part in summary["geometry"]:
        # What is certified has its numbers in the order of the quantities.
        errors = None if part["certified"] is None else np.abs(np.subtract(part["values"], part["certified"]))
        for quantity in part["quantities"]:
            count = len(quantity["values"])
            difference = "" if errors is None else float(errors[:count].max())
            errors = None if errors is None else errors[count:]
            rows.append(quantity | {"part": part["part"], "difference": difference})
    certified = any(part["certified"] is not None for part in summary["geometry"])
    columns = {
        "part": "part",
        "quantity": "quantity",
        "value": lambda row: _words(row, factor),
        "U (95 %)": lambda row: expanded_words(row, factor),
        "largest difference from the certified values [mm]": "difference" if certified else None,
    }
    return listed("Geometry found", rows, columns)
