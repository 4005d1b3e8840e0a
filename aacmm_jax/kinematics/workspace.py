"""The workspace of an arm: its reach, lowest point, links as lines in space, and configurations at given points.

A tool may come to a socket from the directions of a cone alone.
"""

import math
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.arguments import Range, checked
from ..core.errors import InputError
from ..core.numpy_or_jax import in_chunks, to_numpy
from .arm import Arm, JointLimits, Limits, joint_limits
from .chain import ForwardPass, forward_pass, joint_motion, reading_units
from .collisions import Cell, checked_cell, is_clear
from .inverse_kinematics import ARRIVED, EXACT, LARGEST_STEP, ROWS, damped_inverse, project_to_targets, repeated
from .jacobian import reading_columns, reading_rotations
from .robots import chains_of

TOOL_AXIS = (0.0, 0.0, 1.0)
_STARTS, _SWEEPS = 256, 30
_REACHING = 25  # steps: seven of ten random starts arrive, and with 60 eight would
_LARGEST_TURN = 0.5  # rad, of the tool in a step
_INSIDE = 1e-4  # rad: what is brought into a cone ends this far inside it
_LEVER = 100.0  # mm: a rotation of the tool counts as what it moves at this distance

Configurations = Float[np.ndarray, "c n"]
Targets = Float[np.ndarray, "c 3"]
Chosen = Bool[np.ndarray, " c"]
Places = Int[np.ndarray, " c"]


class Reach(NamedTuple):
    """The smallest ball about the shoulder that contains all positions of the tip, mm."""

    shoulder: Float[np.ndarray, " 3"]  # on the first axis, d_1 above the base; amid the travel of a prismatic joint
    radius: float


def arm_reach(arm: Arm) -> Reach:
    """Largest distance of the tip from the shoulder within the joint limits; of a robot, a ball that contains those of
    its chains.

    Args:
        arm: One arm.

    Returns:
        The shoulder in the base frame ``(3,)``, and the distance, mm.

    Example:
        >>> reach = aj.kinematics.arm_reach(arm)
        >>> print(f"{reach.radius:.0f} mm")
        1359 mm
    """
    if not arm.chains:
        return _extreme_distance(arm, farthest=True)
    own = [(chain.base, _extreme_distance(chain.arm, farthest=True)) for chain in chains_of(arm).values()]
    shoulders = np.array([base[:3, :3] @ reach.shoulder + base[:3, 3] for base, reach in own])
    middle = shoulders.mean(axis=0)
    beyond = np.linalg.norm(shoulders - middle, axis=1) + [reach.radius for _, reach in own]
    return Reach(middle, float(beyond.max()))


def closest_approach(arm: Arm) -> float:
    """Smallest distance of the tip from the shoulder within the joint limits, mm; the arm's own body may be in the way.

    Found from many random starts, so that a smaller one is unlikely, but not excluded.

    Args:
        arm: One arm.

    Example:
        >>> print(f"{aj.kinematics.closest_approach(arm):.0f} mm")
        146 mm
    """
    return _extreme_distance(arm, farthest=False).radius


def _extreme_distance(arm: Arm, *, farthest: bool) -> Reach:
    """The shoulder, and the largest or smallest distance of the tip from it.

    As a function of one joint the squared distance is a constant plus a sinusoid: with the lever r from a point of the
    joint's axis z to the tip, and s from the shoulder to that point, of 2 s . (r - (z . r) z) cos t + 2 s . (z x r) sin
    t. Of a prismatic joint it is convex: an end of its travel is the maximum, the foot of the perpendicular the
    minimum. From many random starts, joint after joint is set to its extreme until nothing changes, the last joint
    first: a joint moves the tip, but no axis of the joints before it.
    """
    sign, limits, geometry = 1.0 if farthest else -1.0, joint_limits(arm, None), to_numpy(arm.geometry)
    slides = [joint + 1 in arm.prismatic for joint in range(arm.joints)]
    shoulder = np.array([0.0, 0.0, float(np.asarray(arm.d)[0] + (np.mean(limits[0]) if slides[0] else 0.0))])
    q = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (_STARTS, arm.joints))
    best, now = -np.inf, 0.0
    for _ in range(_SWEEPS):
        forward = forward_pass(geometry, joint_motion(geometry, q))
        tip = forward.tip.T
        # The first joint, if it is revolute, rotates the whole arm about the shoulder's axis.
        for joint in range(arm.joints - 1, -1 if slides[0] else 0, -1):
            axis, (low, high) = forward.z_before[joint].T, limits[joint]
            if slides[joint]:
                foot = q[:, joint] - np.sum((tip - shoulder) * axis, axis=1)
                reading = np.where(foot > (low + high) / 2, low, high) if farthest else np.clip(foot, low, high)
                tip = tip + (reading - q[:, joint])[:, None] * axis
                q[:, joint] = reading
                continue
            # tip(t) = origin + (tip - origin) cos t + ..., so that s . tip varies as cosine cos t + sine sin t.
            origin = forward.origin_before[joint].T
            offset, across = origin - shoulder, np.cross(axis, tip - origin)
            along = np.cross(across, axis)
            cosine, sine = sign * np.sum(offset * along, axis=1), sign * np.sum(offset * across, axis=1)
            highest = q[:, joint] + np.arctan2(sine, cosine)
            # The angle of the maximum, by whole revolutions within the limits if one is; else the better limit.
            whole = highest + 2 * np.pi * np.ceil((low - highest) / (2 * np.pi))
            at_low, at_high = (cosine * np.cos(t) + sine * np.sin(t) for t in (low - q[:, joint], high - q[:, joint]))
            reading = np.where(whole <= high, whole, np.where(at_low > at_high, low, high))
            change = (reading - q[:, joint])[:, None]
            tip = tip + (np.cos(change) - 1) * along + np.sin(change) * across
            q[:, joint] = reading
        now = sign * float((sign * np.linalg.norm(tip - shoulder, axis=1)).max())
        if sign * now - best <= 1e-12 * abs(now):
            break
        best = sign * now
    return Reach(shoulder, now)


