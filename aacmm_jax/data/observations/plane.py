"""Planes: the tip touches one, or two parallel ones at a certified distance."""

import dataclasses
from collections.abc import Hashable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ...core.arrays import Numbers, is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import products_by_column, semidefinite_eigen
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import cross, rotation_and_derivative, rotation_matrix
from .columns import variances
from .frames import moved, turned_z
from .observation import (
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
    checked_truth,
    is_exact,
    numbers,
)

PLANE = ("rad", "rad", "mm")


class Plane(AbstractObservation):
    """Touches of a plane whose position and direction are unknown.

    Args:
        name: Name of the plane.
        q: Joint readings ``(m, n)``, rad; all from one side, so that the ball's radius is part of the unknown position.
        form: Standard deviation of the surface about its plane, mm.
        target: Name of the tip, by default the arm's own probe.

    Raises:
        InputError: Readings are not finite, or ``form`` is negative.

    Example:
        >>> table = aj.data.observations.Plane("table", capture.q[:12], form=0.002)
        >>> print([*table.unknowns])
        ['plane table']
    """

    kind: ClassVar[str] = "plane"
    table: ClassVar[str] = "plane"
    entries: ClassVar[tuple[Entry, ...]] = (
        READINGS,
        Entry("form", "standard deviation of the surface about its plane", "mm"),
        TARGET,
    )
    rows: ClassVar[int] = 1
    stated: ClassVar[tuple[str, ...]] = ("form",)
    q: Float[AnyArray, "m n"]
    form: Float[AnyArray, ""]
    name: str = eqx.field(static=True)
    target: str = eqx.field(static=True)

    def __init__(self, name: str, q: Numbers, *, form: Numbers = 0.0, target: str = ""):
        self.name = checked_name(name, "a plane")
        self.q = checked_readings(f"plane '{name}'", q)
        self.form = checked_scalar(f"form of plane '{name}'", form)
        self.target = checked_target(target)

    @property
    def place(self) -> str:
        """Name of the unknown plane: two components of the rotation vector that turns z to its normal, and its distance
        from the origin."""
        return f"plane {self.name}"

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        return {self.place: PLANE}

    @property
    def alike(self) -> Hashable | None:
        return ()

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        return _normal_and_distance(values)

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        return {self.place: fitted_plane(tips.position)}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        distance, normal, by_plane = heights(tips.position, unknowns[self.place])
        measured = variances(self.form, self.q.shape[0])
        return Rows(distance[None], _each(normal, self.q.shape[0]), {self.place: by_plane[:, None]}, measured)

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

    kind: ClassVar[str] = "parallel planes"
    by_pose: ClassVar[tuple[str, ...]] = ("q", "second")
    table: ClassVar[str] = "parallel_planes"
    entries: ClassVar[tuple[Entry, ...]] = (
        READINGS,
        Entry("side", "plane that was touched: one or other", dimensions=("pose",), content="text", required=True),
        Entry("distance", "certified distance between the planes", "mm", required=True, uncertainty="u"),
        Entry("u", "standard uncertainty of the distance", "mm"),
        Entry("stylus", "diameter of the tip's ball", "mm"),
        Entry("inside", "whether the ball was between the planes", content="truth"),
        Entry("form", "standard deviation of the surface about its plane", "mm"),
        TARGET,
    )
    rows: ClassVar[int] = 1
    q: Float[AnyArray, "m n"]
    distance: Float[AnyArray, ""]  # mm
    stylus: Float[AnyArray, ""]  # mm
    u: Float[AnyArray, ""]
    form: Float[AnyArray, ""]
    name: str = eqx.field(static=True)
    target: str = eqx.field(static=True)
    second: tuple[bool, ...] = eqx.field(static=True)  # whether a pose is on the second plane; these come last
    inside: bool = eqx.field(static=True)
    free: bool = eqx.field(static=True)  # whether the distance is an unknown with a certified value

    def __init__(
        self,
        name: str,
        one: Numbers,
        other: Numbers,
        distance: Numbers,
        *,
        u: Numbers = 0.0,
        stylus: Numbers = 0.0,
        inside: bool = False,
        form: Numbers = 0.0,
        target: str = "",
    ):
        self.name = checked_name(name, "a pair of planes")
        where = f"planes '{name}'"
        sides = checked_readings(f"{where}, one side,", one), checked_readings(f"{where}, other side,", other)
        if sides[0].shape[1] != sides[1].shape[1]:
            raise InputError(f"{where} have {sides[0].shape[1]} and {sides[1].shape[1]} columns; give one a joint.")
        self.q = namespace(*sides).concatenate(sides)
        self.second = (False,) * sides[0].shape[0] + (True,) * sides[1].shape[0]
        self.stylus = checked_scalar(f"stylus of {where}", stylus)
        self.distance = checked_scalar(f"distance of {where}", distance, positive=True)
        self.inside = checked_truth(f"inside of {where}", inside)
        if is_concrete(self.between) and float(self.between) <= 0:
            raise InputError(
                f"{where} have a stylus of {float(self.stylus):g} mm between planes at {float(self.distance):g} mm; "
                "give the distance and the diameter of the ball that fits between them, in mm."
            )
        self.u = checked_scalar(f"u of {where}", u)
        self.form = checked_scalar(f"form of {where}", form)
        self.target = checked_target(target)
        self.free = not is_exact(self.u)

    @property
    def place(self) -> str:
        """Name of the first of the unknown planes."""
        return f"plane {self.name}"

    @property
    def between(self) -> Float[AnyArray, "*batch"]:
        """Certified distance of the tip's centres on both planes, mm."""
        return self.distance - self.stylus if self.inside else self.distance + self.stylus

    def stored(self) -> dict[str, Any]:
        sides = np.where(self.second, "other", "one")
        return super().stored() | {"side": sides}

    @classmethod
    def rebuilt(cls, name: str, stored: Mapping[str, Any]) -> "ParallelPlanes":
        rest = {key: value for key, value in stored.items() if key not in ("q", "side")}
        side = np.asarray(stored["side"])
        unknown = sorted(set(side.tolist()) - {"one", "other"})
        if unknown:
            raise InputError(f"planes '{name}' have the side '{unknown[0]}'; the sides are one and other.")
        return cls(name, stored["q"][side == "one"], stored["q"][side == "other"], **rest)

    @property
    def first(self) -> int:
        """Number of poses on the first plane."""
        return self.second.count(False)

    @property
    def separation(self) -> str:
        """Name of the distance."""
        return f"distance of {self.name}"

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        return {self.place: PLANE} | ({self.separation: ("mm",)} if self.free else {})

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        if part == self.separation and float(self.stylus):
            ball = float(self.stylus)
            return (Quantity("without the tip's ball", values + ball if self.inside else values - ball, "mm"),)
        return _normal_and_distance(values) if part == self.place else super().quantities(part, values)

    @property
    def fixes_scale(self) -> bool:
        return True

    @property
    def certified(self) -> dict[str, tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]]:
        return {self.separation: (self.between[None], self.u[None])} if self.free else {}

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        xp, k = namespace(tips), self.first
        sides = tips.position[:, :k], tips.position[:, k:]
        centres = [xp.mean(side, axis=1, keepdims=True) for side in sides]
        both = xp.concatenate([side - centre for side, centre in zip(sides, centres, strict=True)], axis=1)
        start = fitted_plane(both + centres[0])
        return {self.place: start} | ({self.separation: self.between[None]} if self.free else {})

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        height, normal, by_plane = heights(tips.position, unknowns[self.place])
        m, k = self.q.shape[0], self.first
        xp = namespace(height, self.form)
        other = np.array(self.second)
        # The normal may point either way; which way the other plane is follows from the tips.
        side = xp.where(xp.mean(height[k:]) >= xp.mean(height[:k]), 1.0, -1.0) * xp.asarray(other.astype(float))
        distance = unknowns[self.separation][0] if self.free else self.between
        by_unknowns = {self.place: by_plane[:, None]}
        if self.free:
            by_unknowns[self.separation] = -side[None, None]
        measured = variances(self.form, m)
        return Rows((height - side * distance)[None], _each(normal, m), by_unknowns, measured)

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        k = self.first
        sides = [tips[:, :k], tips[:, k:]]
        both = np.concatenate([side - side.mean(axis=1, keepdims=True) for side in sides], axis=1)
        check_plane(f"planes '{self.name}'", both)


