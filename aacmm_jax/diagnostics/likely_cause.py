"""Why data do not belong to an arm: mistakes in the recording, tried one by one on the nominal arm.

A mistake is corrected, the unknown geometry fitted to the tips of the nominal arm, and the residuals compared; nothing
is identified. A nominal arm is a few millimetres off, a mistake some hundred.
"""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, to_numpy
from ..core.text import shorten
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
_ROUNDS = 4  # Gauss-Newton steps of the geometry
_UNITS = {
    "measured values in m are taken for mm": M,
    "measured values in cm are taken for mm": 10.0,
    "measured values in inches are taken for mm": INCH,
    "measured values in um are taken for mm, or those in mm for m": UM,
    "measured values in mm are taken for inches": 1 / INCH,
}
_MIRRORED = "left-handed: two columns are exchanged, or one has the wrong sign"


class _Tried(NamedTuple):
    cause: str
    q: Float[np.ndarray, "M n"]
    observations: tuple[AbstractObservation, ...] | None = None  # None: as given
    write: str = ""  # what corrects it in the manifest, as a sentence


def likely_cause(arm: Arm, capture: Capture) -> str:
    """The mistake whose correction makes the residuals by the nominal arm far smaller, as a sentence; or nothing."""
    arm, capture = to_numpy((arm, capture))
    with np.errstate(all="ignore"):
        misfit = _Misfit.by(arm, capture)
        if misfit is None:
            return ""
        given, size = misfit.rms(_Tried("", np.asarray(misfit.observed.q))), total_link_length(arm)
        if given < _NOMINAL * size:
            return ""
        rms, cause, write = np.inf, "", ""
        for tried in misfit.corrections():
            corrected = misfit.rms(tried)
            if corrected < 0.98 * rms:  # of equally good corrections, the first
                rms, cause, write = corrected, tried.cause, tried.write
    if not rms < min(given / _BETTER, _SMALL * size):
        return ""
    return (
        f"Likely cause: {cause}. Correcting it reduces the residuals (nominal arm) from {given:.3g} to {rms:.3g} mm "
        f"RMS.{write}"
    )


class _Misfit(NamedTuple):
    """How far an arm is from what was observed: sockets and other observations, a part of them where there are many."""

    arm: Arm
    observed: Observed

    @classmethod
    def by(cls, arm: Arm, capture: Capture) -> "_Misfit | None":
        """None where no two poses can disagree."""
        sockets = [Socket(name, q) for name, q in capture.sockets.items() if len(q) > 1]
        scattering = [*sockets, *capture.observations]
        if not scattering:
            return None
        chosen = [scattering[i] for i in _evenly(len(scattering), _OBSERVATIONS)]
        part = [observation.select(_evenly(observation.q.shape[0], _POSES)) for observation in chosen]
        # Without the arm: its readings may be in any unit.
        observed = Observed.of(Capture({}, (), part), None)
        return cls(arm, observed.moved(arm, np.asarray(observed.q)))

    def corrections(self) -> Iterator[_Tried]:
        q, observations = np.asarray(self.observed.q), self.observed.observations
        for tried in _of_joints(q[:, : self.arm.joints], self.arm):  # the column of a thermometer stays
            yield tried._replace(q=np.concatenate([tried.q, q[:, self.arm.joints :]], axis=1))
        concerned = [i for i, one in enumerate(observations) if _measured_field(one) is not None]
        alike: dict[tuple[str, str], list[int]] = {}
        for i in concerned:
            for label in ("kind", "station", "artefact"):
                alike.setdefault((label, str(getattr(observations[i], label, i))), []).append(i)
        for several in dict.fromkeys([tuple(concerned), *map(tuple, alike.values()), *((i,) for i in concerned)]):
            if not several:
                continue
            corrected = [list(_measured(observations[i])) for i in several]
            for cause in dict.fromkeys(text for of in corrected for text, _ in of):
                changed = list(observations)
                for i, of in zip(several, corrected, strict=True):
                    changed[i] = dict(of).get(cause, observations[i])
                names = shorten([observations[i].name for i in several], 3)
                field = _measured_field(observations[several[0]])
                unit = length_unit(_UNITS.get(cause, 0.0))
                write = f' In its table of the manifest write units = {{ {field} = "{unit}" }}.'
                write = write if unit in ("m", "inch") else ""
                yield _Tried(f"{cause} ({names})", q, tuple(changed), write)

    def rms(self, tried: _Tried) -> float:
        """RMS distance of the tips from the geometry that fits them, mm; an angle counts as the arm's lever makes it.

        What is certified stays as it is stated.
        """
        observed = self.observed.moved(self.arm, tried.q, tried.observations)
        space, lever = Parameters(self.arm, ("d_1",)), total_link_length(self.arm) / 4
        certified: dict[str, AnyArray] = {name: np.asarray(value) for name, (value, _) in observed.certified().items()}
        fixed = [np.full(len(units), name in certified) for name, units in observed.blocks.items()]
        vector, best = np.asarray(space.vector()), np.inf
        try:
            start = observed.split(np.asarray(observed.start(space, vector))) | certified
            z = np.concatenate([vector, *(start[name] for name in observed.blocks)])
            for _ in range(_ROUNDS):
                point = rows_at(space, observed, z)
                sizes = [rows.values.shape for rows in point.rows]
                roots = [np.diag([1.0] * min(size, 3) + [lever] * (size - 3)) for size, _ in sizes]
                roots = tuple(
                    np.broadcast_to(root, (m, *root.shape)) for root, (_, m) in zip(roots, sizes, strict=True)
                )
                whitening = Whitening(roots, np.zeros(0), {name: 0 * value for name, value in certified.items()})
                linear = Linearisation.of(observed, space, z, point, [], whitening, None)
                squares = sum(float(np.sum(white**2)) for white in linear.white())
                rms = float(np.sqrt(squares / len(observed.q)))
                if not rms < 0.95 * best:
                    break
                best, z = rms, linear.fitted(np.concatenate([[True], *fixed]))
        except np.linalg.LinAlgError:
            return np.inf
        return best if np.isfinite(best) else np.inf


