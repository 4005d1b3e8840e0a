"""A cylinder: the tip touches it, so it is at one distance from an unknown axis."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.arrays import is_concrete
from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import rotation_matrix
from .declared import count, is_exact, number, part, truth
from .fits import distances_from_axis, fitted_cylinder
from .frames import variances
from .observation import Parts, Quantity, Rows, Tips, Unknowns
from .simulated import Readings, Transforms
from .sphere import AbstractRound, AbstractSimulatedRound

_SMALLEST_ARC = 30.0  # degrees from its middle: below it, axis and radius can hardly be told apart
_LEAST_HEIGHT = 0.05  # standard deviation of the heights, in radii, below which the axis can tilt
_LEAST_SINGULAR = 0.02  # smallest singular value of the touches' directions, of root m


class Cylinder(AbstractRound):
    """Touches of a cylinder: the tip's centre is at one distance from an unknown axis.

    Outside (a pin, a plug gauge) that distance is (diameter + stylus) / 2, inside (a ring gauge, a bore)
    (diameter - stylus) / 2.

    Raises:
        InputError: Shapes do not fit, a value is negative, or the ball is larger than the bore.

    Example:
        >>> kinds = aj.data.observations
        >>> ring = kinds.Cylinder("ring", capture.q[:8], diameter=50.0, u=0.001, stylus=6.0, inside=True)
        >>> print(ring.radius, [*ring.unknowns])
        22.0 ['axis of ring', 'radius of ring']
    """

    kind, table, noun, rows = "cylinder", "touched_cylinder", "cylinder", 1
    diameter: Float[AnyArray, ""] | None = number(
        "certified diameter", "mm", default=None, uncertainty="u", positive=True, more="None where it is unknown"
    )
    inside: bool = truth("whether the ball was inside")
    form: Float[AnyArray, ""] = number("standard deviation of the surface about its cylinder", "mm", default=0.0)
    # Two components of the rotation vector that turns z to the axis' direction, and where the axis meets the plane
    # through the origin across it, along the x and y axes that are turned likewise.
    axis = part("axis of {name}", "rad", "rad", "mm", "mm")
    size = part("radius of {name}", "mm", when="free")

    def completed(self, where: str) -> Mapping[str, Any]:
        radius = self.radius
        if radius is not None and is_concrete(radius) and float(radius) <= 0:
            raise InputError(
                f"{where} has a stylus of {self.stylus:g} mm inside a diameter of {self.diameter:g} mm; give the "
                "diameters of the bore and of the ball that fits into it, in mm."
            )
        return {"free": radius is None or not is_exact(self.u), "fixes_scale": radius is not None}

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        if part != self.axis:
            return super().quantities(part, values)
        turned = np.asarray(rotation_matrix(np.append(values[:2], 0.0)))
        point = turned[:, :2] @ values[2:]
        return (Quantity("direction of the axis", turned[:, 2], "1"), Quantity("point of the axis", point, "mm"))

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        axis, radius = fitted_cylinder(tips.position, self.radius)
        return {self.axis: axis} | ({self.size: radius[None]} if self.free else {})

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        distance, direction, by_axis = distances_from_axis(tips.position, unknowns[self.axis])
        xp, m = namespace(distance), self.q.shape[0]
        by_unknowns = {self.axis: by_axis[:, None]}
        if self.free:
            by_unknowns[self.size] = -xp.ones((1, 1, m))
        values = (distance - self.radius_at(unknowns))[None]
        return Rows(values, direction[None], by_unknowns, variances(self.form, m))

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        where = f"cylinder '{self.name}'"
        needed = 5 if self.radius is None else 4
        if tips.shape[1] < needed:
            raise InputError(f"{where} has {tips.shape[1]} touches, but {needed} unknowns; touch it more often.")
        middle = tips.mean(axis=1, keepdims=True)
        radius = None if self.radius is None else np.asarray(self.radius)
        axis, radius = fitted_cylinder(tips - middle, radius)
        _, direction, _ = distances_from_axis(tips - middle, axis)
        turned = rotation_matrix(np.array([*axis[:2], 0.0]))
        across = turned.T[:2] @ direction
        height = turned[:, 2] @ (tips - middle)
        if np.std(height) < _LEAST_HEIGHT * float(radius):
            raise InputError(
                f"the touches of {where} are at one height of its axis, which can then tilt; touch it at two heights."
            )
        mean = across.mean(axis=1)
        mean = mean / max(np.linalg.norm(mean), 1e-300)
        arc = math.degrees(math.acos(np.clip((mean @ across).min(), -1, 1)))
        if self.radius is None and arc < _SMALLEST_ARC:
            raise InputError(
                f"the touches of {where} cover an arc of {arc:.0f} degrees about its middle, which hardly separates "
                "axis and radius; touch it all round, or give its diameter."
            )
        slopes = np.concatenate([across, across * height / np.std(height)])
        if self.radius is None:
            slopes = np.concatenate([slopes, np.ones_like(slopes[:1])])
        if np.linalg.svd(slopes, compute_uv=False)[-1] < _LEAST_SINGULAR * math.sqrt(tips.shape[1]):
            raise InputError(
                f"the touches of {where} are on too few lines along it, so that its axis can move or tilt; touch it "
                "all round at two heights."
            )


class SimulatedCylinder(AbstractSimulatedRound):
    """Touches all round a cylinder and along it.

    Example:
        >>> ends = [[400, 200, 300], [400, 200, 320]]
        >>> ring = aj.data.observations.SimulatedCylinder("ring", ends, 50.0, 12, inside=True)
        >>> print(aj.simulate(true, {}, observations=[ring]).observations[0].q.shape)
        (12, 6)
    """

    table = "touched_cylinder"
    ends: Float[np.ndarray, "2 3"] = number("both ends of the axis in the base frame", "mm", moves="point")
    diameter: float = number("true diameter", "mm")
    poses: int = count("number of poses")
    inside: bool = truth("whether the ball is inside")

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        along = self.ends[1] - self.ends[0]
        directions = np.cross(along, random.normal(size=(self.poses, 3)))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        radius = (self.diameter - self.stylus if self.inside else self.diameter + self.stylus) / 2
        return self.ends[0] + random.uniform(size=(self.poses, 1)) * along + radius * directions

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Cylinder:
        certificate = self.certificate(random)
        return Cylinder(self.name, q, **certificate, inside=bool(certificate) and self.inside)
