"""What identifications and calibrations, of one and of many, return: fields of the same names.

One is a PyTree of arrays of JAX, also under jit, vmap and derivatives; many are NumPy's arrays with the batch axis
first, without what costs more than the solve.
"""

import math
from typing import Any, NamedTuple, Union

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core._compat import member_numbers
from ..core.arrays import Numbers, is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace, to_numpy
from ..data.noise import Noise, at_tip
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters
from ..kinematics.workspace import total_link_length
from ..model.scale import Scale
from ..model.sockets import Repeatability
from ..solver.reason import Reason
from ..uncertainty.covariance import NoiseModel, ParameterCovariance, SharedErrors
from .scale_anchor import ScaleAnchor

_GOOD = [int(member_numbers(reason)) for reason in (Reason.gradient, Reason.step, Reason.rounding)]
PLAUSIBLE_SCALE = (0.5, 2.0)
# Repeatability of an arm or robot relative to the sum of its links: the paper's arm reaches 1e-5 (0.026 mm on 2.5 m).
_RELATIVE_REPEATABILITY = 1e-5
# Residuals larger by these factors than that are looked into; and come from wrong data, not from an arm, because they
# exceed what a nominal arm leaves before it is calibrated (0.5 % of its size). What is stated (noise of the arm,
# uncertainty of what was measured) may be this many times too small.
_UNUSUAL, _OVER_REPEATABILITY, _OVER_STATED = 100.0, 500.0, 10.0


class PriorMetrics(eqx.Module):
    """What a prior was, and what the data made of it: group by group, and parameter by parameter."""

    groups: tuple[str, ...] = eqx.field(static=True)
    learned: tuple[bool, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)  # of each group's standard deviation
    parameters: tuple[int, ...] = eqx.field(static=True)  # how many have the prior of the group
    sd: Float[AnyArray, " g"]  # standard deviation, given or learned
    effective: Float[AnyArray, " g"]  # how many of its parameters the data determine (the rest the prior does)
    supported: Bool[AnyArray, " g"]  # False where the data support no deviation from the mean
    names: tuple[str, ...] = eqx.field(static=True)  # of the parameters, without the scale anchor
    mean: Float[AnyArray, " q"]  # mm and rad
    weight: Float[AnyArray, " q"]  # one over the standard deviation, 1/mm and 1/rad; 0 without a prior

    @property
    def with_prior(self) -> tuple[str, ...]:
        """Names of the parameters that have a prior."""
        return tuple(name for name, weight in zip(self.names, np.asarray(self.weight), strict=True) if weight > 0)


class NoisyEncoder(NamedTuple):
    """An encoder whose readings are noisier than expected; standard deviations in rad, or mm of a prismatic joint."""

    joint: int  # from 1
    expected: float  # as it was given, or as that of the others is
    found: float
    u: float  # standard uncertainty of ``found``
    probability: float  # of such residuals or larger ones, where the noise is as expected


class ObservedMetrics(eqx.Module):
    """How the observations of a capture agree with their geometry, and that geometry; in their order, sockets first."""

    names: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    rms_before: Float[AnyArray, " k"]  # root mean square distance from the geometry at the start, mm
    rms_after: Float[AnyArray, " k"]  # by the arm found, mm
    reduced_chi: Float[AnyArray, " k"]  # root mean square in standard deviations of a residual
    reduced_chi_of_all: Float[AnyArray, ""]  # over the degrees of freedom of all
    sigma: Float[AnyArray, ""]  # standard deviation of a tip coordinate, mm, estimated from the residuals
    geometry: dict[str, Float[AnyArray, " _"]]  # part of the unknown geometry -> its numbers, mm and rad
    geometry_covariance: dict[str, Float[AnyArray, "_ _"]]  # of the numbers of each part
    weights: tuple[Float[AnyArray, " _"], ...]  # of every pose; less than 1 where a robust loss takes weight from it

    @property
    def rms(self) -> float:
        """Root mean square distance of all poses from their geometry, by the arm found, mm."""
        poses = [len(weights) for weights in self.weights]
        return float(np.sqrt(np.average(np.asarray(self.rms_after) ** 2, weights=poses)))


