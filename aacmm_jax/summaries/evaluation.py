"""An evaluation as a plain dictionary with the unit in every key: printed by the command line, and its ``--json``."""

from typing import Any

import numpy as np

from ..acceptance.metrics import METRICS, AcceptanceTest, Metric, MetricValue
from ..acceptance.record import EvaluationRecord, PointsRecord, unstated_uncertainty_warning
from ..calibration.evaluation import Evaluation, evaluate
from ..data.capture import Capture
from .calibration import figures, length_figures, tables

_LIMITED = {"rms_mm": "RMS distance", "deltam_mm": "Deltam", "length_error_largest_mm": "largest length error"}


def evaluation_summary(record: EvaluationRecord, tests: dict[str, list[AcceptanceTest]] | None = None) -> dict[str, Any]:
    """The nominal and the calibrated arm on a capture, apart for what was identified from and what was held out; acceptance tests.

    A length counts as held out where at least one of its ends was never identified from. ``tests`` (`EvaluationRecord.acceptance`)
    are run where they are not given.
    """
    capture, unseen = record.recording.capture, record.held_out_lengths()
    summary: dict[str, Any] = {
        "kind": "evaluation",
        "arm": record.recording.nominal.name,
        "warnings": list(record.warnings),
    }
    whole = {stage: evaluate(specification.arm, capture) for stage, specification in record.arms().items()}
    rows = tables(capture, whole["calibrated"])
    for group in ("held_out", "identified_from"):
        wanted = group == "identified_from"
        names = [name for name in capture.names if (name in record.used) == wanted]
        lengths = [i for i in range(len(capture.lengths)) if (i not in unseen) == wanted]
        if not names and not lengths:
            summary[group] = None
            continue
        part = Capture({name: capture.sockets[name] for name in names}) if names else None
        summary[group] = {
            stage: _grouped(None if part is None else evaluate(specification.arm, part), whole[stage], lengths)
            for stage, specification in record.arms().items()
        }
        summary[group]["sockets"] = [row for row in rows["sockets"] if row["socket"] in names]
        summary[group]["lengths"] = [rows["lengths"][i] for i in lengths]
    summary["kept"], summary["failed"] = _exceeded(summary, record)
    found = record.acceptance() if tests is None else tests
    summary["acceptance"] = acceptance_summary(found["calibrated"], found["nominal"])
    summary["u_test_mm"] = record.u_test
    return summary


def points_summary(record: PointsRecord, tests: list[AcceptanceTest] | None = None) -> dict[str, Any]:
    """Acceptance tests of points; ``tests`` (`PointsRecord.acceptance`) are run where they are not given."""
    tests = record.acceptance() if tests is None else tests
    sockets = record.measured.sockets
    return {
        "kind": "acceptance",
        "points": sum(map(len, sockets.values()))
        + sum(len(group) for sphere in record.measured.spheres for group in sphere.groups),
        "sockets": len(sockets),
        "lengths": len(record.measured.lengths),
        "spheres": len(record.measured.spheres),
        "warnings": unstated_uncertainty_warning(tests),
        "kept": [],
        "failed": [],
        "acceptance": acceptance_summary(tests),
        "u_test_mm": record.u_test,
    }


def acceptance_summary(tests: list[AcceptanceTest], before: list[AcceptanceTest] | None = None) -> list[dict[str, Any]]:
    """Acceptance tests, with the figures of the arm as found beside those as left where both are given."""
    earlier = {(test.title, figure.name): figure for test in before or () for figure in test.metrics}
    return [
        {
            "standard": test.standard,
            "title": test.title,
            "decision": test.decision,
            "missing": list(test.missing),
            "figures": [_figure(figure, earlier.get((test.title, figure.name))) for figure in test.metrics],
        }
        for test in tests
    ]


def _figure(figure: Metric, earlier: Metric | None) -> dict[str, Any]:
    return {
        "name": figure.name,
        "what": METRICS[figure.name],
        "decision": figure.decision,
        **_part(figure.worst),
        "as_found_mm": None if earlier is None else earlier.value,
        "as_found_decision": None if earlier is None else earlier.decision,
        "failing": figure.failing,
        "parts": [_part(part) | {"decision": part.decision} for part in figure.values],
    }


def _part(part: MetricValue) -> dict[str, Any]:
    return {"where": part.where, "value_mm": part.value, "expanded_mm": part.expanded, "limit_mm": part.limit}


def _grouped(part: Evaluation | None, whole: Evaluation, lengths: list[int]) -> dict[str, Any]:
    """Repeatability of a group's own sockets, and errors of the lengths that count for it."""
    found = {} if part is None else figures(part)
    return found | (length_figures(np.asarray(whole.error)[lengths]) if lengths else {})


def _exceeded(summary: dict[str, Any], record: EvaluationRecord) -> tuple[list[str], list[str]]:
    """Sentences on limits kept and limits exceeded by the calibrated arm, over held-out data where there are any."""
    kept, failed = [], []
    for key, limit in record.maxima.items():
        groups = [group for group in ("held_out", "identified_from") if summary[group] and key in summary[group]["calibrated"]]
        if not groups:
            failed.append(f"{_LIMITED[key]} has a limit of {limit:g} mm, but there is nothing to measure it on.")
            continue
        value = summary[groups[0]]["calibrated"][key]
        where = "held-out data" if groups[0] == "held_out" else "the data identified from"
        relation = "within" if value <= limit else "over"
        verdict = f"{_LIMITED[key]} on {where} is {value:.4f} mm, {relation} the limit of {limit:g} mm."
        (kept if value <= limit else failed).append(verdict)
    return kept, failed
