"""Planes: the tip touches one, or two parallel ones at a certified distance."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers, is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import products_by_column
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import cross, rotation_and_derivative, rotation_matrix
from .declared import checked_readings, count, derived, is_exact, number, part, text, truth
from .fits import fitted_plane
from .frames import variances
from .observation import AbstractObservation, Certified, Parts, Quantity, Rows, Tips, Unknowns
from .simulated import AbstractSimulated, Readings, Transforms

# Two components of the rotation vector that turns z to the normal, and the distance from the origin.
PLANE = ("rad", "rad", "mm")
SIDES = ("one", "other")


class Plane(AbstractObservation):
    """Touches of a plane whose position and direction are unknown.

    All are from one side, so that the radius of the tip's ball is part of the unknown position.

    Raises:
        InputError: Readings are not finite, or ``form`` is negative.

    Example:
        >>> table = aj.data.observations.Plane("table", capture.q[:12], form=0.002)
        >>> print([*table.unknowns])
        ['plane table']
    """

    kind, table, noun, rows = "plane", "plane", "plane", 1
    form: Float[AnyArray, ""] = number("standard deviation of the surface about its plane", "mm", default=0.0)
    place = part("plane {name}", *PLANE)

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        return _normal_and_distance(values)

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        return {self.place: fitted_plane(tips.position)}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        height, by_tip, by_plane = heights(tips.position, unknowns[self.place])
        return Rows(height[None], by_tip, {self.place: by_plane[:, None]}, variances(self.form, self.q.shape[0]))

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        check_plane(f"plane '{self.name}'", tips)


class ParallelPlanes(AbstractObservation):
    """Touches of two parallel planes at a certified distance, such as the faces of a gauge block or a step.

    Args:
        name: Name of the pair.
        one: Joint readings on one plane ``(m, n)``, rad.
        other: Joint readings on the other plane ``(k, n)``, rad.
        distance: Certified distance between the planes, mm.
        u: Standard uncertainty (k = 1) of the distance, mm.
        stylus: Diameter of the tip's ball, mm.
        inside: Whether the ball was between the planes (a gap), and not outside them (a block).
        form: Standard deviation of the surfaces about their planes, mm.
        target: Name of the tip, by default the arm's own probe.

    Raises:
        InputError: The planes have different numbers of joints, or a value is negative.

    Example:
        >>> block = aj.data.observations.ParallelPlanes("block", capture.q[:6], capture.q[6:12], 100.0, u=0.0003)
        >>> print(block.q.shape, [*block.unknowns])
        (12, 6) ['plane block', 'distance of block']
    """

    kind, table, noun, rows = "parallel planes", "parallel_planes", "planes", 1
    side: tuple[str, ...] = text("plane that was touched: one or other", "pose")
    distance: Float[AnyArray, ""] = number(
        "certified distance between the planes", "mm", uncertainty="u", positive=True
    )
    u: Float[AnyArray, ""] = number("standard uncertainty of the distance", "mm", default=0.0)
    stylus: Float[AnyArray, ""] = number("diameter of the tip's ball", "mm", default=0.0)
    inside: bool = truth("whether the ball was between the planes")
    form: Float[AnyArray, ""] = number("standard deviation of the surface about its plane", "mm", default=0.0)
    free: bool = derived()  # whether the distance is an unknown with a certified value
    place = part("plane {name}", *PLANE)  # of the first side
    separation = part("distance of {name}", "mm", when="free")
    fixes_scale, stacks = True, False  # which way the other plane is follows from all of its poses

    def __init__(self, name: str, one: Numbers, other: Numbers, distance: Numbers, **options: Any):
        readings = [
            checked_readings(f"planes '{name}', side {side},", q) for side, q in zip(SIDES, (one, other), strict=True)
        ]
        widths = [q.shape[1] for q in readings]
        if widths[0] != widths[1]:
            raise InputError(f"planes '{name}' have {widths[0]} and {widths[1]} columns; give one a joint.")
        sides = [side for side, q in zip(SIDES, readings, strict=True) for _ in range(q.shape[0])]
        super().__init__(name, namespace(*readings).concatenate(readings), sides, distance, **options)

    def completed(self, where: str) -> Mapping[str, Any]:
        if unknown := sorted(set(self.side) - set(SIDES)):
            raise InputError(f"{where} have the side '{unknown[0]}'; the sides are one and other.")
        if missing := set(SIDES) - set(self.side):
            raise InputError(f"{where} have no poses on the side '{missing.pop()}'; record some.")
        if is_concrete(self.between) and float(self.between) <= 0:
            raise InputError(
                f"{where} have a stylus of {float(self.stylus):g} mm between planes at {float(self.distance):g} mm; "
                "give the distance and the diameter of the ball that fits between them, in mm."
            )
        return {"free": not is_exact(self.u)}

    @property
    def between(self) -> Float[AnyArray, "*batch"]:
        """Certified distance of the tip's centres on both planes, mm."""
        return self.distance - self.stylus if self.inside else self.distance + self.stylus

    @property
    def second(self) -> np.ndarray:
        """Whether each pose is on the other plane, ``(m,)``."""
        return np.array(self.side) == SIDES[1]

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        if part == self.separation and float(self.stylus):
            ball = float(self.stylus)
            return (Quantity("without the tip's ball", values + ball if self.inside else values - ball, "mm"),)
        return _normal_and_distance(values) if part == self.place else super().quantities(part, values)

    @property
    def certified(self) -> Certified:
        return {self.separation: (self.between[None], self.u[None])} if self.free else {}

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        # Both planes have one normal: that of all touches, each side about its middle.
        xp, sides = namespace(tips), [np.flatnonzero(~self.second), np.flatnonzero(self.second)]
        centres = [xp.mean(tips.position[:, rows], axis=1, keepdims=True) for rows in sides]
        centred = [tips.position[:, rows] - centre for rows, centre in zip(sides, centres, strict=True)]
        plane = fitted_plane(xp.concatenate(centred, axis=1) + centres[0])
        return {self.place: plane} | ({self.separation: self.between[None]} if self.free else {})

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        height, by_tip, by_plane = heights(tips.position, unknowns[self.place])
        xp, second = namespace(height, self.form), self.second
        # The normal may point either way; which way the other plane is follows from the tips.
        upwards = xp.mean(height[np.flatnonzero(second)]) >= xp.mean(height[np.flatnonzero(~second)])
        side = xp.where(upwards, 1.0, -1.0) * xp.asarray(second.astype(float))
        distance = unknowns[self.separation][0] if self.free else self.between
        by_unknowns = {self.place: by_plane[:, None]}
        if self.free:
            by_unknowns[self.separation] = -side[None, None]
        return Rows((height - side * distance)[None], by_tip, by_unknowns, variances(self.form, len(second)))

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        sides = [tips[:, ~self.second], tips[:, self.second]]
        both = np.concatenate([side - side.mean(axis=1, keepdims=True) for side in sides], axis=1)
        check_plane(f"planes '{self.name}'", both)


