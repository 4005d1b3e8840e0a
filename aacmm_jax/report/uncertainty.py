"""Sections on uncertainty in the report of a calibration: volume, correlations, observability, bounds, Monte Carlo."""

import math
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.units import people_read
from ..kinematics.arm import parameter_unit
from ..summaries.tables import encoders_in_words, volume_rows
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.identifiability import Observability
from ..uncertainty.volume import VolumetricUncertainty
from . import charts
from .elements import Chart, ReportTable, Section, format_number, number_cell, text_cell

_INDICES = {
    "O1": "geometric mean of the singular values (Menq, Borm)",
    "O2": "smallest over largest (Driels, Pathre)",
    "O3": "smallest (Nahvi)",
    "O4": "smallest squared over largest (Nahvi, Hollerbach)",
    "O5": "harmonic sum (Sun, Hollerbach)",
}


def volume_section(volume: VolumetricUncertainty, summary: dict[str, Any], factor: float) -> Section:
    """Expanded uncertainty of tips and lengths over the working volume."""
    found = summary["uncertainty"]["volume"]
    length = f"{volume.length:g} mm length"
    rows = [[text_cell(title), *map(number_cell, values)] for title, values in volume_rows(found, factor)]
    low, high = volume.start.min(axis=0), volume.start.max(axis=0)
    box = ", ".join(f"{axis} from {a:.0f} to {b:.0f}" for axis, a, b in zip("xyz", low, high, strict=True))
    introduction = (
        f"At {len(volume.start)} positions that random poses within the joint limits reach ({box} mm), "
        f"expanded to 95 % with the factor {factor:.2f}."
    )
    table = ReportTable(
        "Expanded uncertainty over the working volume [mm]", ("", "median", "95th percentile", "largest"), rows
    )
    chart = _volume_chart(volume, factor, length)
    return Section(
        "volume",
        "Uncertainty over the working volume",
        [introduction, table, chart, _noise_sentence(summary["uncertainty"])],
    )


def _volume_chart(volume: VolumetricUncertainty, factor: float, length: str) -> Chart:
    expanded = factor * volume.u_length
    known = np.isfinite(expanded)
    radius = np.hypot(volume.start[:, 0], volume.start[:, 1])
    scale = expanded[known] / max(float(expanded[known].max(initial=0.0)), 1e-12)
    hover = [
        f"({', '.join(f'{x:.0f}' for x in point)}) mm: U = {format_number(value)} mm"
        for point, value in zip(volume.start[known], expanded[known], strict=True)
    ]
    title = "U of a length that starts here"
    trace = charts.markers(title, radius[known], volume.start[known, 2], charts.DARK, "circle", hover=hover)
    trace["marker"] |= {
        "size": [round(float(x), 1) for x in 4 + 10 * scale],
        "color": [float(f"{x:.4g}") for x in expanded[known]],
        "colorscale": [[0, "#d7dee9"], [1, "#0d2347"]],
        "line": {"width": 0.5, "color": "#555"},
        "colorbar": {"title": {"text": "U [mm]"}, "thickness": 12, "len": 0.8},
    }
    layout = charts.layout("distance from the first axis [mm]", "height [mm]", showlegend=False)
    columns = ("x [mm]", "y [mm]", "z [mm]", "U of the tip [mm]", f"U of a {length} [mm]", "with readings [mm]")
    data = [
        [*(number_cell(float(x), 0) for x in point), *(number_cell(factor * float(value)) for value in u)]
        for point, *u in zip(volume.start, volume.u_tip, volume.u_length, volume.u_length_reading, strict=True)
    ]
    return Chart(
        "volume",
        f"U of a {length} over the volume",
        "Larger and darker marks are more uncertain; height against distance from the first axis.",
        {"data": [trace], "layout": layout},
        ReportTable("All positions", columns, data),
        420,
    )


def _noise_sentence(found: dict[str, Any]) -> str:
    seating = 1e3 * found["seating_mm"]
    noise = f"{encoders_in_words(found)}, seat {seating:.3g} µm"
    basis = "All uncertainties are based on"
    joints = ", ".join(str(row["joint"]) for row in found.get("noisy_encoders", ()))
    replaced = f", but for joint {joints}, whose noise was estimated" if joints else ""
    return {
        "given": f"{basis} the given noise{replaced}: {noise}. Residuals are {found['misfit'] or 0:.2f} times its "
        "prediction.",
        "estimated": f"{basis} the noise estimated from the residuals: {noise}.",
        "common": f"{basis} one variance for all poses: {seating:.3g} µm in each coordinate.",
        "robust": "Each pose's own residual is taken as its error (robust covariance).",
    }[found["form"]]


