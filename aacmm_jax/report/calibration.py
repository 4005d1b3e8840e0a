"""The report of a calibration."""

import math
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.record import REPEATABILITY, CalibrationRecord, uncertainty_of
from ..core.text import pluralise, shorten
from ..core.units import DEG, people_read
from ..diagnostics.determined import determined
from ..diagnostics.findings import case_of
from ..diagnostics.pose_residuals import distances_of, observation_residuals
from ..summaries.calibration import calibration_summary
from ..summaries.observations import capture_words
from ..summaries.tables import decimals_for, lengths_sentence, two_digits
from ..summaries.uncertainty_sentences import shared_sentence
from ..uncertainty.volume import volumetric_uncertainty
from .arm_view import view_of_arm
from .elements import (
    ArmView,
    Report,
    ReportTable,
    Section,
    format_number,
    number_cell,
    text_cell,
)
from .lengths import length_chart
from .observations import (
    agreement_tables,
    geometry_section,
    observation_tables,
    other_poses_table,
    removed_tables,
    residuals_section,
    stages_chart,
)
from .parameters import parameters_section
from .patterns import patterns_sections
from .residuals import length_rows, metrics_table, pose_distances, residual_chart, socket_table, validation_tables
from .tried import tried_sections
from .uncertainty import (
    bounds_section,
    correlations_section,
    monte_carlo_section,
    observability_section,
    volume_section,
)

_METHODS = {
    "two-stage": "Identification from repeatability, then a scale fix",
    "joint": "Joint least squares of poses and lengths",
    REPEATABILITY: "Identification with the scale of the nominal arm",
}
_MOST_KINDS = 3  # among the facts at the beginning
_OBSERVED = "Joint least squares of everything observed"


def calibration_report(record: CalibrationRecord) -> tuple[Report, dict[str, Any]]:
    """The report, except for the origin of its file; and the summary that it was made from."""
    uncertainty, observability = uncertainty_of(record), case_of(record).once(determined)
    volume = volumetric_uncertainty(uncertainty)
    summary = calibration_summary(record, volume)
    evaluations = record.evaluations()
    capture = record.recording.capture
    sections = [
        _data(record, summary),
        _nominal_and_calibrated(record, summary, evaluations),
        _scale(record, summary, evaluations),
        parameters_section(record, summary),
        *_residuals(record, summary, evaluations["calibrated"]),
        *patterns_sections(record),
        Section("arm", "The arm in its poses", [_view(record, evaluations["calibrated"])]),
        volume_section(volume, summary),
        *tried_sections(record, volume),
        *([] if record.sampled is None else [monte_carlo_section(record)]),
        correlations_section(record, uncertainty),
        observability_section(observability),
        bounds_section(record, summary),
    ]
    joint = record.final_method == "joint"
    method = _OBSERVED if joint and capture.observations else _METHODS[record.final_method]
    robust = f", robust loss {record.robust}" if record.robust else ""
    verdict = summary["verdict"]
    report = Report(
        title="Calibration of " + (record.recording.nominal.name or "an arm"),
        subtitle=f"{method}{robust}; {pluralise(summary['poses'], 'pose')} in {capture_words(capture)}",
        verdict=verdict["says"],
        verdict_mark=verdict["mark"],
        warnings=summary["warnings"],
        facts=_facts(summary),
        sections=sections,
    )
    return report, summary


def _view(record: CalibrationRecord, evaluation: Evaluation) -> ArmView:
    arm, capture = record.calibrated.arm, record.recording.capture
    if record.sockets_alone:
        return view_of_arm(arm, capture, pose_distances(capture, evaluation))
    distances = np.concatenate([one.distance for one in observation_residuals(record)])
    return view_of_arm(arm, capture, distances, record.observed.geometry)


