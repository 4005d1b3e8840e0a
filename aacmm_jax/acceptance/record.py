"""Acceptance tests of arms by JJF 1408-2013 (as Cheng et al. 2018 use it), ASME B89.4.22-2004 and ISO 10360-12:2016.

The texts of the standards were not available: formulas and procedures follow secondary sources of the editions named.
Every metric is of single readings, never of means, because a test states by how much one measurement can be wrong.
Uncertainties are the tester's (artefacts, seat, fixture, temperature): the arm's own scatter is what is tested (ISO
14253-5, ISO/TS 23165). An evaluation of a calibrated arm, or of points, is a record that the tests follow from.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, NamedTuple

import jax
import numpy as np

from ..calibration.evaluation import Evaluation, evaluate
from ..calibration.task import check_observed
from ..core.arguments import Range, checked, checked_arguments
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture, names_in
from ..data.recording import Recording, checked_sphere
from ..kinematics.arm import Arm
from ..kinematics.chain import Geometry
from ..kinematics.parameters import ArmSpecification, Parameters
from ..kinematics.workspace import arm_reach
from ..model.layout import unknowns_of
from ..model.observed import Observed
from ..uncertainty.arm_uncertainty import Uncertainty
from .geometry import elbow_sides, points_of, unit_rows
from .judgement import MOST, Influences, Limit, Rule, checked_influences, checked_limit, decide, without_test
from .requirements import TESTS
from .results import METRICS, AcceptanceTest, Measured, Metric, Postures
from .standards import DEFAULT_RULES, STANDARDS

NO_INFLUENCES = Influences()
MAXIMA = ("rms_mm", "deltam_mm", "length_error_largest_mm")
SIMULATED = "The readings are simulated: no real arm was measured."
Millimetres = Annotated[float, Range(least=0, most=MOST, unit="mm")]
_FARTHEST = 1e6  # mm: no arm reaches a kilometre
_ROUNDING = 1e-7  # relative error up to which a length has the error zero by construction


def measured_by(arm: Arm, recording: Recording) -> Measured:
    """Compute what an arm measures where the poses of a recording were taken, mm.

    Args:
        arm: The arm, for example a calibrated one.
        recording: Joint readings in sockets and on spheres, with the reference lengths.

    Example:
        >>> measured = aj.acceptance.measured_by(result.arm, recording)
        >>> print(measured.sockets["A"].shape, f"{measured.reach.radius:.0f} mm")
        (40, 3) 1360 mm
    """
    capture, touched = recording.capture, [group for sphere in recording.spheres for group in sphere.groups]
    readings = [np.asarray(q) for q in (*capture.sockets.values(), *touched)]
    ends = np.cumsum([len(q) for q in readings])
    none = np.zeros((0, capture.columns))
    points = iter(np.split(np.asarray(arm.position(np.concatenate([*readings, none]))), ends[:-1]))
    sockets = {name: next(points) for name in capture.sockets}
    # Sockets that held another target than the arm's own probe are not part of any procedure.
    lengths = tuple(length for length in capture.lengths if length.start in sockets and length.end in sockets)
    spheres = tuple(sphere._replace(groups=tuple(next(points) for _ in sphere.groups)) for sphere in recording.spheres)
    reach = arm_reach(arm)
    sides = elbow_sides(arm, np.concatenate([*readings[: len(sockets)], none]), reach)
    elbows = dict(zip(sockets, np.split(sides, ends[: len(sockets)])[:-1], strict=True))
    # From the last frame's origin to the tip, or of its z axis where these coincide.
    probe = np.asarray(arm.probe) if np.any(arm.probe) else np.array([0.0, 0.0, 1.0])
    probes = {
        (sphere.name, sphere.test): tuple(unit_rows(np.asarray(arm.pose(q))[:, :3, :3] @ probe) for q in sphere.groups)
        for sphere in recording.spheres
    }
    postures = Postures(elbows, probes)
    return Measured(sockets, lengths, spheres, reach, measuring_range=recording.measuring_range, postures=postures)


@checked_arguments
def run(
    measured: Measured,
    limits: Mapping[str, Limit | float] | None = None,
    u_test: Millimetres = 0.0,
    *,
    influences: Influences = NO_INFLUENCES,
    rule: Rule | None = None,
) -> list[AcceptanceTest]:
    """Run every test that the measured points allow and that has at least one metric.

    Source: JJF 1408-2013 as used by Cheng et al. 2018, ASME B89.4.22-2004, ISO 10360-12:2016; formulas stated from
    secondary sources (`requirements_table` says which, and how certain they are). Decisions: see `decide`. A test says
    what its full procedure would also need, and bears the standard's name (`AcceptanceTest.called`) only where nothing
    that can be checked is missing. `InputError` for points that are not in mm, and for a limit of a metric that these
    points do not give, or that grows with a length although the metric is not of one; and for the expansion of an
    artefact whose lengths are already corrected.

    Args:
        measured: Points of sockets and spheres, and reference lengths, mm.
        limits: MPE by the name of a metric (a key of `METRICS`): a `Limit`, or a number of mm.
        u_test: Standard uncertainty that seat and fixture add to every test value, mm.
        influences: What else adds to it: in proportion to a length, and thermal expansion of artefact and arm.
        rule: Decision rule (a key of `RULES`); by default ISO 14253-1:2017, and simple acceptance for ASME.

    Example:
        >>> measured = aj.acceptance.measured_by(result.arm, aj.Recording(two_bars, nominal))
        >>> test = aj.acceptance.run(measured, limits={"SPAT": 0.1})[1]
        >>> print(test.called, [(metric.name, metric.decision) for metric in test.metrics])
        based on ASME B89.4.22-2004 [('SPAT', 'conforms'), ('SPAT_2s', None)]
    """
    measured, influences, given = _checked(measured), checked_influences(influences), checked_limits(limits or {})
    influences = influences._replace(u=math.hypot(influences.u, u_test))
    twice = next((length for length in measured.lengths if length.corrected), None)
    if twice is not None and influences.artefact is not None:
        raise InputError(
            f"the length '{twice.start}' to '{twice.end}' is already corrected for thermal expansion (temperature_C, "
            "expansion in [[length]]), and --expansion artefact=... (influences.artefact) would correct it twice; "
            "leave out one of the two."
        )
    tests = [result for test in TESTS if (result := test.run(measured, influences)) is not None]
    tests = [test._replace(rule=rule or DEFAULT_RULES[test.standard]) for test in tests]
    if measured.none_held_out:
        held_out = (
            "All data were used to calibrate the arm; measure sockets and lengths that were not used for the "
            "calibration."
        )
        tests = [test._replace(missing=(held_out, *test.missing)) for test in tests]
    present = {metric.name for test in tests for metric in test.metrics}
    for name in given:
        if name not in present:
            held_out = "held-out " if measured.identified_from else ""
            raise InputError(
                f"a limit is given for {name} ({METRICS[name]}), but the capture has no {held_out}data for this "
                "metric; remove the limit."
            )
    return [
        test._replace(metrics=tuple(_decided(metric, given.get(metric.name), test.rule) for metric in test.metrics))
        for test in tests
    ]


def checked_limits(limits: Mapping[str, Limit | float]) -> dict[str, Limit]:
    """Limits by the name of a metric, numbers made into `Limit`; `InputError` for an unknown metric or a bad limit."""
    by_name = {}
    for name, limit in limits.items():
        if name not in METRICS:
            raise InputError(f"there is no metric '{name}'{without_test(name, list(METRICS))}")
        fixed, divisor = limit if isinstance(limit, Limit) else (limit, math.inf)
        what = f"the limit of {name}"
        by_name[name] = checked_limit(Limit(float(checked(fixed, Millimetres, what)), divisor), what)
    return by_name


def _checked(measured: Measured) -> Measured:
    sockets = {name: points_of(points, f"the points of socket '{name}'") for name, points in measured.sockets.items()}
    for length in measured.lengths:
        for end in (length.start, length.end):
            if end not in sockets:
                raise InputError(
                    f"length '{length.start}' to '{length.end}' names the unknown socket '{end}'{nearest(end, sockets)}"
                )
    spheres = tuple(checked_sphere(sphere, 3) for sphere in measured.spheres)
    for name, points in (*sockets.items(), *((sphere.name, group) for sphere in spheres for group in sphere.groups)):
        if np.abs(points).max() > _FARTHEST:
            raise InputError(f"'{name}' has a coordinate beyond {_FARTHEST:g} mm; give points in mm.")
    size = measured.measuring_range
    if size is not None and not 0 < size <= 2 * _FARTHEST:
        raise InputError(f"measuring_range is {size:g} mm; give the diameter of the maker's measuring volume in mm.")
    return measured._replace(sockets=sockets, spheres=spheres)


def _decided(metric: Metric, limit: Limit | None, rule: Rule) -> Metric:
    if limit is None:
        return metric
    values = []
    for value in metric.values:
        if value.length is None and math.isfinite(limit.divisor):
            raise InputError(
                f"the limit of {metric.name} grows with a length, but the metric does not measure a length; give a "
                "constant limit."
            )
        most = limit.at(value.length or 0.0)
        values.append(value._replace(limit=most, decision=decide(value.value, most, value.expanded, rule)))
    return metric._replace(values=tuple(values))


class EvaluationRecord(NamedTuple):
    """A calibrated arm and the capture it is evaluated on; the metrics follow from these.

    Example:
        >>> evaluation = aj.evaluate_capture(record, aj.Recording(two_bars, nominal), standards=["asme"])
        >>> print([test.title for test in evaluation.acceptance()["calibrated"]])
        ['single-point articulation', 'volumetric']
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
    calibration_unusable: str | None = None  # why the calibration is not to be used, if it is not
    influences: Influences = NO_INFLUENCES
    rule: Rule | None = None  # None: that of each standard

    def arms(self) -> dict[str, ArmSpecification]:
        """The nominal arm, the arm as found, where that is known, and the calibrated arm."""
        as_found = self.recording.as_found
        before = {} if as_found is None else {"as_found": as_found}
        return {"nominal": self.recording.nominal, **before, "calibrated": self.calibrated}

    def evaluations(self, capture: Capture) -> dict[str, Evaluation]:
        """These arms on a capture. Only the calibrated one is weighted by the noise of the calibration, and keeps
        geometry: the nominal arm's errors are not that noise, and weighted by it, or with a geometry that is not its
        own, its distances would not be the least that it reaches."""
        noise, kept = None, None
        if self.uncertainty is not None and capture.observations:
            noise, kept = self.uncertainty.noise, self.uncertainty.kept
        kept = None if kept is None else kept.select(Observed.of(capture, None).blocks)
        geometry = None if kept is None else kept.parts
        return {
            stage: evaluate(specification.arm, capture, noise=noise, geometry=geometry)
            if stage == "calibrated"
            else evaluate(specification.arm, capture)
            for stage, specification in self.arms().items()
        }

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


