"""Stage 1 (`identify`), both stages (`calibrate`), and the joint solve."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .arm import Arm, locate
from .arrays import Numbers, as_array, is_concrete
from .capture import Capture
from .errors import InputError
from .metrics import Repeatability, repeatability
from .parameters import Bounds, Parameters, is_length
from .residuals import (
    Measurement,
    joint_model,
    joint_residual,
    measured_lengths,
    repeatability_model,
    repeatability_residual,
)
from .scale import Scale, divide_lengths, scale_of
from .solver import BoundedLevenbergMarquardt, least_squares
from .steps import Reason

# The boxes of this problem are small against its curvature, so the first steps can be nearly Gauss-Newton's.
_SOLVER = BoundedLevenbergMarquardt(initial_damping=1e-6)
_MAX_STEPS = 300
# Standard deviations (mm) below which noise-free data would get infinite weight.
_LEAST_SIGMA = 1e-9


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
    def converged(self) -> Array:
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
    def converged(self) -> Array:
        """Whether every solve ended at a minimum."""
        return self.stage1.converged & converged(self.result)

    def active_names(self) -> dict[str, str]:
        """Parameters on a bound: name -> 'lower' or 'upper'."""
        return active_names(self.space, self.active)


def converged(result: Reason) -> Array:
    """Whether a reason means that a minimum was reached."""
    return (result == Reason.gradient) | (result == Reason.step) | (result == Reason.rounding)


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
    length is held meanwhile: ``hold`` names it, "longest" takes the longest free link, None frees all, as the paper does
    (then expect active bounds).

    Differentiable with respect to angles, bounds and start, exactly, also where a bound is active. Failure to converge is
    data (``result``). Raises `InputError` for too few poses, a start outside the box, or names that do not fit.
    """
    space = bounds.space
    vector = space.vector(arm) if start is None else as_array(start, "the start")
    hold = _held_length(space, hold)
    _check_fit(capture, space)
    _check_start(bounds, vector, "the start" if start is not None else "the arm")
    # Repeatability does not see the scale: where lengths are free, it determines one parameter less.
    _check_enough(capture, len(space.names) - int(space.lengths.any()))
    return _identify(_based_on(space, arm), Measurement.of(capture), bounds, vector, hold, max_steps)


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
    stage1 = identify(arm, capture, bounds, hold=hold, start=start, max_steps=max_steps)
    measurement = Measurement.of(capture)
    if start is not None:
        arm = bounds.space.arm(start)
    return _finish(arm, measurement, stage1, method, max_steps)


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
        solver=_SOLVER,
        max_steps=max_steps,
        throw=False,
    )
    parameters = start.at[index].set(solution.value)
    identified = space.arm(parameters)
    tips = identified.position(measurement.q)
    after = repeatability(tips, measurement.sizes, fitted=int(kept.sum()))
    active = jnp.where(jnp.asarray(kept), bounds.active(parameters), 0)
    fixed = (active != 0) | ~jnp.asarray(kept)
    covariance, determined = _covariance(space, measurement, parameters, fixed, after.sigma, with_lengths=False)
    return Identification(
        arm=identified,
        parameters=parameters,
        de=after.de,
        deltam=after.deltam,
        active=active,
        steps=solution.stats["num_steps"],
        result=solution.stats["reason"],
        optimality=solution.stats["optimality"],
        scale=scale_of(identified, measurement) if measurement.ends else None,
        covariance=covariance,
        determined=determined,
        before=repeatability(space.arm(start).position(measurement.q), measurement.sizes),
        after=after,
        bounds=bounds,
        hold=hold,
    )


@eqx.filter_jit
def _finish(arm: Arm, measurement: Measurement, stage1: Identification, method: str, max_steps: int) -> Calibration:
    space = stage1.space
    assert stage1.scale is not None
    scaled = divide_lengths(stage1.arm, stage1.scale.value)
    parameters, active, steps, result = space.vector(scaled), stage1.active, stage1.steps, stage1.result
    if method == "joint":
        parameters, active, more, result = _joint(scaled, measurement, stage1, max_steps)
        steps = steps + more
        scaled = Parameters(scaled, space.names).arm(parameters)
    tips = scaled.position(measurement.q)
    after = repeatability(tips, measurement.sizes, fitted=len(space.names))
    covariance, determined = _covariance(
        space, measurement, parameters, active != 0, after.sigma, with_lengths=True, base=scaled
    )
    return Calibration(
        arm=scaled,
        parameters=parameters,
        scale=stage1.scale,
        de=after.de,
        deltam=after.deltam,
        active=active,
        steps=steps,
        result=result,
        covariance=covariance,
        determined=determined,
        before=stage1.before,
        after=after,
        length_before=measurement.distances(arm.position(measurement.q)),
        length_after=measurement.distances(tips),
        stage1=stage1,
        method=method,
    )


