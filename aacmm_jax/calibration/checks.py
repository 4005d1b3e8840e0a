"""Checks before a solve, and whether a result is plausible at all."""

import math
import warnings

import jax
import numpy as np

from ..core._compat import inside_trace
from ..core.arguments import shown
from ..core.arrays import is_concrete
from ..core.errors import IdentifiabilityWarning, InputError
from ..core.numpy_or_jax import AnyArray
from ..data.capture import Capture
from ..data.noise import Noise, at_tip
from ..kinematics.arm import Arm, is_single
from ..kinematics.parameters import Bounds
from ..kinematics.priors import Prior
from ..kinematics.workspace import total_link_length
from ..uncertainty.covariance import NOISE_MODELS, NoiseModel
from ..uncertainty.identifiability import observability

PLAUSIBLE_SCALE = (0.5, 2.0)
# Repeatability of an arm or robot relative to the sum of its links: the paper's arm reaches 1e-5 (0.026 mm on 2.5 m).
_RELATIVE_REPEATABILITY = 1e-5
# Residuals larger by these factors come from wrong data, not from an arm: than that, and than its noise predicts.
_OVER_REPEATABILITY, _OVER_NOISE = 100.0, 10.0


def check_single(arm: Arm, capture: Capture, bounds: Bounds, many: str) -> None:
    """Raise `InputError` where an arm, a capture or bounds are a batch; ``many`` is the function that takes batches."""
    batched = {
        "arm": not is_single(arm),
        "capture": capture.q.ndim > 2,
        "bounds": max(bounds.lower.ndim, bounds.upper.ndim) > 1,
    }
    found = [what for what, batch in batched.items() if batch]
    if found:
        raise InputError(
            f"the {' and the '.join(found)} given are a batch, but one problem is solved here; use {many}."
        )


def check_start(bounds: Bounds, vector: AnyArray, what: str) -> None:
    """Raise `InputError` where a start is not one value a parameter, inside the box."""
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
            f"{what} is outside the bounds: {bounds.space.names[i]} is {values[i]:g}, not within {lower[i]:g} to "
            f"{upper[i]:g}; move the start or widen the bounds."
        )


def check_enough(sizes: tuple[int, ...], unknowns: int) -> None:
    """Raise `InputError` where poses are too few: m poses in a socket give 3 (m - 1) equations."""
    equations = 3 * sum(size - 1 for size in sizes)
    if equations < unknowns:
        sockets, poses = len(sizes), sum(sizes)
        needed = -(-unknowns // 3) + sockets
        raise InputError(
            f"{poses} poses in {sockets} socket{'s' if sockets > 1 else ''} give {equations} equations, but {unknowns} "
            f"unknowns need at least {needed} poses; record more poses or hold more parameters."
        )


def check_identifiable(capture: Capture, bounds: Bounds, prior: Prior | None, strict: bool) -> None:
    """Warn of, or with ``strict`` refuse, free parameters that these data cannot determine; not of traced values."""
    if inside_trace() or not is_concrete(*jax.tree.leaves((capture, bounds))):
        return
    space = bounds.space
    known = None if prior is None else prior.of(space.names, space.vector())
    named = () if known is None else tuple(space.names[i] for i in known.index)
    seen = observability(space.base, capture, space, known=named)
    sentences, lost = seen.sentences(), seen._replace(by_prior=()).sentences()
    if lost and strict:
        raise InputError(" ".join(lost))
    for sentence in sentences:
        warnings.warn(sentence, IdentifiabilityWarning, stacklevel=4)


def check_method(method: str, general: bool) -> None:
    """Refuse an unknown method, and two stages where observations are ``general``: more than sockets and lengths."""
    if not isinstance(method, str) or method not in ("two-stage", "joint"):
        raise InputError(f"method is {shown(method)}; it must be 'two-stage' or 'joint'.")
    if method == "two-stage" and general:
        raise InputError(
            "method='two-stage' is for sockets with reference lengths, without a robust loss, a prior and covariances "
            "of batches; use method='joint'."
        )


def check_noise_model(noise_model: NoiseModel | None, noise: Noise | None, joints: int) -> NoiseModel:
    """The model of the tips' errors: by default the noise that is given, else one estimated from the residuals."""
    if noise is not None:
        noise.check(joints)
    if noise_model is None:
        return "estimated" if noise is None else "given"
    if noise_model not in NOISE_MODELS:
        raise InputError(f"noise_model is '{noise_model}'; it must be one of {', '.join(NOISE_MODELS)}.")
    if noise_model == "given" and noise is None:
        raise InputError("noise_model='given' needs the noise; give noise=aj.Noise(encoder_arcsec=..., seating=...).")
    if noise_model == "estimated" and noise is not None:
        raise InputError("the noise is given, so it is not estimated; leave out noise, or choose another noise_model.")
    return noise_model


def plausible(k: float) -> bool:
    """Whether a scale can be a calibration's at all, and not a mistaken unit or socket."""
    return PLAUSIBLE_SCALE[0] <= k <= PLAUSIBLE_SCALE[1]


def largest_plausible_residual(arm: Arm, *noises: Noise | None) -> float:
    """RMS distance from the sockets' centroids, mm, above which data and arm do not belong together.

    A hundred times the repeatability of a good arm of this size, or, where that is more, ten times what one of the
    noises predicts at full reach: that which was given, and that which is usual for the class of the arm.
    """
    size = total_link_length(arm)
    predicted = [math.sqrt(3) * math.hypot(*at_tip(noise, arm, size)) for noise in noises if noise is not None]
    return max([_OVER_REPEATABILITY * _RELATIVE_REPEATABILITY * size, *(_OVER_NOISE * each for each in predicted)])