class AbstractResult(eqx.Module):
    """What the results of stage 1 and of a calibration have in common, of one problem and of many."""

    result: eqx.AbstractVar[Reason]
    parameters: eqx.AbstractVar[Float[AnyArray, "*batch p"]]
    stage1: eqx.AbstractVar[Union["Identification", "ManyIdentifications"]]  # of stage 1 itself, the result

    @property
    def space(self) -> Parameters:
        """The free parameters."""
        return self.stage1.bounds.space

    @property
    def hold(self) -> str | None:
        """The scale anchor of stage 1."""
        return self.stage1.anchor.hold

    @property
    def scale_set_by(self) -> tuple[str, ...]:
        """Fixed lengths that set the scale, so that k changes nothing in a two-stage calibration."""
        return self.stage1.anchor.set_by

    @property
    def converged(self) -> Bool[AnyArray, "*batch"]:
        """Whether every solve ended at a minimum, with finite parameters and, in a calibration, a plausible k."""
        parameters, k = to_numpy((self.parameters, self.stage1.k))
        xp = namespace(parameters)
        good = converged(self.stage1.result) & converged(self.result) & xp.all(xp.isfinite(parameters), axis=-1)
        if k is not None and self.stage1 is not self:
            good = good & plausible(k)
        return np.asarray(good) if is_concrete(good) else good


class AbstractSingleResult(AbstractResult):
    """What an `Identification` and a `Calibration` have in common; mm and rad."""

    stage1: eqx.AbstractVar["Identification"]
    arm: Arm
    parameters: Float[AnyArray, " p"]
    de: Float[AnyArray, ""]  # mean distance from the centroid, mm
    deltam: Float[AnyArray, ""]  # largest half range, mm
    active: Int[AnyArray, " p"]  # -1 on the lower bound, +1 on the upper, 0 inside
    steps: Int[AnyArray, ""]  # evaluations of all solves
    result: Reason  # why the last solve ended
    scale: Scale | None  # k of stage 1, where the capture holds reference lengths
    # Of stage 1 given the scale anchor: its rows are 0, and those of active parameters but for near-degenerate
    # directions.
    parameter_covariance: ParameterCovariance
    before: Repeatability  # the start
    after: Repeatability
    observed: ObservedMetrics  # how the observations agree, sockets first

    @property
    def k(self) -> Float[AnyArray, "*batch"] | None:
        """k = measured / nominal of stage 1, where the capture holds reference lengths."""
        return None if self.scale is None else self.scale.value

    @property
    def covariance(self) -> Float[AnyArray, "*batch p p"]:
        """Covariance of the parameters; that of what is determined, where not all is."""
        return self.parameter_covariance.matrix

    @property
    def determined(self) -> Bool[AnyArray, "*batch p"]:
        """Which parameters are determined one by one, and not only in combination with others."""
        return self.parameter_covariance.determined

    @property
    def noise(self) -> Noise:
        """Noise of readings and seat: as given, or as estimated from the residuals."""
        return self.parameter_covariance.noise

    @property
    def prior(self) -> PriorMetrics | None:
        """The prior, where one was given, with its learned standard deviations and effective parameters."""
        return self.stage1.prior_metrics

    @property
    def degrees_of_freedom(self) -> Float[AnyArray, "*batch"] | float:
        """Degrees of freedom behind the covariance, equations less effective parameters; infinite where the noise was
        given."""
        fitted, prior = self.stage1.fitted_degrees_of_freedom, self.prior
        if prior is None:
            return max(fitted, 1.0)
        effective = np.asarray(prior.effective) if is_concrete(prior.effective) else prior.effective
        spared = sum(prior.parameters) - namespace(effective).sum(effective)  # NumPy compiles nothing
        if is_concrete(spared) and np.ndim(spared) == 0:
            return max(fitted + float(spared), 1.0)
        return namespace(spared).maximum(fitted + spared, 1.0)

    @property
    def given_noise(self) -> Noise | None:
        """The noise, where it was given and not estimated."""
        return None if self.stage1.reduced_chi is None else self.noise

    @property
    def weighting_noise(self) -> Noise | None:
        """The noise by which poses were weighted: given, or estimated by joint; None where all count alike."""
        return self.noise if self.stage1.noisy_encoders else self.given_noise

    @property
    def implausible_residual(self) -> bool:
        """Whether the residual is larger than that of an arm of this size with such noise, so that data and arm do not
        belong together. Only a record has what is usual for a class of arms (`calibration.record_of`)."""
        self._check_single()
        return float(self.after.rms) > largest_plausible_residual(self.arm, self.given_noise)

    def active_names(self) -> dict[str, str]:
        """Parameters on a bound: name -> 'lower' or 'upper'."""
        self._check_single()
        return active_names(self.space, self.active)

    def _check_single(self) -> None:
        if self.active.ndim != 1 or not is_concrete(self.active):
            raise InputError(
                "this result is a batch, or is traced by jit or vmap, where its values are not known; outside jit "
                "and vmap, select one result of the batch: jax.tree.map(lambda leaf: leaf[0], results)."
            )