def _joint(scaled: Arm, measurement: Measurement, stage1: Identification, max_steps: int) -> tuple[Array, Array, Array, Reason]:
    space = Parameters(scaled, stage1.space.names)
    assert stage1.scale is not None
    sigma = jnp.maximum(jax.lax.stop_gradient(stage1.after.sigma / stage1.scale.value), _LEAST_SIGMA)
    solution = least_squares(
        joint_residual,
        space.vector(scaled),
        (space, measurement, sigma, _length_sigma(measurement, sigma)),
        lower=stage1.bounds.lower,
        upper=stage1.bounds.upper,
        scale=space.scale,
        normal=joint_model,
        solver=_SOLVER,
        max_steps=max_steps,
        throw=False,
    )
    stats = solution.stats
    return solution.value, stage1.bounds.active(solution.value), stats["num_steps"], stats["reason"]


def _length_sigma(measurement: Measurement, sigma: Float[Array, ""]) -> Float[Array, " l"]:
    """Standard deviation of measured minus nominal length: u, and the scatter of the poses at both ends; mm."""
    return jnp.sqrt(measurement.u**2 + sigma**2 * jnp.asarray(measurement.averaging_variance()))


def _covariance(
    space: Parameters,
    measurement: Measurement,
    parameters: Array,
    fixed: Array,
    sigma: Array,
    *,
    with_lengths: bool,
    base: Arm | None = None,
) -> tuple[Float[Array, "p p"], Bool[Array, " p"]]:
    """Covariance of the free parameters on the identifiable subspace: inverse of J^T W J (JCGM 100; see GUM 5.2).

    Weights are the residual variance and, ``with_lengths``, the variance of each reference length. Directions that the
    data do not determine are left out, and so are ``fixed`` parameters; their rows are 0. Second: which parameters have no
    part in an undetermined direction.
    """
    space = space if base is None else Parameters(base, space.names)
    sigma = jnp.maximum(sigma, _LEAST_SIGMA)
    information = repeatability_model(parameters, (space, measurement)).gram / sigma**2
    if with_lengths:
        rows = measured_lengths(parameters, space, measurement)[1] / _length_sigma(measurement, sigma)[:, None]
        information = information + rows.T @ rows
    scale = jnp.where(fixed, 0.0, space.scale)
    values, vectors = jnp.linalg.eigh(scale[:, None] * information * scale[None, :])
    known = values > 1e-12 * values[-1]
    inverse = jnp.where(known, 1 / jnp.where(known, values, 1.0), 0.0)
    spread = scale[:, None] * vectors
    determined = fixed | (jnp.sum(jnp.where(known[None, :], 0.0, vectors**2), axis=1) < 1e-6)
    return (spread * inverse[None, :]) @ spread.T, determined


def _based_on(space: Parameters, arm: Arm) -> Parameters:
    """The free parameters on the given arm: held values come from the arm that is calibrated, not from the space's base."""
    if arm.beta is None and space.base.beta is not None:
        return space
    return Parameters(base=arm, names=space.names)


def _held_length(space: Parameters, hold: str | None) -> str | None:
    lengths = [name for name in space.names if is_length(name)]
    if hold is None or (hold == "longest" and not lengths):
        return None
    if hold != "longest":
        if not is_length(hold) or hold not in lengths:
            space.index(hold)
            raise InputError(f"hold is '{hold}', which is an angle; hold a length, for example '{lengths[0]}'.")
        return hold
    links = [name for name in lengths if not name.startswith("probe")] or lengths
    base = space.base
    if not is_concrete(base.a, base.d, base.probe):
        raise InputError(
            "hold='longest' needs an arm with known values; where the arm itself is traced, name the length to hold."
        )

    # Read with NumPy: under jit even a constant arm's values become tracers once JAX computes with them.
    def nominal(name: str) -> float:
        kind, i = locate(base, name)
        return float(np.abs(np.asarray(getattr(base, kind))[..., i]).max())

    return max(links, key=nominal)


def _check_fit(capture: Capture, space: Parameters) -> None:
    if capture.joints != space.base.joints:
        raise InputError(
            f"the capture has {capture.joints} columns, but the arm has {space.base.joints} joints; give one column a joint."
        )


def _check_start(bounds: Bounds, vector: Array, what: str) -> None:
    if vector.shape != (len(bounds.space.names),):
        raise InputError(
            f"{what} has shape {vector.shape}, but {len(bounds.space.names)} parameters are free; give one value each."
        )
    if not is_concrete(vector, bounds.lower, bounds.upper):
        return
    values, lower, upper = (np.asarray(x) for x in (vector, bounds.lower, bounds.upper))
    outside = ~((values >= lower) & (values <= upper))
    if outside.any():
        i = int(np.flatnonzero(outside)[0])
        raise InputError(
            f"{what} is outside the bounds: {bounds.space.names[i]} is {values[i]:g}, not within {lower[i]:g} to {upper[i]:g}; "
            "move the start or widen the bounds."
        )


def _check_enough(capture: Capture, unknowns: int) -> None:
    """A socket of m poses gives 3 (m - 1) equations: its own position takes three."""
    equations = 3 * sum(size - 1 for size in capture.sizes)
    if equations < unknowns:
        sockets, poses = len(capture.sizes), sum(capture.sizes)
        needed = -(-unknowns // 3) + sockets
        raise InputError(
            f"{poses} poses in {sockets} socket{'s' if sockets > 1 else ''} give {equations} equations, but {unknowns} unknowns "
            f"need at least {needed} poses; record more poses or hold more parameters."
        )
