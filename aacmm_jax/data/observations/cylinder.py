"""A cylinder: the tip touches it, so it is at one distance from an unknown axis."""

import dataclasses
import functools
import math
from collections.abc import Hashable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ...core.arrays import Numbers, is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import length_and_direction, products_by_column, semidefinite_eigen, solve_positive_definite
from ...core.numpy_or_jax import AnyArray, namespace, scan
from ...core.rotations import cross, rotation_and_derivative, rotation_matrix
from .columns import as_columns, variances
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

AXIS = ("rad", "rad", "mm", "mm")
_DIRECTIONS = 300  # of axes that are tried: a hemisphere in steps of about 8 degrees
_LARGEST_RADIUS = 30.0  # root mean square distances from the middle
_TRIED = 8  # directions that are refined
_FEW_STEPS, _STEPS = 5, 8  # of their refinement, and of the best one's
_SMALLEST_ARC = 30.0  # degrees from its middle: below it, axis and radius can hardly be told apart
_LEAST_HEIGHT = 0.05  # standard deviation of the heights, in radii, below which the axis can tilt
_LEAST_SINGULAR = 0.02  # smallest singular value of the touches' directions, of root m


class Cylinder(AbstractObservation):
    """Touches of a cylinder: the tip's centre is at one distance from an unknown axis.

    Outside (a pin, a plug gauge) that distance is (diameter + stylus) / 2, inside (a ring gauge, a bore)
    (diameter - stylus) / 2.

    Args:
        name: Name of the cylinder.
        q: Joint readings ``(m, n)``, rad.
        diameter: Certified diameter, mm; None where it is unknown.
        u: Standard uncertainty (k = 1) of the diameter, mm.
        stylus: Diameter of the tip's ball, mm; 0 where the tip itself is on the cylinder, or where the diameter is
            unknown, which then includes it.
        inside: Whether the ball was inside the cylinder.
        form: Standard deviation of the surface about its cylinder, mm.
        target: Name of the tip, by default the arm's own probe.

    Raises:
        InputError: Shapes do not fit, a value is negative, or the ball is larger than the bore.

    Example:
        >>> kinds = aj.data.observations
        >>> ring = kinds.Cylinder("ring", capture.q[:8], diameter=50.0, u=0.001, stylus=6.0, inside=True)
        >>> print(ring.radius, [*ring.unknowns])
        22.0 ['axis of ring', 'radius of ring']
    """

    kind: ClassVar[str] = "cylinder"
    table: ClassVar[str] = "touched_cylinder"
    entries: ClassVar[tuple[Entry, ...]] = (
        READINGS,
        Entry("diameter", "certified diameter", "mm", uncertainty="u"),
        Entry("u", "standard uncertainty of the diameter", "mm"),
        Entry("stylus", "diameter of the tip's ball", "mm"),
        Entry("inside", "whether the ball was inside", content="truth"),
        Entry("form", "standard deviation of the surface about its cylinder", "mm"),
        TARGET,
    )
    rows: ClassVar[int] = 1
    stated: ClassVar[tuple[str, ...]] = ("diameter", "stylus", "u", "form")
    q: Float[AnyArray, "m n"]
    diameter: Float[AnyArray, ""] | None  # mm
    stylus: Float[AnyArray, ""]  # mm
    u: Float[AnyArray, ""]  # of the radius, mm
    form: Float[AnyArray, ""]
    name: str = eqx.field(static=True)
    target: str = eqx.field(static=True)
    inside: bool = eqx.field(static=True)
    free: bool = eqx.field(static=True)  # whether the radius is an unknown

    def __init__(
        self,
        name: str,
        q: Numbers,
        *,
        diameter: Numbers | None = None,
        u: Numbers = 0.0,
        stylus: Numbers = 0.0,
        inside: bool = False,
        form: Numbers = 0.0,
        target: str = "",
    ):
        self.name = checked_name(name, "a cylinder")
        where = f"cylinder '{name}'"
        self.q = checked_readings(where, q)
        self.u = checked_scalar(f"u of {where}", u) / 2
        self.form = checked_scalar(f"form of {where}", form)
        self.target = checked_target(target)
        self.inside = checked_truth(f"inside of {where}", inside)
        self.stylus = checked_scalar(f"stylus of {where}", stylus)
        self.diameter = None if diameter is None else checked_scalar(f"diameter of {where}", diameter, positive=True)
        radius = self.radius
        if radius is not None and is_concrete(radius) and float(radius) <= 0:
            raise InputError(
                f"{where} has a stylus of {self.stylus:g} mm inside a diameter of {self.diameter:g} mm; give the "
                "diameters of the bore and of the ball that fits into it, in mm."
            )
        self.free = radius is None or not is_exact(self.u)

    @property
    def radius(self) -> Float[AnyArray, "*batch"] | None:
        """Certified distance of the tip's centre from the axis, mm."""
        if self.diameter is None:
            return None
        return (self.diameter - self.stylus if self.inside else self.diameter + self.stylus) / 2

    @property
    def axis(self) -> str:
        """Name of the unknown axis: two components of the rotation vector that turns z to its direction, and where it
        meets the plane through the origin across it, along the x and y axes that are turned likewise."""
        return f"axis of {self.name}"

    @property
    def size(self) -> str:
        """Name of the unknown radius."""
        return f"radius of {self.name}"

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        return {self.axis: AXIS} | ({self.size: ("mm",)} if self.free else {})

    def stored(self) -> dict[str, Any]:
        return super().stored() | {"u": 2 * self.u}  # twice and half of a number are exact

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        if part == self.size and float(self.stylus):
            ball = float(self.stylus) / 2
            return (Quantity("without the tip's ball", values + ball if self.inside else values - ball, "mm"),)
        if part != self.axis:
            return super().quantities(part, values)
        turned = np.asarray(rotation_matrix(np.append(values[:2], 0.0)))
        point = turned[:, :2] @ values[2:]
        return (Quantity("direction of the axis", turned[:, 2], "1"), Quantity("point of the axis", point, "mm"))

    @property
    def fixes_scale(self) -> bool:
        return self.radius is not None

    @property
    def certified(self) -> dict[str, tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]]:
        return {self.size: (self.radius[None], self.u[None])} if self.free and self.radius is not None else {}

    @property
    def alike(self) -> Hashable | None:
        return self.inside, self.free, self.diameter is None

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        axis, radius = fitted_cylinder(tips.position, self.radius)
        return {self.axis: axis} | ({self.size: radius[None]} if self.free else {})

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        distance, direction, by_axis = distances(tips.position, unknowns[self.axis])
        xp, m = namespace(distance), self.q.shape[0]
        radius: Any = unknowns[self.size][0] if self.free else self.radius
        by_unknowns = {self.axis: by_axis[:, None]}
        if self.free:
            by_unknowns[self.size] = -xp.ones((1, 1, m))
        return Rows((distance - radius)[None], direction[None], by_unknowns, variances(self.form, m))

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        where = f"cylinder '{self.name}'"
        needed = 5 if self.radius is None else 4
        if tips.shape[1] < needed:
            raise InputError(f"{where} has {tips.shape[1]} touches, but {needed} unknowns; touch it more often.")
        middle = tips.mean(axis=1, keepdims=True)
        known = None if self.radius is None else np.asarray(self.radius)
        axis, radius = fitted_cylinder(tips - middle, known)
        _, direction, _ = distances(tips - middle, axis)
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


