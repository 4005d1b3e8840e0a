"""Touched surfaces: spheres, cylinders, planes, and pairs of parallel planes.

All state one residual a touch: the distance of the tip's centre from a geometry (a centre, an axis, a plane), less a
size that may be certified (the radius of a sphere with the tip's ball on it, the distance between two planes).
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers, is_concrete
from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray, namespace, to_numpy
from .declared import Part, checked_readings, declared, is_exact
from .geometry import (
    distances_from_axis,
    distances_from_point,
    fitted_cylinder,
    fitted_plane,
    fitted_sphere,
    heights,
    variances,
)
from .observation import (
    AXIS,
    PLANE,
    POINT,
    AbstractObservation,
    Certified,
    Parts,
    Quantity,
    Readings,
    Rows,
    Tips,
    Transforms,
    Unknowns,
)
from .simulated import AbstractSimulated

SIDES = ("one", "other")
# Smallest singular value of a touch's derivatives, of those by angles in units of the touches' own extent. With it a
# sphere of unknown radius is touched up to 26 degrees from the middle, and a plane beside a line.
_LEAST_SINGULAR = 0.02

Fitted = tuple[Float[AnyArray, " k"], Float[AnyArray, ""] | None]  # a geometry and its size


class AbstractTouched(AbstractObservation):
    """Touches of a surface by the tip's ball, whose centre is at one distance, the size, from a geometry.

    ``certificate`` is the name of the entry with the certified value, if there is one; the size is this value, with the
    ball added or taken off, times ``share``: 1/2 of a diameter.
    """

    row_units = ("mm",)
    certificate: ClassVar[str] = ""
    share: ClassVar[float] = 1.0
    advice: ClassVar[str]  # to whoever has touched too little of it
    free: bool = False  # whether the size is an unknown
    inside: bool = False  # whether the ball was inside
    form: Any = 0.0  # standard deviation of the surface, mm
    stylus: Any
    u: Any
    geometry: Any  # a part
    size: Any  # another, unless there is no ``certificate``

    distances: ClassVar[Any]  # of tips from the geometry, with their derivatives: a function of tips and numbers
    # The geometry closest to nearly right tips, of this size where that is known.
    closest: ClassVar[Any]

    def fitted(self, tips: Float[AnyArray, "3 m"]) -> Fitted:
        """The geometry closest to nearly right tips, and its size."""
        return self.closest(tips, self.certified_size)

    def sides(self, distances: Float[AnyArray, " m"]) -> Float[AnyArray, " m"]:
        """How many times the size each touch is away from the geometry: 1, or 1 and 0 of the two sides of something."""
        return namespace(distances).ones_like(distances)

    def completed(self, where: str) -> Mapping[str, Any]:
        size = self.certified_size
        if size is not None and is_concrete(size) and float(size) <= 0:
            value, stylus = float(getattr(self, self.certificate)), float(self.stylus)
            raise InputError(
                f"{where}: a stylus of {stylus:g} mm does not fit into a {self.certificate} of {value:g} mm; give "
                f"the {self.certificate} of the artefact, and the diameter of a stylus that fits, both in mm."
            )
        return {"free": size is None or not is_exact(self.u)} if self.certificate else {}

    @property
    def certified_size(self) -> Float[AnyArray, "*batch"] | None:
        """Certified distance of the tip's centre from the geometry, mm; None if the diameter is unknown."""
        value = getattr(self, self.certificate) if self.certificate else None
        if value is None:
            return None
        return (value - self.stylus if self.inside else value + self.stylus) * self.share

    @property
    def fixes_scale(self) -> bool:
        return bool(self.certificate) and getattr(self, self.certificate) is not None

    @property
    def certified(self) -> Certified:
        size = self.certified_size
        return {self.size: (size[None], self.u[None] * self.share)} if self.free and size is not None else {}

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        if not self.free or part != self.size or not float(self.stylus):
            return super().quantities(part, values)
        ball = float(self.stylus) * self.share
        return (Quantity("without the tip's ball", values + ball if self.inside else values - ball, "mm"),)

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        geometry, size = self.fitted(tips.position)
        parts: Parts = {self.geometry: geometry}
        if self.free:
            certified = self.certified_size
            size = size if certified is None else certified
            assert size is not None
            parts[self.size] = size[None]
        return parts

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        values, by_tip, by_geometry = self.distances(tips.position, unknowns[self.geometry])
        by_unknowns, sides, size = {self.geometry: by_geometry[:, None]}, self.sides(values), self.certified_size
        if self.free:
            size = unknowns[self.size][0]
            by_unknowns[self.size] = -sides[None, None]
        if size is not None:
            values = values - sides * size
        return Rows(values[None], by_tip[None], by_unknowns, variances(self.form, values.shape[0]))

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        centred = tips - tips.mean(axis=1, keepdims=True)
        geometry, _ = to_numpy(self).fitted(centred)
        values, _, rows = self.distances(centred, np.asarray(geometry)[:, None])
        angles = np.array([unit == "rad" for unit in self.unknowns[self.geometry]])
        rows = np.where(angles[:, None], rows / (np.sqrt(np.mean(centred**2)) + 1e-300), rows)
        if self.free and self.certified_size is None:
            rows = np.concatenate([rows, self.sides(values)[None]])
        where = f"{self.noun} '{self.name}'"
        if tips.shape[1] < len(rows):
            raise InputError(
                f"{where} has {tips.shape[1]} touches, but there are {len(rows)} unknowns; record more touches."
            )
        if np.linalg.svd(rows, compute_uv=False)[-1] < _LEAST_SINGULAR * np.sqrt(tips.shape[1]):
            raise InputError(f"the touches do not determine the geometry of {where} well enough; {self.advice}.")


