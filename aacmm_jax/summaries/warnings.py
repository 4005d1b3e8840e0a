"""Warnings about a capture or a calibration: one sentence each, the most serious first."""

import math
from collections.abc import Iterator

import numpy as np

from ..calibration.record import REPEATABILITY, CalibrationRecord, record_of
from ..calibration.results import Calibration, Identification, active_names, plausible
from ..calibration.scale_anchor import scale_set_by_clause
from ..core.numpy_or_jax import to_numpy
from ..core.text import shorten
from ..core.units import INCH, UM, M
from ..data.capture import Capture
from ..data.noise import Noise, tip_covariances
from ..data.recording import Recording
from ..diagnostics.contradictions import session_metrics
from ..diagnostics.model_errors import ModelTests, model_tests
from ..kinematics.chain import joint_motion, reading_units
from ..kinematics.parameters import ArmSpecification, Bounds, Parameters
from ..model.metrics import pose_outliers
from ..uncertainty.identifiability import Observability, observability
from .contradictions import contradictions, removals
from .likely_cause import likely_cause
from .model_errors import sentence_of_noisy_encoders, sentences_of_tests
from .validation import contradicted_prediction

_SUSPICIOUS_SCALE = 0.005  # of a fixed link: beyond it the nominal value or a reference length is wrong
_TOLERANCE = math.radians(0.01)  # beyond a limit: more than the noise of any encoder
_APART = 5.0  # RMS of a session among others, over that which it has alone, beyond which they are not of one arm
_EXACT = 1e-6  # mm: smaller residuals are rounding errors of a simulation without noise
# mm. An interferometer reaches 0.1 um in a metre; seats, probes and trackers of arms are far from it. Beyond 1 mm a
# length or point says less than the nominal arm does.
_SMALLEST_U, _LARGEST_U = 1e-4, 1.0
_TRY_ALL = "aacmm arm ARM --check MANIFEST tries every order and sign of the columns, and the zeros of the joints."
# By k, which is a length measured by the nominal arm over its reference value: one in m, read as mm, makes k = 1000.
_MISTAKEN_UNITS = {
    M: "are the reference lengths in m by mistake?",
    10.0: "are the reference lengths in cm by mistake?",
    INCH: "are the reference lengths in inches by mistake?",
    1 / M: "is the arm in m, or are the reference lengths in um by mistake?",
    1 / 10.0: "is the arm in cm by mistake?",
    1 / INCH: "is the arm in inches by mistake?",
}


def of_capture(recording: Recording) -> list[str]:
    """Of what was recorded: readings outside the arm's limits (a wrong unit, or exchanged columns), and exact lengths.

    A simulation keeps within the limits but for its noise.
    """
    found = []
    q, units = np.asarray(recording.capture.readings), reading_units(recording.nominal.arm.geometry)
    for joint, limits in enumerate(recording.nominal.arm.limits or () if recording.true is None else ()):
        tolerance = _TOLERANCE * units[joint]
        outside = int(np.sum((q[:, joint] < limits[0] - tolerance) | (q[:, joint] > limits[1] + tolerance)))
        if outside:
            slides = joint + 1 in recording.nominal.arm.prismatic
            low, high = (f"{x if slides else math.degrees(x):.0f}" for x in limits)
            found.append(
                f"Joint {joint + 1}: {outside} of {len(q)} readings lie outside its limits, {low} to {high} "
                f"{'mm' if slides else 'deg'}; "
                "is the unit right, and the order of the columns?"
            )
    found += recording.capture.repeated.sentences()
    exact = [f"{length.start} - {length.end}" for length in recording.capture.lengths if float(length.u) == 0]
    if exact and recording.true is None:
        found.append(f"Taken as exact, because u is 0: {shorten(exact)}; give the standard uncertainty of each length.")
    return found + ([] if recording.true is not None else _implausible_uncertainties(recording.capture))


