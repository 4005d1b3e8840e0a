"""Stage 1 (`identify`), both stages (`calibrate`), and the joint solve."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from . import covariance
from .arm import Arm
from .arrays import Numbers, as_array, is_concrete
from .capture import Capture
from .checks import based_on, check_enough, check_fit, check_start, held_length
from .errors import InputError
from .metrics import Repeatability, repeatability
from .parameters import Bounds, Parameters
from .residuals import (
    Measurement,
    joint_model,
    joint_residual,
    measured_lengths,
    repeatability_model,
    repeatability_residual,
)
from .scale import Scale, divide_lengths, scale_and_shares
from .solver import BoundedLevenbergMarquardt, least_squares
from .steps import Reason, numbers_of

# The boxes of this problem are small against its curvature, so the first steps can be nearly Gauss-Newton's.
SOLVER = BoundedLevenbergMarquardt(rtol=1e-13, initial_damping=1e-6)
_MAX_STEPS = 300
_GOOD = [int(reason._value) for reason in (Reason.gradient, Reason.step, Reason.rounding)]  # pyright: ignore


class Identification(eqx.Module):
    """Result of stage 1. A PyTree: under ``eqx.filter_vmap`` every array gains the batch axis.

    ``parameters``, ``active`` and ``covariance`` are in the order of ``space.names``; mm and rad.
    """

    arm: Arm
    parameters: Float[Array, " p"]
    de: Float[Array, ""]  # mean distance from the centroid, mm
    deltam: Float[Array, ""]  # largest half range, mm
    active: Int[Array, " p"]  # -1 on the lower bound, +1 on the upper, 0 inside
    steps: Int[Array, ""]  # evaluations
    result: Reason  # why it ended
    optimality: Float[Array, ""]  # projected gradient as a cosine; 0 at a minimum
    scale: Scale | None  # k of this arm, where the capture holds reference lengths
    covariance: Float[Array, "p p"]  # with the scale as it was held; rows of active and held parameters are 0
    determined: Bool[
        Array, " p"
    ]  # False where only a combination with others is determined; covariance is then that of the rest
    before: Repeatability  # the start
    after: Repeatability
    bounds: Bounds
    hold: str | None = eqx.field(static=True)

    @property
    def space(self) -> Parameters:
        """The free parameters."""
        return self.bounds.space

    @property
    def converged(self) -> Bool[Array | np.ndarray, "*lanes"]:
        """Whether the solve ended at a minimum."""
        return converged(self.result)

    def active_names(self) -> dict[str, str]:
        """Parameters on a bound: name -> 'lower' or 'upper'."""
        return active_names(self.space, self.active)


class Calibration(eqx.Module):
    """Result of both stages, or of the joint solve. ``covariance`` is in the order of ``space.names``; mm and rad."""

    arm: Arm
    parameters: Float[Array, " p"]
    scale: Scale  # k of stage 1, by which its lengths were divided
    de: Float[Array, ""]
    deltam: Float[Array, ""]
    active: Int[Array, " p"]
    steps: Int[Array, ""]
    result: Reason
    covariance: Float[Array, "p p"]
    determined: Bool[Array, " p"]  # False where only a combination with others is determined
    before: Repeatability
    after: Repeatability
    length_before: Float[Array, " l"]  # measured reference lengths, mm: at the start
    length_after: Float[Array, " l"]  # by the calibrated arm
    stage1: Identification
    method: str = eqx.field(static=True)

    @property
    def space(self) -> Parameters:
        """The free parameters."""
        return self.stage1.space

    @property
    def bounds(self) -> Bounds:
        """The box of the identification."""
        return self.stage1.bounds

    @property
    def converged(self) -> Bool[Array | np.ndarray, "*lanes"]:
        """Whether every solve ended at a minimum."""
        both = self.stage1.converged & converged(self.result)
        return np.asarray(both) if is_concrete(both) else both

    def active_names(self) -> dict[str, str]:
        """Parameters on a bound: name -> 'lower' or 'upper'."""
        return active_names(self.space, self.active)


def converged(result: Reason) -> Bool[Array | np.ndarray, "*lanes"]:
    """Whether a reason means that a minimum was reached."""
    number = numbers_of(result)
    good = np.array(_GOOD, dtype=number.dtype)
    return np.asarray(np.isin(np.asarray(number), good)) if is_concrete(number) else jnp.isin(number, good)


def active_names(space: Parameters, active: Numbers) -> dict[str, str]:
    """Parameters on a bound: name -> 'lower' or 'upper'."""
    return {name: "lower" if side < 0 else "upper" for name, side in zip(space.names, np.asarray(active), strict=True) if side}


def identify(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    *,
    hold: str | None = "longest",
    start: Numbers | None = None,
    max_steps: int = _MAX_STEPS,
) -> Identification:
    """Stage 1: the parameters that make the poses of every socket agree, within bounds.

    Minimises the summed squared distance of the tips from their socket's centroid. It starts from ``arm``, or from
    ``start`` ``(p,)``. Repeatability cannot see the scale of the arm, and with noise it is lowered by shrinking it, so one
    length is held meanwhile: ``hold`` names it, "longest" takes the longest free link (none, if a length that matters is held
    anyway), None frees all, as the paper does (then expect active bounds).

    Differentiable with respect to angles and bounds, exactly, also where a bound is active (not in directions that the data
    leave open, such as the scale of noise-free data with nothing held). Failure to converge is
    data (``result``). Raises `InputError` for too few poses, a start outside the box, or names that do not fit.
    """
    return _identify(*_checked(arm, capture, bounds, start), held_length(bounds.space, arm, hold), max_steps)


def _checked(
    arm: Arm, capture: Capture, bounds: Bounds, start: Numbers | None
) -> tuple[Parameters, Measurement, Bounds, Float[Array, " p"]]:
    space = bounds.space
    vector = space.vector(arm) if start is None else as_array(start, "the start")
    check_fit(capture, space)
    check_start(bounds, vector, "the start" if start is not None else "the arm")
    # Repeatability does not see the scale: where lengths are free, it determines one parameter less.
    check_enough(capture.sizes, len(space.names) - int(space.lengths.any()))
    return based_on(space, arm), Measurement.of(capture), bounds, vector


def calibrate(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    *,
    method: Literal["two-stage", "joint"] = "two-stage",
    hold: str | None = "longest",
    start: Numbers | None = None,
    max_steps: int = _MAX_STEPS,
) -> Calibration:
    """Both stages: identify from repeatability, then fix the scale with the reference lengths.

    ``method="joint"`` goes on from there with one least squares of repeatability and lengths together, each weighted by its
    standard deviation: that of a tip coordinate from stage 1's residuals; that of a length from its u and from what the
    scatter of the poses at its ends adds. Raises `InputError` as `identify` does, and without a reference length.
    """
    if method not in ("two-stage", "joint"):
        raise InputError(f"method is '{method}'; it must be 'two-stage' or 'joint'.")
    if not capture.lengths:
        raise InputError(
            "the capture holds no reference length, so the scale cannot be fixed; add one between two sockets (or, from Python, identify for stage 1 alone)."
        )
    return _calibrate(*_checked(arm, capture, bounds, start), held_length(bounds.space, arm, hold), method, max_steps)


@eqx.filter_jit
def _identify(
    space: Parameters, measurement: Measurement, bounds: Bounds, start: Array, hold: str | None, max_steps: int
) -> Identification:
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
        max_steps=max_steps,
        throw=False,
    )
    parameters = start.at[index].set(solution.value)
    identified = space.arm(parameters)
    tips = identified.position(measurement.q)
    after = repeatability(tips, measurement.sizes, fitted=int(kept.sum()))
    active = jnp.where(jnp.asarray(kept), bounds.active(parameters), 0)
    fixed = (active != 0) | ~jnp.asarray(kept)
    spread = covariance.of_parameters(space, measurement, parameters, fixed, after.sigma)
    return Identification(
        arm=identified,
        parameters=parameters,
        de=after.de,
        deltam=after.deltam,
        active=active,
        steps=solution.stats["num_steps"],
        result=solution.stats["reason"],
        optimality=solution.stats["optimality"],
        scale=_scale(tips, measurement, space, parameters, spread, after.sigma) if measurement.ends else None,
        covariance=spread.matrix,
        determined=spread.determined,
        before=repeatability(space.arm(start).position(measurement.q), measurement.sizes),
        after=after,
        bounds=bounds,
        hold=hold,
    )


def _scale(
    tips: Array, measurement: Measurement, space: Parameters, parameters: Array, spread: covariance.Covariance, sigma: Array
) -> Scale:
    """k with an uncertainty that holds that of the identified parameters too."""
    scale, by_lengths = scale_and_shares(tips, measurement, sigma)
    by_parameters = by_lengths @ measured_lengths(parameters, space, measurement)[1]
    u = jnp.sqrt(by_parameters @ spread.matrix @ by_parameters + scale.u**2)
    return eqx.tree_at(lambda s: s.u, scale, u)


@eqx.filter_jit
def _calibrate(
    space: Parameters, measurement: Measurement, bounds: Bounds, start: Array, hold: str | None, method: str, max_steps: int
) -> Calibration:
    stage1 = _identify(space, measurement, bounds, start, hold, max_steps)
    assert stage1.scale is not None
    arm, k = space.arm(start), stage1.scale.value
    space = stage1.space
    if method == "joint":
        calibrated, parameters, active, steps, result, spread = _joint(arm, measurement, stage1, max_steps)
    else:
        calibrated = divide_lengths(stage1.arm, k)
        parameters, active, steps, result = space.vector(calibrated), stage1.active, stage1.steps, stage1.result
        spread = _divided(measurement, stage1, parameters)
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
        covariance=spread.matrix,
        determined=spread.determined,
        before=stage1.before,
        after=after,
        length_before=measurement.distances(arm.position(measurement.q)),
        length_after=measurement.distances(tips),
        stage1=stage1,
        method=method,
    )


def _divided(measurement: Measurement, stage1: Identification, parameters: Array) -> covariance.Covariance:
    """Covariance after the division by k."""
    assert stage1.scale is not None
    tips = stage1.arm.position(measurement.q)
    space = Parameters(stage1.arm, stage1.space.names)
    scale, by_lengths = scale_and_shares(tips, measurement, stage1.after.sigma)
    by_parameters = by_lengths @ measured_lengths(stage1.parameters, space, measurement)[1]
    before = covariance.Covariance(stage1.covariance, stage1.determined)
    return covariance.after_division(before, by_parameters, scale.u**2, space, parameters, scale.value)


def _joint(
    arm: Arm, measurement: Measurement, stage1: Identification, max_steps: int
) -> tuple[Arm, Array, Array, Array, Reason, covariance.Covariance]:
    """One weighted least squares of poses and lengths, from the two-stage result; held parameters stay as given."""
    assert stage1.scale is not None
    space, k = Parameters(arm, stage1.space.names), stage1.scale.value
    scaled = divide_lengths(stage1.arm, k)
    sigma = jnp.maximum(stage1.after.sigma / k, covariance.LEAST_SIGMA)
    centroids = measurement.centroids(scaled.position(measurement.q))
    spread = covariance.length_covariance(centroids, measurement, sigma)
    whitening = jnp.linalg.inv(jnp.linalg.cholesky(spread))
    solution = least_squares(
        joint_residual,
        space.vector(scaled),
        (space, measurement, sigma, whitening),
        lower=stage1.bounds.lower,
        upper=stage1.bounds.upper,
        scale=space.scale,
        normal=joint_model,
        solver=SOLVER,
        max_steps=max_steps,
        throw=False,
    )
    stats, active = solution.stats, stage1.bounds.active(solution.value)
    found = covariance.of_parameters(space, measurement, solution.value, active != 0, sigma, whitening)
    steps = stage1.steps + stats["num_steps"]
    return space.arm(solution.value), solution.value, active, steps, stats["reason"], found
