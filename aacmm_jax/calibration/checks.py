"""What is checked before a solve, and which length is held during it."""

import jax
import numpy as np
from jaxtyping import Array

from ..core.arrays import is_concrete
from ..core.errors import InputError
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm, locate, parameter_names
from ..kinematics.parameters import Bounds, Parameters, is_length
from ..uncertainty.covariance import FORMS, Form

_PLAUSIBLE_SCALE = (0.5, 2.0)


def based_on(space: Parameters, arm: Arm) -> Parameters:
    """The free parameters on the given arm: held values come from the arm that is calibrated, not from the space's base."""
    if arm.beta is None and space.base.beta is not None:
        return space
    return Parameters(base=arm, names=space.names)


def held_length(space: Parameters, arm: Arm, hold: str | None) -> str | None:
    """The length that stage 1 holds: the one named; or, for "longest", the longest free link if the scale is free at all.

    Raises `InputError` for an angle, a parameter that is not free, or an arm whose values cannot be looked at.
    """
    lengths = [name for name in space.names if is_length(name)]
    if hold is None or (hold == "longest" and (not lengths or len(space.names) == 1)):
        return None
    if hold != "longest":
        if hold not in lengths:
            space.index(hold)
            raise InputError(f"hold is '{hold}', which is an angle; hold a length, for example '{lengths[0]}'.")
        return hold
    if not is_concrete(*jax.tree.leaves(arm)):
        raise InputError(
            "hold='longest' needs an arm with known values; where the arm itself is traced, name the length to hold."
        )
    if not scale_is_free(arm, space):
        return None
    links = [name for name in lengths if not name.startswith("probe")] or lengths
    return max(links, key=lambda name: np.abs(value_of(arm, name)).max())


def scale_is_free(arm: Arm, space: Parameters) -> bool:
    """Whether repeatability leaves the scale open: stretching the *held* lengths too can be imitated by the free parameters.

    It cannot where a held length matters (say d_3, known from a drawing): then the scale is known and nothing more may be
    held. It can where the held ones are zero, or redundant with free ones (d_7 with a probe along the same axis).
    """
    held = [n for n in parameter_names(arm) if n not in space.names and is_length(n) and n != "d_1"]
    held = [name for name in held if np.any(value_of(arm, name) != 0)]
    if not held:
        return True
    if arm.alpha.ndim > 1:
        arm = jax.tree.map(lambda leaf: leaf.reshape(-1, leaf.shape[-1])[0], arm)
    poses = np.random.default_rng(0).uniform(-np.pi, np.pi, (2 * len(space.names) + 10, arm.joints))
    with jax.ensure_compile_time_eval():
        columns = np.asarray(arm.jacobian(poses, [*space.names, *held]))
        scale = np.asarray(space.scale)
    columns = (columns - columns.mean(axis=0)).reshape(-1, columns.shape[-1])
    free, stretch = columns[:, : -len(held)] * scale, columns[:, -len(held) :] @ np.array([value_of(arm, n) for n in held])
    left = stretch - free @ np.linalg.lstsq(free, stretch, rcond=1e-10)[0]
    return bool(np.linalg.norm(left) <= 1e-6 * np.linalg.norm(stretch))


def value_of(arm: Arm, name: str) -> np.ndarray:
    """Value of a named parameter of a concrete arm, mm or rad; with the arm's batch, if it has one."""
    # Read with NumPy: under jit even a constant arm's values become tracers once JAX computes with them.
    kind, i = locate(arm, name)
    return np.asarray(getattr(arm, kind))[..., i]


def check_fit(capture: Capture, space: Parameters) -> None:
    """Raise `InputError` where capture and arm differ in their number of joints."""
    if capture.joints != space.base.joints:
        raise InputError(
            f"the capture has {capture.joints} columns, but the arm has {space.base.joints} joints; give one column a joint."
        )


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


def check_form(form: Form | None, noise: Noise | None, joints: int) -> Form:
    """What errors of tips are taken for: by default the noise that is given, else one estimated from the residuals."""
    if noise is not None:
        noise.check(joints)
    if form is None:
        return "estimated" if noise is None else "given"
    if form not in FORMS:
        raise InputError(f"form is '{form}'; it must be one of {', '.join(FORMS)}.")
    if form == "given" and noise is None:
        raise InputError("form='given' needs the noise; give noise=aj.Noise(encoder_arcsec=..., seating=...).")
    if form == "estimated" and noise is not None:
        raise InputError("the noise is given, so it is not estimated; leave out noise, or choose another form.")
    return form


def plausible(k: float) -> bool:
    """Whether a scale can be a calibration's at all, and not a mistaken unit or socket."""
    return _PLAUSIBLE_SCALE[0] <= k <= _PLAUSIBLE_SCALE[1]