def _implausible_uncertainties(capture: Capture) -> list[str]:
    """Of standard uncertainties that nothing which measures arms has: most likely of another unit than mm."""
    small, large = [], []
    for where, values in _uncertainties(capture):
        positive = values[values > 0]
        if len(positive) and positive.min() < _SMALLEST_U:
            small.append(f"{where} (u = {positive.min() / UM:.3g} um)")
        if len(positive) and positive.max() > _LARGEST_U:
            large.append(f"{where} (u = {positive.max() / UM:,.0f} um)")
    found = []
    if small:
        found.append(f"Less than 0.1 um is hardly ever reached: {shorten(small)}; u is in mm, was it given in m?")
    if large:
        found.append(f"More than 1 mm says next to nothing: {shorten(large)}; u is in mm, was it given in um?")
    return found


def _uncertainties(capture: Capture) -> Iterator[tuple[str, np.ndarray]]:
    """What has standard uncertainties of lengths or coordinates, by its table in a manifest, and these, mm."""
    for length in capture.lengths:
        yield f"[[length]] {length.start} - {length.end}", np.atleast_1d(np.asarray(length.u, dtype=float))
    for one in capture.observations:
        stored = one.stored()
        values = stored.get("u")
        if stored.get("covariance") is not None:
            values = np.sqrt(np.diagonal(np.asarray(stored["covariance"]), axis1=-2, axis2=-1))
        if values is not None:
            yield f"[[{one.table}]] {one.name}", np.atleast_1d(np.asarray(values, dtype=float)).ravel()


def of_import(recording: Recording) -> list[str]:
    """Of a capture before any calibration: as `of_capture`, after the likely cause where the nominal arm is far off."""
    cause = likely_cause(recording.nominal.arm, recording.capture) if recording.true is None else ""
    return [*([cause] if cause else []), *of_capture(recording)]


def warnings_of(
    result: Calibration | Identification, capture: Capture, *, class_noise: Noise | None = None
) -> list[str]:
    """What should be read about a calibration before its numbers: one sentence each, the most serious first.

    The command line prints the same. The numbers behind the tests of model and noise: `diagnostics.model_tests`.

    Args:
        result: What `calibrate` or `identify` returned.
        capture: What it was calibrated from.
        class_noise: Noise that is usual for this class of arms, for a calibration whose noise was estimated.

    Returns:
        The sentences; none where nothing is to be said.

    Example:
        >>> for sentence in aj.warnings_of(result, capture):
        ...     print(sentence)
        One reference length fixes the scale, so its own error is no check; keep another for checking.
    """
    record = record_of(result, Recording(capture, ArmSpecification(result.space.base)))
    return of_calibration(record, tests=model_tests(record, class_noise=class_noise))


def of_calibration(
    record: CalibrationRecord, seen: Observability | None = None, tests: ModelTests | None = None
) -> list[str]:
    """What should be read about a calibration before its numbers; ``seen`` is the result of `observed`, and ``tests``
    that of `model_tests`, if known."""
    if not record.plausible_scale:  # a wrong unit, say: what was fitted and predicted with it says nothing
        ended = [] if record.reason.startswith("Converged") else [record.reason]
        return [*_scale(record), *ended, *_implausible(record), *of_capture(record.recording)]
    found = [] if record.converged else [record.reason]
    found += removals(record)
    found += _implausible(record)
    found += contradictions(record)
    if record.noisy_encoders:
        slides, given = record.calibrated.arm.prismatic, record.given_noise is not None
        found.append(sentence_of_noisy_encoders(record.noisy_encoders, slides, given))
    found += [] if record.validation is None else contradicted_prediction(record.validation)
    if not record.implausible_residual:
        tests = model_tests(record) if tests is None else tests
        found += sentences_of_tests(tests, record.final_method, record.shared, record.calibrated.arm)
    if record.recording.capture.observations:
        found += [*_on_bounds_observed(record), *_scale(record), *of_capture(record.recording)]
        seen = observed(record) if seen is None else seen
        return found if record.implausible_residual else found + _identifiability(record, seen)
    found += [*_scale(record), *_not_divided(record), *of_capture(record.recording)]
    seen = observed(record) if seen is None else seen
    if record.implausible_residual:
        return found + _data(record)  # bounds and uncertainties of such a solve say nothing
    return [*found, *_bounds(record, seen), *_data(record), *_identifiability(record, seen)]


