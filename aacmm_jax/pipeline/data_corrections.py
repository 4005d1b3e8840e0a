"""What `calibrate_capture` and `evaluate_capture` correct in data that nobody stated otherwise: a prior and noise for
data that are too few, and readings that are not those of the arm as they are."""

from typing import Any

import equinox as eqx
import numpy as np

from ..calibration.evaluation import evaluate
from ..calibration.record import CalibrationRecord
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..core.text import listed
from ..core.units import DEG, length_unit
from ..data.capture import Capture
from ..data.noise import CLASSES, ArmNoise, class_noise
from ..data.observations.measured import MeasuredPoints
from ..data.observations.observation import AbstractObservation, stated_u
from ..data.observations.pixels import Pixels
from ..data.recording import RecordedAs, Recording
from ..diagnostics.capture_check import check_capture, fits_as_recorded
from ..diagnostics.reading_check import explanation_words
from ..diagnostics.reading_fit import Explanation
from ..diagnostics.reading_search import Hypothesis
from ..diagnostics.recorded import LARGEST_U, SMALLEST_U
from ..diagnostics.usability import many_on_bounds
from ..kinematics.arm import Arm
from ..kinematics.priors import default_prior
from ..model.observed import Observed
from .automatic import Record, Solve

# More equations than unknowns with which the residuals show the noise: with fewer, the factor by which Student's t
# widens every U exceeds 2.8, and a fit without a prior follows the noise.
_SPARE = 5
_ROBOT = "robot"


def with_prior_of_few(recording: Recording, options: Any) -> tuple[Recording, Any, tuple[str, ...]]:
    """The recording and the options of `calibrate_capture` for data that are too few to determine all free parameters
    and the noise: with the prior of a real arm, and the noise that is usual for it; and what was decided, in words.

    In simulated captures of 5 to 10 points, the error of the calibrated arm elsewhere is 0.7 to 0.06 of the nominal
    arm's; without a prior these captures cannot be calibrated, or follow the noise. The noise of an arm whose class is
    not known is taken as a robot's, which is the larger one.
    """
    nominal, capture = recording.nominal, recording.capture
    observed, parameters = Observed.of(*to_numpy((capture, nominal.arm))), len(nominal.space().names)
    unknowns = parameters + len(observed.steps)
    stated = options.prior is None or options.method is not None or options.robust is not None
    if observed.equations >= unknowns + _SPARE or stated:
        return recording, options, ()
    if nominal.prior is not None and options.noise is not None:
        return recording, options, ()
    parts, usual = [], recording.usual
    if nominal.prior is None:
        nominal = nominal._replace(prior=default_prior(nominal.arm))
        parts.append("the parameters have the prior of a real arm (1 mm and 1 mrad, adjusted to the data)")
    if options.noise is None:
        usual = usual or ArmNoise(_ROBOT, class_noise(nominal.arm, _ROBOT), CLASSES[_ROBOT].source)
        options = options._replace(noise=usual.noise)
        parts.append(f"the readings the noise of a {usual.arm_class} ({usual.source})")
    says = (
        f"There are {observed.equations} equations for {unknowns} unknowns ({parameters} parameters), so "
        f"{' and '.join(parts)}. Record more poses, or state a prior (--prior) and the noise (--encoder-arcsec, "
        "--seating-mm)."
    )
    return recording._replace(nominal=nominal), options, (says,)


def camera_fits(recording: Recording) -> bool:
    """Whether what cameras saw fits the arm as it is nominally, as far as that can be told; true without a camera."""
    if not any(isinstance(part, Pixels) for part in recording.capture.observations):
        return True
    try:
        return fits_as_recorded(recording.nominal.arm, recording.capture, recording.usual)
    except InputError:  # too few poses
        return True


