"""The report of an evaluation: acceptance tests, and the arm on a capture as found and as left."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..acceptance.decision import worst
from ..acceptance.metrics import METRICS, AcceptanceTest, Metric
from ..acceptance.record import EvaluationRecord, PointsRecord
from ..acceptance.standards import EDITIONS
from ..calibration.evaluation import Evaluation, evaluate
from ..data.capture import ReferenceLength
from ..data.sphere import ProbedSphere
from ..summaries.evaluation import evaluation_summary, points_summary
from . import charts
from .parts import Cell, Chart, Report, Section, Table, number, shown, text
from .residuals import figures_table, length_rows, residual_chart, socket_table
from .scene import arms_of

_MARKS = {"conforms": "good", "fails": "bad", "undecided": "unsure", None: ""}
_STAGES = {"nominal": "as found", "calibrated": "as left"}
_GROUPS = (("held_out", "Sockets never identified from"), ("identified_from", "Sockets identified from"))


def evaluation_report(record: EvaluationRecord) -> tuple[Report, dict[str, Any]]:
    """The report, without what names its file; and the summary that it was made from."""
    tests = record.acceptance()
    summary = evaluation_summary(record, tests)
    evaluations = {stage: evaluate(arm.arm, record.recording.capture) for stage, arm in record.arms().items()}
    verdict, mark = _verdict(summary)
    capture = record.recording.capture
    report = Report(
        title="Evaluation of " + (record.recording.nominal.name or "an arm"),
        subtitle=f"{sum(capture.sizes)} poses in {len(capture.names)} sockets, {len(capture.lengths)} reference lengths, "
        f"{len(record.recording.spheres)} touched spheres",
        verdict=verdict,
        verdict_mark=mark,
        warnings=summary["warnings"] + [f"Over the limit: {sentence}" for sentence in summary["failed"]],
        facts=_facts(summary),
        sections=[
            Section(
                "acceptance",
                "Acceptance tests",
                [
                    *_acceptance(tests["calibrated"], summary["acceptance"], record.u_test),
                    *_artefacts(capture.lengths, record.recording.spheres),
                ],
            ),
            Section("found-left", "As found and as left", _found_and_left(record, summary, evaluations)),
            *_lengths(record, tests["calibrated"], evaluations["calibrated"], evaluations["nominal"]),
            Section(
                "residuals",
                "Residuals by socket and pose",
                [
                    socket_table(capture, evaluations["calibrated"]),
                    residual_chart(
                        "residuals", "Residuals as left", capture, {"as left": evaluations["calibrated"]}, mark=True
                    ),
                ],
            ),
            Section("arm", "The arm in its poses", [arms_of(record.calibrated.arm, capture, evaluations["calibrated"])]),
        ],
    )
    return report, summary


def overall(summary: dict[str, Any]) -> str | None:
    """What all limits come to together: "fails", "undecided", "conforms"; None where there is none."""
    decisions = [figure["decision"] for test in summary["acceptance"] for figure in test["figures"] if figure["decision"]]
    return "fails" if summary["failed"] else worst(decisions) or ("conforms" if summary["kept"] else None)


def _verdict(summary: dict[str, Any]) -> tuple[str, str]:
    decision = overall(summary)
    if decision == "fails":
        return "A limit is not kept", "bad"
    if decision == "undecided":
        return "Undecided: the measurement is not certain enough for a limit", "unsure"
    if decision == "conforms":
        incomplete = any(test["missing"] for test in summary["acceptance"] if test["decision"])
        words = "Every limit is kept" + ("; a procedure was not complete" if incomplete else "")
        return words, "unsure" if incomplete or summary["warnings"] else "good"
    return "Measured; no limit was given", "unsure" if summary["warnings"] else "good"


def _facts(summary: dict[str, Any]) -> list[tuple[str, str]]:
    facts = []
    for group, title in _GROUPS:
        part = summary[group]
        if part is None:
            continue
        for key, name in (("rms_mm", "RMS distance"), ("deltam_mm", "Δm"), ("length_error_largest_mm", "largest length error")):
            if key in part["calibrated"]:
                values = f"{shown(part['nominal'][key])} → {shown(part['calibrated'][key])} mm"
                facts.append((f"{name}, {title[0].lower()}{title[1:]}, as found → as left", values))
        break
    return facts


def _acceptance(tests: list[AcceptanceTest], rows: list[dict[str, Any]], u_test: float) -> list:
    """Every test as a table, what its full procedure would need besides, and the parts that its figures rest on."""
    if not rows:
        return ["There is nothing here that an acceptance test looks at: no socket of several poses, no length, no sphere."]
    stated = (
        f"{shown(1000 * u_test, 1)} µm of standard uncertainty were stated for seat, fixture and temperature"
        if u_test
        else "nothing was stated for seat, fixture and temperature"
    )
    blocks: list = [
        f"Every figure is of single readings. U is what the tester brings, with coverage factor 2: the artefacts' uncertainty; {stated}. The arm's own "
        "scatter is what is tested (ISO 14253-5). A figure conforms where |value| ≤ MPE − U, fails where |value| ≥ MPE + U, and is undecided between "
        "(ISO 14253-1, with U as guard band as in its editions up to 2013). What standards allow of repeating a reading is not applied, and how positions and "
        "directions are spread is not checked. Procedures and formulas follow secondary sources of the editions named.",
    ]
    before = any(figure["as_found_mm"] is not None for test in rows for figure in test["figures"])
    limited = any(figure["limit_mm"] is not None for test in rows for figure in test["figures"])
    for test in rows:
        columns = ["figure", "what it is"]
        columns += (["as found"] + (["decision as found"] if limited else [])) if before else []
        columns += (
            ["as left" if before else "value", "U"]
            + (["MPE", "decision as left" if before else "decision"] if limited else [])
            + ["worst at"]
        )
        lines = []
        for figure in test["figures"]:
            line = [text(figure["name"]), text(METRICS[figure["name"]])]
            if before:
                line += [number(figure["as_found_mm"])] + ([_sign(figure["as_found_decision"])] if limited else [])
            line += [number(figure["value_mm"]), _expanded(figure["expanded_mm"])]
            line += (
                [number(figure["limit_mm"]), _sign(figure["decision"], figure["failing"], len(figure["parts"]))]
                if limited
                else []
            )
            lines.append([*line, text(figure["where"])])
        blocks.append(Table(f"{EDITIONS[test['standard']]}: {test['title']} [mm]", tuple(columns), lines))
        if test["missing"]:
            blocks.append(f"This was not the full procedure; it also needs {'; '.join(test['missing'])}.")
    parts = [
        [
            *(text(word) for word in (test.standard, figure.name, part.where)),
            *(number(part.value), _expanded(part.expanded), number(part.limit)),
            _part(part.decision),
        ]
        for test in tests
        for figure in test.metrics
        for part in figure.values
        if not limited or part.limit is not None
    ]
    title = "Every part of every figure with a limit [mm]" if limited else "Every part of every figure [mm]"
    behind = Table(title, ("standard", "figure", "at", "as left" if before else "value", "U", "MPE", "decision"), parts)
    return [*blocks, _margins(tests)._replace(table=behind, printed=limited)]


def _expanded(value: float) -> Cell:
    """U, or that nothing was stated that it could be made of."""
    return number(value) if value > 0 else text("not stated")


def _sign(decision: Any, failing: int = 0, of: int = 1) -> Cell:
    signs = {"conforms": "✓ conforms", "fails": "✗ fails", "undecided": "? undecided", None: "–"}
    return text(signs[decision] + (f" ({failing} of {of})" if failing and of > 1 else ""), _MARKS[decision])


def _artefacts(lengths: Sequence[ReferenceLength], spheres: Sequence[ProbedSphere]) -> list:
    """Bars and spheres that figures were measured on."""
    bars: dict[tuple[float, float], int] = {}
    for length in lengths:
        key = (float(length.value), float(length.u))
        bars[key] = bars.get(key, 0) + 1
    rows = [
        [text("length"), number(value), number(u), text(f"in {count} place{'' if count == 1 else 's'}")]
        for (value, u), count in sorted(bars.items())
    ]
    rows += [
        [
            text(f"sphere '{sphere.name}' for {sphere.test.replace('-', ' ')}"),
            number(sphere.diameter),
            number(sphere.u),
            text(
                f"touched {'+'.join(str(len(group)) for group in sphere.groups)} times by a ball of {sphere.stylus:g} mm; form error {shown(sphere.form)} mm"
            ),
        ]
        for sphere in spheres
    ]
    return [Table("Artefacts", ("artefact", "calibrated value [mm]", "u [mm]", "used"), rows)] if rows else []


def points_report(record: PointsRecord) -> tuple[Report, dict[str, Any]]:
    """The report of an evaluation of points, and the summary that it was made from."""
    tests = record.acceptance()
    summary = points_summary(record, tests)
    verdict, mark = _verdict(summary)
    chart = next((figure for test in tests for figure in test.metrics if figure.name == "E_Uni"), None)
    sections = [
        Section(
            "acceptance",
            "Acceptance tests",
            [
                *_acceptance(tests, summary["acceptance"], record.u_test),
                *_artefacts(record.measured.lengths, record.measured.spheres),
            ],
        ),
        *([] if chart is None else [Section("lengths", "Lengths", [_length_chart(chart)])]),
    ]
    subtitle = f"{summary['points']} points as they were recorded: {summary['sockets']} sockets, {summary['lengths']} lengths, {summary['spheres']} spheres"
    return Report("Acceptance test of points", subtitle, verdict, mark, summary["warnings"], [], sections), summary


def _part(decision: Any) -> Cell:
    return text(decision or "–", _MARKS[decision])


def _margins(tests: list[AcceptanceTest]) -> Chart:
    """Every figure's worst value with U; where limits were given as a share of them."""
    figures = [figure for test in tests for figure in test.metrics]
    limited = [figure for figure in figures if figure.worst.limit is not None]
    if limited:
        least = 1e-6  # mm: a limit of zero is drawn as this
        shares = [abs(figure.value) / max(figure.worst.limit or 0.0, least) for figure in limited]
        bars = [figure.worst.expanded / max(figure.worst.limit or 0.0, least) for figure in limited]
        words = "The value of each figure as a share of its limit, with U: it conforms where the whole bar lies below 1."
        y, shapes, shown_figures = "|value| / MPE", charts.horizontal([1.0], "solid"), limited
    else:
        shares, bars = [abs(figure.value) for figure in figures], [figure.worst.expanded for figure in figures]
        words, y, shapes, shown_figures = "The value of each figure, with U. No limit was given.", "|value| [mm]", [], figures
    names = [figure.name for figure in shown_figures]
    hover = [f"{figure.name}: {shown(figure.value)} mm at {figure.worst.where}" for figure in shown_figures]
    trace = charts.dots("as left", names, shares, charts.DARK, "square", hover=hover, bars=bars)
    layout = charts.layout("", y, shapes=shapes, showlegend=False, yaxis={"rangemode": "tozero"})
    return Chart(
        "margins",
        "Figures against their limits" if limited else "Figures",
        words,
        {"data": [trace], "layout": layout},
        height=320,
    )


