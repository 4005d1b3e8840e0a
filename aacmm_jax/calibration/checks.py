"""What is checked before a solve, and which length is held during it."""

import numpy as np
from jaxtyping import Array

from ..core.arrays import is_concrete
from ..core.errors import InputError
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters
from ..uncertainty.covariance import NOISE_MODELS, NoiseModel

_PLAUSIBLE_SCALE = (0.5, 2.0)


def based_on(space: Parameters, arm: Arm) -> Parameters:
    """The free parameters on the given arm: held values come from the arm that is calibrated, not from the space's base."""
    if arm.beta is None and space.base.beta is not None:
        return space
    return Parameters(base=arm, names=space.names)


def check_start(bounds: Bounds, vector: Array, what: str) -> None:
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
            f"{what} is outside the bounds: {bounds.space.names[i]} is {values[i]:g}, not within {lower[i]:g} to {upper[i]:g}; "
            "move the start or widen the bounds."
        )


def check_enough(sizes: tuple[int, ...], unknowns: int) -> None:
    """A socket of m poses gives 3 (m - 1) equations: its own position takes three."""
    equations = 3 * sum(size - 1 for size in sizes)
    if equations < unknowns:
        sockets, poses = len(sizes), sum(sizes)
        needed = -(-unknowns // 3) + sockets
        raise InputError(
            f"{poses} poses in {sockets} socket{'s' if sockets > 1 else ''} give {equations} equations, but {unknowns} unknowns "
            f"need at least {needed} poses; record more poses or hold more parameters."
        )


def check_noise_model(noise_model: NoiseModel | None, noise: Noise | None, joints: int) -> NoiseModel:
    """What errors of tips are taken for: by default the noise that is given, else one estimated from the residuals."""
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
    return _PLAUSIBLE_SCALE[0] <= k <= _PLAUSIBLE_SCALE[1]
