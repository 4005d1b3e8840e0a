"""Stage 1 (`identify`), both stages (`calibrate`), and the joint solve; with a named model of the joints."""

import warnings
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ..calibration.results import Calibration, Identification
from ..calibration.scale_anchor import Method, method_of, scale_set_by_clause
from ..calibration.stages import Stages, identified, in_two_stages, jointly
from ..calibration.task import Solving, Task, task_of, without_lengths
from ..core._compat import inside_trace
from ..core.arguments import Count, check_finite, checked_arguments, shown, with_options
from ..core.arrays import Numbers, is_concrete
from ..core.blas_threads import one_blas_thread
from ..core.errors import IdentifiabilityWarning, InputError
from ..core.numpy_or_jax import compiled, namespace, to_jax, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..diagnostics import held_arm, noisy_encoders, shared_errors
from ..diagnostics.findings import amendable
from ..kinematics.arm import DOWN, Arm, correction_names, is_single, without_corrections
from ..kinematics.corrected_arm import with_corrections
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..kinematics.priors import Prior, default_prior
from ..model.loss_names import LossName
from ..uncertainty.covariance import STATED, NoiseModel
from ..uncertainty.identifiability import observability
from ..uncertainty.target_parameters import determined_parameters


class CalibrationOptions(NamedTuple):
    """How a calibration is solved: the keyword arguments of `calibrate`, described there, and their defaults.

    Example:
        >>> options = aj.pipeline.CalibrationOptions(method="joint", noise=noise)
        >>> print(bool(aj.calibrate(arm, capture, bounds, **options._asdict()).converged))
        True
    """

    model: str | None = None
    method: Method | None = None
    hold: str | None = "longest"
    start: Numbers | None = None
    noise: Noise | None = None
    noise_model: NoiseModel | None = None
    robust: LossName | None = None
    prior: Prior | None = None
    replace_noise: bool = True
    shared_errors: bool = True
    undetermined: Literal["warn", "raise", "ignore"] = "warn"
    max_steps: Count = 300

    @property
    def solving(self) -> Solving:
        """Those of a single solve, which `identify` takes too."""
        return Solving(**{name: getattr(self, name) for name in Solving._fields})


@checked_arguments
@with_options(Solving)
@one_blas_thread
def identify(arm: Arm, capture: Capture, bounds: Bounds, **options: Any) -> Identification:
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
    given = Solving(**options)
    task = _stage1_task("identify_many", arm, capture, bounds, given)
    capture = to_numpy(capture)
    result = to_jax(_identified(to_numpy(task), capture))
    case = amendable(result, capture) if given.may_replace_noise else None
    if case is None:
        return result
    again = given._replace(noise_model=None, replace_noise=False)
    with_noise = lambda noise: identify(arm, capture, bounds, **again._replace(noise=noise)._asdict())  # noqa: E731
    return noisy_encoders.amend(result, case, with_noise)


@compiled(jit=eqx.filter_jit)
def _identified(task: Task, capture: Capture) -> Identification:
    return identified(task, capture).solution.identification


def _stage1_task(many: str, arm: Arm, capture: Capture, bounds: Bounds, solving: Solving) -> Task:
    """The checked task of stage 1, in which lengths take no part; ``many`` is the function that takes batches."""
    _check_single(arm, capture, bounds, many)
    for sentence in () if inside_trace() else capture.repeated.sentences():
        warnings.warn(sentence, IdentifiabilityWarning, stacklevel=4)
    check_finite(arm=arm, capture=capture, noise=solving.noise)
    return task_of(arm, without_lengths(capture), bounds, solving)


def _check_single(arm: Arm, capture: Capture, bounds: Bounds, many: str) -> None:
    """Raise `InputError` where an arm, a capture or bounds are a batch; ``many`` is the function that takes batches."""
    wide = max(bounds.lower.ndim, bounds.upper.ndim) > 1
    is_batch = {"arm": not is_single(arm), "capture": capture.q.ndim > 2, "bounds": wide}
    if batches := [what for what, batch in is_batch.items() if batch]:
        raise InputError(
            f"the given {' and the '.join(batches)} must not be a batch, because this function solves a single "
            f"problem; use {many}."
        )


