"""The record of a calibration: everything that is kept of it, in plain arrays; and its uncertainty."""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..data.noise import Noise
from ..data.recording import Recording
from ..kinematics.parameters import Parameters
from ..kinematics.specification import ArmSpecification
from ..solver.reason import Reason
from ..uncertainty.arm_uncertainty import Uncertainty
from .evaluation import Evaluation, evaluate
from .results import Calibration, CrossValidation, Identification


class CalibrationRecord(NamedTuple):
    """Everything a calibration file holds. Arrays are NumPy's, in mm and rad, in the order of ``names``."""

    recording: Recording  # what it was identified from, and the nominal arm
    stage1: ArmSpecification
    calibrated: ArmSpecification
    names: tuple[str, ...]  # free parameters
    held: tuple[str, ...]
    hold: str | None  # held in stage 1 only
    lower: np.ndarray
    upper: np.ndarray
    active_stage1: np.ndarray  # -1, 0, +1
    active: np.ndarray
    covariance: np.ndarray
    determined: np.ndarray  # False where only a combination with others is determined
    open: np.ndarray  # projector onto the directions that are not determined, in steps of 1 mm and 1 mrad
    common_scale_error: np.ndarray  # of lengths that were held but divided by k: see covariance.Covariance
    noise: Noise  # given, or estimated from the residuals
    noise_model: str  # what the covariance takes errors of tips for: covariance.FORMS
    degrees_of_freedom: float  # degrees of freedom behind the covariance
    reduced_chi: float | None  # residuals in units of the given noise
    k: float
    u_k: float
    method: str
    steps: int
    converged: bool
    reason: str
    validation: CrossValidation | None = None
    # Monte Carlo after JCGM 101: quantity, estimate, u, low, high, linear_u, agrees; and what to say of it.
    sampled: Mapping[str, np.ndarray] | None = None
    sampled_says: str | None = None

    @property
    def fixed_by_one_length(self) -> bool:
        """Whether a single length fixed the scale exactly, so that its own error as left is zero by construction: no measurement."""
        return self.method == "two-stage" and len(self.recording.capture.lengths) == 1

    def vectors(self) -> dict[str, np.ndarray]:
        """Free parameters of the nominal arm, after stage 1, and calibrated; and of the true arm of a simulation."""
        space = Parameters(self.recording.nominal.arm, self.names)
        arms = {"nominal": self.recording.nominal.arm, "stage1": self.stage1.arm, "calibrated": self.calibrated.arm}
        if self.recording.true is not None:
            arms["true"] = self.recording.true.arm
        return {stage: np.asarray(space.vector(arm)) for stage, arm in arms.items()}

    def evaluations(self) -> dict[str, Evaluation]:
        """The three arms on the capture that was identified from."""
        arms = {"nominal": self.recording.nominal.arm, "stage1": self.stage1.arm, "calibrated": self.calibrated.arm}
        return {stage: evaluate(arm, self.recording.capture) for stage, arm in arms.items()}


def record_of(calibration: Calibration, recording: Recording) -> CalibrationRecord:
    """The record of a calibration, given the recording that it was identified from."""
    nominal, stage1 = recording.nominal, calibration.stage1
    result = calibration.result if bool(stage1.converged) else stage1.result
    return CalibrationRecord(
        recording=recording,
        stage1=nominal._replace(arm=stage1.arm, name=f"{nominal.name}, after stage 1"),
        calibrated=nominal._replace(arm=calibration.arm, name=f"{nominal.name}, calibrated"),
        names=calibration.space.names,
        held=calibration.space.held,
        hold=stage1.hold,
        lower=np.asarray(calibration.bounds.lower),
        upper=np.asarray(calibration.bounds.upper),
        active_stage1=np.asarray(stage1.active),
        active=np.asarray(calibration.active),
        covariance=np.asarray(calibration.covariance),
        determined=np.asarray(calibration.determined),
        open=np.asarray(calibration.parameter_covariance.open),
        common_scale_error=np.asarray(calibration.parameter_covariance.common_scale_error),
        noise=calibration.noise,
        noise_model=calibration.noise_model,
        degrees_of_freedom=calibration.degrees_of_freedom,
        reduced_chi=None if stage1.reduced_chi is None else float(stage1.reduced_chi),
        k=float(calibration.scale.value),
        u_k=float(calibration.scale.u),
        method=calibration.method,
        steps=int(calibration.steps),
        converged=bool(calibration.converged),
        reason=Reason[result],
    )


def uncertainty_of(result: Calibration | Identification | CalibrationRecord) -> Uncertainty:
    """The uncertainty of a calibration, just made or loaded from a file; of an identification, with the scale as it was held."""
    if isinstance(result, CalibrationRecord):
        return Uncertainty(
            arm=result.calibrated.arm,
            covariance=jnp.asarray(result.covariance),
            common_scale_error=jnp.asarray(result.common_scale_error),
            open=jnp.asarray(result.open),
            noise=result.noise,
            u_k=jnp.asarray(result.u_k),
            names=result.names,
            degrees_of_freedom=result.degrees_of_freedom,
        )
    scale = result.scale
    return Uncertainty(
        arm=result.arm,
        covariance=result.covariance,
        common_scale_error=result.parameter_covariance.common_scale_error,
        open=result.parameter_covariance.open,
        noise=result.noise,
        u_k=None if scale is None else scale.u,
        names=result.space.names,
        degrees_of_freedom=result.degrees_of_freedom,
    )
