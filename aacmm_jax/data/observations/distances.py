"""Distances of the tip from an unknown pivot: a telescoping ball bar, a draw wire."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.arrays import is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import length_and_direction, solve_positive_definite
from ...core.numpy_or_jax import AnyArray, namespace
from .declared import number, part, truth
from .frames import variances
from .observation import POINT, AbstractObservation, Parts, Rows, Tips, Unknowns
from .simulated import AbstractInBox, Readings, Transforms


class Distances(AbstractObservation):
    """Measured distances of the tip from a pivot whose position is unknown.

    Raises:
        InputError: Shapes do not fit, or a distance is not positive.

    Example:
        >>> bar = aj.data.observations.Distances("telescoping bar", capture.q[:3], [310.2, 352.7, 401.9], u=0.001)
        >>> print([*bar.unknowns])
        ['pivot of telescoping bar']
    """

    kind, table, rows = "distances", "distances", 1
    values: Float[AnyArray, " m"] = number("measured distance from the pivot", "mm", "pose")
    u: Float[AnyArray, " m"] = number(
        "standard uncertainty of a distance", "mm", "pose", default=0.0, spread=True, more="one number, or one each"
    )
    constant: bool = truth(
        "whether an unknown constant is added to all distances", more="as to those of a bar of unknown zero"
    )
    pivot = part("pivot of {name}", *POINT)
    zero = part("constant of {name}", "mm", when="constant")
    fixes_scale = True

    def completed(self, where: str) -> Mapping[str, Any]:
        if not self.constant and is_concrete(self.values) and np.any(np.asarray(self.values) <= 0):
            raise InputError(f"{where} has a distance that is not positive; give distances in mm, or constant=True.")
        return {}

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        xp = namespace(tips, self.values)
        middle = xp.mean(tips.position, axis=1, keepdims=True)
        size = xp.sqrt(xp.mean((tips.position - middle) ** 2)) + 1e-12
        centred, values = (tips.position - middle) / size, self.values / size
        # |t - p|^2 = (v + c)^2: linear in p, in |p|^2 - c^2 and, with the constant, in c.
        columns = [2 * centred, xp.ones_like(centred[:1])] + ([2 * values[None]] if self.constant else [])
        design = xp.concatenate(columns)
        normal = design @ design.T + 1e-12 * centred.shape[1] * xp.asarray(np.eye(len(design)))
        solution = solve_positive_definite(normal, design @ (xp.sum(centred**2, axis=0) - values**2))
        return {self.pivot: middle[:, 0] + size * solution[:3]} | (
            {self.zero: size * solution[4:]} if self.constant else {}
        )

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, m = namespace(tips, unknowns, self.values), self.q.shape[0]
        distance, towards = length_and_direction(tips.position - unknowns[self.pivot])
        by_unknowns = {self.pivot: -towards[:, None]}
        values = self.values
        if self.constant:
            values = values + unknowns[self.zero][0]
            by_unknowns[self.zero] = -xp.ones((1, 1, m))
        return Rows((distance - values)[None], towards[None], by_unknowns, variances(self.u, m))

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        needs = "pivot and constant need five" if self.constant else "pivot needs four"
        if tips.shape[1] < 4 + self.constant:
            raise InputError(f"observation '{self.name}' has {tips.shape[1]} distances, but its {needs}; measure more.")


class SimulatedDistances(AbstractInBox):
    """Distances from a pivot to random places in a box.

    Example:
        >>> box = [[200, -300, 100], [600, 300, 500]]
        >>> wire = aj.data.observations.SimulatedDistances("draw wire", box, 20, (1000, 0, 0), u=0.01)
        >>> print(aj.simulate(true, {}, observations=[wire]).observations[0].values.shape)
        (20,)
    """

    table = "distances"
    pivot: Float[np.ndarray, "3"] = number("pivot in the base frame", "mm", moves="point")
    u: float = number("standard uncertainty of each distance", "mm", default=0.0)

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Distances:
        true = np.linalg.norm(transforms[:, :3, 3] - self.pivot, axis=1)
        return Distances(self.name, q, true + self.u * random.normal(size=len(q)), u=self.u)
