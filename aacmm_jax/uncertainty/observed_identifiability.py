"""What observations of all kinds determine: their derivatives by the parameters, with the unknown geometry eliminated.

A rank must not follow from errors of an arm that is not yet calibrated, so what an instrument measured is first
replaced by what it would measure of this arm, in the geometry that fits best; the configurations of other observations
are moved, a few milliradians at most, to where the tips agree with that geometry. (An arm of few joints cannot be moved
to agree with a measured transform.)
"""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.chain import reading_units
from ..kinematics.parameters import Parameters
from ..model.observed import Observed, certified_and_lengths, linear_rows, whitened, whitening_of
from .tip_errors import ArmErrors, arm_errors, covariance_of_noise, covariance_of_sigma

_ROUNDS = 15
_LONGEST_STEP = 0.1  # rad, of a configuration
_AGREES = 1e-9  # mm or rad
_NULL = 1e-10  # singular values of the geometry below this, of the largest, are zero
_MOVED = 1e-4  # of the largest change: parts of the geometry that change less do not follow
_NAMED = 2


class Eliminated(NamedTuple):
    """Derivatives by the parameters in natural steps, after the geometry has followed as well as it can."""

    poses: Float[np.ndarray, "r p"]  # of the rows of all poses
    relations: Float[np.ndarray, "l p"]  # of reference lengths and certified values
    geometry: Float[np.ndarray, "g p"]  # how the geometry follows, natural steps


class Agreeing(NamedTuple):
    """Observations whose configurations agree exactly with one arm and one geometry."""

    observed: Observed
    space: Parameters
    linear: list
    errors: list[ArmErrors]
    relations: Float[np.ndarray, "l z"]  # derivatives of lengths and certified values
    u: Float[np.ndarray, " l"]  # their standard uncertainties, mm

    @classmethod
    def of(cls, observed: Observed, space: Parameters) -> "Agreeing":
        """Fit the geometry, and make measured values and configurations agree with it."""
        p = len(space.names)
        z = np.concatenate([np.asarray(space.vector()), np.zeros(len(observed.steps))])
        z[p:] = np.asarray(observed.start(space, z[:p]))
        for _ in range(_ROUNDS):
            linear, errors = _linear(observed, space, z)
            unit = _whitening(observed, linear, [covariance_of_sigma(error, np.asarray(1.0)) for error in errors])
            dense, values = dense_rows(linear, unit.roots, len(z))
            step = np.linalg.lstsq(dense[:, p:] * observed.steps, -values, rcond=_NULL)[0] * observed.steps
            z[p:] += step
            if np.max(np.abs(step), initial=0.0) < 1e-8:
                break
        observed = observed.measured_without_errors(space, z[:p], z[p:])
        for _ in range(_ROUNDS):
            linear, errors = _linear(observed, space, z)
            if max(np.abs(part.rows.values).max() for part in linear) < _AGREES:
                break
            observed = _moved(observed, space.base, linear, errors)
        relations, u = certified_and_lengths(observed, z, p)
        return cls(observed, space, linear, errors, relations, u)

    def eliminated(self, noise: Noise | None = None, sigma: float | None = None) -> Eliminated:
        """In standard deviations by the noise, or by that of a tip coordinate; else in mm."""
        measured = noise is not None or sigma is not None
        if noise is not None:
            of_arm = [covariance_of_noise(error, noise) for error in self.errors]
        else:
            of_arm = [covariance_of_sigma(error, np.asarray(1.0 if sigma is None else sigma)) for error in self.errors]
        whitening = _whitening(self.observed, self.linear, of_arm, measured)
        p, steps = len(self.space.names), self.observed.steps
        # Poses that this arm cannot take, next to a singularity, would look like information.
        agree = [np.abs(part.rows.values).max(axis=0) < _AGREES for part in self.linear]
        roots = tuple(root * kept[:, None, None] for root, kept in zip(whitening.roots, agree, strict=True))
        poses, _ = dense_rows(self.linear, roots, p + len(steps))
        u = np.maximum(self.u, 1e-6) if measured else np.ones_like(self.u)
        rows = np.concatenate([poses, self.relations / u[:, None]])
        parameters, geometry = rows[:, :p] * np.asarray(self.space.scale), rows[:, p:] * steps
        basis, singular, vectors = np.linalg.svd(geometry, full_matrices=False)
        known = singular > _NULL * max(singular[0], 1e-300)
        basis, along = basis[:, known], basis[:, known].T @ parameters
        rest = parameters - basis @ along
        follow = -vectors[known].T @ (along / singular[known, None])
        return Eliminated(rest[: len(poses)], rest[len(poses) :], follow)

    def named(self, texts: tuple[str, ...], null: Float[np.ndarray, "p nullity"]) -> tuple[str, ...]:
        """Names of undetermined directions with the parts of the geometry that follow them."""
        follow = self.eliminated().geometry @ null
        found = []
        for text, change, direction in zip(texts, follow.T, null.T, strict=True):
            least = _MOVED * np.abs(direction).max()
            parts = [name for name, rows in self.observed.positions.items() if np.abs(change[rows]).max() > least]
            found.append(text if not parts or "the scale" in text else _with_parts(text, parts))
        return tuple(found)