class Identification(AbstractSingleResult):
    """Result of stage 1. A PyTree: under ``eqx.filter_vmap`` every array has the batch axis first.

    ``parameters``, ``active`` and ``covariance`` are in the order of ``space.names``; mm and rad.

    Example:
        >>> stage1 = aj.identify(arm, capture, bounds)
        >>> print(f"nominal {stage1.before.de:.3f} mm, identified {stage1.de:.4f} mm")
        nominal 1.880 mm, identified 0.0124 mm
        >>> print(dict(zip(stage1.space.names[9:12], stage1.parameters[9:12].round(3).tolist())))
        {'a_5': 0.159, 'd_2': 0.137, 'd_3': 750.0}
    """

    optimality: Float[AnyArray, ""]  # projected gradient as a cosine; 0 at a minimum
    # Root mean square of the residuals in units of what the given noise predicts (1 where it is right), or None.
    reduced_chi: Float[AnyArray, ""] | None
    bounds: Bounds
    anchor: ScaleAnchor = eqx.field(static=True)  # what sets the scale
    noise_model: NoiseModel = eqx.field(static=True)  # model of the tips' errors
    # Of the covariance, with every parameter as fitted in full; infinite where the noise was given.
    fitted_degrees_of_freedom: float = eqx.field(static=True)
    prior_metrics: PriorMetrics | None = None
    # Encoders that proved noisier than given, or than the others, and whose noise was estimated.
    noisy_encoders: tuple[NoisyEncoder, ...] = eqx.field(static=True, default=())

    @property
    def stage1(self) -> "Identification":
        """This result."""
        return self


class Calibration(AbstractSingleResult):
    """Result of both stages, or of the joint solve. ``covariance`` is in the order of ``space.names``; mm and rad.

    Example:
        >>> print(bool(result.converged), result.active.any())
        True False
        >>> u = np.sqrt(np.diag(result.covariance))
        >>> for name in ("a_5", "d_3"):
        ...     at = result.space.names.index(name)
        ...     print(f"{name} = {result.parameters[at]:.3f} mm, u = {u[at]:.3f} mm")
        a_5 = 0.160 mm, u = 0.001 mm
        d_3 = 750.579 mm, u = 0.010 mm
    """

    length_after: Float[AnyArray, " l"]  # the reference lengths as the calibrated arm measures them, mm
    stage1: Identification
    method: str = eqx.field(static=True)  # "two-stage" or "joint", as it was asked for or chosen
    # Whether the result is stage 1 divided by k; not where a bound or a fixed length stood against that, and everything
    # was solved at once, as with the method "joint".
    divided: Bool[AnyArray, ""]
    shared: SharedErrors | None = None  # shared errors, which the covariance contains; None: none were found

    @property
    def noise_model(self) -> NoiseModel:
        """Model of the tips' errors behind the covariance."""
        return self.stage1.noise_model

    @property
    def bounds(self) -> Bounds:
        """The box of the identification."""
        return self.stage1.bounds

    @property
    def noisy_encoders(self) -> tuple[NoisyEncoder, ...]:
        """Encoders that proved noisier than given, or than the others, and whose noise was estimated."""
        return self.stage1.noisy_encoders


class AbstractManyResults(AbstractResult):
    """What `ManyIdentifications` and `ManyCalibrations` have in common; mm and rad."""

    parameters: Float[np.ndarray, "b p"]
    k: Float[np.ndarray, " b"] | None  # measured / nominal of stage 1, where the capture holds reference lengths
    de: Float[np.ndarray, " b"]  # mm
    deltam: Float[np.ndarray, " b"]  # mm
    steps: Int[np.ndarray, " b"]  # evaluations of all solves
    result: Reason  # why the last solve of each ended
    active: Int[np.ndarray, "b p"]  # -1 on the lower bound, +1 on the upper, 0 inside or fixed, in the last solve
    covariance: Float[np.ndarray, "b p p"] | None = eqx.field(default=None, kw_only=True)  # where it was asked for
    # Of all observations, where there are any but sockets.
    reduced_chi: Float[np.ndarray, " b"] | None = eqx.field(default=None, kw_only=True)
    prior: PriorMetrics | None = eqx.field(default=None, kw_only=True)  # with a batch axis

    @property
    def u(self) -> Float[np.ndarray, "b p"]:
        """Standard uncertainties of the parameters, mm and rad. Raises `InputError` where they were not computed."""
        if self.covariance is None:
            raise InputError("the batch was solved without covariances; solve the batch with covariance=True.")
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def arm(self) -> Arm:
        """The arms found, as a batch; computed when it is asked for."""
        arm, batch = self.space.arm(self.parameters), self.parameters.shape[:1]
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*batch, leaf.shape[-1])), arm)