def _on_bounds_observed(record: CalibrationRecord) -> list[str]:
    """Of a calibration with observations besides sockets."""
    sentences = []
    sides = _sides(record)
    if _many_on_bounds(record) and not record.implausible_residual:
        sentences.append(_on_bounds(record, sides))
    elif sides:
        sentences.append(
            f"On a bound: {shorten(sides)}; fix what the data hardly determine (--held), or widen the bounds. Every "
            "uncertainty takes these values as exact."
        )
    return sentences


def observed(record: CalibrationRecord) -> Observability:
    """What the data of a calibration determine about the calibrated arm, given its noise and bounds."""
    arm, capture = record.calibrated.arm, record.recording.capture
    geometry, noise = to_numpy((arm.geometry, record.noise))
    covariances = tip_covariances(geometry, joint_motion(geometry, np.asarray(capture.readings)), noise)
    sigma = float(np.sqrt(np.trace(np.asarray(covariances)).mean() / 3))
    space = Parameters(arm, record.names)
    known = () if record.prior is None else record.prior.known
    return observability(
        arm, capture, space, sigma=sigma, bounds=Bounds(space, record.lower, record.upper), known=known
    )


def _implausible(record: CalibrationRecord) -> list[str]:
    """A residual that no arm has: the solve ended at a minimum, but of data that do not belong to this arm."""
    if not record.implausible_residual:
        return []
    most = f"more than the {record.largest_plausible_residual:.2g} mm that are plausible for this arm"
    if record.recording.capture.observations:
        worst = int(np.argmax(record.observed.rms_after))
        name, rms = record.observed.names[worst], record.observed.rms_after[worst]
        return [
            f"Poses of {name} are {rms:.3g} mm RMS from their geometry, {most}, so data and arm do not belong "
            "together: check columns, units, signs and the arm." + _cause(record)
        ]
    rms = float(record.evaluations()["calibrated"].repeatability.rms)
    return [
        f"The poses of a socket disagree by {rms:.3g} mm RMS, {most}, so data and arm do not belong together: check "
        "the files, their columns and unit, the sockets and the arm." + _cause(record)
    ]


def does_not_fit(record: CalibrationRecord) -> bool:
    """Whether so many parameters are on a bound that the arm is not that of the data, or sessions of one arm are far
    worse together than each alone."""
    metrics = session_metrics(record).values()
    return _many_on_bounds(record) or any(together > _APART * max(alone, _EXACT) for _, together, alone in metrics)


def _many_on_bounds(record: CalibrationRecord) -> bool:
    anchored = record.hold is not None or bool(record.recording.capture.observations)
    return len(_sides(record)) >= len(record.names) / 3 and anchored


def _on_bounds(record: CalibrationRecord, sides: list[str]) -> str:
    return (
        f"{len(sides)} of {len(record.names)} parameters are on a bound, so the arm does not fit the data: "
        "check unit, order of columns, sockets and arm." + _cause(record)
    )


def _cause(record: CalibrationRecord) -> str:
    cause = likely_cause(record.recording.nominal.arm, record.recording.capture)
    return f" {cause or _TRY_ALL}"


def _scale(record: CalibrationRecord) -> list[str]:
    k = record.k
    if record.method == REPEATABILITY and not record.scale_set_by:
        return [
            "The scale is that of the nominal arm, and every uncertainty takes it as exact: lengths are wrong by as "
            "much as it is." + (f" By the reference lengths, k = {k:.6f}." if math.isfinite(k) else "")
        ]
    if not math.isfinite(k):
        return []
    stage1 = _sides(record)
    if not plausible(k):
        mistakes = (question for ratio, question in _MISTAKEN_UNITS.items() if abs(k / ratio - 1) < 0.1)
        hint = next(mistakes, "check units, sockets, lengths and arm.")
        return [f"k = {k:.6g} cannot be the scale of this arm; {hint}"]
    fixed = record.scale_set_by
    if fixed and record.method == "two-stage":
        return [
            f"{scale_set_by_clause(fixed)}, so the reference lengths changed nothing: by them the arm is "
            f"{k:.6f} times too large (u = {record.u_k:.2g}). "
            "Free one of these lengths, or use both with the joint solve (--method joint)."
        ]
    if record.hold is None and stage1 and not fixed:
        word = "shrank" if k < 1 else "stretched"
        return [
            f"Stage 1 ran with every length free and {word} the arm to k = {k:.5f} until a bound stopped it: "
            f"{shorten(stage1)}. The scale fix undoes that; hold a length (--hold) to avoid it. The uncertainty of k "
            "takes these bounds as exact."
        ]
    if record.hold is not None and abs(k - 1) > max(_SUSPICIOUS_SCALE, 3 * record.u_k):
        return [
            f"k = {k:.5f} is far from 1: is {record.hold} at its nominal value, and is each reference length right?"
        ]
    return []


