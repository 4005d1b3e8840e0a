"""Geometry that a calibration found and an evaluation keeps: a target's place in the last frame, an instrument's frame.

Given the parameters x, the numbers k of such a geometry are those that fit the poses of the calibration best, with a
covariance F by the scatter of these poses. So errors dx of the parameters come with dk = (dk/dx) dx + e, where e has
the covariance F and is independent of dx.
"""

from collections.abc import Container, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray
from .linear_propagation import Influence
from .linearisation import Linearisation

_NULL = 1e-10  # eigenvalues of the information on the shared geometry below this, of the largest, are zero


class KeptGeometry(eqx.Module):
    """Numbers of a geometry, mm and rad, and how they depend on the parameters of the complete uncertainty."""

    names: tuple[str, ...] = eqx.field(static=True)  # the part of each number
    values: Float[AnyArray, " k"]
    follow: Float[AnyArray, "k p"]  # derivatives by the parameters
    covariance: Float[AnyArray, "k k"]  # F

    @classmethod
    def of(cls, linear: Linearisation, parts: Sequence[str]) -> "KeptGeometry":
        """Some parts of the geometry of a calibration, linear at its solution. Raises `InputError` where its poses do
        not determine them."""
        p, positions = len(linear.space.names), linear.observed.positions
        index = np.concatenate([positions[name] for name in parts])
        names = tuple(name for name in parts for _ in positions[name])
        influence = linear.influence()
        pull = np.eye(len(linear.z) - p)[index]
        head, components = linear.observed.by_unknowns(pull, p)
        by_head = np.asarray(influence.eliminated(head, components))
        root, follow = fitted_geometry(influence, head_of(linear, None))
        pairs = zip(components, influence.d_inverses, strict=True)
        scatter = np.sum([np.einsum("qKk,Kkj,rKj->qr", part, inverse, part) for part, inverse in pairs], axis=0)
        own = by_head[:, p:]
        covariance = own @ root @ root.T @ own.T + scatter
        if np.any(np.diagonal(covariance) <= 0):
            raise InputError(f"the calibration does not determine {names[0]}, so it cannot be kept; leave out --keep.")
        by_parameters = by_head[:, :p] / np.asarray(linear.space.scale) - own @ follow
        return cls(names, np.asarray(linear.z)[p:][index], by_parameters, covariance)

    def select(self, parts: Container[str]) -> "KeptGeometry | None":
        """Only these parts; None where it has none of them."""
        chosen = np.array([name in parts for name in self.names])
        if not chosen.any():
            return None
        values, follow, covariance = (np.asarray(part) for part in (self.values, self.follow, self.covariance))
        names = tuple(name for name in self.names if name in parts)
        return KeptGeometry(names, values[chosen], follow[chosen], covariance[np.ix_(chosen, chosen)])

    @property
    def parts(self) -> dict[str, np.ndarray]:
        """The numbers of each part."""
        names = np.array(self.names, dtype=object)
        return {name: np.asarray(self.values)[names == name] for name in dict.fromkeys(self.names)}


class Head(NamedTuple):
    """The numbers of the head that are fitted, and the others: first those that are kept, then the parameters."""

    fitted: np.ndarray  # indices among the head's numbers, natural steps
    given: Float[np.ndarray, "h q"]  # by mm and rad of the others; where these are parameters, kept numbers follow

    def split(
        self, by_head: Float[np.ndarray, "h ..."]
    ) -> tuple[Float[np.ndarray, "s ..."], Float[np.ndarray, "q ..."]]:
        """Derivatives by the head as those by both."""
        return by_head[self.fitted], np.tensordot(self.given.T, by_head, 1)


def head_of(linear: Linearisation, kept: KeptGeometry | None) -> Head:
    """The head of a problem with some of its shared geometry kept."""
    p, height = len(linear.space.names), linear.height
    parameters = np.eye(height)[:, :p] / np.asarray(linear.space.scale)
    if kept is None:
        return Head(np.arange(p, height), parameters)
    index = np.concatenate([linear.observed.positions[name] for name in kept.parts])
    of_kept = np.eye(height)[:, p + index] / linear.observed.steps[index]
    given = np.concatenate([of_kept, parameters + of_kept @ np.asarray(kept.follow)], axis=1)
    return Head(np.setdiff1d(np.arange(p, height), p + index), given)


def fitted_geometry(influence: Influence, head: Head) -> tuple[Float[np.ndarray, "s b"], Float[np.ndarray, "s q"]]:
    """Of the shared geometry that is fitted, in natural steps: a root of its covariance, the others given; and how it
    follows these, with the opposite sign."""
    information = np.asarray(influence.information)[head.fitted]
    values, vectors = np.linalg.eigh(information[:, head.fitted])
    large = values > _NULL * values.max(initial=0.0)
    root = vectors[:, large] / np.sqrt(values[large])
    return root, root @ (root.T @ information @ head.given)
