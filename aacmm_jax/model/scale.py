"""The scale k, which repeatability cannot determine, from reference lengths (Cheng et al. 2018, section 2.3).

The uncertainty of k comes from the lengths and the scatter at their ends (here, `scale_and_weights`), and from the
identified parameters (`calibration.stages`).
"""

from typing import Annotated, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.arguments import NOT_EMPTY, NotNegative, Range, check_finite, checked_arguments
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace, to_jax, to_numpy
from ..core.text import shorten
from ..data.capture import Capture, check_one_capture, check_readings
from ..kinematics.arm import Arm, is_length, is_single, parameter_names
from ..kinematics.parameters import Parameters
from .sockets import means_over_sockets, repeatability

Length = Range(above=0, unit="mm")
# Names of fixed lengths that free ones can replace, and for each free parameter its weight in place of each of them.
Partners = tuple[tuple[str, ...], tuple[tuple[float, ...], ...]]


class Scale(eqx.Module):
    """k = measured / nominal with its standard uncertainty, and the lengths it was found from (mm).

    Example:
        >>> k = result.scale
        >>> print(f"{k.measured[0]:.3f} mm / {k.nominal[0]:.3f} mm = {k.value:.6f}, u = {k.u:.1e}")
        468.676 mm / 469.038 mm = 0.999229, u = 7.8e-06
    """

    value: Float[AnyArray, ""]
    u: Float[AnyArray, ""]  # conditional on active bounds: takes parameters on a bound as exact
    measured: Float[AnyArray, " l"]
    nominal: Float[AnyArray, " l"]
    surplus: Float[AnyArray, ""]  # what the lengths' disagreement, beyond what is predicted, adds to u^2


class ScaleFix(eqx.Module):
    """Result of stage 2 on its own: the arm divided by k, and k."""

    arm: Arm
    scale: Scale


def divide_lengths(
    space: Parameters,
    parameters: Float[AnyArray, "... p"],
    k: Float[AnyArray, "..."],
    partners: Partners | None = None,
) -> Float[AnyArray, "... p"]:
    """Free parameters with which the arm, its fixed lengths as they are, equals the arm with every length divided by k.

    Tips are linear in the lengths, so a fixed length f that free lengths x can replace with weights w leaves
    x' = x / k + (1 / k - 1) w f. ``d_1`` is not divided (see `divisible`). Without ``partners`` nothing is replaced.
    """
    # NumPy for arrays of NumPy: XLA rounds a division by a broadcast k differently.
    xp = namespace(parameters, k)
    rows = divisible(space), replaced_lengths(space, partners)
    divided, replaced = (xp.broadcast_to(xp.asarray(row), parameters.shape) for row in rows)
    return xp.where(divided, (parameters + replaced) / k[..., None] - replaced, parameters)


def divisible(space: Parameters) -> np.ndarray:
    """Boolean mask ``(p,)``: free lengths that the division by k changes, all but ``d_1``.

    ``d_1`` only shifts the whole base frame along the first axis. No length and no repeatability depends on it, k says
    nothing about it, and it stays as given (as in Table 2 of the paper).
    """
    return space.lengths & np.array([name != "d_1" for name in space.names])


def replaced_lengths(space: Parameters, partners: Partners | None) -> Float[AnyArray, "... p"]:
    """w f of `divide_lengths`, mm: the fixed lengths of the base arm by the weights of their partners."""
    names, weights = partners or ((), ())
    if not names:
        return np.zeros(len(space.names))
    return Parameters(space.base, names).vector() @ np.array(weights).T


def divided_arm(arm: Arm, k: Float[AnyArray, "..."]) -> Arm:
    """The arm with every length but ``d_1`` divided by k."""
    space = Parameters(arm, tuple(name for name in parameter_names(arm) if is_length(name)))
    return space.arm(divide_lengths(space, space.vector(), k))


@checked_arguments
def fix_scale(
    arm: Arm, capture: Capture, *, sigma: Annotated[float, Range(least=0, unit="mm")] | None = None
) -> ScaleFix:
    """Stage 2: k from every reference length of a capture, and the arm divided by it.

    k is the mean of measured / nominal weighted by uncertainty: the length's own u, and the scatter of the poses over
    the number of them at each end. Its standard uncertainty is the larger of what those predict and what the lengths'
    disagreement shows (the Birge ratio). It takes the arm's angles as exact; `calibrate` adds their uncertainty, and
    leaves fixed parameters as they are, where this function divides every length but ``d_1``.

    Args:
        arm: the arm as stage 1 left it.
        capture: sockets and at least one reference length.
        sigma: standard deviation of a tip coordinate, mm (stage 1's ``after.sigma``); by default the capture's own
            scatter. With one pose in every socket there is none, and u of k is NaN.

    Returns:
        The arm divided by k, and k with its standard uncertainty.

    Raises:
        InputError: the capture has no reference length.

    Example:
        >>> stage2 = aj.fix_scale(aj.identify(arm, capture, bounds).arm, capture)
        >>> print(f"k = {stage2.scale.value:.6f}, u(k) = {stage2.scale.u:.1e}")
        k = 0.999229, u(k) = 7.2e-06
    """
    if not capture.lengths:
        raise InputError(
            "the capture contains no reference length, so the scale cannot be determined; add a reference length "
            "between two of its sockets."
        )
    check_finite(arm=arm, capture=capture)
    if not is_single(arm):
        raise InputError("fix_scale needs a single arm, but this is a batch; use jax.vmap.")
    check_one_capture(capture)
    if capture.observations:
        names = shorten([observation.name for observation in capture.observations])
        raise InputError(
            f"fix_scale supports only sockets and reference lengths, but the capture has other observations ({names}); "
            "give a capture without these observations."
        )
    check_readings(capture, arm)
    arm, capture = to_numpy((arm, capture))
    tips = arm.position(capture.q)
    with np.errstate(all="ignore"):
        scatter = repeatability(tips, capture.sizes).sigma if sigma is None else namespace(tips).asarray(sigma)
        scale, _ = scale_and_weights(ends_of_sockets(tips, capture, scatter))
    return to_jax(ScaleFix(divided_arm(arm, scale.value), scale))


