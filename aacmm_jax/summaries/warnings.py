"""What a user should know before trusting a capture or a calibration: one sentence each, the gravest first."""

import math

import numpy as np

from ..calibration.checks import plausible
from ..calibration.record import CalibrationRecord
from ..calibration.results import active_names
from ..core.units import INCH, M
from ..data.recording import Recording
from ..kinematics.parameters import Parameters
from ..uncertainty.identifiability import Observability, observability

_SUSPICIOUS_SCALE = 0.005  # a held link is not off by more than this; its nominal value or a reference length is wrong
_LENGTH_OUTLIER = 8.0  # in standard uncertainties: real arms reach 6 where the D-H model misses something
_POSE_OUTLIER = 8.0  # in median distances
_HONEST = 1.5  # errors may exceed their prediction by so much before it is said
_NAMED = 5  # how many of a kind are named


def of_capture(recording: Recording) -> list[str]:
    """Readings outside the arm's limits (a wrong unit, or exchanged columns), and lengths taken as exact."""
    found = []
    q = np.asarray(recording.capture.q)
    for joint, limits in enumerate(recording.nominal.arm.limits or ()):
        outside = int(np.sum((q[:, joint] < limits[0]) | (q[:, joint] > limits[1])))
        if outside:
            low, high = (f"{math.degrees(x):.0f}" for x in limits)
            found.append(
                f"Joint {joint + 1}: {outside} of {len(q)} readings lie outside its limits, {low} to {high} deg; "
                "is the unit right, and the order of the columns?"
            )
    exact = [f"{length.start} - {length.end}" for length in recording.capture.lengths if float(length.u) == 0]
    if exact and recording.true is None:
        found.append(f"Taken as exact, because u is 0: {_some(exact)}; give the standard uncertainty of each length.")
    return found


def of_calibration(record: CalibrationRecord, seen: Observability | None = None) -> list[str]:
    """Everything about a calibration that should be read before its numbers. ``seen`` saves looking again: see `observed`."""
    found = [] if record.converged else [record.reason]
    found += _implausible(record)
    found += _validation(record)
    found += [*_scale(record), *of_capture(record.recording), *_bounds(record), *_data(record)]
    return found + _identifiability(record, observed(record) if seen is None else seen)


def observed(record: CalibrationRecord) -> Observability:
    """What the data of a calibration determine, about the calibrated arm."""
    arm = record.calibrated.arm
    return observability(arm, record.recording.capture, Parameters(arm, record.names))


def _implausible(record: CalibrationRecord) -> list[str]:
    """A residual that no arm has: the solve ended at a minimum, but of data that do not belong to this arm."""
    if not record.implausible_residual:
        return []
    rms = float(record.evaluations()["calibrated"].repeatability.rms)
    return [
        f"The poses of a socket disagree by {rms:.3g} mm RMS, over a hundred times what an arm of this size can be, so data and arm "
        "do not belong together: check the files, their columns and unit, the sockets and the arm."
    ]


def _validation(record: CalibrationRecord) -> list[str]:
    """What cross-validation found, where it contradicts the uncertainty; and noise that the residuals contradict."""
    found = []
    validation = record.validation
    if validation is not None and validation.surprising:
        found.append(
            f"Sockets left out one placement after the other err {validation.excess:.1f} times as much as their uncertainty predicts "
            f"({validation.rms:.3g} mm RMS against {validation.rms_predicted:.3g}, lengths {validation.length_rms:.3g} mm against "
            f"{validation.length_u:.3g}): errors of neighbouring poses are alike, so the D-H model misses something (joints that "
            "give way, eccentric encoders). Trust the cross-validated figures; every u below is too small."
        )
    if record.reduced_chi is not None and not 1 / _HONEST < record.reduced_chi < _HONEST:
        word = "small" if record.reduced_chi > 1 else "large"
        factor = max(record.reduced_chi, 1 / record.reduced_chi)
        found.append(
            f"Residuals are {record.reduced_chi:.2g} times what the given noise predicts, and every uncertainty below rests on that noise: it is "
            f"about {factor:.2g} times too {word}. Check the noise, or leave it out to have it estimated."
        )
    return found


def _scale(record: CalibrationRecord) -> list[str]:
    k = record.k
    stage1 = _sides(record)
    if not plausible(k):
        unit = next((u for u, factor in (("m", M), ("cm", 10), ("inch", 1 / INCH)) if abs(k / factor - 1) < 0.1), None)
        hint = f"are the lengths in {unit} by mistake?" if unit else "check units, sockets, lengths and arm."
        return [f"k = {k:.6g} cannot be the scale of this arm; {hint}"]
    fixed = record.scale_set_by
    if fixed and record.method == "two-stage":
        which = f"{_some(list(fixed))} {'is' if len(fixed) == 1 else 'are'} fixed and already set{'s' * (len(fixed) == 1)} the scale"
        return [
            f"{which}, so the reference lengths changed nothing: by them the arm is {k:.6f} times too large (u = {record.u_k:.2g}). "
            "Free one of these lengths, or use both with the joint solve (--method joint)."
        ]
    if record.hold is None and stage1 and not fixed:
        word = "shrank" if k < 1 else "stretched"
        return [
            f"Stage 1 ran with every length free and {word} the arm to k = {k:.5f} until a bound stopped it: {_some(stage1)}. "
            "The scale fix undoes that; hold a length (--hold) to avoid it."
        ]
    if record.hold is not None and abs(k - 1) > max(_SUSPICIOUS_SCALE, 3 * record.u_k):
        return [f"k = {k:.5f} is far from 1: is {record.hold} at its nominal value, and is each reference length right?"]
    return []


