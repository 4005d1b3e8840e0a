"""Evaluations in HDF5: a calibrated arm on a capture, or the points that an arm's own program reported."""

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..acceptance.all_tests import checked_limits
from ..acceptance.judgement import Expansion, Influences, Limit, Rule, checked_influences
from ..acceptance.record import MAXIMA, EvaluationRecord, PointsRecord
from ..acceptance.results import Measured
from ..core.arguments import checked
from ..kinematics.arm import parameter_names
from ..kinematics.workspace import Reach
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.degrees_of_freedom import Components
from ..uncertainty.shared_errors import SharedErrors
from . import schema
from .captures import (
    arm_table,
    lengths_of,
    recording_attributes,
    recording_of,
    recording_tables,
    specification_of,
    sphere_table,
    spheres_of,
)
from .hdf5 import StoredTable, Table, Variable, check_sense, columns, undamaged, write_tables
from .records import Within, records_within, rows_table, table_of, tables_within, values_in
from .sense import read_checked

_RECORDS = {
    "shared": Within("shared_errors", SharedErrors, schema.SHARED_ERRORS),
    "components": Within("components", Components, schema.COMPONENTS),
}


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
    tables = recording_tables(record.recording) | {"calibrated_arm": arm_table(record.calibrated)}
    tables["evaluation"] = table_of(record._replace(limits=checked_limits(record.limits)), schema.EVALUATION)
    tables["figures"] = _metric_table(record)
    uncertainty = record.uncertainty
    if uncertainty is not None:
        tables["uncertainty"] = table_of(uncertainty, schema.UNCERTAINTY)
        tables |= tables_within(uncertainty, _RECORDS)
    write_tables(path, "evaluation", tables, recording_attributes(record.recording), summary=summary)


def _metric_table(record: EvaluationRecord) -> Table:
    """The results, for other programs; this package computes them again on reading."""
    rows = [
        (stage, test.standard, metric, metric.worst)
        for stage, tests in record.acceptance().items()
        for test in tests
        for metric in test.metrics
    ]
    return Table(
        columns(
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
    )


def load_evaluation(path: str | os.PathLike) -> EvaluationRecord:
    """Read an evaluation of a capture.

    Args:
        path: the file to read.

    Returns:
        The record, from which the results are computed again.

    Raises:
        InputError: the file does not exist, is damaged, is not of this kind, or was written by another version.

    Example:
        >>> evaluation = aj.acceptance.evaluation_of(record, aj.Recording(two_bars, nominal))
        >>> aj.files.save_evaluation("evaluation.h5", evaluation)
        >>> print(aj.files.load_evaluation("evaluation.h5").calibrated.name)
        Cheng 2018, simulated arm, calibrated
    """
    with undamaged(path):
        stored = read_checked(path, ("evaluation",))
        calibrated = specification_of(path, stored, "calibrated_arm")
        values = _judged(stored.tables["evaluation"], EvaluationRecord, schema.EVALUATION)
        maxima = values["maxima"]
        possible = all(name in MAXIMA and 0 <= limit < math.inf for name, limit in maxima.items())
        check_sense(path, {"a limit is unknown, negative or not finite": not possible})
        uncertainty, table = None, stored.tables.get("uncertainty")
        if table is not None:
            parameters = values_in(Uncertainty, schema.UNCERTAINTY, table, table.attributes)
            names = set(parameters["names"])
            strange = not names <= set(parameter_names(calibrated.arm)) or len(names) < len(parameters["names"])
            check_sense(path, {"a parameter is unknown, or named twice": strange})
            uncertainty = Uncertainty(
                arm=calibrated.arm,
                u_k=None,
                **records_within(stored.tables, _RECORDS),
                **parameters,
            )
        return EvaluationRecord(recording_of(path, stored), calibrated, uncertainty=uncertainty, **values)


def _judged(table: StoredTable, cls: type, fields: schema.Fields) -> dict[str, Any]:
    """What an evaluation is judged by, checked as when it was made."""
    values = values_in(cls, fields, table, table.attributes)
    u, u_relative, *bodies = values["influences"]
    expansions = (None if body is None else Expansion(*body) for body in bodies)
    values["influences"] = checked_influences(Influences(u, u_relative, *expansions))
    values["limits"] = checked_limits({name: Limit(*limit) for name, limit in values["limits"].items()})
    check_sense(table.path, {"the uncertainty of the test is not finite": not math.isfinite(values["u_test"])})
    checked(values["rule"], Rule | None, "rule")
    return values


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
    measured, reach = record.measured, record.measured.reach
    owner = [name for name, points in measured.sockets.items() for _ in points]
    position = np.concatenate([np.zeros((0, 3)), *measured.sockets.values()])
    points = columns("point", socket=(owner, "", "socket that held it"))
    points["position"] = Variable(("point", "axis"), position, "mm", "centre of the probe")
    attributes = dict(table_of(record._replace(limits=checked_limits(record.limits)), schema.JUDGED).attributes)
    if reach is not None:
        attributes |= {"shoulder_mm": np.asarray(reach.shoulder), "radius_mm": reach.radius}
    tables = {
        "points": Table(points, attributes),
        "reference": rows_table("length", measured.lengths, schema.LENGTHS),
    }
    if measured.spheres:
        tables["sphere"] = sphere_table(measured.spheres, points=True)
    root = {"of": "points"} | dict(table_of(measured, schema.POINTS).attributes)
    write_tables(path, "evaluation", tables, root, summary=summary)


def load_points(path: str | os.PathLike) -> PointsRecord:
    """Read an evaluation of points.

    Args:
        path: the file to read.

    Returns:
        The record, from which the results are computed again.

    Raises:
        InputError: the file does not exist, is damaged, is not of this kind, or was written by another version.

    Example:
        >>> points = {"cone": true.position(capture.sockets["A"])}
        >>> aj.files.save_points("points.h5", aj.acceptance.PointsRecord(aj.acceptance.Measured(points)))
        >>> print(aj.files.load_points("points.h5").measured.sockets["cone"].shape)
        (40, 3)
    """
    with undamaged(path):
        stored = read_checked(path, ("evaluation",))
        table = stored.tables["points"]
        owner = np.asarray(table["socket"]).astype(str)
        sockets = {name: table["position"][owner == name] for name in dict.fromkeys(owner.tolist())}
        reach = None
        if "radius_mm" in table.attributes:
            reach = Reach(np.array(table.attributes["shoulder_mm"]), float(table.attributes["radius_mm"]))
        measured = Measured(
            sockets,
            lengths_of(stored),
            spheres_of(stored, "position"),
            reach,
            **values_in(Measured, schema.POINTS, stored.tables, stored.attributes),
        )
        return PointsRecord(measured, **_judged(table, PointsRecord, schema.JUDGED))
