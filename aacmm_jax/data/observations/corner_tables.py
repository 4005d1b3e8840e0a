"""Observations of a camera from a table of corners, and what is known of the camera beforehand."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...core.arguments import OneOf, checked
from ...core.arrays import Numbers
from ...core.errors import InputError
from ..cameras.camera import camera_models
from ..cameras.views import CameraCalibration, Corners, calibrated_camera, started_intrinsics
from .pixels import Pixels

_FAR = 5.0  # robust standard deviations, beyond which a corner takes no part in a start
_LEAST_U = 1e-3  # px
_MISFIT, _BETTER = 1.0, 3.0  # px RMS that stated intrinsics leave, if others leave less by this factor: a mistake


class Camera(NamedTuple):
    """What is known of a camera before the calibration.

    Args:
        name: Name of the camera.
        model: Name of its model.
        intrinsics: Their values, in the order of the model; None if nothing is known of them.
        u: Standard uncertainties, one or one for each: 0 for exact values, infinite for values that are only a start;
            None for infinite.
        image_size: Width and height of its images, px.
        coefficients: How many numbers describe its distortion, if ``intrinsics`` is None.

    Example:
        >>> known = aj.data.observations.Camera("webcam", intrinsics=(600, 600, 320, 240), u=(5, 5, 3, 3))
    """

    name: str
    model: str = "pinhole"
    intrinsics: Numbers | None = None
    u: Numbers | None = None
    image_size: Sequence[float] | None = None
    coefficients: int | None = None


class CornerTable(NamedTuple):
    """Corners that images show, one in each row.

    Args:
        image: Number of the image, and of the pose in which it was taken, from 0 ``(N,)``.
        ids: Identifier of the point of the target ``(N,)``.
        corners: Where it was seen ``(N, d)``, px; mm for a camera that measures points.
        u: Standard deviation of a coordinate, one or one for each ``(N, d)``; None to take it from the scatter of the
            corners about the best view of each image.
        names: Names of the images, in their order.

    Example:
        >>> table = aj.data.observations.CornerTable([0, 0], [7, 8], [(100.2, 50.1), (140.9, 50.4)], u=0.3)
    """

    image: Numbers
    ids: Numbers
    corners: Numbers
    u: Numbers | None = None
    names: Sequence[str] | None = None


def pixels_of(
    name: str, q: Numbers, table: CornerTable, target: Any, camera: Camera, board: str = "board", on_arm: bool = True
) -> Pixels:
    """The observation that a table of corners states. Every row of the table is in it.

    Args:
        name: Name of the observation.
        q: Joint readings of each image ``(m, n)``.
        table: The corners.
        target: Its ``ids`` ``(k,)``, ``points`` ``(k, 3)`` in mm, and ``u_scale``, as the records of `data.targets`
            have them.
        camera: What is known of the camera. Intrinsics that are not, and the start of free ones, come from the corners.
        board: Name of the target.
        on_arm: Whether the camera is on the arm, and the target stands still.

    Raises:
        InputError: a point is unknown to the target or occurs twice in an image, an image has no corners or no pose, or
            the corners do not show the intrinsics.

    Example:
        >>> from types import SimpleNamespace
        >>> camera = aj.data.observations.Camera("webcam", intrinsics=(600, 600, 320, 240), u=0)
        >>> target = SimpleNamespace(ids=range(4), points=[(0, 0, 0), (50, 0, 0), (0, 40, 0), (50, 40, 0)], u_scale=0)
        >>> corners = [(100, 100), (200, 100), (100, 180), (200, 180)]
        >>> table = aj.data.observations.CornerTable([0] * 4, range(4), corners, u=0.3)
        >>> eye = aj.data.observations.pixels_of("eye", np.zeros((1, 6)), table, target, camera)
        >>> print(eye.corners.shape, [*eye.unknowns])
        (1, 4, 2) ['frame of board', 'orientation of webcam']
    """
    where, m = f"observation '{name}'", len(np.asarray(q))
    image, ids = (_whole(getattr(table, field), f"{field} of {where}") for field in ("image", "ids"))
    corners = np.asarray(checked(table.corners, Float[np.ndarray, "N d"], f"corners of {where}"))
    OneOf(camera_models())(camera.model, f"the model of camera '{camera.name}'")
    of_target = _points_of(target, ids, image, where)
    order, counts = _ordered(image, ids, m, where)
    c = int(counts.max())
    place = image[order], np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    filled = {"ids": np.full((m, c), -1), "corners": np.zeros((m, c, corners.shape[1])), "points": np.zeros((m, c, 3))}
    for field, values in (("ids", ids), ("corners", corners), ("points", of_target)):
        filled[field][place] = values[order]
    u = np.ones_like(filled["corners"])
    if table.u is not None:
        u[place] = np.broadcast_to(np.asarray(table.u, dtype=float), corners.shape)[order]
    model, present = camera_models()[camera.model], filled["ids"] >= 0
    seen = Corners(model, filled["corners"], filled["points"], present, u)
    intrinsics, u_intrinsics, alone = _started(seen, camera)
    if table.u is None:
        u = u * max(alone.chi if alone.degrees_of_freedom > 0 else 1.0, _LEAST_U)
    made = Pixels(
        name,
        q,
        **filled,
        u=u,
        camera=camera.name,
        board=board,
        on_arm=on_arm,
        model=camera.model,
        intrinsics=intrinsics,
        u_intrinsics=u_intrinsics,
        image_size=camera.image_size,
        images=None if table.names is None else tuple(table.names),
        u_scale=float(getattr(target, "u_scale", 0.0)),
    )
    _check_intrinsics(seen, camera, u_intrinsics, alone)
    return made


def _whole(values: Numbers, what: str) -> np.ndarray:
    array = np.asarray(checked(values, Float[np.ndarray, " N"], what))
    if not np.array_equal(array, np.round(array)):
        raise InputError(f"{what} contains a number that is not whole; give whole numbers.")
    return array.astype(int)


def _points_of(target: Any, ids: np.ndarray, image: np.ndarray, where: str) -> Float[np.ndarray, "N 3"]:
    """The points with these identifiers."""
    known = {
        int(i): point for i, point in zip(np.asarray(target.ids), np.asarray(target.points, dtype=float), strict=True)
    }
    for i, number in zip(ids, image, strict=True):
        if int(i) not in known:
            raise InputError(
                f"{where}: image {number + 1} shows the point {i}, which the target does not have (it has "
                f"{min(known)} to {max(known)}); check the target."
            )
    return np.array([known[int(i)] for i in ids]).reshape(-1, 3)


def _ordered(image: np.ndarray, ids: np.ndarray, m: int, where: str) -> tuple[np.ndarray, np.ndarray]:
    """The order of the rows by image, and the number of corners of each."""
    if len(image) != len(ids):
        raise InputError(f"{where} has {len(image)} images and {len(ids)} ids; give one of each for every corner.")
    if len(image) and (image.min() < 0 or image.max() >= m):
        worst = image.max() if image.max() >= m else image.min()
        raise InputError(f"{where}: there is an image {worst + 1}, but {m} poses; give one pose for each image.")
    counts = np.bincount(image, minlength=m)
    if m and counts.min() == 0:
        raise InputError(f"{where}: image {int(np.argmin(counts)) + 1} has no corner; leave out its pose.")
    order = np.lexsort((ids, image))
    pairs = np.stack([image, ids], axis=1)[order]
    twice = np.flatnonzero(np.all(pairs[1:] == pairs[:-1], axis=1))
    if len(twice):
        number, i = pairs[twice[0]]
        raise InputError(f"{where}: image {number + 1} shows the point {i} twice; keep one of both.")
    return order, counts


def _started(seen: Corners, camera: Camera) -> tuple[np.ndarray, np.ndarray, CameraCalibration]:
    """Intrinsics, as stated or as the corners show them, their standard uncertainties, and the camera by itself."""
    where = f"camera '{camera.name}'"
    size = camera.image_size
    if camera.intrinsics is not None or seen.model.dimension == 3:
        stated = np.asarray(() if camera.intrinsics is None else camera.intrinsics, dtype=float)
        seen.model.check_count(len(stated), where)
        u = np.broadcast_to(np.asarray(np.inf if camera.u is None else camera.u, dtype=float), stated.shape)
    else:
        default = {"pinhole": 5}.get(camera.model, seen.model.counts[-1] - 4)
        count = 4 + (default if camera.coefficients is None else camera.coefficients)
        seen.model.check_count(count, where)
        stated, u = started_intrinsics(seen, count, _size_of(seen, size)), np.full(count, np.inf)
    prior = np.where(np.isfinite(u), np.maximum(u, 1e-12), _wide(stated))
    alone = calibrated_camera(seen, stated, u > 0, prior)
    near = ~(alone.far(seen) > _FAR)
    if not near.all():
        alone = calibrated_camera(seen._replace(present=seen.present & near), alone.intrinsics, u > 0, prior)
    return np.where(np.isfinite(u), stated, alone.intrinsics), u, alone


def _check_intrinsics(seen: Corners, camera: Camera, u: np.ndarray, alone: CameraCalibration) -> None:
    """Raise `InputError` where others than the stated intrinsics fit the corners far better."""
    if not len(u) or not np.all(np.isfinite(u)) or alone.rms < _MISFIT:
        return
    start = started_intrinsics(seen, len(u), _size_of(seen, camera.image_size))
    free = calibrated_camera(seen, start, prior=_wide(start))
    if free.rms < alone.rms / _BETTER:
        raise InputError(
            f"the stated intrinsics of camera '{camera.name}' leave residuals of {alone.rms:.2g} px RMS, and others "
            f"(fx = {free.intrinsics[0]:.0f}, fy = {free.intrinsics[1]:.0f} px) leave {free.rms:.2g} px; they may be "
            "those of another image size or camera: correct them, or state that they are free."
        )


def _wide(intrinsics: np.ndarray) -> np.ndarray:
    """Standard deviations of a wide prior, so that images which do not show a number give a start nearby."""
    sizes = [0.5 * intrinsics[:2].mean(), 0.2 * intrinsics[2:4].mean()] if len(intrinsics) else []
    return np.concatenate([np.repeat(sizes, 2), np.ones(max(len(intrinsics) - 4, 0))])


def _size_of(seen: Corners, stated: Sequence[float] | None) -> Float[np.ndarray, "2"]:
    """Width and height of the images, px; at least what the corners need."""
    return np.asarray(seen.values[seen.present].max(axis=0) + 1 if stated is None else stated, dtype=float)