def _facts(summary: dict[str, Any]) -> list[tuple[str, str]]:
    nominal, calibrated, facts = summary["nominal"], summary["calibrated"], []
    validated = summary["cross_validation"]
    if validated is not None and validated["rms_mm"] is not None:
        rms, predicted = format_number(validated["rms_mm"]), format_number(validated["rms_predicted_mm"])
        facts.append(("Held-out groups, RMS distance", f"{rms}\u00a0mm (predicted {predicted})"))
    for key, name in (("de_mm", "DE"), ("deltam_mm", "Deltam")) if "de_mm" in calibrated else ():
        change = f"{format_number(nominal[key])} → {format_number(calibrated[key])}\u00a0mm"
        facts.append((f"{name}, nominal → calibrated", change))
    if "other_poses" in summary:
        facts.append(("Other poses, RMS distance", f"{format_number(summary['other_poses']['rms_mm'])}\u00a0mm"))
    for row in summary["kinds"][:_MOST_KINDS]:
        change = f"{format_number(row['rms_before_mm'])} → {format_number(row['rms_after_mm'])}\u00a0mm"
        facts.append((f"RMS residual, {row['kind']}, nominal → calibrated", change))
    volume = summary["uncertainty"]["volume"]
    length = f"U of a {volume['length_mm']:g} mm length with the noise of its readings"
    largest, median = (volume[f"expanded_length_reading_{which}_mm"] for which in ("largest", "median"))
    if median is not None and largest is not None:
        typical, worst = (f"{two_digits(u)}\u00a0mm" for u in (median, largest))
        facts.append((f"{length} (95 %)", f"median {typical}, largest {worst}"))
    else:
        facts.append((length, "not determined everywhere"))
    if summary.get("lengths_tested"):
        facts.append(("Lengths tested", lengths_sentence(summary["lengths_tested"]).partition(": ")[2]))
    if summary["scale_k"] is not None:
        expanded = summary["scale_expanded"] or 0.0
        decimals = decimals_for(expanded, 7)
        k = f"{summary['scale_k']:.{decimals}f}\u00a0±\u00a0{expanded:.{decimals}f} (95\u00a0%)"
        facts.append(("Scale k of stage 1", k))
    return facts


