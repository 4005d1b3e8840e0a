"""What a calibration's report says of uncertainty: over the volume, correlations, observability, bounds, Monte Carlo."""

import math
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.units import DEG
from ..kinematics.arm import is_length
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.identifiability import Observability
from ..uncertainty.volume import VolumetricUncertainty
from . import charts
from .elements import Chart, Section, Table, number, shown, text


def volume_section(volume: VolumetricUncertainty, summary: dict[str, Any], factor: float) -> Section:
    """Expanded uncertainty of tips and lengths over the working volume."""
    found = summary["uncertainty"]["volume"]
    length = f"{volume.length:g} mm length"
    rows = [
        [
            text(title),
            *(
                number(None if found[f"{key}_{which}_mm"] is None else factor * found[f"{key}_{which}_mm"])
                for which in ("median", "95", "largest")
            ),
        ]
        for key, title in (
            ("u_tip", "tip position, along its worst direction: from the calibration"),
            ("u_length", f"{length}: from the calibration"),
            ("u_length_reading", f"{length}: with the noise of both readings"),
        )
    ]
    low, high = volume.start.min(axis=0), volume.start.max(axis=0)
    box = ", ".join(f"{axis} from {a:.0f} to {b:.0f}" for axis, a, b in zip("xyz", low, high, strict=True))
    words = f"At {len(volume.start)} places that random poses within the joint limits reach ({box} mm), expanded to 95 % with the factor {factor:.2f}."
    table = Table("Expanded uncertainty over the working volume [mm]", ("", "median", "95th percentile", "largest"), rows)
    expanded = factor * volume.u_length
    radius = np.hypot(volume.start[:, 0], volume.start[:, 1])
    known = np.isfinite(expanded)
    scale = expanded[known] / max(float(expanded[known].max(initial=0.0)), 1e-12)
    hover = [
        f"({', '.join(f'{x:.0f}' for x in point)}) mm: U = {shown(value)} mm"
        for point, value in zip(volume.start[known], expanded[known], strict=True)
    ]
    trace = charts.dots(
        "U of a length that starts here", radius[known], volume.start[known, 2], charts.DARK, "circle", hover=hover
    )
    trace["marker"] |= {
        "size": [round(float(x), 1) for x in 4 + 10 * scale],
        "color": [float(f"{x:.4g}") for x in expanded[known]],
        "colorscale": [[0, "#d7dee9"], [1, "#0d2347"]],
        "line": {"width": 0.5, "color": "#555"},
        "colorbar": {"title": {"text": "U [mm]"}, "thickness": 12, "len": 0.8},
    }
    figure = {"data": [trace], "layout": charts.layout("distance from the first axis [mm]", "height [mm]", showlegend=False)}
    data = [
        [
            *(number(float(x), 0) for x in point),
            number(factor * float(tip)),
            number(factor * float(own)),
            number(factor * float(read)),
        ]
        for point, tip, own, read in zip(volume.start, volume.u_tip, volume.u_length, volume.u_length_reading, strict=True)
    ]
    columns = ("x [mm]", "y [mm]", "z [mm]", "U of the tip [mm]", f"U of a {length} [mm]", "with readings [mm]")
    chart = Chart(
        "volume", f"U of a {length} over the volume", "Larger and darker marks are more uncertain; height against distance from the first axis.",
        figure, Table("All places", columns, data), 420,
    )  # fmt: skip
    source = _noise_words(summary["uncertainty"])
    return Section("volume", "Uncertainty over the working volume", [words, table, chart, source])


def _noise_words(found: dict[str, Any]) -> str:
    encoder = found["encoder_arcsec"]
    told = ", ".join(f"{x:.3g}" for x in encoder) if isinstance(encoder, list) else f"{encoder:.3g}"
    noise = f"encoders {told} arcsec, seat {1e3 * found['seating_mm']:.3g} µm"
    return {
        "given": f"All uncertainties rest on the noise that was given: {noise}. The residuals are {found['misfit'] or 0:.2f} times what it predicts.",
        "estimated": f"All uncertainties rest on the noise that was estimated from the residuals: {noise}.",
        "common": f"All uncertainties rest on one variance for all poses: {1e3 * found['seating_mm']:.3g} µm a coordinate.",
        "robust": "Each pose's own residual stands for its error (robust form).",
    }[found["form"]]


def correlations_section(record: CalibrationRecord, uncertainty: Uncertainty) -> Section:
    """Correlations of the parameters."""
    names = list(record.names)
    table = np.asarray(uncertainty.correlation)
    pairs = [[text(one), text(other), number(r, 3, signed=True)] for one, other, r in uncertainty.correlated(0.5)]
    words = "Darker is more strongly correlated; the sign stands where it is at least 0.5. Strongly correlated parameters are known better together than each alone."
    behind = Table("Pairs correlated by 0.5 or more", ("parameter", "with", "correlation"), pairs)
    figure = {"data": charts.heatmap(names, table), "layout": charts.layout("", "")}
    figure["layout"]["yaxis"] |= {"autorange": "reversed", "showgrid": False, "tickfont": {"size": 10}}
    figure["layout"]["xaxis"] |= {"showgrid": False, "tickangle": -90, "tickfont": {"size": 10}}
    return Section(
        "correlations", "Correlations", [Chart("correlations", "Correlation of the parameters", words, figure, behind, 520)]
    )


