"""What was recorded: readings outside the arm's limits, repeated poses, standard uncertainties that nothing has; and
why data do not belong to an arm.

For that, mistakes in the recording are tried one by one on the nominal arm: a mistake is corrected, the unknown
geometry fitted to the tips of the nominal arm, and the residuals compared; nothing is identified. A nominal arm is a
few millimetres off, a mistake some hundred.
"""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, to_numpy
from ..core.text import shorten
from ..core.units import DEG, INCH, UM, M, length_unit
from ..data.capture import Capture
from ..data.observations.held import Socket
from ..data.observations.measured import MeasuredTransforms
from ..data.observations.observation import AbstractObservation, stated_u
from ..data.recording import Recording
from ..kinematics.arm import Arm, by_joint
from ..kinematics.chain import reading_units
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import total_link_length
from ..model.observed import Observed
from ..model.rows import Whitening, rows_at
from ..uncertainty.linearisation import Linearisation
from .findings import Case, Finding

ORDER, NEEDS = 80, "nothing"
_TOLERANCE = math.radians(0.01)  # beyond a limit: more than the noise of any encoder
# mm. An interferometer reaches 0.1 um in a metre; seats, probes and trackers of arms are far from it. Beyond 1 mm a
# length or point says less than the nominal arm does.
_SMALLEST_U, _LARGEST_U = 1e-4, 1.0


def test(case: Case) -> list[Finding]:
    """Of the capture of a calibration."""
    return of_recording(case.record.recording)


def findings_of_capture(recording: Recording) -> list[Finding]:
    """What should be read about a capture before it is calibrated.

    Args:
        recording: The capture, and the nominal arm.

    Returns:
        The likely cause where the nominal arm is far off, and what is wrong with readings and uncertainties.

    Example:
        >>> print(aj.diagnostics.findings_of_capture(recording))
        []
    """
    cause = likely_cause(recording.nominal.arm, recording.capture) if recording.true is None else ""
    return [*([Finding("likely-cause", cause)] if cause else []), *of_recording(recording)]


def of_recording(recording: Recording) -> list[Finding]:
    """Of what was recorded; a simulation keeps within the limits but for its noise, and may have exact lengths."""
    capture, simulated = recording.capture, recording.true is not None
    repeated = [Finding("repeated", sentence) for sentence in capture.repeated.sentences()]
    if simulated:
        return repeated
    exact = [f"{length.start} - {length.end}" for length in capture.lengths if float(length.u) == 0]
    findings = [*_outside_limits(recording), *repeated]
    if exact:
        says = f"These lengths are treated as exact, because their u is 0: {shorten(exact)}."
        advice = "Give the standard uncertainty of each length."
        findings.append(Finding("exact-lengths", says, advice=advice, concerns=tuple(exact)))
    return findings + _implausible_uncertainties(capture)


def _outside_limits(recording: Recording) -> Iterator[Finding]:
    """Readings outside the joint limits: a wrong unit, or exchanged columns."""
    arm, q = recording.nominal.arm, np.asarray(recording.capture.readings)
    units = reading_units(arm.geometry)
    for joint, limits in enumerate(arm.limits or ()):
        tolerance = _TOLERANCE * units[joint]
        outside = int(np.sum((q[:, joint] < limits[0] - tolerance) | (q[:, joint] > limits[1] + tolerance)))
        if outside:
            slides = joint + 1 in arm.prismatic
            low, high = (f"{x if slides else math.degrees(x):.0f}" for x in limits)
            yield Finding(
                "outside-limits",
                f"Joint {joint + 1}: {outside} of {len(q)} readings lie outside its limits, {low} to {high} "
                f"{'mm' if slides else 'deg'}.",
                advice="Are the unit and the order of the columns right?",
                concerns=(f"joint {joint + 1}",),
            )


def _implausible_uncertainties(capture: Capture) -> list[Finding]:
    """Of standard uncertainties that nothing which measures arms has: most likely of another unit than mm."""
    stated = [(f"[[length]] {length.start} - {length.end}", length.u) for length in capture.lengths]
    stated += [(f"[[{part.table}]] {part.name}", stated_u(part)) for part in capture.observations]
    positive = [(where, values[values > 0]) for where, u in stated for values in [np.asarray(u, dtype=float).ravel()]]
    least = [(where, values.min() / UM) for where, values in positive if len(values) and values.min() < _SMALLEST_U]
    most = [(where, values.max() / UM) for where, values in positive if len(values) and values.max() > _LARGEST_U]
    small = [f"{where} (u = {u:.3g} um)" for where, u in least]
    large = [f"{where} (u = {u:,.0f} um)" for where, u in most]
    return [
        Finding(
            code,
            f"{says}: {shorten(texts)}.",
            advice=f"u must be in mm; was it given in {unit}?",
            concerns=tuple(texts),
        )
        for code, texts, says, unit in (
            ("small-u", small, "u < 0.1 um is implausibly small", "m"),
            ("large-u", large, "u > 1 mm is implausibly large", "um"),
        )
        if texts
    ]


