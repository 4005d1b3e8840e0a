"""Robust losses: how much less than its square a large residual counts.

They act on the norm of a pose's whitened residual, so that a bad pose loses weight as a whole. With s = |r|^2 / c^2 and
c the tuning constant of `Loss`, the cost of a pose is c^2 / 2 rho(s), and its weight rho'(s).
Sources: Huber 1964; Holland and Welsch 1977 (Cauchy); Beaton and Tukey 1974; Triggs et al. 2000.
"""

from typing import Literal, get_args

import equinox as eqx
from jaxtyping import Float

from ..core.arguments import shown
from ..core.errors import InputError
from ..core.module import Module
from ..core.numpy_or_jax import AnyArray, namespace

LossName = Literal["huber", "cauchy", "tukey"]
LOSSES = get_args(LossName)

# Constants of 95 % efficiency for normal residuals of r rows a pose (tests/model/test_robust.py integrates them).
TUNING = {
    "huber": {1: 1.345, 3: 1.628, 6: 1.869},
    "cauchy": {1: 2.385, 3: 2.666, 6: 2.862},
    "tukey": {1: 4.685, 3: 5.490, 6: 6.356},
}
# Medians of the chi-square distribution: of the square of a pose's whitened residual.
MEDIANS = {1: 0.454936, 3: 2.365974, 6: 5.348121}
# Its 95 % point, and what remains of its expectation, of 1 a row, where larger squares count as one at that point.
BOUNDED_SQUARES = {1: (3.841459, 0.912972), 3: (7.814728, 0.963499), 6: (12.591587, 0.978234)}


def check_loss(robust: object) -> None:
    """Raise `InputError` for what is neither the name of a loss nor None."""
    if robust is not None and not (isinstance(robust, str) and robust in LOSSES):
        raise InputError(f"robust is {shown(robust)}; it must be one of {', '.join(LOSSES)}, or None.")


class Loss(Module):
    """A robust loss by its name."""

    name: LossName = eqx.field(static=True)

    def _constant(self, rows: int) -> float:
        return TUNING[self.name][rows]

    def cost_and_weight(self, white: Float[AnyArray, "r m"]) -> tuple[Float[AnyArray, " m"], Float[AnyArray, " m"]]:
        """Cost and weight of every pose."""
        xp, c2 = namespace(white), self._constant(white.shape[0]) ** 2
        s = xp.sum(white**2, axis=0) / c2
        if self.name == "huber":
            inside = s <= 1
            root = xp.sqrt(xp.where(inside, 1.0, s))
            rho, weight = xp.where(inside, s, 2 * root - 1), 1 / root
        elif self.name == "cauchy":
            rho, weight = xp.log1p(s), 1 / (1 + s)
        else:
            inside = xp.minimum(s, 1.0)
            rho, weight = inside * (1 - inside + inside**2 / 3), (1 - inside) ** 2
        return 0.5 * c2 * rho, weight

    def transformed(self, white: Float[AnyArray, "r m"]) -> Float[AnyArray, "r m"]:
        """Residuals whose squares are twice the cost."""
        xp, c2 = namespace(white), self._constant(white.shape[0]) ** 2
        square = xp.sum(white**2, axis=0)
        small = square < 1e-12 * c2
        cost, _ = self.cost_and_weight(white)
        factor = xp.sqrt(2 * xp.where(small, 0.5, cost) / xp.where(small, 1.0, square))
        return xp.where(small, 1.0, factor)[None] * white