class AbstractRound(AbstractTouched):
    """Touches of what has one diameter, which may be certified."""

    certificate, share = "diameter", 0.5
    diameter: Float[AnyArray, ""] | None = declared(
        "certified diameter", "mm", default=None, uncertainty="u", positive=True, more="None if the diameter is unknown"
    )
    u: Float[AnyArray, ""] = declared("standard uncertainty of the diameter", "mm", default=0.0)
    stylus: Float[AnyArray, ""] = declared(
        "diameter of the tip's ball", "mm", default=0.0,
        more=(
            "0 if the tip itself touches the surface, or if the diameter is unknown (then the fitted diameter includes "
            "the ball)"
        ),
    )  # fmt: skip
    derived = ("free",)

    @property
    def radius(self) -> Float[AnyArray, "*batch"] | None:
        """Certified distance of the tip's centre from the middle, mm."""
        return self.certified_size


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
    geometry = Part("centre of {name}", *POINT)
    size = Part("radius of {name}", "mm", when="free")
    advice = "distribute the touches over the sphere, or give its diameter"
    distances, closest = staticmethod(distances_from_point), staticmethod(fitted_sphere)


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

    kind, table, noun = "cylinder", "touched_cylinder", "cylinder"
    inside: bool = declared("whether the ball touched the cylinder from inside", default=False)
    form: Float[AnyArray, ""] = declared("standard deviation of the surface from an ideal cylinder", "mm", default=0.0)
    geometry = Part("axis of {name}", *AXIS)
    size = Part("radius of {name}", "mm", when="free")
    advice = "distribute the touches around the cylinder at two heights, or give its diameter"
    distances, closest = staticmethod(distances_from_axis), staticmethod(fitted_cylinder)


