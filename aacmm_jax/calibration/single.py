"""Stage 1 (`identify`), both stages (`calibrate`), and the joint solve."""

import warnings
from functools import partial
from typing import Literal

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core._compat import inside_trace
from ..core.arguments import check_finite, checked_arguments
from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import IdentifiabilityWarning, InputError
from ..core.numpy_or_jax import AnyArray, compiled, namespace, to_jax, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, based_on
from ..kinematics.priors import Prior
from ..model.loss_names import LossName
from ..model.measurement import Measurement, check_joints
from ..model.metrics import repeatability
from ..model.residuals import JointWeights, joint_normal_equations, joint_residual
from ..uncertainty import propagation, scale_uncertainty
from ..uncertainty.active_bounds import with_active_bounds
from ..uncertainty.covariance import NoiseModel, ParameterCovariance, residual_degrees_of_freedom
from .bounded_fit import Fit, fit
from .checks import check_enough, check_identifiable, check_method, check_noise_model, check_single, check_start
from .encoder_noise import with_noise_by_joint
from .joint_model import with_joint_model
from .observed import calibrate_observed, identify_observed
from .observed_state import observed_task
from .results import Calibration, Identification
from .scale_anchor import default_method, scale_anchor, scale_from_slides, warn_of_a_known_scale
from .second_stage import adjust_anchor, clip_to_bounds, divide_by_k, must_adjust_anchor
from .sensitivities import sensitivities_of_observations, sensitivities_of_sockets
from .shared_errors import with_shared_errors
from .task import Task, fit_repeatability

_MAX_STEPS = 300


@checked_arguments
def identify(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    *,
    hold: str | None = "longest",
    start: Numbers | None = None,
    noise: Noise | None = None,
    noise_model: NoiseModel | None = None,
    robust: LossName | None = None,
    prior: Prior | None = None,
    replace_noise: bool = True,
    max_steps: int = _MAX_STEPS,
) -> Identification:
    """Stage 1: the parameters that make the poses of every socket agree, within bounds.

    Minimises the summed squared distance of the tips from their socket's centroid (Cheng et al. 2018, section 2.2).
    Repeatability does not determine the scale of the arm, and noise makes it shrink, so one length, the scale anchor,
    is kept at its start.

    Differentiable with respect to angles, bounds and the arm, exactly, also where a bound is active (not in directions
    that the data leave open, such as the scale of noise-free data without an anchor). Failure to converge is data
    (``result``).

    Args:
        arm: the arm to identify; its values are the start, and the fixed parameters stay as it has them.
        capture: joint readings by socket, rad, or mm of prismatic joints.
        bounds: box of the free parameters ``(p,)``, mm and rad.
        hold: the scale anchor. A free length by name; "longest", the longest free link, or none where fixed lengths or
            the slides of prismatic joints determine the scale well; None, no anchor, as in the paper (then expect
            active bounds).
        start: free parameters ``(p,)`` to start from instead of the arm's, mm and rad.
        noise: standard deviations of readings and seat. Where given, every pose is weighted by the inverse covariance
            of its tip, and the covariance of the result follows from it; else both are estimated from the residuals.
        noise_model: another model of the tips' errors, one of `uncertainty.covariance.NOISE_MODELS`.
        robust: a robust loss, "huber", "cauchy" or "tukey", of each pose's whitened residual; None, least squares.
        prior: what is known of the parameters, as a mean (by default ``arm``'s values) and a standard deviation. It
            weighs against the data, whose noise is given or estimated; bounds hold as well. The scale anchor has none.
        replace_noise: where the residuals show that some encoders are noisier than given, or than the others, solve
            once more with their noise as estimated (``noisy_encoders`` of the result). Not inside jit, vmap or a
            derivative, in batches, with a robust loss, or where ``noise_model`` is named.
        max_steps: most evaluations of the residual.

    Returns:
        Parameters, repeatability, active bounds, covariance, and why the solve ended.

    Raises:
        InputError: too few poses, a start outside the box, names that do not fit, or a batch (see `identify_many`).

    Example:
        >>> stage1 = aj.identify(arm, capture, bounds)
        >>> print(f"scale anchor {stage1.hold}, DE {stage1.de:.4f} mm")
        scale anchor d_3, DE 0.0124 mm
    """
    if capture.observations or robust is not None or prior is not None:
        check_single(arm, capture, bounds, "identify_many")
        check_finite(arm=arm, capture=capture, noise=noise)
        alone = eqx.tree_at(lambda c: c.lengths, capture, (), is_leaf=lambda leaf: isinstance(leaf, tuple))
        task = observed_task(arm, alone, bounds, start, noise, hold, noise_model, max_steps, robust, prior)
        result = to_jax(identify_observed(to_numpy(task)))
    else:
        task = _prepare_task(arm, capture, bounds, start, noise, hold, noise_model, max_steps, "identify_many")
        result = to_jax(_identify(to_numpy(task)))
    if not replace_noise or noise_model in ("common", "robust") or robust is not None:
        return result
    options = {"hold": hold, "start": start, "prior": prior, "max_steps": max_steps, "replace_noise": False}
    return with_noise_by_joint(result, capture, lambda found: identify(arm, capture, bounds, noise=found, **options))


