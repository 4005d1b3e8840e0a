"""The record of a calibration: everything that a file keeps of it, in plain arrays; and its uncertainty."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..core._compat import member_numbers
from ..core.arguments import checked_arguments
from ..core.numpy_or_jax import to_numpy
from ..data.noise import Noise
from ..data.observations.observation import stated_u
from ..data.recording import Recording
from ..kinematics.arm import Arm, joint_limits, parameter_names, value_of
from ..kinematics.corrected_arm import function_values
from ..kinematics.correction_kinds import Term
from ..kinematics.parameters import ArmSpecification, Parameters
from ..solver.reason import MAX_STEPS, STALLED, Reason
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.covariance import SharedErrors
from ..uncertainty.degrees_of_freedom import Components
from .agreement import CrossValidation
from .evaluation import Evaluation, evaluate
from .pose_table import PoseResiduals
from .results import (
    Calibration,
    Identification,
    NoisyEncoder,
    ObservedMetrics,
    PriorMetrics,
    converged,
    largest_plausible_residual,
    plausible,
)
from .stages import against_division

REPEATABILITY = "repeatability"  # method of stage 1 alone
# First words of the reason where the solve ended, but with a k that is not plausible.
SCALE_REFUSED = "Not usable: the scale factor k"
_POINTS = 400  # of a joint's corrections as a function of its reading
_BEYOND = 0.15  # of a joint's travel, on either side of it, where its corrections are given
_CORRELATED = 0.1  # smallest eigenvalue of correlations, below which parameters slide along each other
_MOST_NAMED, _LEAST_SHARE = 4, 0.3  # of the parameters that do, and of the largest share


class Removed(NamedTuple):
    """What a calibration left out because it contradicts the rest, why, and what that changed."""

    kind: str  # "socket", "placement", "station", ..., or "pose"
    group: str  # its name; of poses with what was probably done wrong
    members: tuple[str, ...]  # names of its sockets and observations, or of poses
    ratio: float  # F: mean square that it added, over that of the rest
    degrees_of_freedom: tuple[int, int]
    probability: float  # of this ratio or a larger one, where nothing is wrong
    rms_with: float  # root mean square distance of the rest from its geometry, mm
    rms_without: float = 0.0  # the same without the group
    changed_most: str = ""  # parameter
    change: float = 0.0  # of it, in standard uncertainties before


class CalibrationRecord(NamedTuple):
    """Everything a calibration file holds. Arrays are NumPy's, in mm and rad, in the order of ``names``.

    Example:
        >>> print(record.method, record.hold, f"k = {record.k:.5f}")
        two-stage d_3 k = 0.99923
        >>> print(record.names[:3], record.covariance.shape)
        ('alpha_1', 'alpha_2', 'alpha_3') (21, 21)
    """

    recording: Recording  # what it was identified from, and the nominal arm
    stage1: ArmSpecification
    calibrated: ArmSpecification
    names: tuple[str, ...]  # free parameters
    held: tuple[str, ...]  # fixed parameters
    hold: str | None  # scale anchor of stage 1
    scale_set_by: tuple[str, ...]  # fixed lengths that set the scale, so that two stages change nothing
    lower: np.ndarray
    upper: np.ndarray
    active_stage1: np.ndarray  # -1, 0, +1
    active: np.ndarray
    covariance: np.ndarray
    determined: np.ndarray  # False where only a combination with others is determined
    open: np.ndarray  # projector onto the directions that are not determined, in steps of 1 mm and 1 mrad
    noise: Noise  # given, or estimated from the residuals
    noise_model: str  # model of the tips' errors: `uncertainty.covariance.NOISE_MODELS`
    degrees_of_freedom: float  # of the scatter of single poses
    reduced_chi: float | None  # residuals in units of the given noise
    k: float
    u_k: float
    method: str
    steps: int
    converged: bool
    reason: str
    observed: ObservedMetrics  # how sockets and other observations agree, and their geometry; with arrays of NumPy
    divided: bool  # whether the arm is that of stage 1 divided by k
    # Bounds, fixed lengths and slides that stood against that in two stages, so that everything was solved at once.
    against_division: tuple[str, ...] = ()
    validation: CrossValidation | None = None
    # Monte Carlo after JCGM 101: quantity, estimate, u, low, high, linear_u, agrees; and its summary in words.
    sampled: Mapping[str, np.ndarray] | None = None
    sampled_says: str | None = None
    robust: str | None = None  # the robust loss
    held_out: PoseResiduals | None = None  # residuals of poses that it was not calibrated with
    held_out_nominal: np.ndarray | None = None  # distances of these poses by the nominal arm, mm
    removed: tuple[Removed, ...] = ()
    prior: PriorMetrics | None = None  # with arrays of NumPy
    noisy_encoders: tuple[NoisyEncoder, ...] = ()  # whose noise was estimated, because it is larger than expected
    shared: SharedErrors | None = None  # shared errors, likewise
    components: Components | None = None  # parts of the covariance that do not rest on the scatter of single poses
    surplus_k: float = 0.0  # of u_k^2, by lengths that disagree
    decisions: tuple[str, ...] = ()  # what was decided by default, a sentence each

    @property
    def given_noise(self) -> Noise | None:
        """The noise, where it was given and not estimated."""
        return None if self.reduced_chi is None else self.noise

    @property
    def plausible_scale(self) -> bool:
        """Whether k may be the scale of an arm, where reference lengths measured one."""
        return bool(np.isnan(self.k)) or plausible(self.k)

    @property
    def sockets_alone(self) -> bool:
        """Whether nothing took part but poses in sockets, which all count in full, and reference lengths: no other
        observation, no slides that set the scale instead of lengths, no robust loss and no prior."""
        capture = self.recording.capture
        by_slides = self.method != REPEATABILITY and not capture.lengths
        return not (capture.observations or by_slides or self.robust is not None or self.prior is not None)

    @property
    def stage1_apart(self) -> bool:
        """Whether stage 1 was a solve of its own, with another arm than the calibrated one."""
        return self.sockets_alone and self.method != REPEATABILITY

    @property
    def final_method(self) -> str:
        """How the calibrated arm was solved: jointly too where the division by k of two stages was not possible."""
        return "joint" if self.against_division else self.method

    @property
    def fixed_by_one_length(self) -> bool:
        """Whether the arm was divided by the k of a single length, whose own error is then zero by construction."""
        return self.divided and len(self.recording.capture.lengths) == 1

    @property
    def residual(self) -> float:
        """RMS distance of the poses from their geometry, mm; without those that a robust loss took weight from."""
        return self.observed.rms if self.robust is None else float(np.sqrt(3) * self.observed.sigma)

    @property
    def largest_plausible_residual(self) -> float:
        """RMS distance from the geometry, mm, that no arm of this size and class exceeds with its own data."""
        return self._largest_residual(only_usual=False)

    @property
    def largest_usual_residual(self) -> float:
        """RMS distance from the geometry, mm, above which a mistake in the data is looked for."""
        return self._largest_residual(only_usual=True)

    @property
    def implausible_residual(self) -> bool:
        """Whether the residual is larger than that of any such arm, so that data and arm do not belong together."""
        return self.residual > self.largest_plausible_residual

    def _largest_residual(self, only_usual: bool) -> float:
        noises = self.given_noise, None if self.recording.usual is None else self.recording.usual.noise
        # Of each observation at most three coordinates; a socket has no measured point.
        capture = self.recording.capture
        stated_of = [(len(part.q), stated_u(part)) for part in capture.observations]
        squares = sum(poses * 3 * float(np.mean(u**2)) for poses, u in stated_of if len(u))
        stated = math.sqrt(squares / len(capture.readings))
        return largest_plausible_residual(self.calibrated.arm, *noises, stated_rms=stated, only_usual=only_usual)

    def vectors(self) -> dict[str, np.ndarray]:
        """Free parameters of the nominal arm, after stage 1, and calibrated; and of the true arm of a simulation."""
        space = Parameters(self.recording.nominal.arm, self.names)
        arms = {"nominal": self.recording.nominal, "stage1": self.stage1, "calibrated": self.calibrated}
        vectors = {stage: np.asarray(space.vector(specification.arm)) for stage, specification in arms.items()}
        if self.recording.true is not None:
            true, nominal = self.recording.true.arm, dict(zip(self.names, vectors["nominal"], strict=True))
            # The corrections of the true arm need not be those that are identified: what it lacks is 0, but for the
            # direction of gravity, which no arm is without.
            lacking = {name: nominal[name] if name.startswith("gravity_") else 0.0 for name in self.names}
            values = lacking | {name: float(value_of(true, name)) for name in parameter_names(true)}
            vectors["true"] = np.array([values[name] for name in self.names])
        return vectors

    def evaluations(self) -> dict[str, Evaluation]:
        """The nominal arm, the arm as found (where that is known), that after stage 1 and the calibrated one on the
        capture that was identified from."""
        capture, calibrated = self.recording.capture, evaluate(self.calibrated.arm, self.recording.capture)
        leaves = [jax.tree.leaves(specification.arm) for specification in (self.stage1, self.calibrated)]
        alike = len(leaves[0]) == len(leaves[1]) and all(map(np.array_equal, *leaves))
        stage1 = calibrated if alike else evaluate(self.stage1.arm, capture)
        as_found = self.recording.as_found
        before = {} if as_found is None else {"as_found": evaluate(as_found.arm, capture)}
        nominal = evaluate(self.recording.nominal.arm, capture)
        return {"nominal": nominal, **before, "stage1": stage1, "calibrated": calibrated}


@checked_arguments
def record_of(
    calibration: Calibration | Identification,
    recording: Recording,
    *,
    robust: str | None = None,
) -> CalibrationRecord:
    """The record of a calibration.

    Args:
        calibration: what `calibrate` returned, or `identify`: the scale is then that of the nominal arm.
        recording: the capture that it was identified from, and the nominal arm.
        robust: the robust loss of the calibration.

    Returns:
        What a calibration file holds, as NumPy arrays.

    Example:
        >>> made = aj.calibration.record_of(result, recording)
        >>> print(made.converged, made.reason)
        True Converged: the projected gradient is zero to the tolerance.
    """
    nominal, stage1, scale = recording.nominal, calibration.stage1, calibration.scale
    single = isinstance(calibration, Identification)
    # What files hold is NumPy's.
    kept = (calibration.parameter_covariance, calibration.observed, calibration.prior)
    covariance, observed, prior, shared = jax.tree.map(np.asarray, (*kept, None if single else calibration.shared))
    return CalibrationRecord(
        recording=recording,
        stage1=nominal._replace(arm=stage1.arm, name=f"{nominal.name}, after stage 1"),
        calibrated=nominal._replace(arm=calibration.arm, name=f"{nominal.name}, calibrated"),
        names=calibration.space.names,
        held=calibration.space.held,
        hold=stage1.hold,
        scale_set_by=stage1.scale_set_by,
        lower=np.asarray(calibration.bounds.lower),
        upper=np.asarray(calibration.bounds.upper),
        active_stage1=np.asarray(stage1.active),
        active=np.asarray(calibration.active),
        covariance=covariance.matrix,
        determined=covariance.determined,
        open=covariance.open,
        noise=calibration.noise,
        noise_model=calibration.noise_model,
        degrees_of_freedom=float(calibration.degrees_of_freedom),
        reduced_chi=None if stage1.reduced_chi is None else float(stage1.reduced_chi),
        k=np.nan if scale is None else float(scale.value),
        u_k=np.nan if scale is None else float(scale.u),
        method=REPEATABILITY if single else calibration.method,
        steps=int(calibration.steps),
        converged=bool(calibration.converged),
        reason=_reason(calibration),
        divided=not single and bool(calibration.divided) and stage1.anchor.can_scale,
        against_division=() if single else against_division(calibration),
        observed=observed,
        robust=robust,
        prior=prior,
        noisy_encoders=calibration.noisy_encoders,
        shared=shared,
        components=covariance.components,
        surplus_k=0.0 if scale is None else float(scale.surplus),
    )


def _reason(calibration: Calibration | Identification) -> str:
    """Why the calibration ended, in words; where parameters trade off, with their names."""
    stage1 = calibration.stage1
    result = calibration.result if bool(stage1.converged) else stage1.result
    sentence, number = Reason[result], int(member_numbers(result))
    covariance = np.asarray(calibration.covariance)
    if not bool(calibration.converged) and bool(converged(result)):
        # What the solve says of itself would contradict that.
        k = calibration.stage1.k
        if k is not None and not bool(plausible(k)):
            return f"{SCALE_REFUSED} = {float(k):.6g} is not plausible."
        return "Not converged: a parameter is not finite; check the data and the start."
    sd = np.sqrt(np.diag(covariance))
    moving = np.flatnonzero(sd > 0)
    if number not in (MAX_STEPS, STALLED) or not len(moving) or not np.all(np.isfinite(covariance)):
        return sentence
    # The combination that is known best beside what is known of each parameter: where a solve does not end, these slide
    # along each other, the first most.
    values, vectors = np.linalg.eigh(covariance[np.ix_(moving, moving)] / sd[moving] / sd[moving, None])
    share = np.abs(vectors[:, 0])
    leading = [i for i in np.argsort(-share)[:_MOST_NAMED] if share[i] > _LEAST_SHARE * share.max()]
    if values[0] >= _CORRELATED or len(leading) < 2:
        return sentence
    together = ", ".join(calibration.space.names[moving[i]] for i in leading)
    return f"{sentence.partition(';')[0]}; {together} trade off; fix one of these parameters, or give it a prior."


@checked_arguments
def uncertainty_of(result: Calibration | Identification | CalibrationRecord) -> Uncertainty:
    """The uncertainty of a calibration, just made or loaded from a file; of an identification, given its scale anchor.

    Args:
        result: what `calibrate` or `identify` returned, or the record of a calibration.

    Returns:
        Standard uncertainties of parameters, tips and lengths, mm and rad; those of a record are arrays of NumPy.

    Example:
        >>> uncertainty = aj.uncertainty_of(result)
        >>> print(np.sqrt(np.diag(uncertainty.tip(q))).round(3), "mm")
        [0.007 0.006 0.009] mm
    """
    if isinstance(result, CalibrationRecord):
        arm, noise, components, shared = to_numpy(
            (result.calibrated.arm, result.noise, result.components, result.shared)
        )
        covariance, is_open, names = np.asarray(result.covariance), np.asarray(result.open), result.names
        u_k, surplus_k = None if np.isnan(result.u_k) else np.asarray(result.u_k), np.asarray(result.surplus_k)
        lengths = len(result.recording.capture.lengths)
        chosen = result.prior is not None and any(result.prior.learned)
        between = None if result.validation is None else result.validation.between(chosen=chosen)
    else:
        arm, scale, names = result.arm, result.scale, result.space.names
        covariance, _, is_open, noise, components = result.parameter_covariance
        shared = None if isinstance(result, Identification) else result.shared
        between = None
        u_k, surplus_k, lengths = (None, None, 0) if scale is None else (scale.u, scale.surplus, len(scale.nominal))
    # Parts of the covariance of the parameters, with errors of the tip that poses share.
    of_tips = None if shared is None else shared.of_tips
    return Uncertainty(
        arm=arm,
        covariance=covariance,
        open=is_open,
        noise=noise,
        u_k=u_k,
        shared=shared,
        components=of_tips if components is None else components.joined(of_tips),
        surplus_k=surplus_k,
        names=names,
        scatter_degrees_of_freedom=float(result.degrees_of_freedom),
        lengths=lengths,
        between=between,
    )


class JointFunction(NamedTuple):
    """Corrections of one joint by its own reading, less their mean over the poses; rad, or mm of a prismatic joint."""

    reading: Float[np.ndarray, " points"]  # the travel of the poses and a little beyond, within the joint's limits
    value: Float[np.ndarray, " points"]
    expanded: Float[np.ndarray, " points"]  # expanded uncertainty U
    at_poses: Float[np.ndarray, " poses"]


def function_of_joint(
    record: CalibrationRecord, joint: int, q: Float[np.ndarray, "poses joints"]
) -> JointFunction | None:
    """The functions of its own reading that correct a joint (harmonics, gear ratio), numbered from 1, over the travel
    of these poses, with their uncertainty; None where it has none.

    The mean over the poses is taken away: a zero offset takes it up.
    """
    arm: Arm = to_numpy(record.calibrated.arm)
    terms = [] if arm.corrections is None else [(i, t) for i, t in enumerate(arm.corrections.functions.terms)]
    chosen = {i: t for i, t in terms if isinstance(t, Term) and t.joint == joint and t.kind.of_own_reading}
    if arm.corrections is None or not chosen:
        return None
    coefficients = np.asarray(arm.coefficients)[list(chosen)]
    travel = q[:, joint - 1]
    low, high = joint_limits(arm, None)[joint - 1] if arm.limits is not None or not arm.prismatic else (-np.inf, np.inf)
    beyond = _BEYOND * np.ptp(travel)
    reading = np.linspace(max(travel.min() - beyond, low), min(travel.max() + beyond, high), _POINTS)
    rows = np.zeros((_POINTS, q.shape[1]))
    rows[:, joint - 1] = reading
    values = [function_values(arm, list(chosen.values()), poses) for poses in (q, rows)]
    at_poses, functions = (value - values[0].mean(axis=1, keepdims=True) for value in values)
    slopes = np.zeros((_POINTS, len(record.names)))
    for term, function in zip(chosen.values(), functions, strict=True):
        if term.name in record.names:
            slopes[:, record.names.index(term.name)] = function
    expanded = uncertainty_of(record).expanded_of(slopes)
    return JointFunction(reading, coefficients @ functions, expanded, coefficients @ at_poses)
