"""Parts of the report of a calibration from observations: what was observed, residuals, the geometry found."""

from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.text import pluralise
from ..core.units import DEG
from ..diagnostics.pose_residuals import ObservationResiduals, observation_residuals
from ..model.metrics import pose_outliers
from ..summaries.observations import capture_observations
from ..summaries.tables import expanded_words, quantity_words
from .elements import Cell, Chart, ReportTable, Section, format_number, number_cell, text_cell
from .residuals import Groups, pose_chart

_LITTLE_WEIGHT = "half of its weight or less"


def observation_tables(record: CalibrationRecord) -> list[ReportTable]:
    """What was observed besides sockets and lengths, what is certified of it, and what else was stated."""
    capture = record.recording.capture
    if not capture.observations:
        return []
    residuals = {one.observation.name: one for one in observation_residuals(record)}
    rows, certified = [], []
    for row in capture_observations(capture):
        one = residuals[row["observation"]]
        stated = "; ".join(f"{quantity['quantity']} {_words(quantity)}" for quantity in row["stated"])
        rows.append([
            text_cell(row["observation"]),
            text_cell(row["kind"]),
            text_cell(row["target"] or "own probe"),
            number_cell(row["poses"], 0),
            text_cell(", ".join(row["unknowns"])),
            number_cell(one.u or None),
            text_cell(stated),
        ])  # fmt: skip
        certified += [
            [
                text_cell(row["observation"]),
                text_cell(quantity["quantity"]),
                text_cell(_words(quantity)),
                text_cell("taken as exact") if quantity["u"] == 0 else number_cell(quantity["u"]),
            ]
            for quantity in row["certified"]
        ]
    columns = ["observation", "kind", "tip", "poses", "unknown geometry", "u of what was measured [mm]", "stated"]
    for number, empty in ((6, ""), (5, "–")):  # the last first
        if all(row[number].text == empty for row in rows):
            columns.pop(number)
            rows = [row[:number] + row[number + 1 :] for row in rows]
    tables = [ReportTable("Observations", tuple(columns), rows)]
    if certified:
        columns = ("observation", "quantity", "certified value", "u [mm]")
        tables.append(ReportTable("Certified values", columns, certified))
    return tables


def removed_tables(record: CalibrationRecord) -> list[ReportTable]:
    """What was left out because it contradicts the rest, why, and what that changed."""
    if not record.removed:
        return []
    rows = [
        [
            text_cell(one.group),
            text_cell(one.kind),
            text_cell(", ".join(one.members)),
            number_cell(one.ratio, 1),
            text_cell("{} and {}".format(*one.degrees_of_freedom)),
            number_cell(one.probability) if one.probability >= 1e-4 else text_cell("< 0.0001"),
            number_cell(one.rms_with),
            number_cell(one.rms_without),
            text_cell(f"{one.changed_most}, by {format_number(one.change, 1)} u"),
        ]
        for one in record.removed
    ]
    columns = ("group", "kind", "its sockets and observations", "F", "degrees of freedom", "p")
    changed = ("RMS of the rest, with it [mm]", "without it [mm]", "changed most")
    return [ReportTable("Left out, because it contradicts the rest", (*columns, *changed), rows)]


def _words(quantity: dict[str, Any], coverage: float | None = None) -> str:
    return quantity_words(quantity, u=False, coverage=coverage).replace("-", "−")


def agreement_tables(summary: dict[str, Any]) -> list[ReportTable]:
    """Root mean square residuals by kind and by observation, nominal and calibrated."""
    tables = []
    angles = any(row["rms_angle_rad"] is not None for row in summary["observations"])
    for key, names in (("kinds", ("kind", "observations")), ("observations", ("observation", "kind"))):
        if key == "kinds" and len(summary["kinds"]) == len(summary["observations"]):
            continue  # the other table says the same
        rows = []
        for row in summary[key]:
            cells = [
                number_cell(row[key_], 0) if isinstance(row[key_], int) else text_cell(row[key_]) for key_ in names
            ]
            cells += [number_cell(row["poses"], 0), *(number_cell(row[f"rms_{when}_mm"]) for when in _STAGES)]
            cells += [_in_degrees(row["rms_angle_rad"])] if angles else []
            rows.append([*cells, number_cell(row["reduced_chi"], 2)])
        columns = (*names, "poses", "nominal [mm]", "calibrated [mm]", *(["calibrated [deg]"] if angles else []))
        caption = "RMS residuals by " + ("kind" if key == "kinds" else "observation")
        tables.append(ReportTable(caption, (*columns, "calibrated, in standard deviations"), rows))
    return tables


_STAGES = ("before", "after")


def _in_degrees(angle: float | None) -> Cell:
    return number_cell(None if angle is None else angle / DEG)