class Plane(AbstractTouched):
    """Touches of a plane whose position and direction are unknown.

    All are from one side, so that the radius of the tip's ball is part of the unknown position.

    Raises:
        InputError: Readings are not finite, or ``form`` is negative.

    Example:
        >>> table = aj.data.observations.Plane("table", capture.q[:12], form=0.002)
        >>> print([*table.unknowns])
        ['plane table']
    """

    kind, table, noun = "plane", "plane", "plane"
    form: Float[AnyArray, ""] = declared("standard deviation of the surface from an ideal plane", "mm", default=0.0)
    geometry = Part("plane {name}", *PLANE)
    advice = "record touches that are not on one line"
    distances, closest = staticmethod(heights), staticmethod(fitted_plane)


class ParallelPlanes(Plane):
    """Touches of two parallel planes at a certified distance, such as the faces of a gauge block or a step.

    Args:
        name: Name of the pair.
        one: Joint readings on one plane ``(m, n)``, rad.
        other: Joint readings on the other plane ``(k, n)``, rad.
        distance: Certified distance between the planes, mm.

    Raises:
        InputError: The planes have different numbers of joints, or a value is negative.

    Example:
        >>> block = aj.data.observations.ParallelPlanes("block", capture.q[:6], capture.q[6:12], 100.0, u=0.0003)
        >>> print(block.q.shape, [*block.unknowns])
        (12, 6) ['plane block', 'distance of block']
    """

    kind, table, noun = "parallel planes", "parallel_planes", "planes"
    side: tuple[str, ...] = declared("the plane that was touched: 'one' or 'other'", "", "pose")
    distance: Float[AnyArray, ""] = declared(
        "certified distance between the planes", "mm", uncertainty="u", positive=True
    )
    u: Float[AnyArray, ""] = declared("standard uncertainty of the distance", "mm", default=0.0)
    stylus: Float[AnyArray, ""] = declared("diameter of the tip's ball", "mm", default=0.0)
    inside: bool = declared(
        "whether the ball was between the planes (true, a gap) or outside (false, a block)", default=False
    )
    derived, certificate = ("free",), "distance"
    size = Part("distance of {name}", "mm", when="free")  # from the plane of the first side
    stacks = False  # which way the other plane is follows from all of its poses

    def __init__(self, name: str, one: Numbers, other: Numbers, distance: Numbers, **options: Any):
        given = zip(SIDES, (one, other), strict=True)
        readings = [checked_readings(f"planes '{name}', side {side},", q) for side, q in given]
        widths = [q.shape[1] for q in readings]
        if widths[0] != widths[1]:
            raise InputError(f"planes '{name}' have {widths[0]} and {widths[1]} columns; give one column per joint.")
        sides = np.repeat(SIDES, [len(q) for q in readings]).tolist()
        super().__init__(name, namespace(*readings).concatenate(readings), sides, distance, **options)

    def completed(self, where: str) -> Mapping[str, Any]:
        if unknown := sorted(set(self.side) - set(SIDES)):
            raise InputError(f"{where} have the side '{unknown[0]}'; the sides are named 'one' and 'other'.")
        if missing := set(SIDES) - set(self.side):
            raise InputError(f"{where} have no poses on the side '{missing.pop()}'; record poses on this side.")
        return super().completed(where)

    def sides(self, distances: Float[AnyArray, " m"]) -> Float[AnyArray, " m"]:
        # The normal may point either way; which way the other plane is follows from the tips.
        xp, (first, second) = namespace(distances), [np.flatnonzero(np.array(self.side) == side) for side in SIDES]
        upwards = xp.mean(distances[second]) >= xp.mean(distances[first])
        return xp.where(upwards, 1.0, -1.0) * xp.asarray(np.isin(np.arange(len(self.side)), second).astype(float))

    def fitted(self, tips: Float[AnyArray, "3 m"]) -> Fitted:
        centred, middle = self._about_sides(tips)
        return fitted_plane(centred + middle, None)

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        super().check_determined(np.asarray(self._about_sides(tips)[0]))

    def _about_sides(self, tips: Float[AnyArray, "3 m"]) -> tuple[Float[AnyArray, "3 m"], Float[AnyArray, "3 1"]]:
        """The touches of each side about its middle, which have the normal of both planes; and the first middle."""
        xp, other = namespace(tips), np.array(self.side) == SIDES[1]
        first, second = (xp.mean(tips[:, np.flatnonzero(rows)], axis=1, keepdims=True) for rows in (~other, other))
        return tips - xp.where(other, second, first), first