def _found_and_left(record: EvaluationRecord, summary: dict[str, Any], evaluations: dict[str, Evaluation]) -> list:
    blocks: list = []
    for group, title in _GROUPS:
        if summary[group] is not None:
            blocks.append(figures_table(f"{title} [mm]", summary[group], _STAGES))
    pair = {_STAGES[stage]: evaluation for stage, evaluation in evaluations.items()}
    blocks.append(
        residual_chart("found-left", "Distance of every pose from its socket's centroid", record.recording.capture, pair)
    )
    if record.used:
        blocks.append(f"Identified from were: {', '.join(sorted(record.used))}. All else the calibration has never seen.")
    return blocks


def _lengths(record: EvaluationRecord, tests: list[AcceptanceTest], left: Evaluation, found: Evaluation) -> list[Section]:
    """Errors of lengths, of single readings where acceptance tests took them, with their limits."""
    capture = record.recording.capture
    if not capture.lengths:
        return []
    figure = next((figure for test in tests for figure in test.metrics if figure.name == "E_Uni"), None)
    blocks: list = []
    if figure is not None:
        blocks.append(_length_chart(figure))
    rows = [
        {
            "from": length.start,
            "to": length.end,
            "value_mm": float(length.value),
            "error_mm": float(left.error[i]),
            "error_u_mm": _known(left.u[i]),
        }
        for i, length in enumerate(capture.lengths)
    ]
    columns = ("between", "value", "as found", "as left", "U of error")
    table = Table(
        "Lengths between the mean points of their sockets [mm]",
        columns,
        length_rows(rows, 2.0, {"as found": np.asarray(found.error)}),
    )
    note = "Means of all poses, for comparison; no acceptance test uses them. Their U (factor 2) also holds the scatter of the poses at both ends."
    return [Section("lengths", "Lengths", [*blocks, table, note])]


