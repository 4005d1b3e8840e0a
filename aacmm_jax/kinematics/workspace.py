"""How far an arm reaches."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..data.simulation import limits_of
from .arm import Arm

_STARTS, _SWEEPS = 256, 30


class Reach(NamedTuple):
    """The ball that an arm's tip stays in, mm."""

    shoulder: Float[np.ndarray, " 3"]  # its centre: on the first axis, d_1 above the base
    radius: float


def reach_of(arm: Arm) -> Reach:
    """How far the tip can be from the shoulder within the joint limits.

    Along one joint the squared distance is a constant and a sinusoid, so three of its values tell where it is largest. From many
    starts, joint after joint is set there until nothing changes: exact but for the choice of starts, and quick.
    """
    shoulder = np.array([0.0, 0.0, float(arm.d[0])])
    limits = np.asarray(limits_of(arm, None))
    q = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (_STARTS, arm.joints))

    def squared(poses: np.ndarray) -> np.ndarray:
        return np.sum((np.asarray(arm.position(poses)) - shoulder) ** 2, axis=-1)

    best = 0.0
    for _ in range(_SWEEPS):
        for joint in range(1, arm.joints):  # the first only turns the whole arm
            turned = np.repeat(q[None], 3, axis=0)
            turned[1, :, joint], turned[2, :, joint] = q[:, joint] + 2 * np.pi / 3, q[:, joint] - 2 * np.pi / 3
            here, ahead, behind = squared(turned)
            # f(t) = c + A cos t + B sin t about the present angle.
            cosine, sine = (2 * here - ahead - behind) / 3, (ahead - behind) / np.sqrt(3)
            highest = q[:, joint] + np.arctan2(sine, cosine)
            low, high = limits[joint]
            whole = highest + 2 * np.pi * np.ceil((low - highest) / (2 * np.pi))
            ends = np.where(
                cosine * np.cos(low - q[:, joint]) + sine * np.sin(low - q[:, joint])
                > cosine * np.cos(high - q[:, joint]) + sine * np.sin(high - q[:, joint]),
                low,
                high,
            )
            q[:, joint] = np.where(whole <= high, whole, ends)
        now = float(squared(q).max())
        if now - best <= 1e-12 * now:
            break
        best = now
    return Reach(shoulder, float(np.sqrt(squared(q).max())))
