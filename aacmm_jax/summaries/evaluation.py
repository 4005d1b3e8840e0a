"""Evaluations and acceptance tests as plain dictionaries with the unit in every key; ``--json`` prints them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..acceptance.judgement import RULES, Rule, deciding_uncertainty, worst
from ..acceptance.record import EvaluationRecord, PointsRecord, check_geometry, unstated_uncertainty_warning
from ..acceptance.results import METRICS, AcceptanceTest, Metric, MetricValue
from ..calibration.agreement import NOTHING, Agreement
from ..calibration.evaluation import Evaluation
from ..calibration.prediction import unseen_errors
from ..core.errors import InputError
from ..core.text import common_labels
from ..data.capture import Capture, names_in, part_of
from ..data.observations.held import Socket
from ..diagnostics.findings import sentences
from ..diagnostics.held_out import no_better, surprise
from ..diagnostics.pose_residuals import rms
from ..pipeline.cross_validation import groups_of
from ..uncertainty.arm_uncertainty import Uncertainty
from .calibration import agreement_row, length_metrics, metrics, metrics_by_socket_and_length
from .maxima import failed_before, judged_maxima
from .result_tables import BEFORE
from .tables import attributes, plain, rows_of
from .verdicts import evaluation_verdict

_EXPANSION = {
    "coefficient_per_k": "coefficient",
    "u_coefficient_per_k": "u_coefficient",
    "temperature_celsius": "temperature",
    "u_temperature_celsius": "u_temperature",
}
_GROUPS = {"held_out": "held-out data", "identified_from": "the data used for identification"}


def evaluation_summary(
    record: EvaluationRecord, tests: dict[str, list[AcceptanceTest]] | None = None
) -> dict[str, Any]:
    """The nominal and the calibrated arm, and the arm as found where that is known, on a capture, on held-out data and
    on those identified from; acceptance tests.

    A length counts as held out if at least one of its ends was not identified from. Errors on held-out data stand
    beside those that the uncertainty of the calibration predicts. ``tests`` (`EvaluationRecord.acceptance`) are run if
    not given.
    """
    capture, unseen, held_out = record.recording.capture, record.held_out_lengths(), record.held_out()
    summary: dict[str, Any] = {
        "kind": "evaluation",
        "arm": record.recording.nominal.name,
        "warnings": list(record.warnings),
        "calibration_warnings": list(record.calibration_warnings),
        "calibration_unusable": record.calibration_unusable,
    }
    whole = record.evaluations(capture)
    rows = metrics_by_socket_and_length(capture, whole["calibrated"])
    for group in _GROUPS:
        wanted = group == "identified_from"
        names = [name for name in names_in(capture) if (name in held_out) != wanted]
        lengths = [i for i in range(len(capture.lengths)) if (i not in unseen) == wanted]
        if not names and not lengths:
            summary[group] = None
            continue
        part = None if not names else capture if len(names) == len(names_in(capture)) else part_of(capture, names)
        parts = whole if part is capture else {} if part is None else record.evaluations(part)
        summary[group] = {stage: _grouped(parts.get(stage), whole[stage], lengths) for stage in whole} | {
            "sockets": [row for row in rows["sockets"] if row["socket"] in names],
            "observations": _observation_rows(parts),
            "lengths": [rows["lengths"][i] for i in lengths],
            "fixed_by_one_length": record.length_that_fixed_scale() in lengths,
        }
        if not wanted:
            summary["warnings"] += _add_prediction(summary[group], record, part, lengths)
    decisions = judged_maxima(summary, record)
    for key, decision in (("kept", "conforms"), ("failed", "fails"), ("undecided", "undecided")):
        summary[key] = [judged.says for judged in decisions if judged.decision == decision]
    summary["failed_before"] = {stage: failed_before(summary, record.maxima, stage) for stage in BEFORE}
    tests = record.acceptance() if tests is None else tests
    summary |= _judged(record, tests) | {"conformity_verdict": _statable(record, tests["calibrated"])}
    return summary | {"verdict": evaluation_verdict(summary, len(summary["warnings"]))._asdict()}


def _grouped(part: Evaluation | None, whole: Evaluation, lengths: list[int]) -> dict[str, Any]:
    """Repeatability of a group's own sockets, and errors of the lengths that count for it."""
    row = {} if part is None else metrics(part)
    if part is not None and part.observed is not None:
        pairs = zip(part.observed.kinds, part.observed.distances, strict=True)
        # The only pose of a socket shows no scatter.
        scattered = [np.asarray(distances) for kind, distances in pairs if kind != "socket" or len(distances) > 1]
        whole_distances = np.concatenate([np.zeros(0), *scattered])
        row["observed_rms_mm"] = rms(whole_distances)
        if len(whole_distances):
            row |= {
                "observed_mean_mm": float(whole_distances.mean()),
                "observed_largest_mm": float(whole_distances.max()),
            }
    return row | length_metrics(np.asarray(whole.error)[lengths])


