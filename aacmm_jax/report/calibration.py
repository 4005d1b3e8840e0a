"""The report of a calibration."""

import math
from typing import Any

import numpy as np

from ..calibration_files import CalibrationRecord
from ..evaluate import Evaluation
from ..observability import observe
from ..parameters import Parameters, is_length
from ..summary import calibration_summary
from ..uncertainty import Volume, over_volume, uncertainty_of
from . import charts
from .parts import ARCSEC, Arms, Chart, Report, Section, Table, decimals_of, number, shown, text
from .residuals import figures_table, length_rows, residual_chart, socket_table
from .scene import scene_of


def calibration_report(record: CalibrationRecord) -> tuple[Report, dict[str, Any]]:
    """The report, without what names its file; and the summary that it was made from."""
    summary = calibration_summary(record)
    evaluations = record.evaluations()
    uncertainty = uncertainty_of(record)
    volume = over_volume(uncertainty)
    factor = uncertainty.factor(0.95)
    sections = [
        _data(record, summary),
        _found_and_left(record, summary, evaluations),
        _scale(record, summary, evaluations, factor),
        _parameters(record, summary, factor),
        _residuals(record, evaluations["calibrated"]),
        Section("arm", "The arm in its poses", [_arms(record, evaluations["calibrated"])]),
        _volume(volume, summary, factor),
        _correlations(record, uncertainty),
        _observability(record),
        _bounds(record, summary),
    ]
    if record.sampled is not None:
        sections.insert(7, _sampled(record))
    good = record.converged
    report = Report(
        title="Calibration of " + (record.recording.nominal.name or "an arm"),
        subtitle=f"{_METHODS[record.method]}; {summary['poses']} poses in {len(summary['sockets_used'])} sockets, "
        f"{len(summary['lengths'])} reference length{'' if len(summary['lengths']) == 1 else 's'}",
        verdict=record.reason if good else f"Not to be used. {record.reason}",
        verdict_mark="good" if good and not summary["warnings"] else "unsure" if good else "bad",
        warnings=summary["warnings"],
        facts=_facts(summary, factor),
        sections=sections,
    )
    return report, summary


_METHODS = {
    "two-stage": "Identification from repeatability, then a scale fix",
    "joint": "Joint least squares of poses and lengths",
}


def _facts(summary: dict[str, Any], factor: float) -> list[tuple[str, str]]:
    found, left = summary["nominal"], summary["calibrated"]
    facts = []
    validated = summary["cross_validation"]
    if validated is not None and validated["rms_mm"] == validated["rms_mm"]:
        facts.append(
            (
                "Left-out placements, RMS distance",
                f"{shown(validated['rms_mm'])} mm (predicted {shown(validated['rms_predicted_mm'])})",
            )
        )
    if "de_mm" in left:
        facts.append(("DE, as found → as left", f"{shown(found['de_mm'])} → {shown(left['de_mm'])} mm"))
        facts.append(("Δm, as found → as left", f"{shown(found['deltam_mm'])} → {shown(left['deltam_mm'])} mm"))
    volume = summary["uncertainty"]["volume"]
    largest, median = volume["u_length_largest_mm"], volume["u_length_median_mm"]
    if median is not None and largest is not None:
        facts.append(
            (
                f"U of a {volume['length_mm']:g} mm length (95 %)",
                f"median {shown(factor * median)}, largest {shown(factor * largest)} mm",
            )
        )
    else:
        facts.append((f"U of a {volume['length_mm']:g} mm length", "not determined everywhere"))
    facts.append(("Scale k of stage 1", f"{summary['scale_k']:.7f} ± {factor * summary['scale_u']:.7f} (95 %)"))
    return facts