def distances(
    tips: Float[AnyArray, "3 m"], axis: Float[AnyArray, "4 ..."]
) -> tuple[Float[AnyArray, " m"], Float[AnyArray, "3 m"], Float[AnyArray, "4 m"]]:
    """Distances of tips from an axis (or from one each), mm, the unit vectors from the axis to the tips, and the
    derivatives of the distances by the axis' numbers."""
    xp, axis = namespace(tips, axis), as_columns(axis)
    w = xp.concatenate([axis[:2], xp.zeros_like(axis[:1])])
    rotation, axes = rotation_and_derivative(w)
    across_axis = rotation[:, :2]
    between = products_by_column(across_axis.swapaxes(0, 1), tips) - axis[2:]
    distance, across = length_and_direction(between)
    direction = products_by_column(across_axis, across)
    # A small rotation v of the axes moves a tip t by -v x t in them, and the distance by -v.(t x direction).
    by_rotation = -products_by_column(axes[:, :2].swapaxes(0, 1), cross(tips, direction))
    return distance, direction, xp.concatenate([by_rotation, -across])


def fitted_cylinder(
    tips: Float[AnyArray, "3 m"], radius: Float[AnyArray, ""] | None
) -> tuple[Float[AnyArray, " 4"], Float[AnyArray, ""]]:
    """Axis and radius of the cylinder that points are closest to; of this radius where it is known.

    For a given direction the best circle of the points' projections is a linear problem (|y|^2 = 2 c.y + k). Directions
    all over a hemisphere are tried, and the best of them are refined by Levenberg-Marquardt.
    """
    xp = namespace(tips, radius)
    middle = xp.mean(tips, axis=1, keepdims=True)
    size = xp.sqrt(xp.mean((tips - middle) ** 2)) + 1e-12
    centred = (tips - middle) / size
    frames = _frames(centred)
    centres, radii = _circles(frames, centred)
    if radius is not None:
        radii = xp.zeros_like(radii) + radius / size
    upwards = xp.where(frames[:, 2, 2] < 0, -1.0, 1.0)[:, None] * frames[:, :, 2]
    tried = _worth_refining(centred, frames, centres, radii)

    def refined(best: AnyArray, i: AnyArray) -> tuple[AnyArray, AnyArray]:
        first = _moved(turned_z(upwards[i]), frames[i, :, :2] @ centres[i])
        found, cost = _refined(centred, xp.concatenate([first, radii[i][None]]), _FEW_STEPS, free=radius is None)
        # A plane is a cylinder too, of a radius far beyond the points.
        cost = xp.where(xp.abs(found[4]) < _LARGEST_RADIUS, cost, cost + 1e6) if radius is None else cost
        return xp.where(cost < best[5], xp.concatenate([found, cost[None]]), best), cost

    worst = xp.concatenate([xp.zeros(5), xp.zeros(1) + np.inf])
    best, _ = scan(refined, worst, tried)
    found, _ = _refined(centred, best[:5], _STEPS, free=radius is None)
    position = size * found[2:4] + _moved(found[:2], middle[:, 0])[2:]
    return xp.concatenate([found[:2], position]), size * found[4]