_BETTER = 4.0  # the factor by which a correction must reduce the residual to be named
_SMALL = 0.05  # of the arm's size: a larger residual is left by an arm that the data do not belong to
_NOMINAL = 0.005  # of the arm's size: a smaller residual is what a nominal arm leaves
_POSES, _OBSERVATIONS = 60, 24  # of which as many as these are looked at
_TURN = 2 * np.pi * 1.02  # rad; readings of few joints go further
_ROUNDS = 4  # Gauss-Newton steps of the geometry
_UNITS = {
    "measured values are in m, but were read as mm": M,
    "measured values are in cm, but were read as mm": 10.0,
    "measured values are in inches, but were read as mm": INCH,
    "measured values are in um, but were read as mm (or are in mm, but were read as m)": UM,
    "measured values are in mm, but were read as inches": 1 / INCH,
}
# A cause, readings, observations (None: as given), and a sentence on what corrects it in the manifest.
_Correction = tuple[str, np.ndarray, tuple[AbstractObservation, ...] | None, str]


def likely_cause(arm: Arm, capture: Capture) -> str:
    """The mistake whose correction makes the residuals by the nominal arm far smaller, as a sentence; or nothing."""
    arm, capture = to_numpy((arm, capture))
    sockets = [Socket(name, q) for name, q in capture.sockets.items() if len(q) > 1]
    scattering = [*sockets, *capture.observations]
    if not scattering:  # no two poses can disagree
        return ""
    chosen = [scattering[i] for i in _evenly(len(scattering), _OBSERVATIONS)]
    part = [observation.select(_evenly(observation.q.shape[0], _POSES)) for observation in chosen]
    # Without the arm: its readings may be in any unit.
    observed, size = Observed.of(Capture({}, (), part), None), total_link_length(arm)
    with np.errstate(all="ignore"):
        given = _rms(arm, observed.moved(arm, np.asarray(observed.q)))
        if given < _NOMINAL * size:
            return ""
        rms, cause, write = np.inf, "", ""
        for text, q, observations, line in _corrections(arm, observed):
            corrected = _rms(arm, observed.moved(arm, q, observations))
            if corrected < 0.98 * rms:  # of equally good corrections, the first
                rms, cause, write = corrected, text, line
    if not rms < min(given / _BETTER, _SMALL * size):
        return ""
    return (
        f"Likely cause: {cause}. Correcting this reduces the residuals (nominal arm) from {given:.3g} to {rms:.3g} "
        f"mm RMS.{write}"
    )


def _evenly(number: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, number - 1, min(number, most)).astype(int))


def _rms(arm: Arm, observed: Observed) -> float:
    """RMS distance of the tips from the geometry that fits them, mm; an angle counts as the arm's lever makes it.

    What is certified stays as it is stated.
    """
    space, lever = Parameters(arm, ("d_1",)), total_link_length(arm) / 4
    certified: dict[str, AnyArray] = {name: np.asarray(value) for name, (value, _) in observed.certified().items()}
    fixed = [np.full(len(units), name in certified) for name, units in observed.blocks.items()]
    vector, best = np.asarray(space.vector()), np.inf
    try:
        start = observed.split(np.asarray(observed.start(space, vector))) | certified
        z = np.concatenate([vector, *(start[name] for name in observed.blocks)])
        for _ in range(_ROUNDS):
            point, roots = rows_at(space, observed, z), []
            for stack, rows in zip(observed.stacks, point.rows, strict=True):
                # Of a kind without lengths, a residual counts as it moves the tip.
                moves = np.maximum(np.linalg.norm(rows.by_tip, axis=1).T, 1e-300)
                weights = [1.0] * stack.lengths + [lever] * (stack.rows - stack.lengths) if stack.lengths else 1 / moves
                size = np.broadcast_to(weights, moves.shape)
                roots.append(size[:, :, None] * np.eye(stack.rows))
            whitening = Whitening(tuple(roots), np.zeros(0), {name: 0 * value for name, value in certified.items()})
            linear = Linearisation.of(observed, space, z, point, [], whitening, None)
            squares = sum(float(np.sum(white**2)) for white in linear.white())
            rms = float(np.sqrt(squares / len(observed.q)))
            if not rms < 0.95 * best:
                break
            best, z = rms, linear.fitted(np.concatenate([[True], *fixed]))
    except np.linalg.LinAlgError:
        return np.inf
    return best if np.isfinite(best) else np.inf


