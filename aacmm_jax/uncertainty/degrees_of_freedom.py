"""Degrees of freedom of a quantity, by what each part of its variance rests on, and the one coverage factor of every U.

A covariance is a sum of parts: the scatter of single poses, certified lengths and what instruments state, the
disagreement of the lengths, shared errors. A quantity with derivatives g has the variances v_i = g' C_i g of
these parts, and where each was estimated from nu_i degrees of freedom, those of their sum are (Welch 1947,
Satterthwaite 1946; JCGM 100, G.4.1)

    nu = (sum v_i)^2 / sum (v_i^2 / nu_i).

This takes the variance for nearly normal, or for a chi-square variable's multiple. The variance of an effect that three
placements show is neither: it may well be 0, or four times what is most probable. Such a part is described by its
posterior distribution (`Law.ratios`), and an error of the quantity is then distributed as a mixture of Student's t with
the variances that are possible, as the propagation of distributions has it (JCGM 101, 6.4.9; Bodnar, Link and Elster
2016, Bayesian Analysis 11, 25-45). The coverage factor is that of the mixture, the degrees of freedom those of
Student's t with the same factor for the coverage probability `LEVEL`.
"""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.distributions import student_density, student_quantile, student_tail
from ..core.errors import InputError
from ..core.linear_algebra import quadratic_forms
from ..core.numpy_or_jax import AnyArray, namespace, set_at
from .coverage import LEVEL

_DRAWS = 128  # combinations of the variances of several parts that have distributions
_ROUNDS = 24  # most steps of Newton's method to a coverage factor
_STEPS = (0.41421356237309515, 0.7320508075688772, 0.23606797749978969, 0.6457513110645906)  # fractions of square roots


class Law(NamedTuple):
    """How well the variances of c parts are known.

    A part's variance is estimated from ``degrees_of_freedom`` (infinite: exact), or has one of k ``ratios`` to the
    stated one, with probabilities ``weights``.
    """

    degrees_of_freedom: Float[AnyArray, " c"]
    ratios: Float[AnyArray, "c k"]
    weights: Float[AnyArray, "c k"]

    @classmethod
    def of(cls, degrees_of_freedom: Float[AnyArray, " c"]) -> "Law":
        """Of variances that were estimated from so many degrees of freedom."""
        certain = np.ones((len(degrees_of_freedom), 1))
        return cls(degrees_of_freedom, certain, certain)

    def of_parts(self, index: Any) -> "Law":
        """Of some of the parts."""
        return Law(*(values[index] for values in self))

    @property
    def in_numpy(self) -> "Law":
        """With NumPy's arrays."""
        return Law(*(np.asarray(values, dtype=float) for values in self))

    def joined(self, *others: "Law") -> "Law":
        """With further parts."""
        every = [self, *others]
        xp, most, padded = namespace(every), max(law.ratios.shape[1] for law in every), []
        for freedom, ratios, weights in every:
            further = ((0, 0), (0, most - ratios.shape[1]))
            padded.append((freedom, xp.pad(ratios, further, constant_values=1.0), xp.pad(weights, further)))
        return Law(*(xp.concatenate(parts) for parts in zip(*padded, strict=True)))


class Components(eqx.Module):
    """Parts of a covariance that rest on something else than its other parts do; names of what they rest on."""

    names: tuple[str, ...] = eqx.field(static=True)
    matrices: Float[AnyArray, "c p p"]
    law: Law

    @classmethod
    def of(cls, parts: dict[str, tuple[Float[AnyArray, "p p"], float]]) -> "Components | None":
        """Of matrices, each with its degrees of freedom."""
        if not parts:
            return None
        matrices, degrees_of_freedom = zip(*parts.values(), strict=True)
        xp = namespace(matrices)
        return cls(tuple(parts), xp.stack(matrices), Law.of(np.array(degrees_of_freedom)))

    def joined(self, other: "Components | None") -> "Components":
        """With further ones."""
        if other is None:
            return self
        xp = namespace(self, other)
        matrices = xp.concatenate([self.matrices, other.matrices])
        return Components((*self.names, *other.names), matrices, self.law.joined(other.law))

    def without(self, name: str) -> "Components | None":
        """Without one of them."""
        kept = np.array([i for i, part in enumerate(self.names) if part != name], dtype=int)
        if not len(kept):
            return None
        return Components(tuple(self.names[i] for i in kept), self.matrices[kept], self.law.of_parts(kept))

    def wider(self, free: np.ndarray, size: int) -> "Components":
        """Of ``size`` parameters, of which these are the ``free`` ones; the others are exact."""
        xp = namespace(self)
        matrices = set_at(xp.zeros((len(self.names), size, size)), (slice(None), *np.ix_(free, free)), self.matrices)
        return Components(self.names, matrices, self.law)

    def variances(self, derivatives: Float[AnyArray, "... p"]) -> Float[AnyArray, "... c"]:
        """Of quantities with these derivatives by the parameters."""
        xp = namespace(self, derivatives)
        return xp.stack([quadratic_forms(derivatives, matrix) for matrix in self.matrices], axis=-1)


