"""An evaluation: a calibrated arm tried on a capture, within what limits; in HDF5."""

import math
import os
from collections.abc import Mapping

import numpy as np

from ..acceptance.decision import Limit
from ..acceptance.metrics import METRICS
from ..acceptance.record import MAXIMA, EvaluationRecord
from ..acceptance.suite import checked_limits
from .captures import arm_table, recording_attributes, recording_of, recording_tables, specification_of
from .hdf5 import Stored, Table, Variable, need, read_tables, undamaged, write_tables


def save_evaluation(path: str | os.PathLike, record: EvaluationRecord) -> None:
    """Write an evaluation to HDF5, whole or not at all."""
    tables = recording_tables(record.recording)
    tables["calibrated_arm"] = arm_table(record.calibrated)
    tables["used"] = Table({"used": Variable(("used",), sorted(record.used), "", "socket that the arm was identified from")})
    tables["limits"] = limit_table(record.limits)
    tables["figures"] = _figure_table(record)
    attributes = recording_attributes(record.recording) | {
        "warnings": list(record.warnings) or None,
        "u_test_mm": record.u_test,
        **{f"most_{name}": value for name, value in record.maxima.items()},
    }
    write_tables(path, "evaluation", tables, attributes)


def limit_table(limits: Mapping[str, Limit | float]) -> Table:
    """Limits by the name of a figure."""
    checked = checked_limits(limits)
    columns = {
        "figure": (list(checked), "", "figure of an acceptance test"),
        "fixed": ([limit.fixed for limit in checked.values()], "mm", "MPE at length 0"),
        "divisor": ([limit.divisor for limit in checked.values()], "1", "MPE grows by the length over this"),
    }
    return Table({name: Variable(("figure",), *column) for name, column in columns.items()})


def limits_in(stored: Stored) -> dict[str, Limit]:
    """The limits that a file holds."""
    table = stored.tables["limits"]
    rows = zip(table["figure"], table["fixed"], table["divisor"], strict=True)
    found = {str(name): Limit(float(fixed), float(divisor)) for name, fixed, divisor in rows}
    if not all(name in METRICS and 0 <= limit.fixed < math.inf and limit.divisor > 0 for name, limit in found.items()):
        raise ValueError("a limit that this package would not have written")  # `storage.undamaged` says what that means
    return found


def _figure_table(record: EvaluationRecord) -> Table:
    """The results, for other programs; this package computes them again."""
    rows = [(stage, test, figure) for stage, tests in record.acceptance().items() for test in tests for figure in test.metrics]
    columns = {
        "arm": ([stage for stage, *_ in rows], "", "arm that measured"),
        "standard": ([test.standard for _, test, _ in rows], "", "standard of the test"),
        "name": ([figure.name for *_, figure in rows], "", "figure"),
        "value": ([figure.value for *_, figure in rows], "mm", "value of the worst part"),
        "expanded": ([figure.worst.expanded for *_, figure in rows], "mm", "expanded uncertainty, coverage factor 2"),
        "limit": ([math.nan if figure.worst.limit is None else figure.worst.limit for *_, figure in rows], "mm", "MPE"),
        "decision": ([figure.decision or "" for *_, figure in rows], "", "decision by ISO 14253-1"),
        "where": ([figure.worst.where for *_, figure in rows], "", "what gave the worst part"),
    }
    row = {"row": Variable(("row",), np.arange(1, len(rows) + 1), "1", "row number")}
    return Table(row | {name: Variable(("row",), *column) for name, column in columns.items()})


def load_evaluation(path: str | os.PathLike) -> EvaluationRecord:
    """Read an evaluation. Raises `InputError` where the file is missing, damaged, foreign, newer or no evaluation."""
    stored = read_tables(path, ("evaluation",))
    need(path, stored.tables, "calibrated_arm", "used", "limits")
    with undamaged(path):
        attributes = stored.attributes
        maxima = {name.removeprefix("most_"): float(value) for name, value in attributes.items() if name.startswith("most_")}
        if not set(maxima) <= set(MAXIMA) or not all(0 <= value < math.inf for value in maxima.values()):
            raise ValueError("a limit that this package would not have written")
        return EvaluationRecord(
            recording_of(path, stored),
            specification_of(path, stored, "calibrated_arm"),
            frozenset(str(name) for name in stored.tables["used"]["used"]),
            tuple(map(str, np.atleast_1d(attributes.get("warnings") or []))),
            limits_in(stored),
            float(attributes["u_test_mm"]),
            maxima,
        )
