"""A sphere: the tip touches it, so it is at one distance from an unknown centre."""

import dataclasses
from collections.abc import Hashable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers, is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import length_and_direction, solve_positive_definite
from ...core.numpy_or_jax import AnyArray, namespace
from .columns import each_pose, no_covariance
from .frames import moved
from .observation import (
    POINT,
    READINGS,
    TARGET,
    AbstractObservation,
    AbstractSimulated,
    Entry,
    Quantity,
    Rows,
    Tips,
    Unknowns,
    checked_name,
    checked_readings,
    checked_scalar,
    checked_target,
    is_exact,
    numbers,
)

_SMALLEST_CAP = 20.0  # degrees from its middle: below it, centre and radius can hardly be told apart


class Sphere(AbstractObservation):
    """Touches of a sphere: the tip's centre is at (diameter + stylus) / 2 from an unknown centre.

    Args:
        name: Name of the sphere.
        q: Joint readings ``(m, n)``, rad.
        diameter: Certified diameter, mm; None where it is unknown.
        u: Standard uncertainty (k = 1) of the diameter, mm.
        stylus: Diameter of the tip's ball, mm; 0 where the tip itself is on the sphere, or where the diameter is
            unknown, which then includes it.
        target: Name of the tip, by default the arm's own probe.

    Raises:
        InputError: Shapes do not fit, or a diameter or uncertainty is negative.

    Example:
        >>> ball = aj.data.observations.Sphere("ball", capture.q[:12], diameter=25.0, u=0.0005, stylus=6.0)
        >>> print(ball.radius, [*ball.unknowns])
        15.5 ['centre of ball', 'radius of ball']
    """

    kind: ClassVar[str] = "sphere"
    table: ClassVar[str] = "touched_sphere"
    entries: ClassVar[tuple[Entry, ...]] = (
        READINGS,
        Entry("diameter", "certified diameter", "mm", uncertainty="u"),
        Entry("u", "standard uncertainty of the diameter", "mm"),
        Entry("stylus", "diameter of the tip's ball", "mm"),
        TARGET,
    )
    stated: ClassVar[tuple[str, ...]] = ("diameter", "stylus", "u")
    q: Float[AnyArray, "m n"]
    diameter: Float[AnyArray, ""] | None  # mm
    stylus: Float[AnyArray, ""]  # mm
    u: Float[AnyArray, ""]  # of the radius, mm
    name: str = eqx.field(static=True)
    target: str = eqx.field(static=True)
    point: bool = eqx.field(static=True)  # whether the radius is exactly 0: a socket
    free: bool = eqx.field(static=True)  # whether the radius is an unknown

    def __init__(
        self,
        name: str,
        q: Numbers,
        *,
        diameter: Numbers | None = None,
        u: Numbers = 0.0,
        stylus: Numbers = 0.0,
        target: str = "",
    ):
        self.name = checked_name(name, "a sphere")
        where = f"sphere '{name}'"
        self.q = checked_readings(where, q)
        self.target = checked_target(target)
        self.u = checked_scalar(f"u of {where}", u) / 2
        self.stylus = checked_scalar(f"stylus of {where}", stylus)
        self.diameter = None if diameter is None else checked_scalar(f"diameter of {where}", diameter)
        exact = is_exact(self.u)
        known = self.radius is not None and is_concrete(self.radius)
        self.point = known and exact and float(self.radius) == 0  # pyright: ignore[reportArgumentType]
        self.free = self.radius is None or not exact

    @property
    def radius(self) -> Float[AnyArray, "*batch"] | None:
        """Certified distance of the tip's centre from the centre, mm."""
        return None if self.diameter is None else (self.diameter + self.stylus) / 2

    @property
    def rows(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Residuals of each pose: of a sphere of radius 0 all three coordinates, else the distance."""
        return 3 if self.point else 1

    @property
    def centre(self) -> str:
        """Name of the unknown centre."""
        return f"centre of {self.name}"

    @property
    def size(self) -> str:
        """Name of the unknown radius."""
        return f"radius of {self.name}"

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        return {self.centre: POINT} | ({self.size: ("mm",)} if self.free else {})

    def stored(self) -> dict[str, Any]:
        return super().stored() | {"u": 2 * self.u}  # twice and half of a number are exact

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        if part != self.size or not float(self.stylus):
            return super().quantities(part, values)
        return (Quantity("without the tip's ball", values - float(self.stylus) / 2, "mm"),)

    @property
    def fixes_scale(self) -> bool:
        return self.radius is not None and not self.point

    @property
    def certified(self) -> dict[str, tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]]:
        return {self.size: (self.radius[None], self.u[None])} if self.free and self.radius is not None else {}

    @property
    def linear(self) -> bool:
        return self.point

    @property
    def alike(self) -> Hashable | None:
        return self.point, self.free, self.diameter is None

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        xp = namespace(tips)
        if self.point:
            return {self.centre: xp.mean(tips.position, axis=1)}
        centre, radius = fitted_sphere(tips.position)
        found = {self.centre: centre}
        if self.free:
            found[self.size] = (radius if self.radius is None else self.radius)[None]
        return found

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, m = namespace(tips, unknowns, self.u), self.q.shape[0]
        between = tips.position - unknowns[self.centre]
        if self.point:
            identity = each_pose(xp.asarray(np.eye(3)), m)
            return Rows(between, identity, {self.centre: -identity}, no_covariance(3, m))
        distance, towards = length_and_direction(between)
        direction = towards[None]
        radius: Any = unknowns[self.size][0] if self.free else self.radius
        by_unknowns = {self.centre: -direction.swapaxes(0, 1)}
        if self.free:
            by_unknowns[self.size] = -xp.ones((1, 1, m))
        return Rows((distance - radius)[None], direction, by_unknowns, no_covariance(1, m))

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        where = f"sphere '{self.name}'"
        if self.point:
            return
        needed = 4 if self.radius is None else 3
        if tips.shape[1] < needed:
            raise InputError(f"{where} has {tips.shape[1]} touches, but {needed} unknowns; touch it more often.")
        centre, _ = fitted_sphere(tips)
        directions = tips - np.asarray(centre)[:, None]
        directions = directions / np.linalg.norm(directions, axis=0)
        middle = directions.mean(axis=1)
        middle = middle / max(np.linalg.norm(middle), 1e-300)
        cap = float(np.degrees(np.arccos(np.clip((middle @ directions).min(), -1, 1))))
        if self.radius is None and cap < _SMALLEST_CAP:
            raise InputError(
                f"the touches of {where} cover a cap of {cap:.0f} degrees about its middle, which hardly separates "
                "centre and radius; touch it all over, or give its diameter."
            )


def fitted_sphere(tips: Float[AnyArray, "3 m"]) -> tuple[Float[AnyArray, " 3"], Float[AnyArray, ""]]:
    """Centre and radius of the sphere through points, by linear least squares: |t|^2 = 2 c.t + r^2 - |c|^2."""
    xp = namespace(tips)
    middle = xp.mean(tips, axis=1, keepdims=True)
    size = xp.sqrt(xp.mean((tips - middle) ** 2)) + 1e-12
    centred = (tips - middle) / size
    design = xp.concatenate([2 * centred, xp.ones_like(centred[:1])])
    normal = design @ design.T + 1e-12 * tips.shape[1] * xp.asarray(np.eye(4))
    solution = solve_positive_definite(normal, design @ xp.sum(centred**2, axis=0))
    radius = xp.sqrt(xp.maximum(solution[3] + xp.sum(solution[:3] ** 2), 0.0))
    return middle[:, 0] + size * solution[:3], size * radius


class SimulatedSphere(AbstractSimulated):
    """Touches all over a sphere, or over a cap of it.

    Args:
        name: Name of the sphere.
        centre: Its centre in the base frame ``(3,)``, mm.
        diameter: Its true diameter, mm.
        poses: Number of touches.
        certified: Whether the diameter is certified.
        u: Standard uncertainty of the certified diameter, mm.
        stylus: Diameter of the tip's ball, mm.

    Example:
        >>> ball = aj.data.observations.SimulatedSphere("ball", (300, 0, 300), 50.0, 25, u=0.001, stylus=6.0)
        >>> touched = aj.simulate(true, {}, observations=[ball]).observations[0]
        >>> print(touched.q.shape, f"{touched.radius:.2f} mm")
        (25, 6) 28.00 mm
    """

    table: ClassVar[str] = "touched_sphere"
    name: str = eqx.field(static=True)
    centre: np.ndarray = eqx.field(converter=numbers("centre", 3))
    diameter: float
    poses: int = eqx.field(static=True)
    certified: bool = eqx.field(static=True, default=True)
    u: float = 0.0
    stylus: float = 0.0

    def placed(self, name: str, frame: Float[np.ndarray, " 6"]) -> "SimulatedSphere":
        return dataclasses.replace(self, name=name, centre=moved(frame, self.centre))

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        directions = random.normal(size=(self.poses, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return self.centre + (self.diameter + self.stylus) / 2 * directions

    def recorded(
        self, q: Float[np.ndarray, "m n"], transforms: Float[np.ndarray, "m 4 4"], random: np.random.Generator
    ) -> Sphere:
        if not self.certified:
            return Sphere(self.name, q)
        diameter = self.diameter + self.u * random.normal()
        return Sphere(self.name, q, diameter=diameter, u=self.u, stylus=self.stylus)
