"""What observations determine: their derivatives by the parameters, with the unknown geometry eliminated.

A rank must not follow from errors of an arm that is not yet calibrated, so what an instrument measured is first
replaced by what it would measure of this arm, in the geometry that fits best; the configurations of other observations,
such as sockets, are moved, a few milliradians at most, to where the tips agree with that geometry. (An arm of few
joints cannot be moved to agree with a measured transform.)

Also why data do not determine a coefficient of a joint correction: in the poses of a capture its function is nearly 0,
a constant (which is a zero offset) or a straight line (which is a gear ratio).
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import inverse_cholesky
from ..core.text import listed, pluralise
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.observations.held import position_of
from ..kinematics.arm import Arm
from ..kinematics.chain import reading_units
from ..kinematics.corrected_arm import function_values
from ..kinematics.correction_kinds import GearRatio, Gravity, Term
from ..kinematics.parameters import Parameters
from ..model.elimination import followed, pseudo_inverse, sums_by_component
from ..model.observed import Observed, ends_of
from ..model.rows import rows_at, whitening_of
from ..solver.arrow import joined, split
from .linear_propagation import Influence, arm_errors, covariance_of_noise, covariance_of_sigma
from .linearisation import Linearisation

_ROUNDS = 15
_FITTED = 1e-8  # mm or rad, a step of the geometry
_LONGEST_STEP = 0.1  # rad, of a configuration
_AGREES = 1e-9  # mm or rad
_LEAST_U = 1e-6  # mm: an exact certified value would be a row of infinite weight
_NULL = 1e-10  # singular values of the shared geometry below this, of the largest, are zero
_MOST = 0.5  # of the poses: where fewer agree, all count


class Eliminated(NamedTuple):
    """Derivatives by the parameters in natural steps, after the geometry has followed as well as it can."""

    poses: Float[np.ndarray, "r p"]  # of the rows of all poses
    relations: Float[np.ndarray, "l p"]  # of certified values and reference lengths
    geometry: Float[np.ndarray, "g p"]  # how the geometry follows, natural steps


class Agreeing(NamedTuple):
    """Observations whose configurations agree exactly with one arm and one geometry."""

    linear: Linearisation  # without reference lengths; rows in mm
    ends: tuple[tuple[str, str], ...]  # positions at the ends of the lengths
    u: Float[np.ndarray, " l"]  # standard uncertainties of the lengths, mm

    @classmethod
    def of(cls, capture: Capture, space: Parameters, targets_of: Arm | None = None) -> "Agreeing":
        """Fit the geometry, and make configurations agree with it.

        The geometry is that of ``targets_of``, by default of the arm itself.
        """
        arm, p = space.base, len(space.names)
        observed = Observed.of(capture, arm, lengths=False)
        source = space if targets_of is None else Parameters(targets_of, space.names)
        z = np.asarray(source.vector())
        z = start = np.concatenate([z, np.asarray(observed.start(source, z))])
        for _ in range(_ROUNDS):
            # What is certified does not count: the fit in mm.
            linear = _linear(source, observed, z, certified=0.0)
            # Of images that are not those of the poses, steps lead to corners at the height of the camera.
            new = np.asarray(linear.fitted(np.arange(len(z)) < p)) if _is_finite(linear) else np.full_like(z, np.nan)
            if not np.isfinite(new).all():
                z = start
                break
            step, z = np.max(np.abs(new - z), initial=0.0), new
            if step < _FITTED:
                break
        z = np.concatenate([np.asarray(space.vector()), z[p:]])
        linear = _linear(space, observed, z)
        for _ in range(_ROUNDS):
            if max(np.abs(rows.values).max() for rows in linear.point.rows) < _AGREES:
                break
            moved = _linear(space, _moved(linear), z)
            if not _is_finite(moved):
                break
            linear = moved
        return cls(linear, ends_of(capture), np.array([float(length.u) for length in capture.lengths]))

    def eliminated(self, weigh: Noise | float | None = None) -> Eliminated:
        """In standard deviations by the noise, or by that of a tip coordinate; else in mm."""
        agreeing, p = self.linear, len(self.linear.space.names)
        # Poses that this arm cannot take, next to a singularity, would look like information.
        agree = [np.abs(rows.values).max(axis=0) < _AGREES for rows in agreeing.point.rows]
        if np.mean(np.concatenate(agree)) < _MOST:  # another arm's: what is left of it says as little
            agree = [np.ones_like(mask) for mask in agree]
        linear = _linear(agreeing.space, agreeing.observed, np.asarray(agreeing.z), weigh)
        pairs = zip(linear.whitening.roots, agree, strict=True)
        roots = tuple(root * kept[:, None, None] for root, kept in pairs if root is not None)
        linear = Linearisation.of(*linear[:5], linear.whitening._replace(roots=roots), None)
        influence = linear.influence()
        rows = [part.reshape(linear.height, -1).T for part in _without_components(influence)]
        count = sum(len(part) for part in rows[: len(roots)])
        rows = np.concatenate(rows)
        # What remains is to eliminate the shared geometry.
        basis, singular, vectors = np.linalg.svd(rows[:, p:], full_matrices=False)
        determined = singular > _NULL * max(singular.max(initial=0.0), 1e-300)
        basis, inverse = basis[:, determined], vectors[determined].T / singular[determined]
        along = basis.T @ rows[:, :p]
        rest, shared = rows[:, :p] - basis @ along, -inverse @ along
        whole = np.concatenate([np.eye(p), shared])
        followers = (-np.moveaxis(np.asarray(by_head) @ whole, -1, 0) for by_head in influence.follow)
        geometry = np.asarray(joined(shared.T, *followers)).T
        by_lengths = self._lengths(influence, None if weigh is None else inverse) @ geometry
        return Eliminated(rest[:count], np.concatenate([rest[count:], by_lengths]), geometry)

    def _lengths(self, influence: Influence, inverse: Float[np.ndarray, "s k"] | None) -> Float[np.ndarray, "l g"]:
        """How the lengths follow the geometry; with the inverse of the shared rows, in standard deviations of what they
        are by their own uncertainty and by the poses at their ends."""
        observed, geometry = self.linear.observed, self.linear.z[len(self.linear.space.names) :]
        positions, pull = observed.positions, np.zeros((len(self.ends), len(geometry)))
        for row, (start, end) in zip(pull, self.ends, strict=True):
            between = geometry[positions[end]] - geometry[positions[start]]
            row[positions[end]] = between / np.linalg.norm(between)
            row[positions[start]] = -row[positions[end]]
        pull = pull * observed.steps
        if inverse is None or not self.ends:
            return pull
        head, components = split(pull, observed.layout.shared, observed.layout.classes)
        covariance = np.diag(np.maximum(self.u, _LEAST_U) ** 2)
        for part, inverse_of_part, follow in zip(components, influence.d_inverses, influence.follow, strict=True):
            head = head - np.einsum("lKk,Kkh->lh", part, follow[..., len(self.linear.space.names) :])
            turned = np.einsum("lKk,Kkm->lKm", part, inverse_of_part)
            covariance += turned.reshape(len(pull), -1) @ part.reshape(len(pull), -1).T
        by_shared = head @ inverse
        return np.asarray(inverse_cholesky(covariance + by_shared @ by_shared.T)) @ pull

    @property
    def parts(self) -> list[tuple[str, np.ndarray]]:
        """The parts of the geometry with their indices, but for sockets, which follow every arm."""
        observed = self.linear.observed
        sockets = {position_of(part.name) for part in observed.observations if part.kind == "socket"}
        return [(name, observed.positions[name]) for name in observed.names if name not in sockets]


def _linear(
    space: Parameters,
    observed: Observed,
    z: Float[np.ndarray, " z"],
    weigh: Noise | float | None = None,
    certified: float = 1.0,
) -> Linearisation:
    """By the noise, or the standard deviation of a tip coordinate; else in mm, whatever the uncertainty of what was
    measured, with ``certified`` as the weight of what is certified."""
    point = rows_at(space, observed, z)
    rows, errors = point.rows, arm_errors(point, observed)
    if isinstance(weigh, Noise):
        of_arm = [covariance_of_noise(error, weigh) for error in errors]
    else:
        of_arm = [covariance_of_sigma(error, np.asarray(1.0 if weigh is None else weigh)) for error in errors]
    if weigh is None:
        # Of more residuals than a tip has coordinates, the tip's scatter alone has a covariance without an inverse.
        rows = [
            part if len(part.values) > error.by_seat.shape[1] else part._replace(measured=np.zeros_like(part.measured))
            for part, error in zip(rows, errors, strict=True)
        ]
    whitening = whitening_of(rows, observed, of_arm, np.asarray(_LEAST_U))
    if weigh is None:
        weights = {name: np.full_like(weight, certified) for name, weight in whitening.certified.items()}
        whitening = whitening._replace(certified=weights)
    return Linearisation.of(observed, space, z, point, errors, whitening, None)


def _without_components(influence: Influence) -> list[Float[np.ndarray, "h r m"]]:
    """The rows of every block without what private geometry imitates.

    Eliminated a second time: what rounding leaves of a poorly determined component would look like information.
    """
    left = [np.zeros((*private.shape[:2], influence.inverse.shape[0])) for private in influence.d_inverses]
    for number, (block, rows) in enumerate(zip(influence.blocks, influence.rows, strict=True)):
        private = influence.own_rows(number)
        if private is not None and block.class_index >= 0:
            left[block.class_index] += sums_by_component(private, rows, block.sizes)
    eliminated = [np.asarray(rows) for rows in influence.rows]
    for number, block in enumerate(influence.blocks):
        private = influence.own_rows(number)
        if private is not None and block.class_index >= 0:
            eliminated[number] = eliminated[number] - followed(
                private, influence.d_inverses[block.class_index] @ left[block.class_index], block.sizes
            )
    return eliminated


def _is_finite(linear: Linearisation) -> bool:
    return all(np.isfinite(rows.values).all() and np.isfinite(rows.by_tip).all() for rows in linear.point.rows)


def _moved(linear: Linearisation) -> Observed:
    """With configurations one step of Gauss and Newton closer to the geometry, of all such steps the shortest."""
    observed, arm = linear.observed, linear.space.base
    units, q = reading_units(arm.geometry), np.array(observed.q)
    for group, rows, error in zip(observed.layout.groups, linear.point.rows, linear.errors, strict=True):
        by_units = np.moveaxis(np.asarray(error.by_readings) * units[:, None], -1, 0)
        turned = by_units.swapaxes(-1, -2)
        # Poses that a diverged fit has next to a singularity stay: corners at the height of the camera, for instance.
        values, products = np.asarray(rows.values).T[..., None], by_units @ turned
        finite = np.isfinite(products).all(axis=(1, 2)) & np.isfinite(values).all(axis=(1, 2))
        step = np.zeros((*turned.shape[:2], 1))
        step[finite] = turned[finite] @ pseudo_inverse(products[finite]) @ values[finite]
        size = np.linalg.norm(step, axis=1, keepdims=True)
        step = (step * np.minimum(1.0, _LONGEST_STEP / np.maximum(size, 1e-300)))[..., 0]
        poses = np.arange(len(q))[group.index]
        q[poses, : len(units)] -= units * step
    return observed.moved(arm, q)


_ZERO = 1e-9  # of what the function is elsewhere
# Of the whole function: what is left of it beside a constant, or a straight line. A first harmonic leaves 5 % of itself
# over 20 deg, and 0.4 % beside a straight line over 60 deg.
_NEARLY = 0.06
_SENTENCES = {
    "zero": (
        "{names}: the correction function is 0 in all {poses}, like the moment of gravity about a vertical axis; "
        "omit the coefficient, or let other joints move."
    ),
    "constant": (
        "{names} cannot be separated from the zero offset of joint {joint}, because the correction function is nearly "
        "constant over the {travel} that this joint moves; let the joint move farther, and record poses in more "
        "sockets."
    ),
    "line": (
        "{names} cannot be separated from the zero offset of joint {joint} and from other parameters, because the "
        "correction function is nearly a straight line over the {travel} that this joint moves; let the joint move "
        "farther."
    ),
}


def why_undetermined(
    arm: Arm, q: Float[np.ndarray, "N n"], groups: Iterable[tuple[tuple[str, ...], tuple[str, ...]]]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Reasons, one sentence for each joint and cause, and the names of coefficients without one.

    ``q`` are the poses of the capture, ``groups`` the names of parameters that the data do not, or hardly, tell apart,
    direction by direction: those that the direction is mostly of, and all.
    """
    if arm.corrections is None:
        return (), ()
    terms = {term.name: term for term in arm.corrections.functions.terms if isinstance(term, Term)}
    causes: dict[str, str] = {}
    for chief, names in groups:
        for name in chief:
            if name in terms and causes.get(name, "") != "line":  # which says more than that it is nearly constant
                causes[name] = _cause(arm, q, terms[name], names) or causes.get(name, "")
    names_by_cause: dict[tuple[str, int], list[str]] = {}
    for name, cause in causes.items():
        names_by_cause.setdefault((cause, terms[name].joint), []).append(name)
    sentences = []
    for (cause, joint), names in names_by_cause.items():
        travel = float(np.ptp(q[:, joint - 1]))
        moves = f"{travel:.3g} mm" if joint in arm.prismatic else f"{np.degrees(travel):.0f} deg"
        if cause:
            sentences.append(
                _SENTENCES[cause].format(
                    names=listed(names), joint=joint, travel=moves, poses=pluralise(len(q), "pose")
                )
            )
    return tuple(sentences), tuple(name for name, cause in causes.items() if not cause)