def _bounds(record: CalibrationRecord) -> list[str]:
    sides = _sides(record)
    if not sides or (record.hold is None and len(sides) < len(record.names) / 3):
        return []
    if len(sides) >= len(record.names) / 3:
        return [
            f"{len(sides)} of {len(record.names)} parameters are on a bound, so the arm does not fit the data: "
            "check unit, order of columns, sockets and arm."
        ]
    return [f"On a bound: {_some(sides)}; widen the bounds unless they are known limits. Uncertainties leave these out."]


def _data(record: CalibrationRecord) -> list[str]:
    capture = record.recording.capture
    evaluation = record.evaluations()["calibrated"]
    spread, owner = np.asarray(evaluation.distances), capture.owner
    first = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    found = []
    typical = float(np.median(spread))
    far = np.flatnonzero(spread > _POSE_OUTLIER * typical) if typical > 1e-6 else []
    if len(far):
        worst = sorted(far, key=lambda i: -spread[i])
        names = [f"{capture.names[owner[i]]} pose {i - first[owner[i]] + 1} ({spread[i]:.3g} mm)" for i in worst]
        found.append(f"Poses far from their socket, where {typical:.2g} mm is typical: {_some(names)}; was the tip seated?")
    error = np.asarray(evaluation.error)
    normalised = np.abs(error) / np.hypot(np.asarray(evaluation.u), 1e-9)
    wrong = [
        f"{length.start} - {length.end} ({error[i]:+.3g} mm, {normalised[i]:.0f} times its uncertainty)"
        for i, length in enumerate(capture.lengths)
        if len(error) > 1 and normalised[i] > _LENGTH_OUTLIER and abs(error[i]) > 1e-6
    ]
    if wrong:
        found.append(f"Reference lengths that disagree with the arm: {_some(wrong)}; check their values and sockets.")
    freedom = 3 * sum(size - 1 for size in capture.sizes) - (len(record.names) - 1)
    if freedom < (len(record.names) - 1) / 2:
        found.append(
            f"Only {freedom} more equations than unknowns: the small residuals are the fit's own doing; record more poses."
        )
    error, u = np.asarray(evaluation.error), np.asarray(evaluation.u)
    birge = float(np.sqrt(np.sum((error / u) ** 2) / (len(error) - 1))) if len(error) > 1 and np.all(u > 0) else 0.0
    if birge > _HONEST:
        found.append(
            f"The {len(error)} reference lengths disagree {birge:.2g} times as much as their u and the scatter of the poses allow (Birge "
            "ratio); u(k) has been enlarged by as much. Look for a wrong length, or for errors that the D-H model does not hold."
        )
    if len(capture.lengths) == 1:
        found.append("One reference length fixes the scale, so its own error says nothing; keep another for checking.")
    return found


def _identifiability(record: CalibrationRecord, seen: Observability) -> list[str]:
    found = seen.sentences()
    weak = [name for name, known in zip(record.names, record.determined, strict=True) if not known]
    # Those that no noise-free capture could determine either are told above; the rest are lost in the noise.
    lost = np.abs(seen.null).max(axis=1, initial=0.0) > 1e-3
    weak = [name for name in weak if not lost[record.names.index(name)]]
    if weak:
        found.append(
            f"Hardly determined one by one, only together: {_some(weak, 12)}. The tips and lengths that follow from them are (see their "
            "uncertainty), but these have none of their own; hold the redundant ones (--held)."
        )
    u, width = np.sqrt(np.diag(record.covariance)), (record.upper - record.lower) / 2
    loose = [
        name
        for i, name in enumerate(record.names)
        if record.determined[i] and u[i] > (0.5 * width[i] if np.isfinite(width[i]) else np.inf)
    ]
    if loose:
        found.append(
            f"Hardly determined, with a standard uncertainty over half of what the bounds allow: {_some(loose)}; "
            "hold some (--held), or record poses that tell them apart."
        )
    return found


def _sides(record: CalibrationRecord) -> list[str]:
    space = Parameters(record.recording.nominal.arm, record.names)
    return [f"{name} ({side})" for name, side in active_names(space, record.active_stage1).items()]


def _some(items: list[str], most: int = _NAMED) -> str:
    return ", ".join(items[:most]) + (f" and {len(items) - most} more" if len(items) > most else "")