def with_corrected_readings(
    record: CalibrationRecord, solve: Solve, recorded: Record
) -> tuple[CalibrationRecord, Explanation | None]:
    """The calibration with other orders, signs, zeros or units of the readings, where the data do not match the arm as
    they are, a single such explanation makes them match, and nothing else is as good; and the explanation.

    The zeros become those of the nominal arm, so that the calibrated arm holds them. Where several explanations are
    as good, or one changes what somebody stated, a sentence says so and nothing is changed.
    """
    if not (record.implausible_residual or many_on_bounds(record) or not record.converged):
        return record, None
    recording = record.recording
    try:
        if fits_as_recorded(recording.nominal.arm, recording.capture, recording.usual):
            return record, None
        check = check_capture(recording.nominal.arm, recording.capture, recording.usual)
    except InputError:  # neither sockets nor points, or too few
        return record, None
    best = check.best
    if not check.explained or check.fits:
        return record, None
    if check.others:
        texts = [explanation_words(other) or "nothing" for other in (best, *check.others[:2])]
        says = f"The readings do not match the arm, and several corrections fit as well: {'; or '.join(texts)}."
        return record._replace(decisions=(*record.decisions, f"{says} State the right one in [angles].")), None
    if stated := _stated(recording, best):
        says = (
            f"The readings match the arm if {explanation_words(best)}. They were not corrected, because this differs "
            f"from what is stated: {listed(stated)}."
        )
        return record._replace(decisions=(*record.decisions, says)), None
    capture = corrected_capture(recording.capture, best)
    if capture is None:
        return record, None
    nominal = recording.nominal._replace(arm=_with_zeros(recording.nominal.arm, best))
    as_recorded = recording.read_as or range(1, len(best.order) + 1)
    read_as = tuple(sign * as_recorded[column] for sign, column in zip(best.signs, best.order, strict=True))
    written = None if recording.recorded_as is None else recorded_as_corrected(recording.recorded_as, best)
    corrected = recording._replace(capture=capture, nominal=nominal, read_as=read_as, recorded_as=written)
    try:
        again = recorded(solve(corrected), corrected)
    except InputError:
        return record, None
    if again.implausible_residual or not again.converged:
        return record, None
    says = (
        f"The readings were corrected: {explanation_words(best)}. The residuals fell from {record.observed.rms:.3g} to "
        f"{again.observed.rms:.3g} mm RMS. To state this in the manifest: {_line(best)}."
    )
    return again._replace(decisions=(*record.decisions, says)), best


def with_readings_of_arm(
    record: CalibrationRecord, capture: Capture, stated: tuple[str, ...]
) -> tuple[Capture, tuple[str, ...]]:
    """A capture to evaluate a calibration on, with the order, signs and units of its readings with which they match the
    calibrated arm, where they do not as they are and a single explanation makes them match; and what was found.

    Zeros are not corrected: another zero than at the calibration is an error of the arm. Neither is what somebody
    ``stated`` (`Recording.stated`).
    """
    observed = evaluate(record.calibrated.arm, capture, noise=record.noise).observed
    assert observed is not None
    poses = [*capture.sizes, *(observation.q.shape[0] for observation in capture.observations)]
    rms = float(np.sqrt(np.average(np.asarray(observed.rms) ** 2, weights=poses)))
    if rms <= record.largest_plausible_residual:
        return capture, ()
    try:
        # By the nominal arm, for which explanations that are the same by its symmetry are one.
        check = check_capture(record.recording.nominal.arm, capture, record.recording.usual)
    except InputError:  # neither sockets nor points, or too few
        return capture, ()
    best, corrected = check.best, corrected_capture(capture, check.best)
    if not check.explained or check.fits or check.others or corrected is None:
        return capture, ()
    if any(best.offsets) or set(best.hypothesis.changed) & set(stated):
        return capture, (f"The readings do not match the calibrated arm, unless {explanation_words(best)}.",)
    says = f"The readings were corrected to match the calibrated arm: {explanation_words(best)}."
    return corrected, (f"{says} To state this in the manifest: {_line(best)}.",)