def effective_degrees_of_freedom(
    variances: Float[np.ndarray, "... c"], degrees_of_freedom: Float[np.ndarray, " c"]
) -> Float[np.ndarray, "..."]:
    """Of sums of independent variances (Welch and Satterthwaite); infinite where no part that counts is estimated."""
    variances = np.asarray(variances, dtype=float)
    # Relative to the largest, so that the variance of an angle of a microradian does not underflow.
    largest = np.max(np.abs(variances), axis=-1, initial=0.0, keepdims=True)
    relative = variances / np.where((largest > 0) & np.isfinite(largest), largest, 1.0)
    below = np.sum(relative**2 / degrees_of_freedom, axis=-1)
    return np.asarray(np.where(below > 0, np.sum(relative, axis=-1) ** 2 / np.where(below > 0, below, 1.0), np.inf))


def coverage_factor(level: float, variances: Float[AnyArray, "... c"], law: Law) -> Float[np.ndarray, "..."]:
    """The factor of U over u, for a coverage probability, of quantities with these variances of their parts, whose sum
    is u^2; ``law`` says how well each is known."""
    if not 0 < level < 1:
        raise InputError(f"level is {level:g}; give a probability between 0 and 1, for example {LEVEL:g}.")
    law, variances = law.in_numpy, np.asarray(variances, dtype=float)
    variances = np.where(np.all(np.isfinite(variances), axis=-1)[..., None], variances, 0.0)
    freedom = effective_degrees_of_freedom(variances, np.asarray(law.degrees_of_freedom))
    factors, total = np.array(student_quantile(0.5 + level / 2, freedom)), np.sum(variances, axis=-1)
    spread = np.flatnonzero(np.sum(np.asarray(law.weights) > 0, axis=1) > 1)
    mixed = np.any(variances[..., spread] > 1e-9 * total[..., None], axis=-1) & (total > 0)
    if mixed.any():
        factors[mixed] = _of_mixtures(level, variances[mixed], law, spread)
    return factors


def degrees_of_freedom(variances: Float[AnyArray, "... c"], law: Law) -> Float[np.ndarray, "..."]:
    """Those of Student's t with the same coverage factor for the coverage probability `LEVEL`."""
    from scipy import special

    plain = effective_degrees_of_freedom(np.asarray(variances, dtype=float), np.asarray(law.degrees_of_freedom))
    factor, normal = coverage_factor(LEVEL, variances, law), special.ndtri(0.5 + LEVEL / 2)
    # Very many are infinitely many: the inverse has no more digits there.
    mixed = special.stdtridf(0.5 + LEVEL / 2, np.maximum(factor, normal * (1 + 1e-6)))
    same = np.abs(student_quantile(0.5 + LEVEL / 2, plain) - factor) < 1e-9 * factor
    return np.where(same, plain, np.where(factor > normal * (1 + 1e-6), mixed, np.inf))


def _of_mixtures(
    level: float, variances: Float[np.ndarray, "m c"], law: Law, spread: np.ndarray
) -> Float[np.ndarray, " m"]:
    """Coverage factors of quantities of whose variance some parts have distributions.

    Possible variances of all parts over the stated ones: all of one part that has a distribution, and of several a
    lattice (Kronecker's sequence), which has as many of each.
    """
    first, *further = spread
    chances = np.asarray(law.weights)[first]
    ratios, weights = np.ones((int(np.sum(chances > 0)), variances.shape[1])), chances[chances > 0]
    ratios[:, first] = np.asarray(law.ratios)[first, chances > 0]
    if further:
        number, weights = np.arange(_DRAWS), np.full(_DRAWS, 1 / _DRAWS)
        ratios = np.ones((_DRAWS, variances.shape[1]))
        for i, part in enumerate(spread):
            order = np.argsort(law.ratios[part])
            possible, chances = np.asarray(law.ratios)[part, order], np.asarray(law.weights)[part, order]
            at = (number + 0.5) / _DRAWS if i == 0 else (0.5 + number * _STEPS[(i - 1) % len(_STEPS)]) % 1.0
            ratios[:, part] = np.interp(at, np.cumsum(chances) - 0.5 * chances, possible)
    total = np.sum(variances, axis=1)
    parts = variances[:, None, :] * ratios  # (m, draws, c)
    possible = np.maximum(np.sum(parts, axis=2), 1e-12 * total[:, None])
    freedom = effective_degrees_of_freedom(parts, np.asarray(law.degrees_of_freedom))
    root = np.sqrt(possible / total[:, None])
    both = student_quantile(0.5 + level / 2, freedom) * root
    low, high = both.min(axis=1), both.max(axis=1)
    # Newton's method: what lies outside is a convex function of the factor, so it converges from below, and from above
    # its first step ends below.
    factors = np.sum(weights * both, axis=1)
    for _ in range(_ROUNDS):
        scaled = factors[:, None] / root
        outside = np.sum(weights * student_tail(scaled, freedom), axis=1)
        slope = -2 * np.sum(weights * student_density(scaled, freedom) / root, axis=1)
        last, factors = factors, np.clip(factors - (outside - (1 - level)) / slope, low, high)
        if np.all(np.abs(factors - last) <= 1e-9 * factors):
            break
    return factors