def _observation_rows(parts: dict[str, Evaluation]) -> list[dict[str, Any]]:
    """Residuals of the observations besides sockets by both arms, mm, and in standard deviations of the noise."""
    if not parts or parts["nominal"].observed is None or parts["calibrated"].observed is None:
        return []
    before, after = parts["nominal"].observed, parts["calibrated"].observed
    return rows_of(
        observation=after.names,
        kind=after.kinds,
        poses=[residuals.shape[1] for residuals in after.residuals],
        nominal_rms_mm=before.rms,
        rms_mm=after.rms,
        rms_angle_rad=after.rms_angle,
        rms_px=after.rms_px,
        reduced_chi=after.reduced_chi,
    )[len(parts["calibrated"].repeatability.socket_rms) :]


def _add_prediction(
    group: dict[str, Any], record: EvaluationRecord, part: Capture | None, lengths: list[int]
) -> list[str]:
    """Add what the uncertainty of the calibration predicts to the rows of held-out data; sentences on contradictions.

    Each kind, and all that shares a geometry or a length (a placement, a station), has a row of its own.
    """
    group |= {"predicted": None, "kinds": [], "groups": []}
    if record.uncertainty is None:
        return []
    capture = record.recording.capture
    compared = None if part is None else unseen_errors(record.uncertainty, part)
    by_name: dict[str, Agreement] = {}
    poses = of_lengths = NOTHING
    if compared is not None and part is not None:
        by_name, poses = {name: compared.of([name]) for name in compared.parts}, compared.of(compared.parts)
        for row in (*group["sockets"], *group["observations"]):
            agreement = agreement_row(by_name[row.get("socket", row.get("observation"))])
            row |= {key: agreement[key] for key in ("rms_predicted_mm", "reduced_chi", "probability")}
        kinds: dict[str, list[str]] = {"socket": list(part.names)} if part.names else {}
        for observation in part.observations:
            kinds.setdefault(observation.kind, []).append(observation.name)
        group["kinds"] = [
            {"kind": kind, "observations": len(names)} | agreement_row(compared.of(names))
            for kind, names in kinds.items()
        ]
        group["groups"] = [
            {"group": label, "members": list(names)} | agreement_row(compared.of(names))
            for label, names in zip(common_labels(groups_of(part)), groups_of(part), strict=True)
        ]
    unexpected = NOTHING  # lengths that are all within their U are as expected, however they lie within it
    if lengths:
        errors = compared if compared is not None and part is capture else unseen_errors(record.uncertainty, capture)
        of_lengths, expanded = errors.of_lengths(lengths), plain(errors.expanded())
        for row, i in zip(group["lengths"], lengths, strict=True):
            row["expanded_mm"] = expanded[i]
            row["error_over_expanded"] = plain(row["error_mm"] / expanded[i]) if expanded[i] else None
        if any(abs(row["error_over_expanded"] or 0.0) > 1 for row in group["lengths"]):
            unexpected = of_lengths
    group["predicted"] = {
        "poses": agreement_row(poses) | {"degrees_of_freedom": plain(poses.degrees_of_freedom)},
        "lengths": {
            "lengths": of_lengths.count,
            "normalised_error_rms": plain(of_lengths.rms / of_lengths.predicted),
            "probability": plain(of_lengths.probability),
        },
    }
    before, after = (
        group[stage].get("observed_rms_mm", group[stage].get("rms_mm")) for stage in ("nominal", "calibrated")
    )
    unseen = surprise(poses, unexpected, by_name, lambda: _with_probe_fitted(record.uncertainty, part))
    return sentences(unseen + no_better(before, after))


