"""Evaluations and acceptance tests as plain dictionaries with the unit in every key; ``--json`` prints them."""

from typing import Any

import numpy as np

from ..acceptance.judgement import RULES, Influences
from ..acceptance.record import EvaluationRecord, PointsRecord, check_geometry, unstated_uncertainty_warning
from ..acceptance.results import METRICS, AcceptanceTest, Metric, MetricValue
from ..calibration.evaluation import Evaluation, evaluate
from ..calibration.prediction import NOTHING, Agreement, unseen_errors
from ..core.errors import InputError
from ..core.text import common_labels
from ..data.capture import Capture, names_in, part_of
from ..data.noise import Noise
from ..data.observations.held import Socket
from ..diagnostics.findings import sentences
from ..diagnostics.held_out import no_better, surprise
from ..kinematics.arm import Arm
from ..pipeline.cross_validation import groups_of
from ..uncertainty.arm_uncertainty import Uncertainty
from .calibration import length_metrics, metrics, metrics_by_socket_and_length
from .validation import agreement_row, finite
from .verdicts import evaluation_verdict

_LIMITED = {"rms_mm": "RMS distance", "deltam_mm": "Deltam", "length_error_largest_mm": "largest length error"}
_GROUPS = ("held_out", "identified_from")


def evaluation_summary(
    record: EvaluationRecord, tests: dict[str, list[AcceptanceTest]] | None = None
) -> dict[str, Any]:
    """The nominal and the calibrated arm on a capture, on held-out data and on those identified from; acceptance tests.

    A length counts as held out if at least one of its ends was not identified from. Errors on held-out data stand
    beside those that the uncertainty of the calibration predicts. ``tests`` (`EvaluationRecord.acceptance`) are run if
    not given.
    """
    capture, unseen = record.recording.capture, record.held_out_lengths()
    summary: dict[str, Any] = {
        "kind": "evaluation",
        "arm": record.recording.nominal.name,
        "warnings": list(record.warnings),
    }
    # The nominal arm's errors are not that noise: weighted by it, its distances would not be the least that it reaches.
    noise = {"calibrated": None if record.uncertainty is None else record.uncertainty.noise}
    arms = {stage: specification.arm for stage, specification in record.arms().items()}
    whole = {stage: _evaluated(arm, capture, noise.get(stage)) for stage, arm in arms.items()}
    rows = metrics_by_socket_and_length(capture, whole["calibrated"])
    fixed_scale, held_out = record.length_that_fixed_scale(), record.held_out()
    for group in ("held_out", "identified_from"):
        wanted = group == "identified_from"
        names = [name for name in names_in(capture) if (name in held_out) != wanted]
        lengths = [i for i in range(len(capture.lengths)) if (i not in unseen) == wanted]
        if not names and not lengths:
            summary[group] = None
            continue
        part = None if not names else capture if len(names) == len(names_in(capture)) else part_of(capture, names)
        parts: dict[str, Evaluation | None] = dict(whole) if part is capture else dict.fromkeys(arms)
        if part is not None and part is not capture:
            parts = {stage: _evaluated(arm, part, noise.get(stage)) for stage, arm in arms.items()}
        summary[group] = {stage: _grouped(parts[stage], whole[stage], lengths) for stage in whole}
        summary[group]["sockets"] = [row for row in rows["sockets"] if row["socket"] in names]
        summary[group]["observations"] = _observation_rows(parts["nominal"], parts["calibrated"])
        summary[group]["lengths"] = [rows["lengths"][i] for i in lengths]
        summary[group]["fixed_by_one_length"] = fixed_scale in lengths
        if not wanted:
            summary["warnings"] += _add_prediction(summary[group], record, part, lengths)
    summary["kept"], summary["failed"] = _exceeded(summary, record)
    tests = record.acceptance() if tests is None else tests
    summary["acceptance"] = acceptance_summary(tests["calibrated"], tests["nominal"])
    summary["standards"] = list(record.standards)
    summary["u_test_mm"] = record.u_test
    summary["influences"] = influences_row(record.influences)
    summary["verdict"] = evaluation_verdict(summary, len(summary["warnings"]))._asdict()
    summary["calibration_warnings"] = list(record.calibration_warnings)
    return summary


def _evaluated(arm: Arm, capture: Capture, noise: Noise | None) -> Evaluation:
    return evaluate(arm, capture, noise=noise if capture.observations else None)


def _observation_rows(nominal: Evaluation | None, calibrated: Evaluation | None) -> list[dict[str, Any]]:
    """Residuals of the observations besides sockets by both arms, mm, and in standard deviations of the noise."""
    if nominal is None or calibrated is None or nominal.observed is None or calibrated.observed is None:
        return []
    before, after = nominal.observed, calibrated.observed
    columns = (before.rms, after.rms, after.rms_angle, after.reduced_chi)
    rows = list(zip(after.names, after.kinds, after.residuals, *columns, strict=True))
    keys = ("nominal_rms_mm", "rms_mm", "rms_angle_rad", "reduced_chi")
    return [
        {"observation": name, "kind": kind, "poses": residuals.shape[1]}
        | {key: finite(float(value)) for key, value in zip(keys, values, strict=True)}
        for name, kind, residuals, *values in rows[len(calibrated.repeatability.socket_rms) :]
    ]