def _normal_and_distance(values: Float[np.ndarray, " 3"]) -> tuple[Quantity, ...]:
    normal = np.asarray(rotation_matrix(np.append(values[:2], 0.0)))[:, 2]
    return (Quantity("normal", normal, "1"), Quantity("distance from the origin", values[2:], "mm"))


def heights(
    tips: Float[AnyArray, "3 m"], plane: Float[AnyArray, "3 p"]
) -> tuple[Float[AnyArray, " m"], Float[AnyArray, "1 3 m"], Float[AnyArray, "3 m"]]:
    """Heights of tips over a plane (or over one each), mm, and their derivatives by the tips, which are the unit
    normal, and by the plane's numbers."""
    xp = namespace(tips, plane)
    w = xp.concatenate([plane[:2], xp.zeros_like(plane[:1])])
    rotation, axes = rotation_and_derivative(w)
    normal = rotation[:, 2]
    # The normal, and its derivatives by the two components.
    rows = xp.stack([normal, *(cross(axes[:, i], normal) for i in range(2))])
    height, *by_turn = products_by_column(rows, tips)
    by_tip = xp.broadcast_to(normal[None], (1, 3, tips.shape[1]))
    return height - plane[2], by_tip, xp.stack([*by_turn, -xp.ones_like(height)])


def check_plane(where: str, tips: Float[np.ndarray, "3 m"]) -> None:
    """Raise `InputError` for points that determine no plane."""
    if tips.shape[1] < 3:
        raise InputError(f"{where} has {tips.shape[1]} touches, but a plane needs three at least; touch it more often.")
    sizes = np.linalg.svd(tips - tips.mean(axis=1, keepdims=True), compute_uv=False)
    if sizes[1] <= 0.02 * sizes[0]:
        raise InputError(f"the touches of {where} are on one line, about which it can tilt; touch it beside the line.")


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
    corner: Float[np.ndarray, "3"] = number("corner of the (first) rectangle in the base frame", "mm", moves="point")
    sides: Float[np.ndarray, "2 3"] = number("its two sides as vectors", "mm", moves="vector")
    poses: int = count("number of poses")
    distance: float | None = number(
        "true distance to the second plane",
        "mm",
        default=None,
        more="along the cross product of the sides; None for one",
    )
    u: float = number("standard uncertainty of the certified distance", "mm", default=0.0)

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
