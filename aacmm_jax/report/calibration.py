"""The report of a calibration: its facts, data, stages and scale; the other sections are in `calibration_sections`."""

import math
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.record import REPEATABILITY, CalibrationRecord, uncertainty_of
from ..core.text import pluralise, shorten
from ..diagnostics.determined import determined
from ..diagnostics.findings import case_of
from ..diagnostics.pose_residuals import rms
from ..plot.lengths import length_chart
from ..plot.residuals import arms_chart, distances_by_arm
from ..summaries import result_tables
from ..summaries.calibration import calibration_summary
from ..summaries.observations import capture_words
from ..summaries.tables import (
    Cell,
    decided_of,
    decimals_for,
    format_number,
    lengths_sentence,
    listed,
    number,
    shared_sentence,
    two_digits,
)
from ..summaries.verdicts import length_uncertainty
from ..uncertainty.coverage import LEVEL_IN_PERCENT
from ..uncertainty.volume import volumetric_uncertainty
from . import calibration_sections as sections
from .elements import DRAWN, Block, Report, Section, length_table, observation_tables, removed_tables

_METHODS = {
    "two-stage": "Identification from repeatability, then a scale fix",
    "joint": "One least-squares fit of poses and lengths",
    REPEATABILITY: "Identification with the scale of the nominal arm",
}
_MOST_KINDS = 3  # among the facts at the beginning
_OBSERVED = "One least-squares fit of all observations"


def calibration_report(record: CalibrationRecord) -> Report:
    """The report, except for the origin of its file."""
    uncertainty, observability = uncertainty_of(record), case_of(record).once(determined)
    volume = volumetric_uncertainty(uncertainty)
    summary = calibration_summary(record, volume)
    evaluations = record.evaluations()
    capture = record.recording.capture
    joint = record.final_method == "joint"
    method = _OBSERVED if joint and capture.observations else _METHODS[record.final_method]
    robust = f", robust loss {record.robust}" if record.robust else ""
    distances = distances_by_arm(record)
    return Report(
        title="Calibration of " + (record.recording.nominal.name or "an arm"),
        subtitle=f"{method}{robust}; {pluralise(summary['poses'], 'pose')} in {capture_words(capture)}",
        verdict=summary["verdict"]["says"],
        verdict_mark=summary["verdict"]["mark"],
        warnings=summary["warnings"],
        numbers=_numbers(summary, distances),
        picture=arms_chart(capture, distances, most=DRAWN),
        facts=_facts(summary),
        sections=[
            _data(record, summary),
            _nominal_and_calibrated(record, summary),
            _scale(record, summary, evaluations),
            sections.parameters(record, summary),
            *sections.residuals(record, summary, evaluations["calibrated"]),
            *sections.cameras(record, summary),
            *sections.patterns(record),
            sections.arm_in_poses(record, evaluations["calibrated"]),
            sections.volume(volume, summary),
            *sections.coverage(record, volume),
            *sections.monte_carlo(record),
            sections.correlations(uncertainty),
            sections.observability(observability),
            sections.bounds(record, summary),
        ],
        simulated=record.recording.true is not None,
    )


def _numbers(summary: dict[str, Any], distances: dict[str, np.ndarray]) -> list[tuple[str, str, str]]:
    """What the calibration changed, what lengths are measured to, and what held-out data or the scale say of it."""
    before, after = (f"{rms(values[np.isfinite(values)]):.3g}" for values in distances.values())
    numbers = [("RMS residual", f"{before} → {after} mm", "nominal → calibrated, poses of the calibration")]
    stated, length = length_uncertainty(summary["uncertainty"]), summary["uncertainty"]["volume"]["length_mm"]
    value, where, rest = (stated or "not determined everywhere").partition(" where ")
    value, unit, everywhere = (value, "", where + rest) if where else value.partition(" mm")
    numbers.append((f"U of a {length:.4g} mm length ({LEVEL_IN_PERCENT})", f"{value}{unit}", everywhere.strip()))
    validated, held_out = summary["cross_validation"], summary.get("held_out_poses")
    if validated is not None and validated["rms_mm"] is not None:
        predicted = validated["rms_predicted_mm"]
        note = "" if predicted is None else f"predicted {predicted:.3g} mm"
        numbers.append(("Held-out groups, RMS distance", f"{validated['rms_mm']:.3g} mm", note))
    elif held_out is not None:
        before, after = (held_out["held_out"][key] for key in ("rms_nominal_mm", "rms_mm"))
        change, note = ("", "") if before is None else (f"{before:.3g} → ", "nominal → calibrated")
        numbers.append(("Held-out poses, RMS distance", f"{change}{after:.3g} mm", note))
    else:
        numbers.append(("Poses", f"{summary['poses']}", "none held out"))
    return numbers


