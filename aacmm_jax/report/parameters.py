"""The section on the parameters of a calibration: their values with U, their changes, and what joints do besides."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..calibration.joint_functions import function_of_joint
from ..calibration.record import CalibrationRecord
from ..core.units import DEG, people_read
from ..kinematics.corrections.kind import Term
from ..summaries.harmonics import harmonics_by_joint, listed_apart
from ..summaries.tables import decimals_for
from . import charts
from .elements import Chart, ReportTable, Section, format_number, number_cell, text_cell

_POINTS = 301  # of a curve
_COLUMNS = ("parameter", "unit", "calibrated", "U (95 %)", "change", "nominal", "")


def parameters_section(record: CalibrationRecord, summary: Mapping[str, Any]) -> Section:
    """Every parameter with its expanded uncertainty; hundreds of coefficients joint by joint, and on demand."""
    listed, harmonics = listed_apart(summary["parameters"])
    introduction = (
        "U is the expanded uncertainty (95 %), with the coverage factor of each parameter's own degrees of freedom. A "
        "parameter on a bound, or one that the data "
        "determine only together with others, has none of its own."
    )
    by_unit = {unit: [row for row in listed if row["unit"] == unit] for unit in ("mm", "rad")}
    changes = [_change_chart(unit, chosen) for unit, chosen in by_unit.items() if chosen]
    table = ReportTable("Parameters", _COLUMNS, _rows(listed))
    functions = [chart] if (chart := _functions_chart(record)) is not None else []
    blocks = [introduction, *changes, table, *functions]
    if harmonics:
        blocks += [
            f"The {len(harmonics)} coefficients of harmonics are not printed: they are in the table below on screen, "
            "and in the calibration's file (aacmm export --format csv).",
            _by_joint(harmonics),
            ReportTable("Coefficients of harmonics", _COLUMNS, _rows(harmonics), folded=True),
        ]
    return Section("parameters", "Parameters", blocks)


def _rows(parameters: Sequence[Mapping[str, Any]]) -> list[list]:
    rows = []
    for row in parameters:
        scale, unit = people_read(row["unit"])
        expanded = None if row["expanded"] is None else scale * row["expanded"]
        decimals = decimals_for(expanded)
        rounded = expanded is not None
        state = "" if expanded else "only with others"
        if row["bound"]:
            state = f"on the {row['bound']} bound" + (" of stage 1; U is that of k" if expanded else "")
        rows.append([
            text_cell(row["parameter"]),
            text_cell(unit),
            number_cell(scale * row["calibrated"], decimals, rounded=rounded),
            number_cell(expanded, decimals),
            number_cell(scale * (row["calibrated"] - row["nominal"]), decimals, signed=True, rounded=rounded),
            number_cell(scale * row["nominal"], max(decimals, 4)),
            text_cell(state, "unsure" if state else ""),
        ])  # fmt: skip
    return rows


def _by_joint(harmonics: Sequence[Mapping[str, Any]]) -> ReportTable:
    rows = []
    for row in harmonics_by_joint(harmonics):
        scale, unit = people_read(row["unit"])
        largest = row["largest"]
        expanded = None if largest["expanded"] is None else scale * largest["expanded"]
        decimals = decimals_for(expanded)
        rows.append([
            text_cell(row["joint"]),
            number_cell(row["coefficients"], 0),
            text_cell(row["orders"]),
            number_cell(scale * row["rms"], decimals),
            text_cell(largest["parameter"]),
            number_cell(scale * largest["calibrated"], decimals, signed=True, rounded=expanded is not None),
            number_cell(expanded, decimals),
            text_cell(unit),
        ])  # fmt: skip
    columns = ("joint", "coefficients", "orders", "RMS over a revolution", "largest", "its value", "its U", "unit")
    return ReportTable("Harmonics of the joints", columns, rows)


def _functions_chart(record: CalibrationRecord) -> Chart | None:
    """What each joint does besides its reading; None for an arm whose joints do what they read."""
    q = np.asarray(record.recording.capture.readings)
    plots = []
    for joint in range(1, record.calibrated.arm.joints + 1):
        found = function_of_joint(record, joint, q, _POINTS)
        if found is None:
            continue
        slides = joint in record.calibrated.arm.prismatic
        of, unit = (1.0, "mm") if slides else (DEG, "deg")
        at, value, expanded = found.reading / of, found.value / of, found.expanded / of
        low, high = value - expanded, value + expanded
        travel = q[:, joint - 1] / of
        marks = (
            charts.Marks("with U (95 %)", at, value, "band", "main", low=low, high=high),
            charts.Marks("", at, value, "line", "main"),
        )
        axes = (
            charts.linear(f"reading of joint {joint} [{unit}]", at, margin=0.02),
            charts.linear(unit, low, high, [0.0]),
        )
        ends = [float(travel.min()), float(travel.max())]
        plots.append(charts.Plot(*axes, marks, vertical=ends, horizontal=[0.0], height=150))
    if not plots:
        return None
    corrections = record.calibrated.arm.corrections
    terms = () if corrections is None else corrections.functions.terms
    kinds = {term.kind.description: term.kind.of_own_reading for term in terms if isinstance(term, Term)}
    drawn, others = ([each for each, own in kinds.items() if own is of] for of in (True, False))
    description = (
        f"Corrections of each joint by its own reading ({', '.join(drawn)}), less their mean, against the reading"
        + (f"; without {', '.join(others)}" if others else "")
        + ". Dotted lines are the ends of the travel that was measured."
    )
    return Chart("functions", "What the joints do besides their readings", description, tuple(plots))


def _change_chart(unit: str, parameters: Sequence[Mapping[str, Any]]) -> Chart:
    scale, label = people_read(unit)
    kind = "length" if unit == "mm" else "angle"
    names = [row["parameter"] for row in parameters]
    x, change = np.arange(len(names)), scale * np.array([row["calibrated"] - row["nominal"] for row in parameters])
    expanded = np.array([np.nan if row["expanded"] is None else scale * row["expanded"] for row in parameters])
    known = np.isfinite(expanded)
    decimals = [decimals_for(bar) if there else 4 for bar, there in zip(expanded.tolist(), known, strict=True)]
    hover = np.array([
        f"{name}: {format_number(value, digits, signed=True)} {label}"
        + (f", U {format_number(bar, digits)} {label}" if there else ", no uncertainty of its own")
        for name, value, bar, digits, there in zip(
            names, change.tolist(), expanded.tolist(), decimals, known.tolist(), strict=True
        )
    ])  # fmt: skip
    low, high = (change - expanded)[known], (change + expanded)[known]
    marks = [charts.Marks("with U (95 %)", x[known], change[known], "dot", "main", hover[known].tolist(), low, high)]
    # What has no uncertainty of its own has an arbitrary value: within the range of the others it has a cross.
    axis = charts.linear(f"change [{label}]", *((change[known], low, high) if np.any(known) else (change,)), [0.0])
    if not np.all(known):
        at = np.clip(change[~known], axis.low, axis.high)
        says = "without U of its own: known only together with others, or on a bound"
        marks.append(charts.Marks(says, x[~known], at, "cross", "accent", hover[~known].tolist()))
    outside = int(np.sum((change < axis.low) | (change > axis.high)))
    plot = charts.Plot(charts.names("", names), axis, tuple(marks), horizontal=[0.0], height=260)
    description = "Calibrated minus nominal; bars are U, and smaller than the mark where none is visible."
    if outside:
        description += f" At the edge: {outside} without U, whose values (in the table) lie outside."
    return Chart(f"change-{unit}", f"Change of {kind} parameters", description, (plot,))