def _circles(
    frames: Float[AnyArray, "k 3 3"], centred: Float[AnyArray, "3 m"]
) -> tuple[Float[AnyArray, "k 2"], Float[AnyArray, " k"]]:
    """Centre and radius of the circle through the projections of points along the last axis of each frame."""
    xp, least = namespace(frames, centred), 1e-9 * centred.shape[1]
    y = xp.einsum("kca,cm->kam", frames[:, :, :2], centred)
    a, b, c = (xp.sum(y[:, i] * y[:, j], axis=1) for i, j in ((0, 0), (0, 1), (1, 1)))
    a, c = a + least, c + least
    right = xp.sum(xp.sum(y**2, axis=1)[:, None] * y, axis=2) / 2
    centre = xp.stack([c * right[:, 0] - b * right[:, 1], a * right[:, 1] - b * right[:, 0]], axis=1)
    centre = centre / (a * c - b**2)[:, None]
    return centre, xp.mean(xp.sqrt(xp.sum((y - centre[:, :, None]) ** 2, axis=1)), axis=1)


def _worth_refining(
    centred: Float[AnyArray, "3 m"],
    frames: Float[AnyArray, "k 3 3"],
    centres: Float[AnyArray, "k 2"],
    radii: Float[AnyArray, " k"],
) -> Int[AnyArray, " t"]:
    """The directions whose circle fits better than those around them, the best of them, and the principal axes: a few
    touches may lie nearly on several cylinders, and the best direction tried need not be next to the best of all."""
    xp = namespace(centred)
    y = xp.einsum("kca,cm->kam", frames[:, :, :2], centred)
    distance = xp.sqrt(xp.sum((y - centres[:, :, None]) ** 2, axis=1))
    error = xp.mean((distance - radii[:, None]) ** 2, axis=1)[:_DIRECTIONS]
    _, around = _hemisphere()
    least = xp.min(xp.where(xp.asarray(around), error[None], np.inf), axis=1)
    best = xp.argsort(xp.where(error <= least, error, error + 1e6))[:_TRIED]
    return xp.concatenate([best, xp.arange(_DIRECTIONS, _DIRECTIONS + 3)])


def _moved(turn: Float[AnyArray, " 2"], point: Float[AnyArray, " 3"]) -> Float[AnyArray, " 4"]:
    """The numbers of the axis through a point."""
    xp = namespace(turn, point)
    return xp.concatenate([turn, (rotation_matrix(xp.concatenate([turn, xp.zeros(1)])).T @ point)[:2]])


