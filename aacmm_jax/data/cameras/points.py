"""A camera that measures points in space, such as a stereo rig or an RGB-D camera."""

import numpy as np
from jaxtyping import Float

from ...core.numpy_or_jax import AnyArray, namespace
from .camera import AbstractCamera, Projected


class PointCamera(AbstractCamera):
    """What it measures are the coordinates of points in its own frame, mm."""

    name = "points"
    dimension = 3
    unit = "mm"
    names = ()
    counts = (0,)

    def project(self, points: Float[AnyArray, "3 ..."], intrinsics: Float[AnyArray, "k ..."]) -> Projected:
        xp = namespace(points, intrinsics)
        identity = xp.asarray(np.eye(3)).reshape(3, 3, *(1,) * (points.ndim - 1))
        by_point = xp.broadcast_to(identity, (3, *points.shape))
        return Projected(points, by_point, xp.zeros((0, *points.shape)))

    def directions(self, values: Float[np.ndarray, "d ..."], intrinsics: Float[np.ndarray, " k"]) -> np.ndarray:
        size = np.linalg.norm(values, axis=0)
        return values / np.where(size > 0, size, 1.0)
