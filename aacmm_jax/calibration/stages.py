"""Stage 1 (`identify`), both stages (`calibrate`), and the joint solve."""

import warnings
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core._compat import inside_trace
from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import IdentifiabilityWarning, InputError
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm, is_single
from ..kinematics.parameters import Bounds, Parameters
from ..model.measurement import Measurement, check_joints
from ..model.metrics import repeatability
from ..model.residuals import joint_model, joint_residual, repeatability_model, repeatability_residual
from ..model.scale import divide_lengths
from ..solver.bounded import BoundedLevenbergMarquardt, least_squares
from ..solver.reason import Reason
from ..uncertainty import propagation
from ..uncertainty.covariance import NoiseModel, ParameterCovariance, residual_degrees_of_freedom
from ..uncertainty.identifiability import observability
from .checks import based_on, check_enough, check_noise_model, check_start
from .results import Calibration, Identification
from .scale_anchor import scale_anchor

# The boxes of this problem are small against its curvature, so the first steps can be nearly Gauss-Newton's.
SOLVER = BoundedLevenbergMarquardt(rtol=1e-13, initial_damping=1e-6)
_MAX_STEPS = 300


def identify(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    *,
    hold: str | None = "longest",
    start: Numbers | None = None,
    noise: Noise | None = None,
    noise_model: NoiseModel | None = None,
    max_steps: int = _MAX_STEPS,
) -> Identification:
    """Stage 1: the parameters that make the poses of every socket agree, within bounds.

    Minimises the summed squared distance of the tips from their socket's centroid. It starts from ``arm``, or from
    ``start`` ``(p,)``. Repeatability cannot see the scale of the arm, and with noise it is lowered by shrinking it, so one
    length is held meanwhile: ``hold`` names it, "longest" takes the longest free link (none, if a length that matters is held
    anyway), None frees all, as the paper does (then expect active bounds).

    Where the ``noise`` of readings and seat is known, every pose is weighed by the inverse covariance of its tip, and the
    covariance of the result follows from it; else both standard deviations are estimated from the residuals. ``form`` takes
    another view of the errors (`covariance.FORMS`).

    Differentiable with respect to angles and bounds, exactly, also where a bound is active (not in directions that the data
    leave open, such as the scale of noise-free data with nothing held). Failure to converge is
    data (``result``). Raises `InputError` for too few poses, a start outside the box, or names that do not fit.
    """
    return _identify(_checked(arm, capture, bounds, start, noise, hold, noise_model, max_steps))


def _checked(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    start: Numbers | None,
    noise: Noise | None,
    hold: str | None,
    noise_model: NoiseModel | None,
    max_steps: int,
) -> "_Task":
    space = bounds.space
    vector = space.vector(arm) if start is None else as_array(start, "the start")
    check_joints(capture, space)
    check_start(bounds, vector, "the start" if start is not None else "the arm")
    # Repeatability does not see the scale: where lengths are free, it determines one parameter less.
    check_enough(capture.sizes, len(space.names) - int(space.lengths.any()))
    noise_model = check_noise_model(noise_model, noise, arm.joints)
    hold = scale_anchor(space, arm, hold)
    return _Task(based_on(space, arm), Measurement.of(capture), bounds, vector, noise, hold, noise_model, max_steps)


def calibrate(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    *,
    method: Literal["two-stage", "joint"] = "two-stage",
    hold: str | None = "longest",
    start: Numbers | None = None,
    noise: Noise | None = None,
    noise_model: NoiseModel | None = None,
    strict: bool = False,
    max_steps: int = _MAX_STEPS,
) -> Calibration:
    """Both stages: identify from repeatability, then fix the scale with the reference lengths.

    ``method="joint"`` goes on from there with one least squares of repeatability and lengths together, each weighted by its
    standard deviation: that of a tip coordinate from stage 1's residuals; that of a length from its u and from what the
    scatter of the poses at its ends adds. ``noise`` and ``form`` are as in `identify`.

    Raises `InputError` as `identify` does, and without a reference length. Free parameters that these data cannot determine
    are an `IdentifiabilityWarning` that names them and says what would determine them; with ``strict`` an `InputError`.
    """
    if method not in ("two-stage", "joint"):
        raise InputError(f"method is '{method}'; it must be 'two-stage' or 'joint'.")
    if not capture.lengths:
        raise InputError(
            "the capture holds no reference length, so the scale cannot be fixed; add one between two sockets (or, from Python, identify for stage 1 alone)."
        )
    task = _checked(arm, capture, bounds, start, noise, hold, noise_model, max_steps)
    _check_identifiable(arm, capture, bounds, strict)
    return _calibrate(task, method)


def _check_identifiable(arm: Arm, capture: Capture, bounds: Bounds, strict: bool) -> None:
    """Warn of, or with ``strict`` refuse, free parameters that these data cannot determine; traced values are not looked at."""
    if not is_single(arm) or inside_trace() or not is_concrete(*jax.tree.leaves((arm, capture, bounds))):
        return
    sentences = observability(arm, capture, bounds.space).sentences()
    if sentences and strict:
        raise InputError(" ".join(sentences))
    for sentence in sentences:
        warnings.warn(sentence, IdentifiabilityWarning, stacklevel=3)


class _Task(NamedTuple):
    """An identification, checked."""

    space: Parameters
    measurement: Measurement
    bounds: Bounds
    start: Float[Array, " p"]
    noise: Noise | None
    hold: str | None
    noise_model: NoiseModel
    max_steps: int