def correlations_section(record: CalibrationRecord, uncertainty: Uncertainty) -> Section:
    """Correlations of the parameters."""
    pairs = [
        [text_cell(one), text_cell(other), number_cell(r, 3, signed=True)]
        for one, other, r in uncertainty.correlated(0.5)
    ]
    description = (
        "Darker is more strongly correlated; the sign is written where it is at least 0.5. Strongly correlated "
        "parameters are determined better in combination than one by one."
    )
    table = ReportTable("Pairs correlated by 0.5 or more", ("parameter", "with", "correlation"), pairs)
    traces = charts.correlation_heatmap(list(record.names), np.asarray(uncertainty.correlation))
    layout = charts.layout("", "")
    layout["yaxis"] |= {"autorange": "reversed", "showgrid": False, "tickfont": {"size": 10}}
    layout["xaxis"] |= {"showgrid": False, "tickangle": -90, "tickfont": {"size": 10}}
    figure = {"data": traces, "layout": layout}
    chart = Chart("correlations", "Correlation of the parameters", description, figure, table, 520)
    return Section("correlations", "Correlations", [chart])


def observability_section(observability: Observability) -> Section:
    """What the data determine, and how strongly."""
    count, singular = len(observability.names), observability.singular
    sentences = observability.sentences() or [f"These data determine all {count} parameters."]
    rows = [
        ("rank", f"{observability.rank} of {count}", "number of directions that are determined"),
        ("condition", f"{observability.condition:.3g}", "of what is determined, columns scaled"),
        *((name, f"{x:.3g}", f"{_INDICES[name]}; larger is better") for name, x in observability.indices.items()),
    ]
    values = np.maximum(singular, 1e-12 * singular.max())
    order = list(range(1, len(singular) + 1))
    cells = [[number_cell(i, 0), number_cell(float(value), 6)] for i, value in zip(order, singular, strict=True)]
    trace = charts.markers("singular value", order, values, charts.DARK, "circle")
    layout = charts.layout("number", "singular value", yaxis=charts.logarithmic(values), showlegend=False)
    chart = Chart(
        "singular",
        "Singular values",
        "Sensitivity of the data to each independent direction of the parameters, in steps of 1 mm and 1 mrad.",
        {"data": [trace], "layout": layout},
        ReportTable("Singular values", ("number", "value"), cells),
        300,
    )
    metrics = ReportTable("Metrics", ("", "value", "meaning"), [[text_cell(word) for word in row] for row in rows])
    return Section("observability", "Observability", [" ".join(sentences), metrics, chart])


def bounds_section(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    """Which bounds are active, and the position of each parameter within its bounds."""
    vector = record.vectors()["calibrated"]
    active, stage1 = summary["active"], summary["active_stage1"]
    rows, positions = [], []
    for i, name in enumerate(record.names):
        scale, unit = people_read(parameter_unit(record.recording.nominal.arm, name))
        width = record.upper[i] - record.lower[i]
        bounded = np.isfinite(width) and width > 0
        positions.append(2 * (vector[i] - record.lower[i]) / width - 1 if bounded else math.nan)
        side = active.get(name) or stage1.get(name)
        state = f"on the {side} bound" + ("" if name in active else " in stage 1") if side else ""
        values = (number_cell(scale * x) for x in (record.lower[i], vector[i], record.upper[i]))
        rows.append([text_cell(name), text_cell(unit), *values, text_cell(state, "unsure" if side else "")])
    on_bound = sorted({*active, *stage1})
    introduction = f"On a bound: {', '.join(on_bound)}." if on_bound else "No bound is active."
    if record.method == "two-stage":
        introduction += " Bounds are those of stage 1; the scale fix comes after it."
    trace = charts.markers("calibrated", record.names, positions, charts.DARK, "circle")
    trace["marker"]["symbol"] = ["diamond" if name in on_bound else "circle" for name in record.names]
    axis = {"range": [-1.15, 1.15], "tickvals": [-1, 0, 1], "ticktext": ["lower", "middle", "upper"]}
    shapes = charts.horizontal([-1, 1], "solid")
    layout = charts.layout("", "position within bounds", yaxis=axis, showlegend=False, shapes=shapes)
    chart = Chart(
        "bounds",
        "Position of every parameter within its bounds",
        "Diamonds are on a bound.",
        {"data": [trace], "layout": layout},
        ReportTable("Bounds", ("parameter", "unit", "lower", "calibrated", "upper", ""), rows),
        300,
    )
    return Section("bounds", "Bounds", [introduction, chart])


def monte_carlo_section(record: CalibrationRecord) -> Section:
    """The Monte Carlo evaluation after JCGM 101, if it was run."""
    found = record.sampled
    assert found is not None
    rows = []
    for i, name in enumerate(found["quantity"]):
        values = (number_cell(float(found[key][i]), 6) for key in ("estimate", "u", "linear_u", "low", "high"))
        agrees = bool(found["agrees"][i])
        rows.append([text_cell(name), *values, text_cell("yes" if agrees else "no", "" if agrees else "unsure")])
    columns = ("quantity", "value", "u by Monte Carlo", "u by propagation", "from", "to", "agree")
    table = ReportTable("Quantities, in mm and rad; 95 % coverage intervals", columns, rows)
    return Section("monte-carlo", "Monte Carlo (JCGM 101)", [record.sampled_says or "", table])
