"""One identification, checked, and stage 1's least squares."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, set_at
from ..data.noise import Noise
from ..kinematics.parameters import Bounds, Parameters
from ..model.measurement import Measurement
from ..model.residuals import repeatability_normal_equations, repeatability_residual
from ..uncertainty.covariance import NoiseModel
from .bounded_fit import Fit, fit
from .scale_anchor import ScaleAnchor


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


def fit_repeatability(task: Task, measurement: Measurement, start: Float[AnyArray, " p"], hold: str | None) -> Fit:
    """Stage 1's least squares within bounds, with one parameter kept at its start."""
    space = task.space
    index = np.flatnonzero([name != hold for name in space.names])
    reduced = Parameters(base=space.arm(start), names=tuple(name for name in space.names if name != hold))
    bounds = task.bounds.lower[index], task.bounds.upper[index]
    functions, args = (repeatability_residual, repeatability_normal_equations), (reduced, measurement)
    found = fit(*functions, start[index], args, bounds, reduced.scale, task.max_steps)
    return found._replace(parameters=set_at(start, index, found.parameters))
