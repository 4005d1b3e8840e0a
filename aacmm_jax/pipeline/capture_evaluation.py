"""A calibration evaluated on a capture, and points judged, as ``aacmm evaluate`` does it.

One call each, whose options state their defaults once.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..acceptance.judgement import Influences, Limit, Rule
from ..acceptance.record import (
    NO_INFLUENCES,
    SIMULATED,
    EvaluationRecord,
    Millimetres,
    PointsRecord,
    check_geometry,
    checked_limits,
    same_arm,
    unstated_uncertainty_warning,
)
from ..acceptance.results import Measured
from ..acceptance.standards import OF_SPHERES, STANDARDS, checked_standards
from ..calibration.pose_table import noise_of_poses
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.arguments import NotNegative, OneOf, checked_arguments, with_options
from ..core.blas_threads import one_blas_thread
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..core.text import listed, shorten
from ..data.capture import Capture, as_read_by
from ..data.recording import Recording
from ..diagnostics.findings import findings_of, sentences
from ..diagnostics.usability import why_unusable
from ..kinematics.arm import Arm
from ..model.observed import Observed
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.kept_geometry import KeptGeometry
from ..uncertainty.linearisation import Linearisation
from .data_corrections import with_readings_of_arm

_LEAST = 1e-6  # mm: smallest standard uncertainty of what is certified


class EvaluationOptions(NamedTuple):
    """How `evaluate_capture` and `evaluate_points` judge: their keyword arguments, described there, and their defaults.

    Example:
        >>> options = aj.pipeline.EvaluationOptions(only=["A", "B"], limits={"Deltam": 0.1})
        >>> evaluation = aj.evaluate_capture(record, aj.Recording(two_bars, nominal), **options._asdict())
        >>> print(evaluation.recording.capture.names)
        ('A', 'B')
    """

    only: Sequence[str] | str | None = None
    without: Sequence[str] | str = ()
    limits: Mapping[str, Limit | float] = MappingProxyType({})
    u_test: Millimetres = 0.0
    influences: Influences = NO_INFLUENCES
    rule: Rule | None = None
    standards: Sequence[str] | None = None
    measuring_range: float | None = None
    maxima: Mapping[str, NotNegative] = MappingProxyType({})
    calibration_warnings: Sequence[str] | None = None
    keep: Sequence[str] = ()


@checked_arguments
@with_options(EvaluationOptions)
@one_blas_thread
def evaluate_capture(record: CalibrationRecord, recording: Recording, **options: Any) -> EvaluationRecord:
    """Evaluate a calibration on a capture: what ``aacmm evaluate`` does, with the same defaults.

    A socket counts as identified from if the calibration used any of its poses. Of another observation, the poses that
    it did not use are held out, as far as they determine their geometry: that is fitted to the arm. Readings in another
    order, with other signs or units than those of the calibrated arm are corrected where a single such explanation
    makes them match; a warning says so.

    Args:
        record: the calibration.
        recording: the capture; its nominal arm should be that of the calibration.
        only: names or shell patterns of the sockets and observations to evaluate, as for `Capture.select`; None, all.
        without: names or shell patterns of those to leave out.
        limits: MPE of metrics, mm, as for `acceptance.run`.
        u_test: standard uncertainty that seat and fixture add to every test value, mm.
        influences: what else adds to it, as for `acceptance.run`.
        rule: decision rule, as for `acceptance.run`.
        standards: standards whose acceptance tests are run: "jjf", "asme", "iso". By default those whose procedure the
            recording was made for. Tests with a limit are run in any case.
        measuring_range: diameter of the measuring volume as the maker states it, mm; by default the recording's.
        maxima: limits of the quantities in `acceptance.record.MAXIMA`, mm.
        calibration_warnings: what should be read about the calibration itself; by default it is tested again
            (`diagnostics.findings_of`).
        keep: geometry that is not fitted to the capture, but is as the calibration found it: "target", the place of a
            target in the last frame, which was not mounted anew; "frame", that of an instrument or artefact, neither
            of which nor the base has moved. The nominal arm has its own, fitted.

    Returns:
        The record, from which errors and acceptance tests follow; it has warnings on what makes it doubtful.

    Raises:
        InputError: an impossible limit, or one whose metric nothing can be measured for; observations that do not
            determine their own unknown geometry; options of acceptance tests where none is run.

    Example:
        >>> limits = {"Length": 0.1}
        >>> evaluation = aj.evaluate_capture(record, aj.Recording(two_bars, nominal), limits=limits)
        >>> for test in evaluation.acceptance()["calibrated"]:
        ...     print(test.title, test.decision)
        single point and length, as in Cheng et al. 2018 conforms
    """
    chosen = EvaluationOptions(**options)
    used = {row.tobytes() for row in np.asarray(record.recording.capture.readings)}
    capture = recording.capture.select(chosen.only, chosen.without)
    capture = as_read_by(capture, recording.nominal.arm, record.calibrated.arm)
    capture, corrected = with_readings_of_arm(record, capture, recording.stated)
    uncertainty = uncertainty_of(record)
    if chosen.keep:
        uncertainty = replace(uncertainty, kept=_kept(record, uncertainty, capture, chosen.keep))
    kept = () if uncertainty.kept is None else uncertainty.kept.names
    capture = _divided(record.calibrated.arm, capture, used, kept)
    check_geometry(record.calibrated.arm, capture, kept)
    readings = dict(capture.sockets) | {part.name: part.q for part in capture.observations}
    shared = {name: sum(row.tobytes() in used for row in np.asarray(q)) for name, q in readings.items()}
    made_for = (*recording.acceptance, *(OF_SPHERES[sphere.test] for sphere in recording.spheres))
    noted = chosen.calibration_warnings
    evaluation = EvaluationRecord(
        recording._replace(
            capture=capture,
            nominal=record.recording.nominal,
            as_found=recording.as_found or record.recording.as_found,
            measuring_range=chosen.measuring_range or recording.measuring_range,
        ),
        record.calibrated,
        frozenset(name for name, count in shared.items() if count),
        limits=checked_limits(chosen.limits),
        u_test=chosen.u_test,
        maxima=dict(chosen.maxima),
        standards=checked_standards(made_for if chosen.standards is None else chosen.standards),
        uncertainty=uncertainty,
        calibration_warnings=tuple(sentences(findings_of(record)) if noted is None else noted),
        calibration_unusable=why_unusable(record),
        influences=chosen.influences,
        rule=chosen.rule,
    )
    tests = evaluation.acceptance()["calibrated"]
    if not tests:
        _refuse_options_of_tests(chosen)
    partly = [
        f"{name} ({count} of {len(readings[name])} poses)"
        for name, count in shared.items()
        if 0 < count < len(readings[name])
    ]
    warnings = [*corrected, *_warnings(record, recording, evaluation, partly), *unstated_uncertainty_warning(tests)]
    return evaluation._replace(warnings=tuple(warnings))


@checked_arguments
@with_options(EvaluationOptions)
def evaluate_points(measured: Measured, **options: Any) -> PointsRecord:
    """Judge points that were measured elsewhere: what ``aacmm evaluate`` does with a manifest of points.

    Args:
        measured: the points of sockets and spheres, and the reference lengths, mm.
        options: as for `evaluate_capture`, like all arguments that are not named here; those that concern a calibration
            do not apply, and the acceptance tests of all standards are run by default.

    Returns:
        The record, from which the acceptance tests follow.

    Raises:
        InputError: options that do not apply, or a standard that is unknown.

    Example:
        >>> cone = aj.acceptance.Measured({"cone": result.arm.position(capture.sockets["A"])})
        >>> judged = aj.evaluate_points(cone, limits={"SPAT": 0.05}, rule="simple")
        >>> print([(metric.name, metric.decision) for test in judged.acceptance() for metric in test.metrics])
        [('Deltam', None), ('SPAT', 'conforms'), ('SPAT_2s', None)]
    """
    chosen = EvaluationOptions(**options)
    of_captures = chosen.maxima, chosen.without, chosen.keep, chosen.only, chosen.calibration_warnings
    if any(of_captures[:3]) or any(value is not None for value in of_captures[3:]):
        raise InputError(
            "--max-..., --only, --without and --keep (maxima, only, without, keep) do not apply to a manifest of "
            "points; name a calibration and a capture, or leave these options out."
        )
    return PointsRecord(
        measured._replace(measuring_range=chosen.measuring_range or measured.measuring_range),
        limits=chosen.limits,
        u_test=chosen.u_test,
        standards=checked_standards(STANDARDS if chosen.standards is None else chosen.standards),
        influences=chosen.influences,
        rule=chosen.rule,
    )


def _refuse_options_of_tests(chosen: EvaluationOptions) -> None:
    """Raise `InputError` where options are given that only acceptance tests use."""
    influences = chosen.influences
    given = {
        "--rule (rule)": chosen.rule is not None,
        "--test-u-mm (u_test)": chosen.u_test > 0 or influences.u > 0 or influences.u_relative > 0,
        "--expansion (influences)": influences.artefact is not None or influences.arm is not None,
        "--range-mm (measuring_range)": chosen.measuring_range is not None,
    }
    if any(given.values()):
        raise InputError(
            f"{shorten([name for name, there in given.items() if there])} applies to acceptance tests only, but the "
            "capture allows no acceptance test, or no test was requested; request a test with --acceptance "
            "(standards), or leave this option out."
        )


def _warnings(
    record: CalibrationRecord, recording: Recording, evaluation: EvaluationRecord, partly: Sequence[str]
) -> Iterator[str]:
    """What makes an evaluation doubtful; ``partly`` names what has poses that the calibration used, and others."""
    if evaluation.calibration_unusable:
        yield f"The calibration is not usable, so the results are meaningless: {evaluation.calibration_unusable}."
    if recording.true is not None:
        yield SIMULATED
    yield from evaluation.recording.capture.repeated.sentences()
    if partly:
        yield (
            f"The calibration used some of the poses of {', '.join(partly)}; the other poses of these sockets and "
            "observations are treated as used by the calibration, too."
        )
    nominal, given = record.recording.nominal.arm, recording.nominal.arm
    if record.decisions and given.joints == nominal.joints:  # zeros that the calibration has corrected
        given = given.replace(theta=nominal.theta)
    if not same_arm(given, nominal):
        yield (
            f"The capture is of '{recording.nominal.name}', but the calibration is of "
            f"'{record.recording.nominal.name}'; check that the arm is the same."
        )
    if not evaluation.independent:
        yield (
            "The calibration used all data of this capture, so the results are too favourable and are not a test; "
            "measure sockets or lengths that the calibration does not use."
        )


def _kept(record: CalibrationRecord, uncertainty: Uncertainty, capture: Capture, keep: Sequence[str]) -> KeptGeometry:
    """The geometry of the calibration that is kept. Raises `InputError` where calibration and capture have none."""
    kinds = {"target": ("offset of ", "orientation of "), "frame": ("frame of ",)}
    in_capture, found = Observed.of(capture, None).names, record.observed.geometry
    parts: list[str] = []
    for kind in keep:
        OneOf(kinds)(kind, "keep")
        of_kind, of_calibration = (
            [name for name in names if name.startswith(kinds[kind])] for names in (in_capture, found)
        )
        same = [name for name in of_kind if name in of_calibration]
        if not same:
            raise InputError(
                f"--keep {kind} (keep) needs a {kind} of the same name in both, but the calibration has "
                f"{listed(of_calibration or ['none'])}, and the capture has {listed(of_kind or ['none'])}; leave the "
                "option out, or rename the one in the capture."
            )
        parts += same
    complete = to_numpy(to_numpy(uncertainty).complete)
    observed = to_numpy(Observed.of(record.recording.capture, complete.arm))
    numbers = [np.asarray(record.observed.geometry[name]) for name in observed.blocks]
    z = np.concatenate([np.asarray(complete.space.vector()), *numbers])
    noise = noise_of_poses(complete)
    return KeptGeometry.of(Linearisation.at(observed, complete.space, z, noise=noise, least=_LEAST), parts)


def _divided(arm: Arm, capture: Capture, used: Collection[bytes], kept: Collection[str]) -> Capture:
    """With the poses of an observation that were not used as an observation of their own, where others were."""
    observations = []
    for observation in capture.observations:
        seen = np.array([row.tobytes() in used for row in np.asarray(observation.q)])
        parts = [observation]
        if seen.any() and not seen.all() and not any(observation.name in (r.start, r.end) for r in capture.lengths):
            unseen = observation.select(np.flatnonzero(~seen)).changed(name=f"{observation.name}, held out")
            try:
                check_geometry(arm, Capture({}, [], [unseen]), kept)
                parts = [observation.select(np.flatnonzero(seen)), unseen]
            except InputError:
                pass  # too few poses: the observation counts as identified from
        observations += parts
    return Capture(capture.sockets, capture.lengths, observations, capture.repeated)