def _not_divided(record: CalibrationRecord) -> list[str]:
    if not record.against_division:
        return []
    return [
        f"The division by k was not possible because of {shorten(record.against_division)}; poses and reference "
        "lengths were solved jointly instead."
    ]


def _bounds(record: CalibrationRecord, seen: Observability) -> list[str]:
    sides = _sides(record)
    if not sides or (record.hold is None and len(sides) < len(record.names) / 3):
        return []
    if len(sides) >= len(record.names) / 3:
        return [_on_bounds(record, sides)]
    traded = {name for trade_off in seen.trade_offs for name in trade_off.names}
    weak = [side for side in sides if side.split(" ")[0] in traded]
    others = [side for side in sides if side not in weak]
    found = []
    if weak:
        found.append(
            f"On a bound because the data hardly determine them: {shorten(weak)}; fix one parameter of each "
            "combination named below (--held), and do not widen the bounds. Until then the width of the bounds is part "
            "of their uncertainties."
        )
    if others:
        found.append(
            f"On a bound: {shorten(others)}; widen the bounds unless they are known limits. Every uncertainty, "
            "that of k too, takes these values as exact."
        )
    return found


def _data(record: CalibrationRecord) -> list[str]:
    capture = record.recording.capture
    evaluation = record.evaluations()["calibrated"]
    distances, owner = np.asarray(evaluation.distances), capture.owner
    first = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    found = []
    far, typical = pose_outliers(distances, capture.sizes)
    if len(far):
        worst = sorted(far, key=lambda i: -distances[i])
        names = [f"{capture.names[owner[i]]} pose {i - first[owner[i]] + 1} ({distances[i]:.3g} mm)" for i in worst]
        found.append(
            f"Poses far from their socket, where {typical:.2g} mm is typical: {shorten(names)}; was the tip seated?"
        )
    surplus = 3 * sum(size - 1 for size in capture.sizes) - (len(record.names) - 1)
    if surplus < (len(record.names) - 1) / 2:
        found.append(
            f"Only {surplus} more equations than unknowns, which makes the residuals small whatever the errors are; "
            "record more poses."
        )
    if len(capture.lengths) == 1 and record.method != REPEATABILITY and not record.scale_set_by:
        found.append("One reference length fixes the scale, so its own error is no check; keep another for checking.")
    return found


def _identifiability(record: CalibrationRecord, seen: Observability) -> list[str]:
    found = seen.sentences()
    weak = [name for name, known in zip(record.names, record.determined, strict=True) if not known]
    # Named above are those that the same capture could not determine without noise either, and near-degenerate ones.
    named = {record.names[i] for i in np.flatnonzero(np.abs(seen.null).max(axis=1, initial=0.0) > 1e-3)}
    named |= {name for trade_off in seen.trade_offs for name in trade_off.names}
    weak = [name for name in weak if name not in named]
    if weak:
        found.append(
            f"Determined only together, hardly one by one: {shorten(weak, 12)}. Tips and lengths that follow from them "
            "have an uncertainty, but these have none of their own; fix the redundant ones (--held)."
        )
    u, width = np.sqrt(np.diag(record.covariance)), (record.upper - record.lower) / 2
    loose = [
        name
        for i, name in enumerate(record.names)
        if record.determined[i] and name not in named and u[i] > (0.5 * width[i] if np.isfinite(width[i]) else np.inf)
    ]
    if loose:
        found.append(
            f"Hardly determined, with a standard uncertainty over half of what the bounds allow: {shorten(loose)}; "
            "fix some (--held), or record poses that separate them."
        )
    return found


def _sides(record: CalibrationRecord) -> list[str]:
    space = Parameters(record.recording.nominal.arm, record.names)
    return [f"{name} ({side})" for name, side in active_names(space, record.active_stage1).items()]
