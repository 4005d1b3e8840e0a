"""Evaluations in HDF5: a calibrated arm tried on a capture, or the points that an arm's own program reported."""

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..acceptance.all_tests import NO_INFLUENCES, checked_limits
from ..acceptance.decision import Limit, Rule, checked_rule
from ..acceptance.influences import Expansion, Influences, checked_influences
from ..acceptance.record import MAXIMA, EvaluationRecord, PointsRecord
from ..acceptance.results import METRICS, Measured
from ..acceptance.standards import STANDARDS
from ..kinematics.arm import Arm, parameter_names
from ..kinematics.workspace import Reach
from ..uncertainty.arm_uncertainty import Uncertainty
from .calibration_shared import component_tables, components_of, shared_errors_of, shared_tables
from .captures import (
    arm_table,
    lengths_of,
    linear_encoder_attribute,
    noise_of_attributes,
    recording_attributes,
    recording_of,
    recording_tables,
    reference_table,
    specification_of,
    sphere_table,
    spheres_of,
)
from .hdf5 import (
    Stored,
    Table,
    Variable,
    axes,
    check_sense,
    columns,
    names_in,
    need,
    numbering,
    read_tables,
    undamaged,
    write_tables,
)
from .sense import check_evaluation, check_points


def save_evaluation(
    path: str | os.PathLike, record: EvaluationRecord, summary: Mapping[str, Any] | None = None
) -> None:
    """Write an evaluation of a capture to HDF5, whole or not at all.

    Args:
        path: the file to write.
        record: the evaluation, from `acceptance.evaluation_of`.
        summary: what ``aacmm show`` prints of the file; without it, ``show`` computes it, which takes longer.

    Raises:
        InputError: the file cannot be written, or a name holds a character that no file can hold.

    Example:
        >>> evaluation = aj.acceptance.evaluation_of(record, aj.Recording(two_bars, nominal))
        >>> aj.files.save_evaluation("evaluation.h5", evaluation)
        >>> print(aj.files.load_evaluation("evaluation.h5").recording.capture.names)
        ('A', 'B', 'C', 'D')
    """
    tables = recording_tables(record.recording)
    tables["calibrated_arm"] = arm_table(record.calibrated)
    tables["used"] = Table(columns("used", used=(sorted(record.used), "", "socket that the arm was identified from")))
    tables["limits"] = _limit_table(record.limits)
    tables["figures"] = _metric_table(record)
    if record.uncertainty is not None:
        tables["uncertainty"] = _uncertainty_table(record.uncertainty)
        tables |= shared_tables(record.uncertainty.shared) | component_tables(record.uncertainty.components)
    attributes = recording_attributes(record.recording) | {
        "warnings": list(record.warnings) or None,
        "calibration_warnings": list(record.calibration_warnings) or None,
        "standards": list(record.standards) or "",
        "u_test_mm": record.u_test,
        **_influence_attributes(record.influences, record.rule),
        **{f"most_{name}": value for name, value in record.maxima.items()},
    }
    write_tables(path, "evaluation", tables, attributes, summary=summary)


def _uncertainty_table(uncertainty: Uncertainty) -> Table:
    """The covariance of the calibrated arm's parameters, from which errors are predicted."""
    names, square = list(uncertainty.names), ("parameter", "parameter_2")
    variables = columns("parameter", parameter=(names, "", "free parameter"))
    variables |= columns("parameter_2", parameter_2=(names, "", "free parameter, second axis of the covariance"))
    variables["covariance"] = Variable(square, np.asarray(uncertainty.covariance), "products of units", "covariance")
    variables["open"] = Variable(
        square, np.asarray(uncertainty.open), "1", "projector onto what is not determined, in mm and mrad"
    )
    return Table(
        variables,
        {
            "encoder_arcsec": np.asarray(uncertainty.noise.encoder_arcsec),
            "linear_encoder_mm": linear_encoder_attribute(uncertainty.noise),
            "seating_mm": float(uncertainty.noise.seating),
            "degrees_of_freedom": uncertainty.scatter_degrees_of_freedom,
        },
    )


def _uncertainty_of(path: str | os.PathLike, stored: Stored, calibrated: Arm) -> Uncertainty | None:
    """The uncertainty of the calibrated arm; files of earlier versions have none."""
    table = stored.tables.get("uncertainty")
    if table is None:
        return None
    need(path, table, "parameter", "covariance", "open", of="entry")
    attributes, names = stored.table_attributes["uncertainty"], tuple(map(str, table["parameter"]))
    strange = not set(names) <= set(parameter_names(calibrated)) or len(set(names)) < len(names)
    check_sense(path, {"a parameter is unknown, or named twice": strange})
    return Uncertainty(
        arm=calibrated,
        covariance=table["covariance"],
        open=table["open"],
        noise=noise_of_attributes(attributes),
        u_k=None,
        shared=shared_errors_of(stored),
        names=names,
        components=components_of(stored),
        scatter_degrees_of_freedom=float(attributes["degrees_of_freedom"]),
    )


