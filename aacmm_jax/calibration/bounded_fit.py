"""The least squares within bounds that both stages, the joint solve and observations share."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.numpy_or_jax import AnyArray, namespace
from ..solver.levenberg_marquardt import Rules, minimise
from ..solver.reason import Reason, reasons

# The boxes of this problem are small against its curvature, so the first steps can be nearly Gauss-Newton's.
RULES = Rules(rtol=1e-13, initial_damping=1e-8)
# Of solves that begin where one with nearly the same weights ended: damping would shorten steps that are right.
NEAR = RULES._replace(initial_damping=1e-11)


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
