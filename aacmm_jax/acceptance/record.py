"""The records of an evaluation: a calibrated arm on a capture, or points, with the limits they are judged by."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import jax
import numpy as np

from ..calibration.evaluation import evaluate
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..calibration.task import check_observed
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture, names_in
from ..data.recording import Recording
from ..kinematics.arm import Arm
from ..kinematics.chain import Geometry
from ..kinematics.parameters import ArmSpecification, Parameters
from ..model.observed import Observed
from ..uncertainty.arm_uncertainty import Uncertainty
from .all_tests import NO_INFLUENCES, checked_limits, measured_by, run
from .judgement import Influences, Limit, Rule
from .results import AcceptanceTest, Measured
from .standards import OF_SPHERES, STANDARDS, Standard, checked_standards

MAXIMA = ("rms_mm", "deltam_mm", "length_error_largest_mm")
_ROUNDING = 1e-7  # relative error up to which a length has the error zero by construction
SIMULATED = "The readings are simulated: no real arm was measured."


class EvaluationRecord(NamedTuple):
    """A calibrated arm and the capture it is evaluated on; the metrics follow from these.

    Example:
        >>> evaluation = aj.acceptance.evaluation_of(record, aj.Recording(two_bars, nominal), standards=["asme"])
        >>> print(evaluation.calibrated.name)
        Cheng 2018, simulated arm, calibrated
        >>> for which, tests in evaluation.acceptance().items():
        ...     print(which, [test.title for test in tests])
        nominal ['single-point articulation', 'volumetric']
        calibrated ['single-point articulation', 'volumetric']
    """

    recording: Recording  # the capture, with the nominal arm of the calibration
    calibrated: ArmSpecification
    used: frozenset[str]  # sockets that the calibration was identified from
    warnings: tuple[str, ...] = ()
    limits: Mapping[str, Limit] = MappingProxyType({})  # MPE by the name of a metric (`acceptance.METRICS`)
    u_test: float = 0.0  # standard uncertainty that seat and fixture add, mm
    maxima: Mapping[str, float] = MappingProxyType({})  # limits of the quantities in `MAXIMA`, mm
    standards: tuple[str, ...] = tuple(STANDARDS)  # whose acceptance tests are run, in addition to those with a limit
    uncertainty: Uncertainty | None = None  # of the calibrated arm; files of earlier versions have none
    calibration_warnings: tuple[str, ...] = ()  # what should be read about the calibration itself
    influences: Influences = NO_INFLUENCES
    rule: Rule | None = None  # None: that of each standard

    def arms(self) -> dict[str, ArmSpecification]:
        """The nominal and the calibrated arm."""
        return {"nominal": self.recording.nominal, "calibrated": self.calibrated}

    def held_out_lengths(self) -> list[int]:
        """Indices of the lengths with an end that the calibration was not identified from."""
        lengths = self.recording.capture.lengths
        return [i for i, length in enumerate(lengths) if not {length.start, length.end} <= self.used]

    def length_that_fixed_scale(self) -> int | None:
        """Index of the only length identified from, if its error is zero by construction because it fixed the scale."""
        lengths, held_out = self.recording.capture.lengths, self.held_out_lengths()
        used = [i for i in range(len(lengths)) if i not in held_out]
        if len(used) != 1:
            return None
        error = float(np.asarray(evaluate(self.calibrated.arm, self.recording.capture).error)[used[0]])
        return used[0] if abs(error) <= _ROUNDING * float(lengths[used[0]].value) else None

    def measured(self, arm: Arm) -> Measured:
        """What acceptance tests are run on: held-out data, or everything if there are none."""
        whole = measured_by(arm, self.recording)
        if not self.independent:
            return whole._replace(none_held_out=True)
        lengths = self.recording.capture.lengths
        held_out = {(lengths[i].start, lengths[i].end) for i in self.held_out_lengths()}
        tested = tuple(length for length in whole.lengths if (length.start, length.end) in held_out)
        return whole._replace(lengths=tested, identified_from=self.used)

    @property
    def independent(self) -> bool:
        """Whether there are data that the calibration was not identified from."""
        return bool(self.held_out() or self.held_out_lengths() or self.recording.spheres)

    def held_out(self) -> tuple[str, ...]:
        """Sockets and observations that the calibration was not identified from."""
        return tuple(name for name in names_in(self.recording.capture) if name not in self.used)

    def acceptance(self) -> dict[str, list[AcceptanceTest]]:
        """The tests of ``standards``, and those with a limit, as far as the capture allows; of both arms."""
        if not (self.standards or self.limits):
            return {stage: [] for stage in self.arms()}
        return {stage: _tests(self, self.measured(arm.arm)) for stage, arm in self.arms().items()}


class PointsRecord(NamedTuple):
    """Recorded points and the limits they are judged by; the metrics follow from these.

    Example:
        >>> measured = aj.acceptance.Measured({"cone": result.arm.position(capture.sockets["A"])})
        >>> judged = aj.acceptance.PointsRecord(measured, limits={"SPAT": 0.05}, rule="simple")
        >>> print([(metric.name, metric.decision) for test in judged.acceptance() for metric in test.metrics])
        [('Deltam', None), ('SPAT', 'conforms'), ('SPAT_2s', None)]
    """

    measured: Measured
    limits: Mapping[str, Limit | float] = MappingProxyType({})
    u_test: float = 0.0  # standard uncertainty that seat and fixture add, mm
    standards: tuple[str, ...] = tuple(STANDARDS)  # whose acceptance tests are run, in addition to those with a limit
    influences: Influences = NO_INFLUENCES
    rule: Rule | None = None  # None: that of each standard

    def acceptance(self) -> list[AcceptanceTest]:
        """The tests of ``standards``, and those with a limit, as far as the points allow."""
        return _tests(self, self.measured)


def _tests(record: EvaluationRecord | PointsRecord, measured: Measured) -> list[AcceptanceTest]:
    tests = run(measured, record.limits, record.u_test, influences=record.influences, rule=record.rule)
    wanted = {STANDARDS[name] for name in record.standards if name in STANDARDS}
    return [test for test in tests if test.standard in wanted or {m.name for m in test.metrics} & record.limits.keys()]


def evaluation_of(
    record: CalibrationRecord,
    recording: Recording,
    *,
    limits: Mapping[str, Limit | float] | None = None,
    u_test: float = 0.0,
    maxima: Mapping[str, float] | None = None,
    standards: Iterable[str] | None = None,
    influences: Influences = NO_INFLUENCES,
    rule: Rule | None = None,
) -> EvaluationRecord:
    """Evaluate a calibration on a capture; the record has warnings on what makes it doubtful.

    A socket counts as identified from if the calibration used any of its poses. Of another observation, the poses that
    it did not use are held out, as far as they determine their geometry: that is fitted to the arm.
    `InputError` for an impossible limit, one whose metric nothing can be measured for, and observations that do not
    determine their own unknown geometry.

    Args:
        record: The calibration.
        recording: The capture; its nominal arm should be that of the calibration.
        limits: MPE by the name of a metric: a `Limit`, or a number of mm.
        u_test: Standard uncertainty that seat and fixture add to every test value, mm.
        maxima: Limits of the quantities in `MAXIMA`, mm.
        standards: Standards whose acceptance tests are run: "jjf", "asme", "iso". Default: those whose procedure the
            recording was made for. Tests with a limit are run in any case.
        influences: What else adds uncertainty: in proportion to a length, and thermal expansion.
        rule: Decision rule, a key of `RULES`; by default that of each standard.

    Example:
        >>> limits = {"Length": 0.1}
        >>> evaluation = aj.acceptance.evaluation_of(record, aj.Recording(two_bars, nominal), limits=limits)
        >>> for test in evaluation.acceptance()["calibrated"]:
        ...     print(test.title, test.decision)
        single point and length, as in Cheng et al. 2018 conforms
    """
    used = {row.tobytes() for row in np.asarray(record.recording.capture.readings)}
    recording = recording._replace(capture=_divided(record.calibrated.arm, recording.capture, used))
    check_geometry(record.calibrated.arm, recording.capture)
    readings = dict(recording.capture.sockets) | {part.name: part.q for part in recording.capture.observations}
    shared = {name: sum(row.tobytes() in used for row in np.asarray(q)) for name, q in readings.items()}
    warnings = []
    if not record.converged or not record.plausible_scale:
        reason = record.reason if not record.converged else f"k = {record.k:.6g} is not a plausible scale."
        warnings.append(f"The calibration failed, so the results mean nothing: {reason}")
    if recording.true is not None:
        warnings.append(SIMULATED)
    warnings += recording.capture.repeated.sentences()
    counts = ((name, count, len(readings[name])) for name, count in shared.items())
    if partly := [f"{name} ({count} of {poses} poses)" for name, count, poses in counts if 0 < count < poses]:
        names = ", ".join(partly)
        warnings.append(f"The arm was identified from some poses of {names}; these count as identified from.")
    if not same_arm(recording.nominal.arm, record.recording.nominal.arm):
        warnings.append(
            f"The capture is of '{recording.nominal.name}', but the calibration is of "
            f"'{record.recording.nominal.name}'; check that it is the same arm."
        )
    evaluation = EvaluationRecord(
        recording._replace(nominal=record.recording.nominal),
        record.calibrated,
        frozenset(name for name, count in shared.items() if count),
        limits=checked_limits(limits or {}),
        u_test=u_test,
        maxima=dict(maxima or {}),
        standards=made_for(recording) if standards is None else checked_standards(standards),
        uncertainty=uncertainty_of(record),
        influences=influences,
        rule=rule,
    )
    if not evaluation.independent:
        warnings.append(
            "The arm was identified from all of this capture, so the results are too favourable and are not a test; "
            "measure what the calibration does not use."
        )
    warnings += unstated_uncertainty_warning(evaluation.acceptance()["calibrated"])
    return evaluation._replace(warnings=tuple(warnings))


def _divided(arm: Arm, capture: Capture, used: Collection[bytes]) -> Capture:
    """With the poses of an observation that were not used as an observation of their own, where others were."""
    observations = []
    for observation in capture.observations:
        seen = np.array([row.tobytes() in used for row in np.asarray(observation.q)])
        parts = [observation]
        if seen.any() and not seen.all() and not any(observation.name in (r.start, r.end) for r in capture.lengths):
            unseen = observation.select(np.flatnonzero(~seen)).changed(name=f"{observation.name}, unseen")
            try:
                check_geometry(arm, Capture({}, [], [unseen]))
                parts = [observation.select(np.flatnonzero(seen)), unseen]
            except InputError:
                pass  # too few poses: the observation counts as identified from
        observations += parts
    return Capture(capture.sockets, capture.lengths, observations, capture.repeated)


def check_geometry(arm: Arm, capture: Capture) -> None:
    """Raise `InputError` where observations do not determine their own unknowns."""
    space = to_numpy(Parameters(arm, ("d_1",)))
    check_observed(Observed.of(capture, arm), space, np.asarray(space.vector()), 0)


def made_for(recording: Recording) -> tuple[Standard, ...]:
    """Standards whose acceptance procedure a recording was made for: as it says, or as the spheres say it has."""
    return checked_standards((*recording.acceptance, *(OF_SPHERES[sphere.test] for sphere in recording.spheres)))


def unstated_uncertainty_warning(tests: Sequence[AcceptanceTest]) -> list[str]:
    """A sentence on metrics that were decided although no uncertainty was stated for them, if there are any."""
    metrics = (metric for test in tests for metric in test.metrics)
    names = [metric.name for metric in metrics if metric.decision is not None and metric.worst.expanded == 0]
    sentence = (
        f"No uncertainty was stated for {', '.join(names)}, so U is 0 and the decision ignores it; state what seat "
        "and fixture contribute (--test-u-mm), and the temperatures (--expansion)."
    )
    return [sentence] if names else []


def same_arm(one: Arm, other: Arm) -> bool:
    """Whether two arms have the same parameters; without beta it is 0. A model of its joints may come
    with a calibration."""

    def parameters(arm: Arm) -> Geometry:
        plain = arm.geometry._replace(coefficients=None, gravity=None, corrections=None)
        return plain._replace(beta=np.zeros(arm.joints) if arm.beta is None else arm.beta)

    return jax.tree.all(jax.tree.map(np.array_equal, parameters(one), parameters(other)))
