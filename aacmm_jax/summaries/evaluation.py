"""Evaluations and acceptance tests as plain dictionaries with the unit in every key; ``--json`` prints them."""

from typing import Any

import numpy as np

from ..acceptance.record import EvaluationRecord, PointsRecord, unstated_uncertainty_warning
from ..acceptance.results import METRICS, AcceptanceTest, Metric, MetricValue
from ..calibration.evaluation import Evaluation, evaluate
from ..data.capture import Capture
from .calibration import length_metrics, metrics, metrics_by_socket_and_length

_LIMITED = {"rms_mm": "RMS distance", "deltam_mm": "Deltam", "length_error_largest_mm": "largest length error"}


def evaluation_summary(
    record: EvaluationRecord, tests: dict[str, list[AcceptanceTest]] | None = None
) -> dict[str, Any]:
    """The nominal and the calibrated arm on a capture, on held-out data and on those identified from; acceptance tests.

    A length counts as held out if at least one of its ends was not identified from. ``tests``
    (`EvaluationRecord.acceptance`) are run if not given.
    """
    capture, unseen = record.recording.capture, record.held_out_lengths()
    summary: dict[str, Any] = {
        "kind": "evaluation",
        "arm": record.recording.nominal.name,
        "warnings": list(record.warnings),
    }
    whole = {stage: evaluate(specification.arm, capture) for stage, specification in record.arms().items()}
    rows = metrics_by_socket_and_length(capture, whole["calibrated"])
    fixed_scale = record.length_that_fixed_scale()
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
        summary[group]["fixed_by_one_length"] = fixed_scale in lengths
    summary["kept"], summary["failed"] = _exceeded(summary, record)
    found = record.acceptance() if tests is None else tests
    summary["acceptance"] = acceptance_summary(found["calibrated"], found["nominal"])
    summary["u_test_mm"] = record.u_test
    return summary


def points_summary(record: PointsRecord, tests: list[AcceptanceTest] | None = None) -> dict[str, Any]:
    """Acceptance tests of points; ``tests`` (`PointsRecord.acceptance`) are run if not given."""
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
    """Acceptance tests; ``before``: those of the arm as found, whose metrics are added."""
    earlier = {(test.title, metric.name): metric for test in before or () for metric in test.metrics}
    return [
        {
            "standard": test.standard,
            "title": test.title,
            "decision": test.decision,
            "missing": list(test.missing),
            "figures": [_metric(metric, earlier.get((test.title, metric.name))) for metric in test.metrics],
        }
        for test in tests
    ]


def _metric(metric: Metric, earlier: Metric | None) -> dict[str, Any]:
    return {
        "name": metric.name,
        "what": METRICS[metric.name],
        "decision": metric.decision,
        **_part(metric.worst),
        "as_found_mm": None if earlier is None else earlier.value,
        "as_found_decision": None if earlier is None else earlier.decision,
        "failing": metric.failing,
        "parts": [_part(part) | {"decision": part.decision} for part in metric.values],
    }


def _part(part: MetricValue) -> dict[str, Any]:
    return {"where": part.where, "value_mm": part.value, "expanded_mm": part.expanded, "limit_mm": part.limit}


def _grouped(part: Evaluation | None, whole: Evaluation, lengths: list[int]) -> dict[str, Any]:
    """Repeatability of a group's own sockets, and errors of the lengths that count for it."""
    found = {} if part is None else metrics(part)
    return found | (length_metrics(np.asarray(whole.error)[lengths]) if lengths else {})


def _exceeded(summary: dict[str, Any], record: EvaluationRecord) -> tuple[list[str], list[str]]:
    """Sentences on limits kept and limits exceeded by the calibrated arm, on held-out data if there are any."""
    kept, failed = [], []
    for key, limit in record.maxima.items():
        groups = ("held_out", "identified_from")
        groups = [group for group in groups if summary[group] and key in summary[group]["calibrated"]]
        if not groups:
            failed.append(
                f"{_LIMITED[key]} has a limit of {limit:g} mm, but the data contain nothing to measure it on."
            )
            continue
        value = summary[groups[0]]["calibrated"][key]
        where = "held-out data" if groups[0] == "held_out" else "the data identified from"
        relation = "within" if value <= limit else "over"
        verdict = f"{_LIMITED[key]} on {where} is {value:.4f} mm, {relation} the limit of {limit:g} mm."
        (kept if value <= limit else failed).append(verdict)
    return kept, failed