class AbstractSimulatedRound(AbstractSimulated):
    """Touches of a surface of one diameter, which may be certified."""

    diameter: float
    certified: bool = declared("whether the diameter is certified", default=True)
    u: float = declared("standard uncertainty of the certified diameter", "mm", default=0.0)
    stylus: float = declared("diameter of the tip's ball", "mm", default=0.0)

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
    centre: Float[np.ndarray, "3"] = declared("centre in the base frame", "mm", moves="point")
    diameter: float = declared("true diameter", "mm")
    poses: int = declared("number of poses")

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        directions = random.normal(size=(self.poses, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return self.centre + (self.diameter + self.stylus) / 2 * directions

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Sphere:
        return Sphere(self.name, q, **self.certificate(random))


class SimulatedCylinder(AbstractSimulatedRound):
    """Touches all round a cylinder and along it.

    Example:
        >>> ends = [[400, 200, 300], [400, 200, 320]]
        >>> ring = aj.data.observations.SimulatedCylinder("ring", ends, 50.0, 12, inside=True)
        >>> print(aj.simulate(true, {}, observations=[ring]).observations[0].q.shape)
        (12, 6)
    """

    table = "touched_cylinder"
    ends: Float[np.ndarray, "2 3"] = declared("both ends of the axis in the base frame", "mm", moves="point")
    diameter: float = declared("true diameter", "mm")
    poses: int = declared("number of poses")
    inside: bool = declared("whether the ball touches the cylinder from inside", default=False)

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        along = self.ends[1] - self.ends[0]
        directions = np.cross(along, random.normal(size=(self.poses, 3)))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        radius = (self.diameter - self.stylus if self.inside else self.diameter + self.stylus) / 2
        return self.ends[0] + random.uniform(size=(self.poses, 1)) * along + radius * directions

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Cylinder:
        return Cylinder(self.name, q, **self.certificate(random), inside=self.certified and self.inside)


class SimulatedPlanes(AbstractSimulated):
    """Touches at random places of a rectangle, or of two that face each other.

    Example:
        >>> faces = aj.data.observations.SimulatedPlanes(
        ...     "block", (300, -200, 150), [[80, 0, 0], [0, 80, 0]], 8, distance=100.0, u=0.001
        ... )
        >>> print(aj.simulate(true, {}, observations=[faces]).observations[0].q.shape)
        (16, 6)
    """

    table = "planes"
    corner: Float[np.ndarray, "3"] = declared("corner of the (first) rectangle in the base frame", "mm", moves="point")
    sides: Float[np.ndarray, "2 3"] = declared("two sides of the rectangle as vectors", "mm", moves="vector")
    poses: int = declared("number of poses")
    distance: float | None = declared(
        "true distance to the second plane", "mm", default=None,
        more="in the direction of the cross product of the sides; None for a single plane",
    )  # fmt: skip
    u: float = declared("standard uncertainty of the certified distance", "mm", default=0.0)

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        planes = 1 if self.distance is None else 2
        places = self.corner + random.uniform(size=(planes * self.poses, 2)) @ self.sides
        if self.distance is not None:
            normal = np.cross(*self.sides)
            places[self.poses :] += self.distance * normal / np.linalg.norm(normal)
        return places

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Plane | ParallelPlanes:
        if self.distance is None:
            return Plane(self.name, q)
        distance = self.distance + self.u * random.normal()
        return ParallelPlanes(self.name, q[: self.poses], q[self.poses :], distance, u=self.u)
