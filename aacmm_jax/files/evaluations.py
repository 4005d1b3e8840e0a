"""An evaluation: a calibrated arm tried on a capture, within what limits; in HDF5."""

import math
import os
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..acceptance.decision import Limit
from ..acceptance.suite import FIGURES, AcceptanceTest, Measured, accept, checked_limits, measured_by, unstated
from ..calibration.checks import plausible
from ..data.recording import ArmSpecification, Recording
from ..kinematics.arm import Arm
from . import storage
from .calibrations import CalibrationRecord
from .captures import arm_table, recording_attributes, recording_of, recording_tables, specification_of
from .storage import Table, Variable

MAXIMA = ("rms_mm", "deltam_mm", "length_error_largest_mm")
SIMULATED = "The readings are simulated: no real arm was measured."


class EvaluationRecord(NamedTuple):
    """What an evaluation is of; its figures follow from that."""

    recording: Recording  # the capture, with the nominal arm of the calibration
    calibrated: ArmSpecification
    used: frozenset[str]  # sockets that the calibration was identified from
    warnings: tuple[str, ...] = ()
    limits: Mapping[str, Limit] = MappingProxyType({})  # MPE by the name of a figure (`acceptance.FIGURES`)
    u_test: float = 0.0  # standard uncertainty that seat, fixture and temperature add, mm
    maxima: Mapping[str, float] = MappingProxyType({})  # plain limits on rms_mm, deltam_mm, length_error_largest_mm

    def arms(self) -> dict[str, ArmSpecification]:
        """The arm as found and as left."""
        return {"nominal": self.recording.nominal, "calibrated": self.calibrated}

    def unseen(self) -> list[int]:
        """Which lengths have an end that was never identified from."""
        lengths = self.recording.capture.lengths
        return [i for i, length in enumerate(lengths) if not {length.start, length.end} <= self.used]

    def measured(self, arm: Arm) -> Measured:
        """What acceptance tests look at: what the calibration has not seen; all, where it has seen everything."""
        whole = measured_by(arm, self.recording)
        if not self.independent:
            return whole._replace(seen=True)
        return whole._replace(lengths=tuple(whole.lengths[i] for i in self.unseen()), known=self.used)

    @property
    def independent(self) -> bool:
        """Whether there is anything that the calibration has not seen."""
        new = set(self.recording.capture.names) - self.used
        return bool(new or self.unseen() or self.recording.spheres)

    def acceptance(self) -> dict[str, list[AcceptanceTest]]:
        """Every test that the capture allows, as found and as left."""
        return {stage: accept(self.measured(arm.arm), self.limits, self.u_test) for stage, arm in self.arms().items()}


def evaluation_of(
    record: CalibrationRecord,
    recording: Recording,
    *,
    limits: Mapping[str, Limit | float] | None = None,
    u_test: float = 0.0,
    maxima: Mapping[str, float] | None = None,
) -> EvaluationRecord:
    """A calibration tried on a capture. A socket counts as identified from where the calibration holds any of its poses."""
    known = {row.tobytes() for row in np.asarray(record.recording.capture.q)}
    shared = {name: sum(row.tobytes() in known for row in np.asarray(q)) for name, q in recording.capture.sockets.items()}
    used = {name for name, count in shared.items() if count}
    warnings = []
    if not record.converged or not plausible(record.k):
        reason = record.reason if not record.converged else f"k = {record.k:.6g} is the scale of no arm."
        warnings.append(f"The calibration failed, so its figures mean nothing: {reason}")
    if recording.true is not None:
        warnings.append(SIMULATED)
    sizes = dict(zip(recording.capture.names, recording.capture.sizes, strict=True))
    partly = [f"{name} ({shared[name]} of {sizes[name]} poses)" for name in sizes if 0 < shared[name] < sizes[name]]
    if partly:
        warnings.append(
            f"The arm was identified from some poses of {', '.join(partly)}; these sockets count as identified from."
        )
    if not _same(recording.nominal.arm, record.recording.nominal.arm):
        warnings.append(
            f"The capture is of '{recording.nominal.name}', but the calibration of '{record.recording.nominal.name}'; is it the same arm?"
        )
    found = EvaluationRecord(
        recording._replace(nominal=record.recording.nominal),
        record.calibrated,
        frozenset(used),
        tuple(warnings),
        checked_limits(limits or {}),
        u_test,
        dict(maxima or {}),
    )
    if not found.independent:
        warnings.append(
            "The arm was identified from all of this capture, so its figures flatter it and are no test; take sockets and lengths "
            "that it has not seen."
        )
    warnings += bare_warning(found.acceptance()["calibrated"])
    return found._replace(warnings=tuple(warnings))


def bare_warning(tests: Sequence[AcceptanceTest]) -> list[str]:
    """A sentence on figures that were decided although nothing of their uncertainty was stated; none without them."""
    bare = unstated(tests)
    if not bare:
        return []
    return [
        f"Nothing was stated of the uncertainty of {', '.join(bare)}, so U is 0 and the decision rests on that; state what seat, fixture "
        "and temperature bring (--test-u-mm)."
    ]


def _same(one: Arm, other: Arm) -> bool:
    return one.joints == other.joints and all(
        np.array_equal(np.asarray(getattr(one, kind)), np.asarray(getattr(other, kind)))
        for kind in ("alpha", "a", "d", "theta", "probe")
    )


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
    storage.write_tables(path, "evaluation", tables, attributes)


def limit_table(limits: Mapping[str, Limit | float]) -> Table:
    """Limits by the name of a figure."""
    checked = checked_limits(limits)
    columns = {
        "figure": (list(checked), "", "figure of an acceptance test"),
        "fixed": ([limit.fixed for limit in checked.values()], "mm", "MPE at length 0"),
        "divisor": ([limit.divisor for limit in checked.values()], "1", "MPE grows by the length over this"),
    }
    return Table({name: Variable(("figure",), *column) for name, column in columns.items()})


def limits_in(stored: storage.Stored) -> dict[str, Limit]:
    """The limits that a file holds."""
    table = stored.tables["limits"]
    rows = zip(table["figure"], table["fixed"], table["divisor"], strict=True)
    found = {str(name): Limit(float(fixed), float(divisor)) for name, fixed, divisor in rows}
    if not all(name in FIGURES and 0 <= limit.fixed < math.inf and limit.divisor > 0 for name, limit in found.items()):
        raise ValueError("a limit that this package would not have written")  # `storage.undamaged` says what that means
    return found


def _figure_table(record: EvaluationRecord) -> Table:
    """The results, for other programs; this package computes them again."""
    rows = [(stage, test, figure) for stage, tests in record.acceptance().items() for test in tests for figure in test.figures]
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
    stored = storage.read_tables(path, ("evaluation",))
    storage.need(path, stored.tables, "calibrated_arm", "used", "limits")
    with storage.undamaged(path):
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