def _corrections(arm: Arm, observed: Observed) -> Iterator[_Correction]:
    q, observations = np.asarray(observed.q), observed.observations
    for cause, corrected in _of_joints(q[:, : arm.joints], arm):  # the column of a thermometer stays
        yield cause, np.concatenate([corrected, q[:, arm.joints :]], axis=1), None, ""
    concerned = [i for i, observation in enumerate(observations) if _measured_field(observation) is not None]
    alike: dict[tuple[str, str], list[int]] = {}
    for i in concerned:
        for label in ("kind", "station", "artefact"):
            alike.setdefault((label, str(getattr(observations[i], label, i))), []).append(i)
    for several in dict.fromkeys([tuple(concerned), *map(tuple, alike.values()), *((i,) for i in concerned)]):
        if not several:
            continue
        corrected = [dict(_of_measured(observations[i])) for i in several]
        names, field = shorten([observations[i].name for i in several], 3), _measured_field(observations[several[0]])
        for cause in dict.fromkeys(text for changes in corrected for text in changes):
            changed = list(observations)
            for i, changes in zip(several, corrected, strict=True):
                changed[i] = changes.get(cause, observations[i])
            unit = length_unit(_UNITS.get(cause, 0.0))
            write = f' In the table of the observation in the manifest, write units = {{ {field} = "{unit}" }}.'
            yield f"{cause} ({names})", q, tuple(changed), write if unit in ("m", "inch") else ""


def _of_joints(q: Float[np.ndarray, "M n"], arm: Arm) -> Iterator[tuple[str, Float[np.ndarray, "M n"]]]:
    joints = range(q.shape[1])
    for i in joints:
        yield f"joint {i + 1} was read with the wrong sign", np.where(np.isin(joints, [i]), -q, q)
    pairs = list(itertools.combinations(joints, 2))
    for i, j in pairs:
        yield f"joints {i + 1} and {j + 1} were read with the wrong sign", np.where(np.isin(joints, [i, j]), -q, q)
    yield "all joints were read with the wrong sign", -q
    for i, j in pairs:
        order = list(joints)
        order[i], order[j] = j, i
        yield f"the columns of joints {i + 1} and {j + 1} are exchanged", q[:, order]
    yield "the columns are in reverse order", q[:, ::-1]
    yield "the first column is that of the last joint", np.roll(q, -1, axis=1)
    yield "the last column is that of the first joint", np.roll(q, 1, axis=1)
    slides = np.array(by_joint(arm, False, True))
    yield "readings are in gon, but were read as degrees", np.where(slides, q, 0.9 * q)
    largest = float(np.abs(q[:, ~slides]).max(initial=0.0))
    if 0 < largest < _TURN * DEG:
        yield "readings are in radians, but were read as degrees", np.where(slides, q, q / DEG)
    if largest > _TURN:  # otherwise every tip would come near every other
        yield "readings are in degrees, but were read as radians", np.where(slides, q, q * DEG)
    if slides.any():
        yield "readings of prismatic joints are in m, but were read as mm", np.where(slides, 1000.0 * q, q)


def _measured_field(observation: AbstractObservation) -> str | None:
    """Name of the coordinates, distances or sizes in mm that were measured or certified, where there are any."""
    for entry in observation.entries:
        measured = bool(entry.uncertainty) or (entry.required and bool(entry.dimensions))
        if entry.unit == "mm" and measured and getattr(observation, entry.name) is not None:
            return entry.name
    return None


def _of_measured(observation: AbstractObservation) -> Iterator[tuple[str, AbstractObservation]]:
    """Corrections of what one observation measured."""
    from scipy.spatial.transform import Rotation

    name = _measured_field(observation)
    assert name is not None
    values = np.asarray(getattr(observation, name))

    def changed(new: AnyArray, field: str = name) -> Any:
        return eqx.tree_at(lambda o: getattr(o, field), observation, new)

    for cause, factor in _UNITS.items():
        yield cause, changed(values * factor)
    if values.shape[1:] != (3,):
        return
    mirrored = "measured coordinates are left-handed: two columns are exchanged, or one has the wrong sign"
    yield mirrored, changed(values * [1, 1, -1])
    if not isinstance(observation, MeasuredTransforms):
        return
    rotations = np.asarray(observation.rotations)
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3) if order == (0, 1, 2) else ((1, 1, 1),):
            read = " ".join(("-" if signs[i] < 0 else "") + "xyz"[i] for i in np.argsort(order))
            if read != "x y z":
                yield f"the columns of positions are {read}", changed(values[:, order] * signs)
    first, last = (Rotation.from_matrix(rotations).as_quat(scalar_first=scalar_first) for scalar_first in (True, False))
    for cause, corrected in (
        ("quaternions are in the order x y z w, but were read as w x y z", Rotation.from_quat(first)),
        ("quaternions are in the order w x y z, but were read as x y z w", Rotation.from_quat(last, scalar_first=True)),
    ):
        yield cause, changed(corrected.as_matrix(), "rotations")
    inverse = changed(rotations.swapaxes(-1, -2), "rotations")
    yield "orientations are those of the instrument in the target's frame", inverse
