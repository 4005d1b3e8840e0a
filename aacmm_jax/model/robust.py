"""Robust losses: how much less than its square a large residual counts.

They act on the norm of a pose's whitened residual, so that a bad pose loses weight as a whole. With s = |r|^2 / c^2 and
c the tuning constant of `Loss`, the cost of a pose is c^2 / 2 rho(s), and its weight rho'(s).
Sources: Huber 1964; Holland and Welsch 1977 (Cauchy); Beaton and Tukey 1974; Triggs et al. 2000.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.distributions import chi_square_quantile, chi_square_tail
from ..core.numpy_or_jax import AnyArray, namespace
from .loss_names import LossName

_EFFICIENCY = 0.95  # for normal residuals
# The least curvature of a loss along a residual, relative to that across it: beyond c it would be 0 or negative.
_LEAST_CURVATURE = 0.01


class _Shape(NamedTuple):
    """A loss by three functions of s: rho, the weight rho', and the curvature of the cost along the residual over that
    across it, which is the weight: 1 + 2 s rho'' / rho'. The first argument of each is NumPy or JAX's NumPy."""

    rho: Callable[[Any, Any], Any]
    weight: Callable[[Any, Any], Any]
    curvature: Callable[[Any, Any], Any]


def _root_outside(xp: Any, s: Any) -> Any:
    """The square root of s beyond 1, and 1 inside, where its derivative would be infinite at 0."""
    return xp.sqrt(xp.where(s <= 1, 1.0, s))


_SHAPES: dict[LossName, _Shape] = {
    "huber": _Shape(
        rho=lambda xp, s: xp.where(s <= 1, s, 2 * _root_outside(xp, s) - 1),
        weight=lambda xp, s: 1 / _root_outside(xp, s),
        curvature=lambda xp, s: xp.where(s <= 1, 1.0, 0.0),
    ),
    "cauchy": _Shape(
        rho=lambda xp, s: xp.log1p(s),
        weight=lambda xp, s: 1 / (1 + s),
        curvature=lambda xp, s: (1 - s) / (1 + s),
    ),
    "tukey": _Shape(
        # (1 - (1 - s)^3) / 3 up to 1, without its cancellation at small s.
        rho=lambda xp, s: xp.minimum(s, 1.0) * (1 - xp.minimum(s, 1.0) + xp.minimum(s, 1.0) ** 2 / 3),
        weight=lambda xp, s: (1 - xp.minimum(s, 1.0)) ** 2,
        curvature=lambda xp, s: (1 - 5 * xp.minimum(s, 0.5)) / (1 - xp.minimum(s, 0.5)),  # negative beyond a fifth
    ),
}


@cache
def tuning_constant(name: LossName, rows: int) -> float:
    """The constant c of a loss with which it is 95 % efficient for normal residuals of so many rows, to 3 decimals.

    The efficiency of the estimate of a shift is A^2 / B with A = E[w + 2/r w' |x|^2] and B = E[w^2 |x|^2] / r, where w
    is the weight and |x| has the chi distribution with r degrees of freedom (Hampel et al. 1986, section 4.2). With
    many rows even a tiny c is more efficient than that; then a quarter of good poses has |x| < c.
    """
    root = np.linspace(0.0, np.sqrt(rows) + 8.0, 4_001)
    exponent = (rows - 1) * np.log(np.maximum(root, 1e-300)) - 0.5 * root**2
    density = np.exp(exponent - exponent.max())
    density[0] /= 2  # as the trapezoidal rule counts it
    density /= density.sum()
    low, high = np.sqrt(chi_square_quantile(0.25, rows)), 20.0 + 2 * np.sqrt(rows)
    while high - low > 1e-6:
        c = 0.5 * (low + high)
        weight = _SHAPES[name].weight(np, (root / c) ** 2)
        # w' |x|^2 as half the derivative by |x|, times |x|.
        a = np.sum(density * (weight + np.gradient(weight, root) * root / rows))
        b = np.sum(density * weight**2 * root**2) / rows
        low, high = (c, high) if a**2 < _EFFICIENCY * b else (low, c)
    return round(float(high), 3)


def median_square(rows: int) -> float:
    """The median of |x|^2 for normal residuals of so many rows."""
    return chi_square_quantile(0.5, rows)


def bounded_square(rows: int) -> tuple[float, float]:
    """The 95 % point of |x|^2 for normal residuals, and the mean of a row's square where larger ones count as that.

    The mean is F(b; r + 2) + b (1 - F(b; r)) / r, with the chi-square distribution function F at the point b.
    """
    most = chi_square_quantile(0.95, rows)
    return most, 1 - chi_square_tail(most, rows + 2) + most * chi_square_tail(most, rows) / rows


class Loss(eqx.Module):
    """A robust loss by its name."""

    name: LossName = eqx.field(static=True)

    def square_of(self, white: Float[AnyArray, "r m"], counts: tuple[int, ...] = ()) -> Any:
        """c^2: one for all poses, or one each by how many equations each gives."""
        if not counts:
            return tuning_constant(self.name, white.shape[0]) ** 2
        squares = {count: tuning_constant(self.name, count) ** 2 for count in set(counts)}
        return namespace(white).asarray(np.array([squares[count] for count in counts]))

    def cost_and_weight(
        self, white: Float[AnyArray, "r m"], counts: tuple[int, ...] = ()
    ) -> tuple[Float[AnyArray, " m"], Float[AnyArray, " m"]]:
        """Cost and weight of every pose; ``counts`` are their equations, where these are not the rows."""
        xp, c2 = namespace(white), self.square_of(white, counts)
        s = xp.sum(white**2, axis=0) / c2
        return 0.5 * c2 * _SHAPES[self.name].rho(xp, s), _SHAPES[self.name].weight(xp, s)

    def along(self, white: Float[AnyArray, "r m"], counts: tuple[int, ...] = ()) -> Float[AnyArray, " m"]:
        """Square roots of the ratios q of two curvatures of the cost of every pose: along its residual, and across it.

        The second derivative of the cost by the residual r is w (1 + (q - 1) u u^T), with the weight w and the
        direction u of r. Negative curvatures, by which a step would lead uphill, are left out (Triggs et al. 2000,
        4.3). Steps by weights alone (q = 1) converge the more slowly the more poses of a socket are beyond c.
        """
        xp, c2 = namespace(white), self.square_of(white, counts)
        return xp.sqrt(xp.maximum(_SHAPES[self.name].curvature(xp, xp.sum(white**2, axis=0) / c2), _LEAST_CURVATURE))

    def transformed(self, white: Float[AnyArray, "r m"], counts: tuple[int, ...] = ()) -> Float[AnyArray, "r m"]:
        """Residuals whose squares are twice the cost."""
        xp, square = namespace(white), namespace(white).sum(white**2, axis=0)
        small = square < 1e-12 * self.square_of(white, counts)
        cost = xp.where(small, 0.5, self.cost_and_weight(white, counts)[0])
        factor = xp.sqrt(2 * cost / xp.where(small, 1.0, square))
        return xp.where(small, 1.0, factor)[None] * white