def _facts(summary: dict[str, Any]) -> list[tuple[str, str]]:
    nominal, calibrated, facts = summary["nominal"], summary["calibrated"], []

    def changed(before: float, after: float) -> str:
        return f"{format_number(before)} → {format_number(after)}\u00a0mm"

    for key, name in (("de_mm", "DE"), ("deltam_mm", "Deltam")) if "de_mm" in calibrated else ():
        facts.append((f"{name}, nominal → calibrated", changed(nominal[key], calibrated[key])))
    if "held_out_poses" in summary:
        row = summary["held_out_poses"]["held_out"]
        numbers = " / ".join(format_number(row[key]) for key in ("rms_mm", "mean_mm", "largest_mm"))
        facts.append(
            (f"{pluralise(row['poses'], 'held-out pose')}, distance: RMS / mean / largest", f"{numbers}\u00a0mm")
        )
    kinds = summary["kinds"]
    for row in kinds[:_MOST_KINDS] if len(kinds) > 1 else ():  # the RMS of a single kind is the first number
        title = f"RMS residual, {row['kind']}, nominal → calibrated"
        facts.append((title, changed(row["rms_before_mm"], row["rms_after_mm"])))
    if summary.get("lengths_tested"):
        facts.append(("Lengths tested", lengths_sentence(summary["lengths_tested"]).partition(": ")[2]))
    if summary["scale_k"] is not None:
        expanded = summary["scale_expanded"] or 0.0
        decimals = decimals_for(expanded, 7)
        level = LEVEL_IN_PERCENT.replace(" ", "\u00a0")
        k = f"{summary['scale_k']:.{decimals}f}\u00a0±\u00a0{expanded:.{decimals}f} ({level})"
        facts.append(("Scale k of stage 1", k))
    return facts


