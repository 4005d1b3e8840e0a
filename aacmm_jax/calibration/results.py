"""What an identification, a calibration and a cross-validation return."""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..core._compat import member_numbers
from ..core.arrays import Numbers, is_concrete
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters
from ..model.metrics import Repeatability
from ..model.scale import Scale
from ..solver.reason import Reason, numbers_of
from ..uncertainty.covariance import NoiseModel, ParameterCovariance
from .checks import largest_plausible_residual

_GOOD = [int(member_numbers(reason)) for reason in (Reason.gradient, Reason.step, Reason.rounding)]


class Identification(eqx.Module):
    """Result of stage 1. A PyTree: under ``eqx.filter_vmap`` every array has the batch axis first.

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
    # Given the scale anchor: its rows are 0, and those of active parameters but for near-degenerate directions.
    parameter_covariance: ParameterCovariance
    before: Repeatability  # the start
    after: Repeatability
    # Root mean square of the residuals in units of what the given noise predicts (1 where it is right), or None.
    reduced_chi: Float[Array, ""] | None
    bounds: Bounds
    hold: str | None = eqx.field(static=True)  # the scale anchor
    scale_set_by: tuple[str, ...] = eqx.field(static=True)  # fixed lengths that set the scale, where there is no anchor
    noise_model: NoiseModel = eqx.field(static=True)  # model of the tips' errors
    degrees_of_freedom: float = eqx.field(static=True)  # of the covariance; infinite where the noise was given

    @property
    def covariance(self) -> Float[Array, "*batch p p"]:
        """Covariance of the parameters; that of what is determined, where not all is."""
        return self.parameter_covariance.matrix

    @property
    def determined(self) -> Bool[Array, "*batch p"]:
        """Which parameters are determined one by one, and not only in combination with others."""
        return self.parameter_covariance.determined

    @property
    def noise(self) -> Noise:
        """Noise of readings and seat: as given, or as estimated from the residuals."""
        return self.parameter_covariance.noise

    @property
    def space(self) -> Parameters:
        """The free parameters."""
        return self.bounds.space

    @property
    def k(self) -> Float[Array, "*batch"] | None:
        """k = measured / nominal, where the capture holds reference lengths."""
        return None if self.scale is None else self.scale.value

    @property
    def implausible_residual(self) -> bool:
        """Whether the residual is a hundred times what an arm of this size can be, so that data and arm do not fit."""
        given = None if self.reduced_chi is None else self.noise
        return float(self.after.rms) > largest_plausible_residual(self.arm, given)

    @property
    def converged(self) -> Bool[Array | np.ndarray, "*batch"]:
        """Whether the solve ended at a minimum."""
        return converged(self.result)

    def active_names(self) -> dict[str, str]:
        """Parameters on a bound: name -> 'lower' or 'upper'."""
        return active_names(self.space, self.active)


class Calibration(eqx.Module):
    """Result of both stages, or of the joint solve. ``covariance`` is in the order of ``space.names``; mm and rad."""

    arm: Arm
    parameters: Float[Array, " p"]
    scale: Scale  # k of stage 1
    de: Float[Array, ""]  # mean distance from the centroid, mm
    deltam: Float[Array, ""]  # largest half range, mm
    active: Int[Array, " p"]  # -1 on the lower bound, +1 on the upper, 0 inside
    steps: Int[Array, ""]  # evaluations of all solves
    result: Reason  # why the last solve ended
    parameter_covariance: ParameterCovariance
    before: Repeatability
    after: Repeatability
    length_before: Float[Array, " l"]  # measured reference lengths, mm: at the start
    length_after: Float[Array, " l"]  # by the calibrated arm
    stage1: Identification
    method: str = eqx.field(static=True)

    @property
    def covariance(self) -> Float[Array, "*batch p p"]:
        """Covariance of the parameters; that of what is determined, where not all is."""
        return self.parameter_covariance.matrix

    @property
    def determined(self) -> Bool[Array, "*batch p"]:
        """Which parameters are determined one by one, and not only in combination with others."""
        return self.parameter_covariance.determined

    @property
    def noise(self) -> Noise:
        """Noise of readings and seat: as given, or as estimated from the residuals."""
        return self.parameter_covariance.noise

    @property
    def k(self) -> Float[Array, "*batch"]:
        """k = measured / nominal of stage 1."""
        return self.scale.value

    @property
    def hold(self) -> str | None:
        """The scale anchor of stage 1."""
        return self.stage1.hold

    @property
    def scale_set_by(self) -> tuple[str, ...]:
        """Fixed lengths that set the scale, so that k changes nothing in a two-stage calibration."""
        return self.stage1.scale_set_by

    @property
    def implausible_residual(self) -> bool:
        """Whether the residual is a hundred times what an arm of this size can be, so that data and arm do not fit."""
        given = None if self.stage1.reduced_chi is None else self.noise
        return float(self.after.rms) > largest_plausible_residual(self.arm, given)

    @property
    def noise_model(self) -> NoiseModel:
        """Model of the tips' errors behind the covariance."""
        return self.stage1.noise_model

    @property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom behind the covariance; infinite where the noise was given."""
        return self.stage1.degrees_of_freedom

    @property
    def space(self) -> Parameters:
        """The free parameters."""
        return self.stage1.space

    @property
    def bounds(self) -> Bounds:
        """The box of the identification."""
        return self.stage1.bounds

    @property
    def converged(self) -> Bool[Array | np.ndarray, "*batch"]:
        """Whether every solve ended at a minimum."""
        both = self.stage1.converged & converged(self.result)
        return np.asarray(both) if is_concrete(both) else both

    def active_names(self) -> dict[str, str]:
        """Parameters on a bound: name -> 'lower' or 'upper'."""
        return active_names(self.space, self.active)


def converged(result: Reason) -> Bool[Array | np.ndarray, "*batch"]:
    """Whether a reason means that a minimum was reached."""
    number = numbers_of(result)
    good = np.array(_GOOD, dtype=number.dtype)
    return np.asarray(np.isin(np.asarray(number), good)) if is_concrete(number) else jnp.isin(number, good)


def active_names(space: Parameters, active: Numbers) -> dict[str, str]:
    """Parameters on a bound: name -> 'lower' or 'upper'."""
    return {
        name: "lower" if side < 0 else "upper"
        for name, side in zip(space.names, np.asarray(active), strict=True)
        if side
    }


class LeftOut(NamedTuple):
    """One group of sockets that an arm was not identified from; mm. Predictions are infinite where the other groups
    leave a direction open that matters."""

    sockets: tuple[str, ...]
    poses: int  # in sockets with more than one
    rms: float  # distance from the socket's centroid, found
    rms_predicted: float  # root of the mean square that the uncertainty predicts
    length_error: Float[np.ndarray, " l"]
    length_u: Float[np.ndarray, " l"]  # standard uncertainty of that error, predicted
    converged: bool


class CrossValidation(NamedTuple):
    """Every group of sockets left out once. The metrics pool the groups that the others can predict."""

    groups: tuple[LeftOut, ...]

    @property
    def rms(self) -> float:
        """Root mean square distance from the socket's centroid over the poses of all groups, mm."""
        return self._pooled([group.rms for group in self.groups])

    @property
    def rms_predicted(self) -> float:
        """What the uncertainties of the calibrations without them predicted, mm."""
        return self._pooled([group.rms_predicted for group in self.groups])

    def _pooled(self, values: list[float]) -> float:
        counted = [
            (group.poses, value)
            for group, value in zip(self.groups, values, strict=True)
            if group.poses and np.isfinite(group.rms_predicted)
        ]
        total = sum(poses for poses, _ in counted)
        return float(np.sqrt(sum(poses * value**2 for poses, value in counted) / total)) if total else float("nan")

    def _lengths(self) -> tuple[np.ndarray, np.ndarray]:
        errors, u = (
            np.concatenate([getattr(group, what) for group in self.groups]) for what in ("length_error", "length_u")
        )
        return errors[np.isfinite(u)], u[np.isfinite(u)]

    @property
    def length_rms(self) -> float:
        """Root mean square error of the reference lengths, mm."""
        errors, _ = self._lengths()
        return float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")

    @property
    def length_u(self) -> float:
        """Root mean square of the predicted standard uncertainties of these errors, mm."""
        _, u = self._lengths()
        return float(np.sqrt(np.mean(u**2))) if len(u) else float("nan")

    @property
    def open(self) -> int:
        """How many groups the others cannot predict, because without them something is not determined."""
        return sum(not np.all(np.isfinite(group.length_u)) or group.rms_predicted == np.inf for group in self.groups)

    def ratios(self) -> list[tuple[float, int]]:
        """Found over predicted, of poses and of lengths, and the number of values behind each, where they are known."""
        pairs = [
            (self.rms, self.rms_predicted, 3 * sum(group.poses for group in self.groups)),
            (self.length_rms, self.length_u, len(self._lengths()[0])),
        ]
        return [(found / predicted, count) for found, predicted, count in pairs if predicted > 0 and np.isfinite(found)]

    @property
    def excess(self) -> float:
        """Errors over their prediction, the larger of both ratios: about 1 where the uncertainty is right."""
        return max((ratio for ratio, _ in self.ratios()), default=float("nan"))

    @property
    def surprising(self) -> bool:
        """Whether errors exceed their prediction by half, and by more than chance allows in one case of a hundred."""
        from scipy import stats

        return any(ratio > max(1.5, math.sqrt(stats.chi2.ppf(0.99, count) / count)) for ratio, count in self.ratios())