def _evenly(number: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, number - 1, min(number, most)).astype(int))


def _of_joints(q: Float[np.ndarray, "M n"], arm: Arm) -> Iterator[_Tried]:
    joints = range(q.shape[1])
    for several in (1, 2):
        for chosen in itertools.combinations(joints, several):
            signs = np.where(np.isin(joints, chosen), -1.0, 1.0)
            named = " and ".join(str(joint + 1) for joint in chosen)
            yield _Tried(f"joint{'s' if several > 1 else ''} {named} read with the wrong sign", q * signs)
    yield _Tried("all joints read with the wrong sign", -q)
    for one, other in itertools.combinations(joints, 2):
        order = list(joints)
        order[one], order[other] = other, one
        yield _Tried(f"the columns of joints {one + 1} and {other + 1} are exchanged", q[:, order])
    yield _Tried("the columns are in reverse order", q[:, ::-1])
    yield _Tried("the columns begin with that of the last joint", np.roll(q, -1, axis=1))
    yield _Tried("the columns end with that of the first joint", np.roll(q, 1, axis=1))
    slides = np.array(by_joint(arm, False, True))
    yield _Tried("readings in gon are taken for degrees", np.where(slides, q, 0.9 * q))
    largest = float(np.abs(q[:, ~slides]).max(initial=0.0))
    if 0 < largest < _TURN * DEG:
        yield _Tried("readings in radians are taken for degrees", np.where(slides, q, q / DEG))
    if largest > _TURN:  # otherwise every tip would come near every other
        yield _Tried("readings in degrees are taken for radians", np.where(slides, q, q * DEG))
    if slides.any():
        yield _Tried("readings of prismatic joints in m are taken for mm", np.where(slides, 1000.0 * q, q))


def _measured_field(observation: AbstractObservation) -> str | None:
    """Name of the coordinates, distances or sizes in mm that were measured or certified, where there are any."""
    for entry in observation.entries:
        measured = bool(entry.uncertainty) or (entry.required and bool(entry.dimensions))
        if entry.unit == "mm" and measured and getattr(observation, entry.name) is not None:
            return entry.name
    return None


def _measured(observation: AbstractObservation) -> Iterator[tuple[str, AbstractObservation]]:
    """Corrections of what one observation measured."""
    name = _measured_field(observation)
    if name is None:
        return
    values = np.asarray(getattr(observation, name))

    def changed(new: AnyArray, field: str = name) -> Any:
        return eqx.tree_at(lambda o: getattr(o, field), observation, new)

    for cause, factor in _UNITS.items():
        yield cause, changed(values * factor)
    if values.shape[1:] != (3,):
        return
    yield f"measured coordinates are {_MIRRORED}", changed(values * [1, 1, -1])
    if isinstance(observation, MeasuredTransforms):
        rotations = np.asarray(observation.rotations)
        for order in itertools.permutations(range(3)):
            for signs in itertools.product((1, -1), repeat=3) if order == (0, 1, 2) else ((1, 1, 1),):
                read = " ".join(("-" if signs[i] < 0 else "") + "xyz"[i] for i in np.argsort(order))
                if read != "x y z":
                    yield f"the columns of positions are {read}", changed(values[:, order] * signs)
        for cause, corrected in _rotations(rotations):
            yield cause, changed(corrected, "rotations")


def _rotations(rotations: Float[np.ndarray, "m 3 3"]) -> Iterator[tuple[str, Float[np.ndarray, "m 3 3"]]]:
    from scipy.spatial.transform import Rotation

    read = Rotation.from_matrix(rotations)
    first, last = read.as_quat(scalar_first=True), read.as_quat()
    yield "quaternions in the order x y z w are taken for w x y z", Rotation.from_quat(first).as_matrix()
    yield (
        "quaternions in the order w x y z are taken for x y z w",
        Rotation.from_quat(last, scalar_first=True).as_matrix(),
    )
    yield "orientations are those of the instrument in the target's frame", rotations.swapaxes(-1, -2)
