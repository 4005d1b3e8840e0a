"""The report of an evaluation: acceptance tests, and the nominal and the calibrated arm on a capture."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..acceptance.decision import COVERAGE_FACTOR
from ..acceptance.record import EvaluationRecord, PointsRecord
from ..acceptance.results import METRICS, AcceptanceTest, Metric
from ..calibration.evaluation import Evaluation, evaluate
from ..core.text import pluralise
from ..data.capture import Capture, ReferenceLength
from ..data.sphere import ProbedSphere
from ..kinematics.arm import Arm
from ..summaries.evaluation import evaluation_summary, points_summary
from ..summaries.observations import capture_words
from ..summaries.tables import decimals_for
from . import charts
from .arm_view import view_of_arm
from .elements import ArmView, Cell, Chart, Report, ReportTable, Section, format_number, number_cell, text_cell
from .lengths import by_placement
from .residuals import length_rows, metrics_table, pose_distances, residual_chart, socket_table

_MARKS = {"conforms": "good", "fails": "bad", "undecided": "unsure", None: ""}
_SIGNS = {"conforms": "✓ conforms", "fails": "✗ fails", "undecided": "? undecided", None: "–"}
_STAGES = ("nominal", "calibrated")
_GROUPS = (("held_out", "Held-out data"), ("identified_from", "Data used for identification"))


def evaluation_report(record: EvaluationRecord) -> tuple[Report, dict[str, Any]]:
    """The report, except for the origin of its file; and the summary that it was made from."""
    tests, capture = record.acceptance(), record.recording.capture
    summary = evaluation_summary(record, tests)
    noise = None if record.uncertainty is None or not capture.observations else record.uncertainty.noise
    evaluations = {
        stage: evaluate(arm.arm, capture, noise=noise if stage == "calibrated" else None)
        for stage, arm in record.arms().items()
    }
    calibrated = evaluations["calibrated"]
    verdict = summary["verdict"]
    residuals = residual_chart(
        "residuals", "Residuals of the calibrated arm", capture, {"calibrated": calibrated}, mark=True
    )
    residual_tables = [*([socket_table(capture, calibrated)] if capture.names else []), *_observation_tables(summary)]
    report = Report(
        title="Evaluation of " + (record.recording.nominal.name or "an arm"),
        subtitle=f"{pluralise(len(capture.readings), 'pose')} in {capture_words(capture)}"
        + (f", {pluralise(tested, 'touched sphere')}" if (tested := len(record.recording.spheres)) else ""),
        verdict=verdict["says"],
        verdict_mark=verdict["mark"],
        warnings=[
            *summary["warnings"],
            *(f"Over the limit: {sentence}" for sentence in summary["failed"]),
            *(f"Of the calibration: {sentence}" for sentence in record.calibration_warnings),
        ],
        facts=_facts(summary),
        sections=[
            *_acceptance_sections(tests["calibrated"], summary, capture.lengths, record.recording.spheres),
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
    verdict = summary["verdict"]
    chart = _length_chart(tests)
    sections = [
        *_acceptance_sections(tests, summary, measured.lengths, measured.spheres),
        *([] if chart is None else [Section("lengths", "Lengths", [chart])]),
    ]
    subtitle = (
        f"{pluralise(summary['points'], 'point')} as recorded: {pluralise(summary['sockets'], 'socket')}, "
        f"{pluralise(summary['lengths'], 'length')}, {pluralise(summary['spheres'], 'sphere')}"
    )
    title = "Acceptance test of points"
    return Report(title, subtitle, verdict["says"], verdict["mark"], summary["warnings"], [], sections), summary


def _facts(summary: dict[str, Any]) -> list[tuple[str, str]]:
    facts = []
    group, title = next(((group, title) for group, title in _GROUPS if summary[group] is not None), ("", ""))
    for key, name in (
        ("observed_rms_mm", "RMS distance from the geometry"),
        ("rms_mm", "RMS distance in sockets"),
        ("deltam_mm", "Deltam"),
        ("length_error_largest_mm", "largest length error"),
    ):
        by_construction = group and key.startswith("length") and summary[group]["fixed_by_one_length"]
        if group and key in summary[group]["calibrated"] and not by_construction:
            values = " → ".join(format_number(summary[group][stage][key]) for stage in _STAGES)
            what = f"{title}: {name}, nominal → calibrated"
            facts.append((what, f"{values}\u00a0mm"))
    return facts


def _acceptance_sections(
    tests: list[AcceptanceTest],
    summary: dict[str, Any],
    lengths: Sequence[ReferenceLength],
    spheres: Sequence[ProbedSphere],
) -> list[Section]:
    """The acceptance tests, if there were any, and the artefacts."""
    rows, artefacts = summary["acceptance"], _artefacts(lengths, spheres)
    if rows:
        blocks = _acceptance_blocks(tests, rows, summary["u_test_mm"])
        return [Section("acceptance", "Acceptance tests", [*blocks, *artefacts])]
    return [Section("artefacts", "Artefacts", artefacts)] if artefacts else []


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
            text_cell(part.where),
            text_cell(part.decision or "–", _MARKS[part.decision]),
            number_cell(part.value, decimals_for(part.expanded)),
            _expanded(part.expanded),
            number_cell(part.limit),
            *(text_cell(word) for word in (metric.name, test.standard)),
        ]
        for test in tests
        for metric in test.metrics
        for part in metric.values
        if not limited or part.limit is not None
    ]
    title = "Every part of every metric with a limit [mm]" if limited else "Every part of every metric [mm]"
    columns = ("at", "decision", "as left" if before else "value", "U", "MPE", "metric", "standard")
    return [*blocks, _metrics_chart(tests)._replace(table=ReportTable(title, columns, parts), printed=limited)]


def _test_table(test: dict[str, Any], before: bool, limited: bool) -> ReportTable:
    """One acceptance test; ``before``: with columns of the arm as found; ``limited``: with limits and decisions."""
    # Decisions first: on a telephone, what stands behind them is off the screen.
    decisions = ["decision as left", "decision as found"] if before else ["decision"]
    columns = ["metric", *(decisions if limited else []), "as left" if before else "value", "U"]
    columns += [*(["MPE"] if limited else []), *(["as found"] if before else [])]
    rows = []
    for metric in test["figures"]:
        row, decimals = [text_cell(metric["symbol"])], decimals_for(metric["expanded_mm"])
        if limited:
            row.append(_decision(metric["decision"], metric["failing"], len(metric["parts"])))
            row += [_decision(metric["as_found_decision"])] if before else []
        row += [number_cell(metric["value_mm"], decimals), _expanded(metric["expanded_mm"])]
        row += [number_cell(metric["limit_mm"])] if limited else []
        row += [number_cell(metric["as_found_mm"], decimals)] if before else []
        rows.append([*row, text_cell(metric["where"]), text_cell(METRICS[metric["name"]])])
    caption = f"{test['called']}: {test['title']} [mm]"
    return ReportTable(caption, (*columns, "worst at", "what it is"), rows)


def _expanded(value: float) -> Cell:
    """U, or that nothing was stated to compute it from."""
    return number_cell(value, decimals_for(value)) if value > 0 else text_cell("not stated")


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
            number_cell(value, decimals_for(u)),
            number_cell(u, decimals_for(u)),
            text_cell(f"in {count} position{'' if count == 1 else 's'}"),
        ]
        for (value, u), count in sorted(bars.items())
    ]
    for sphere in spheres:
        name = f"sphere '{sphere.name}' for {sphere.test.replace('-', ' ')}"
        touches = "+".join(str(len(group)) for group in sphere.groups)
        use = f"touched {touches} times by a ball of {sphere.stylus:g} mm; form error {format_number(sphere.form)} mm"
        numbers = (number_cell(value, decimals_for(sphere.u)) for value in (sphere.diameter, sphere.u))
        rows.append([text_cell(name), *numbers, text_cell(use)])
    return [ReportTable("Artefacts", ("artefact", "calibrated value [mm]", "u [mm]", "used"), rows)] if rows else []


def _metrics_chart(tests: list[AcceptanceTest]) -> Chart:
    """The worst value of every metric with U, divided by its limit if limits were given."""
    metrics = [metric for test in tests for metric in test.metrics]
    limited = [metric for metric in metrics if metric.worst.limit is not None]
    if limited:
        metrics, y, lines = limited, "|value| / MPE", [1.0]
        least = 1e-6  # mm: drawn for a limit of zero
        divisors = [max(metric.worst.limit or 0.0, least) for metric in metrics]
        title = "Metrics against their limits"
        description = (
            "The value of each metric, divided by its limit, with U. The decisions are in the tables: they follow the "
            "rule stated above, whose guard band may be less than U."
        )
    else:
        y, lines, divisors = "|value| [mm]", [], [1.0] * len(metrics)
        title, description = "Metrics", "The value of each metric, with U. No limit was given."
    values = np.array([abs(metric.value) / divisor for metric, divisor in zip(metrics, divisors, strict=True)])
    bars = np.array([metric.worst.expanded / divisor for metric, divisor in zip(metrics, divisors, strict=True)])
    hover = [f"{metric.name}: {format_number(metric.value)} mm at {metric.worst.where}" for metric in metrics]
    # An absolute value is not negative, so a bar that is longer than its value ends at 0.
    low = np.maximum(values - bars, 0.0)
    x = np.arange(len(metrics))
    marks = charts.Marks("as left", x, values, "square", "main", hover, low, values + bars, size=8)
    axes = (
        charts.names("", [metric.name for metric in metrics]),
        charts.linear(y, values + bars, lines, [0.0], zero=True),
    )
    return Chart("margins", title, description, (charts.Plot(*axes, (marks,), horizontal=lines, height=240),))


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
            "expanded_mm": COVERAGE_FACTOR * float(calibrated.u[i]) if np.isfinite(calibrated.u[i]) else None,
        }
        for i, length in enumerate(capture.lengths)
    ]
    columns = ("between", "value", "error, nominal", "error, calibrated", "U of error")
    before = [np.asarray(evaluations["nominal"].error)]
    cells = length_rows(rows, before, record.length_that_fixed_scale())
    table = ReportTable("Lengths between the mean points of their sockets [mm]", columns, cells)
    note = (
        "Means of all poses, for comparison; no acceptance test uses them. Their U (factor 2) also contains the "
        "scatter of the poses at both ends."
    )
    return [Section("lengths", "Lengths", [*([] if chart is None else [chart]), table, note])]


def _length_chart(tests: list[AcceptanceTest]) -> Chart | None:
    """Errors of single readings of lengths (E_Uni), placement by placement, and their limits."""
    metric: Metric | None = next((m for test in tests for m in test.metrics if m.name == "E_Uni"), None)
    if metric is None:
        return None
    ends = [part.where.partition(", reading ")[0].split(" - ", 1) for part in metric.values]
    x, axis, borders = by_placement([(one[0], one[-1]) for one in ends])
    values, bars = (np.array([getattr(part, name) for part in metric.values]) for name in ("value", "expanded"))
    hover = [
        f"{part.where}: {format_number(part.value, signed=True)} mm; length {part.length:g} mm"
        + (f", MPE {format_number(part.limit)} mm" if part.limit is not None else "")
        for part in metric.values
    ]
    says = "single readings" + (", with U" if np.any(bars > 0) else "")
    marks = [charts.Marks(says, x, values, "dot", "main", hover, values - bars, values + bars, size=5)]
    limits = np.array([np.nan if part.limit is None else part.limit for part in metric.values])
    if np.any(np.isfinite(limits)):
        order = np.argsort(x)
        for side, name in ((1, "MPE"), (-1, "MPE")):
            marks.append(charts.Marks(name, x[order], side * limits[order], "dashed", "ink"))
    axis_of_errors = charts.linear("measured − value [mm]", values - bars, values + bars, limits, -limits, [0.0])
    description = "Errors of the reference lengths, reading by reading, by the calibrated arm"
    description += ", and their limits." if len(marks) > 1 else "."
    plot = charts.Plot(axis, axis_of_errors, tuple(marks), borders, [0.0])
    return Chart("length-errors", "Errors of lengths", description, (plot,))