def _add_prediction(
    group: dict[str, Any], record: EvaluationRecord, part: Capture | None, lengths: list[int]
) -> list[str]:
    """Add what the uncertainty of the calibration predicts to the rows of held-out data; sentences on contradictions.

    Each kind, and all that shares a geometry or a length (a placement, a station), has a row of its own.
    """
    group["predicted"], group["kinds"], group["groups"] = None, [], []
    if record.uncertainty is None:
        return []
    capture = record.recording.capture
    compared = None if part is None else unseen_errors(record.uncertainty, part)
    of_lengths = compared if part is capture or not lengths else unseen_errors(record.uncertainty, capture)
    by_name: dict[str, Agreement] = {}
    poses = agreement_of_lengths = NOTHING
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
    if of_lengths is not None and lengths:
        agreement_of_lengths = of_lengths.of_lengths(lengths)
        every = of_lengths.expanded()
        for row, i in zip(group["lengths"], lengths, strict=True):
            row["expanded_mm"] = expanded = finite(every[i])
            row["error_over_expanded"] = finite(row["error_mm"] / expanded) if expanded else None
    group["predicted"] = {
        "poses": agreement_row(poses),
        "lengths": {
            "lengths": agreement_of_lengths.count,
            "normalised_error_rms": finite(agreement_of_lengths.rms / agreement_of_lengths.predicted),
            "probability": finite(agreement_of_lengths.probability),
        },
    }
    before, after = (group[stage].get("observed_rms_mm", group[stage].get("rms_mm")) for stage in record.arms())
    unseen = surprise(poses, agreement_of_lengths, by_name, lambda: _with_probe_fitted(record.uncertainty, part))
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
    sockets = record.measured.sockets
    summary = {
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
        "standards": list(record.standards),
        "u_test_mm": record.u_test,
        "influences": influences_row(record.influences),
    }
    return summary | {"verdict": evaluation_verdict(summary, len(summary["warnings"]))._asdict()}


def influences_row(influences: Influences) -> dict[str, Any]:
    """What adds uncertainty to test values, besides what is the same for all of them."""
    bodies = {of: getattr(influences, of) for of in ("artefact", "arm")}
    return {"u_relative": influences.u_relative} | {
        f"{of}_expansion": None
        if body is None
        else {
            "coefficient_per_k": body.coefficient,
            "u_coefficient_per_k": body.u_coefficient,
            "temperature_celsius": body.temperature,
            "u_temperature_celsius": body.u_temperature,
        }
        for of, body in bodies.items()
    }


def acceptance_summary(tests: list[AcceptanceTest], before: list[AcceptanceTest] | None = None) -> list[dict[str, Any]]:
    """Acceptance tests; ``before``: those of the nominal arm, whose metrics are added."""
    earlier = {(test.title, metric.name): metric for test in before or () for metric in test.metrics}
    return [
        {
            "standard": test.standard,
            "called": test.called,
            "rule": RULES[test.rule],
            "title": test.title,
            "decision": test.decision,
            "missing": list(test.missing),
            "figures": [
                _metric(metric, earlier.get((test.title, metric.name))) | {"symbol": test.symbol(metric)}
                for metric in test.metrics
            ],
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
        "failing": sum(value.decision == "fails" for value in metric.values),
        "parts": [_part(part) | {"decision": part.decision} for part in metric.values],
    }


def _part(part: MetricValue) -> dict[str, Any]:
    return {"where": part.where, "value_mm": part.value, "expanded_mm": part.expanded, "limit_mm": part.limit}


def _grouped(part: Evaluation | None, whole: Evaluation, lengths: list[int]) -> dict[str, Any]:
    """Repeatability of a group's own sockets, and errors of the lengths that count for it."""
    row = {} if part is None else metrics(part)
    if part is not None and part.observed is not None:
        pairs = zip(part.observed.kinds, part.observed.residuals, strict=True)
        # The only pose of a socket shows no scatter.
        scattered = [np.asarray(values)[:3] for kind, values in pairs if kind != "socket" or values.shape[1] > 1]
        squares = [np.zeros(0), *(np.sum(values**2, axis=0) for values in scattered)]
        row["observed_rms_mm"] = float(np.sqrt(np.concatenate(squares).mean()))
    return row | (length_metrics(np.asarray(whole.error)[lengths]) if lengths else {})


def _exceeded(summary: dict[str, Any], record: EvaluationRecord) -> tuple[list[str], list[str]]:
    """Sentences on limits kept and limits exceeded by the calibrated arm, on held-out data if there are any."""
    kept, failed = [], []
    for name, limit in record.maxima.items():
        # Of a capture with observations besides sockets, the RMS distance is that of all poses.
        keys = {group: _key(name, summary[group]["calibrated"]) for group in _GROUPS if summary[group] is not None}
        groups = [group for group, key in keys.items() if key in summary[group]["calibrated"]]
        if not groups:
            failed.append(
                f"{_LIMITED[name]} has a limit of {limit:g} mm, but the data contain nothing to measure it on."
            )
            continue
        value = summary[groups[0]]["calibrated"][keys[groups[0]]]
        where = "held-out data" if groups[0] == "held_out" else "the data identified from"
        relation = "within" if value <= limit else "over"
        verdict = f"{_LIMITED[name]} on {where} is {value:.4f} mm, {relation} the limit of {limit:g} mm."
        (kept if value <= limit else failed).append(verdict)
    return kept, failed


def _key(name: str, found: dict[str, Any]) -> str:
    return "observed_rms_mm" if name == "rms_mm" and "observed_rms_mm" in found else name
