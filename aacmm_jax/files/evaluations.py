"""Evaluations in HDF5, of a calibrated arm on a capture or of reported points; and models of its joints compared."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..acceptance.judgement import Expansion, Influences, Limit, Rule, checked_influences
from ..acceptance.record import MAXIMA, EvaluationRecord, PointsRecord, checked_limits
from ..acceptance.results import Measured
from ..core.arguments import checked
from ..kinematics.arm import parameter_names
from ..kinematics.workspace import Reach
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.covariance import SharedErrors
from ..uncertainty.coverage import COVERAGE_FACTOR
from ..uncertainty.degrees_of_freedom import Components
from ..uncertainty.kept_geometry import KeptGeometry
from . import captures, schema
from .hdf5 import Stored, StoredTable, Table, Variable, check_sense, columns, opened, undamaged, write_tables
from .records import Fields, Within, number, records_within, rows_table, table_of, tables_within, text, truth, values_in
from .stored_checks import read_checked

_RECORDS = {
    "shared": Within("shared_errors", SharedErrors, schema.SHARED_ERRORS),
    "kept": Within("kept_geometry", KeptGeometry, schema.KEPT_GEOMETRY),
    "components": Within("components", Components, schema.COMPONENTS),
}


def save_evaluation(
    path: str | os.PathLike, record: EvaluationRecord | PointsRecord, summary: Mapping[str, Any] | None = None
) -> None:
    """Write an evaluation of a capture, or of points, to HDF5, whole or not at all.

    Args:
        path: the file to write.
        record: the evaluation, from `evaluate_capture`; or points with their limits, from `evaluate_points`.
        summary: what ``aacmm show`` prints of the file; without it, ``show`` computes it, which takes longer.

    Example:
        >>> evaluation = aj.evaluate_capture(record, aj.Recording(two_bars, nominal))
        >>> aj.files.save_evaluation("evaluation.h5", evaluation)
        >>> print(aj.files.load_evaluation("evaluation.h5").recording.capture.names)
        ('A', 'B', 'C', 'D')
    """
    record = record._replace(limits=checked_limits(record.limits))
    if isinstance(record, PointsRecord):
        root = {"of": "points"} | dict(table_of(record.measured, schema.POINTS).attributes)
        write_tables(path, "evaluation", _points_tables(record), root, summary=summary)
        return
    tables = captures.recording_tables(record.recording) | {"calibrated_arm": captures.arm_table(record.calibrated)}
    tables["evaluation"] = table_of(record, schema.EVALUATION)
    rows = [
        (stage, test.standard, metric.name, metric.value, metric.decision or "", metric.worst)
        for stage, tests in record.acceptance().items()
        for test in tests
        for metric in test.metrics
    ]
    arms, standards, names, values, decisions, worst = zip(*rows, strict=True) if rows else ((),) * 6
    limits = [math.nan if part.limit is None else part.limit for part in worst]
    # The results, for other programs; this package computes them again on reading.
    figures = columns(
        "row",
        arm=(arms, "", "arm that measured"),
        standard=(standards, "", "standard of the test"),
        name=(names, "", "metric"),
        value=(values, "mm", "worst value of the metric"),
        expanded=(
            [part.expanded for part in worst],
            "mm",
            f"expanded uncertainty, coverage factor {COVERAGE_FACTOR:g}",
        ),
        limit=(limits, "mm", "MPE"),
        decision=(decisions, "", "statement of conformity by the decision rule of the test"),
        where=([part.where for part in worst], "", "measurement that gave the worst value"),
    )
    tables["figures"] = Table(figures)
    if record.uncertainty is not None:
        tables["uncertainty"] = table_of(record.uncertainty, schema.UNCERTAINTY)
        tables |= tables_within(record.uncertainty, _RECORDS)
    write_tables(path, "evaluation", tables, captures.recording_attributes(record.recording), summary=summary)


def _points_tables(record: PointsRecord) -> dict[str, Table]:
    measured, reach = record.measured, record.measured.reach
    owner = [name for name, points in measured.sockets.items() for _ in points]
    position = np.concatenate([np.zeros((0, 3)), *measured.sockets.values()])
    points = columns("point", socket=(owner, "", "socket in which the tip was seated"))
    points["position"] = Variable(("point", "axis"), position, "mm", "centre of the probe")
    attributes = dict(table_of(record, schema.JUDGED).attributes)
    if reach is not None:
        attributes |= {"shoulder_mm": np.asarray(reach.shoulder), "radius_mm": reach.radius}
    tables = {
        "points": Table(points, attributes),
        "reference": rows_table("length", measured.lengths, schema.LENGTHS),
    }
    return tables | ({"sphere": captures.sphere_table(measured.spheres)} if measured.spheres else {})


def load_evaluation(path: str | os.PathLike) -> Any:
    """Read an evaluation of a capture (`acceptance.EvaluationRecord`) or of points (`acceptance.PointsRecord`).

    Args:
        path: the file to read.

    Returns:
        The record, from which the results are computed again.

    Example:
        >>> points = {"cone": true.position(capture.sockets["A"])}
        >>> aj.files.save_evaluation("points.h5", aj.acceptance.PointsRecord(aj.acceptance.Measured(points)))
        >>> print(aj.files.load_evaluation("points.h5").measured.sockets["cone"].shape)
        (40, 3)
    """
    with undamaged(path):
        stored = read_checked(path, ("evaluation",))
        if stored.attributes.get("of") == "points":
            return _points_record(stored)
        calibrated = captures.specification_of(path, stored, "calibrated_arm")
        values = _judged(stored.tables["evaluation"], EvaluationRecord, schema.EVALUATION)
        maxima = values["maxima"]
        possible = all(name in MAXIMA and 0 <= limit < math.inf for name, limit in maxima.items())
        check_sense(path, {"a limit is unknown, negative or not finite": not possible})
        uncertainty, table = None, stored.tables.get("uncertainty")
        if table is not None:
            parameters = values_in(Uncertainty, schema.UNCERTAINTY, table, table.attributes)
            names = set(parameters["names"])
            strange = not names <= set(parameter_names(calibrated.arm)) or len(names) < len(parameters["names"])
            check_sense(path, {"a parameter is unknown or is given twice": strange})
            within = records_within(stored.tables, _RECORDS)
            uncertainty = Uncertainty(arm=calibrated.arm, u_k=None, **within, **parameters)
        return EvaluationRecord(captures.recording_of(path, stored), calibrated, uncertainty=uncertainty, **values)


def _points_record(stored: Stored) -> PointsRecord:
    table = stored.tables["points"]
    owner = np.asarray(table["socket"]).astype(str)
    sockets = {name: table["position"][owner == name] for name in dict.fromkeys(owner.tolist())}
    reach = None
    if "radius_mm" in table.attributes:
        reach = Reach(np.array(table.attributes["shoulder_mm"]), float(table.attributes["radius_mm"]))
    values = values_in(Measured, schema.POINTS, stored.tables, stored.attributes)
    measured = Measured(sockets, captures.lengths_of(stored), captures.spheres_of(stored, "position"), reach, **values)
    return PointsRecord(measured, **_judged(table, PointsRecord, schema.JUDGED))


def _judged(table: StoredTable, cls: type, fields: schema.Fields) -> dict[str, Any]:
    """What an evaluation is judged by, checked as when it was made."""
    values = values_in(cls, fields, table, table.attributes)
    u, u_relative, *bodies = values["influences"]
    expansions = (None if body is None else Expansion(*body) for body in bodies)
    values["influences"] = checked_influences(Influences(u, u_relative, *expansions))
    values["limits"] = checked_limits({name: Limit(*limit) for name, limit in values["limits"].items()})
    check_sense(table.path, {"the standard uncertainty of the test is not finite": not math.isfinite(values["u_test"])})
    checked(values["rule"], Rule | None, "rule")
    return values


KIND = "model comparison"
_MODELS: Fields = {
    "parameters": number("free parameters", "1"),
    "effective_parameters": number("parameters that the data determine", "1"),
    "rms_inside": number("RMS distance of the fitted poses from their geometry", "mm"),
    "rms_outside": number("RMS error in held-out regions", "mm"),
    "u_outside": number("standard error of rms_outside, estimated from the scatter between regions", "mm"),
    "ratio": number("mean of (error / predicted standard deviation)^2 in held-out regions", "1"),
    "log_evidence": number("natural logarithm of the evidence, without the terms that are equal for all models", "1"),
    "difference": number("mean square error in held-out regions, minus the mean square error of the best model", "mm2"),
    "u_difference": number("standard error of the difference", "mm2"),
    "cpu_seconds": number("CPU time", "s"),
}
_REGIONS: Fields = {
    "model": text("model of the joints"),
    "region": text("region that was held out"),
    "poses": number("number of poses in the region", "1"),
    "rms": number("RMS error of the poses in the region", "mm"),
    "ratio": number("mean of (error / predicted standard deviation)^2", "1"),
}
_NEEDED = ("parameters", "effective_parameters", "rms_inside", "rms_outside", "log_evidence", "cpu_seconds")
_LARGEST = 1e12


def save_compared_models(
    path: str | os.PathLike, summary: Mapping[str, Any], sources: Sequence[str] = (), seed: int | None = None
) -> None:
    """Write compared models to HDF5, whole or not at all.

    Args:
        path: The file to write.
        summary: What `summaries.compared_models_summary` returned, with the number of poses.
        sources: Names and digests of the files that were read.
        seed: Seed of a random choice of poses.

    Example:
        >>> from aacmm_jax.summaries.compared_models import compared_models_summary
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> summary = compared_models_summary(compared, nominal.name) | {"poses": 60}
        >>> aj.files.save_compared_models("models.h5", summary)
        >>> print(aj.files.load_compared_models("models.h5")["arm"])
        Cheng 2018, simulated arm
    """
    models = [SimpleNamespace(**row) for row in summary["models"]]
    regions = [SimpleNamespace(model=row.model, **region) for row in models for region in row.regions]
    fields = {"model": text("model of the joints"), **_MODELS, "converged": truth("whether its calibration converged")}
    tables = {  # for other programs: the summary has all of it
        "models": rows_table("model", models, fields),
        "by_region": rows_table("row", regions, _REGIONS),
    }
    write_tables(path, KIND, tables, {"sources": list(sources) or None, "seed": seed}, summary=summary)


def load_compared_models(path: str | os.PathLike) -> dict[str, Any]:
    """Read compared models: the summary that was saved.

    Args:
        path: The file to read.

    Example:
        >>> from aacmm_jax.summaries.compared_models import compared_models_summary
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> summary = compared_models_summary(compared, nominal.name) | {"poses": 60}
        >>> aj.files.save_compared_models("models.h5", summary)
        >>> print(aj.files.load_compared_models("models.h5")["recommended"])
        dh
    """
    with undamaged(path), opened(path, (KIND,)) as file:
        summary = json.loads(file["summary"].asstr()[()])
        _check(path, summary)
        return summary


def _check(path: str | os.PathLike, summary: Mapping[str, Any]) -> None:
    """Raise `InputError` where values make no sense."""
    models = summary["models"]
    names = [row["model"] for row in models]
    numbers = [row[key] for row in models for key in _MODELS]
    numbers += [region[key] for row in models for region in row["regions"] for key in ("rms", "ratio")]
    chosen = {summary["best"], summary["recommended"]}
    uneven = any([region["region"] for region in row["regions"]] != summary["regions"] for row in models)
    positive = [row[key] for row in models for key in _NEEDED[:4]]
    positive += [region["rms"] or 0.0 for row in models for region in row["regions"]]
    check_sense(
        path,
        {
            "it contains no models": not models,
            "a model is named twice": len(set(names)) != len(names),
            "the recommended model is not one of the models": not chosen <= set(names),
            "a model lacks a region": uneven,
            "a model lacks a number": any(row[key] is None for row in models for key in _NEEDED),
            "a number is impossibly large": any(abs(value) > _LARGEST for value in numbers if value is not None),
            "a number that must be 0 or positive is negative": any(
                value is not None and value < 0 for value in positive
            ),
        },
    )
