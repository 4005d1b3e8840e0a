"""Plans with artefacts and instruments: where to put what is at hand, and which poses to take with it."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from ..core.arguments import with_options
from ..core.blas_threads import one_blas_thread
from ..core.errors import InputError
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.observations.observation import AbstractObservation
from ..data.observations.simulated import AbstractSimulated
from ..kinematics.arm import Arm
from ..kinematics.collisions import Cell
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import Cone, cones_of, reached
from ..uncertainty.identifiability import observability
from .kit_placement import KitItem, Thing, candidates_of_kit, least_poses, place, set_up
from .motion import Motion, ordered_motion
from .problem import LOOSE, Criterion, DesignProblem, PlanOptions, Prediction, best_poses, prediction_of, predictions

_CANDIDATES = 2000
_EVENLY = 60  # candidates in each thing that show what no poses determine
_RANDOM_SETS, _LOOSE_SETS = 30, 5  # of poses, for predictions


class KitPlan(NamedTuple):
    """Poses to take with a kit of artefacts and instruments. Arrays are of NumPy: q in rad, positions in mm.

    Example:
        >>> box = [[200, -300, 100], [600, 300, 500]]
        >>> tracker = aj.data.observations.SimulatedPoints("tracker", box, 30, u=0.02)
        >>> planned = aj.planning.plan_kit(arm, [tracker], poses=30, candidates=100)
        >>> print(planned.poses, [observation.name for observation in planned.observations])
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
    heights: tuple[float, float] | None = None  # range of z in which artefacts were placed, mm; None where none were
    held: tuple[str, ...] = ()  # parameters that no poses with this kit determine, held at their values in the arm

    @property
    def poses(self) -> int:
        """How many there are."""
        return sum(observation.q.shape[0] for observation in self.observations)

    def capture(self) -> Capture:
        """The plan as a capture, whose measured values are those of the nominal arm."""
        return Capture({}, (), self.observations)