def _with_probe_fitted(uncertainty: Uncertainty | None, part: Capture | None) -> Agreement | None:
    """How unseen data agree where the place of their probe is unknown; None where they held several, or other tips."""
    if uncertainty is None or part is None or any(observation.target for observation in part.observations):
        return None
    poses = [Socket(name, q) for name, q in part.sockets.items()]
    capture = Capture({}, [], [held.changed(target="probe") for held in (*poses, *part.observations)])
    try:
        check_geometry(uncertainty.arm, capture)
    except InputError:
        return None
    errors = unseen_errors(uncertainty, capture)
    return errors.of(errors.parts)


def points_summary(record: PointsRecord, tests: list[AcceptanceTest] | None = None) -> dict[str, Any]:
    """Acceptance tests of points; ``tests`` (`PointsRecord.acceptance`) are run if not given."""
    tests = record.acceptance() if tests is None else tests
    measured = record.measured
    points = [*measured.sockets.values(), *(group for sphere in measured.spheres for group in sphere.groups)]
    summary = {
        "kind": "acceptance",
        "points": sum(map(len, points)),
        "sockets": len(measured.sockets),
        "lengths": len(measured.lengths),
        "spheres": len(measured.spheres),
        "warnings": unstated_uncertainty_warning(tests),
        "kept": [],
        "failed": [],
        "undecided": [],
        **_judged(record, {"calibrated": tests}),
    }
    return summary | {"verdict": evaluation_verdict(summary, len(summary["warnings"]))._asdict()}


def _statable(record: EvaluationRecord, tests: Sequence[AcceptanceTest]) -> str | None:
    """The verdict of the statement of conformity that a certificate can make, as `Conformity` has it."""
    if record.recording.true is not None or record.calibration_unusable:
        return None
    decision = worst([test.decision for test in tests if test.decision is not None])
    return {"conforms": "pass", "fails": "fail"}.get(decision or "")


def _judged(
    record: EvaluationRecord | PointsRecord, by_stage: Mapping[str, Sequence[AcceptanceTest]]
) -> dict[str, Any]:
    """Acceptance tests, and what adds uncertainty to their values: those of the calibrated arm, to whose metrics those
    of the nominal arm and of the arm as found are added."""
    tests = by_stage["calibrated"]
    earlier = {
        stage: {(test.title, metric.name): metric for test in by_stage.get(stage, ()) for metric in test.metrics}
        for stage in BEFORE
    }
    influences = record.influences
    bodies = {"artefact": influences.artefact, "arm": influences.arm}
    expansions = {
        f"{name}_expansion": None if body is None else attributes(body, **_EXPANSION) for name, body in bodies.items()
    }
    return {
        "acceptance": [
            attributes(test, "standard", "called", "title", "decision", "missing")
            | {
                "rule": RULES[test.rule],
                "figures": [
                    _metric(metric, {stage: of.get((test.title, metric.name)) for stage, of in earlier.items()})
                    | {"symbol": test.symbol(metric), "deciding_mm": _deciding(metric, test.rule)}
                    for metric in test.metrics
                ],
            }
            for test in tests
        ],
        **attributes(record, "standards", u_test_mm="u_test"),
        "influences": {"u_relative": influences.u_relative} | expansions,
    }


def _deciding(metric: Metric, rule: Rule) -> float | None:
    """The expanded uncertainty with which an undecided metric would be decided, mm."""
    worst = metric.worst
    if worst.decision != "undecided" or worst.limit is None:
        return None
    return deciding_uncertainty(worst.value, worst.limit, rule)


def _metric(metric: Metric, earlier: Mapping[str, Metric | None]) -> dict[str, Any]:
    def part(value: MetricValue) -> dict[str, Any]:
        return attributes(value, "where", value_mm="value", expanded_mm="expanded", limit_mm="limit")

    return {
        **attributes(metric, "name", "decision"),
        "what": METRICS[metric.name],
        **part(metric.worst),
        **{f"{stage}_mm": None if before is None else before.value for stage, before in earlier.items()},
        **{f"{stage}_decision": None if before is None else before.decision for stage, before in earlier.items()},
        "failing": sum(value.decision == "fails" for value in metric.values),
        "parts": [part(value) | {"decision": value.decision} for value in metric.values],
    }
