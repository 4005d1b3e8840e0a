"""What poses tell of an arm: their information in sockets, and the uncertainty of lengths after a calibration."""

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int

from ..core.linear_algebra import inverse_cholesky
from ..core.numpy_or_jax import in_chunks, to_numpy
from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import Arm, jacobian_at, joint_limits
from ..kinematics.chain import Geometry, joint_motion, reading_units
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import SearchRegion, configurations_at
from ..uncertainty.volume import sample_lengths
from .fedorov_exchange import Candidates, Kind, Objective, covariance_of, exchange
from .options import Criterion, FixturePlacement, PlanOptions, PlanTask

PRIOR = 1e-4  # parameters are known to 100 mm or 100 mrad in advance: makes the first information matrices invertible
MORE = 10  # poses added in the prediction `Plan.more`
LOOSE = math.radians(5)  # standard deviation of joints of an imprecise operator
OBJECTIVES: dict[Criterion, tuple[Kind, float]] = {
    "length": ("functions", 8.0),
    "A": ("trace", 0.0),
    "D": ("determinant", 8.0),
    "E": ("trace", 8.0),
}
_NEAR = math.radians(12)  # of candidates near a chosen pose
_ROUNDS, _NEIGHBOURS = 2, 12  # of the search about the chosen poses, and its candidates for each
_OBJECTIVE_LENGTHS, _PREDICTION_LENGTHS = 300, 400  # predictions use other lengths than the objective

Poses = TypeVar("Poses")


class DesignProblem(NamedTuple):
    """What all designs for one arm have in common."""

    region: SearchRegion
    space: Parameters
    noise: Noise
    objective: Objective
    lengths: Float[np.ndarray, "v p"] = np.zeros((0, 0))  # derivatives of the lengths that predictions are of
    retract: float = 0.0  # distance of approach points, mm

    @property
    def arm(self) -> Arm:
        """The arm."""
        return self.region.arm

    def near(self, q: Float[np.ndarray, "N n"]) -> tuple[Float[np.ndarray, "m n"], Int[np.ndarray, " m"]]:
        """Configurations near some, with the tips off their places; and which of these each is near."""
        which = np.repeat(np.arange(len(q)), _NEIGHBOURS)
        steps = _NEAR * reading_units(self.arm.geometry) * self.region.random.normal(size=(len(which), q.shape[1]))
        return q[which] + steps, which

    @classmethod
    def of(cls, task: PlanTask, region: SearchRegion) -> "DesignProblem":
        """The problem of a task in its region, in NumPy."""
        space, seed = to_numpy(task.space), task.options.seed
        limits = joint_limits(task.arm, task.options.limits)
        of_objective, of_predictions = (
            length_derivatives(
                region.arm,
                space,
                *sample_lengths(region.arm, count, length=task.check_length, limits=limits, seed=seed + offset),
            )
            for offset, count in ((1, _OBJECTIVE_LENGTHS), (2, _PREDICTION_LENGTHS))
        )
        kind, power = OBJECTIVES[task.options.criterion]
        objective = Objective(kind, of_objective, power)
        return cls(region, space, to_numpy(task.noise), objective, of_predictions, task.options.retract)


def length_derivatives(
    arm: Arm, space: Parameters, start: Float[np.ndarray, "v n"], end: Float[np.ndarray, "v n"]
) -> Float[np.ndarray, "v p"]:
    """Derivatives of the lengths between configurations by the free parameters, in natural steps."""
    between = np.asarray(arm.position(end)) - np.asarray(arm.position(start))
    direction = between / np.linalg.norm(between, axis=1, keepdims=True)
    jacobian = jacobian_at(arm, end, space.names) - jacobian_at(arm, start, space.names)
    return np.einsum("vc,vcp->vp", direction, jacobian) * np.asarray(space.scale)


class Pool(NamedTuple):
    """Configurations in sockets, and what each measures of the parameters: derivatives of the tip, whitened."""

    q: Float[np.ndarray, "c n"]
    owner: Int[np.ndarray, " c"]  # index of each one's socket
    jacobian: Float[np.ndarray, "c 3 p"]  # by the parameters in natural steps, in standard deviations
    roots: Float[np.ndarray, "c 3 3"]  # that whiten the tips

    def at(self, rows: Any) -> "Pool":
        """Some of these configurations."""
        return Pool(*(part[rows] for part in self))

    def joined(self, other: "Pool") -> "Pool":
        """Both."""
        return Pool(*(np.concatenate(parts) for parts in zip(self, other, strict=True)))

    def fewest(self, sockets: int) -> int:
        """The number of configurations in the socket that has the fewest."""
        return int(np.bincount(self.owner, minlength=sockets).min())


def pool_of(problem: DesignProblem, q: Float[np.ndarray, "c n"], owner: Int[np.ndarray, " c"]) -> Pool:
    """Configurations with their whitened derivatives."""
    geometry, noise = to_numpy((problem.arm.geometry, problem.noise))
    roots = in_chunks(lambda block: _whitening(geometry, block, noise), q)
    jacobian = jacobian_at(problem.arm, q, problem.space.names) * np.asarray(problem.space.scale)
    return Pool(q, owner, roots @ jacobian, roots)


def pool_at(problem: DesignProblem, points: Float[np.ndarray, "s 3"], starts: int) -> Pool:
    """Configurations that reach the points from ``each`` random starts a point."""
    return pool_of(problem, *configurations_at(problem.region, points, starts))


def candidates_of(problem: DesignProblem, placement: FixturePlacement, pool: Pool) -> Candidates:
    """The information that each configuration would add, and that of the lengths alone."""
    p, sockets = len(problem.space.names), len(placement.points)
    unknowns = p + 3 * sockets
    rows = np.zeros((len(pool.q), 3, unknowns))
    rows[:, :, :p] = pool.jacobian
    for axis in range(3):
        rows[np.arange(len(pool.q)), :, p + 3 * pool.owner + axis] = -pool.roots[:, :, axis]
    base = PRIOR * np.eye(unknowns)
    for (start, end), u in zip(placement.ends, placement.u, strict=True):
        between = placement.points[end] - placement.points[start]
        row = np.zeros(unknowns)
        direction = between / np.linalg.norm(between)
        row[p + 3 * end : p + 3 * end + 3], row[p + 3 * start : p + 3 * start + 3] = direction, -direction
        base += np.outer(row, row) / u**2
    return Candidates(rows, pool.owner, base, p)


def _whitening(geometry: Geometry, q: Float[np.ndarray, "c n"], noise: Noise) -> Float[np.ndarray, "c 3 3"]:
    covariances = tip_covariances(geometry, joint_motion(geometry, q), noise)
    return np.asarray(inverse_cholesky(np.moveaxis(np.asarray(covariances), -1, 0)))


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
    candidates_in: Callable[[Poses], Candidates],
    taken: Callable[[Poses, np.ndarray], Poses],
    near: Callable[[Poses], Poses],
    choose: Callable[[Candidates, Callable[[float], None]], np.ndarray],
    options: PlanOptions,
) -> Poses:
    """The best poses of a pool, then the best of these and of poses near them."""
    best, best_value = pool, np.inf
    for number in range(1 + _ROUNDS):

        def report(done: float, number: int = number) -> None:
            options.report("Choosing poses", (number + done) / (1 + _ROUNDS))

        candidates = candidates_in(pool)
        rows = choose(candidates, report)
        covariance = covariance_of(candidates.information(candidates.rows[rows]), candidates.parameters)
        value = problem.objective.value(covariance)
        if value < best_value:
            best, best_value = taken(pool, rows), value
        if number < _ROUNDS:
            pool = near(best)
    return best