def check_geometry(arm: Arm, capture: Capture, kept: Collection[str] = ()) -> None:
    """Raise `InputError` where observations do not determine their own unknowns, except for parts that are kept."""
    parts = [part for part in capture.observations if not set(unknowns_of(part)) <= set(kept)]
    if not parts and not capture.names:
        return
    capture = Capture(capture.sockets, capture.lengths, parts) if len(parts) < len(capture.observations) else capture
    space = to_numpy(Parameters(arm, ("d_1",)))
    check_observed(Observed.of(capture, arm), space, np.asarray(space.vector()), 0)


def unstated_uncertainty_warning(tests: Sequence[AcceptanceTest]) -> list[str]:
    """A sentence on metrics that were decided although no uncertainty was stated for them, if there are any."""
    metrics = (metric for test in tests for metric in test.metrics)
    names = [metric.name for metric in metrics if metric.decision is not None and metric.worst.expanded == 0]
    sentence = (
        f"No uncertainty was stated for {', '.join(names)}, so the decision uses U = 0; state the contribution of "
        "seat and fixture (--test-u-mm) and the temperatures (--expansion)."
    )
    return [sentence] if names else []


def same_arm(first: Arm, second: Arm) -> bool:
    """Whether two arms have the same parameters; without beta it is 0. A model of its joints may come
    with a calibration."""

    def parameters(arm: Arm) -> Geometry:
        plain = arm.geometry._replace(coefficients=None, gravity=None, corrections=None, beside=None)
        return plain._replace(beta=np.zeros(arm.joints) if arm.beta is None else arm.beta)

    return jax.tree.all(jax.tree.map(np.array_equal, parameters(first), parameters(second)))