@eqx.filter_jit
def _identify(task: _Task) -> Identification:
    return _stage1(task)[0]


def _stage1(task: _Task) -> tuple[Identification, propagation.Propagated]:
    space, bounds, start, hold = task.space, task.bounds, task.start, task.hold
    measurement = task.measurement.weighted(space.arm(start).geometry, task.noise)
    kept = np.array([name != hold for name in space.names])
    index = jnp.asarray(np.flatnonzero(kept))
    reduced = Parameters(base=space.arm(start), names=tuple(name for name in space.names if name != hold))
    solution = least_squares(
        repeatability_residual,
        start[index],
        (reduced, measurement),
        lower=bounds.lower[index],
        upper=bounds.upper[index],
        scale=reduced.scale,
        normal=repeatability_model,
        solver=SOLVER,
        max_steps=task.max_steps,
        throw=False,
    )
    parameters = start.at[index].set(solution.value)
    identified = space.arm(parameters)
    tips = identified.position(measurement.q)
    after = repeatability(tips, measurement.sizes, fitted=int(kept.sum()))
    active = jnp.where(jnp.asarray(kept), bounds.active(parameters), 0)
    fixed = (active != 0) | ~jnp.asarray(kept)
    propagated = propagation.propagate_solve(identified, space, measurement, fixed, after.sigma, task.noise_model, task.noise)
    identification = Identification(
        arm=identified,
        parameters=parameters,
        de=after.de,
        deltam=after.deltam,
        active=active,
        steps=solution.stats["num_steps"],
        result=solution.stats["reason"],
        optimality=solution.stats["optimality"],
        scale=propagation.propagated_scale(tips, measurement, propagated, after.sigma) if measurement.ends else None,
        parameter_covariance=propagated.parameter_covariance,
        before=repeatability(space.arm(start).position(measurement.q), measurement.sizes),
        after=after,
        reduced_chi=_reduced_chi(measurement, tips, int(kept.sum())),
        bounds=bounds,
        hold=hold,
        noise_model=task.noise_model,
        degrees_of_freedom=residual_degrees_of_freedom(task.noise_model, measurement.sizes, int(kept.sum())),
    )
    return identification, propagated


def _reduced_chi(measurement: Measurement, tips: Float[Array, "N 3"], fitted: int) -> Float[Array, ""] | None:
    if measurement.weights is None:
        return None
    degrees_of_freedom = max(3 * sum(size - 1 for size in measurement.sizes) - fitted, 1)
    return jnp.sqrt(jnp.sum(measurement.whitened(measurement.centred(tips)) ** 2) / degrees_of_freedom)


@eqx.filter_jit
def _calibrate(task: _Task, method: str) -> Calibration:
    stage1, propagated = _stage1(task)
    assert stage1.scale is not None
    space, k = task.space, stage1.scale.value
    arm = space.arm(task.start)
    measurement = task.measurement.weighted(arm.geometry, task.noise)
    if method == "joint":
        calibrated, parameters, active, steps, result, parameter_covariance = _joint(arm, stage1, task)
    else:
        calibrated = divide_lengths(stage1.arm, k)
        parameters, active, steps, result = space.vector(calibrated), stage1.active, stage1.steps, stage1.result
        sigma = stage1.after.sigma
        parameter_covariance = propagation.propagate_division(
            propagated, stage1.arm, space, measurement, sigma, parameters
        ).parameter_covariance
    tips = calibrated.position(measurement.q)
    after = repeatability(tips, measurement.sizes, fitted=len(space.names))
    return Calibration(
        arm=calibrated,
        parameters=parameters,
        scale=stage1.scale,
        de=after.de,
        deltam=after.deltam,
        active=active,
        steps=steps,
        result=result,
        parameter_covariance=parameter_covariance,
        before=stage1.before,
        after=after,
        length_before=measurement.distances(arm.position(measurement.q)),
        length_after=measurement.distances(tips),
        stage1=stage1,
        method=method,
    )


def _joint(arm: Arm, stage1: Identification, task: _Task) -> tuple[Arm, Array, Array, Array, Reason, ParameterCovariance]:
    """One weighted least squares of poses and lengths, from the two-stage result; held parameters stay as given."""
    assert stage1.scale is not None
    space, k = Parameters(arm, stage1.space.names), stage1.scale.value
    scaled = divide_lengths(stage1.arm, k)
    measurement = task.measurement.weighted(scaled.geometry, task.noise)
    joint_weights = propagation.joint_weights(scaled, measurement, stage1.after.sigma / k)
    solution = least_squares(
        joint_residual,
        space.vector(scaled),
        (space, measurement, joint_weights.sigma, joint_weights.whitening),
        lower=stage1.bounds.lower,
        upper=stage1.bounds.upper,
        scale=space.scale,
        normal=joint_model,
        solver=SOLVER,
        max_steps=task.max_steps,
        throw=False,
    )
    stats, active = solution.stats, stage1.bounds.active(solution.value)
    found = space.arm(solution.value)
    sigma = stage1.after.sigma / k
    parameter_covariance = propagation.propagate_solve(
        found, space, measurement, active != 0, sigma, task.noise_model, task.noise, joint_weights
    ).parameter_covariance
    return found, solution.value, active, stage1.steps + stats["num_steps"], stats["reason"], parameter_covariance
