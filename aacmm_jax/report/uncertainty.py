"""Sections on uncertainty in the report of a calibration: volume, correlations, observability, bounds, Monte Carlo."""

import math
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.units import people_read
from ..kinematics.arm import parameter_unit
from ..summaries.harmonics import listed_apart
from ..summaries.tables import decimals_for, encoders_in_words, factor_words, seat_in_words, volume_rows
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.identifiability import Observability
from ..uncertainty.volume import VolumetricUncertainty
from . import charts
from .elements import Cell, Chart, ReportTable, Section, format_number, number_cell, text_cell

_INDICES = {
    "O1": "geometric mean of the singular values (Menq, Borm)",
    "O2": "smallest over largest (Driels, Pathre)",
    "O3": "smallest (Nahvi)",
    "O4": "smallest squared over largest (Nahvi, Hollerbach)",
    "O5": "harmonic sum (Sun, Hollerbach)",
}


def volume_section(volume: VolumetricUncertainty, summary: dict[str, Any]) -> Section:
    """Expanded uncertainty of tips and lengths over the working volume."""
    found = summary["uncertainty"]["volume"]
    length = f"{volume.length:g} mm length"
    rows = [[text_cell(title), *map(_expanded, values)] for title, values in volume_rows(found)]
    low, high = volume.start.min(axis=0), volume.start.max(axis=0)
    box = ", ".join(f"{axis} from {_whole(a)} to {_whole(b)}" for axis, a, b in zip("xyz", low, high, strict=True))
    introduction = (
        f"At {len(volume.start)} positions that random poses within the joint limits reach ({box} mm), "
        f"expanded to 95 % ({factor_words(found)})."
    )
    table = ReportTable(
        "Expanded uncertainty over the working volume [mm]", ("", "median", "95th percentile", "largest"), rows
    )
    chart = _volume_chart(volume, length)
    return Section(
        "volume",
        "Uncertainty over the working volume",
        [introduction, table, chart, _noise_sentence(summary)],
    )


def _expanded(u: float | None) -> Cell:
    """An expanded uncertainty, to two digits."""
    return number_cell(u, decimals_for(u))


def _whole(value: float) -> str:
    return f"{value:.0f}".replace("-", "−")


def _volume_chart(volume: VolumetricUncertainty, length: str) -> Chart:
    expanded = volume.expanded_length
    known = np.isfinite(expanded)
    radius = np.hypot(volume.start[:, 0], volume.start[:, 1])
    hover = [
        f"({', '.join(f'{x:.0f}' for x in point)}) mm: U = {format_number(value, decimals_for(value))} mm"
        for point, value in zip(volume.start[known], expanded[known].tolist(), strict=True)
    ]
    shade, limits = charts.shades(expanded[known])
    order = np.argsort(shade, kind="stable")
    marks = charts.Marks(
        "", radius[known][order], volume.start[known, 2][order], hover=[hover[i] for i in order], shade=shade[order]
    )
    axes = (
        charts.linear("distance from the first axis [mm]", radius, [0.0]),
        charts.linear("height [mm]", volume.start[:, 2]),
    )
    plot = charts.Plot(*axes, (marks,), height=380)
    columns = ("x [mm]", "y [mm]", "z [mm]", "U of the tip [mm]", f"U of a {length} [mm]", "with readings [mm]")
    data = [
        [*(number_cell(float(x), 0) for x in point), *(_expanded(float(value)) for value in u)]
        for point, *u in zip(volume.start, *volume[8:], strict=True)
    ]
    return Chart(
        "volume",
        f"U of a {length} over the volume",
        "The larger the mark, the more uncertain; height against distance from the first axis.",
        (plot,),
        ReportTable("All positions", columns, data),
        shade_limits=limits if np.any(known) else (),
        shade_unit="mm",
    )


def _noise_sentence(summary: dict[str, Any]) -> str:
    found = summary["uncertainty"]
    seating = 1e3 * found["seating_mm"]
    noise = f"{encoders_in_words(found)}, {seat_in_words(summary)} {seating:.3g} µm"
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
        "The colour is the size of the correlation; its sign is written from 0.5 on. Strongly correlated "
        "parameters are determined better in combination than one by one."
    )
    table = ReportTable("Pairs correlated by 0.5 or more", ("parameter", "with", "correlation"), pairs)
    names, chosen = list(record.names), uncertainty.most_correlated()
    if len(chosen) < len(names):
        description += f" Of {len(names)} parameters, the {len(chosen)} that are correlated most are drawn."
    plot = charts.correlations([names[i] for i in chosen], np.asarray(uncertainty.correlation)[np.ix_(chosen, chosen)])
    limits = tuple(i / charts.SHADES for i in range(charts.SHADES + 1))
    title = "Correlation of the parameters"
    chart = Chart("correlations", title, description, (plot,), table, shade_limits=limits)
    return Section("correlations", "Correlations", [chart])


