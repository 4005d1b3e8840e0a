"""The report of a calibration."""

import math
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.units import ARCSEC, DEG
from ..summaries.calibration import calibration_summary
from ..summaries.warnings import observed
from ..uncertainty.volume import volumetric_uncertainty
from . import charts
from .uncertainty import bounds_section, correlations_section, observability_section, sampled_section, volume_section
from .elements import Chart, Report, Section, Table, decimals_of, number, shown, text
from .residuals import figures_table, length_rows, residual_chart, socket_table
from .arm_view import arms_of


def calibration_report(record: CalibrationRecord) -> tuple[Report, dict[str, Any]]:
    """The report, without what names its file; and the summary that it was made from."""
    uncertainty, seen = uncertainty_of(record), observed(record)
    volume = volumetric_uncertainty(uncertainty)
    summary = calibration_summary(record, seen, volume)
    evaluations = record.evaluations()
    factor = uncertainty.factor(0.95)
    sections = [
        _data(record, summary),
        _found_and_left(record, summary, evaluations),
        _scale(record, summary, evaluations, factor),
        _parameters(record, summary, factor),
        _residuals(record, evaluations["calibrated"]),
        Section(
            "arm", "The arm in its poses", [arms_of(record.calibrated.arm, record.recording.capture, evaluations["calibrated"])]
        ),
        volume_section(volume, summary, factor),
        correlations_section(record, uncertainty),
        observability_section(seen),
        bounds_section(record, summary),
    ]
    if record.sampled is not None:
        sections.insert(7, sampled_section(record))
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
    traceable = "What the arm measures is traceable to the metre through these reference lengths alone, as far as their calibration certificates are."
    return Section("data", "What was calibrated, and from which data", [words, sockets, lengths, traceable])


def _found_and_left(record: CalibrationRecord, summary: dict[str, Any], evaluations: dict[str, Evaluation]) -> Section:
    stages = {"nominal": "as found", "stage1": "after stage 1", "calibrated": "as left"}
    blocks: list = ["As found is the nominal arm, as left the calibrated one, both on the poses that were identified from."]
    if summary["cross_validation"] is not None:
        blocks.append(_validated(summary["cross_validation"]))
    blocks.append(figures_table("Figures as found and as left [mm]", summary, stages, fixed_scale=record.fixed_by_one_length))
    pair = {"as found": evaluations["nominal"], "as left": evaluations["calibrated"]}
    blocks.append(
        residual_chart("found-left", "Distance of every pose from its socket's centroid", record.recording.capture, pair)
    )
    if "truth" in summary:
        rows = [
            [text(title), *(number(scale * summary["truth"][stage][key]) for stage in stages)]
            for key, title, scale in (
                ("length_error_largest_mm", "largest error of a length parameter [mm]", 1.0),
                ("angle_error_largest_rad", "largest error of an angle parameter [arcsec]", 1 / ARCSEC),
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
            f"Poses and reference lengths were fitted together. By the arm that poses alone give, they measure k = {k:.8f} times their calibrated "
            f"value, with u(k) = {u:.1e}."
        )
    single = record.fixed_by_one_length
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
    if len(names) <= 12 and max(map(len, names)) <= 12:
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
        scale, unit = (1.0, "mm") if row["unit"] == "mm" else (1 / DEG, "deg")
        u = None if row["u"] is None else factor * scale * row["u"]
        decimals = decimals_of(u)
        change = scale * (row["calibrated"] - row["nominal"])
        state = "" if u else "only with others"
        if row["bound"]:
            state = f"on the {row['bound']} bound" + (" of stage 1; U is that of k" if u else "")
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
        ("rad", "Change of angle parameters", 1 / ARCSEC, "arcsec"),
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
            trace["marker"]["symbol"] = ["x-thin" if math.isnan(bar) else "circle" for bar in bars]
            figure = {
                "data": [trace],
                "layout": charts.layout("", f"change [{label}]", shapes=charts.horizontal([0.0], "solid"), showlegend=False),
            }
            blocks.append(
                Chart(
                    f"change-{unit}",
                    title,
                    "As left less as found; bars are U (95 %), smaller than the mark where none is seen. Crosses have no U of their own.",
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
