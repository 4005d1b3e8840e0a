"""What a camera saw as if an instrument had measured it: a point for each image, which searches of mistakes compare.

The view of an image says where the camera was in the target's frame, or, if the camera stands still, where the middle
of the target was in its frame. A search over hundreds of hypotheses then takes seconds.
"""

from collections.abc import Collection

import equinox as eqx
import numpy as np
from jaxtyping import Float

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


def axes_of_cameras(capture: Capture, names: Collection[str]) -> Float[np.ndarray, "m 3 3"] | None:
    """Of each such point of these observations, the axes of what the arm carries in the frame of what stands still, as
    columns; None where one of the observations is not of a camera."""
    parts = [part for part in capture.observations if part.name in names]
    cameras = [part for part in parts if isinstance(part, Pixels)]
    if len(cameras) < len(parts):
        return None
    return np.concatenate([_turns(part).swapaxes(1, 2) if part.on_arm else _turns(part) for part in cameras])


def _turns(part: Pixels) -> Float[np.ndarray, "m 3 3"]:
    """Rotations of the views, which take directions in the target's frame to the camera's."""
    return np.moveaxis(np.asarray(rotation_matrix(np.asarray(part.views)[:, :3].T)), -1, 0)


def _as_points(part: AbstractObservation) -> AbstractObservation:
    """The points of a camera; an observation of another kind, or with an image that shows too little, as it is."""
    if not isinstance(part, Pixels) or part.views is None or not np.all(np.any(part.views[:, 3:] != 0, axis=1)):
        return part
    views = np.asarray(part.views)
    turns = _turns(part)
    if part.on_arm:
        points = -np.einsum("mji,mj->mi", turns, views[:, 3:])
    else:
        points = turns @ np.asarray(part.points)[part.seen].mean(axis=0) + views[:, 3:]
    u = _U * float(np.median(np.linalg.norm(views[:, 3:], axis=1)))
    return MeasuredPoints(part.name, np.asarray(part.q), points, u=u, station=part.still, target=part.target)
