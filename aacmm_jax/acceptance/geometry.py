"""Geometry of a test: how touches are spread over a sphere, where bars and spheres were, and how the arm was held."""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..data.recording import Recording
from ..kinematics.arm import Arm
from ..kinematics.workspace import Reach, skeleton
from .results import Measured, Postures
from .spheres import EXACT_POINTS, fit_sphere

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
_SAME_PLACE, LEAST_SPREAD, _LEAST_ACROSS = 0.05, 0.1, 0.03  # parts of the range; of directions, mean square


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


def directions_on_sphere(points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Directions of touches from the centre of the sphere that fits them."""
    return unit_rows(points - fit_sphere(points).centre)


def hemisphere_gap(directions: Float[np.ndarray, "m 3"]) -> float:
    """Largest angle, rad, from a direction of a hemisphere to the nearest touch, for the hemisphere that suits best."""
    grid, inside = _grid()
    nearest = np.arccos(np.clip((grid @ directions.T).max(axis=1), -1, 1))
    return float(np.where(inside, nearest, 0.0).max(axis=1).min())


@functools.cache
def allowed_gap(count: int) -> float:
    """The largest `hemisphere_gap` that counts as the recommended spread of so many touches, rad."""
    return hemisphere_gap(touch_directions(count)) + _BY_HAND


def covers_hemisphere(points: Float[np.ndarray, "m 3"], count: int) -> bool:
    """Whether the touches of one sphere are spread over a hemisphere as the recommended ``count`` of them are."""
    return len(points) >= EXACT_POINTS and hemisphere_gap(directions_on_sphere(points)) <= allowed_gap(count)


def least_turn(points: Float[np.ndarray, "m 3"]) -> float:
    """Smallest angle about the pole by which a ring of touches is turned against the ring above it, rad.

    The pole is the touch that the others lie about; 0 where they are in no rings.
    """
    directions = directions_on_sphere(points)
    pole = directions[int(np.argmax(directions @ directions.mean(axis=0)))]
    across = unit_rows(np.cross(pole, np.eye(3)[int(np.argmin(np.abs(pole)))])[None])[0]
    polar = np.arccos(np.clip(directions @ pole, -1, 1))
    azimuth = np.arctan2(directions @ np.cross(pole, across), directions @ across)
    order = np.argsort(polar)
    rings = np.split(order, np.flatnonzero(np.diff(polar[order]) > _RING_GAP) + 1)[1:]
    if len(rings) < 2:
        return 0.0
    turns = [
        np.abs((azimuth[lower][:, None] - azimuth[upper][None] + np.pi) % (2 * np.pi) - np.pi).min()
        for upper, lower in itertools.pairwise(rings)
    ]
    return float(min(turns))


@functools.cache
def _grid() -> tuple[Float[np.ndarray, "g 3"], Bool[np.ndarray, "g g"]]:
    """Directions spread evenly over the sphere (a spiral of Fibonacci), and which are of each one's hemisphere."""
    number = np.arange(_DIRECTIONS) + 0.5
    height, azimuth = 1 - 2 * number / _DIRECTIONS, math.pi * (1 + math.sqrt(5)) * number
    radius = np.sqrt(1 - height**2)
    grid = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
    return grid, grid @ grid.T >= 0


class BarPositions(NamedTuple):
    """Where one bar was measured: a row a position."""

    length: float  # mm
    middles: Float[np.ndarray, "k 3"]  # mm
    directions: Float[np.ndarray, "k 3"]
    readings: tuple[int, ...]

    @property
    def in_all_directions(self) -> bool:
        """Whether the directions are not all in one plane or parallel, with a margin of about 10 degrees."""
        # Mean square of their components along the axis that they have least of; 1/3 for all directions.
        across = np.linalg.eigvalsh(self.directions.T @ self.directions / len(self.directions))[0]
        return bool(across >= _LEAST_ACROSS)

    def spread(self, size: float) -> float:
        """RMS distance of the middles from their mean, relative to a size."""
        return float(np.sqrt(np.mean(np.sum((self.middles - self.middles.mean(axis=0)) ** 2, axis=1)))) / size

    def distinct(self, size: float | None) -> "BarPositions":
        """Positions that differ from one another by 10 degrees or more, or in place by 5 % of the size (mm)."""
        near = _SAME_PLACE * (self.length if size is None else size)
        kept: list[int] = []
        for i, (middle, direction) in enumerate(zip(self.middles, self.directions, strict=True)):
            along = np.abs(self.directions[kept] @ direction) > math.cos(_SAME_DIRECTION)
            close = np.linalg.norm(self.middles[kept] - middle, axis=1) < near
            if not np.any(along & close):
                kept.append(i)
        return BarPositions(
            self.length, self.middles[kept], self.directions[kept], tuple(self.readings[i] for i in kept)
        )


def bar_positions(measured: Measured, groups: Sequence[Sequence[float]]) -> list[BarPositions]:
    """The positions of each bar, of which ``groups`` has the calibrated values."""
    positions = []
    pairs = {frozenset((length.start, length.end)): length for length in measured.lengths}
    for values in groups:
        lengths = [length for length in pairs.values() if min(values) <= float(length.value) <= max(values)]
        ends = [[measured.sockets[name] for name in (length.start, length.end)] for length in lengths]
        start, end = (np.array([pair[i].mean(axis=0) for pair in ends]) for i in (0, 1))
        readings = tuple(min(map(len, pair)) for pair in ends)
        positions.append(BarPositions(float(np.mean(values)), (start + end) / 2, unit_rows(end - start), readings))
    return positions


def all_bars(bars: Sequence[BarPositions]) -> BarPositions:
    """The positions of all bars together."""
    return BarPositions(
        float(np.mean([bar.length for bar in bars])),
        np.concatenate([bar.middles for bar in bars]),
        np.concatenate([bar.directions for bar in bars]),
        tuple(number for bar in bars for number in bar.readings),
    )


def size_of(measured: Measured) -> float | None:
    """The maker's measuring range (a diameter), mm; twice the reach by the model where it is not stated."""
    if measured.measuring_range is not None:
        return measured.measuring_range
    return None if measured.reach is None else 2 * measured.reach.radius


def separate_places(points: Sequence[Float[np.ndarray, " 3"]], least: float) -> int:
    """How many points are farther apart than ``least`` from one another, mm."""
    kept: list[np.ndarray] = []
    for point in points:
        if all(np.linalg.norm(point - other) >= least for other in kept):
            kept.append(point)
    return len(kept)


def postures_of(arm: Arm, recording: Recording, reach: Reach) -> Postures:
    """The postures of the poses in sockets and on spheres."""
    sockets = recording.capture.sockets
    q = [np.asarray(readings) for readings in sockets.values()]
    sides = elbow_sides(arm, np.concatenate(q), reach) if q else np.zeros(0)
    elbows = np.split(sides, np.cumsum([len(readings) for readings in q])[:-1]) if q else []
    probes = {
        (sphere.name, sphere.test): tuple(probe_directions(arm, np.asarray(group)) for group in sphere.groups)
        for sphere in recording.spheres
    }
    return Postures(dict(zip(sockets, elbows, strict=True)), probes)


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


def probe_directions(arm: Arm, q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m 3"]:
    """Directions of the probe, from the last frame's origin to the tip; where these coincide, of its z axis."""
    rotations = np.asarray(arm.pose(q))[:, :3, :3]
    probe = np.asarray(arm.probe)
    return unit_rows(rotations @ (probe if np.any(probe) else np.array([0.0, 0.0, 1.0])))
