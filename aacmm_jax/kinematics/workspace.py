"""The workspace of an arm: its reach, lowest point, configurations at given points, and links as lines in space."""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.arguments import Range, checked
from ..core.errors import InputError
from ..core.numpy_or_jax import in_chunks, to_numpy
from .arm import Arm, joint_limits
from .chain import forward_pass, joint_motion, reading_units
from .collisions import Cell, checked_cell, is_clear
from .cones import Cones, into_cones
from .inverse_kinematics import project_to_targets

_STARTS, _SWEEPS = 256, 30
_REACHING = 25  # steps: seven of ten random starts arrive, and with 60 eight would


class Reach(NamedTuple):
    """The smallest ball about the shoulder that contains all positions of the tip, mm."""

    shoulder: Float[np.ndarray, " 3"]  # on the first axis, d_1 above the base; amid the travel of a prismatic joint
    radius: float


def arm_reach(arm: Arm) -> Reach:
    """Largest distance of the tip from the shoulder within the joint limits.

    Args:
        arm: One arm.

    Returns:
        The shoulder in the base frame ``(3,)``, and the distance, mm.

    Example:
        >>> reach = aj.kinematics.arm_reach(arm)
        >>> print(f"{reach.radius:.0f} mm")
        1359 mm
    """
    shoulder = _shoulder(arm)
    return Reach(shoulder, _extreme_distance(arm, shoulder, farthest=True))


def _shoulder(arm: Arm) -> Float[np.ndarray, " 3"]:
    travel = np.mean(joint_limits(arm, None)[0]) if 1 in arm.prismatic else 0.0
    return np.array([0.0, 0.0, float(np.asarray(arm.d)[0] + travel)])


def closest_approach(arm: Arm) -> float:
    """Smallest distance of the tip from the shoulder within the joint limits, mm; the arm's own body may be in the way.

    Found from many random starts, so that a smaller one is unlikely, but not excluded.

    Args:
        arm: One arm.

    Example:
        >>> print(f"{aj.kinematics.closest_approach(arm):.0f} mm")
        146 mm
    """
    return _extreme_distance(arm, _shoulder(arm), farthest=False)


def _extreme_distance(arm: Arm, shoulder: Float[np.ndarray, " 3"], *, farthest: bool) -> float:
    """Largest or smallest distance of the tip from the shoulder.

    As a function of one joint the squared distance is a constant plus a sinusoid: with the lever r from a point of the
    joint's axis z to the tip, and s from the shoulder to that point, of 2 s . (r - (z . r) z) cos t + 2 s . (z x r) sin
    t. Of a prismatic joint it is convex: an end of its travel is the maximum, the foot of the perpendicular the
    minimum. From many random starts, joint after joint is set to its extreme until nothing changes, the last joint
    first: a joint moves the tip, but no axis of the joints before it.
    """
    sign = 1.0 if farthest else -1.0
    limits = np.asarray(joint_limits(arm, None))
    slides = [joint + 1 in arm.prismatic for joint in range(arm.joints)]
    q = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (_STARTS, arm.joints))
    geometry = to_numpy(arm.geometry)
    best, now = -np.inf, 0.0
    for _ in range(_SWEEPS):
        forward = forward_pass(geometry, joint_motion(geometry, q))
        tip = forward.tip.T
        # The first joint, if it is revolute, rotates the whole arm about the shoulder's axis.
        for joint in range(arm.joints - 1, -1 if slides[0] else 0, -1):
            if slides[joint]:
                axis, (low, high) = forward.z_before[joint].T, limits[joint]
                foot = q[:, joint] - np.sum((tip - shoulder) * axis, axis=1)
                reading = np.where(foot > (low + high) / 2, low, high) if farthest else np.clip(foot, low, high)
                tip = tip + (reading - q[:, joint])[:, None] * axis
                q[:, joint] = reading
                continue
            axis, origin = forward.z_before[joint].T, forward.origin_before[joint].T
            # tip(t) = origin + (tip - origin) cos t + ..., so that s . tip varies as cosine cos t + sine sin t.
            offset, across = origin - shoulder, np.cross(axis, tip - origin)
            along = np.cross(across, axis)
            cosine, sine = sign * np.sum(offset * along, axis=1), sign * np.sum(offset * across, axis=1)
            highest = q[:, joint] + np.arctan2(sine, cosine)
            low, high = limits[joint]
            # The angle of the maximum, by whole revolutions within the limits if one is; else the better limit.
            whole = highest + 2 * np.pi * np.ceil((low - highest) / (2 * np.pi))
            at_low, at_high = (
                cosine * np.cos(end) + sine * np.sin(end) for end in (low - q[:, joint], high - q[:, joint])
            )
            reading = np.where(whole <= high, whole, np.where(at_low > at_high, low, high))
            change = (reading - q[:, joint])[:, None]
            tip = tip + (np.cos(change) - 1) * along + np.sin(change) * across
            q[:, joint] = reading
        now = sign * float((sign * np.linalg.norm(tip - shoulder, axis=1)).max())
        if sign * now - best <= 1e-12 * abs(now):
            break
        best = sign * now
    return now