def observability_section(observability: Observability) -> Section:
    """What the data determine, and how strongly."""
    count, singular = len(observability.names), observability.singular
    determined = f"These data determine all {count} parameters."
    if observability.rank < count:
        determined = (
            f"These data determine {observability.rank} directions of the {count} parameters; with their priors, all "
            "are determined."
        )
    sentences = observability.sentences() or [determined]
    rows = [
        ("rank", f"{observability.rank} of {count}", "number of directions that are determined"),
        ("condition", f"{observability.condition:.3g}", "of what is determined, columns scaled"),
        *((name, f"{x:.3g}", f"{_INDICES[name]}; larger is better") for name, x in observability.indices.items()),
    ]
    values = np.maximum(singular, 1e-12 * singular.max())
    order = list(range(1, len(singular) + 1))
    cells = [[number_cell(i, 0), number_cell(float(value), 6)] for i, value in zip(order, singular, strict=True)]
    hover = [f"{i}: {value:.3g}" for i, value in zip(order, singular.tolist(), strict=True)]
    axes = charts.linear("number", order), charts.logarithmic("singular value", values)
    plot = charts.Plot(*axes, (charts.Marks("", order, values, hover=hover),), height=240)
    chart = Chart(
        "singular",
        "Singular values",
        "Sensitivity of the data to each independent direction of the parameters, in steps of 1 mm and 1 mrad.",
        (plot,),
        ReportTable("Singular values", ("number", "value"), cells),
    )
    metrics = ReportTable("Metrics", ("", "value", "meaning"), [[text_cell(word) for word in row] for row in rows])
    return Section("observability", "Observability", [" ".join(sentences), metrics, chart])


def bounds_section(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    """Which bounds are active, and the position of each parameter within its bounds."""
    vector = record.vectors()["calibrated"]
    active, stage1 = summary["active"], summary["active_stage1"]
    on_bound = sorted({*active, *stage1})
    listed, harmonics = listed_apart(summary["parameters"])
    shown = [*(row["parameter"] for row in listed), *(r["parameter"] for r in harmonics if r["parameter"] in on_bound)]
    rows, positions = [], []
    for name in shown:
        i = record.names.index(name)
        scale, unit = people_read(parameter_unit(record.recording.nominal.arm, name))
        width = record.upper[i] - record.lower[i]
        bounded = np.isfinite(width) and width > 0
        positions.append(2 * (vector[i] - record.lower[i]) / width - 1 if bounded else math.nan)
        side = active.get(name) or stage1.get(name)
        state = f"on the {side} bound" + ("" if name in active else " in stage 1") if side else ""
        values = (number_cell(scale * x) for x in (record.lower[i], vector[i], record.upper[i]))
        rows.append([text_cell(name), text_cell(unit), *values, text_cell(state, "unsure" if side else "")])
    introduction = f"On a bound: {', '.join(on_bound)}." if on_bound else "No bound is active."
    if record.final_method == "two-stage":
        introduction += " Bounds are those of stage 1; the scale fix comes after it."
    at, on = np.asarray(positions), np.array([name in on_bound for name in shown])
    x = np.arange(len(at))
    hover = [f"{name}: {position:+.2f}" for name, position in zip(shown, positions, strict=True)]
    marks = [charts.Marks("within", x[~on], at[~on], hover=[hover[i] for i in x[~on]])]
    if np.any(on):
        # Stage 1 may have been on a bound that the calibrated value has left.
        edge = np.clip(at[on], -1, 1)
        marks.append(charts.Marks("on a bound", x[on], edge, "diamond", "accent", [hover[i] for i in x[on]]))
    ticks = ((-1.0, "lower"), (0.0, "middle"), (1.0, "upper"))
    axes = charts.names("", shown), charts.Axis("position within bounds", -1.15, 1.15, ticks)
    plot = charts.Plot(*axes, tuple(marks), horizontal=[-1.0, 1.0], height=220)
    description = "Diamonds are on a bound." if np.any(on) else "None is on a bound."
    if len(shown) < len(record.names):
        description += f" Not drawn: {len(record.names) - len(shown)} coefficients of harmonics within theirs."
    chart = Chart(
        "bounds",
        "Position of every parameter within its bounds",
        description,
        (plot,),
        ReportTable("Bounds", ("parameter", "unit", "lower", "calibrated", "upper", ""), rows),
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