@checked_arguments
@with_options(CalibrationOptions)
@one_blas_thread
def calibrate(arm: Arm, capture: Capture, bounds: Bounds | None = None, **options: Any) -> Calibration:
    """Both stages: identify from repeatability, then fix the scale with the reference lengths.

    "two-stage" divides the arm of stage 1 by k = measured / nominal. Fixed parameters stay as they are, to the bit, and
    the result is inside the box: where a bound or a fixed length stands against the division, everything is solved at
    once instead, and ``divided`` of the result is false. Where fixed lengths set the scale, k changes nothing, and an
    `IdentifiabilityWarning` says so. The uncertainty of k, ``scale.u``, takes parameters on a bound as exact.

    "joint" is one least squares of everything, each weighted by its standard deviation: that of a tip coordinate from
    the residuals, that of a length from its u.

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
        shared_errors: add shared errors, as far as residuals show any, to the covariance (`SharedErrors`).
        undetermined: what to do where these data do not determine free parameters: "warn", "raise" (`InputError`) or
            "ignore", which leaves out the check; it takes about as long as the calibration.
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
    given = CalibrationOptions(**options)
    arm, bounds, prior = with_joint_model(arm, capture, bounds, given.model, given.prior)
    given = given._replace(model=None, prior=prior)
    method, at_once = method_of(arm, capture, bounds.space, given.noise, given.method, given.solving.all_at_once)
    given = given._replace(method=method)
    if at_once:
        _check_single(arm, capture, bounds, "calibrate_many")
        check_finite(arm=arm, capture=capture, noise=given.noise)
    elif given.hold is None and not is_concrete(*jax.tree.leaves(arm)) and bounds.space.lengths.any():
        raise InputError(
            "with hold=None, calibrate needs the values of the arm, which are not known inside jit, vmap or a "
            "derivative; name the length to hold."
        )
    first = None if at_once else _stage1_task("calibrate_many", arm, capture, bounds, given.solving)
    task = task_of(arm, capture, bounds, given.solving._replace(hold=None))
    if given.undetermined != "ignore":
        _check_identifiable(capture, task.bounds, prior, given.undetermined == "raise")
    set_by = first.anchor.set_by if method == "two-stage" and first is not None and not inside_trace() else ()
    if set_by:  # a division by k changes nothing
        says = f"{scale_set_by_clause(set_by)}, so the reference lengths have no effect"
        other_way = "" if arm.prismatic else "free one of these lengths, or "
        warnings.warn(
            f"{says}; {other_way}use {'the readings' if arm.prismatic else 'the fixed'} and the reference lengths "
            "together with method='joint'.",
            IdentifiabilityWarning,
            stacklevel=3,
        )
    first, task, capture = to_numpy((first, task, capture))
    if namespace((first, task, capture)) is not np:
        return to_jax(_traced(first, task, capture, method))
    with np.errstate(all="ignore"):
        result, sensitivities, _ = _stages(first, task, capture, method)
    case = amendable(result, capture)
    if case is not None and given.solving.may_replace_noise:
        again = given._replace(noise_model=None, replace_noise=False, undetermined="ignore")
        replaced = noisy_encoders.amend(
            result, case, lambda noise: calibrate(arm, capture, bounds, **again._replace(noise=noise)._asdict())
        )
        if replaced is not result:
            return replaced
    if case is not None and given.shared_errors:
        held = not bounds.space.names
        result = held_arm.amend(result, case) if held else shared_errors.amend(result, case, sensitivities)
    return to_jax(result)


def _check_identifiable(capture: Capture, bounds: Bounds, prior: Prior | None, strict: bool) -> None:
    """Warn of, or with ``strict`` refuse, free parameters that these data cannot determine; not of traced values."""
    if not bounds.space.names or inside_trace() or not is_concrete(*jax.tree.leaves((capture, bounds))):
        return
    space = bounds.space
    stated = prior and prior.of(space.names, space.vector())
    seen = observability(
        space.base, capture, space, with_prior=tuple(space.names[i] for i in stated.index) if stated else ()
    )
    lost = seen._replace(by_prior=()).sentences()
    if lost and strict:
        raise InputError(" ".join(lost))
    for sentence in seen.sentences():
        warnings.warn(sentence, IdentifiabilityWarning, stacklevel=4)


def _stages(first: Task | None, task: Task, capture: Capture, method: str) -> Stages:
    """Both stages, or the joint solve; ``first`` is stage 1's task where reference lengths alone fix the scale."""
    stage1 = None if first is None else identified(first, capture)
    if method == "joint" or stage1 is None:
        return jointly(task, capture, stage1, method)
    divided = in_two_stages(stage1, capture)
    if not stage1.solution.identification.anchor.can_scale:
        return divided

    def joint() -> Stages:
        joint = jointly(task, capture, stage1, method)
        return joint._replace(calibration=_with_components_of(divided.calibration, joint.calibration))

    if namespace(divided.stands_against) is np:
        return joint() if divided.stands_against else divided
    calibration = jax.lax.cond(divided.stands_against, lambda: joint().calibration, lambda: divided.calibration)
    return divided._replace(calibration=calibration)


