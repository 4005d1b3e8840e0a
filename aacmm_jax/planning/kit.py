"""Plans with artefacts and instruments: where to put what is at hand, and which poses to take with it.

The information of a pose is that of the model's own rows (`uncertainty.linearisation`), so every kind of observation
that can be simulated can be planned, and nothing here depends on a kind.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from ..core.arguments import with_options
from ..core.errors import InputError
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.observations.observation import AbstractObservation, AbstractSimulated
from ..kinematics.arm import Arm
from ..kinematics.collisions import Cell
from ..kinematics.workspace import Cone, cones_of, reached
from ..uncertainty.identifiability import observability
from .fedorov_exchange import exchange
from .information import LOOSE, DesignProblem, Prediction, best_poses, prediction_of, predictions
from .kit_placement import KitItem, PlacedKit, approachable, candidates_of_kit, least_poses, place, region_of, set_up
from .motion import Motion, ordered_motion
from .options import Criterion, PlacementRegion, PlanOptions, PlanTask

_CANDIDATES = 2000
_RANDOM_SETS, _LOOSE_SETS = 30, 5  # of poses, for predictions

Observations = Sequence[AbstractObservation]


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


@with_options(PlanOptions)
def plan_kit(arm: Arm, kit: Sequence[KitItem | AbstractSimulated], *, poses: int = 60, **options: Any) -> KitPlan:
    """Choose where to put artefacts, and the poses that determine an arm best with them and with instruments.

    Random placements are ranked by random poses and the best by relaxed designs, then moved a little; poses are chosen
    by Fedorov's exchange (1972), and again among poses near the chosen ones.

    Args:
        arm: The arm, not a batch.
        kit: What is at hand: observations to simulate, with their uncertainties, as they stand; or `KitItem`, which are
            placed. How many poses each has is chosen.
        poses: Number of poses in all.
        **options: Fields of `PlanOptions`, like all arguments that are not named here: ``noise``, ``region``,
            ``margin``, ``cell``, ``candidates``, ``seed`` and others.

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
    task = PlanTask.of(arm, PlanOptions(**options))
    items, ranges = _checked(kit), PlacementRegion.of(task.arm, task.options.region, task.options.farthest)
    problem = DesignProblem.of(task, task.search_region(cones_of([Cone()], task.options.tool_axis)))
    count = task.options.candidates or _CANDIDATES
    placed = place(problem, items, poses, ranges, task.options.report)
    pool = _pool(problem, placed, count)
    least = least_poses(pool)
    if poses < least.sum():
        raise InputError(
            f"{poses} poses are too few for this kit; give {least.sum()} at least, or leave something out."
        )
    chosen, motions = _in_order(problem, placed, _chosen(problem, placed, pool, poses, least, task.options))
    unseen = observability(arm, Capture({}, (), chosen), task.space)
    if unseen.rank < len(task.space.names):
        raise InputError(f"this kit does not determine the parameters. {' '.join(unseen.sentences())}")
    planned = KitPlan(
        arm=arm,
        names=task.space.names,
        kit=placed.kit,
        parts=placed.parts,
        observations=tuple(chosen),
        noise=task.noise,
        criterion=task.options.criterion,
        check_length=task.check_length,
        **_predictions(problem, placed, pool, chosen, task.options),
        motions=motions,
        cell=problem.region.cell,
        retract=problem.retract,
    )
    if task.options.unconstrained:
        free = problem._replace(region=problem.region._replace(cell=None))
        anywhere = placed._replace(items=tuple(item._replace(half_angle=math.pi) for item in placed.items))
        poses_anywhere = _chosen(free, anywhere, _pool(free, anywhere, count), poses, least, task.options)
        unconstrained = prediction_of(free, candidates_of_kit(free, poses_anywhere))
        planned = planned._replace(unconstrained=unconstrained)
    return planned


def _pool(problem: DesignProblem, placed: PlacedKit, count: int) -> list[AbstractObservation]:
    """Poses to choose from in everything."""
    starts = count // len(placed.kit)
    things = zip(placed.kit, placed.items, strict=True)
    return [set_up(problem.region, thing, starts, item=item, retract=problem.retract) for thing, item in things]


