"""One identification, checked, and the least squares that both stages and the joint solve share."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.numpy_or_jax import AnyArray, namespace, set_at
from ..data.noise import Noise
from ..kinematics.parameters import Bounds, Parameters
from ..model.measurement import Measurement
from ..model.residuals import repeatability_normal_equations, repeatability_residual
from ..solver.levenberg_marquardt import Rules, minimise
from ..solver.reason import Reason, reasons
from ..uncertainty.covariance import NoiseModel
from .scale_anchor import ScaleAnchor

# The boxes of this problem are small against its curvature, so the first steps can be nearly Gauss-Newton's.
RULES = Rules(rtol=1e-13, initial_damping=1e-6)


class Task(NamedTuple):
    """An identification, checked; the space of its bounds is based on the arm that is calibrated."""

    measurement: Measurement
    bounds: Bounds
    start: Float[AnyArray, " p"]
    noise: Noise | None
    anchor: ScaleAnchor
    noise_model: NoiseModel
    max_steps: int

    @property
    def space(self) -> Parameters:
        """The free parameters, and the fixed ones of the arm."""
        return self.bounds.space


class Fit(NamedTuple):
    """Result of one least squares."""

    parameters: Float[AnyArray, " p"]
    steps: Int[AnyArray, ""]  # evaluations
    result: Reason
    optimality: Float[AnyArray, ""]


def fit(
    residual: Callable,
    normal: Callable,
    start: Float[AnyArray, " p"],
    args: Any,
    bounds: tuple[Float[AnyArray, " p"], Float[AnyArray, " p"]],
    scale: Float[AnyArray, " p"],
    max_steps: int,
    *,
    rules: Rules = RULES,
    differentiable: bool = True,
) -> Fit:
    """A least squares within bounds: by Optimistix for arrays of JAX, unless no derivative is needed; else by its bare
    steps."""
    lower, upper = bounds
    if not differentiable or namespace(start, args, bounds) is np:
        last = minimise(normal, start, args, lower=lower, upper=upper, scale=scale, rules=rules, max_steps=max_steps)
        return Fit(last.y, last.steps, reasons(last.reason), last.optimality)
    # Optimistix takes 0.2 s to import, and NumPy needs none of it.
    from ..solver.bounded import BoundedLevenbergMarquardt, least_squares

    solution = least_squares(
        residual,
        start,
        args,
        lower=lower,
        upper=upper,
        scale=scale,
        normal=normal,
        solver=BoundedLevenbergMarquardt(**rules._asdict()),
        max_steps=max_steps,
        throw=False,
    )
    stats = solution.stats
    return Fit(solution.value, stats["num_steps"], stats["reason"], stats["optimality"])


def fit_repeatability(task: Task, measurement: Measurement, start: Float[AnyArray, " p"], hold: str | None) -> Fit:
    """Stage 1's least squares within bounds, with one parameter kept at its start."""
    space = task.space
    index = np.flatnonzero([name != hold for name in space.names])
    reduced = Parameters(base=space.arm(start), names=tuple(name for name in space.names if name != hold))
    bounds = task.bounds.lower[index], task.bounds.upper[index]
    functions, args = (repeatability_residual, repeatability_normal_equations), (reduced, measurement)
    found = fit(*functions, start[index], args, bounds, reduced.scale, task.max_steps)
    return found._replace(parameters=set_at(start, index, found.parameters))
