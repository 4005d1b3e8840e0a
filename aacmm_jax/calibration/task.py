"""One identification, checked, and the least squares of its repeatability that both stages share."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ..data.noise import Noise
from ..kinematics.parameters import Bounds, Parameters
from ..model.measurement import Measurement
from ..model.residuals import repeatability_model, repeatability_residual
from ..solver.bounded import BoundedLevenbergMarquardt, least_squares
from ..uncertainty.covariance import NoiseModel
from .scale_anchor import ScaleAnchor

# The boxes of this problem are small against its curvature, so the first steps can be nearly Gauss-Newton's.
SOLVER = BoundedLevenbergMarquardt(rtol=1e-13, initial_damping=1e-6)


class Task(NamedTuple):
    """An identification, checked; the space of its bounds is based on the arm that is calibrated."""

    measurement: Measurement
    bounds: Bounds
    start: Float[Array, " p"]
    noise: Noise | None
    anchor: ScaleAnchor
    noise_model: NoiseModel
    max_steps: int

    @property
    def space(self) -> Parameters:
        """The free parameters, and the fixed ones of the arm."""
        return self.bounds.space


def fit_repeatability(
    task: Task, measurement: Measurement, start: Float[Array, " p"], hold: str | None
) -> tuple[Float[Array, " p"], optx.Solution]:
    """Stage 1's least squares within bounds, with one parameter kept at its start; the parameters and how it ended."""
    space = task.space
    index = jnp.asarray(np.flatnonzero([name != hold for name in space.names]))
    reduced = Parameters(base=space.arm(start), names=tuple(name for name in space.names if name != hold))
    solution = least_squares(
        repeatability_residual,
        start[index],
        (reduced, measurement),
        lower=task.bounds.lower[index],
        upper=task.bounds.upper[index],
        scale=reduced.scale,
        normal=repeatability_model,
        solver=SOLVER,
        max_steps=task.max_steps,
        throw=False,
    )
    return start.at[index].set(solution.value), solution