def _prepare_task(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    start: Numbers | None,
    noise: Noise | None,
    hold: str | None,
    noise_model: NoiseModel | None,
    max_steps: int,
    many: str,
) -> Task:
    check_single(arm, capture, bounds, many)
    for sentence in () if inside_trace() else capture.repeated.sentences():
        warnings.warn(sentence, IdentifiabilityWarning, stacklevel=4)
    check_finite(arm=arm, capture=capture, noise=noise)
    space = based_on(bounds.space, arm)
    bounds = Bounds(space, bounds.lower, bounds.upper)
    vector = space.vector() if start is None else as_array(start, "the start")
    if max_steps < 1:
        raise InputError(f"max_steps is {max_steps}; give at least 1.")
    check_joints(capture, space)
    check_start(bounds, vector, "the start" if start is not None else "the arm")
    # Repeatability does not determine the scale: where lengths are free, it determines one parameter less.
    check_enough(capture.sizes, len(space.names) - int(space.lengths.any()))
    noise_model = check_noise_model(noise_model, noise, arm.joints)
    anchor = scale_anchor(space, space.base, hold, noise, capture)
    return Task(Measurement.of(capture, space.base), bounds, vector, noise, anchor, noise_model, max_steps)


@checked_arguments
def calibrate(
    arm: Arm,
    capture: Capture,
    bounds: Bounds | None = None,
    *,
    model: str | None = None,
    method: Literal["two-stage", "joint"] | None = None,
    hold: str | None = "longest",
    start: Numbers | None = None,
    noise: Noise | None = None,
    noise_model: NoiseModel | None = None,
    robust: LossName | None = None,
    prior: Prior | None = None,
    replace_noise: bool = True,
    shared_errors: bool = True,
    check_identifiability: bool = True,
    strict: bool = False,
    max_steps: int = _MAX_STEPS,
) -> Calibration:
    """Both stages: identify from repeatability, then fix the scale with the reference lengths.

    "two-stage" divides the arm of stage 1 by k = measured / nominal. Fixed parameters stay as they are, to the bit, and
    the result is inside the box: where the division cannot give that, stage 1 is repeated with its anchor adjusted
    until k = 1 (`calibration.second_stage`). Where fixed lengths set the scale, k changes nothing, and an
    `IdentifiabilityWarning` says so. The uncertainty of k, ``scale.u``, takes parameters on a bound as exact.

    "joint" goes on from there with one least squares of repeatability and lengths together, each weighted by its
    standard deviation: that of a tip coordinate from stage 1's residuals; that of a length from its u and from the
    scatter of the poses at its ends.

    Args:
        arm: as for `identify`, like all arguments that are not named here.
        capture: sockets, and at least one reference length, mm; none is needed where the slides of prismatic joints
            determine the scale.
        bounds: box of the free parameters ``(p,)``, mm and rad; by default around those that such data determine.
        model: what the joints do besides their readings, as on the command line: "gravity,harmonics=1" (see
            `kinematics.with_corrections`). Corrections that the arm has are replaced; all coefficients are free.
        method: "two-stage" or "joint"; by default two-stage, but joint where the capture has observations besides
            sockets and lengths, the arm has prismatic joints (whose readings say something about the scale too), the
            loss is robust, or there is a prior, which a division by k would ignore.
        hold: the scale anchor of stage 1.
        start: free parameters ``(p,)`` to start from, mm and rad.
        noise: standard deviations of readings and seat.
        noise_model: another model of the tips' errors.
        robust: a robust loss, as for `identify`.
        prior: what is known of the parameters, as for `identify`; of a model, by default `kinematics.default_prior`.
        replace_noise: estimate the noise of encoders that prove noisier, as for `identify`.
        shared_errors: add errors that poses share, as far as residuals show any, to the covariance (`SharedErrors`).
        check_identifiability: warn where free parameters are not determined by these data; the check takes about as
            long as the calibration.
        strict: raise instead of warn where free parameters are not determined by these data.
        max_steps: most evaluations of each solve.

    Returns:
        The calibrated arm and its parameters, k, repeatability, lengths, covariance, and the result of stage 1.

    Raises:
        InputError: as `identify` does, and without a reference length.

    Example:
        >>> calibrated = aj.calibrate(arm, capture, bounds)
        >>> print(f"DE {calibrated.de:.4f} mm, Deltam {calibrated.deltam:.4f} mm, k = {calibrated.scale.value:.5f}")
        DE 0.0124 mm, Deltam 0.0153 mm, k = 0.99923
        >>> error = calibrated.arm.position(q) - true.position(q)
        >>> print(f"{np.abs(arm.position(q) - true.position(q)).max():.2f} mm become {np.abs(error).max():.4f} mm")
        1.80 mm become 0.0032 mm
    """
    arm, bounds, prior = with_joint_model(arm, capture, bounds, model, prior)
    by_slides = scale_from_slides(arm, capture, bounds.space, noise)
    general = bool(capture.observations) or robust is not None or prior is not None or by_slides
    method = default_method(arm, general) if method is None else method
    check_method(method, general)
    if not capture.lengths and not by_slides and not any(one.fixes_scale for one in capture.observations):
        raise InputError(
            "the capture holds no reference length, so the scale cannot be fixed; add one between two sockets, or take "
            "the scale from the nominal arm (--scale nominal; from Python, identify for stage 1 alone)."
        )
    sensitivities = None
    if general:
        check_single(arm, capture, bounds, "calibrate_many")
        check_finite(arm=arm, capture=capture, noise=noise)
        task = observed_task(arm, capture, bounds, start, noise, None, noise_model, max_steps, robust, prior)
        if check_identifiability or strict:
            check_identifiable(capture, task.bounds, prior, strict)
        task = to_numpy(task)
        result = calibrate_observed(task)
        sensitivities = partial(sensitivities_of_observations, task, result)
    else:
        task = _prepare_task(arm, capture, bounds, start, noise, hold, noise_model, max_steps, "calibrate_many")
        if check_identifiability or strict:
            check_identifiable(capture, task.bounds, None, strict)
        result, propagated = _calibrate_sockets(task, method, hold)
        if propagated is not None:
            sensitivities = partial(sensitivities_of_sockets, result, to_numpy(task.measurement), propagated)
    if replace_noise and noise_model not in ("common", "robust") and robust is None:
        options = {"method": method, "hold": hold, "start": start, "prior": prior, "max_steps": max_steps}
        options |= {"check_identifiability": False, "replace_noise": False, "shared_errors": shared_errors}
        found = with_noise_by_joint(
            result, capture, lambda found: calibrate(arm, capture, bounds, noise=found, **options)
        )
        if found is not result:
            return found
    if shared_errors and sensitivities is not None:
        result = with_shared_errors(result, capture, sensitivities)
    return to_jax(result)


