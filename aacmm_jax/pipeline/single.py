"""Stage 1 (`identify`), both stages (`calibrate`), and the joint solve."""

import warnings
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ..calibration.joint_model import with_joint_model
from ..calibration.results import Calibration, Identification
from ..calibration.scale_anchor import Method, warn_of_known_scale
from ..calibration.stages import Stages, identified, in_two_stages, jointly
from ..calibration.task import (
    Solving,
    Task,
    check_identifiable,
    check_single,
    method_of,
    task_of,
    without_lengths,
)
from ..core._compat import inside_trace
from ..core.arguments import Count, check_finite, checked_arguments, with_options
from ..core.arrays import Numbers, is_concrete
from ..core.errors import IdentifiabilityWarning, InputError
from ..core.numpy_or_jax import compiled, namespace, to_jax, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..diagnostics import noisy_encoders, shared_errors
from ..diagnostics.findings import amendable
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds
from ..kinematics.priors import Prior
from ..model.loss_names import LossName
from ..uncertainty.covariance import STATED, NoiseModel


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
    def of_stage1(self) -> dict[str, Any]:
        """Those that `identify` takes too."""
        others = ("model", "method", "shared_errors", "undetermined")
        return {name: value for name, value in self._asdict().items() if name not in others}

    @property
    def solving(self) -> Solving:
        """Those of a single solve."""
        return Solving(**{name: getattr(self, name) for name in Solving._fields})

    @property
    def may_replace_noise(self) -> bool:
        """Whether the noise of noisy encoders may be replaced: a robust loss and other models of noise have none."""
        return self.replace_noise and self.noise_model not in ("common", "robust") and self.robust is None


_DEFAULT = CalibrationOptions()


@checked_arguments
def identify(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    *,
    hold: str | None = _DEFAULT.hold,
    start: Numbers | None = None,
    noise: Noise | None = None,
    noise_model: NoiseModel | None = None,
    robust: LossName | None = None,
    prior: Prior | None = None,
    replace_noise: bool = _DEFAULT.replace_noise,
    max_steps: Count = _DEFAULT.max_steps,
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
    options = CalibrationOptions(None, None, hold, start, noise, noise_model, robust, prior, replace_noise)
    options = options._replace(max_steps=max_steps)
    task = _stage1_task("identify_many", arm, capture, bounds, options)
    capture = to_numpy(capture)
    result = to_jax(_identified(to_numpy(task), capture))
    case = amendable(result, capture) if options.may_replace_noise else None
    if case is None:
        return result
    again = options._replace(noise_model=None, replace_noise=False)

    def with_noise(replaced: Noise) -> Identification:
        return identify(arm, capture, bounds, **again._replace(noise=replaced).of_stage1)

    return noisy_encoders.amend(result, case, with_noise)


def _stage1_task(many: str, arm: Arm, capture: Capture, bounds: Bounds, options: CalibrationOptions) -> Task:
    """The checked task of stage 1, in which lengths take no part; ``many`` is the function that takes batches."""
    check_single(arm, capture, bounds, many)
    for sentence in () if inside_trace() else capture.repeated.sentences():
        warnings.warn(sentence, IdentifiabilityWarning, stacklevel=4)
    check_finite(arm=arm, capture=capture, noise=options.noise)
    return task_of(arm, without_lengths(capture), bounds, options.solving)


@compiled(jit=eqx.filter_jit)
def _identified(task: Task, capture: Capture) -> Identification:
    return identified(task, capture).solution.identification


@checked_arguments
@with_options(CalibrationOptions)
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
        shared_errors: add errors that poses share, as far as residuals show any, to the covariance (`SharedErrors`).
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
    method, at_once = method_of(arm, capture, bounds.space, given.solving, given.method)
    given = given._replace(method=method)
    if at_once:
        check_single(arm, capture, bounds, "calibrate_many")
        check_finite(arm=arm, capture=capture, noise=given.noise)
    elif given.hold is None and not is_concrete(*jax.tree.leaves(arm)) and bounds.space.lengths.any():
        raise InputError(
            "hold=None needs an arm with known values in calibrate; where the arm itself is traced, name the length to "
            "hold."
        )
    first = None if at_once else _stage1_task("calibrate_many", arm, capture, bounds, given)
    task = task_of(arm, capture, bounds, given.solving._replace(hold=None))
    if given.undetermined != "ignore":
        check_identifiable(capture, task.bounds, prior, given.undetermined == "raise")
    if method == "two-stage" and first is not None and not inside_trace():
        warn_of_known_scale(first.anchor.set_by, bool(arm.prismatic))
    first, task, capture = to_numpy((first, task, capture))
    if namespace((first, task, capture)) is not np:
        return to_jax(_traced(first, task, capture, method))
    with np.errstate(all="ignore"):
        result, sensitivities, _ = _stages(first, task, capture, method)
    case = amendable(result, capture)
    if case is not None and given.may_replace_noise:
        again = given._replace(noise_model=None, replace_noise=False, undetermined="ignore")

        def with_noise(replaced: Noise) -> Calibration:
            return calibrate(arm, capture, bounds, **again._replace(noise=replaced)._asdict())

        replaced = noisy_encoders.amend(result, case, with_noise)
        if replaced is not result:
            return replaced
    if case is not None and given.shared_errors:
        result = shared_errors.amend(result, case, sensitivities)
    return to_jax(result)


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
    return eqx.tree_at(lambda one: one.parameter_covariance.components, result, components.joined(none))
