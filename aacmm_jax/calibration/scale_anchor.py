"""Which length stage 1 holds as the anchor of the scale, and whether it needs one."""

import jax
import numpy as np

from ..core.arrays import is_concrete
from ..core.errors import InputError
from ..kinematics.arm import Arm, is_length, parameter_names, value_of
from ..kinematics.parameters import Parameters


def scale_anchor(space: Parameters, arm: Arm, hold: str | None) -> str | None:
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
    free, scale_direction = (
        columns[:, : -len(held)] * scale,
        columns[:, -len(held) :] @ np.array([value_of(arm, n) for n in held]),
    )
    left = scale_direction - free @ np.linalg.lstsq(free, scale_direction, rcond=1e-10)[0]
    return bool(np.linalg.norm(left) <= 1e-6 * np.linalg.norm(scale_direction))