def _cause(arm: Arm, q: Float[np.ndarray, "N n"], term: Term, names: tuple[str, ...]) -> str:
    """A key of `_SENTENCES`; empty where the function is none of these."""
    assert arm.corrections is not None
    elsewhere = q + np.random.default_rng(0).uniform(-np.pi, np.pi, q.shape)
    everywhere, here = (function_values(arm, [term], poses)[0] for poses in (elsewhere, q))
    size = np.abs(everywhere).max()
    if size < _ZERO or np.abs(here).max() < _ZERO * size:
        return "zero"
    offset = f"{'d' if term.joint in arm.prismatic else 'theta'}_{term.joint}"
    reading, constant = q[:, term.joint - 1], np.ones(len(q))
    if offset in names and _left(here, [constant]) < _NEARLY * size:
        return "constant"
    lines = [] if isinstance(term.kind, Gravity) else [here]
    if term.name == f"{GearRatio().words[0]}_{term.joint}":  # the line itself, which harmonics may imitate
        waves = {f"cos1_{term.joint}": np.cos(reading), f"sin1_{term.joint}": np.sin(reading)}
        lines = [values for name, values in waves.items() if name in names]
    return "line" if any(_left(line, [constant, reading]) < _NEARLY * np.abs(line).max() for line in lines) else ""


def _left(values: Float[np.ndarray, " N"], rows: list[np.ndarray]) -> float:
    """The largest part that no combination of rows explains."""
    basis = np.stack(rows, axis=1)
    return float(np.abs(values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]).max())
