"""Plans with artefacts and instruments: where to put what is at hand, and which poses to take with it.

The information of a pose is that of the model's own rows (`uncertainty.linearisation`), so every kind of observation
that can be simulated can be planned, and nothing here depends on a kind.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..calibration.evaluation import fit_geometry
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..data.arm_classes import small_arm_noise
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.observations.observation import AbstractObservation
from ..data.observations.simulated import AbstractSimulated
from ..kinematics.arm import Arm, is_single, joint_limits
from ..kinematics.collisions import Cell
from ..kinematics.cones import TOOL_AXIS, Cone, cones_of
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import reached, search_region
from ..model.observed import Observed
from ..uncertainty.identifiability import observability
from ..uncertainty.linearisation import Linearisation
from ..uncertainty.volume import default_length
from .design import Criterion, Progress, check_plannable, design_problem
from .fedorov_exchange import Candidates, covariance_of, exchange
from .kit_placement import KitItem, PlacedKit, approachable, place, region_of, set_up
from .motion import Motion, ordered_motion
from .placement import FARTHEST, PRIOR, DesignProblem, Ranges, check_region, placement_region
from .plan_arguments import check_retract, planned_parameters, with_table
from .predictions import MORE, Prediction, prediction_of

_LEAST_U = 1e-4  # mm: an exact certified value would be a row of infinite weight
_START_AGREES = 0.1  # mm or rad: a start of the geometry that is farther off is fitted
_RANDOM_SETS, _LOOSE_SETS = 30, 5
_LOOSE, _NEAR = math.radians(5), math.radians(12)
_ROUNDS, _NEIGHBOURS = 2, 12  # of the search about the chosen poses, and its candidates for each


class KitPlan(NamedTuple):
    """Poses to take with a kit of artefacts and instruments. Arrays are of NumPy: q in rad, positions in mm.

    Example:
        >>> box = [[200, -300, 100], [600, 300, 500]]
        >>> tracker = aj.data.observations.SimulatedPoints("tracker", box, 30, u=0.02)
        >>> planned = aj.planning.plan_kit(arm, [tracker], poses=30, candidates=100)
        >>> print(planned.poses, [one.name for one in planned.observations])
        30 ['tracker']
    """

    arm: Arm
    names: tuple[str, ...]  # free parameters
    kit: tuple[AbstractSimulated, ...]  # where each thing is, in the order of the observations
    parts: tuple[str, ...]  # of which item of the kit each is a placement
    observations: tuple[AbstractObservation, ...]  # the poses, with what would be measured
    noise: Noise
    criterion: Criterion
    check_length: float  # length that predictions are of, mm
    predicted: Prediction
    random: Prediction  # median over sets of as many random poses in the same places
    loose: Prediction  # the same plan with joints off by 5 deg (standard deviation)
    more: Prediction  # with ten more poses
    without: dict[str, Prediction]  # by what is left out; infinite where the rest does not determine the arm
    motions: tuple[Motion, ...] = ()  # of each observation, its poses in their order
    cell: Cell | None = None  # what the poses keep clear of
    retract: float = 0.0  # distance of approach points, mm
    unconstrained: Prediction | None = None  # in the same places without cones, obstacles and approach points

    @property
    def poses(self) -> int:
        """How many there are."""
        return sum(observation.q.shape[0] for observation in self.observations)

    def capture(self) -> Capture:
        """The plan as a capture, whose measured values are those of the nominal arm."""
        return Capture({}, (), self.observations)


def plan_kit(
    arm: Arm,
    kit: Sequence[KitItem | AbstractSimulated],
    *,
    poses: int = 60,
    region: Ranges | None = None,
    farthest: float = FARTHEST,
    space: Parameters | None = None,
    noise: Noise | None = None,
    criterion: Criterion = "length",
    margin: float = math.radians(5),
    above: float = 0.0,
    limits: Sequence[Sequence[float]] | None = None,
    tool_axis: tuple[float, float, float] = TOOL_AXIS,
    cell: Cell | None = None,
    retract: float = 0.0,
    unconstrained: bool = False,
    candidates: int = 2000,
    check_length: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> KitPlan:
    """Choose where to put artefacts, and the poses that determine an arm best with them and with instruments.

    Random placements are ranked by random poses and the best by relaxed designs, then moved a little; poses are chosen
    by Fedorov's exchange (1972), and again among poses near the chosen ones.

    Args:
        arm: The arm, not a batch.
        kit: What is at hand: observations to simulate, with their uncertainties, as they stand; or `KitItem`, which are
            placed. How many poses each has is chosen.
        poses: Number of poses in all.
        region: Ranges of ``x``, ``y``, ``z`` and of the ``distance`` from the origin for the tip in what is placed, mm
            (default: z at least 0).
        farthest: Largest distance from the shoulder of the tip in what is placed, as a part of the reach.
        space: Free parameters (default: those of `Parameters.free_of`).
        noise: Noise of readings and seat; by default that of a small measuring arm.
        criterion: As in `plan`.
        margin: Distance of the joints from their limits, rad.
        above: Height in the base frame below which no joint and no tip comes, mm.
        limits: Lowest and highest reading of each joint, rad (default: the arm's own).
        tool_axis: Axis of the last frame that points from the tool into a seat, for the cones of the items.
        cell: The arm's body and the obstacles that it may not touch; by default nothing is checked.
        retract: Distance of the approach points of items with a cone along their normal, mm; 0 for none.
        unconstrained: Whether to predict also what poses in the same places without cones, cell and approach points
            would give.
        candidates: Number of candidate configurations.
        check_length: Length that predictions are of, mm.
        seed: Seed of the search.
        progress: Called with the name of the stage and the fraction of it that is done.

    Returns:
        The plan, with predicted uncertainties, also without each part of the kit.

    Raises:
        InputError: Something cannot be reached, the poses are too few, or nothing determines the parameters.

    Example:
        >>> ends = {"1": (0, 0, 0), "2": (300, 0, 0)}
        >>> bar = aj.data.observations.SimulatedArtefact("ball bar", ends, 2, (0, 0, 0.7, 300, -200, 300), u=0.001)
        >>> tracker = aj.data.observations.SimulatedPoints("tracker", [[200, -300, 100], [600, 300, 500]], 30, u=0.02)
        >>> planned = aj.planning.plan_kit(arm, [bar, tracker], poses=30, candidates=100)
        >>> print([one.name for one in planned.observations], sum(len(one.q) for one in planned.observations))
        ['ball bar', 'tracker'] 30
        >>> print(f"u of {planned.check_length:.0f} mm: at most {planned.predicted.largest:.2f} mm")
        u of 300 mm: at most 0.04 mm
    """
    report = progress or (lambda stage, fraction: None)
    if not is_single(arm):
        raise InputError("plan_kit takes one arm, not a batch; give one of its arms.")
    noise = small_arm_noise() if noise is None else noise
    check_plannable(arm, criterion, noise)
    items = _checked(kit)
    ranges = placement_region(to_numpy(arm), region, farthest)
    check_region(ranges.ranges)
    check_retract(retract)
    space = planned_parameters(Parameters.free_of(arm) if space is None else space)
    check_length = default_length(arm) if check_length is None else check_length
    problem, functions = design_problem(
        search_region(
            to_numpy(arm), limits, margin, above, seed, cones_of([Cone()], tool_axis), with_table(cell, above)
        ),
        to_numpy(space),
        to_numpy(noise),
        criterion,
        dict(length=check_length, limits=joint_limits(arm, limits)),
        seed,
    )
    placed = place(problem, items, poses, ranges, candidates_of_kit, report)
    pool = _pool(problem, placed, candidates, retract)
    least = least_poses(pool)
    if poses < least.sum():
        raise InputError(
            f"{poses} poses are too few for this kit; give {least.sum()} at least, or leave something out."
        )
    chosen = _chosen(problem, placed, pool, poses, least, retract, report)
    chosen, motions = _in_order(problem, placed, chosen, retract)
    capture = Capture({}, (), chosen)
    unseen = observability(arm, capture, space)
    if unseen.rank < len(space.names):
        raise InputError(f"this kit does not determine the parameters. {' '.join(unseen.sentences())}")
    found = KitPlan(
        arm=arm,
        names=space.names,
        kit=placed.kit,
        parts=placed.parts,
        observations=tuple(chosen),
        noise=noise,
        criterion=criterion,
        check_length=check_length,
        **_predictions(problem, placed, pool, chosen, functions, report),
        motions=motions,
        cell=problem.region.cell,
        retract=retract,
    )
    if unconstrained:
        free = problem._replace(region=problem.region._replace(cell=None))
        anywhere = placed._replace(items=tuple(item._replace(half_angle=math.pi) for item in placed.items))
        pool = _pool(free, anywhere, candidates, 0.0)
        at = candidates_of_kit(free, _chosen(free, anywhere, pool, poses, least, 0.0, report))
        found = found._replace(unconstrained=prediction_of(at, at.rows, functions))
    return found


def _pool(problem: DesignProblem, placed: PlacedKit, count: int, retract: float) -> list[AbstractObservation]:
    """Poses to choose from in everything."""
    each = count // len(placed.kit)
    return [
        set_up(problem.region, one, each, item=item, retract=retract)
        for one, item in zip(placed.kit, placed.items, strict=True)
    ]


def _in_order(
    problem: DesignProblem, placed: PlacedKit, chosen: Sequence[AbstractObservation], retract: float
) -> tuple[list[AbstractObservation], tuple[Motion, ...]]:
    """Each observation with its poses in the order in which to take them, place after place, and how the arm moves.

    What has no cone has no normal either, and its tilts are not numbers.
    """
    ordered, motions = [], []
    for simulated, item, one in zip(placed.kit, placed.items, chosen, strict=True):
        region, q = region_of(problem.region, simulated, item), np.asarray(one.q)
        assert region.cones is not None
        normals = np.tile(region.cones.normals, (len(q), 1))
        order, motion = ordered_motion(region, q, one.places, normals, retract if item.has_cone else 0.0)
        ordered.append(one.select(order))
        motions.append(motion if item.has_cone else motion._replace(tilt=np.full(len(q), np.nan)))
    return ordered, tuple(motions)


def _checked(kit: Sequence[KitItem | AbstractSimulated]) -> list[KitItem]:
    items = [item if isinstance(item, KitItem) else KitItem(item, places=0) for item in kit]
    if not items:
        raise InputError("the kit is empty; name an artefact or an instrument.")
    for item in items:
        if not isinstance(item.simulated, AbstractSimulated):
            raise InputError(
                f"{item.simulated!r} cannot be planned; give one of aj.data.observations, such as SimulatedArtefact."
            )
        cones_of([Cone(item.half_angle, item.normal)])  # refuses what is no cone
        if item.places < 0:
            raise InputError(f"'{item.simulated.name}' has {item.places} places; give 0, which leaves it, or more.")
    names = [item.simulated.name for item in items]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError(f"two things of the kit have the name '{twice[0]}'; give each a name of its own.")
    return items


def least_poses(observations: Sequence[AbstractObservation]) -> Int[np.ndarray, " s"]:
    """For each place of each observation: as many as determine its own unknowns, and two at least."""
    found = []
    for one in observations:
        unknowns = sum(len(units) for units in one.unknowns.values()) + (3 if one.target else 0)
        places = int(one.places.max()) + 1
        found += [max(2, math.ceil((unknowns + 1) / (one.rows * places)))] * places
    return np.array(found)


def candidates_of_kit(problem: DesignProblem, observations: Sequence[AbstractObservation]) -> Candidates:
    """The information that each pose of the observations would add, and that of certified values alone."""
    observed, space = Observed.of(Capture({}, (), observations), problem.arm), problem.space
    vector, p = np.asarray(space.vector()), len(space.names)

    def linear_at(geometry: Float[AnyArray, " g"]) -> Linearisation:
        z = np.concatenate([vector, np.asarray(geometry)])
        return Linearisation.at(observed, space, z, noise=problem.noise, least=_LEAST_U)

    linear = linear_at(observed.start(space, vector))
    if max(np.abs(rows.values).max() for rows in linear.point.rows) > _START_AGREES:
        linear = linear_at(fit_geometry(problem.arm, observed, {}, problem.noise).geometry)
    parts = linear.dense()
    rows = np.zeros((len(observed.q), max(3, *(part.shape[1] for part in parts)), len(linear.z)))
    owner = np.empty(len(observed.q), dtype=int)
    places = 0
    for observation, part, poses in zip(observed.observations, parts, observed.slices, strict=True):
        rows[poses, : part.shape[1]] = np.moveaxis(np.asarray(part) * linear.steps[:, None, None], 0, 2).swapaxes(0, 1)
        owner[poses] = places + observation.places
        places = owner[poses].max() + 1
    relations, _, u = linear.relations()
    scaled = relations * linear.steps / np.maximum(u, _LEAST_U)[:, None]
    return Candidates(rows, owner, PRIOR * np.eye(len(linear.z)) + scaled.T @ scaled, p)


def _chosen(
    problem: DesignProblem,
    placed: PlacedKit,
    pool: list[AbstractObservation],
    poses: int,
    least: Int[np.ndarray, " s"],
    retract: float,
    report: Progress,
) -> list[AbstractObservation]:
    """The best poses of the pool, then the best of these and of poses near them."""
    best, best_value = None, np.inf
    for number in range(1 + _ROUNDS):
        possible = candidates_of_kit(problem, pool)
        rows = exchange(
            possible, poses, problem.objective, least=least,
            progress=lambda done, number=number: report("Choosing poses", (number + done) / (1 + _ROUNDS)),
        )  # fmt: skip
        value = problem.objective.value(covariance_of(possible.information(possible.rows[rows]), possible.parameters))
        if best is None or value < best_value:
            best, best_value = _taken(pool, rows), value
        if number < _ROUNDS:
            pool = [
                _near(problem, one, item, chosen, retract)
                for one, item, chosen in zip(placed.kit, placed.items, best, strict=True)
            ]
    assert best is not None
    return best


def _taken(pool: Sequence[AbstractObservation], rows: Int[np.ndarray, " N"]) -> list[AbstractObservation]:
    """The observations with some of the poses of the pool, numbered through."""
    found, first = [], 0
    for one in pool:
        last = first + one.q.shape[0]
        found.append(one.select(np.sort(rows[(rows >= first) & (rows < last)]) - first))
        first = last
    return found


def _near(
    problem: DesignProblem, simulated: AbstractSimulated, item: KitItem, chosen: AbstractObservation, retract: float
) -> AbstractObservation:
    """The poses of an observation, and others near each: joints changed, and the tip brought back."""
    region, q = region_of(problem.region, simulated, item), np.asarray(chosen.q)
    which = np.repeat(np.arange(len(q)), _NEIGHBOURS)
    starts = q[which] + _NEAR * region.random.normal(size=(len(which), q.shape[1]))
    moved, good = reached(region, starts, np.asarray(region.arm.position(q))[which])
    good[good] = approachable(region, moved[good], item, retract)
    rows = np.concatenate([np.arange(len(q)), which[good]])
    order = np.argsort(chosen.places[rows], kind="stable")
    return with_readings(chosen.select(rows[order]), np.concatenate([q, moved[good]])[order])


def with_readings(observation: AbstractObservation, q: Float[np.ndarray, "m n"]) -> AbstractObservation:
    """The same observation read otherwise."""
    return eqx.tree_at(lambda one: one.q, observation, q)


def _loosened(
    problem: DesignProblem, simulated: AbstractSimulated, item: KitItem, chosen: AbstractObservation
) -> AbstractObservation:
    """The same poses, with joints off by some degrees and the tip brought back."""
    region, q = region_of(problem.region, simulated, item), np.asarray(chosen.q)
    moved, good = reached(region, q + _LOOSE * region.random.normal(size=q.shape), np.asarray(region.arm.position(q)))
    return with_readings(chosen, np.where(good[:, None], moved, q))


def _predictions(
    problem: DesignProblem,
    placed: PlacedKit,
    pool: list[AbstractObservation],
    chosen: list[AbstractObservation],
    functions: Float[np.ndarray, "v p"],
    report: Progress,
) -> dict[str, Any]:
    """For the plan, for random poses, for imprecise and more poses, and without each part of the kit."""
    random, stage = problem.region.random, "Predicting"
    report(stage, 0.0)

    def predicted(candidates: Candidates, rows: Float[np.ndarray, "m r P"]) -> Prediction:
        return prediction_of(candidates, rows, functions)

    def typical(sets: list[Prediction]) -> Prediction:
        return Prediction(*(float(np.median(column)) for column in zip(*sets, strict=True)))

    def of(observations: Sequence[AbstractObservation]) -> Prediction:
        candidates = candidates_of_kit(problem, observations)
        return predicted(candidates, candidates.rows)

    possible, planned = candidates_of_kit(problem, pool), candidates_of_kit(problem, chosen)
    counts = np.bincount(planned.owner)
    random_sets = []
    for _ in range(_RANDOM_SETS):
        rows = [random.choice(np.flatnonzero(possible.owner == i), count) for i, count in enumerate(counts)]
        random_sets.append(predicted(possible, possible.rows[np.concatenate(rows)]))
    loose_sets = [
        of([_loosened(problem, *parts) for parts in zip(placed.kit, placed.items, chosen, strict=True)])
        for _ in range(_LOOSE_SETS)
    ]
    report(stage, 0.3)
    base = planned.information(planned.rows)
    added = exchange(possible._replace(base=base), MORE, problem.objective, least=0, sweeps=1)
    without = {}
    parts = list(dict.fromkeys(placed.parts)) if len(set(placed.parts)) > 1 else []
    for number, part in enumerate(parts):
        report(stage, 0.4 + 0.6 * number / len(parts))
        left = [one for one, of_part in zip(chosen, placed.parts, strict=True) if of_part != part]
        seen = observability(problem.arm, Capture({}, (), left), problem.space)
        complete = seen.rank == len(problem.space.names)
        without[part] = of(left) if complete else Prediction(math.inf, math.inf)
    report(stage, 1.0)
    return {
        "predicted": predicted(planned, planned.rows),
        "random": typical(random_sets),
        "loose": typical(loose_sets),
        "more": predicted(planned, np.concatenate([planned.rows, possible.rows[added]])),
        "without": without,
    }