def _calibrate_sockets(task: Task, method: str, hold: str | None) -> tuple[Calibration, propagation.Propagated | None]:
    """From sockets and reference lengths alone; and how its covariance was propagated, as far as values are known."""
    arm, bounds = task.space.base, task.bounds
    if hold is None and not is_concrete(*jax.tree.leaves(arm)) and bounds.space.lengths.any():
        raise InputError(
            "hold=None needs an arm with known values in calibrate; where the arm itself is traced, name the length to "
            "hold."
        )
    if method == "two-stage" and not inside_trace():
        warn_of_a_known_scale(task.anchor.set_by, bool(arm.prismatic))
    task = to_numpy(task)
    if method == "joint":
        return _calibrate_jointly(task)
    result, propagated, adjust = _calibrate_by_division(task)
    if not task.anchor.can_scale or (is_concrete(adjust) and not bool(adjust)):
        return result, propagated
    if is_concrete(adjust):
        return _calibrate_by_adjustment(task, result)
    return jax.lax.cond(adjust, lambda: _calibrate_by_adjustment(task, result)[0], lambda: result), None


@compiled(jit=eqx.filter_jit)
def _identify(task: Task) -> Identification:
    return _solve_stage1(task)[0]


def _solve_stage1(task: Task) -> tuple[Identification, propagation.Propagated]:
    xp = namespace(task)
    space, start, hold = task.space, task.start, task.anchor.hold
    measurement = task.measurement.weighted(space.arm(start).geometry, task.noise)
    found = fit_repeatability(task, measurement, start, hold)
    parameters = found.parameters
    kept = np.array([name == hold for name in space.names])
    fitted = int((~kept).sum())
    identified = space.arm(parameters)
    tips = identified.position(measurement.q)
    after = repeatability(tips, measurement.sizes, fitted=fitted)
    active = xp.where(xp.asarray(kept), 0, task.bounds.active(parameters))
    propagated = propagation.propagate_solve(
        identified, space, measurement, (active != 0) | xp.asarray(kept), after.sigma, task.noise_model, task.noise
    )
    identification = Identification(
        arm=identified,
        parameters=parameters,
        de=after.de,
        deltam=after.deltam,
        active=active,
        steps=found.steps,
        result=found.result,
        optimality=found.optimality,
        scale=scale_uncertainty.propagated_scale(tips, measurement, propagated, after.sigma)
        if measurement.ends
        else None,
        parameter_covariance=with_active_bounds(
            propagated.parameter_covariance, identified, space, measurement, active, task.bounds, after.sigma, hold
        ),
        before=repeatability(space.arm(start).position(measurement.q), measurement.sizes),
        after=after,
        reduced_chi=_reduced_chi(measurement, tips, fitted),
        bounds=task.bounds,
        anchor=task.anchor,
        noise_model=task.noise_model,
        fitted_degrees_of_freedom=residual_degrees_of_freedom(task.noise_model, measurement.sizes, fitted),
    )
    return identification, propagated