def skeleton(arm: Arm, q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m c 3"]:
    """Corners of the arm, mm: the base, the end of each joint's offset and of its link, and the tip (c = 2 n + 2); of a
    robot, those of the chain of each pose, where joints of other chains add nothing."""
    chains = [chain for chain in chains_of(arm).values() if chain.mount]

    def lines(rows: np.ndarray) -> np.ndarray:
        geometry, motion = to_numpy((arm.geometry, joint_motion(arm.geometry, rows)))
        forward = forward_pass(geometry, motion)
        along = geometry.d[:, None, None] + (0.0 if motion.slide is None else motion.slide)
        along = along if motion.members is None else along * motion.members[: arm.joints]
        offset = forward.origin_before + along * forward.z_before
        both = np.stack([offset, np.broadcast_to(forward.origin, offset.shape)], axis=1).reshape(2 * arm.joints, 3, -1)
        corners = np.concatenate([np.zeros_like(both[:1]), both, forward.tip[None]]).transpose(2, 0, 1)
        for chain in chains:  # they begin at their own base
            of_chain = rows[:, arm.joints] == chain.number
            first = 2 * max(chain.mount)
            corners[of_chain, :first] = corners[of_chain, first : first + 1]
        return corners

    return in_chunks(lines, np.asarray(q))


def lowest_point(arm: Arm, q: Configurations) -> Float[np.ndarray, " c"]:
    """Height of the lowest joint or tip in the base frame, mm, without the base itself, for each configuration; of a
    robot, of the chain of each."""
    mounts = [joint - 1 for chain in chains_of(arm).values() for joint in chain.mount]

    def lowest(rows: np.ndarray) -> np.ndarray:
        forward = forward_pass(*to_numpy((arm.geometry, joint_motion(arm.geometry, rows))))
        heights = np.array(forward.origin[:, 2])
        if forward.members is not None:
            heights[forward.members[: arm.joints, 0] == 0] = np.inf
            heights[mounts] = np.inf
        return np.minimum(np.min(heights, axis=0), forward.tip[2])

    return in_chunks(lowest, q)


def total_link_length(arm: Arm) -> float:
    """Sum of the lengths of the links and the probe, without the base's height d_1, mm; a prismatic joint adds its
    longest slide by its limits, or 1 m where it has none."""
    slides = [1000.0 if arm.limits is None else max(map(abs, arm.limits[i - 1])) for i in arm.prismatic]
    links = np.abs(arm.a).sum() + np.abs(np.asarray(arm.d)[1:]).sum() + np.linalg.norm(np.asarray(arm.probe))
    return float(links + sum(slides))


class Cone(NamedTuple):
    """Directions from which a tool may come to a socket: within ``half_angle`` (rad) of its ``normal``.

    The normal points out of the socket, in the base frame.

    Example:
        >>> upwards = aj.kinematics.Cone(half_angle=np.radians(45), normal=(0, 0, 1))
        >>> print(f"{upwards.half_angle:.3f} rad")
        0.785 rad
    """

    half_angle: float = math.pi
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)


class Cones(NamedTuple):
    """The cones of several sockets, and the axis of the last frame that points from the tool into a socket."""

    normals: Float[np.ndarray, "s 3"]
    half_angles: Float[np.ndarray, " s"]
    tool_axis: Float[np.ndarray, " 3"]

    @property
    def any(self) -> bool:
        """Whether some cone leaves out directions."""
        return bool(np.any(self.half_angles < math.pi))

    def at(self, sockets: Places) -> "Cones":
        """The cone of each of these sockets."""
        return self._replace(normals=self.normals[sockets], half_angles=self.half_angles[sockets])