def _data(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    capture = record.recording.capture
    sockets = Table(
        "Sockets that held the tip",
        ("socket", "poses"),
        [[text(name), number(size, 0)] for name, size in zip(capture.names, capture.sizes, strict=True)],
    )
    lengths = Table(
        "Reference lengths",
        ("between", "calibrated value [mm]", "u [mm]"),
        [
            [text(f"{row['from']} – {row['to']}"), number(row["value_mm"]), number(float(length.u))]
            for row, length in zip(summary["lengths"], capture.lengths, strict=True)
        ],
    )
    kind = "The poses are simulated." if record.recording.true is not None else "The poses were recorded."
    held = ", ".join(record.held) or "nothing"
    hold = f" {record.hold} was held in stage 1 as well, since poses alone cannot tell the scale." if record.hold else ""
    words = f"{kind} Identified were {len(record.names)} parameters of {capture.joints} joints. Held at their nominal values: {held}.{hold}"
    return Section("data", "What was calibrated, and from which data", [words, sockets, lengths])


def _found_and_left(record: CalibrationRecord, summary: dict[str, Any], evaluations: dict[str, Evaluation]) -> Section:
    stages = {"nominal": "as found", "stage1": "after stage 1", "calibrated": "as left"}
    blocks: list = ["As found is the nominal arm, as left the calibrated one, both on the poses that were identified from."]
    if summary["cross_validation"] is not None:
        blocks.append(_validated(summary["cross_validation"]))
    blocks.append(figures_table("Figures as found and as left [mm]", summary, stages, fixed_scale=len(summary["lengths"]) == 1))
    pair = {"as found": evaluations["nominal"], "as left": evaluations["calibrated"]}
    blocks.append(
        residual_chart("found-left", "Distance of every pose from its socket's centroid", record.recording.capture, pair)
    )
    if "truth" in summary:
        rows = [
            [text(title), *(number(scale * summary["truth"][stage][key]) for stage in stages)]
            for key, title, scale in (
                ("length_error_largest_mm", "largest error of a length parameter [mm]", 1.0),
                ("angle_error_largest_rad", "largest error of an angle parameter [arcsec]", ARCSEC),
            )
        ]
        blocks.append(Table("Against the true arm of the simulation", ("", *stages.values()), rows))
    return Section("found-left", "As found and as left", blocks)


def _validated(found: dict[str, Any]) -> Table:
    rows = [
        [
            text("RMS distance of poses from their socket's centroid"),
            number(found["rms_mm"]),
            number(found["rms_predicted_mm"]),
        ],
        [text("RMS error of reference lengths"), number(found["length_error_rms_mm"]), number(found["length_u_mm"])],
    ]
    return Table(
        f"Cross-validated: each of {found['groups']} placements left out once [mm]", ("", "found", "predicted by u"), rows
    )


def _scale(record: CalibrationRecord, summary: dict[str, Any], evaluations: dict[str, Evaluation], factor: float) -> Section:
    k, u = record.k, record.u_k
    words = (
        f"Repeatability says nothing of an arm's size, so the reference lengths do: by the arm of stage 1 they measure k = {k:.8f} times their "
        f"calibrated value, with u(k) = {u:.1e}. Every length of the arm was divided by it: {shown(abs(k - 1) * 1000, 4)} mm in a metre, "
        f"known to ± {shown(1000 * factor * u, 4)} mm in a metre (95 %)."
    )
    if record.method == "joint":
        words = (
            f"Poses and reference lengths were fitted together. The arm that poses alone give measures the lengths k = {k:.8f} times too long; "
            f"u(k) = {u:.1e}."
        )
    single = len(summary["lengths"]) == 1
    errors = {stage: np.asarray(evaluations[stage].error) for stage in ("nominal", "stage1", "calibrated")}
    if not single:
        words += " A length's U holds what its certificate says and the scatter of the poses at its ends."
    if single:
        words += " The only length fixed the scale, so its own error is zero by construction and is not shown."
    rows = length_rows(summary["lengths"], factor, {"as found": errors["nominal"], "after stage 1": errors["stage1"]}, single)
    table = Table("Reference lengths [mm]", ("between", "value", "as found", "after stage 1", "as left", "U of error"), rows)
    if single:
        return Section("scale", "Scale, and what it corrected", [words, table])
    names = [f"{row['from']} – {row['to']}" for row in summary["lengths"]]
    places = list(range(1, len(names) + 1))
    u_error = [factor * (row["error_u_mm"] or np.nan) for row in summary["lengths"]]
    traces = [
        charts.dots("after stage 1", places, errors["stage1"], charts.WARM, "triangle-up-open", hover=names),
        charts.dots("as left, with U", places, errors["calibrated"], charts.DARK, "square", hover=names, bars=u_error),
    ]
    shapes = charts.horizontal([0.0], "solid")
    figure = {"data": traces, "layout": charts.layout("reference length", "measured − value [mm]", shapes=shapes)}
    if len(names) <= 12:
        figure["layout"]["xaxis"] |= {"tickvals": places, "ticktext": [charts.plain(name) for name in names]}
    chart = Chart(
        "lengths",
        "Errors of the reference lengths",
        "Measured less calibrated value, before and after the scale fix.",
        figure,
        table,
    )
    return Section("scale", "Scale, and what it corrected", [words, chart])


def _parameters(record: CalibrationRecord, summary: dict[str, Any], factor: float) -> Section:
    rows, plotted = [], {"mm": [], "rad": []}
    for row in summary["parameters"]:
        scale, unit = (1.0, "mm") if row["unit"] == "mm" else (180 / math.pi, "deg")
        u = None if row["u"] is None else factor * scale * row["u"]
        decimals = decimals_of(u)
        change = scale * (row["calibrated"] - row["nominal"])
        state = f"on the {row['bound']} bound" if row["bound"] else "" if u else "only with others"
        rows.append(
            [
                text(row["parameter"]),
                text(unit),
                number(scale * row["nominal"], 4),
                number(scale * row["calibrated"], decimals),
                number(change, decimals, signed=True),
                number(u, decimals),
                text(state, "unsure" if state else ""),
            ]
        )
        plotted[row["unit"]].append(
            (row["parameter"], row["calibrated"] - row["nominal"], None if row["u"] is None else row["u"])
        )
    columns = ("parameter", "unit", "as found", "as left", "change", "U (95 %)", "")
    table = Table("Parameters", columns, rows)
    blocks: list = [
        f"U is the expanded uncertainty, coverage factor {factor:.2f}. A parameter on a bound, or that the data determine only together with others, has none of its own."
    ]
    for unit, title, scale, label in (
        ("mm", "Change of length parameters", 1.0, "mm"),
        ("rad", "Change of angle parameters", ARCSEC, "arcsec"),
    ):
        if plotted[unit]:
            names, changes, u = zip(*plotted[unit], strict=True)
            bars = [np.nan if x is None else factor * scale * x for x in u]
            y = [scale * x for x in changes]
            hover = [
                f"{name}: {shown(value)} ± {'–' if math.isnan(bar) else shown(bar)} {label}"
                for name, value, bar in zip(names, y, bars, strict=True)
            ]
            trace = charts.dots("as left − as found, with U", names, y, charts.DARK, "circle", hover=hover, bars=bars)
            figure = {
                "data": [trace],
                "layout": charts.layout("", f"change [{label}]", shapes=charts.horizontal([0.0], "solid"), showlegend=False),
            }
            blocks.append(
                Chart(
                    f"change-{unit}",
                    title,
                    "As left less as found; bars are U (95 %), smaller than the mark where none is seen.",
                    figure,
                    height=320,
                )
            )
    return Section("parameters", "Parameters", [*blocks, table])


def _residuals(record: CalibrationRecord, evaluation: Evaluation) -> Section:
    capture = record.recording.capture
    chart = residual_chart("residuals", "Residuals as left", capture, {"as left": evaluation}, mark=True)
    words = (
        "The distance of each pose's tip from the centroid of its socket, by the calibrated arm. Marked are poses more than four times as far as "
        "the median: look at how the tip was seated there."
    )
    return Section("residuals", "Residuals by socket and pose", [words, socket_table(capture, evaluation), chart])


def _arms(record: CalibrationRecord, evaluation: Evaluation) -> Arms:
    capture = record.recording.capture
    data = scene_of(record.calibrated.arm, capture, np.asarray(evaluation.distances))
    words = "Drag, or use the arrow keys, to turn it; plus and minus change its size. The slider goes through the poses."
    return Arms("scene", "The calibrated arm, its sockets and its poses", words, data)


def _volume(volume: Volume, summary: dict[str, Any], factor: float) -> Section:
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


def _correlations(record: CalibrationRecord, uncertainty: Any) -> Section:
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


def _observability(record: CalibrationRecord) -> Section:
    arm = record.calibrated.arm
    seen = observe(arm, record.recording.capture, Parameters(arm, record.names))
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


def _bounds(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    vector = record.vectors()["calibrated"]
    stage1 = summary["active_stage1"]
    rows, inside = [], []
    for i, name in enumerate(record.names):
        scale, unit = (1.0, "mm") if is_length(name) else (180 / math.pi, "deg")
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


def _sampled(record: CalibrationRecord) -> Section:
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