def _reduced_chi(measurement: Measurement, tips: Float[AnyArray, "N 3"], fitted: int) -> Float[AnyArray, ""] | None:
    if measurement.weights is None:
        return None
    whitened, spare = (
        measurement.whitened(measurement.centred(tips)),
        3 * sum(n - 1 for n in measurement.sizes) - fitted,
    )
    return namespace(whitened).sqrt(namespace(whitened).sum(whitened**2) / max(spare, 1))


def _make_calibration(
    task: Task,
    stage1: Identification,
    method: str,
    found: Fit,
    parameter_covariance: ParameterCovariance,
    sigma: Float[AnyArray, ""],
    conditional_on: Int[AnyArray, " p"] | None = None,
) -> Calibration:
    """The result of a calibration, of which ``found`` is what came after stage 1; tips scatter by ``sigma`` (mm).

    ``conditional_on`` are the active bounds that its covariance takes as exact; by default those that are active.
    """
    assert stage1.scale is not None
    space = task.space
    start, calibrated, active = space.arm(task.start), space.arm(found.parameters), task.bounds.active(found.parameters)
    measurement = task.measurement.weighted(start.geometry, task.noise)
    tips = calibrated.position(measurement.q)
    after = repeatability(tips, measurement.sizes, fitted=len(space.names))
    exact = active if conditional_on is None else conditional_on
    return Calibration(
        arm=calibrated,
        parameters=found.parameters,
        scale=stage1.scale,
        de=after.de,
        deltam=after.deltam,
        active=active,
        steps=stage1.steps + found.steps,
        result=found.result,
        parameter_covariance=with_active_bounds(
            parameter_covariance, calibrated, space, measurement, exact, task.bounds, sigma
        ),
        before=stage1.before,
        after=after,
        length_before=measurement.distances(start.position(measurement.q)),
        length_after=measurement.distances(tips),
        stage1=stage1,
        method=method,
    )