def _data(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    capture = record.recording.capture
    introduction = (
        f"The poses {'are simulated' if record.recording.true is not None else 'were recorded'}. "
        f"{len(record.names)} parameters of {record.recording.nominal.arm.joints} joints were identified. "
        f"Fixed at their nominal values: {', '.join(record.held) or 'none'}."
    )
    if record.hold and record.method == REPEATABILITY:
        introduction += f" No observation determines the scale, so {record.hold} was held constant."
    elif record.hold:
        introduction += (
            f" Poses alone do not determine the scale, so {record.hold} was held constant in stage 1 (scale anchor)."
        )
    blocks: list[Block] = [introduction, *decided_of(summary)]
    if capture.names or not capture.observations:
        sockets = zip(capture.names, capture.sizes, strict=True)
        columns = {"socket": lambda row: row[0], "poses": lambda row: row[1]}
        blocks.append(listed("Sockets in which the tip was seated", sockets, columns))
    blocks += observation_tables(record)
    if capture.lengths or not capture.observations:

        def to_u(value: Any, u: Any) -> Cell:
            return number(float(value), decimals_for(float(u)))

        columns = {
            "between": lambda length: f"{length.start} – {length.end}",
            "calibrated value [mm]": lambda length: to_u(length.value, length.u),
            "u [mm]": lambda length: to_u(length.u, length.u),
        }
        blocks.append(listed("Reference lengths", capture.lengths, columns))
    sources = summary["scale_from"]
    start = "Measurements of the arm are"
    if not sources:
        traceable = f"{start} not traceable to the metre by this calibration: no measurement set the scale of the arm."
    elif sources == ["the reference lengths"]:
        traceable = (
            f"{start} traceable to the metre through these reference lengths alone, as far as the calibration "
            "certificates of the lengths are."
        )
    else:
        traceable = (
            f"The scale comes from {', '.join(sources)}. {start} traceable to the metre as far as the calibration "
            "certificates of these sources are."
        )
    return Section("data", "What was calibrated, and from which data", [*blocks, *removed_tables(record), traceable])


def _nominal_and_calibrated(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    stages = dict(result_tables.STAGES)
    if not record.stage1_apart:
        del stages["stage1"]  # which is the calibrated arm
    introduction = "The nominal and the calibrated arm, compared on the poses used for identification."
    if record.recording.as_found is not None:
        introduction += " The arm as found has the parameters that were in its controller on arrival."
    if record.robust:
        introduction += " RMS values count every pose in full, including poses whose weight the robust loss reduced."
    blocks: list[Block] = [introduction]
    if summary["cross_validation"] is not None:
        blocks += result_tables.validation_tables(summary["cross_validation"])
    if "held_out_poses" in summary:
        blocks += result_tables.held_out_tables(summary["held_out_poses"])
    capture = record.recording.capture
    if summary.get("prior"):
        blocks.append(result_tables.prior_table(summary["prior"]))
    if summary.get("shared_errors"):
        blocks.append(shared_sentence(summary["shared_errors"]))
    if not record.sockets_alone:
        blocks += result_tables.agreement_tables(summary)
    if summary["nominal"]:
        caption = "Metrics by arm [mm]"
        if capture.observations:
            counts = pluralise(len(capture.names), "socket"), pluralise(len(capture.lengths), "reference length")
            caption = f"{counts[0]} measured with the arm's own probe, {counts[1]} [mm]"
        blocks.append(result_tables.metrics_table(caption, summary, stages, fixed_scale=record.fixed_by_one_length))
    if "truth" in summary:
        blocks.append(result_tables.truth_table(summary["truth"], stages))
    return Section("stages", "Nominal and calibrated arm", blocks)


def _scale(record: CalibrationRecord, summary: dict[str, Any], evaluations: dict[str, Evaluation]) -> Section:
    single, introduction = record.fixed_by_one_length, _scale_sentence(record, summary)
    if not summary["lengths"]:
        return Section("scale", "Scale", [introduction])
    introduction += (
        " The only reference length fixed the scale, so its error is zero by construction and is not shown."
        if single
        else " U of a length includes the uncertainty of its certificate and the scatter of the poses at its ends."
    )
    stage1 = {"stage 1": np.asarray(evaluations["stage1"].error)} if record.stage1_apart else {}
    rows, before = summary["lengths"], {"nominal": np.asarray(evaluations["nominal"].error)} | stage1
    block: Block = length_table("Reference lengths [mm]", rows, before, 0 if single else None)
    if not single:
        block = length_chart(rows, stage1)._replace(table=block)
    return Section("scale", "Scale and reference lengths", [introduction, block])


def _scale_sentence(record: CalibrationRecord, summary: dict[str, Any]) -> str:
    k, u = record.k, record.u_k
    k_shown, u_of_k = f"{k:.{decimals_for(u, 8)}f}", f"u(k)\u00a0=\u00a0{two_digits(u)}"
    if record.method == REPEATABILITY:
        return "The scale is that of the nominal arm: no measurement set the scale." + (
            f" The reference lengths, which the calibration did not use, give k = {k_shown}."
            if math.isfinite(k)
            else ""
        )
    if math.isnan(k):
        return (
            "The scale was fitted together with all other parameters; it comes from "
            f"{', '.join(summary['scale_from'])}."
        )
    if record.final_method == "joint":
        against = shorten(record.against_division)
        why = f", since the division by k was not possible because of {against}" if against else ""
        return (
            f"Poses and reference lengths were fitted together{why}. With the parameters determined from the poses "
            f"alone, the arm measures k = {k_shown} times the calibrated value of the lengths, with {u_of_k}."
        )
    expanded = 1000 * (summary["scale_expanded"] or math.nan)
    decimals = decimals_for(expanded)
    return (
        "Repeatability does not determine the size of an arm, but the reference lengths do. With the parameters of "
        f"stage 1, the arm measures k = {k_shown} times the calibrated value of the reference lengths, with {u_of_k}. "
        f"The lengths of the arm were divided by k, a change of {abs(k - 1) * 1000:.{decimals}f} mm per metre, known "
        f"to ±\u00a0{expanded:.{decimals}f} mm per metre ({LEVEL_IN_PERCENT})."
    )
