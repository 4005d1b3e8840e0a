"""Predictions of a plan: the uncertainty of lengths over the volume, and that of other choices of poses."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..kinematics.workspace import reached
from .fedorov_exchange import Candidates, covariance_of, exchange
from .placement import DesignProblem, FixturePlacement, candidates_of, pool_of

MORE = 10  # poses added in the prediction `Plan.more`
_RANDOM_SETS, _LOOSE_SETS = 50, 10
_LOOSE = math.radians(5)


class Prediction(NamedTuple):
    """Median and largest standard uncertainty that the calibration would add to lengths over the volume, mm."""

    median: float
    largest: float


def prediction_of(
    candidates: Candidates, rows: Float[np.ndarray, "m r P"], functions: Float[np.ndarray, "v p"]
) -> Prediction:
    """The prediction for poses with these rows; ``functions`` are derivatives of lengths."""
    covariance = covariance_of(candidates.information(rows), candidates.parameters)
    u = np.sqrt(np.einsum("vp,pq,vq->v", functions, covariance, functions))
    return Prediction(float(np.median(u)), float(u.max()))


def predictions(
    problem: DesignProblem,
    placement: FixturePlacement,
    pool: Candidates,
    q: Float[np.ndarray, "N n"],
    owner: Int[np.ndarray, " N"],
    functions: Float[np.ndarray, "v p"],
) -> dict[str, Prediction]:
    """Predictions for the plan, for random poses in its sockets, for imprecise poses, and for ten more poses."""
    region, random = problem.region, problem.region.random

    def predicted(rows: Float[np.ndarray, "m r P"]) -> Prediction:
        return prediction_of(pool, rows, functions)

    def typical(sets: list[Prediction]) -> Prediction:
        return Prediction(*(float(np.median(column)) for column in zip(*sets, strict=True)))

    planned = candidates_of(problem, placement, pool_of(problem, q, owner))
    counts = np.bincount(owner, minlength=len(placement.points))
    random_sets = []
    for _ in range(_RANDOM_SETS):
        rows = [random.choice(np.flatnonzero(pool.owner == i), count) for i, count in enumerate(counts)]
        random_sets.append(predicted(pool.rows[np.concatenate(rows)]))
    starts = np.tile(q, (_LOOSE_SETS, 1)) + _LOOSE * random.normal(size=(_LOOSE_SETS * len(q), q.shape[1]))
    owners = np.tile(owner, _LOOSE_SETS)
    near, possible = reached(region, starts, placement.points[owners], sockets=owners)
    near = np.where(possible[:, None], near, np.tile(q, (_LOOSE_SETS, 1)))
    loose = candidates_of(problem, placement, pool_of(problem, near, owners)).rows
    loose_sets = [predicted(rows) for rows in np.split(loose, _LOOSE_SETS)]
    base = planned.information(planned.rows)
    added = exchange(pool._replace(base=base), MORE, problem.objective, least=0, sweeps=1)
    return {
        "predicted": predicted(planned.rows),
        "random": typical(random_sets),
        "loose": typical(loose_sets),
        "more": predicted(np.concatenate([planned.rows, pool.rows[added]])),
    }