def _with_parts(text: str, parts: list[str]) -> str:
    names = text.removesuffix(" trade off").split(" (changes nothing")[0].replace(" and ", ", ")
    if len(parts) > _NAMED + 1:
        parts = [*parts[:_NAMED], f"{len(parts) - _NAMED} more parts of the geometry"]
    *first, last = [*names.split(", "), *parts]
    return f"{', '.join(first)} and {last} trade off"


def _linear(observed: Observed, space: Parameters, z: Float[np.ndarray, " z"]) -> tuple[list, list[ArmErrors]]:
    p = len(space.names)
    linear = linear_rows(space, observed, z)
    return linear, arm_errors(observed.forward(space, z[:p], z[p:]), linear, observed)


def _whitening(observed: Observed, linear: list, of_arm: list[Float[AnyArray, "_ _ _"]], measured: bool = False) -> Any:
    if not measured:  # rows in mm, whatever the uncertainty of what was measured
        rows = [part.rows._replace(measured=np.zeros_like(part.rows.measured)) for part in linear]
        linear = [part._replace(rows=row) for part, row in zip(linear, rows, strict=True)]
    return whitening_of(linear, observed, of_arm, np.asarray(1e-6))


def dense_rows(
    linear: list, roots: tuple[Float[AnyArray, "_ _ _"], ...], size: int
) -> tuple[Float[np.ndarray, "r z"], Float[np.ndarray, " r"]]:
    """All derivatives as one matrix, and the residuals."""
    blocks, values = [], []
    for part, root in zip(linear, roots, strict=True):
        white, jacobian = whitened(part, root)
        block = np.zeros((white.size, size))
        block[:, part.indices] = np.asarray(jacobian).reshape(len(part.indices), -1).T
        blocks.append(block)
        values.append(np.asarray(white).ravel())
    return np.concatenate(blocks), np.concatenate(values)


def _moved(observed: Observed, arm: Arm, linear: list, errors: list[ArmErrors]) -> Observed:
    """With configurations one step of Gauss and Newton closer to the geometry, of all such steps the shortest."""
    new, units = [], reading_units(arm.geometry)
    for observation, part, error in zip(observed.observations, linear, errors, strict=True):
        by_units = np.moveaxis(np.asarray(error.by_readings) * units[:, None], -1, 0)
        step = np.einsum("mnr,rm->mn", np.linalg.pinv(by_units, rcond=1e-6), np.asarray(part.rows.values))
        size = np.linalg.norm(step, axis=1, keepdims=True)
        step = step * np.minimum(1.0, _LONGEST_STEP / np.maximum(size, 1e-300))
        q = np.asarray(observation.q).copy()
        q[:, : len(units)] -= units * step
        new.append(q)
    observations = tuple(
        eqx.tree_at(lambda o: o.q, observation, q) for observation, q in zip(observed.observations, new, strict=True)
    )
    return observed.moved(arm, np.concatenate(new), observations)
