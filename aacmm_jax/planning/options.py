"""What a plan is asked for: the options that all plans share, and checks of counts, sockets, cones and regions."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.arguments import Count, Range, checked_fields
from ..core.arrays import Numbers
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import to_numpy
from ..data.noise import CLASSES, ArmNoise, Noise, small_arm_noise
from ..data.simulation import socket_point
from ..kinematics.arm import Arm, is_single
from ..kinematics.collisions import Cell, HalfSpace
from ..kinematics.corrections import Expansion
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import (
    TOOL_AXIS,
    Cone,
    Cones,
    SearchRegion,
    arm_reach,
    cones_of,
    search_region,
    total_link_length,
)
from ..uncertainty.volume import default_length

LEAST_POSES = 2  # in a socket: one shows no scatter
FARTHEST = 0.95  # part of the reach: beyond it an arm is stretched, and hardly any pose can be taken
TABLE = "table"
_U_RANGE = (1e-6, 100.0)  # mm

Criterion = Literal["length", "A", "D", "E"]
Ranges = Mapping[str, tuple[float, float]]  # of x, y, z and the distance from the origin, mm


class PlanOptions(NamedTuple):
    """How poses are planned, in sockets (`plan`) and with a kit (`plan_kit`) alike.

    Args:
        space: Free parameters (default: those of `Parameters.free_of`).
        noise: Noise of the readings and the seat, which weights poses; by default that of a small measuring arm.
        criterion: "length" (largest uncertainty of a length over the volume); or "A", "D", "E" of the parameters'
            covariance in natural steps (1 mm, 1 mrad).
        region: Ranges of ``x``, ``y``, ``z`` and of the ``distance`` from the origin for the tip in what is placed, mm
            (default: z at least 0).
        farthest: Largest distance of what is placed from the shoulder, as a part of the reach.
        limits: Lowest and highest reading of each joint, rad (default: the arm's own).
        margin: Distance of the joints from their limits, rad.
        above: Height in the base frame below which no joint and no tip comes (the table), mm; ``-math.inf`` for none.
            With a ``cell`` the body's capsules stay above it too.
        tool_axis: Axis of the last frame that points from the tool into a socket.
        cell: The arm's body and the obstacles that it may not touch; by default nothing is checked.
        retract: Distance from the socket to the approach point of each pose along the normal, mm; 0 for none. In a kit,
            what has no cone has no approach points.
        unconstrained: Whether to predict also what poses in the same places would give without cones, cell and approach
            points.
        candidates: Number of candidate configurations (default: 3000, with a kit 2000).
        check_length: Length that predictions are of, mm (as in `volumetric_uncertainty`).
        seed: Seed of the search.
        progress: Called with the name of the stage and the fraction of it that is done.

    Example:
        >>> fine = aj.planning.PlanOptions(noise=aj.Noise(encoder_arcsec=1.0), margin=0.2, seed=1)
        >>> print(fine.criterion, fine.farthest)
        length 0.95
    """

    space: Parameters | None = None
    noise: Noise | None = None
    criterion: Criterion = "length"
    region: Ranges | None = None
    farthest: Annotated[float, Range(above=0, most=1)] = FARTHEST
    limits: Sequence[Sequence[float]] | None = None
    margin: float = math.radians(5)
    above: float = 0.0
    tool_axis: tuple[float, float, float] = TOOL_AXIS
    cell: Cell | None = None
    retract: Annotated[float, Range(least=0, most=1000, unit="mm")] = 0.0
    unconstrained: bool = False
    candidates: Count | None = None
    check_length: float | None = None
    seed: int = 0
    progress: Callable[[str, float], None] | None = None

    @classmethod
    def usual(cls, assumed: ArmNoise) -> "PlanOptions":
        """Those for an arm that was not calibrated: the noise and approach points that are usual for its class.

        Example:
            >>> aj.planning.PlanOptions.usual(aj.files.load_noise("panda")).retract
            50.0
        """
        return cls(noise=assumed.noise, retract=CLASSES[assumed.arm_class].retract)

    def report(self, stage: str, fraction: float) -> None:
        """Say how much of a stage is done."""
        if self.progress is not None:
            self.progress(stage, fraction)


class PlanTask(NamedTuple):
    """What is planned for, with every default filled in."""

    arm: Arm
    space: Parameters
    noise: Noise
    check_length: float  # that predictions are of, mm
    options: PlanOptions

    @classmethod
    def of(cls, arm: Arm, options: PlanOptions) -> "PlanTask":
        """The task, checked.

        Raises:
            InputError: The arm is a batch or reaches no volume, or an option is out of range.
        """
        if not is_single(arm):
            raise InputError("plans are for one arm, not a batch; give one of its arms.")
        options = checked_fields(options)
        space = Parameters.free_of(arm) if options.space is None else options.space
        # Plans are at 20 C, so they say nothing of thermal expansion.
        space = Parameters(space.base, tuple(name for name in space.names if name != Expansion.words[0]))
        if arm.beta is None and space.base.beta is not None:  # free, and 0 so far
            arm = arm.replace(beta=np.zeros(arm.joints))
        length = default_length(arm) if options.check_length is None else options.check_length
        if arm.joints < 3 or total_link_length(arm) == 0:
            raise InputError("this arm reaches no volume: it needs three joints and a link; there is nothing to plan.")
        noise = small_arm_noise() if options.noise is None else options.noise
        noise.check(arm.joints)
        return cls(arm, space, noise, length, options)

    def search_region(self, cones: Cones) -> SearchRegion:
        """The configurations that may be taken in seats with these cones."""
        options, cell = self.options, self.options.cell
        if cell is not None and np.isfinite(options.above) and TABLE not in [one.name for one in cell.obstacles]:
            table = HalfSpace(TABLE, (0.0, 0.0, 1.0), (0.0, 0.0, options.above))
            cell = cell._replace(obstacles=(table, *cell.obstacles))
        return search_region(
            to_numpy(self.arm), options.limits, options.margin, options.above, options.seed, cones, cell
        )


class PlacementRegion(NamedTuple):
    """Where sockets and artefacts may be placed."""

    ranges: Ranges
    shoulder: Float[np.ndarray, " 3"]  # mm
    farthest: float  # from the shoulder, mm

    @classmethod
    def of(cls, arm: Arm, ranges: Ranges | None, farthest: float) -> "PlacementRegion":
        """The region with the given ranges (default: z at least 0), no farther than a part of the reach."""
        ranges = {"z": (0.0, np.inf)} if ranges is None else ranges
        for axis, (low, high) in ranges.items():
            if not low < high:
                raise InputError(
                    f"the region's {axis} is {low:g} to {high:g} mm, which is no range; give the lower number first."
                )
            if axis not in ("x", "y", "z", "distance"):
                raise InputError(f"the region has no '{axis}'; give ranges of x, y, z and distance, in mm.")
        reach = arm_reach(to_numpy(arm))
        return cls(ranges, reach.shoulder, farthest * reach.radius)

    def contains(self, points: Float[np.ndarray, "... 3"]) -> Bool[np.ndarray, "..."]:
        """Which points are within the region."""
        values = {"x": points[..., 0], "y": points[..., 1], "z": points[..., 2]}
        values["distance"] = np.linalg.norm(points, axis=-1)
        inside = np.linalg.norm(points - self.shoulder, axis=-1) <= self.farthest
        for key, (low, high) in self.ranges.items():
            inside &= (values[key] >= low) & (values[key] <= high)
        return inside


class FixturePlacement(NamedTuple):
    """Positions of sockets, and which of them are the ends of reference lengths, of what standard uncertainty; mm."""

    points: Float[np.ndarray, "s 3"]
    ends: tuple[tuple[int, int], ...]
    u: tuple[float, ...]

    def in_order(self, sockets: Int[np.ndarray, " s"]) -> "FixturePlacement":
        """The same sockets in another order."""
        place = np.argsort(sockets).tolist()
        ends = tuple((place[start], place[end]) for start, end in self.ends)
        return FixturePlacement(self.points[sockets], ends, self.u)


def check_counts(sockets: int | Mapping, poses: int, parameters: int, u: float, lengths: Sequence[tuple]) -> None:
    """Raise `InputError` where there are too few poses, or an uncertainty is none."""
    for stated in (u, *(float(pair[2]) for pair in lengths if len(pair) > 2)):
        if not _U_RANGE[0] <= stated <= _U_RANGE[1]:
            raise InputError(
                f"u of a reference length is {stated:g} mm; give a standard uncertainty from {_U_RANGE[0]:g} to "
                f"{_U_RANGE[1]:g} mm."
            )
    number = len(sockets) if isinstance(sockets, Mapping) else sockets
    if number < 1 or poses < LEAST_POSES * number:
        raise InputError(
            f"{poses} poses are too few for {number} sockets; give one socket or more, and {LEAST_POSES} poses in each."
        )
    unknowns = parameters + 3 * number - (len(lengths) if isinstance(sockets, Mapping) else number // 2)
    if 3 * poses < unknowns:
        raise InputError(
            f"{poses} poses in {number} sockets give fewer equations than the {unknowns} unknowns; take "
            f"{-(-unknowns // 3)} at least."
        )


def given_placement(
    sockets: Mapping[str, Numbers], u: float, lengths: Sequence[tuple]
) -> tuple[list[str], FixturePlacement]:
    """Names and placement of sockets whose positions are given."""
    points = {name: np.asarray(socket_point(name, point)) for name, point in sockets.items()}
    names = list(points)
    for pair in lengths:
        for end in pair[:2]:
            if end not in names:
                raise InputError(
                    f"reference length {pair[0]}, {pair[1]} names the unknown socket '{end}'{nearest(end, names)}"
                )
    if len({frozenset(pair[:2]) for pair in lengths}) < len(lengths):
        raise InputError("a reference length is named twice; its certified value counts once, so name it once.")
    if any(len(set(pair[:2])) < 2 for pair in lengths):
        raise InputError("a reference length joins a socket to itself; name two different sockets.")
    for i, name in enumerate(names):
        for other in names[:i]:
            if np.linalg.norm(points[name] - points[other]) < 1:
                raise InputError(f"sockets '{other}' and '{name}' are in the same position; move one, or leave it out.")
    ends = tuple((names.index(pair[0]), names.index(pair[1])) for pair in lengths)
    each_u = tuple(float(pair[2]) if len(pair) > 2 else u for pair in lengths)
    return names, FixturePlacement(np.array(list(points.values())), ends, each_u)


def check_length(arm: Arm, length: tuple[float, float], lengths: Sequence[tuple]) -> None:
    """Raise `InputError` where the reference length cannot be placed."""
    if lengths:
        raise InputError("lengths are between sockets that are given; with a number of sockets, give length and u.")
    low, high = length
    if not 0 < low <= high < 2 * total_link_length(arm):
        raise InputError(
            f"a reference length of {low:g} to {high:g} mm does not fit this arm; give one shorter than its reach."
        )


def checked_cones(
    cone: Cone | Mapping[str, Cone] | None, names: Sequence[str], tool_axis: tuple[float, float, float]
) -> Cones:
    """The cone of each socket; a socket without one has the normal (0, 0, 1) and every direction."""
    if isinstance(cone, Mapping):
        for name in cone:
            if name not in names:
                raise InputError(f"a cone is given for the unknown socket '{name}'{nearest(str(name), names)}")
    by_name = cone if isinstance(cone, Mapping) else dict.fromkeys(names, cone or Cone())
    return cones_of([by_name.get(name, Cone()) for name in names], tool_axis)
