"""What is planned for: the options of all plans, the region, the objective, and what a calibration would know after."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.arguments import Count, Range, checked, checked_fields
from ..core.arrays import Numbers
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import to_numpy
from ..data.noise import CLASSES, ArmNoise, Noise, small_arm_noise
from ..kinematics.arm import Arm, correction_names, is_single, jacobian_at, joint_limits
from ..kinematics.collisions import Cell, HalfSpace
from ..kinematics.corrected_arm import loads_of
from ..kinematics.corrections import coefficient_of
from ..kinematics.parameters import Parameters
from ..kinematics.robots import chains_of, mount_names
from ..kinematics.workspace import (
    TOOL_AXIS,
    Cone,
    Reach,
    SearchRegion,
    arm_reach,
    cones_of,
    search_region,
    total_link_length,
)
from ..uncertainty.volume import default_length, sample_lengths
from .designs import Candidates, Kind, Objective, covariance_of, exchange
from .usual import FARTHEST, HEIGHTS

PRIOR = 1e-4  # parameters are known to 100 mm or 100 mrad in advance: makes the first information matrices invertible
MORE = 10  # poses added in the prediction `Plan.more`
LOOSE = math.radians(5)  # standard deviation of joints of an imprecise operator
TABLE = "table"
_NEAR = math.radians(12)  # of candidates near a chosen pose
_ROUNDS, _NEIGHBOURS = 2, 12  # of the search about the chosen poses, and its candidates for each
_OBJECTIVE_LENGTHS, _PREDICTION_LENGTHS = 300, 400  # predictions use other lengths than the objective

Criterion = Literal["length", "A", "D", "E"]
OBJECTIVES: dict[Criterion, tuple[Kind, float]] = {
    "length": ("functions", 8.0),
    "A": ("trace", 0.0),
    "D": ("determinant", 8.0),
    "E": ("trace", 8.0),
}
Poses = TypeVar("Poses")
Ranges = Mapping[str, tuple[float, float]]  # of x, y, z and the distance from the origin, mm


class PlanOptions(NamedTuple):
    """How poses are planned, in sockets (`plan`) and with a kit (`plan_kit`) alike.

    Args:
        space: Free parameters (default: those of `Parameters.free_of`).
        noise: Noise of the readings and the seat, which weights poses; by default that of a small measuring arm.
        criterion: "length" (largest uncertainty of a length over the volume); or "A", "D", "E" of the parameters'
            covariance in natural steps (1 mm, 1 mrad).
        region: Ranges of ``x``, ``y``, ``z`` and of the ``distance`` from the origin for the tip in what is placed, mm
            (default: z from 20 to 1000 mm above the table, everything without a table).
        farthest: Largest distance of what is placed from the shoulder, as a part of the reach.
        limits: Lowest and highest reading of each joint, rad (default: the arm's own).
        margin: Distance of the joints from their limits, rad.
        above: Height in the base frame below which no joint and no tip comes (the table), mm; ``-math.inf`` for none.
            With a ``cell`` the body's capsules stay above it too.
        chains: Of a robot: the chains that take poses, by default all. Parameters of other chains are fixed, and so is
            the base where a single chain is left.
        rest: Of a robot: readings of all its joints, rad or mm, of which those of other chains hold while a chain takes
            a pose. By default 0, or the middle of limits that leave it out.
        tool_axis: Axis of the last frame that points from the tool into a socket.
        cell: The arm's body and the obstacles that it may not touch; by default nothing is checked.
        retract: Distance from the socket to the approach point of each pose along the normal, mm; 0 for none. In a kit,
            what has no cone has no approach points.
        unconstrained: Whether to predict also what as many poses would give without cones, cell and approach points;
            of sockets that are placed, also without limits of z.
        candidates: Number of candidate configurations (default: 3000, with a kit 2000).
        check_length: Length that predictions are of, mm (as in `volumetric_uncertainty`).
        hold_undetermined: Whether parameters that no poses with a kit determine are held at their values in the arm,
            one of each combination; otherwise they are an error. Without the scale, it is always an error.
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
    chains: Sequence[str] = ()
    rest: Numbers | None = None
    tool_axis: tuple[float, float, float] = TOOL_AXIS
    cell: Cell | None = None
    retract: Annotated[float, Range(least=0, most=1000, unit="mm")] = 0.0
    unconstrained: bool = False
    candidates: Count | None = None
    check_length: float | None = None
    hold_undetermined: bool = False
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

    @property
    def ranges(self) -> Ranges:
        """Those of the region."""
        low, high = (self.above + height for height in HEIGHTS)
        return {"z": (low, high if math.isfinite(low) else math.inf), **(self.region or {})}

    def report(self, stage: str, fraction: float) -> None:
        """Say how much of a stage is done."""
        if self.progress is not None:
            self.progress(stage, fraction)


class DesignProblem(NamedTuple):
    """What all designs for one arm have in common, in NumPy."""

    region: SearchRegion
    space: Parameters
    noise: Noise
    objective: Objective
    options: PlanOptions = PlanOptions()
    check_length: float = 0.0  # that predictions are of, mm
    lengths: Float[np.ndarray, "v p"] = np.zeros((0, 0))  # their derivatives
    reach: Reach = Reach(np.zeros(3), np.inf)  # farther from the shoulder nothing is placed

    @classmethod
    def of(cls, arm: Arm, options: PlanOptions) -> "DesignProblem":
        """The problem with every default filled in, and a region in which the tool may have any direction.

        Raises:
            InputError: The arm is a batch or reaches no volume, or an option is out of range.
        """
        if not is_single(arm):
            raise InputError("a plan needs a single arm, but this is a batch; select one arm of the batch.")
        options = checked_fields(options)
        space = Parameters.free_of(arm) if options.space is None else options.space
        taken, space = _chains(arm, options, space)
        # What is recorded beside readings is not known of planned poses, but for the torques of known masses.
        known = "torques" if arm.corrections is not None and loads_of(arm) else ""
        columns = {name: term.kind.column_of(term) for name in space.names if (term := coefficient_of(name))}
        planned = tuple(name for name in space.names if columns.get(name, "") in ("", known))
        space = to_numpy(Parameters(space.base, planned))
        if arm.beta is None and space.base.beta is not None:  # free, and 0 so far
            arm = arm.replace(beta=np.zeros(arm.joints))
        length = default_length(arm) if options.check_length is None else options.check_length
        if arm.joints < 3 or total_link_length(arm) == 0:
            raise InputError(
                "the tip of this arm does not reach a volume, so there is nothing to plan; give an arm with at least "
                "three joints and one link."
            )
        noise = small_arm_noise() if options.noise is None else options.noise
        noise.check(arm.joints)
        for axis, (low, high) in options.ranges.items():
            if not low < high:
                raise InputError(
                    f"the region's {axis} is {low:g} to {high:g} mm, which is not a range; give the lower number first."
                )
            if axis not in ("x", "y", "z", "distance"):
                raise InputError(
                    f"the region has the unknown key '{axis}'; give ranges of x, y, z and distance, in mm."
                )
        cell, seed, arm = options.cell, options.seed, to_numpy(arm)
        if cell is not None and np.isfinite(options.above) and TABLE not in [item.name for item in cell.obstacles]:
            table = HalfSpace(TABLE, (0.0, 0.0, 1.0), (0.0, 0.0, options.above))
            cell = cell._replace(obstacles=(table, *cell.obstacles))
        cones = cones_of([Cone()], options.tool_axis)
        region = search_region(arm, options.limits, options.margin, options.above, seed, cones, cell)
        region = region._replace(chains=taken, rest=_rest(arm, options.rest, region.rest))
        limits = joint_limits(arm, options.limits)
        of_objective, of_predictions = (
            length_derivatives(
                arm, space, *sample_lengths(arm, count, length=length, limits=limits, seed=seed + offset)
            )
            for offset, count in ((1, _OBJECTIVE_LENGTHS), (2, _PREDICTION_LENGTHS))
        )
        kind, power = OBJECTIVES[options.criterion]
        objective = Objective(kind, of_objective, power)
        reach = arm_reach(arm)
        reach = reach._replace(radius=options.farthest * reach.radius)
        return cls(region, space, to_numpy(noise), objective, options, length, of_predictions, reach)

    @property
    def arm(self) -> Arm:
        """The arm."""
        return self.region.arm

    def within(self, **changes: Any) -> "DesignProblem":
        """The same with another region: ``cones``, ``cell``."""
        return self._replace(region=self.region._replace(**changes))

    def without_limits(self) -> "DesignProblem":
        """The same for a tool that may have any direction, in an empty cell, at any height above the table."""
        region = {**(self.options.region or {}), "z": (self.options.above, np.inf)}
        return self.within(cones=None, cell=None)._replace(options=self.options._replace(region=region))

    def contains(self, points: Float[np.ndarray, "... 3"]) -> Bool[np.ndarray, "..."]:
        """At which points something may be placed."""
        values = {"x": points[..., 0], "y": points[..., 1], "z": points[..., 2]}
        values["distance"] = np.linalg.norm(points, axis=-1)
        inside = np.linalg.norm(points - self.reach.shoulder, axis=-1) <= self.reach.radius
        for key, (low, high) in self.options.ranges.items():
            inside &= (values[key] >= low) & (values[key] <= high)
        return inside

    def near(self, q: Float[np.ndarray, "N n"]) -> tuple[Float[np.ndarray, "m n"], Int[np.ndarray, " m"]]:
        """Configurations near some, with the tips off their places; and which of these each is near."""
        which = np.repeat(np.arange(len(q)), _NEIGHBOURS)
        return self.moved(q[which], _NEAR), which

    def moved(self, q: Float[np.ndarray, "N n"], size: float) -> Float[np.ndarray, "N n"]:
        """Configurations with each joint moved by a random step of this standard deviation, rad, or m; of a robot,
        joints of the pose's chain."""
        return q + size * self.region.units(q) * self.region.random.normal(size=q.shape)

    def groups(self, q: Float[np.ndarray, "N n"], owner: Int[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
        """Poses that follow each other in a plan: those in one place, of a robot also with the same chain."""
        return owner * len(self.arm.chains) + q[:, self.arm.joints].astype(int) if self.arm.chains else owner


def _chains(arm: Arm, options: PlanOptions, space: Parameters) -> tuple[tuple[int, ...], Parameters]:
    """Numbers of the chains that take poses, and the parameters that these move."""
    names = [name for name, _ in arm.chains]
    for name in options.chains:
        if name not in names:
            what = f"the robot has no chain '{name}'{nearest(name, names)}" if names else "the arm has no chains."
            raise InputError(what)
    if not options.chains or set(options.chains) == set(names):
        return tuple(range(len(names))), space
    chosen = [chain for name, chain in chains_of(arm).items() if name in options.chains]
    own = {name for chain in chosen for name in chain.names.values()}
    own |= {name for chain in chosen[1:] for name in mount_names(chain)} - set(mount_names(chosen[0]))
    corrections = set(correction_names(arm))
    kept = tuple(name for name in space.names if name in own | corrections)
    return tuple(chain.number for chain in chosen), Parameters(space.base, kept)


def _rest(arm: Arm, given: Numbers | None, usual: Float[np.ndarray, " n"] | None) -> Float[np.ndarray, " n"] | None:
    """Readings of joints at rest."""
    if given is None:
        return usual
    if not arm.chains:
        raise InputError("rest is given, but the arm has no chains; leave it out.")
    return checked(given, Float[np.ndarray, " joints"], "rest", {"joints": arm.joints})


def length_derivatives(
    arm: Arm, space: Parameters, start: Float[np.ndarray, "v n"], end: Float[np.ndarray, "v n"]
) -> Float[np.ndarray, "v p"]:
    """Derivatives of the lengths between configurations by the free parameters, in natural steps."""
    between = np.asarray(arm.position(end)) - np.asarray(arm.position(start))
    direction = between / np.linalg.norm(between, axis=1, keepdims=True)
    jacobian = jacobian_at(arm, end, space.names) - jacobian_at(arm, start, space.names)
    return np.einsum("vc,vcp->vp", direction, jacobian) * np.asarray(space.scale)


class Prediction(NamedTuple):
    """Median and largest standard uncertainty that the calibration would add to lengths over the volume, mm."""

    median: float
    largest: float


def prediction_of(
    problem: DesignProblem, candidates: Candidates, rows: Float[np.ndarray, "m r P"] | None = None
) -> Prediction:
    """The prediction for the poses with these rows; by default for all candidates."""
    information = candidates.information(candidates.rows if rows is None else rows)
    covariance, lengths = covariance_of(information, candidates.parameters), problem.lengths
    u = np.sqrt(np.einsum("vp,pq,vq->v", lengths, covariance, lengths))
    return Prediction(float(np.median(u)), float(u.max()))


def predictions(
    problem: DesignProblem, planned: Candidates, pool: Candidates, loose: Iterable[Candidates], random_sets: int
) -> dict[str, Prediction]:
    """Predictions for the planned poses, for sets of as many random poses of the pool in each place, for the planned
    poses taken imprecisely (``loose``), and for ten more poses."""
    random, counts = problem.region.random, np.bincount(planned.owner, minlength=pool.owner.max() + 1)

    def typical(sets: list[Prediction]) -> Prediction:
        return Prediction(*(float(np.median(column)) for column in zip(*sets, strict=True)))

    drawn = []
    for _ in range(random_sets):
        rows = [random.choice(np.flatnonzero(pool.owner == i), count) for i, count in enumerate(counts)]
        drawn.append(prediction_of(problem, pool, pool.rows[np.concatenate(rows)]))
    imprecise = [prediction_of(problem, poses) for poses in loose]
    base = planned.information(planned.rows)
    added = exchange(pool._replace(base=base), MORE, problem.objective, least=0, sweeps=1)
    return {
        "predicted": prediction_of(problem, planned),
        "random": typical(drawn),
        "loose": typical(imprecise),
        "more": prediction_of(problem, planned, np.concatenate([planned.rows, pool.rows[added]])),
    }


def best_poses(
    problem: DesignProblem,
    pool: Poses,
    poses: int,
    least: int | Int[np.ndarray, " s"],
    candidates_in: Callable[[Poses], Candidates],
    taken: Callable[[Poses, np.ndarray], Poses],
    near: Callable[[Poses], Poses],
) -> Poses:
    """The best poses of a pool by exchange, then the best of these and of poses near them."""
    best, best_value = pool, np.inf
    for number in range(1 + _ROUNDS):

        def report(done: float, number: int = number) -> None:
            problem.options.report("Choosing poses", (number + done) / (1 + _ROUNDS))

        candidates = candidates_in(pool)
        rows = exchange(candidates, poses, problem.objective, least=least, progress=report)
        covariance = covariance_of(candidates.information(candidates.rows[rows]), candidates.parameters)
        value = problem.objective.value(covariance)
        if value < best_value:
            best, best_value = taken(pool, rows), value
        if number < _ROUNDS:
            pool = near(best)
    return best