@eqx.filter_jit
def _traced(first: Task | None, task: Task, capture: Capture, method: str) -> Calibration:
    return _stages(first, task, capture, method).calibration


def _with_components_of(other: Calibration, result: Calibration) -> Calibration:
    """With the components of another calibration that this one does not have, as zeros: the same structure."""
    components, others = result.parameter_covariance.components, other.parameter_covariance.components
    lacking = None if others is None else others.without(STATED)
    if components is None or lacking is None:
        return result
    none = eqx.tree_at(lambda lacking: lacking.matrices, lacking, 0 * lacking.matrices)
    return eqx.tree_at(lambda r: r.parameter_covariance.components, result, components.joined(none))


def with_joint_model(
    arm: Arm, capture: Capture, bounds: Bounds | None, model: str | None, prior: Prior | None
) -> tuple[Arm, Bounds, Prior | None]:
    """The arm, box and prior of a calibration with a model of the joints; without one, as they are given.

    The box is by default that of `default_bounds`; the prior of a model that of `default_prior`.
    """
    if model is None:
        if bounds is None:
            bounds = default_bounds(arm, capture)
            arm = bounds.space.base
        return arm, bounds, prior
    if not isinstance(model, str):
        raise InputError(f"the model is {shown(model)}; give a text such as 'gravity,harmonics=1'.")
    plain = without_corrections(arm)
    bounds = default_bounds(plain, capture) if bounds is None else bounds
    corrected = with_corrections(plain, model, gravity=DOWN if arm.gravity is None else arm.gravity)
    bounds = with_coefficients(bounds, corrected)
    arm = bounds.space.base  # with Hayati's beta, where the box has it
    if prior is None and arm.corrections is not None:
        prior = default_prior(arm)
    return arm, bounds, prior


def default_bounds(arm: Arm, capture: Capture) -> Bounds:
    """Around the parameters that such data determine, as for an arm's file without ``[identification]``, and without
    bounds around the coefficients of joint corrections."""
    plain = without_corrections(arm)
    try:
        space = determined_parameters(plain, capture)
    except InputError:
        space = Parameters.free_of(plain)
    bounds = Bounds.around(plain, space)
    return bounds if arm.corrections is None else with_coefficients(bounds, arm)


def with_coefficients(bounds: Bounds, arm: Arm) -> Bounds:
    """The box of the Denavit-Hartenberg parameters, with the coefficients of a corrected arm free and without bounds:
    their prior is enough."""
    kept = [i for i, name in enumerate(bounds.space.names) if name not in correction_names(bounds.space.base)]
    added = tuple(name for name in correction_names(arm) if not name.startswith("gravity_"))
    names = (*(bounds.space.names[i] for i in kept), *added)
    base = based_on(Parameters(bounds.space.base, names[: len(kept)]), arm).base
    endless = np.full(len(added), np.inf)
    sides = np.asarray(bounds.lower)[kept], np.asarray(bounds.upper)[kept]
    return Bounds(Parameters(base, names), np.concatenate([sides[0], -endless]), np.concatenate([sides[1], endless]))