class ManyIdentifications(AbstractManyResults):
    """Results of stage 1, problem by problem, as NumPy arrays; ``parameters`` in the order of ``space.names``, mm and
    rad.

    Fields have the names of an `Identification`'s. What costs more than the solve is left out: covariance, u of the
    scale and metrics by socket come from ``jax.vmap`` of `identify` or, for one capture, of `evaluate` with ``arm``.

    Example:
        >>> many = aj.identify_many(arm, capture, [bounds.lower] * 3, [bounds.upper] * 3)
        >>> print(many.parameters.shape, many.active.any())
        (3, 21) False
    """

    sigma: Float[np.ndarray, " b"]  # ``after.sigma`` of an `Identification`, mm
    bounds: Bounds  # with a batch axis where bounds or arms were given as a batch
    anchor: ScaleAnchor = eqx.field(static=True)  # what sets the scale

    @property
    def stage1(self) -> "ManyIdentifications":
        """These results."""
        return self


class ManyCalibrations(AbstractManyResults):
    """Results of both stages, or of the joint solve, problem by problem, as NumPy arrays; mm and rad.

    Fields have the names of a `Calibration`'s; what is left out comes from ``jax.vmap`` of `calibrate`.

    Example:
        >>> drawn = [aj.simulate(true, four, poses=10, lengths=bars, noise=noise, seed=seed) for seed in (1, 2)]
        >>> many = aj.calibrate_many(arm, aj.stack_captures(drawn), bounds)
        >>> print(many.parameters.shape, many.de.shape, many.k.shape)
        (2, 21) (2,) (2,)
    """

    stage1: ManyIdentifications
    method: str = eqx.field(static=True)
    divided: Bool[np.ndarray, " b"]  # as in a `Calibration`

    @property
    def bounds(self) -> Bounds:
        """The boxes of the identifications."""
        return self.stage1.bounds


def converged(result: Reason) -> Bool[AnyArray, "*batch"]:
    """Whether a reason means that a minimum was reached.

    Args:
        result: The reason, or one for each problem of a batch.

    Example:
        >>> print(bool(aj.calibration.converged(result.result)))
        True
    """
    number = member_numbers(result)
    if is_concrete(number):
        return np.asarray(np.isin(np.asarray(number), _GOOD))
    return jnp.isin(number, np.array(_GOOD, dtype=number.dtype))


def plausible(k: Any) -> Any:
    """Whether a scale can be a calibration's at all, and not a mistaken unit or socket."""
    return (k >= PLAUSIBLE_SCALE[0]) & (k <= PLAUSIBLE_SCALE[1])


def largest_plausible_residual(
    arm: Arm, *noises: Noise | None, stated_rms: float = 0.0, only_usual: bool = False
) -> float:
    """RMS distance from the sockets' centroids, mm, above which data and arm do not belong together.

    What a nominal arm of this size leaves, or, where that is more, ten times what was stated: what one of the noises
    predicts at full reach (that which was given, and that which is usual for the class of the arm), or the RMS
    uncertainty of what was measured, ``stated_rms``, mm. ``only_usual``: above which the residuals are unusual for a
    calibrated arm of this size, so that a mistake in the data is looked for.
    """
    size = total_link_length(arm)
    predicted = [math.sqrt(3) * math.hypot(*at_tip(noise, arm, size)) for noise in noises if noise is not None]
    of_size = (_UNUSUAL if only_usual else _OVER_REPEATABILITY) * _RELATIVE_REPEATABILITY * size
    return max([of_size, *(_OVER_STATED * rms for rms in (*predicted, stated_rms))])


def active_names(space: Parameters, active: Numbers) -> dict[str, str]:
    """Parameters on a bound: name -> 'lower' or 'upper'."""
    pairs = zip(space.names, np.asarray(active), strict=True)
    return {name: "lower" if side < 0 else "upper" for name, side in pairs if side}