def _normal_and_distance(values: Float[np.ndarray, " 3"]) -> tuple[Quantity, ...]:
    normal = np.asarray(rotation_matrix(np.append(values[:2], 0.0)))[:, 2]
    return (Quantity("normal", normal, "1"), Quantity("distance from the origin", values[2:], "mm"))


def _each(normal: Float[AnyArray, "3 p"], poses: int) -> Float[AnyArray, "1 3 m"]:
    return namespace(normal).broadcast_to(normal[None], (1, 3, poses))


def heights(
    tips: Float[AnyArray, "3 m"], plane: Float[AnyArray, "3 p"]
) -> tuple[Float[AnyArray, " m"], Float[AnyArray, "3 p"], Float[AnyArray, "3 m"]]:
    """Heights of tips over a plane (or over one each), mm, its unit normal, and the derivatives of the heights by the
    plane's numbers."""
    xp = namespace(tips, plane)
    w = xp.concatenate([plane[:2], xp.zeros_like(plane[:1])])
    rotation, axes = rotation_and_derivative(w)
    normal = rotation[:, 2]
    # The normal, and its derivatives by the two components.
    rows = xp.stack([normal, *(cross(axes[:, i], normal) for i in range(2))])
    height, *by_turn = products_by_column(rows, tips)
    return height - plane[2], normal, xp.stack([*by_turn, -xp.ones_like(height)])


