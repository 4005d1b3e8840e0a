"""What a camera saw as if an instrument had measured it: a point for each image, which searches of mistakes compare.

The view of an image says where the camera was in the target's frame, or, if the camera stands still, where the middle
of the target was in its frame. A search over hundreds of hypotheses then takes seconds.
"""

import equinox as eqx
import numpy as np

from ..core.rotations import rotation_matrix
from ..data.capture import Capture
from ..data.observations.measured import MeasuredPoints
from ..data.observations.observation import AbstractObservation
from ..data.observations.pixels import Pixels

_U = 1e-3  # of the distance: a coordinate of such a point


def with_points_of_cameras(capture: Capture) -> Capture:
    """The capture with measured points, of the same names and poses, in place of what cameras saw."""
    if not any(isinstance(part, Pixels) for part in capture.observations):
        return capture
    return eqx.tree_at(lambda c: c.observations, capture, tuple(map(_as_points, capture.observations)))


def _as_points(part: AbstractObservation) -> AbstractObservation:
    """The points of a camera; an observation of another kind, or with an image that shows too little, as it is."""
    if not isinstance(part, Pixels) or part.views is None or not np.all(np.any(part.views[:, 3:] != 0, axis=1)):
        return part
    views = np.asarray(part.views)
    turns = np.moveaxis(np.asarray(rotation_matrix(views[:, :3].T)), -1, 0)
    if part.on_arm:
        points = -np.einsum("mji,mj->mi", turns, views[:, 3:])
    else:
        points = turns @ np.asarray(part.points)[part.seen].mean(axis=0) + views[:, 3:]
    u = _U * float(np.median(np.linalg.norm(views[:, 3:], axis=1)))
    return MeasuredPoints(part.name, np.asarray(part.q), points, u=u, station=part.still, target=part.target)
