"""Everything at one point of a solve: rows, how errors reach them, and the weights that follow."""

from typing import Any, NamedTuple

from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, namespace
from ..kinematics.chain import ForwardPass
from ..kinematics.parameters import Parameters
from ..model.rows import PointRows, PriorRows, Whitening, rows_at, whitening_of
from ..uncertainty.tip_errors import (
    ArmErrors,
    arm_errors,
    covariance_of_noise,
    covariance_of_sigma,
    robust_scatter_of,
    root_of_sum,
    scatter_of,
)
from .task import Task

_LEAST = 1e-4  # smallest standard uncertainty of what is certified, of a tip coordinate's standard deviation


class State(NamedTuple):
    """Everything at one point of the solve."""

    point: PointRows
    errors: list[ArmErrors]
    sigma: Float[AnyArray, ""]  # standard deviation of a tip coordinate, mm


class Begun(NamedTuple):
    """Where a solve begins."""

    space: Parameters
    sides: tuple[Float[AnyArray, " z"], Float[AnyArray, " z"]]  # bounds of all unknowns
    steps: Float[AnyArray, " z"]  # natural steps
    before: State  # at the start
    z: Float[AnyArray, " z"]  # where it begins: there, or near the solution
    state: State  # there


def state_at(
    task: Task,
    space: Parameters,
    z: Float[AnyArray, " z"],
    sigma: Any = None,
    effective: Float[AnyArray, ""] | int | None = None,
    point: PointRows | None = None,
) -> State:
    """The state at a point, whose rows may be known (``point``); ``sigma`` is estimated unless it is given, and
    ``effective`` is how many unknowns the data determine, by default all."""
    point = rows_at(space, task.observed, z) if point is None else point
    # Where a batch needs no weights, nobody asks for errors.
    errors = arm_errors(point, task.observed) if isinstance(point.forward, ForwardPass) else []
    if sigma is None:
        xp = namespace(z, effective)
        spent = z.shape[0] if effective is None else effective
        degrees_of_freedom = xp.maximum(xp.asarray(task.observed.equations - spent, dtype=float), 1.0)
        if task.needs_no_weights:
            squares: Any = sum(xp.sum(part.values**2) for part in point.rows)
            sigma = root_of_sum(squares / degrees_of_freedom)
        else:
            scatter = scatter_of if task.loss is None else robust_scatter_of
            sigma = scatter(point.rows, errors, degrees_of_freedom)
    return State(point, errors, sigma)


def whitening_at(task: Task, state: State, prior: PriorRows | None = None) -> Whitening:
    """The weights of everything by the state of a nearly right arm."""
    if task.noise is None:
        of_arm = [covariance_of_sigma(errors, state.sigma) for errors in state.errors]
    else:
        of_arm = [covariance_of_noise(errors, task.noise) for errors in state.errors]
    least = namespace(state.sigma).maximum(_LEAST * state.sigma, 1e-12)
    return whitening_of(state.point.rows, task.observed, of_arm, least)._replace(prior=prior)


def scatter_at_start(task: Task, space: Parameters, z: Float[AnyArray, " z"]) -> Any:
    """Root mean square of the start's residuals in mm, for the first weights."""
    xp = namespace(z, task)
    values = [rows.values[:3] for rows in rows_at(space, task.observed, z).rows]
    flat = xp.concatenate([xp.reshape(value, (-1,)) for value in values])
    return xp.sqrt(xp.mean(flat**2)) + 1e-9