def _limit_table(limits: Mapping[str, Limit | float]) -> Table:
    """Limits by the name of a result."""
    checked = checked_limits(limits)
    rows = columns(
        "figure",
        figure=(list(checked), "", "metric of an acceptance test"),
        fixed=([limit.fixed for limit in checked.values()], "mm", "MPE at length 0"),
        divisor=([limit.divisor for limit in checked.values()], "1", "MPE grows by the length over this"),
    )
    return Table(rows)


def _limits_in(stored: Stored) -> dict[str, Limit]:
    """The limits that a file holds."""
    table = stored.tables["limits"]
    rows = zip(table["figure"], table["fixed"], table["divisor"], strict=True)
    found = {str(name): Limit(float(fixed), float(divisor)) for name, fixed, divisor in rows}
    if not all(name in METRICS and 0 <= limit.fixed < math.inf and limit.divisor > 0 for name, limit in found.items()):
        raise ValueError("a limit that this package would not have written")  # `hdf5.undamaged` says what that means
    return found


def _metric_table(record: EvaluationRecord) -> Table:
    """The results, for other programs; this package computes them again on reading."""
    rows = [
        (stage, test.standard, metric, metric.worst)
        for stage, tests in record.acceptance().items()
        for test in tests
        for metric in test.metrics
    ]
    results = columns(
        "row",
        arm=([stage for stage, *_ in rows], "", "arm that measured"),
        standard=([standard for _, standard, *_ in rows], "", "standard of the test"),
        name=([metric.name for *_, metric, _ in rows], "", "metric"),
        value=([metric.value for *_, metric, _ in rows], "mm", "value of the worst part"),
        expanded=([worst.expanded for *_, worst in rows], "mm", "expanded uncertainty, coverage factor 2"),
        limit=([math.nan if worst.limit is None else worst.limit for *_, worst in rows], "mm", "MPE"),
        decision=([metric.decision or "" for *_, metric, _ in rows], "", "decision by the rule of the test"),
        where=([worst.where for *_, worst in rows], "", "what gave the worst part"),
    )
    return Table(numbering("row", len(rows)) | results)


def load_evaluation(path: str | os.PathLike) -> EvaluationRecord:
    """Read an evaluation of a capture.

    Args:
        path: the file to read.

    Returns:
        The record, from which the results are computed again.

    Raises:
        InputError: the file does not exist, is damaged, is not of this kind, or was written by a newer version.

    Example:
        >>> evaluation = aj.acceptance.evaluation_of(record, aj.Recording(two_bars, nominal))
        >>> aj.files.save_evaluation("evaluation.h5", evaluation)
        >>> print(aj.files.load_evaluation("evaluation.h5").calibrated.name)
        Cheng 2018, simulated arm, calibrated
    """
    stored = read_tables(path, ("evaluation",))
    need(path, stored.tables, "calibrated_arm", "used", "limits")
    with undamaged(path):
        attributes = stored.attributes
        given = {
            name.removeprefix("most_"): float(value) for name, value in attributes.items() if name.startswith("most_")
        }
        maxima = {name: given[name] for name in MAXIMA if name in given}
        recording, calibrated = recording_of(path, stored), specification_of(path, stored, "calibrated_arm")
        check_sense(path, {"a limit is unknown": len(maxima) != len(given)})
        check_evaluation(path, stored)
        return EvaluationRecord(
            recording,
            calibrated,
            frozenset(str(name) for name in stored.tables["used"]["used"]),
            tuple(map(str, np.atleast_1d(attributes.get("warnings") or []))),
            _limits_in(stored),
            float(attributes["u_test_mm"]),
            maxima,
            _standards_of(stored),
            _uncertainty_of(path, stored, calibrated.arm),
            tuple(map(str, np.atleast_1d(attributes.get("calibration_warnings") or []))),
            *_influences_of(attributes),
        )


def _influence_attributes(influences: Influences, rule: str | None) -> dict[str, Any]:
    """What adds uncertainty to test values, and the decision rule where one was asked for."""
    bodies = {f"expansion_{of}": getattr(influences, of) for of in ("artefact", "arm")}
    return {
        "u_relative": influences.u_relative,
        "rule": rule,
        **{name: None if body is None else np.array(body) for name, body in bodies.items()},
    }


