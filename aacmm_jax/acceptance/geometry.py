"""Geometry of a test: spheres fitted to touches and how these are spread; where bars were; how the arm was held."""

import functools
import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError
from ..kinematics.arm import Arm
from ..kinematics.workspace import Reach, skeleton
from .results import Measured

EXACT_POINTS = 4  # a sphere goes through so many points exactly, so they have no form error
_COINCIDENT = 1e-7  # distance of two points, relative to the extent of all, below which they count as one
# Rings of touches on the upper half of a sphere, from its pole down, by the number of touches: elevation in degrees,
# touches, and azimuth of the first in degrees. That of 25 is ISO 10360-5's (background knowledge): every ring is turned
# by 22.5 deg against the ring above it. Those of 9 and 5 are background knowledge too.
RINGS = {
    25: ((90, 1, 0), (67.5, 4, 0), (45, 8, 22.5), (22.5, 4, 45), (0, 8, 67.5)),
    9: ((90, 1, 0), (45, 4, 0), (0, 4, 45)),
    5: ((90, 1, 0), (10, 4, 45)),
}
_DIRECTIONS = 800  # of a grid over the sphere: 7 deg apart
_BY_HAND = math.radians(8)  # added to the largest gap of the recommended pattern
_RING_GAP = math.radians(12)  # touches whose elevations differ by more are of different rings
_SAME_DIRECTION = math.radians(10)
LEFT_OR_RIGHT = math.radians(15)  # of the elbow against the vertical: nearer it is neither left nor right
_SAME_PLACE, _LEAST_ACROSS = 0.05, 0.03  # part of the range; of directions, mean square
_SAME_ARTEFACT = 0.01  # lengths that differ by less (relative) belong to one artefact


class FittedSphere(NamedTuple):
    """The least-squares sphere of points, mm."""

    centre: Float[np.ndarray, " 3"]
    radius: float
    residuals: Float[np.ndarray, " m"]  # distance of each point from the centre, less the radius

    @property
    def form(self) -> float:
        """Largest less smallest distance of the points from the centre, mm."""
        return float(np.ptp(self.residuals))


def points_of(points: Numbers, what: str) -> Float[np.ndarray, "m 3"]:
    """Points ``(m, 3)``, at least one, as a NumPy array, or `InputError` that names ``what``."""
    array = np.asarray(as_floats(points, what))
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise InputError(f"{what} have shape {array.shape}; give (x, y, z) in mm, one row per point, at least one row.")
    return array