def stages_chart(record: CalibrationRecord, nominal: tuple[np.ndarray, ...]) -> Chart:
    """Distances of all poses from their geometry by the nominal arm, whose residuals are given, and the calibrated."""
    left = [one.distance for one in observation_residuals(record)]
    residuals = {"nominal": np.concatenate(nominal), "calibrated": np.concatenate(left)}
    title = "Distance of every pose from its geometry"
    return pose_chart("stages", title, Groups.of(record.recording.capture), residuals)._replace(table=None)


def other_poses_table(summary: dict[str, Any]) -> list[ReportTable]:
    """How the calibrated arm agrees with poses that it was not calibrated with."""
    found = summary.get("other_poses")
    if found is None:
        return []
    rows = [
        [
            text_cell(row["observation"]),
            number_cell(row["poses"], 0),
            number_cell(row["rms_mm"]),
            _in_degrees(row["rms_angle_rad"]),
        ]
        for row in found["observations"]
    ]
    caption = f"{pluralise(found['poses'], 'other pose')}, not calibrated with: RMS {format_number(found['rms_mm'])} mm"
    return [ReportTable(caption, ("observation", "poses", "RMS [mm]", "RMS [deg]"), rows)]


def residuals_section(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    """Residuals of the calibrated arm, pose by pose, in mm, in standard deviations and of orientations; and the poses
    that a robust loss took weight from."""
    found, groups = observation_residuals(record), Groups.of(record.recording.capture)
    normalised = np.concatenate([one.normalised for one in found])
    introduction = (
        "The distance of each pose's tip from the geometry of its observation, by the calibrated arm, in mm and in "
        "standard deviations of what was measured and of the arm's own scatter together (the root mean square over the "
        "coordinates of a pose, about 1). "
    )
    blocks: list = [introduction]
    if summary["robust"]:
        weight = np.concatenate([one.weight for one in found])
        far, says = np.flatnonzero(weight <= 0.5), _LITTLE_WEIGHT
        blocks.append(_weights_table(summary))
    else:
        far, says = pose_outliers(normalised, groups.sizes)[0], "far from its geometry"
        blocks[0] += "Poses more than eight times as far, in standard deviations, as the median are marked."
    distance = np.concatenate([one.distance for one in found])
    marks = {"far": far, "far_says": says}
    blocks += [
        pose_chart("residuals", "Residuals in mm", groups, {"calibrated": distance}, **marks),
        pose_chart(
            "normalised",
            "Residuals in standard deviations",
            groups,
            {"calibrated": normalised},
            unit="standard deviations",
            axis="residual",
            normal=1.0,
            **marks,
        ),
    ]
    if any(one.angle is not None for one in found):
        blocks.append(_angle_chart(found, groups))
    return Section("residuals", "Residuals by observation and pose", blocks)


def _angle_chart(found: tuple[ObservationResiduals, ...], groups: Groups) -> Chart:
    kept = [i for i, one in enumerate(found) if one.angle is not None]
    angles = np.concatenate([np.asarray(found[i].angle) for i in kept]) / DEG
    of = Groups(tuple(groups.names[i] for i in kept), tuple(groups.sizes[i] for i in kept), groups.word)
    return pose_chart("angles", "Residuals of orientations", of, {"calibrated": angles}, unit="deg", axis="angle")


def _weights_table(summary: dict[str, Any]) -> ReportTable:
    rows = [
        [
            text_cell(row["observation"]),
            number_cell(row["pose"], 0),
            number_cell(row["weight"], 3),
            number_cell(row["residual_mm"]),
            number_cell(row["normalised"], 1),
        ]
        for row in summary["less_weight"]
    ]
    caption = f"Poses that the robust loss ({summary['robust']}) took half of their weight from or more, and why"
    columns = ("observation", "pose", "weight", "residual [mm]", "residual in standard deviations")
    return ReportTable(caption, columns, rows)


def geometry_section(summary: dict[str, Any]) -> Section:
    """Every part of the unknown geometry as found, beside what is certified of it."""
    rows, factor = [], summary["uncertainty"]["coverage_factor_geometry_95"]
    for part in summary["geometry"]:
        # What is certified has its numbers in the order of the quantities.
        errors = None if part["certified"] is None else np.abs(np.subtract(part["values"], part["certified"]))
        for quantity in part["quantities"]:
            difference = None
            if errors is not None:
                count = len(quantity["values"])
                difference, errors = float(errors[:count].max()), errors[count:]
            cells = (part["part"], quantity["quantity"], _words(quantity, factor), expanded_words(quantity, factor))
            rows.append([*map(text_cell, cells), text_cell("") if difference is None else number_cell(difference)])
    introduction = (
        "The geometry that was unknown, as found with the parameters: positions and frames in the base frame, "
        "rotations as vectors along their axis; offsets and orientations of targets in the last frame; placements on "
        "an indexed platform in the platform's frame."
    )
    columns = ("part", "quantity", "found", "U (95 %)", "largest difference from the certified values [mm]")
    if all(part["certified"] is None for part in summary["geometry"]):
        columns, rows = columns[:-1], [row[:-1] for row in rows]
    return Section("geometry", "Geometry found", [introduction, ReportTable("Geometry found", columns, rows)])
