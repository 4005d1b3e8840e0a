"""Distances of the tip from an unknown pivot: a telescoping ball bar, a draw wire."""

import dataclasses
from collections.abc import Hashable, Mapping
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers, as_floats, is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import length_and_direction, solve_positive_definite
from ...core.numpy_or_jax import AnyArray, namespace
from .columns import variances
from .frames import moved
from .observation import (
    POINT,
    READINGS,
    TARGET,
    AbstractObservation,
    AbstractSimulated,
    Entry,
    Rows,
    Tips,
    Unknowns,
    checked_name,
    checked_readings,
    checked_target,
    checked_truth,
    checked_values,
    numbers,
)


class Distances(AbstractObservation):
    """Measured distances of the tip from a pivot whose position is unknown.

    Args:
        name: Name of the observation.
        q: Joint readings ``(m, n)``, rad.
        values: Measured distances ``(m,)``, mm.
        u: Standard uncertainty (k = 1) of the distances, mm: one number, or one each ``(m,)``.
        constant: Whether an unknown constant is added to all distances (a bar of unknown zero).
        target: Name of the tip, by default the arm's own probe.

    Raises:
        InputError: Shapes do not fit, or a distance is not positive.

    Example:
        >>> bar = aj.data.observations.Distances("telescoping bar", capture.q[:3], [310.2, 352.7, 401.9], u=0.001)
        >>> print([*bar.unknowns])
        ['pivot of telescoping bar']
    """

    kind: ClassVar[str] = "distances"
    by_pose: ClassVar[tuple[str, ...]] = ("q", "values", "u")
    table: ClassVar[str] = "distances"
    entries: ClassVar[tuple[Entry, ...]] = (
        READINGS,
        Entry("values", "measured distance from the pivot", "mm", ("pose",), required=True),
        Entry("u", "standard uncertainty of a distance", "mm", ("pose",)),
        Entry("constant", "whether an unknown constant is added to all distances", content="truth"),
        TARGET,
    )
    rows: ClassVar[int] = 1
    q: Float[AnyArray, "m n"]
    values: Float[AnyArray, " m"]
    u: Float[AnyArray, " m"]
    name: str = eqx.field(static=True)
    target: str = eqx.field(static=True)
    constant: bool = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        q: Numbers,
        values: Numbers,
        *,
        u: Numbers = 0.0,
        constant: bool = False,
        target: str = "",
    ):
        self.name = checked_name(name, "an observation")
        where = f"observation '{name}'"
        self.q = checked_readings(where, q)
        self.values = checked_values(f"distances of {where}", values, (self.q.shape[0],))
        self.u = _checked_u(where, u, self.q.shape[0])
        self.target = checked_target(target)
        self.constant = checked_truth(f"constant of {where}", constant)
        if not self.constant and is_concrete(self.values) and np.any(np.asarray(self.values) <= 0):
            raise InputError(f"{where} has a distance that is not positive; give distances in mm, or constant=True.")

    @property
    def pivot(self) -> str:
        """Name of the unknown pivot."""
        return f"pivot of {self.name}"

    @property
    def zero(self) -> str:
        """Name of the unknown constant."""
        return f"constant of {self.name}"

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        return {self.pivot: POINT} | ({self.zero: ("mm",)} if self.constant else {})

    @property
    def fixes_scale(self) -> bool:
        return True

    @property
    def alike(self) -> Hashable | None:
        return ()

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        xp = namespace(tips, self.values)
        middle = xp.mean(tips.position, axis=1, keepdims=True)
        size = xp.sqrt(xp.mean((tips.position - middle) ** 2)) + 1e-12
        centred, values = (tips.position - middle) / size, self.values / size
        # |t - p|^2 = (v + c)^2: linear in p, in |p|^2 - c^2 and, with the constant, in c.
        columns = [2 * centred, xp.ones_like(centred[:1])] + ([2 * values[None]] if self.constant else [])
        design = xp.concatenate(columns)
        normal = design @ design.T + 1e-12 * centred.shape[1] * xp.asarray(np.eye(len(design)))
        solution = solve_positive_definite(normal, design @ (xp.sum(centred**2, axis=0) - values**2))
        found = {self.pivot: middle[:, 0] + size * solution[:3]}
        return found | ({self.zero: size * solution[4:]} if self.constant else {})

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, m = namespace(tips, unknowns, self.values), self.q.shape[0]
        between = tips.position - unknowns[self.pivot]
        distance, towards = length_and_direction(between)
        direction = towards[None]
        by_unknowns = {self.pivot: -direction.swapaxes(0, 1)}
        values = self.values
        if self.constant:
            values = values + unknowns[self.zero][0]
            by_unknowns[self.zero] = -xp.ones((1, 1, m))
        return Rows((distance - values)[None], direction, by_unknowns, variances(self.u, m))

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        needs = "pivot and constant need five" if self.constant else "pivot needs four"
        if tips.shape[1] < 4 + self.constant:
            raise InputError(f"observation '{self.name}' has {tips.shape[1]} distances, but its {needs}; measure more.")


def _checked_u(where: str, u: Numbers, poses: int) -> AnyArray:
    array = as_floats(u, f"u of {where}")
    if array.shape not in ((), (poses,)):
        raise InputError(f"u of {where} has shape {array.shape}; give one number, or ({poses},).")
    if is_concrete(array) and np.any(np.asarray(array) < 0):
        raise InputError(f"u of {where} is negative; a standard uncertainty must be zero or positive.")
    return namespace(array).broadcast_to(array, (poses,))


class SimulatedDistances(AbstractSimulated):
    """Distances from a pivot to random places in a box.

    Args:
        name: Name of the observation.
        box: Lowest and highest coordinates of the tip ``(2, 3)`` in the base frame, mm.
        poses: Number of distances.
        pivot: The pivot in the base frame ``(3,)``, mm.
        u: Standard uncertainty of each distance, mm.

    Example:
        >>> box = [[200, -300, 100], [600, 300, 500]]
        >>> wire = aj.data.observations.SimulatedDistances("draw wire", box, 20, (1000, 0, 0), u=0.01)
        >>> print(aj.simulate(true, {}, observations=[wire]).observations[0].values.shape)
        (20,)
    """

    table: ClassVar[str] = "distances"
    name: str = eqx.field(static=True)
    box: np.ndarray = eqx.field(converter=numbers("box", 2, 3))
    poses: int = eqx.field(static=True)
    pivot: np.ndarray = eqx.field(converter=numbers("pivot", 3))
    u: float = 0.0

    def placed(self, name: str, frame: Float[np.ndarray, " 6"]) -> "SimulatedDistances":
        return dataclasses.replace(self, name=name, pivot=moved(frame, self.pivot))

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        return random.uniform(self.box[0], self.box[1], (self.poses, 3))

    def recorded(
        self, q: Float[np.ndarray, "m n"], transforms: Float[np.ndarray, "m 4 4"], random: np.random.Generator
    ) -> Distances:
        true = np.linalg.norm(transforms[:, :3, 3] - self.pivot, axis=1)
        return Distances(self.name, q, true + self.u * random.normal(size=len(q)), u=self.u)