@compiled(jit=eqx.filter_jit)
def _calibrate_by_division(task: Task) -> tuple[Calibration, propagation.Propagated, Bool[AnyArray, ""]]:
    """Stage 1 and the division by k; and whether the anchor must be adjusted instead."""
    xp = namespace(task)
    stage1, propagated = _solve_stage1(task)
    assert stage1.scale is not None
    space, bounds, anchor = task.space, task.bounds, task.anchor
    scaled = divide_by_k(anchor, space, stage1.parameters, stage1.scale.value)
    adjust = must_adjust_anchor(anchor, bounds, stage1.active, scaled)
    if anchor.can_scale:
        scaled = clip_to_bounds(space, bounds.lower, bounds.upper, scaled)
        measurement = task.measurement.weighted(space.arm(task.start).geometry, task.noise)
        propagated = scale_uncertainty.propagate_division(
            propagated, stage1.arm, space, measurement, stage1.after.sigma, scaled, anchor.partners
        )
    # Divided, a length may have left its bound, which stage 1's covariance takes as exact all the same.
    active = bounds.active(scaled)
    exact = xp.where(active != 0, active, stage1.active)
    divided = Fit(scaled, xp.zeros_like(stage1.steps), stage1.result, stage1.optimality)
    covariance = propagated.parameter_covariance
    calibration = _make_calibration(task, stage1, "two-stage", divided, covariance, stage1.after.sigma, exact)
    return calibration, propagated, adjust


@compiled(jit=eqx.filter_jit)
def _calibrate_by_adjustment(task: Task, by_division: Calibration) -> tuple[Calibration, propagation.Propagated]:
    """Stage 2 where the division leaves the box, or would need a fixed length to move."""
    xp = namespace(task, by_division)
    stage1, space, name = by_division.stage1, task.space, task.anchor.adjusted
    assert name is not None
    measurement = task.measurement.weighted(space.arm(by_division.parameters).geometry, task.noise)
    adjusted = adjust_anchor(task, measurement, by_division.parameters)
    arm, active = space.arm(adjusted.parameters), task.bounds.active(adjusted.parameters)
    # Stage 1's own does not do: bounds that do not act on this solution may have acted on that one.
    sigma = repeatability(arm.position(measurement.q), measurement.sizes, fitted=len(space.names) - 1).sigma
    is_anchor = xp.asarray([other == name for other in space.names])
    solved = propagation.propagate_solve(
        arm, space, measurement, (active != 0) | is_anchor, sigma, task.noise_model, task.noise
    )
    fixed = xp.any((active != 0) & is_anchor)
    found = scale_uncertainty.propagate_adjustment(solved, arm, space, measurement, sigma, name, fixed)
    return _make_calibration(task, stage1, "two-stage", adjusted, found.parameter_covariance, sigma), found


@compiled(jit=eqx.filter_jit)
def _calibrate_jointly(task: Task) -> tuple[Calibration, propagation.Propagated]:
    """One weighted least squares of poses and lengths, from the arm of stage 1 divided by k."""
    stage1, _ = _solve_stage1(task)
    assert stage1.scale is not None
    space, k = task.space, stage1.scale.value
    parameters = divide_by_k(task.anchor, space, stage1.parameters, k)
    scaled = space.arm(parameters)
    measurement = task.measurement.weighted(scaled.geometry, task.noise)
    sigma = stage1.after.sigma / k
    joint_weights = JointWeights.of(scaled.position(measurement.q), measurement, sigma)
    args = (space, measurement, joint_weights.sigma, joint_weights.whitening)
    bounds = task.bounds.lower, task.bounds.upper
    found = fit(joint_residual, joint_normal_equations, parameters, args, bounds, space.scale, task.max_steps)
    active = task.bounds.active(found.parameters)
    solved = propagation.propagate_solve(
        space.arm(found.parameters), space, measurement, active != 0, sigma, task.noise_model, task.noise, joint_weights
    )
    return _make_calibration(task, stage1, "joint", found, solved.parameter_covariance, stage1.after.sigma), solved
