"""The records of an evaluation: a calibrated arm on a capture, or points, with the limits they are judged by."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import jax
import numpy as np

from ..calibration.evaluation import evaluate
from ..calibration.record import CalibrationRecord
from ..calibration.second_stage import LARGEST_LOG_K
from ..data.capture import check_sockets_only
from ..data.recording import Recording
from ..kinematics.arm import Arm
from ..kinematics.chain import Geometry
from ..kinematics.parameters import ArmSpecification
from .all_tests import AcceptanceTest, Measured, checked_limits, measured_by, run, without_stated_uncertainty
from .decision import Limit

MAXIMA = ("rms_mm", "deltam_mm", "length_error_largest_mm")
SIMULATED = "The readings are simulated: no real arm was measured."


class EvaluationRecord(NamedTuple):
    """A calibrated arm and the capture it is evaluated on; the metrics follow from these."""

    recording: Recording  # the capture, with the nominal arm of the calibration
    calibrated: ArmSpecification
    used: frozenset[str]  # sockets that the calibration was identified from
    warnings: tuple[str, ...] = ()
    limits: Mapping[str, Limit] = MappingProxyType({})  # MPE by the name of a metric (`acceptance.METRICS`)
    u_test: float = 0.0  # standard uncertainty that seat, fixture and temperature add, mm
    maxima: Mapping[str, float] = MappingProxyType({})  # limits of the quantities in `MAXIMA`, mm

    def arms(self) -> dict[str, ArmSpecification]:
        """The arm as found (nominal) and as left (calibrated)."""
        return {"nominal": self.recording.nominal, "calibrated": self.calibrated}

    def held_out_lengths(self) -> list[int]:
        """Indices of the lengths with an end that the calibration was not identified from."""
        lengths = self.recording.capture.lengths
        return [i for i, length in enumerate(lengths) if not {length.start, length.end} <= self.used]

    def length_that_fixed_scale(self) -> int | None:
        """Index of the only length identified from, if its error is zero by construction because it fixed the scale."""
        lengths, held_out = self.recording.capture.lengths, self.held_out_lengths()
        known = [i for i in range(len(lengths)) if i not in held_out]
        if len(known) != 1:
            return None
        error = float(np.asarray(evaluate(self.calibrated.arm, self.recording.capture).error)[known[0]])
        return known[0] if abs(error) <= LARGEST_LOG_K * float(lengths[known[0]].value) else None

    def measured(self, arm: Arm) -> Measured:
        """What acceptance tests are run on: held-out data, or everything if there are none."""
        whole = measured_by(arm, self.recording)
        if not self.independent:
            return whole._replace(none_held_out=True)
        lengths = tuple(whole.lengths[i] for i in self.held_out_lengths())
        return whole._replace(lengths=lengths, identified_from=self.used)

    @property
    def independent(self) -> bool:
        """Whether there are data that the calibration was not identified from."""
        new = set(self.recording.capture.names) - self.used
        return bool(new or self.held_out_lengths() or self.recording.spheres)

    def acceptance(self) -> dict[str, list[AcceptanceTest]]:
        """Every test that the capture allows, as found and as left."""
        return {stage: run(self.measured(arm.arm), self.limits, self.u_test) for stage, arm in self.arms().items()}


class PointsRecord(NamedTuple):
    """Recorded points and the limits they are judged by; the metrics follow from these."""

    measured: Measured
    limits: Mapping[str, Limit | float] = MappingProxyType({})
    u_test: float = 0.0  # standard uncertainty that seat, fixture and temperature add, mm

    def acceptance(self) -> list[AcceptanceTest]:
        """Every test that the points allow."""
        return run(self.measured, self.limits, self.u_test)


def evaluation_of(
    record: CalibrationRecord,
    recording: Recording,
    *,
    limits: Mapping[str, Limit | float] | None = None,
    u_test: float = 0.0,
    maxima: Mapping[str, float] | None = None,
) -> EvaluationRecord:
    """Evaluate a calibration on a capture.

    A socket counts as identified from if the calibration used any of its poses.

    Args:
        record: The calibration.
        recording: The capture; its nominal arm should be that of the calibration.
        limits: MPE by the name of a metric: a `Limit`, or a number of mm.
        u_test: Standard uncertainty that seat, fixture and temperature add to every test value, mm.
        maxima: Limits of the quantities in `MAXIMA`, mm.

    Returns:
        The record, with warnings on what makes it doubtful.

    Raises:
        InputError: A limit is impossible, or there is nothing to measure its metric on.
    """
    check_sockets_only(recording.capture, "an evaluation")
    known = {row.tobytes() for row in np.asarray(record.recording.capture.readings)}
    sockets = {name: np.asarray(q) for name, q in recording.capture.sockets.items()}
    shared = {name: sum(row.tobytes() in known for row in q) for name, q in sockets.items()}
    warnings = []
    if not record.converged or not record.plausible_scale:
        reason = record.reason if not record.converged else f"k = {record.k:.6g} is not a plausible scale."
        warnings.append(f"The calibration failed, so the results mean nothing: {reason}")
    if recording.true is not None:
        warnings.append(SIMULATED)
    warnings += recording.capture.repeated.sentences()
    partly = [f"{name} ({count} of {len(sockets[name])} poses)" for name, count in shared.items()
              if 0 < count < len(sockets[name])]  # fmt: skip
    if partly:
        warnings.append(
            f"The arm was identified from some poses of {', '.join(partly)}; these sockets count as identified from."
        )
    if not _same(recording.nominal.arm, record.recording.nominal.arm):
        warnings.append(
            f"The capture is of '{recording.nominal.name}', but the calibration is of "
            f"'{record.recording.nominal.name}'; check that it is the same arm."
        )
    found = EvaluationRecord(
        recording._replace(nominal=record.recording.nominal),
        record.calibrated,
        frozenset(name for name, count in shared.items() if count),
        limits=checked_limits(limits or {}),
        u_test=u_test,
        maxima=dict(maxima or {}),
    )
    if not found.independent:
        warnings.append(
            "The arm was identified from all of this capture, so the results are too favourable and are not a test; "
            "measure sockets and lengths that the calibration does not use."
        )
    warnings += unstated_uncertainty_warning(found.acceptance()["calibrated"])
    return found._replace(warnings=tuple(warnings))


def unstated_uncertainty_warning(tests: Sequence[AcceptanceTest]) -> list[str]:
    """A sentence on metrics that were decided although no uncertainty was stated for them, if there are any."""
    names = without_stated_uncertainty(tests)
    if not names:
        return []
    return [
        f"No uncertainty was stated for {', '.join(names)}, so U is 0 and the decision ignores it; state what seat, "
        "fixture and temperature contribute (--test-u-mm)."
    ]


def _same(one: Arm, other: Arm) -> bool:
    """Whether two arms have the same parameters; an arm without beta is one whose beta is zero."""

    def parameters(arm: Arm) -> Geometry:
        return arm.geometry._replace(beta=np.zeros(arm.joints) if arm.beta is None else arm.beta)

    return jax.tree.all(jax.tree.map(np.array_equal, parameters(one), parameters(other)))