def fitted_plane(tips: Float[AnyArray, "3 m"]) -> Float[AnyArray, " 3"]:
    """The plane that points are closest to: its numbers as `Plane` has them, with the normal upwards."""
    xp = namespace(tips)
    middle = xp.mean(tips, axis=1)
    centred = tips - middle[:, None]
    scatter = centred @ centred.T
    _, vectors = semidefinite_eigen(scatter / (xp.trace(scatter) + 1e-300))
    normal = vectors[:, 2] / xp.sqrt(xp.sum(vectors[:, 2] ** 2))
    normal = xp.where(normal[2] < 0, -normal, normal)
    return xp.concatenate([turned_z(normal), (normal @ middle)[None]])


def check_plane(where: str, tips: Float[np.ndarray, "3 m"]) -> None:
    """Raise `InputError` for points that determine no plane."""
    if tips.shape[1] < 3:
        raise InputError(f"{where} has {tips.shape[1]} touches, but a plane needs three at least; touch it more often.")
    sizes = np.linalg.svd(tips - tips.mean(axis=1, keepdims=True), compute_uv=False)
    if sizes[1] <= 0.02 * sizes[0]:
        raise InputError(f"the touches of {where} are on one line, about which it can tilt; touch it beside the line.")


class SimulatedPlanes(AbstractSimulated):
    """Touches at random places of a rectangle, or of two that face each other.

    Args:
        name: Name of the plane, or of the pair.
        corner: A corner of the (first) rectangle in the base frame ``(3,)``, mm.
        sides: Its two sides as vectors ``(2, 3)``, mm.
        poses: Number of touches of each plane.
        distance: True distance to the second plane, along the cross product of the sides; None for one plane.
        u: Standard uncertainty of the certified distance, mm.

    Example:
        >>> faces = aj.data.observations.SimulatedPlanes(
        ...     "block", (300, -200, 150), [[80, 0, 0], [0, 80, 0]], 8, distance=100.0, u=0.001
        ... )
        >>> print(aj.simulate(true, {}, observations=[faces]).observations[0].q.shape)
        (16, 6)
    """

    table: ClassVar[str] = "planes"
    name: str = eqx.field(static=True)
    corner: np.ndarray = eqx.field(converter=numbers("corner", 3))
    sides: np.ndarray = eqx.field(converter=numbers("sides", 2, 3))
    poses: int = eqx.field(static=True)
    distance: float | None = None
    u: float = 0.0

    def placed(self, name: str, frame: Float[np.ndarray, " 6"]) -> "SimulatedPlanes":
        turned = self.sides @ rotation_matrix(frame[:3]).T
        return dataclasses.replace(self, name=name, corner=moved(frame, self.corner), sides=turned)

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        planes = 1 if self.distance is None else 2
        places = self.corner + random.uniform(size=(planes * self.poses, 2)) @ self.sides
        if self.distance is not None:
            normal = np.cross(*self.sides)
            places[self.poses :] += self.distance * normal / np.linalg.norm(normal)
        return places

    def recorded(
        self, q: Float[np.ndarray, "m n"], transforms: Float[np.ndarray, "m 4 4"], random: np.random.Generator
    ) -> Plane | ParallelPlanes:
        if self.distance is None:
            return Plane(self.name, q)
        distance = self.distance + self.u * random.normal()
        return ParallelPlanes(self.name, q[: self.poses], q[self.poses :], distance, u=self.u)