def skeleton(arm: Arm, q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m c 3"]:
    """Corners of the arm, mm: the base, the end of each joint's offset and of its link, and the tip (c = 2 n + 2)."""

    def lines(rows: np.ndarray) -> np.ndarray:
        motion = joint_motion(arm.geometry, rows)
        forward = forward_pass(*to_numpy((arm.geometry, motion)))
        before, after, axis = (
            np.asarray(part).reshape(arm.joints, 3, -1)
            for part in (forward.origin_before, forward.origin, forward.z_before)
        )
        along = np.asarray(arm.d)[:, None, None] + (0.0 if motion.slide is None else np.asarray(motion.slide))
        offset = before + along * axis
        both = np.stack([offset, after], axis=1).reshape(2 * arm.joints, 3, -1)
        tip = np.asarray(forward.tip).reshape(1, 3, -1)
        return np.concatenate([np.zeros_like(tip), both, tip]).transpose(2, 0, 1)

    return in_chunks(lines, np.asarray(q))


def lowest_point(arm: Arm, q: Float[np.ndarray, "c n"]) -> Float[np.ndarray, " c"]:
    """Height of the lowest joint or tip in the base frame, mm, without the base itself, for each configuration."""

    def lowest(rows: np.ndarray) -> np.ndarray:
        forward = forward_pass(*to_numpy((arm.geometry, joint_motion(arm.geometry, rows))))
        return np.minimum(np.min(forward.origin[:, 2], axis=0), forward.tip[2])

    return in_chunks(lowest, q)


def total_link_length(arm: Arm) -> float:
    """Sum of the lengths of the links and the probe, without the base's height d_1, mm.

    A prismatic joint adds its longest slide by its limits, or 1 m where it has none.
    """
    slides = [1000.0 if arm.limits is None else max(map(abs, arm.limits[i - 1])) for i in arm.prismatic]
    links = np.abs(arm.a).sum() + np.abs(np.asarray(arm.d)[1:]).sum() + np.linalg.norm(np.asarray(arm.probe))
    return float(links + sum(slides))


class SearchRegion(NamedTuple):
    """Where configurations are looked for, and the random numbers that the search uses."""

    arm: Arm
    limits: Float[np.ndarray, "n 2"]  # lowest and highest reading of each joint, rad, or mm of prismatic ones
    above: float  # height in the base frame below which no joint and no tip comes, mm
    random: np.random.Generator
    cones: Cones | None = None  # of approach to each socket; None where the tool may have any direction
    cell: Cell | None = None  # what the arm may not touch

    def draw(self, count: int) -> Float[np.ndarray, "c n"]:
        """Random configurations within the limits."""
        return self.random.uniform(self.limits[:, 0], self.limits[:, 1], (count, self.arm.joints))


def search_region(
    arm: Arm,
    limits: Sequence[Sequence[float]] | None,
    margin: float,
    above: float,
    seed: int,
    cones: Cones | None = None,
    cell: Cell | None = None,
) -> SearchRegion:
    """The region ``margin`` (rad, or m of prismatic joints) inside the joint limits (default: the arm's own), ``above``
    (mm) the table, within the cones of approach and clear of the cell's obstacles."""
    checked(seed, Annotated[int, Range(least=0)], "seed")
    allowed = np.asarray(joint_limits(arm, limits))
    margins = margin * reading_units(arm.geometry)
    if not (math.isfinite(margin) and margin >= 0 and np.all(margins < (allowed[:, 1] - allowed[:, 0]) / 2)):
        raise InputError(
            f"a margin of {math.degrees(margin):g} deg leaves a joint no range within its limits; give a smaller one."
        )
    inner = allowed + margins[:, None] * np.array([1.0, -1.0])
    cell = None if cell is None else checked_cell(arm, cell, inner)
    return SearchRegion(arm, inner, above, np.random.default_rng(seed), cones, cell)


def reached(
    region: SearchRegion,
    starts: Float[np.ndarray, "c n"],
    targets: Float[np.ndarray, "c 3"],
    steps: int = _REACHING,
    sockets: Int[np.ndarray, " c"] | None = None,
    scattered: bool = False,
) -> tuple[Float[np.ndarray, "c n"], Bool[np.ndarray, " c"]]:
    """Configurations moved from their starts to the targets, and which of them arrived and can be taken: above the
    table, within the cone of approach, and clear of obstacles.

    ``sockets`` says which cone belongs to each (by default the first); ``scattered`` brings tools that are outside
    their cone to angles that fill it, not all to its edge.
    """
    if region.cones is None or not region.cones.any:
        q, good = project_to_targets(region.arm, starts, targets, region.limits, steps)
    else:
        cones = region.cones.at(np.zeros(len(starts), dtype=int) if sockets is None else sockets)
        if scattered:  # the area of a cap about the normal grows with the square of its angle
            fractions = np.sqrt(region.random.uniform(size=len(starts)))
            cones = cones._replace(half_angles=cones.half_angles * fractions)
        q, good = into_cones(region.arm, starts, targets, region.limits, cones, steps)
    good &= lowest_point(region.arm, q) >= region.above
    if region.cell is not None:
        rows = np.flatnonzero(good)
        good[rows] = is_clear(region.cell, region.arm, q[rows])
    return q, good


def configurations_at(
    region: SearchRegion, points: Float[np.ndarray, "s 3"], each: int
) -> tuple[Float[np.ndarray, "c n"], Int[np.ndarray, " c"]]:
    """Configurations that reach the points from ``each`` random starts a point, and the index of each one's point.

    With several cones, point i has the cone i; or modulo their number, for several placements of the same sockets.
    """
    owner = np.repeat(np.arange(len(points)), each)
    sockets = owner % (1 if region.cones is None else len(region.cones.normals))
    q, good = reached(region, region.draw(len(owner)), points[owner], sockets=sockets, scattered=True)
    return q[good], owner[good]