def _in_order(
    problem: DesignProblem, placed: PlacedKit, chosen: Observations
) -> tuple[list[AbstractObservation], tuple[Motion, ...]]:
    """Each observation with its poses in the order in which to take them, place after place, and how the arm moves.

    What has no cone has no normal either, and its tilts are not numbers.
    """
    ordered, motions = [], []
    for simulated, item, poses in zip(placed.kit, placed.items, chosen, strict=True):
        region, q = region_of(problem.region, simulated, item), np.asarray(poses.q)
        assert region.cones is not None
        normals = np.tile(region.cones.normals, (len(q), 1))
        order, motion = ordered_motion(region, q, poses.places, normals, problem.retract if item.has_cone else 0.0)
        ordered.append(poses.select(order))
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


def _chosen(
    problem: DesignProblem,
    placed: PlacedKit,
    pool: list[AbstractObservation],
    poses: int,
    least: Int[np.ndarray, " s"],
    options: PlanOptions,
) -> list[AbstractObservation]:
    """The best poses in everything."""

    def near(chosen: list[AbstractObservation]) -> list[AbstractObservation]:
        return [_near(problem, *thing) for thing in zip(placed.kit, placed.items, chosen, strict=True)]

    return best_poses(
        problem,
        pool,
        lambda pool: candidates_of_kit(problem, pool),
        _taken,
        near,
        lambda candidates, report: exchange(candidates, poses, problem.objective, least=least, progress=report),
        options,
    )


def _taken(pool: Sequence[AbstractObservation], rows: Int[np.ndarray, " N"]) -> list[AbstractObservation]:
    """The observations with some of the poses of the pool, numbered through."""
    chosen, first = [], 0
    for one in pool:
        last = first + one.q.shape[0]
        chosen.append(one.select(np.sort(rows[(rows >= first) & (rows < last)]) - first))
        first = last
    return chosen


def _near(
    problem: DesignProblem, simulated: AbstractSimulated, item: KitItem, chosen: AbstractObservation
) -> AbstractObservation:
    """The poses of an observation, and others near each: joints changed, and the tip brought back."""
    region, q = region_of(problem.region, simulated, item), np.asarray(chosen.q)
    starts, which = problem.near(q)
    moved, good = reached(region, starts, np.asarray(region.arm.position(q))[which])
    good[good] = approachable(region, moved[good], item, problem.retract)
    rows = np.concatenate([np.arange(len(q)), which[good]])
    order = np.argsort(chosen.places[rows], kind="stable")
    return chosen.select(rows[order]).changed(q=np.concatenate([q, moved[good]])[order])


def _loosened(
    problem: DesignProblem, simulated: AbstractSimulated, item: KitItem, chosen: AbstractObservation
) -> AbstractObservation:
    """The same poses, with joints off by some degrees and the tip brought back."""
    region, q = region_of(problem.region, simulated, item), np.asarray(chosen.q)
    moved, good = reached(region, q + LOOSE * region.random.normal(size=q.shape), np.asarray(region.arm.position(q)))
    return chosen.changed(q=np.where(good[:, None], moved, q))


def _predictions(
    problem: DesignProblem,
    placed: PlacedKit,
    pool: list[AbstractObservation],
    chosen: list[AbstractObservation],
    options: PlanOptions,
) -> dict[str, Any]:
    """For the plan, for random poses, for imprecise and more poses, and without each part of the kit."""
    options.report("Predicting", 0.0)
    planned, possible = candidates_of_kit(problem, chosen), candidates_of_kit(problem, pool)
    things = list(zip(placed.kit, placed.items, chosen, strict=True))
    loose = (candidates_of_kit(problem, [_loosened(problem, *thing) for thing in things]) for _ in range(_LOOSE_SETS))
    predicted: dict[str, Any] = predictions(problem, planned, possible, loose, _RANDOM_SETS)
    without = {}
    parts = list(dict.fromkeys(placed.parts)) if len(set(placed.parts)) > 1 else []
    for number, part in enumerate(parts):
        options.report("Predicting", 0.4 + 0.6 * number / len(parts))
        left = [poses for poses, of_part in zip(chosen, placed.parts, strict=True) if of_part != part]
        seen = observability(problem.arm, Capture({}, (), left), problem.space)
        complete = seen.rank == len(problem.space.names)
        open_ended = Prediction(math.inf, math.inf)
        without[part] = prediction_of(problem, candidates_of_kit(problem, left)) if complete else open_ended
    options.report("Predicting", 1.0)
    return predicted | {"without": without}