@functools.cache
def _hemisphere() -> tuple[Float[np.ndarray, "k 3 3"], Bool[np.ndarray, "k k"]]:
    """Frames whose last axes are all over a hemisphere, by the golden angle, and which of these axes are neighbours."""
    height = (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    angle = np.pi * (3 - math.sqrt(5)) * np.arange(_DIRECTIONS)
    turns = np.arccos(height) * np.stack([np.cos(angle), np.sin(angle), np.zeros(_DIRECTIONS)])
    frames = np.stack([rotation_matrix(turn) for turn in turns.T])
    axes = frames[:, :, 2]
    return frames, np.abs(axes @ axes.T) > math.cos(1.7 * math.sqrt(2 * math.pi / _DIRECTIONS))


def _frames(centred: Float[AnyArray, "3 m"]) -> Float[AnyArray, "k 3 3"]:
    """Axes that are tried, each as the last column of a rotation: all over a hemisphere, and the points' principal
    axes, since the axis of a long cylinder must be known to better than a step."""
    xp = namespace(centred)
    _, principal = semidefinite_eigen(centred @ centred.T)
    principal = principal / xp.sqrt(xp.sum(principal**2, axis=0) + 1e-300)[None]
    ordered = [principal[:, np.array(order)] for order in ((1, 2, 0), (2, 0, 1), (0, 1, 2))]
    return xp.concatenate([xp.asarray(_hemisphere()[0]), xp.stack(ordered)])


def _refined(
    tips: Float[AnyArray, "3 m"], first: Float[AnyArray, " 5"], steps: int, *, free: bool
) -> tuple[Float[AnyArray, " 5"], Float[AnyArray, ""]]:
    """Axis and radius with the least squares of the distances from the cylinder, from a start nearby; and the sum."""
    xp = namespace(tips, first)
    identity = xp.asarray(np.eye(5))

    def rows(z: Float[AnyArray, " 5"]) -> Float[AnyArray, "6 m"]:
        distance, _, by_axis = distances(tips, z[:4])
        by_radius = -xp.ones_like(tips[:1]) if free else xp.zeros_like(tips[:1])
        return xp.concatenate([by_axis, by_radius, (distance - z[4])[None]])

    def step(state: tuple[AnyArray, AnyArray, AnyArray], _: Any) -> tuple[tuple[AnyArray, AnyArray, AnyArray], None]:
        z, known, damping = state
        gram = known @ known.T
        damped = gram[:5, :5] * (1 + damping * identity) + 1e-9 * tips.shape[1] * identity
        new = z - solve_positive_definite(damped, gram[:5, 5])
        there = rows(new)
        better = xp.sum(there[5] ** 2) < gram[5, 5]
        return (xp.where(better, new, z), xp.where(better, there, known), xp.where(better, 0.1, 10.0) * damping), None

    (found, known, _), _ = scan(step, (first, rows(first), xp.asarray(1e-3)), length=steps)
    return found, xp.sum(known[5] ** 2)


class SimulatedCylinder(AbstractSimulated):
    """Touches all round a cylinder and along it.

    Args:
        name: Name of the cylinder.
        ends: Both ends of its axis in the base frame ``(2, 3)``, mm.
        diameter: Its true diameter, mm.
        poses: Number of touches.
        certified: Whether the diameter is certified.
        u: Standard uncertainty of the certified diameter, mm.
        stylus: Diameter of the tip's ball, mm.
        inside: Whether the ball is inside.

    Example:
        >>> ends = [[400, 200, 300], [400, 200, 320]]
        >>> ring = aj.data.observations.SimulatedCylinder("ring", ends, 50.0, 12, inside=True)
        >>> print(aj.simulate(true, {}, observations=[ring]).observations[0].q.shape)
        (12, 6)
    """

    table: ClassVar[str] = "touched_cylinder"
    name: str = eqx.field(static=True)
    ends: np.ndarray = eqx.field(converter=numbers("ends", 2, 3))
    diameter: float
    poses: int = eqx.field(static=True)
    certified: bool = eqx.field(static=True, default=True)
    u: float = 0.0
    stylus: float = 0.0
    inside: bool = eqx.field(static=True, default=False)

    def placed(self, name: str, frame: Float[np.ndarray, " 6"]) -> "SimulatedCylinder":
        return dataclasses.replace(self, name=name, ends=np.stack([moved(frame, end) for end in self.ends]))

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        along = self.ends[1] - self.ends[0]
        directions = np.cross(along, random.normal(size=(self.poses, 3)))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        radius = (self.diameter - self.stylus if self.inside else self.diameter + self.stylus) / 2
        return self.ends[0] + random.uniform(size=(self.poses, 1)) * along + radius * directions

    def recorded(
        self, q: Float[np.ndarray, "m n"], transforms: Float[np.ndarray, "m 4 4"], random: np.random.Generator
    ) -> Cylinder:
        if not self.certified:
            return Cylinder(self.name, q)
        diameter = self.diameter + self.u * random.normal()
        return Cylinder(self.name, q, diameter=diameter, u=self.u, stylus=self.stylus, inside=self.inside)
