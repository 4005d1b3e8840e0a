"""The report of an evaluation: acceptance tests, and the nominal and the calibrated arm on a capture."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..acceptance.record import EvaluationRecord, PointsRecord
from ..acceptance.results import AcceptanceTest
from ..calibration.evaluation import Evaluation
from ..core.text import pluralise
from ..data.capture import ReferenceLength
from ..data.recording import ProbedSphere
from ..plot.charts import Chart
from ..plot.lengths import metrics_chart, reading_errors_chart
from ..plot.residuals import arms_chart, distances_in
from ..summaries import result_tables
from ..summaries.calibration import metrics_by_socket_and_length
from ..summaries.evaluation import evaluation_summary, points_summary
from ..summaries.observations import capture_words
from ..summaries.tables import Cell, Table, decimals_for, format_number, listed, number
from ..summaries.verdicts import overall_decision
from ..uncertainty.coverage import COVERAGE_FACTOR
from .elements import DRAWN, Block, Report, Section, length_table, residual_chart, socket_table, view_of_arm

_STAGES = ("nominal", "calibrated")
_VALUES = "Every metric is the worst of several values."
_GROUPS = (("held_out", "Held-out data"), ("identified_from", "Data used for identification"))
_FACTS = {
    "observed_rms_mm": "RMS distance from the geometry",
    "rms_mm": "RMS distance in sockets",
    "deltam_mm": "Deltam",
    "length_error_largest_mm": "largest length error",
}


def evaluation_report(record: EvaluationRecord) -> Report:
    """The report, except for the origin of its file."""
    tests, capture, arm = record.acceptance(), record.recording.capture, record.calibrated.arm
    summary = evaluation_summary(record, tests)
    evaluations = record.evaluations(capture)
    calibrated = evaluations["calibrated"]
    geometry = {} if calibrated.observed is None else calibrated.observed.geometry
    sockets = [socket_table(capture, calibrated)] if capture.names else []
    residuals = [*sockets, *observation_tables(summary), residual_chart(capture, calibrated)]
    view = view_of_arm(arm, capture, distances_in(capture, calibrated), geometry)
    tested, facts = len(record.recording.spheres), _facts(summary)
    distances = {stage: distances_in(capture, evaluations[stage]) for stage in _STAGES}
    stages, picture = arms_chart(capture, distances, most=DRAWN), _margins(tests["calibrated"])
    nominal_and_calibrated = _nominal_and_calibrated(record, summary)
    if picture is None:
        picture = stages
    else:
        nominal_and_calibrated.append(stages)
    return Report(
        title="Evaluation of " + (record.recording.nominal.name or "an arm"),
        subtitle=f"{pluralise(len(capture.readings), 'pose')} in {capture_words(capture)}"
        + (f", {pluralise(tested, 'touched sphere')}" if tested else ""),
        verdict=summary["verdict"]["says"],
        verdict_mark=summary["verdict"]["mark"],
        warnings=[
            *summary["warnings"],
            *(f"Over the limit: {sentence}" for sentence in summary["failed"]),
            *(f"About the calibration: {sentence}" for sentence in record.calibration_warnings),
        ],
        numbers=_numbers(summary) or [(*fact, "") for fact in facts[:3]],
        picture=picture,
        facts=facts if summary["acceptance"] else facts[3:],
        sections=[
            *_acceptance(tests["calibrated"], summary, capture.lengths, record.recording.spheres),
            Section("stages", "Nominal and calibrated arm", nominal_and_calibrated),
            *_lengths(record, tests["calibrated"], evaluations),
            Section("residuals", "Residuals by observation and pose", residuals),
            Section("arm", "The arm in its poses", [view]),
        ],
        simulated=record.recording.true is not None,
        decision=overall_decision(summary),
        rules=[test.rule for test in tests["calibrated"] if test.decision is not None],
    )


def observation_tables(summary: dict[str, Any]) -> list[Table]:
    """Observations besides sockets, held-out ones first."""
    return [
        result_tables.observations_table(f"{title}, RMS distance of poses from their geometry [mm]", rows)
        for group, title in _GROUPS
        if (rows := (summary[group] or {}).get("observations"))
    ]


def points_report(record: PointsRecord) -> Report:
    """The report of an evaluation of points."""
    tests, measured = record.acceptance(), record.measured
    summary = points_summary(record, tests)
    chart = reading_errors_chart(tests)
    counts = [pluralise(summary[f"{word}s"], word) for word in ("socket", "length", "sphere")]
    return Report(
        title="Acceptance test of points",
        subtitle=f"{pluralise(summary['points'], 'point')} recorded: {', '.join(counts)}",
        verdict=summary["verdict"]["says"],
        verdict_mark=summary["verdict"]["mark"],
        warnings=summary["warnings"],
        numbers=_numbers(summary),
        picture=_margins(tests),
        facts=[],
        sections=[
            *_acceptance(tests, summary, measured.lengths, measured.spheres),
            *([] if chart is None else [Section("lengths", "Lengths", [chart])]),
        ],
        decision=overall_decision(summary),
        rules=[test.rule for test in tests if test.decision is not None],
    )


def _facts(summary: dict[str, Any]) -> list[tuple[str, str]]:
    chosen = next(((summary[group], title) for group, title in _GROUPS if summary[group] is not None), None)
    if chosen is None:
        return []
    rows, title = chosen
    return [
        (
            f"{title}: {name}, nominal → calibrated",
            " → ".join(format_number(rows[stage][key]) for stage in _STAGES) + "\u00a0mm",
        )
        for key, name in _FACTS.items()
        if key in rows["calibrated"] and not (key.startswith("length") and rows["fixed_by_one_length"])
    ]


def _acceptance(
    tests: list[AcceptanceTest],
    summary: dict[str, Any],
    lengths: Sequence[ReferenceLength],
    spheres: Sequence[ProbedSphere],
) -> list[Section]:
    """The acceptance tests, if there were any: tables, what a full procedure would also need, parts of metrics; and the
    artefacts."""
    rows, artefacts, u_test = summary["acceptance"], _artefacts(lengths, spheres), summary["u_test_mm"]
    if not rows:
        return [Section("artefacts", "Artefacts", artefacts)] if artefacts else []
    stated = "no uncertainty was stated for seat, fixture and temperature"
    if u_test:
        u = format_number(1000 * u_test, 1)
        stated = f"a standard uncertainty of {u} µm was stated for seat, fixture and temperature"
    blocks: list[Block] = [
        f"Every metric is computed from single readings. U (coverage factor {COVERAGE_FACTOR:g}) is the contribution "
        f"of the tester: it includes the uncertainty of the artefacts; {stated}. The arm's own scatter is what is "
        "tested, so U does not include it (ISO 14253-5). The standards allow a reading to be repeated; this is not "
        "done here. A test that lacks something its standard requires is labelled 'based on' the standard. "
        "Requirements and formulas are taken from secondary sources on the editions named.",
    ]
    metrics = [metric for test in rows for metric in test["figures"]]
    limited = any(metric["limit_mm"] is not None for metric in metrics)
    nominal = any(metric["nominal_mm"] is not None for metric in metrics)
    if limited:
        used = dict.fromkeys(f"{test['rule']} (for {test['standard']})" for test in rows if test["decision"])
        blocks.append(
            f"Decision rules: {'; '.join(used)}. A value that a rule neither accepts nor rejects is called undecided."
        )
    for test, metrics_of_test in zip(rows, result_tables.acceptance_tables(rows), strict=True):
        blocks.append(metrics_of_test)
        if test["missing"]:
            blocks.append(f"The full procedure was not carried out. {' '.join(test['missing'])}")
    parts = [(part, metric, test) for test in tests for metric in test.metrics for part in metric.values]
    every = listed(
        f"Every value of every metric{' with a limit' if limited else ''} [mm]",
        [row for row in parts if not limited or row[0].limit is not None],
        {
            "at": lambda row: row[0].where,
            "decision": lambda row: Cell(row[0].decision or "–", None, result_tables.MARKS[row[0].decision]),
            "calibrated" if nominal else "value": lambda row: number(row[0].value, decimals_for(row[0].expanded)),
            "U": lambda row: result_tables.stated_expanded(row[0].expanded),
            "MPE": lambda row: row[0].limit,
            "metric": lambda row: row[1].name,
            "standard": lambda row: row[2].standard,
        },
    )
    values = Chart("values", "Values", _VALUES, (), every, printed=limited)
    return [Section("acceptance", "Acceptance tests", [*blocks, values, *artefacts])]


def _margins(tests: list[AcceptanceTest]) -> Chart | None:
    """The metrics against their limits, if there are any."""
    return metrics_chart(tests) if tests else None


def _numbers(summary: dict[str, Any]) -> list[tuple[str, str, str]]:
    """The three metrics that use most of their limit; without limits, the first three."""
    metrics = [metric for test in summary["acceptance"] for metric in test["figures"]]
    metrics.sort(key=lambda metric: -_used(metric))  # stable
    return [
        (
            metric["name"],
            f"{format_number(metric['value_mm'])}\u00a0mm",
            "no limit" if metric["limit_mm"] is None else f"limit {metric['limit_mm']:.3g} mm: {metric['decision']}",
        )
        for metric in metrics[:3]
    ]


def _used(metric: dict[str, Any]) -> float:
    return 0.0 if not metric["limit_mm"] else abs(metric["value_mm"]) / metric["limit_mm"]


def _artefacts(lengths: Sequence[ReferenceLength], spheres: Sequence[ProbedSphere]) -> list[Table]:
    bars = Counter((float(length.value), float(length.u)) for length in lengths)
    rows = [("length", value, u, f"in {pluralise(count, 'position')}") for (value, u), count in sorted(bars.items())]
    for sphere in spheres:
        name = f"sphere '{sphere.name}' for {sphere.test.replace('-', ' ')}"
        touches = "+".join(str(len(group)) for group in sphere.groups)
        use = f"touched {touches} times with a ball of {sphere.stylus:g} mm; form error {format_number(sphere.form)} mm"
        rows.append((name, sphere.diameter, sphere.u, use))
    columns = {
        "artefact": lambda row: row[0],
        "calibrated value [mm]": lambda row: number(row[1], decimals_for(row[2])),
        "u [mm]": lambda row: result_tables.with_u_digits(row[2]),
        "used": lambda row: row[3],
    }
    return [listed("Artefacts", rows, columns)] if rows else []


def _nominal_and_calibrated(record: EvaluationRecord, summary: dict[str, Any]) -> list[Block]:
    stages = {stage: words for stage, words in result_tables.STAGES.items() if stage != "stage1"}
    blocks: list[Block] = [
        result_tables.metrics_table(f"{title} [mm]", rows, stages, fixed_scale=rows["fixed_by_one_length"])
        for group, title in _GROUPS
        if (rows := summary[group]) is not None
    ]
    if record.used:
        used = ", ".join(sorted(record.used))
        blocks.append(f"The calibration used: {used}. All other data were held out.")
    return blocks


def _lengths(
    record: EvaluationRecord, tests: list[AcceptanceTest], evaluations: dict[str, Evaluation]
) -> list[Section]:
    """Errors of lengths: of single readings if acceptance tests took them, with their limits; and of means."""
    capture, chart, calibrated = record.recording.capture, reading_errors_chart(tests), evaluations["calibrated"]
    if not capture.lengths:
        return []
    rows = metrics_by_socket_and_length(capture, calibrated)["lengths"]
    u = [row["error_u_mm"] for row in rows]
    expanded = [None if value is None else COVERAGE_FACTOR * value for value in u]
    rows = [row | {"expanded_mm": value} for row, value in zip(rows, expanded, strict=True)]
    caption, before = "Lengths between the mean points of their sockets [mm]", np.asarray(evaluations["nominal"].error)
    means = length_table(caption, rows, {"nominal": before}, record.length_that_fixed_scale())
    note = (
        "These lengths are computed from the mean of all poses in each socket. They are given for comparison only "
        f"and are not part of an acceptance test. U (coverage factor {COVERAGE_FACTOR:g}) also includes the scatter "
        "of the poses at both ends."
    )
    return [Section("lengths", "Lengths", [*([] if chart is None else [chart]), means, note])]