def _known(u: Any) -> float | None:
    return float(u) if np.isfinite(u) else None


def _length_chart(figure: Metric) -> Chart:
    lengths = [part.length or 0.0 for part in figure.values]
    hover = [f"{part.where}: {shown(part.value, signed=True)} mm" for part in figure.values]
    trace = charts.dots("single readings, with U", lengths, [part.value for part in figure.values], charts.DARK, "circle",
                        hover=hover, bars=[part.expanded for part in figure.values], size=5)  # fmt: skip
    traces = [trace]
    limits = sorted((length, part.limit) for length, part in zip(lengths, figure.values, strict=True) if part.limit is not None)
    if limits:
        x, y = [length for length, _ in limits], np.array([limit for _, limit in limits])
        line = {"mode": "lines", "line": {"color": "#444", "dash": "dash", "width": 1.5}}
        traces += [
            charts.dots("MPE", x, y, "#444", "circle", **line),
            charts.dots("MPE", x, -y, "#444", "circle", showlegend=False, **line),
        ]
    layout = charts.layout("length [mm]", "measured − value [mm]", shapes=charts.horizontal([0.0], "dot"))
    words = "Errors of the reference lengths, each reading by itself, by the calibrated arm" + (
        ", and their limits." if limits else "."
    )
    return Chart("length-errors", "Errors of lengths", words, {"data": traces, "layout": layout})