def cones_of(cones: list[Cone], tool_axis: tuple[float, float, float] = TOOL_AXIS) -> Cones:
    """The cones with unit vectors; `InputError` where a direction has the length 0, or a half angle is not above 0."""
    directions = {f"normal of cone {i + 1}": cone.normal for i, cone in enumerate(cones)} | {"tool_axis": tool_axis}
    vectors = np.array([checked(value, Float[np.ndarray, "3"], what) for what, value in directions.items()])
    sizes = np.linalg.norm(vectors, axis=1, keepdims=True)
    if np.any(sizes == 0):
        raise InputError("a normal or the tool's axis has the length 0; give three numbers that are not all 0.")
    half_angles = np.array([cone.half_angle for cone in cones], dtype=float)
    degrees = Annotated[Float[np.ndarray, " cones"], Range(above=0, most=180, unit="deg")]
    checked(np.degrees(half_angles), degrees, "half_angle")
    unit = vectors / sizes
    return Cones(unit[:-1], half_angles, unit[-1])


def tilts(arm: Arm, q: Configurations, cones: Cones) -> Float[np.ndarray, " c"]:
    """Angle between a tool and the normal of its socket, rad, 0 where it comes straight from above the socket; with a
    cone for each configuration."""
    rotations = np.asarray(to_numpy(arm).pose(q))[..., :3, :3]
    return _angle(rotations @ cones.tool_axis, cones.normals)


def _angle(tool: Targets, normal: Targets) -> Float[np.ndarray, " c"]:
    """Angle between the reversed tool and a normal; by its tangent, so that small ones are exact."""
    return np.arctan2(np.linalg.norm(np.cross(tool, normal), axis=-1), -np.sum(tool * normal, axis=-1))


def into_cones(
    arm: Arm, q: Configurations, targets: Targets, limits: JointLimits, cones: Cones, steps: int
) -> tuple[Configurations, Chosen]:
    """Configurations moved by least-norm steps until the tip is at its target (mm) and the tool in its cone.

    Each step closes the gap of the tip, as `solve_to_targets` does, and where the tool is outside its cone turns it
    there, with what moves the tip least first taken out: the least-norm solution of four equations by elimination.
    """
    geometry = to_numpy(arm.geometry)
    low, high = limits[:, :1], limits[:, 1:]
    units, columns = reading_units(geometry)[:, None], q.shape[1]  # steps are in what counts alike: 1 rad, or 1 m

    def tool_of(forward: ForwardPass) -> np.ndarray:
        x, y, z = forward.frame
        return cones.tool_axis[0] * x + cones.tool_axis[1] * y + cones.tool_axis[2] * z

    # The first three equations move the tip: J dq = gap, solved by dq0 = J+ gap. The fourth turns the tool by r . dq =
    # turn. Along f = r - J+ J r, the part of r that moves no tip, dq = dq0 + f (turn - r . dq0) / (f . r) solves all.
    def step(q: Any, targets: Any, normals: Any, wanted: Any) -> tuple[Any, Any]:
        forward = forward_pass(geometry, joint_motion(geometry, q.T))
        gap, tool = targets - forward.tip, tool_of(forward)
        columns = units[..., None] * np.asarray(reading_columns(forward))
        inverse = damped_inverse(columns, 1e-2 * np.sum(gap**2, axis=0) + 1e-12)
        change = np.sum(inverse * gap[None], axis=1)
        angle = _angle(tool.T, normals.T)
        outside = angle > wanted
        if outside.any():
            # d angle / dq = z . (tool x normal) / sin(angle): the cosine is -tool . normal.
            across = np.cross(tool, normals, axis=0) / np.maximum(np.sin(angle), 0.05)
            row = _LEVER * np.einsum("jcn,cn->jn", units[..., None] * reading_rotations(forward), across) * outside
            turn = _LEVER * np.clip(wanted - angle, -_LARGEST_TURN, 0.0) * outside
            free = row - np.sum(inverse * np.einsum("jn,jcn->cn", row, columns)[None], axis=1)
            size = np.sum(free * row, axis=0)
            change = change + free * ((turn - np.sum(row * change, axis=0)) / (size + 1e-2 * turn**2 + 1e-6))
        joints = np.clip(q[: arm.joints] + units * np.clip(change, -LARGEST_STEP, LARGEST_STEP), low, high)
        new = np.concatenate([joints, q[arm.joints :]])
        return new, np.any(np.abs(gap) > EXACT, axis=0) | outside

    def moved(rows: np.ndarray) -> np.ndarray:
        start, targets, normals, half_angles = np.split(rows.T, [columns, columns + 3, columns + 6])
        q = repeated(step, start, [targets, normals, np.maximum(half_angles - _INSIDE, 0.0)[0]], steps)
        forward = forward_pass(geometry, joint_motion(geometry, q.T))
        arrived = np.linalg.norm(targets - forward.tip, axis=0) <= ARRIVED
        arrived &= _angle(tool_of(forward).T, normals.T) <= half_angles[0]
        return np.column_stack([q.T, arrived])

    with np.errstate(all="ignore"):
        solved = in_chunks(moved, np.hstack([q, targets, cones.normals, cones.half_angles[:, None]]), ROWS)
    return solved[:, :-1], solved[:, -1] > 0