def corrected_capture(capture: Capture, explanation: Explanation) -> Capture | None:
    """The capture with the order, signs and units of an explanation, without its zeros; None where a unit of lengths is
    wrong and there are other lengths than measured points, which may be in another unit."""
    factor = explanation.length
    others = [part for part in capture.observations if not isinstance(part, MeasuredPoints)]
    if factor != 1 and (others or capture.sizes):
        return None

    def readings(q: Any) -> np.ndarray:
        values, n = np.array(q), len(explanation.order)
        values[:, :n] = _without_zeros(explanation).readings(values[:, :n])
        return values

    def changed(part: AbstractObservation) -> AbstractObservation:
        if factor == 1:
            return part.changed(q=readings(part.q))
        assert isinstance(part, MeasuredPoints)
        # A u is in mm, whatever the unit of the points, unless it cannot be.
        u = stated_u(part)
        of_u = 1.0 if len(u) and u.min() >= SMALLEST_U and u.max() <= LARGEST_U else factor
        covariance = of_u**2 * np.asarray(part.covariance)
        return part.changed(q=readings(part.q), points=factor * np.asarray(part.points), covariance=covariance)

    parts = tuple(changed(part) for part in capture.observations)
    return eqx.tree_at(lambda c: (c.q, c.observations), capture, (readings(capture.q), parts))


def _without_zeros(explanation: Explanation) -> Hypothesis:
    """The order, signs and units of an explanation."""
    return explanation.hypothesis._replace(offsets=(0.0,) * len(explanation.order))


def recorded_as_corrected(written: RecordedAs, explanation: Explanation) -> RecordedAs:
    """How readings are written whose order, signs and units were corrected by an explanation."""
    correct = _without_zeros(explanation).readings
    constants = correct(written.constants[None])[0]
    factors = (correct(written.factors.T + written.constants) - constants).T
    unit = written.unit if explanation.angle == 1 else ("deg" if explanation.angle < 1 else "rad")
    return written._replace(unit=unit, factors=factors, constants=constants)


def _stated(recording: Recording, explanation: Explanation) -> list[str]:
    """What an explanation would change of what somebody stated: in the manifest, or of the zeros by options or the
    arm's file."""
    keys = {
        name: f"{name} of [angles]" if name != "units" else "units of the points"
        for name in explanation.hypothesis.changed
    }
    stated = [text for name, text in keys.items() if name in recording.stated]
    nominal, zeros = recording.nominal, [f"theta_{i}" for i, zero in enumerate(explanation.offsets, start=1) if zero]
    if zeros and "bounds" in nominal.stated:
        stated.append(f"bounds of {listed(zeros)}")
    elif "parameters" in nominal.stated:
        fixed = [name for name in zeros if name not in nominal.space().names]
        stated += [f"{listed(fixed)} as fixed"] if fixed else []
    return stated


def _with_zeros(arm: Arm, explanation: Explanation) -> Arm:
    """The arm whose zeros are where an explanation has them, with joint limits of the readings that it is given."""
    offsets = np.asarray(explanation.offsets)
    limits = arm.limits
    if limits is not None:
        limits = (np.asarray(limits) - offsets[:, None]).tolist()
    return arm.replace(theta=np.asarray(arm.theta) + offsets, limits=limits)


def _line(explanation: Explanation) -> str:
    """What a manifest states in ``[angles]`` so that it reads the columns so, if it states nothing of these yet."""
    order, signs, offsets, angle, length = explanation[:5]
    unit = "" if angle == 1 else ("deg" if angle < 1 else "rad")
    parts = [f'unit = "{unit}"'] * bool(unit)
    if order != tuple(sorted(order)):
        parts.append(f"columns in the order {listed([str(column + 1) for column in order])}")
    if min(signs) < 0:
        parts.append(f"sign = {list(signs)}")
    if any(offsets):
        # A reading c becomes sign (c - offset).
        zeros = [round(-sign * offset / DEG, 4) + 0.0 for sign, offset in zip(signs, offsets, strict=True)]
        parts.append(f"offset = {zeros} (deg)")
    lines = [f"[angles] {', '.join(parts)}"] if parts else []
    if length != 1:
        points = length_unit(length)
        lines.append(f"measured points times {length:g}" if points is None else f'units = {{ points = "{points}" }}')
    return " and ".join(lines)