class MeasuredEnds(NamedTuple):
    """Positions between which lengths were measured, with their own covariances, as one arm has them; mm."""

    positions: Float[AnyArray, "e 3"]
    covariances: Float[AnyArray, "e 3 3"]  # by the scatter of the poses at each
    ends: np.ndarray  # (l, 2): which of them each length joins
    nominal: Float[AnyArray, " l"]
    u: Float[AnyArray, " l"]

    @property
    def measured(self) -> Float[AnyArray, " l"]:
        """The measured lengths."""
        between = self.positions[self.ends[:, 1]] - self.positions[self.ends[:, 0]]
        return namespace(self.positions).linalg.norm(between, axis=-1)

    @property
    def by_positions(self) -> Float[AnyArray, "l e 3"]:
        """Derivatives of the measured lengths."""
        xp, unit = namespace(self.positions), np.eye(len(self.positions))
        pull = xp.asarray(unit[self.ends[:, 1]] - unit[self.ends[:, 0]])
        between = self.positions[self.ends[:, 1]] - self.positions[self.ends[:, 0]]
        return pull[:, :, None] * (between / self.measured[:, None])[:, None, :]

    def covariance(self, scale_factor: Float[AnyArray, "..."] | float = 1.0) -> Float[AnyArray, "l l"]:
        """Of measured minus nominal lengths, mm^2, by an arm that is ``scale_factor`` times too large: each length's
        own u, and the scatter at each end, which lengths that share a socket share."""
        xp, by = namespace(self.positions, self.u, scale_factor), self.by_positions
        scatter = xp.einsum("lec,ecd,med->lm", by, self.covariances, by)
        # The least variance, (1e-12 mm)^2, only keeps a noise-free simulation's weights finite.
        return xp.diag((scale_factor * self.u) ** 2 + 1e-24) + scatter


def ends_of_sockets(tips: Float[AnyArray, "N 3"], capture: Capture, sigma: Float[AnyArray, ""]) -> MeasuredEnds:
    """The ends of a capture's lengths, at the means of their tips, given the standard deviation of a coordinate."""
    xp, pairs = namespace(tips, sigma), capture.ends()
    used, ends = np.unique(pairs, return_inverse=True)
    means = means_over_sockets(tips.T, capture.sizes).T
    covariances = sigma**2 * xp.asarray(np.eye(3)[None] / np.asarray(capture.sizes, dtype=float)[used, None, None])
    nominal, u = (xp.stack([getattr(length, name) for length in capture.lengths]) for name in ("value", "u"))
    return MeasuredEnds(means[used], covariances, ends.reshape(pairs.shape), nominal, u)


def scale_and_weights(measured: MeasuredEnds) -> tuple[Scale, Float[AnyArray, " l"]]:
    """k, and its derivative by each measured length, 1/mm; NaN where the scatter is unknown."""
    xp = namespace(measured)
    length = measured.measured
    ratio = length / measured.nominal
    weighing = measured._replace(covariances=xp.where(xp.isnan(measured.covariances), 0.0, measured.covariances))
    weight = measured.nominal**2 / xp.diagonal(weighing.covariance(ratio))
    weight_of = weight / xp.sum(weight)
    value = xp.sum(weight_of * ratio)
    relative = weight_of / measured.nominal
    predicted = relative @ measured.covariance(value) @ relative
    observed = xp.sum(weight_of * (ratio - value) ** 2) / max(ratio.shape[0] - 1, 1)
    u = xp.sqrt(xp.maximum(predicted, observed))
    return Scale(value, u, length, measured.nominal, xp.maximum(observed - predicted, 0.0)), relative


@checked_arguments
def scale_from_lengths(
    measured: Annotated[Float[AnyArray, ""] | Float[AnyArray, " l"], Length, NOT_EMPTY],
    nominal: Annotated[Float[AnyArray, ""] | Float[AnyArray, " l"], Length],
    u: NotNegative = 0.0,
) -> Scale:
    """k from repeated measurements of a length, measured / nominal (Cheng et al. 2018, section 2.3).

    The uncertainty of k combines that of the nominal value with the standard deviation of the mean of the measurements
    (JCGM 100, type A).

    Args:
        measured: lengths measured by the arm ``(l,)``, mm.
        nominal: their certified values, mm; one, or one each.
        u: standard uncertainty of the nominal value, mm, the same for all.

    Returns:
        k, its standard uncertainty, and the lengths.

    Raises:
        InputError: a length is not positive and finite, or the shapes do not fit.

    Example:
        >>> k = aj.scale_from_lengths(measured=[200.758, 200.761, 200.757], nominal=201.513, u=0.002)
        >>> print(f"k = {k.value:.6f}, u(k) = {k.u:.1e}")
        k = 0.996257, u(k) = 1.2e-05
    """
    measured = jnp.atleast_1d(jnp.asarray(measured))
    nominal = jnp.broadcast_to(jnp.asarray(nominal), measured.shape)
    ratio = measured / nominal
    count = ratio.shape[0]
    value = jnp.mean(ratio)
    repeated = jnp.sum((ratio - value) ** 2) / (max(count - 1, 1) * count)
    return Scale(value, jnp.sqrt(repeated + (value * u / jnp.mean(nominal)) ** 2), measured, nominal, repeated)
