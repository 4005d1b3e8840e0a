"""Poses of an arm as lines in space."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .arm import Arm
from .chain import turns_of, walk
from .independence import in_blocks


def corners(arm: Arm, q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m c 3"]:
    """Corners of the arm in each pose, mm: the base, for each joint the end of its offset and of its link, and the tip (``c`` = 2 n + 2)."""

    def lines(rows: np.ndarray) -> np.ndarray:
        walked = walk(arm.geometry, turns_of(jnp.asarray(rows)))
        before, after, axis = (
            np.asarray(part).reshape(arm.joints, 3, -1) for part in (walked.origin_before, walked.origin, walked.z_before)
        )
        offset = before + np.asarray(arm.d)[:, None, None] * axis
        both = np.stack([offset, after], axis=1).reshape(2 * arm.joints, 3, -1)
        tip = np.asarray(walked.tip).reshape(1, 3, -1)
        return np.concatenate([np.zeros_like(tip), both, tip]).transpose(2, 0, 1)

    return in_blocks(lines, np.asarray(q))