def _influences_of(attributes: Mapping[str, Any]) -> tuple[Influences, Rule | None]:
    """The same, read; files of earlier versions have none, and were decided by the guard band of 2013."""
    if "u_relative" not in attributes:
        return NO_INFLUENCES, "iso-2013"
    bodies = {of: attributes.get(f"expansion_{of}") for of in ("artefact", "arm")}
    expansions = {of: None if row is None else Expansion(*map(float, row)) for of, row in bodies.items()}
    rule = attributes.get("rule")
    influences = Influences(0.0, float(attributes["u_relative"]), expansions["artefact"], expansions["arm"])
    return checked_influences(influences), None if rule is None else checked_rule(str(rule))


def _standards_of(stored: Stored) -> tuple[str, ...]:
    """Whose tests are run; in files of earlier versions, those of all standards."""
    return names_in(stored.attributes.get("standards", list(STANDARDS)))


def save_points(path: str | os.PathLike, record: PointsRecord, summary: Mapping[str, Any] | None = None) -> None:
    """Write an evaluation of points to HDF5, whole or not at all.

    Args:
        path: the file to write.
        record: the measured points, the limits and the uncertainty of the test.
        summary: what ``aacmm show`` prints of the file; without it, ``show`` computes it, which takes longer.

    Raises:
        InputError: the file cannot be written, or a name holds a character that no file can hold.

    Example:
        >>> measured = aj.acceptance.Measured({"cone": true.position(capture.sockets["A"])})
        >>> aj.files.save_points("points.h5", aj.acceptance.PointsRecord(measured, limits={"SPAT": 0.05}))
        >>> print(aj.files.load_points("points.h5").limits)
        {'SPAT': Limit(fixed=0.05, divisor=inf)}
    """
    measured = record.measured
    owner = [name for name, points in measured.sockets.items() for _ in points]
    position = np.concatenate([np.zeros((0, 3)), *measured.sockets.values()])
    tables = {
        "points": Table(
            numbering("point", len(owner))
            | axes()
            | {"position": Variable(("point", "axis"), position, "mm", "centre of the probe")}
            | columns("point", socket=(owner, "", "socket that held it"))
        ),
        "reference": reference_table(measured.lengths),
        "limits": _limit_table(record.limits),
    }
    if measured.spheres:
        tables["sphere"] = sphere_table(measured.spheres, points=True)
    reach = measured.reach
    attributes = {
        "of": "points",
        "standards": list(record.standards) or "",
        "u_test_mm": record.u_test,
        **_influence_attributes(record.influences, record.rule),
        "measuring_range_mm": measured.measuring_range,
        "sources": list(measured.sources) or None,
        "measured": measured.measured or None,
        "reach_mm": None if reach is None else reach.radius,
        "shoulder_mm": None if reach is None else reach.shoulder,
    }
    write_tables(path, "evaluation", tables, attributes, summary=summary)


def load_points(path: str | os.PathLike) -> PointsRecord:
    """Read an evaluation of points.

    Args:
        path: the file to read.

    Returns:
        The record, from which the results are computed again.

    Raises:
        InputError: the file does not exist, is damaged, is not of this kind, or was written by a newer version.

    Example:
        >>> points = {"cone": true.position(capture.sockets["A"])}
        >>> aj.files.save_points("points.h5", aj.acceptance.PointsRecord(aj.acceptance.Measured(points)))
        >>> print(aj.files.load_points("points.h5").measured.sockets["cone"].shape)
        (40, 3)
    """
    stored = read_tables(path, ("evaluation",))
    need(path, stored.tables, "points", "reference", "limits")
    with undamaged(path):
        table, attributes = stored.tables["points"], stored.attributes
        owner = np.asarray(table["socket"]).astype(str)
        sockets = {name: table["position"][owner == name] for name in dict.fromkeys(owner.tolist())}
        check_points(path, stored)
        reach = None
        if attributes.get("reach_mm") is not None:
            reach = Reach(np.array(attributes["shoulder_mm"]), float(attributes["reach_mm"]))
        measured = Measured(
            sockets,
            tuple(lengths_of(path, stored)),
            spheres_of(path, stored, "position"),
            reach,
            sources=tuple(attributes.get("sources") or ()),
            measured=attributes.get("measured", ""),
            measuring_range=attributes.get("measuring_range_mm"),
        )
        return PointsRecord(
            measured,
            _limits_in(stored),
            float(attributes["u_test_mm"]),
            _standards_of(stored),
            *_influences_of(attributes),
        )
