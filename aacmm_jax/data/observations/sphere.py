"""A sphere: the tip touches it, so it is at one distance from an unknown centre."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.arrays import is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import length_and_direction
from ...core.numpy_or_jax import AnyArray, namespace
from .declared import count, derived, is_exact, number, part, truth
from .fits import fitted_sphere
from .frames import each_pose, no_covariance
from .observation import POINT, AbstractObservation, Certified, Parts, Quantity, Rows, Tips, Unknowns
from .simulated import AbstractSimulated, Readings, Transforms

_SMALLEST_CAP = 20.0  # degrees from its middle: below it, centre and radius can hardly be told apart


class AbstractRound(AbstractObservation):
    """Touches of a surface of one diameter, which may be certified: the tip's centre is at one distance, the radius,
    from what is in its middle."""

    diameter: Float[AnyArray, ""] | None = number(
        "certified diameter", "mm", default=None, uncertainty="u", more="None where it is unknown"
    )
    u: Float[AnyArray, ""] = number("standard uncertainty of the diameter", "mm", default=0.0)
    stylus: Float[AnyArray, ""] = number(
        "diameter of the tip's ball", "mm", default=0.0,
        more="0 where the tip itself is on the surface, or where the diameter is unknown, which then includes it",
    )  # fmt: skip
    free: bool = derived()  # whether the radius is an unknown
    fixes_scale: bool = derived()
    size: str
    inside = False

    @property
    def radius(self) -> Float[AnyArray, "*batch"] | None:
        """Certified distance of the tip's centre from the middle, mm."""
        if self.diameter is None:
            return None
        return (self.diameter - self.stylus if self.inside else self.diameter + self.stylus) / 2

    def radius_at(self, unknowns: Unknowns) -> Any:
        """The radius in a residual."""
        return unknowns[self.size][0] if self.free else self.radius

    @property
    def certified(self) -> Certified:
        return {self.size: (self.radius[None], self.u[None] / 2)} if self.free and self.radius is not None else {}

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        if part != self.size or not float(self.stylus):
            return super().quantities(part, values)
        ball = float(self.stylus) / 2
        return (Quantity("without the tip's ball", values + ball if self.inside else values - ball, "mm"),)


class Sphere(AbstractRound):
    """Touches of a sphere: the tip's centre is at (diameter + stylus) / 2 from an unknown centre.

    Raises:
        InputError: Shapes do not fit, or a diameter or uncertainty is negative.

    Example:
        >>> ball = aj.data.observations.Sphere("ball", capture.q[:12], diameter=25.0, u=0.0005, stylus=6.0)
        >>> print(ball.radius, [*ball.unknowns])
        15.5 ['centre of ball', 'radius of ball']
    """

    kind, table, noun = "sphere", "touched_sphere", "sphere"
    # A sphere whose radius is exactly 0 is a point, as a socket is: its rows are the three coordinates, not a distance.
    rows: int = derived()
    linear: bool = derived()
    centre = part("centre of {name}", *POINT)
    size = part("radius of {name}", "mm", when="free")

    def completed(self, where: str) -> Mapping[str, Any]:
        exact, radius = is_exact(self.u), self.radius
        point = radius is not None and is_concrete(radius) and exact and float(radius) == 0
        return {
            "free": radius is None or not exact,
            "fixes_scale": radius is not None and not point,
            "rows": 3 if point else 1,
            "linear": point,
        }

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        if self.linear:
            return {self.centre: namespace(tips).mean(tips.position, axis=1)}
        centre, radius = fitted_sphere(tips.position)
        size = radius if self.radius is None else self.radius
        return {self.centre: centre} | ({self.size: size[None]} if self.free else {})

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, m = namespace(tips, unknowns, self.u), self.q.shape[0]
        between = tips.position - unknowns[self.centre]
        if self.linear:
            identity = each_pose(xp.asarray(np.eye(3)), m)
            return Rows(between, identity, {self.centre: -identity}, no_covariance(3, m))
        distance, towards = length_and_direction(between)
        by_unknowns = {self.centre: -towards[:, None]}
        if self.free:
            by_unknowns[self.size] = -xp.ones((1, 1, m))
        return Rows((distance - self.radius_at(unknowns))[None], towards[None], by_unknowns, no_covariance(1, m))

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        where = f"sphere '{self.name}'"
        if self.linear:
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


class AbstractSimulatedRound(AbstractSimulated):
    """Touches of a surface of one diameter, which may be certified."""

    diameter: float
    certified: bool = truth("whether the diameter is certified", default=True)
    u: float = number("standard uncertainty of the certified diameter", "mm", default=0.0)
    stylus: float = number("diameter of the tip's ball", "mm", default=0.0)

    def certificate(self, random: np.random.Generator) -> dict[str, float]:
        """What is recorded of the diameter."""
        if not self.certified:
            return {}
        return {"diameter": self.diameter + self.u * random.normal(), "u": self.u, "stylus": self.stylus}


class SimulatedSphere(AbstractSimulatedRound):
    """Touches all over a sphere, or over a cap of it.

    Example:
        >>> ball = aj.data.observations.SimulatedSphere("ball", (300, 0, 300), 50.0, 25, u=0.001, stylus=6.0)
        >>> touched = aj.simulate(true, {}, observations=[ball]).observations[0]
        >>> print(touched.q.shape, f"{touched.radius:.2f} mm")
        (25, 6) 28.00 mm
    """

    table = "touched_sphere"
    centre: Float[np.ndarray, "3"] = number("centre in the base frame", "mm", moves="point")
    diameter: float = number("true diameter", "mm")
    poses: int = count("number of poses")

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        directions = random.normal(size=(self.poses, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return self.centre + (self.diameter + self.stylus) / 2 * directions

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Sphere:
        return Sphere(self.name, q, **self.certificate(random))
