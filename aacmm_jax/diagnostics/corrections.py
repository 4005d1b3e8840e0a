"""Why data do not belong to an arm: mistakes in the recording, tried one by one on the nominal arm.

A mistake is corrected, the unknown geometry fitted to the tips of the nominal arm, and the residuals are compared. A
nominal arm is a few millimetres off, a mistake some hundred. Nothing is identified, but for the zero of a joint where
that may be the mistake.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, to_numpy
from ..core.text import pluralise, shorten
from ..core.units import DEG, INCH, UM, M, length_unit
from ..data.capture import Capture
from ..data.observations.held import Socket
from ..data.observations.measured import MeasuredTransforms
from ..data.observations.observation import AbstractObservation
from ..kinematics.arm import Arm, by_joint
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import total_link_length
from ..model.observed import Observed
from ..model.rows import Whitening, rows_at
from ..uncertainty.linearisation import Linearisation

_BETTER = 4.0  # the factor by which a correction must reduce the residual to be named
_SMALL = 0.05  # of the arm's size: a larger residual is left by an arm that the data do not belong to
_NOMINAL = 0.005  # of the arm's size: a smaller residual is what a nominal arm leaves
_POSES, _OBSERVATIONS = 60, 24  # of which as many as these are looked at
_TURN = 2 * np.pi * 1.02  # rad; readings of few joints go further
_ROUNDS, _ROUNDS_FREE = 4, 12  # Gauss-Newton steps of the geometry, and with a zero that is far off
_ADJUSTED = 2.0  # the factor by which a zero that was adjusted must be better than another correction
_STARTS = 8  # zeros that are tried over a full turn
_MOST_ELSEWHERE = 0.25  # of all poses that may be under the name of another socket
_LATE = 3  # most rows by which readings are late or early
UNITS = {
    "measured values are in m, but were read as mm": M,
    "measured values are in cm, but were read as mm": 10.0,
    "measured values are in inches, but were read as mm": INCH,
    "measured values are in um, but were read as mm (or are in mm, but were read as m)": UM,
    "measured values are in mm, but were read as inches": 1 / INCH,
}


class Mistake(NamedTuple):
    """What was probably done wrong in a recording."""

    says: str  # in sentences
    concerns: tuple[str, ...] = ()  # sockets, observations, poses, joints and parameters
    of_readings: bool = False  # whether other orders, signs, zeros or units of the columns may correct it
    of_bounds: bool = False  # whether wider bounds may


class _Correction(NamedTuple):
    """A mistake, and what the recording is without it."""

    cause: str
    observed: Observed
    line: str = ""  # a sentence on what corrects it in the manifest
    concerns: tuple[str, ...] = ()
    of_readings: bool = True
    zero: str = ""  # of a joint, which is not known


def likely_cause(arm: Arm, capture: Capture, bounded: Sequence[str] = ()) -> Mistake | None:
    """The mistake whose correction makes the residuals by the nominal arm far smaller, if there is one.

    The zero of a joint in ``bounded`` is one of the arm, which wider bounds may reach.
    """
    arm, capture = to_numpy((arm, capture))
    sockets = [Socket(name, q) for name, q in capture.sockets.items() if len(q) > 1]
    scattering = [*sockets, *capture.observations]
    if not scattering:  # no two poses can disagree
        return None
    chosen = [scattering[i] for i in _evenly(len(scattering), _OBSERVATIONS)]
    # Without the arm: its readings may be in any unit.
    observed, size = Observed.of(_thinned(chosen), None), total_link_length(arm)
    with np.errstate(all="ignore"):
        given = _rms(arm, observed.moved(arm, np.asarray(observed.q)))
        if given < _NOMINAL * size:
            return None
        tried = []
        moved = _elsewhere(arm, [part for part in chosen if isinstance(part, Socket)], chosen)
        for correction in (*moved, *_corrections(arm, observed), *_late(arm, chosen), *_zeros(arm, observed)):
            rms, zero = _with_zero(arm, correction) if correction.zero else (_rms(arm, correction.observed), 0.0)
            cause = correction.cause.format(zero / DEG) if correction.zero else correction.cause
            tried.append((rms, correction._replace(cause=cause)))
    least = min(rms for rms, _ in tried)
    if not least < min(given / _BETTER, _SMALL * size):
        return None
    (rms, best), *others = [(rms, correction) for rms, correction in tried if 0.98 * rms <= least]
    # One that concerns only some of the observations is part of another that is as good.
    alike = [other.cause for _, other in others if not set(other.concerns) & set(best.concerns)]
    also = f" Equally likely: {shorten(alike, 3)}." if alike else ""
    rms /= _ADJUSTED if best.zero else 1.0
    says = (
        f"Likely cause: {best.cause}. Correcting this reduces the residuals (nominal arm) from {given:.3g} to "
        f"{rms:.3g} mm RMS.{best.line}{also}"
    )
    return Mistake(says, best.concerns, best.of_readings, of_bounds=not alike and best.zero in bounded)


def _thinned(observations: Sequence[AbstractObservation]) -> Capture:
    return Capture({}, (), [part.select(_evenly(part.q.shape[0], _POSES)) for part in observations])


def _evenly(number: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, number - 1, min(number, most)).astype(int))


def _rms(arm: Arm, observed: Observed) -> float:
    """RMS distance of the tips from the geometry that fits them, mm."""
    return _fitted(arm, observed, "")[0]


def _with_zero(arm: Arm, correction: _Correction) -> tuple[float, float]:
    """The same with the zero of a joint that fits best, over a full turn, which counts more as it was adjusted; and the
    change of this zero, rad."""
    joint, best = int(correction.zero.rpartition("_")[2]) - 1, (np.inf, 0.0)
    nominal = np.asarray(arm.theta)
    for turn in np.arange(1, _STARTS) * (2 * np.pi / _STARTS):
        start = to_numpy(arm.replace(theta=nominal + turn * (np.arange(len(nominal)) == joint)))
        rms, zero = _fitted(start, correction.observed, correction.zero)
        best = min(best, (rms, float(np.remainder(zero - nominal[joint] + np.pi, 2 * np.pi) - np.pi)))
    return _ADJUSTED * best[0], best[1]


def _fitted(arm: Arm, observed: Observed, free: str) -> tuple[float, float]:
    """RMS distance of the tips from the geometry that fits them, mm, with one parameter free or none; and its value.

    An angle counts as the arm's lever makes it. What is certified stays as it is stated.
    """
    space, lever = Parameters(arm, (free or "d_1",)), total_link_length(arm) / 4
    certified: dict[str, AnyArray] = {name: np.asarray(value) for name, (value, _) in observed.certified().items()}
    fixed = np.concatenate([[not free], *(np.full(len(u), name in certified) for name, u in observed.blocks.items())])
    vector, best = np.asarray(space.vector()), np.inf
    z = vector
    try:
        start = observed.split(np.asarray(observed.start(space, vector))) | certified
        z = np.concatenate([vector, *(start[name] for name in observed.blocks)])
        for _ in range(_ROUNDS_FREE if free else _ROUNDS):
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
            best, z = rms, linear.fitted(fixed)
    except np.linalg.LinAlgError:
        return np.inf, 0.0
    return best if np.isfinite(best) else np.inf, float(z[0])


def _zeros(arm: Arm, observed: Observed) -> Iterator[_Correction]:
    """The zero of each joint."""
    same = observed.moved(arm, np.asarray(observed.q))
    for joint in range(1, arm.joints + 1):
        if joint not in arm.prismatic:
            cause = f"the zero of joint {joint} is {{:.3g}} deg off"
            yield _Correction(cause, same, concerns=(f"joint {joint}",), zero=f"theta_{joint}")


def _elsewhere(
    arm: Arm, sockets: Sequence[Socket], observations: Sequence[AbstractObservation]
) -> Iterator[_Correction]:
    """Poses under the name of another socket: a few whose nominal tips are nearer the median tip of that one."""
    tips = [np.asarray(arm.position(socket.q)) for socket in sockets]
    medians = np.array([np.median(points, axis=0) for points in tips]).reshape(-1, 3)
    nearest = [np.linalg.norm(points[:, None] - medians, axis=2).argmin(axis=1) for points in tips]
    poses: dict[tuple[int, int], list[str]] = {}
    for i, places in enumerate(nearest):
        for pose in np.flatnonzero(places != i):
            poses.setdefault((i, int(places[pose])), []).append(f"{sockets[i].name} pose {pose + 1}")
    count = sum(map(len, poses.values()))
    if not 0 < count <= _MOST_ELSEWHERE * sum(map(len, tips)):
        return
    q, to = np.concatenate([socket.q for socket in sockets]), np.concatenate(nearest)
    renamed = [Socket(socket.name, q[to == i]) for i, socket in enumerate(sockets) if np.sum(to == i) > 1]
    observed = Observed.of(_thinned([*renamed, *(part for part in observations if not isinstance(part, Socket))]), None)
    fits = shorten([f"{sockets[place].name} fits {shorten(names, 3)}" for (_, place), names in poses.items()], 3)
    cause = f"{pluralise(count, 'pose')} recorded under the name of another socket ({fits})"
    concerns = tuple(dict.fromkeys(sockets[i].name for pair in poses for i in pair))
    yield _Correction(cause, observed.moved(arm, np.asarray(observed.q)), concerns=concerns, of_readings=False)


def _late(arm: Arm, observations: Sequence[AbstractObservation]) -> Iterator[_Correction]:
    """Readings that are some rows late or early in each file, against what was measured; not of sockets alone, whose
    poses have no order but at their ends (`_elsewhere`)."""
    if all(isinstance(observation, Socket) for observation in observations):
        return
    count = min(observation.q.shape[0] for observation in observations)
    for rows in (by for size in range(1, _LATE + 1) for by in (size, -size)):
        if count <= 2 * _LATE:
            return
        shifted = []
        for observation in observations:
            q, poses = np.asarray(observation.q), np.arange(observation.q.shape[0] - abs(rows))
            poses = poses + max(-rows, 0)
            shifted.append(observation.select(poses).changed(q=q[poses + rows]))
        observed = Observed.of(_thinned(shifted), None)
        cause = f"the readings are {pluralise(abs(rows), 'row')} {'late' if rows > 0 else 'early'}"
        yield _Correction(cause, observed.moved(arm, np.asarray(observed.q)), of_readings=False)


def _corrections(arm: Arm, observed: Observed) -> Iterator[_Correction]:
    q, observations = np.asarray(observed.q), observed.observations
    concerned = [i for i, observation in enumerate(observations) if _measured_field(observation) is not None]
    alike: dict[tuple[str, str], list[int]] = {}
    for i in concerned:
        for label in ("kind", "station", "artefact"):
            alike.setdefault((label, str(getattr(observations[i], label, i))), []).append(i)
    for several in dict.fromkeys([tuple(concerned), *map(tuple, alike.values()), *((i,) for i in concerned)]):
        if not several:
            continue
        corrected = [dict(_of_measured(observations[i])) for i in several]
        names, field = [observations[i].name for i in several], _measured_field(observations[several[0]])
        for cause in dict.fromkeys(text for changes in corrected for text in changes):
            changed = list(observations)
            for i, changes in zip(several, corrected, strict=True):
                changed[i] = changes.get(cause, observations[i])
            unit = length_unit(UNITS.get(cause, 0.0))
            write = f' In the table of the observation in the manifest, write units = {{ {field} = "{unit}" }}.'
            line, moved = write if unit in ("m", "inch") else "", observed.moved(arm, q, tuple(changed))
            text = f"{cause} ({shorten(names, 3)})"
            yield _Correction(text, moved, line, tuple(names), of_readings=cause in UNITS)
    for cause, corrected in _of_joints(q[:, : arm.joints], arm):  # the column of a thermometer stays
        readings = np.concatenate([corrected, q[:, arm.joints :]], axis=1)
        yield _Correction(cause, observed.moved(arm, readings))


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
    # Of servos, whose counts of a turn begin at one end, so that their zeros are the middle.
    yield "the zeros of all joints are half a turn off", np.where(slides, q, q - np.pi)
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

    for cause, factor in UNITS.items():
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