@with_options(PlanOptions)
@one_blas_thread
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
        >>> print([observation.name for observation in planned.observations], planned.poses)
        ['ball bar', 'tracker'] 30
        >>> print(f"u of {planned.check_length:.0f} mm: at most {planned.predicted.largest:.2f} mm")
        u of 300 mm: at most 0.04 mm
    """
    problem, items = DesignProblem.of(arm, PlanOptions(**options)), _checked(kit)
    if len(problem.region.chains) > 1:
        raise InputError("a kit is planned for one chain of a robot; name the chain (chains= or --chain).")
    things = place(problem, items, poses)
    pool = _pool(problem, things)
    problem, held = _holding(problem, pool)
    least = least_poses(pool)
    if poses < least.sum():
        raise InputError(
            f"{poses} poses are too few for this kit; give at least {least.sum()} poses, or remove an item from the "
            "kit."
        )
    chosen, motions = _in_order(problem, things, _chosen(problem, things, pool, poses, least))
    unseen = observability(problem.arm, Capture({}, (), chosen), problem.space)
    if unseen.rank < len(problem.space.names):
        raise InputError(f"this kit cannot determine all parameters. {' '.join(unseen.sentences())}")
    planned = KitPlan(
        arm=problem.arm,
        names=problem.space.names,
        kit=tuple(thing.simulated for thing in things),
        parts=tuple(thing.item.simulated.name for thing in things),
        observations=tuple(chosen),
        noise=problem.noise,
        criterion=problem.options.criterion,
        check_length=problem.check_length,
        **_predictions(problem, things, pool, chosen),
        motions=motions,
        cell=problem.region.cell,
        retract=problem.options.retract,
        heights=problem.options.ranges["z"] if any(item.places for item in items) else None,
        held=held,
    )
    if problem.options.unconstrained:
        free = problem.without_limits()
        anywhere = [thing._replace(item=thing.item._replace(half_angle=math.pi)) for thing in things]
        poses_anywhere = _chosen(free, anywhere, _pool(free, anywhere), poses, least)
        unconstrained = prediction_of(free, candidates_of_kit(free, poses_anywhere))
        planned = planned._replace(unconstrained=unconstrained)
    return planned


def _checked(kit: Sequence[KitItem | AbstractSimulated]) -> list[KitItem]:
    items = [item if isinstance(item, KitItem) else KitItem(item, places=0) for item in kit]
    if not items:
        raise InputError("the kit is empty; give at least one artefact or instrument.")
    for item in items:
        if not isinstance(item.simulated, AbstractSimulated):
            raise InputError(
                f"{item.simulated!r} cannot be planned; give an object of aj.data.observations, such as "
                "SimulatedArtefact."
            )
        cones_of([Cone(item.half_angle, item.normal)])  # refuses what is no cone
        if item.places < 0:
            raise InputError(
                f"'{item.simulated.name}' has places = {item.places}; give a positive number, or 0 if the plan must "
                "not move the item."
            )
    names = [item.simulated.name for item in items]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError(f"two items of the kit have the name '{twice[0]}'; give each item a different name.")
    return items


def _pool(problem: DesignProblem, things: Sequence[Thing]) -> list[AbstractObservation]:
    """Poses to choose from in everything."""
    starts = (problem.options.candidates or _CANDIDATES) // len(things)
    return [set_up(problem.region, thing, starts, retract=problem.options.retract) for thing in things]


def _holding(problem: DesignProblem, pool: Sequence[AbstractObservation]) -> tuple[DesignProblem, tuple[str, ...]]:
    """The problem without parameters that not even all candidates determine, one of each combination, if such are to be
    held; and their names."""
    if not (problem.options.hold_undetermined and any(observation.fixes_scale for observation in pool)):
        return problem, ()
    rows = [np.unique(np.linspace(0, len(observation.q) - 1, _EVENLY).astype(int)) for observation in pool]
    some = Capture({}, (), tuple(observation.select(row) for observation, row in zip(pool, rows, strict=True)))
    left, held = problem.space, []
    while (null := observability(problem.arm, some, left).null).shape[1]:
        held.append(left.names[int(np.argmax(np.abs(null[:, 0])))])
        left = Parameters(left.base, tuple(name for name in left.names if name not in held))
    if held:
        problem = DesignProblem.of(problem.arm, problem.options._replace(space=left))
    return problem, tuple(held)


def _chosen(
    problem: DesignProblem,
    things: Sequence[Thing],
    pool: list[AbstractObservation],
    poses: int,
    least: Int[np.ndarray, " s"],
) -> list[AbstractObservation]:
    """The best poses in everything."""

    def taken(pool: list[AbstractObservation], rows: np.ndarray) -> list[AbstractObservation]:
        """The observations with some of the poses of the pool, which are numbered through."""
        first = np.cumsum([0, *(observation.q.shape[0] for observation in pool)])
        parts = [np.sort(rows[(rows >= start) & (rows < end)]) - start for start, end in pairwise(first)]
        return [observation.select(part) for observation, part in zip(pool, parts, strict=True)]

    def near(chosen: list[AbstractObservation]) -> list[AbstractObservation]:
        return [neighbours(problem, thing, poses) for thing, poses in zip(things, chosen, strict=True)]

    return best_poses(problem, pool, poses, least, lambda pool: candidates_of_kit(problem, pool), taken, near)


def neighbours(problem: DesignProblem, thing: Thing, poses: AbstractObservation) -> AbstractObservation:
    """The poses in a thing, and others near each: joints changed, and the tip brought back."""
    seat, q = thing.seat(problem.region), np.asarray(poses.q)
    starts, which = problem.near(q)
    moved, good = reached(seat, starts, np.asarray(seat.arm.position(q))[which])
    good[good] = thing.usable(problem.region, moved[good], problem.options.retract)
    rows = np.concatenate([np.arange(len(q)), which[good]])
    order = np.argsort(poses.places[rows], kind="stable")
    q = np.concatenate([q, moved[good]])[order]
    return thing.recorded(problem.region, q, poses.select(rows[order]))


def _in_order(
    problem: DesignProblem, things: Sequence[Thing], chosen: Sequence[AbstractObservation]
) -> tuple[list[AbstractObservation], tuple[Motion, ...]]:
    """Each observation with its poses in the order in which to take them, place after place, and how the arm moves.

    What has no cone has no normal either, and its tilts are not numbers.
    """
    ordered, motions = [], []
    for thing, poses in zip(things, chosen, strict=True):
        seat, q = thing.seat(problem.region), np.asarray(poses.q)
        assert seat.cones is not None
        normals = np.tile(seat.cones.normals, (len(q), 1))
        retract = problem.options.retract if thing.item.has_cone else 0.0
        order, motion = ordered_motion(seat, q, poses.places, normals, retract)
        ordered.append(poses.select(order))
        motions.append(motion if thing.item.has_cone else motion._replace(tilt=np.full(len(q), np.nan)))
    return ordered, tuple(motions)


def _predictions(
    problem: DesignProblem,
    things: Sequence[Thing],
    pool: list[AbstractObservation],
    chosen: list[AbstractObservation],
) -> dict[str, Any]:
    """For the plan, for random poses, for imprecise and more poses, and without each part of the kit."""

    def loosened(thing: Thing, poses: AbstractObservation) -> AbstractObservation:
        """The same poses, with joints off by some degrees and the tip brought back."""
        seat, q = thing.seat(problem.region), np.asarray(poses.q)
        starts = problem.moved(q, LOOSE)
        moved, good = reached(seat, starts, np.asarray(seat.arm.position(q)))
        good[good] = thing.usable(problem.region, moved[good], 0.0)
        return thing.recorded(problem.region, np.where(good[:, None], moved, q), poses)

    report, names = problem.options.report, [thing.item.simulated.name for thing in things]
    report("Predicting", 0.0)
    planned, possible = candidates_of_kit(problem, chosen), candidates_of_kit(problem, pool)
    loose = (
        candidates_of_kit(problem, [loosened(*pair) for pair in zip(things, chosen, strict=True)])
        for _ in range(_LOOSE_SETS)
    )
    predicted: dict[str, Any] = predictions(problem, planned, possible, loose, _RANDOM_SETS)
    without = {}
    parts = list(dict.fromkeys(names)) if len(set(names)) > 1 else []
    for number, part in enumerate(parts):
        report("Predicting", 0.4 + 0.6 * number / len(parts))
        left = [poses for poses, name in zip(chosen, names, strict=True) if name != part]
        seen = observability(problem.arm, Capture({}, (), left), problem.space)
        without[part] = Prediction(math.inf, math.inf)
        if seen.rank == len(problem.space.names):
            without[part] = prediction_of(problem, candidates_of_kit(problem, left))
    report("Predicting", 1.0)
    return predicted | {"without": without}