def observability_section(seen: Observability) -> Section:
    """What the data determine, and how strongly."""
    sentences = seen.sentences() or [f"These data determine all {len(seen.names)} parameters."]
    indices = seen.indices
    meanings = {
        "O1": "geometric mean of the singular values (Menq, Borm)",
        "O2": "smallest over largest (Driels, Pathre)",
        "O3": "smallest (Nahvi)",
        "O4": "smallest squared over largest (Nahvi, Hollerbach)",
        "O5": "harmonic sum (Sun, Hollerbach)",
    }
    rows = [[text("rank"), text(f"{seen.rank} of {len(seen.names)}"), text("directions that are determined")]]
    rows.append([text("condition"), text(f"{seen.condition:.3g}"), text("of what is determined, columns scaled")])
    rows += [[text(name), text(f"{value:.3g}"), text(f"{meanings[name]}; larger is better")] for name, value in indices.items()]
    order = list(range(1, len(seen.singular) + 1))
    values = np.maximum(seen.singular, 1e-12 * seen.singular.max())
    behind = Table(
        "Singular values",
        ("number", "value"),
        [[number(i, 0), number(float(value), 6)] for i, value in zip(order, seen.singular, strict=True)],
    )
    trace = charts.dots("singular value", order, values, charts.DARK, "circle")
    figure = {
        "data": [trace],
        "layout": charts.layout("number", "singular value", yaxis=charts.logarithmic(values), showlegend=False),
    }
    words = "How strongly the data see each independent direction of the parameters, in steps of 1 mm and 1 mrad."
    return Section(
        "observability",
        "Observability",
        [
            " ".join(sentences),
            Table("Figures", ("", "value", "meaning"), rows),
            Chart("singular", "Singular values", words, figure, behind, 300),
        ],
    )


def bounds_section(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    """Which bounds are active, and where the others lie."""
    vector = record.vectors()["calibrated"]
    stage1 = summary["active_stage1"]
    rows, inside = [], []
    for i, name in enumerate(record.names):
        scale, unit = (1.0, "mm") if is_length(name) else (1 / DEG, "deg")
        width = record.upper[i] - record.lower[i]
        share = 2 * (vector[i] - record.lower[i]) / width - 1 if np.isfinite(width) and width > 0 else math.nan
        side = summary["active"].get(name) or stage1.get(name)
        inside.append(share)
        rows.append(
            [
                text(name),
                text(unit),
                *(number(scale * x) for x in (record.lower[i], vector[i], record.upper[i])),
                text(
                    f"on the {side} bound" + ("" if name in summary["active"] else " in stage 1") if side else "",
                    "unsure" if side else "",
                ),
            ]
        )
    active = sorted({*summary["active"], *stage1})
    words = f"On a bound: {', '.join(active)}." if active else "No bound is active."
    words += " Bounds are those of stage 1; the scale fix comes after it." if record.method == "two-stage" else ""
    marks = ["diamond" if name in active else "circle" for name in record.names]
    trace = charts.dots("as left", record.names, inside, charts.DARK, "circle")
    trace["marker"]["symbol"] = marks
    axis = {"range": [-1.15, 1.15], "tickvals": [-1, 0, 1], "ticktext": ["lower", "middle", "upper"]}
    shapes = charts.horizontal([-1, 1], "solid")
    figure = {"data": [trace], "layout": charts.layout("", "place in its bounds", yaxis=axis, showlegend=False, shapes=shapes)}
    table = Table("Bounds", ("parameter", "unit", "lower", "as left", "upper", ""), rows)
    words_chart = "Where each parameter lies between its bounds; diamonds are on one."
    return Section(
        "bounds", "Bounds", [words, Chart("bounds", "Place of every parameter in its bounds", words_chart, figure, table, 300)]
    )


def sampled_section(record: CalibrationRecord) -> Section:
    """Monte Carlo after JCGM 101, where it was run."""
    assert record.sampled is not None
    found = record.sampled
    rows = []
    for i, name in enumerate(found["quantity"]):
        values = (float(found[key][i]) for key in ("estimate", "u", "linear_u", "low", "high"))
        agrees = bool(found["agrees"][i])
        rows.append(
            [text(name), *(number(value, 6) for value in values), text("yes" if agrees else "no", "" if agrees else "unsure")]
        )
    columns = ("quantity", "value", "u by Monte Carlo", "u by propagation", "from", "to", "agree")
    return Section(
        "monte-carlo",
        "Monte Carlo (JCGM 101)",
        [record.sampled_says or "", Table("Quantities, in mm and rad; intervals hold 95 %", columns, rows)],
    )
