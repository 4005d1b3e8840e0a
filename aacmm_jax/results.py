"""What an identification, a calibration and a cross-validation return."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .arm import Arm
from .arrays import Numbers, is_concrete
from .covariance import Covariance, Form
from .metrics import Repeatability
from .noise import Noise
from .parameters import Bounds, Parameters
from .scale import Scale
from .steps import Reason, numbers_of

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
    spread: Covariance  # with the scale as it was held; rows of active and held parameters are 0
    before: Repeatability  # the start
    after: Repeatability
    # Root mean square of the residuals in units of what the given noise predicts (1 where it is right); None without.
    misfit: Float[Array, ""] | None
    bounds: Bounds
    hold: str | None = eqx.field(static=True)
    form: Form = eqx.field(static=True)  # what the covariance takes errors of tips for
    freedom: float = eqx.field(static=True)  # degrees of freedom behind the covariance; infinite where the noise was given

    @property
    def covariance(self) -> Float[Array, "*lanes p p"]:
        """Covariance of the parameters; that of what is determined, where not all is."""
        return self.spread.matrix

    @property
    def determined(self) -> Bool[Array, "*lanes p"]:
        """Which parameters are determined one by one, and not only in combination with others."""
        return self.spread.determined

    @property
    def noise(self) -> Noise:
        """Noise of readings and seat: as given, or as estimated from the residuals."""
        return self.spread.noise

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
    spread: Covariance
    before: Repeatability
    after: Repeatability
    length_before: Float[Array, " l"]  # measured reference lengths, mm: at the start
    length_after: Float[Array, " l"]  # by the calibrated arm
    stage1: Identification
    method: str = eqx.field(static=True)

    @property
    def covariance(self) -> Float[Array, "*lanes p p"]:
        """Covariance of the parameters; that of what is determined, where not all is."""
        return self.spread.matrix

    @property
    def determined(self) -> Bool[Array, "*lanes p"]:
        """Which parameters are determined one by one, and not only in combination with others."""
        return self.spread.determined

    @property
    def noise(self) -> Noise:
        """Noise of readings and seat: as given, or as estimated from the residuals."""
        return self.spread.noise

    @property
    def form(self) -> Form:
        """What the covariance takes errors of tips for."""
        return self.stage1.form

    @property
    def freedom(self) -> float:
        """Degrees of freedom behind the covariance; infinite where the noise was given."""
        return self.stage1.freedom

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


class LeftOut(NamedTuple):
    """One group of sockets that an arm was not identified from; mm."""

    sockets: tuple[str, ...]
    rms: float  # distance from the socket's centroid, found
    rms_predicted: float  # root of the mean square that the uncertainty predicts
    length_error: Float[np.ndarray, " l"]
    length_u: Float[np.ndarray, " l"]  # standard uncertainty of that error, predicted
    converged: bool


class CrossValidation(NamedTuple):
    """Every group of sockets left out once."""

    groups: tuple[LeftOut, ...]

    @property
    def rms(self) -> float:
        """Root mean square distance from the socket's centroid over all groups, mm."""
        return float(np.sqrt(np.mean([group.rms**2 for group in self.groups])))

    @property
    def rms_predicted(self) -> float:
        """What the uncertainties of the calibrations without them predicted, mm."""
        return float(np.sqrt(np.mean([group.rms_predicted**2 for group in self.groups])))

    @property
    def length_rms(self) -> float:
        """Root mean square error of the reference lengths, mm."""
        errors = np.concatenate([group.length_error for group in self.groups])
        return float(np.sqrt(np.mean(errors**2)))

    @property
    def length_u(self) -> float:
        """Root mean square of the predicted standard uncertainties of these errors, mm."""
        return float(np.sqrt(np.mean(np.concatenate([group.length_u for group in self.groups]) ** 2)))

    @property
    def excess(self) -> float:
        """By how much errors exceed what was predicted, the worse of both figures: 1 where the uncertainty is honest."""
        ratios = [self.rms / self.rms_predicted] if self.rms_predicted > 0 else []
        ratios += [self.length_rms / self.length_u] if self.length_u > 0 else []
        return max(ratios, default=float("nan"))