class SearchRegion(NamedTuple):
    """Where configurations are looked for, and the random numbers that the search uses."""

    arm: Arm
    limits: JointLimits  # lowest and highest reading of each joint, rad, or mm of prismatic ones
    above: float  # height in the base frame below which no joint and no tip comes, mm
    random: np.random.Generator
    cones: Cones | None = None  # of approach to each socket; None where the tool may have any direction
    cell: Cell | None = None  # what the arm may not touch
    chains: tuple[int, ...] = ()  # of a robot: the numbers of those that take poses, in turn
    rest: Float[np.ndarray, " n"] | None = None  # readings of a robot's joints while another chain takes a pose

    def draw(self, count: int) -> Configurations:
        """Random configurations within the limits; of a robot, of one chain each, the joints of others at rest."""
        q = self.random.uniform(self.limits[:, 0], self.limits[:, 1], (count, self.arm.joints))
        if self.rest is None or not self.arm.chains:
            return q
        q = np.column_stack([q, np.resize(np.array(self.chains), count)])
        q[:, : self.arm.joints] = np.where(self.units(q)[:, :-1] > 0, q[:, : self.arm.joints], self.rest)
        return q

    def units(self, q: Configurations) -> Configurations:
        """What a step of each column of these configurations counts: 1 rad or 1 m; 0 of joints of other chains."""
        units, kinds = reading_units(self.arm.geometry), self.arm.geometry.kinds
        if kinds is None or not kinds.chains:
            return np.tile(units, (len(q), 1))
        chain = q[:, self.arm.joints].astype(int)
        return np.column_stack([units * kinds.members(chain)[:, : self.arm.joints], np.zeros(len(q))])


def search_region(
    arm: Arm,
    limits: Limits | None,
    margin: float,
    above: float,
    seed: int,
    cones: Cones | None = None,
    cell: Cell | None = None,
) -> SearchRegion:
    """The region ``margin`` (rad, or m of prismatic joints) inside the joint limits (default: the arm's own), ``above``
    (mm) the table, within the cones of approach and clear of the cell's obstacles."""
    checked(seed, Annotated[int, Range(least=0)], "seed")
    allowed, kinds = joint_limits(arm, limits), arm.geometry.kinds
    moving = np.ones(arm.joints) if kinds is None else kinds.read
    margins = margin * reading_units(arm.geometry) * moving
    room = (allowed[:, 1] - allowed[:, 0])[moving > 0] / 2
    if not (math.isfinite(margin) and margin >= 0 and np.all(margins[moving > 0] < room)):
        raise InputError(
            f"a margin of {math.degrees(margin):g} deg leaves no range of motion between the limits of a joint; give a "
            "smaller margin."
        )
    inner = allowed + margins[:, None] * np.array([1.0, -1.0])
    cell = None if cell is None else checked_cell(arm, cell, inner)
    middle = inner.mean(axis=1)
    rest = np.where((inner[:, 0] <= 0) & (inner[:, 1] >= 0), 0.0, middle)
    return SearchRegion(
        arm, inner, above, np.random.default_rng(seed), cones, cell, tuple(range(len(arm.chains))), rest
    )


def reached(
    region: SearchRegion,
    starts: Configurations,
    targets: Targets,
    steps: int = _REACHING,
    sockets: Places | None = None,
    scattered: bool = False,
) -> tuple[Configurations, Chosen]:
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
    region: SearchRegion, points: Float[np.ndarray, "s 3"], starts_per_point: int
) -> tuple[Configurations, Places]:
    """Configurations that reach the points from random starts, and the index of the point that each of them reaches.

    Of several cones, point i has the cone i, modulo their number (for several placements of the same sockets).
    """
    owner = np.repeat(np.arange(len(points)), starts_per_point)
    sockets = owner % (1 if region.cones is None else len(region.cones.normals))
    q, good = reached(region, region.draw(len(owner)), points[owner], sockets=sockets, scattered=True)
    return q[good], owner[good]
