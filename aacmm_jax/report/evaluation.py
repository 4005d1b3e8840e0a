"""The report of an evaluation: acceptance tests, and the arm on a capture as found and as left."""

from typing import Any

import numpy as np

from ..acceptance import FIGURES, AcceptanceTest, Figure
from ..evaluate import Evaluation, evaluate
from ..evaluation_files import EvaluationRecord
from ..evaluation_summary import evaluation_summary
from . import charts
from .parts import Arms, Cell, Chart, Report, Section, Table, number, shown, text
from .residuals import figures_table, length_rows, residual_chart, socket_table
from .scene import scene_of

_MARKS = {"conforms": "good", "fails": "bad", "undecided": "unsure", None: ""}
_STAGES = {"nominal": "as found", "calibrated": "as left"}
_GROUPS = (("held_out", "Sockets never identified from"), ("identified_from", "Sockets identified from"))


def evaluation_report(record: EvaluationRecord) -> tuple[Report, dict[str, Any]]:
    """The report, without what names its file; and the summary that it was made from."""
    summary = evaluation_summary(record)
    tests = record.acceptance()
    evaluations = {stage: evaluate(arm.arm, record.recording.capture) for stage, arm in record.arms().items()}
    verdict, mark = _verdict(summary)
    capture = record.recording.capture
    report = Report(
        title="Evaluation of " + (record.recording.nominal.name or "an arm"),
        subtitle=f"{sum(capture.sizes)} poses in {len(capture.names)} sockets, {len(capture.lengths)} reference lengths, "
        f"{len(record.recording.spheres)} spheres",
        verdict=verdict,
        verdict_mark=mark,
        warnings=summary["warnings"] + [f"Over the limit: {sentence}" for sentence in summary["failed"]],
        facts=_facts(summary),
        sections=[
            Section("acceptance", "Acceptance tests", _acceptance(record, tests, summary)),
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
            Section("arm", "The arm in its poses", [_arms(record, evaluations["calibrated"])]),
        ],
    )
    return report, summary


def _verdict(summary: dict[str, Any]) -> tuple[str, str]:
    decisions = [figure["decision"] for test in summary["acceptance"] for figure in test["figures"] if figure["decision"]]
    if "fails" in decisions or summary["failed"]:
        return "A limit is not kept", "bad"
    if "undecided" in decisions:
        return "Undecided: the measurement is not certain enough for a limit", "unsure"
    if decisions or summary["kept"]:
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


def _decision(figure: Figure | dict[str, Any]) -> Cell:
    decision = figure["decision"] if isinstance(figure, dict) else figure.decision
    signs = {"conforms": "✓ conforms", "fails": "✗ fails", "undecided": "? undecided", None: "–"}
    return text(signs[decision], _MARKS[decision])


def _acceptance(record: EvaluationRecord, tests: dict[str, list[AcceptanceTest]], summary: dict[str, Any]) -> list:
    blocks: list = [
        "Every figure is of single readings. U is what the tester brings (artefacts"
        + (
            f", and {shown(1000 * record.u_test, 1)} µm of standard uncertainty stated for seat, fixture and temperature"
            if record.u_test
            else ""
        )
        + "), with coverage factor 2. A figure conforms where |value| ≤ MPE − U, fails where |value| ≥ MPE + U, and is undecided between (ISO 14253-1)."
    ]
    if not summary["acceptance"]:
        return ["The capture holds nothing that an acceptance test looks at."]
    for test in summary["acceptance"]:
        rows = [
            [
                text(figure["name"]),
                text(FIGURES[figure["name"]]),
                number(figure["as_found_mm"], mark="bad" if figure["as_found_decision"] == "fails" else ""),
                number(figure["value_mm"]),
                number(figure["expanded_mm"]),
                number(figure["limit_mm"]),
                _decision(figure),
                text(figure["where"]),
            ]
            for figure in test["figures"]
        ]
        columns = ("figure", "what it is", "as found", "as left", "U", "MPE", "decision", "worst at")
        blocks.append(Table(f"{test['standard']}: {test['title']} [mm]", columns, rows))
        if test["missing"]:
            blocks.append(f"This was not the full procedure; it also needs {'; '.join(test['missing'])}.")
    parts = [
        [
            text(test.standard),
            text(figure.name),
            text(part.where),
            number(part.value),
            number(part.expanded),
            number(part.limit),
            _part(part.decision),
        ]
        for test in tests["calibrated"]
        for figure in test.figures
        for part in figure.parts
    ]
    chart = _margins(tests["calibrated"])
    behind = Table("Every part of every figure [mm]", ("standard", "figure", "at", "as left", "U", "MPE", "decision"), parts)
    return [*blocks, chart._replace(table=behind)]


def _part(decision: Any) -> Cell:
    return text(decision or "–", _MARKS[decision])


def _margins(tests: list[AcceptanceTest]) -> Chart:
    """Every figure's worst value with U; where limits were given as a share of them."""
    figures = [figure for test in tests for figure in test.figures]
    limited = [figure for figure in figures if figure.worst.limit]
    if limited:
        shares = [abs(figure.value) / (figure.worst.limit or 1.0) for figure in limited]
        bars = [figure.worst.expanded / (figure.worst.limit or 1.0) for figure in limited]
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
    figure = next((figure for test in tests for figure in test.figures if figure.name == "E_Uni"), None)
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
        "Lengths between the centroids of their sockets [mm]",
        columns,
        length_rows(rows, 2.0, {"as found": np.asarray(found.error)}),
    )
    return [Section("lengths", "Lengths", [*blocks, table])]


def _known(u: Any) -> float | None:
    return float(u) if np.isfinite(u) else None


def _length_chart(figure: Figure) -> Chart:
    lengths = [part.length or 0.0 for part in figure.parts]
    hover = [f"{part.where}: {shown(part.value, signed=True)} mm" for part in figure.parts]
    trace = charts.dots("single readings, with U", lengths, [part.value for part in figure.parts], charts.DARK, "circle",
                        hover=hover, bars=[part.expanded for part in figure.parts], size=5)  # fmt: skip
    traces = [trace]
    limits = sorted((length, part.limit) for length, part in zip(lengths, figure.parts, strict=True) if part.limit is not None)
    if limits:
        x, y = [length for length, _ in limits], np.array([limit for _, limit in limits])
        line = {"mode": "lines", "line": {"color": "#444", "dash": "dash", "width": 1.5}}
        traces += [
            charts.dots("MPE", x, y, "#444", "circle", **line),
            charts.dots("MPE", x, -y, "#444", "circle", showlegend=False, **line),
        ]
    layout = charts.layout("length [mm]", "measured − value [mm]", shapes=charts.horizontal([0.0], "dot"))
    words = "Errors of the reference lengths, each reading by itself, by the calibrated arm" + (
        ", within their limits." if limits else "."
    )
    return Chart("length-errors", "Errors of lengths", words.replace("within", "and"), {"data": traces, "layout": layout})


def _arms(record: EvaluationRecord, evaluation: Evaluation) -> Arms:
    data = scene_of(record.calibrated.arm, record.recording.capture, np.asarray(evaluation.distances))
    words = "Drag, or use the arrow keys, to turn it; plus and minus change its size. The slider goes through the poses."
    return Arms("scene", "The calibrated arm, its sockets and its poses", words, data)