def fit_sphere(points: Numbers) -> FittedSphere:
    """Fit a sphere by least squares of the points' distances from its surface.

    Solved by SciPy's Levenberg-Marquardt method (MINPACK), from the algebraic solution. `InputError` for fewer than
    four points, and for points in one plane.

    Args:
        points: Points ``(m, 3)``, mm.

    Example:
        >>> directions = np.concatenate([np.eye(3), -np.eye(3)])
        >>> sphere = aj.acceptance.fit_sphere([100.0, 0.0, 0.0] + 12.5 * directions)
        >>> print(sphere.centre.round(6), round(sphere.radius, 6))
        [100.   0.   0.] 12.5
    """
    from scipy import optimize

    given = points_of(points, "points on a sphere")
    if len(given) < EXACT_POINTS:
        raise InputError(
            f"a sphere needs at least {EXACT_POINTS} points, but {len(given)} are given; touch the sphere at more "
            "points."
        )
    middle = given.mean(axis=0)
    centred = given - middle
    size = float(np.linalg.norm(centred, axis=1).max())
    if size == 0 or np.linalg.svd(centred / size, compute_uv=False)[2] < 1e-6:
        raise InputError(
            "the points on a sphere lie in one plane, so they do not determine the sphere; touch the sphere on all "
            "sides."
        )
    # |p|^2 = 2 c.p + (r^2 - |c|^2) is linear in the centre; with lengths of about 1 it is also well conditioned.
    scaled = centred / size
    rows = np.column_stack([2 * scaled, np.ones(len(scaled))])
    start = np.linalg.lstsq(rows, np.sum(scaled**2, axis=1), rcond=None)[0]
    start[3] = np.sqrt(max(start[3] + start[:3] @ start[:3], 1e-12))

    def residuals(unknown: np.ndarray) -> np.ndarray:
        return np.linalg.norm(scaled - unknown[:3], axis=1) - unknown[3]

    def jacobian(unknown: np.ndarray) -> np.ndarray:
        away = unknown[:3] - scaled
        return np.column_stack([away / np.linalg.norm(away, axis=1, keepdims=True), -np.ones(len(scaled))])

    solve: Any = optimize.least_squares
    solution = solve(residuals, start, jacobian, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return FittedSphere(middle + size * solution.x[:3], float(size * solution.x[3]), size * solution.fun)


def enclosing_sphere(points: Numbers) -> tuple[Float[np.ndarray, " 3"], float]:
    """Centre ``(3,)`` and radius of the smallest sphere that contains all points, by Welzl's algorithm (miniball), mm.

    Args:
        points: Points ``(m, 3)``, mm, at least one.

    Example:
        >>> centre, radius = aj.acceptance.enclosing_sphere([[0, 0, 0], [2, 0, 0], [1, 0.5, 0]])
        >>> print(centre, radius)
        [1. 0. 0.] 1.0
    """
    import miniball

    given = points_of(points, "points")
    middle = given.mean(axis=0)
    size = float(np.abs(given - middle).max())
    if size == 0:
        return middle, 0.0
    # Nearly coincident points would make the algorithm's small systems singular; all points count again in the radius.
    apart = separate((given - middle) / size, _COINCIDENT)
    ball: Any = miniball.get_bounding_ball(apart, rng=np.random.default_rng(0))
    centre = middle + size * ball[0]
    return centre, float(np.linalg.norm(given - centre, axis=1).max())


def separate(points: Float[np.ndarray, "m 3"], least: float) -> Float[np.ndarray, "k 3"]:
    """Points that are farther apart than ``least`` from those kept before them."""
    kept: list[int] = []
    for i, point in enumerate(points):
        if np.all(np.linalg.norm(points[kept] - point, axis=1) > least):
            kept.append(i)
    return points[kept]


def unit_rows(rows: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Rows divided by their lengths; rows of zeros stay."""
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.divide(rows, size, out=np.zeros_like(rows), where=size > 0)


def touch_directions(count: int) -> Float[np.ndarray, "m 3"]:
    """Directions of the recommended touches on the upper half of a sphere."""
    rows = []
    for elevation, number, first in RINGS[count]:
        azimuth = 2 * np.pi * np.arange(number) / number + math.radians(first)
        height = np.full(number, math.sin(math.radians(elevation)))
        horizontal = [math.cos(math.radians(elevation)) * part(azimuth) for part in (np.cos, np.sin)]
        rows.append(np.column_stack([*horizontal, height]))
    return np.concatenate(rows)


def covers_hemisphere(points: Float[np.ndarray, "m 3"], count: int) -> bool:
    """Whether the touches of one sphere are spread over a hemisphere as the recommended ``count`` of them are."""
    if len(points) < EXACT_POINTS:
        return False
    directions = unit_rows(points - fit_sphere(points).centre)
    return _hemisphere_gap(directions) <= _recommended_gap(count) + _BY_HAND


def _hemisphere_gap(directions: Float[np.ndarray, "m 3"]) -> float:
    """Largest angle, rad, from a direction of a hemisphere to the nearest touch, for the hemisphere that suits best."""
    grid, inside = _grid()
    nearest = np.arccos(np.clip((grid @ directions.T).max(axis=1), -1, 1))
    return float(np.where(inside, nearest, 0.0).max(axis=1).min())


@functools.cache
def _recommended_gap(count: int) -> float:
    return _hemisphere_gap(touch_directions(count))


@functools.cache
def _grid() -> tuple[Float[np.ndarray, "g 3"], Bool[np.ndarray, "g g"]]:
    """Directions spread evenly over the sphere (a spiral of Fibonacci), and which are of each one's hemisphere."""
    number = np.arange(_DIRECTIONS) + 0.5
    height, azimuth = 1 - 2 * number / _DIRECTIONS, math.pi * (1 + math.sqrt(5)) * number
    radius = np.sqrt(1 - height**2)
    grid = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
    return grid, grid @ grid.T >= 0


def least_turn(points: Float[np.ndarray, "m 3"]) -> float:
    """Smallest angle about the pole by which a ring of touches is turned against the ring above it, rad.

    The pole is the touch that the others lie about; 0 where they are in no rings.
    """
    directions = unit_rows(points - fit_sphere(points).centre)
    pole = directions[int(np.argmax(directions @ directions.mean(axis=0)))]
    across = unit_rows(np.cross(pole, np.eye(3)[int(np.argmin(np.abs(pole)))])[None])[0]
    polar = np.arccos(np.clip(directions @ pole, -1, 1))
    azimuth = np.arctan2(directions @ np.cross(pole, across), directions @ across)
    order = np.argsort(polar)
    rings = np.split(order, np.flatnonzero(np.diff(polar[order]) > _RING_GAP) + 1)[1:]
    turns = [
        np.abs((azimuth[lower][:, None] - azimuth[upper][None] + np.pi) % (2 * np.pi) - np.pi).min()
        for upper, lower in itertools.pairwise(rings)
    ]
    return float(min(turns, default=0.0))


class BarPositions(NamedTuple):
    """Where bars were measured: a row a position."""

    lengths: Float[np.ndarray, " k"]  # mm
    middles: Float[np.ndarray, "k 3"]  # mm
    directions: Float[np.ndarray, "k 3"]
    readings: Int[np.ndarray, " k"]  # number of them

    def chosen(self, index: Any) -> "BarPositions":
        """Some of the positions."""
        return BarPositions(*(part[index] for part in self))

    def artefacts(self) -> list["BarPositions"]:
        """The positions of each artefact, the shortest first."""
        order = np.argsort(self.lengths, kind="stable")
        values = self.lengths[order]
        parts = np.split(order, np.flatnonzero(np.diff(values) > _SAME_ARTEFACT * values[1:]) + 1)
        return [self.chosen(part) for part in parts if len(part)]

    @property
    def in_all_directions(self) -> bool:
        """Whether the directions are not all in one plane or parallel, with a margin of about 10 degrees."""
        # Mean square of their components along the axis that they have least of; 1/3 for all directions.
        across = np.linalg.eigvalsh(self.directions.T @ self.directions / len(self.directions))[0]
        return bool(across >= _LEAST_ACROSS)

    def spread(self, size: float) -> float:
        """RMS distance of the middles from their mean, relative to a size."""
        return float(np.sqrt(np.mean(np.sum((self.middles - self.middles.mean(axis=0)) ** 2, axis=1)))) / size

    def distinct(self, size: float | None) -> int:
        """How many differ from one another by 10 degrees or more, or in place by 5 % of the size (mm)."""
        near = _SAME_PLACE * (float(np.mean(self.lengths)) if size is None else size)
        kept: list[int] = []
        for i, (middle, direction) in enumerate(zip(self.middles, self.directions, strict=True)):
            along = np.abs(self.directions[kept] @ direction) > math.cos(_SAME_DIRECTION)
            close = np.linalg.norm(self.middles[kept] - middle, axis=1) < near
            if not np.any(along & close):
                kept.append(i)
        return len(kept)


def bar_positions(measured: Measured) -> BarPositions:
    """The positions of all lengths, one for each pair of sockets."""
    lengths = {frozenset((length.start, length.end)): length for length in measured.lengths}.values()
    ends = [[measured.sockets[name] for name in (length.start, length.end)] for length in lengths]
    start, end = (np.array([pair[i].mean(axis=0) for pair in ends]).reshape(-1, 3) for i in (0, 1))
    return BarPositions(
        np.array([float(length.value) for length in lengths]),
        (start + end) / 2,
        unit_rows(end - start),
        np.array([min(map(len, pair)) for pair in ends], dtype=int),
    )


def elbow_sides(arm: Arm, q: Float[np.ndarray, "m n"], reach: Reach) -> Float[np.ndarray, " m"]:
    """Angle of the elbow about the line from the shoulder to the tip, to the left of the vertical plane, rad.

    The elbow is the corner of the arm farthest from that line. An arm that is stretched, or whose tip is above the
    shoulder, has an elbow on neither side (0).
    """
    corners = skeleton(arm, q) - reach.shoulder
    line = unit_rows(corners[:, -1])
    off = corners - np.einsum("mcj,mj->mc", corners, line)[..., None] * line[:, None]
    off[:, 0] = 0.0  # the base is below the shoulder
    elbow = off[np.arange(len(q)), np.argmax(np.linalg.norm(off, axis=2), axis=1)]
    left = unit_rows(np.column_stack([-line[:, 1], line[:, 0], np.zeros(len(line))]))
    return np.arcsin(np.clip(np.sum(unit_rows(elbow) * left, axis=1), -1, 1))
