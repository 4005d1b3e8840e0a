"""What an evaluation is of: a calibrated arm on a capture, or points, and within what limits."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..calibration.checks import plausible
from ..calibration.record import CalibrationRecord
from ..data.recording import Recording
from ..kinematics.arm import Arm
from ..kinematics.chain import Geometry
from ..kinematics.specification import ArmSpecification
from .decision import Limit
from .suite import AcceptanceTest, Measured, checked_limits, measured_by, run, unstated


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
        return {stage: run(self.measured(arm.arm), self.limits, self.u_test) for stage, arm in self.arms().items()}


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
    warnings += unstated_uncertainty_warning(found.acceptance()["calibrated"])
    return found._replace(warnings=tuple(warnings))


def unstated_uncertainty_warning(tests: Sequence[AcceptanceTest]) -> list[str]:
    """A sentence on figures that were decided although nothing of their uncertainty was stated; none without them."""
    bare = unstated(tests)
    if not bare:
        return []
    return [
        f"Nothing was stated of the uncertainty of {', '.join(bare)}, so U is 0 and the decision rests on that; state what seat, fixture "
        "and temperature bring (--test-u-mm)."
    ]


def _same(one: Arm, other: Arm) -> bool:
    """Whether two arms have the same parameters; an arm without beta is one whose beta is zero."""

    def parameters(arm: Arm) -> Geometry:
        return arm.geometry._replace(beta=np.zeros(arm.joints) if arm.beta is None else arm.beta)

    return all(map(np.array_equal, parameters(one), parameters(other)))


MAXIMA = ("rms_mm", "deltam_mm", "length_error_largest_mm")


SIMULATED = "The readings are simulated: no real arm was measured."


class PointsRecord(NamedTuple):
    """What an evaluation of points is of; its figures follow from that."""

    measured: Measured
    limits: Mapping[str, Limit | float] = MappingProxyType({})
    u_test: float = 0.0  # standard uncertainty that seat, fixture and temperature add, mm

    def acceptance(self) -> list[AcceptanceTest]:
        """Every test that the points allow."""
        return run(self.measured, self.limits, self.u_test)