def _data(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    capture = record.recording.capture
    sockets = [[text_cell(name), number_cell(size, 0)] for name, size in zip(capture.names, capture.sizes, strict=True)]
    lengths = [
        [
            text_cell(f"{row['from']} – {row['to']}"),
            number_cell(row["value_mm"], decimals_for(float(length.u))),
            number_cell(float(length.u), decimals_for(float(length.u))),
        ]
        for row, length in zip(summary["lengths"], capture.lengths, strict=True)
    ]
    introduction = (
        f"The poses {'are simulated' if record.recording.true is not None else 'were recorded'}. "
        f"{len(record.names)} parameters of {record.recording.nominal.arm.joints} joints were identified. "
        f"Fixed at their nominal values: {', '.join(record.held) or 'none'}."
    )
    if record.hold and record.method == REPEATABILITY:
        introduction += f" {record.hold} sets the scale, since nothing that was observed does."
    elif record.hold:
        introduction += f" {record.hold} was the scale anchor of stage 1, since poses alone do not determine the scale."
    blocks: list = [introduction]
    if sockets or not capture.observations:
        blocks.append(ReportTable("Sockets in which the tip was seated", ("socket", "poses"), sockets))
    blocks += observation_tables(record)
    if lengths or not capture.observations:
        blocks.append(ReportTable("Reference lengths", ("between", "calibrated value [mm]", "u [mm]"), lengths))
    blocks += removed_tables(record)
    blocks.append(_traceability(summary["scale_from"]))
    return Section("data", "What was calibrated, and from which data", blocks)


def _traceability(sources: list[str]) -> str:
    if not sources:
        return (
            "Measurements of the arm are not traceable to the metre by this calibration: nothing that was measured set "
            "its scale."
        )
    if sources == ["the reference lengths"]:
        return (
            "Measurements of the arm are traceable to the metre through these reference lengths alone, as far as their "
            "calibration certificates are."
        )
    return (
        "Measurements of the arm are traceable to the metre as far as the calibration certificates are of what sets "
        f"its scale: {', '.join(sources)}."
    )


def _nominal_and_calibrated(
    record: CalibrationRecord, summary: dict[str, Any], evaluations: dict[str, Evaluation]
) -> Section:
    stages = {"nominal": "nominal", "stage1": "stage 1", "calibrated": "calibrated"}
    blocks: list = ["The nominal and the calibrated arm on the poses used for identification."]
    if record.robust:
        blocks[0] += " Root mean squares count every pose in full, those too that lost weight."
    if summary["cross_validation"] is not None:
        blocks += validation_tables(summary["cross_validation"])
    capture, fixed = record.recording.capture, record.fixed_by_one_length
    if not record.stage1_apart:
        del stages["stage1"]  # which is the calibrated arm
    if summary.get("prior"):
        blocks.append(_prior_table(summary["prior"]))
    if summary.get("shared_errors"):
        blocks.append(shared_sentence(summary["shared_errors"]))
    if not record.sockets_alone:
        blocks += [*agreement_tables(summary), *other_poses_table(summary)]
    if summary["nominal"]:
        caption = "Metrics by arm [mm]"
        if capture.observations:
            counts = pluralise(len(capture.names), "socket"), pluralise(len(capture.lengths), "reference length")
            caption = f"{counts[0]} of the arm's own probe, {counts[1]} [mm]"
        blocks.append(metrics_table(caption, summary, stages, fixed_scale=fixed))
    if record.sockets_alone:
        pair = {stage: evaluations[stage] for stage in ("nominal", "calibrated")}
        title = "Distance of every pose from its socket's centroid"
        blocks.append(residual_chart("stages", title, capture, pair))
    else:
        blocks.append(stages_chart(record, distances_of(capture, evaluations["nominal"])))
    if "truth" in summary:
        rows = [
            [text_cell(title), *(number_cell(scale * summary["truth"][stage][key]) for stage in stages)]
            for key, title, scale in (
                ("length_error_largest_mm", "largest error of a length parameter [mm]", 1.0),
                ("angle_error_largest_rad", "largest error of an angle parameter [deg]", 1 / DEG),
            )
        ]
        blocks.append(ReportTable("Against the true arm of the simulation", ("", *stages.values()), rows))
    return Section("stages", "Nominal and calibrated arm", blocks)


def _prior_table(prior: list[dict[str, Any]]) -> ReportTable:
    """Each group of parameters that has a prior: its standard deviation, and how many parameters the data determine."""
    rows = []
    for row in prior:
        scale, unit = people_read(row["unit"])
        sd = text_cell("0: not supported by the data, so exact")
        if row["supported"]:
            sd = text_cell(f"{row['sd'] * scale:.3g} {unit}".strip())
        cells = (text_cell(row["group"]), text_cell("learned" if row["learned"] else "given"), sd)
        rows.append([*cells, number_cell(row["parameters"], 0), number_cell(row["effective_parameters"], 1)])
    columns = ("group", "prior", "standard deviation", "parameters", "of these determined by the data")
    return ReportTable("Priors of the parameters, and effective parameters", columns, rows)


def _scale(record: CalibrationRecord, summary: dict[str, Any], evaluations: dict[str, Evaluation]) -> Section:
    k, u, single = record.k, record.u_k, record.fixed_by_one_length
    k_shown = f"{k:.{decimals_for(u, 8)}f}"
    u_of_k = f"u(k)\u00a0=\u00a0{two_digits(u)}"
    if record.method == REPEATABILITY:
        introduction = "The scale is that of the nominal arm: nothing that was measured set it." + (
            f" By the reference lengths, which took no part, k = {k_shown}." if math.isfinite(k) else ""
        )
    elif math.isnan(k):
        introduction = f"Fitted with all else at once, the scale comes from {', '.join(summary['scale_from'])}."
    elif record.final_method == "joint":
        introduction = (
            f"Poses and reference lengths were fitted together{_why_jointly(record)}. The arm that poses alone give "
            f"measures the lengths as k = {k_shown} times their calibrated value, with {u_of_k}."
        )
    else:
        expanded = 1000 * (summary["scale_expanded"] or math.nan)
        decimals = decimals_for(expanded)
        introduction = (
            "Repeatability does not determine the size of an arm; the reference lengths do. The arm of stage 1 "
            f"measures them as k = {k_shown} times their calibrated value, with {u_of_k}. The lengths of the arm "
            f"were divided by k: {abs(k - 1) * 1000:.{decimals}f} mm in a metre, known to "
            f"±\u00a0{expanded:.{decimals}f} mm in a metre (95 %)."
        )
    if not summary["lengths"]:
        return Section("scale", "Scale", [introduction])
    introduction += (
        " The only length fixed the scale, so its own error is zero by construction and is not shown."
        if single
        else " U of a length contains the uncertainty of its certificate and the scatter of the poses at its ends."
    )
    errors = {stage: np.asarray(evaluations[stage].error) for stage in ("nominal", "stage1", "calibrated")}
    apart = record.stage1_apart
    before = [errors["nominal"], *([errors["stage1"]] if apart else [])]
    stage1 = ["error, stage 1"] if apart else []
    columns = ("between", "value", "error, nominal", *stage1, "error, calibrated", "U of error")
    table = ReportTable(
        "Reference lengths [mm]", columns, length_rows(summary["lengths"], before, 0 if single else None)
    )
    drawn = {"stage 1": errors["stage1"]} if apart else {}
    drawn["calibrated"] = errors["calibrated"]
    block = table if single else length_chart(summary["lengths"], drawn, table)
    return Section("scale", "Scale and reference lengths", [introduction, block])


def _why_jointly(record: CalibrationRecord) -> str:
    against = shorten(record.against_division)
    return f", since the division by k was not possible because of {against}" if against else ""


def _residuals(record: CalibrationRecord, summary: dict[str, Any], evaluation: Evaluation) -> list[Section]:
    capture = record.recording.capture
    if not record.sockets_alone:
        return [residuals_section(record, summary), geometry_section(summary)]
    chart = residual_chart(
        "residuals", "Residuals of the calibrated arm", capture, {"calibrated": evaluation}, mark=True
    )
    introduction = (
        "The distance of each pose's tip from the centroid of its socket, by the calibrated arm. Poses more than eight "
        "times as far as the median are marked: check how the tip was seated there."
    )
    blocks = [introduction, socket_table(capture, evaluation), chart]
    return [Section("residuals", "Residuals by socket and pose", blocks)]
