"""The report of an evaluation: acceptance tests, and the nominal and the calibrated arm on a capture."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..acceptance.decision import worst
from ..acceptance.record import EvaluationRecord, PointsRecord
from ..acceptance.results import METRICS, AcceptanceTest, Metric
from ..calibration.evaluation import Evaluation, evaluate
from ..core.text import pluralise
from ..data.capture import Capture, ReferenceLength
from ..data.sphere import ProbedSphere
from ..kinematics.arm import Arm
from ..summaries.evaluation import evaluation_summary, points_summary
from ..summaries.observations import capture_words
from . import charts
from .arm_view import view_of_arm
from .elements import ArmView, Cell, Chart, Report, ReportTable, Section, format_number, number_cell, text_cell
from .residuals import length_rows, metrics_table, pose_distances, residual_chart, socket_table

_MARKS = {"conforms": "good", "fails": "bad", "undecided": "unsure", None: ""}
_SIGNS = {"conforms": "✓ conforms", "fails": "✗ fails", "undecided": "? undecided", None: "–"}
_STAGES = ("nominal", "calibrated")
_GROUPS = (("held_out", "Held-out data"), ("identified_from", "Data used for identification"))


def evaluation_report(record: EvaluationRecord) -> tuple[Report, dict[str, Any]]:
    """The report, except for the origin of its file; and the summary that it was made from."""
    tests, capture = record.acceptance(), record.recording.capture
    summary = evaluation_summary(record, tests)
    evaluations = {stage: evaluate(arm.arm, capture) for stage, arm in record.arms().items()}
    calibrated = evaluations["calibrated"]
    verdict, mark = _verdict(summary)
    residuals = residual_chart(
        "residuals", "Residuals of the calibrated arm", capture, {"calibrated": calibrated}, mark=True
    )
    residual_tables = [*([socket_table(capture, calibrated)] if capture.names else []), *_observation_tables(summary)]
    report = Report(
        title="Evaluation of " + (record.recording.nominal.name or "an arm"),
        subtitle=f"{pluralise(len(capture.readings), 'pose')} in {capture_words(capture)}"
        + (f", {pluralise(tested, 'touched sphere')}" if (tested := len(record.recording.spheres)) else ""),
        verdict=verdict,
        verdict_mark=mark,
        warnings=summary["warnings"] + [f"Over the limit: {sentence}" for sentence in summary["failed"]],
        facts=_facts(summary),
        sections=[
            _acceptance_section(tests["calibrated"], summary, capture.lengths, record.recording.spheres),
            Section("stages", "Nominal and calibrated arm", _nominal_and_calibrated(record, summary, evaluations)),
            *_lengths(record, tests["calibrated"], evaluations),
            Section("residuals", "Residuals by observation and pose", [*residual_tables, residuals]),
            Section("arm", "The arm in its poses", [_view(record.calibrated.arm, capture, calibrated)]),
        ],
    )
    return report, summary


def _observation_tables(summary: dict[str, Any]) -> list[ReportTable]:
    """Observations besides sockets; of held-out ones, what the calibration predicts too."""
    columns = (
        "observation",
        "kind",
        "poses",
        "nominal",
        "calibrated",
        "predicted",
        "calibrated, in standard deviations",
    )
    keys = ("nominal_rms_mm", "rms_mm", "rms_predicted_mm")
    tables = []
    for group, title in _GROUPS:
        rows = [
            [
                *(text_cell(row["observation"]), text_cell(row["kind"]), number_cell(row["poses"], 0)),
                *(number_cell(row.get(key)) for key in keys),
                number_cell(row["reduced_chi"], 2),
            ]
            for row in (summary[group] or {}).get("observations", ())
        ]
        if rows:
            tables.append(ReportTable(f"{title}, RMS distance of poses from their geometry [mm]", columns, rows))
    return tables


def _view(arm: Arm, capture: Capture, evaluation: Evaluation) -> ArmView:
    geometry = {} if evaluation.observed is None else evaluation.observed.geometry
    return view_of_arm(arm, capture, pose_distances(capture, evaluation), geometry)


def points_report(record: PointsRecord) -> tuple[Report, dict[str, Any]]:
    """The report of an evaluation of points, and the summary that it was made from."""
    tests, measured = record.acceptance(), record.measured
    summary = points_summary(record, tests)
    verdict, mark = _verdict(summary)
    chart = _length_chart(tests)
    sections = [
        _acceptance_section(tests, summary, measured.lengths, measured.spheres),
        *([] if chart is None else [Section("lengths", "Lengths", [chart])]),
    ]
    subtitle = (
        f"{pluralise(summary['points'], 'point')} as recorded: {pluralise(summary['sockets'], 'socket')}, "
        f"{pluralise(summary['lengths'], 'length')}, {pluralise(summary['spheres'], 'sphere')}"
    )
    report = Report("Acceptance test of points", subtitle, verdict, mark, summary["warnings"], [], sections)
    return report, summary


def overall_decision(summary: dict[str, Any]) -> str | None:
    """The decision on all limits together: "fails", "undecided" or "conforms"; None without limits."""
    decisions = [
        metric["decision"] for test in summary["acceptance"] for metric in test["figures"] if metric["decision"]
    ]
    return "fails" if summary["failed"] else worst(decisions) or ("conforms" if summary["kept"] else None)


def _verdict(summary: dict[str, Any]) -> tuple[str, str]:
    decision = overall_decision(summary)
    if decision == "fails":
        return "A limit is not kept", "bad"
    if decision == "undecided":
        return "Undecided: the measurement is too uncertain for a limit", "unsure"
    if decision == "conforms":
        incomplete = any(test["missing"] for test in summary["acceptance"] if test["decision"])
        verdict = "Every limit is kept" + ("; a procedure was not complete" if incomplete else "")
        return verdict, "unsure" if incomplete or summary["warnings"] else "good"
    return "Measured; no limit was given", "neutral"


def _facts(summary: dict[str, Any]) -> list[tuple[str, str]]:
    facts = []
    group, title = next(((group, title) for group, title in _GROUPS if summary[group] is not None), ("", ""))
    for key, name in (
        ("rms_mm", "RMS distance"),
        ("deltam_mm", "Deltam"),
        ("length_error_largest_mm", "largest length error"),
    ):
        by_construction = group and key.startswith("length") and summary[group]["fixed_by_one_length"]
        if group and key in summary[group]["calibrated"] and not by_construction:
            values = " → ".join(format_number(summary[group][stage][key]) for stage in _STAGES)
            facts.append((f"{name}, {title[0].lower()}{title[1:]}, nominal → calibrated", f"{values}\u00a0mm"))
    return facts


def _acceptance_section(
    tests: list[AcceptanceTest],
    summary: dict[str, Any],
    lengths: Sequence[ReferenceLength],
    spheres: Sequence[ProbedSphere],
) -> Section:
    rows, u_test = summary["acceptance"], summary["u_test_mm"]
    if rows:
        blocks = _acceptance_blocks(tests, rows, u_test)
    else:
        blocks = [
            "The data contain nothing for an acceptance test: no socket with several poses, no length, no sphere."
        ]
    return Section("acceptance", "Acceptance tests", [*blocks, *_artefacts(lengths, spheres)])


def _acceptance_blocks(tests: list[AcceptanceTest], rows: list[dict[str, Any]], u_test: float) -> list:
    """Every test as a table, what its full procedure would also need, and the parts of its metrics."""
    stated = (
        f"{format_number(1000 * u_test, 1)} µm of standard uncertainty were stated for seat, fixture and temperature"
        if u_test
        else "nothing was stated for seat, fixture and temperature"
    )
    blocks: list = [
        "Every metric is of single readings. U, with coverage factor 2, is what the tester contributes: the artefacts' "
        f"uncertainty; {stated}. The arm's own scatter is what is tested (ISO 14253-5). What standards allow about "
        "repeating a reading is not applied. A test that lacks something its standard requires is called 'after' it. "
        "Requirements and formulas follow secondary sources of the editions named.",
    ]
    limited = any(metric["limit_mm"] is not None for test in rows for metric in test["figures"])
    if limited:
        used = dict.fromkeys(f"{test['standard']}: {test['rule']}" for test in rows if test["decision"])
        blocks.append(f"Decision rules: {'; '.join(used)}. What no rule decides is undecided.")
    before = any(metric["as_found_mm"] is not None for test in rows for metric in test["figures"])
    if before:
        blocks.append("As found is the nominal arm, as left the calibrated one.")
    for test in rows:
        blocks.append(_test_table(test, before, limited))
        if test["missing"]:
            blocks.append(f"This was not the full procedure. {' '.join(test['missing'])}")
    parts = [
        [
            *(text_cell(word) for word in (test.standard, metric.name, part.where)),
            *(number_cell(part.value), _expanded(part.expanded), number_cell(part.limit)),
            text_cell(part.decision or "–", _MARKS[part.decision]),
        ]
        for test in tests
        for metric in test.metrics
        for part in metric.values
        if not limited or part.limit is not None
    ]
    title = "Every part of every metric with a limit [mm]" if limited else "Every part of every metric [mm]"
    columns = ("standard", "metric", "at", "as left" if before else "value", "U", "MPE", "decision")
    return [*blocks, _metrics_chart(tests)._replace(table=ReportTable(title, columns, parts), printed=limited)]


def _test_table(test: dict[str, Any], before: bool, limited: bool) -> ReportTable:
    """One acceptance test; ``before``: with columns of the arm as found; ``limited``: with limits and decisions."""
    columns = ["metric", "what it is"]
    if before:
        columns += ["as found", *(["decision as found"] if limited else [])]
    columns += ["as left" if before else "value", "U"]
    columns += ["MPE", "decision as left" if before else "decision"] if limited else []
    rows = []
    for metric in test["figures"]:
        row = [text_cell(metric["symbol"]), text_cell(METRICS[metric["name"]])]
        if before:
            row += [number_cell(metric["as_found_mm"]), *([_decision(metric["as_found_decision"])] if limited else [])]
        row += [number_cell(metric["value_mm"]), _expanded(metric["expanded_mm"])]
        if limited:
            decision = _decision(metric["decision"], metric["failing"], len(metric["parts"]))
            row += [number_cell(metric["limit_mm"]), decision]
        rows.append([*row, text_cell(metric["where"])])
    return ReportTable(f"{test['called']}: {test['title']} [mm]", (*columns, "worst at"), rows)


def _expanded(value: float) -> Cell:
    """U, or that nothing was stated to compute it from."""
    return number_cell(value) if value > 0 else text_cell("not stated")


def _decision(decision: Any, failing: int = 0, of: int = 1) -> Cell:
    return text_cell(_SIGNS[decision] + (f" ({failing} of {of})" if failing and of > 1 else ""), _MARKS[decision])


def _artefacts(lengths: Sequence[ReferenceLength], spheres: Sequence[ProbedSphere]) -> list:
    """Bars and spheres that were measured."""
    bars: dict[tuple[float, float], int] = {}
    for length in lengths:
        key = (float(length.value), float(length.u))
        bars[key] = bars.get(key, 0) + 1
    rows = [
        [
            text_cell("length"),
            number_cell(value),
            number_cell(u),
            text_cell(f"in {count} position{'' if count == 1 else 's'}"),
        ]
        for (value, u), count in sorted(bars.items())
    ]
    for sphere in spheres:
        name = f"sphere '{sphere.name}' for {sphere.test.replace('-', ' ')}"
        touches = "+".join(str(len(group)) for group in sphere.groups)
        use = f"touched {touches} times by a ball of {sphere.stylus:g} mm; form error {format_number(sphere.form)} mm"
        rows.append([text_cell(name), number_cell(sphere.diameter), number_cell(sphere.u), text_cell(use)])
    return [ReportTable("Artefacts", ("artefact", "calibrated value [mm]", "u [mm]", "used"), rows)] if rows else []


def _metrics_chart(tests: list[AcceptanceTest]) -> Chart:
    """The worst value of every metric with U, divided by its limit if limits were given."""
    metrics = [metric for test in tests for metric in test.metrics]
    limited = [metric for metric in metrics if metric.worst.limit is not None]
    if limited:
        metrics, y, shapes = limited, "|value| / MPE", charts.horizontal([1.0], "solid")
        least = 1e-6  # mm: drawn for a limit of zero
        divisors = [max(metric.worst.limit or 0.0, least) for metric in metrics]
        title = "Metrics against their limits"
        description = (
            "The value of each metric, divided by its limit, with U: it conforms if the whole bar lies below 1."
        )
    else:
        y, shapes, divisors = "|value| [mm]", [], [1.0] * len(metrics)
        title, description = "Metrics", "The value of each metric, with U. No limit was given."
    values = [abs(metric.value) / divisor for metric, divisor in zip(metrics, divisors, strict=True)]
    bars = [metric.worst.expanded / divisor for metric, divisor in zip(metrics, divisors, strict=True)]
    hover = [f"{metric.name}: {format_number(metric.value)} mm at {metric.worst.where}" for metric in metrics]
    names = [metric.name for metric in metrics]
    trace = charts.markers("as left", names, values, charts.DARK, "square", hover=hover, bars=bars)
    # An absolute value is not negative, so a bar that is longer than its value ends at 0.
    top = 1.05 * max([value + bar for value, bar in zip(values, bars, strict=True)] + [1.0 if limited else 0.0])
    layout = charts.layout("", y, shapes=shapes, showlegend=False, yaxis={"range": [0.0, top]})
    return Chart("margins", title, description, {"data": [trace], "layout": layout}, height=320)


def _nominal_and_calibrated(
    record: EvaluationRecord, summary: dict[str, Any], evaluations: dict[str, Evaluation]
) -> list:
    blocks: list = [
        metrics_table(
            f"{title} [mm]",
            summary[group],
            dict(zip(_STAGES, _STAGES, strict=True)),
            fixed_scale=summary[group]["fixed_by_one_length"],
        )
        for group, title in _GROUPS
        if summary[group] is not None
    ]
    what = "geometry" if record.recording.capture.observations else "socket's centroid"
    title = f"Distance of every pose from its {what}"
    blocks.append(residual_chart("stages", title, record.recording.capture, evaluations))
    if record.used:
        used = ", ".join(sorted(record.used))
        blocks.append(f"The calibration was identified from: {used}. All other data were held out.")
    return blocks


def _lengths(
    record: EvaluationRecord, tests: list[AcceptanceTest], evaluations: dict[str, Evaluation]
) -> list[Section]:
    """Errors of lengths: of single readings if acceptance tests took them, with their limits; and of means."""
    capture, chart, calibrated = record.recording.capture, _length_chart(tests), evaluations["calibrated"]
    if not capture.lengths:
        return []
    rows = [
        {
            "from": length.start,
            "to": length.end,
            "value_mm": float(length.value),
            "error_mm": float(calibrated.error[i]),
            "error_u_mm": float(calibrated.u[i]) if np.isfinite(calibrated.u[i]) else None,
        }
        for i, length in enumerate(capture.lengths)
    ]
    columns = ("between", "value", "error, nominal", "error, calibrated", "U of error")
    before = [np.asarray(evaluations["nominal"].error)]
    cells = length_rows(rows, 2.0, before, record.length_that_fixed_scale())
    table = ReportTable("Lengths between the mean points of their sockets [mm]", columns, cells)
    note = (
        "Means of all poses, for comparison; no acceptance test uses them. Their U (factor 2) also contains the "
        "scatter of the poses at both ends."
    )
    return [Section("lengths", "Lengths", [*([] if chart is None else [chart]), table, note])]


def _length_chart(tests: list[AcceptanceTest]) -> Chart | None:
    """Errors of single readings of lengths (E_Uni), and their limits."""
    metric: Metric | None = next((m for test in tests for m in test.metrics if m.name == "E_Uni"), None)
    if metric is None:
        return None
    lengths = [part.length or 0.0 for part in metric.values]
    x_title = "length [mm]"
    if max(lengths) - min(lengths) < 0.01 * max(lengths):  # of one nominal length, which would be one vertical line
        x_title = f"reading of a length of {np.mean(lengths):g} mm"
        lengths = [float(i + 1) for i in range(len(lengths))]
    hover = [f"{part.where}: {format_number(part.value, signed=True)} mm" for part in metric.values]
    style = {"hover": hover, "bars": [part.expanded for part in metric.values], "size": 5}
    values = [part.value for part in metric.values]
    traces = [charts.markers("single readings, with U", lengths, values, charts.DARK, "circle", **style)]
    pairs = zip(lengths, metric.values, strict=True)
    limits = sorted((length, part.limit) for length, part in pairs if part.limit is not None)
    if limits:
        x, y = [length for length, _ in limits], np.array([limit for _, limit in limits])
        line = {"mode": "lines", "line": {"color": "#444", "dash": "dash", "width": 1.5}}
        traces += [
            charts.markers("MPE", x, y, "#444", "circle", **line),
            charts.markers("MPE", x, -y, "#444", "circle", showlegend=False, **line),
        ]
    layout = charts.layout(x_title, "measured − value [mm]", shapes=charts.horizontal([0.0], "dot"))
    description = "Errors of the reference lengths, reading by reading, by the calibrated arm"
    description += ", and their limits." if limits else "."
    return Chart("length-errors", "Errors of lengths", description, {"data": traces, "layout": layout})
