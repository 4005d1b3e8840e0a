"""A camera alone: where its target was in each image, and its intrinsics, from corners of known points.

This needs no arm. Each image has a view: the rotation vector (rad) and the origin (mm) of the target's frame in the
camera's frame. NumPy only: these are starts of a calibration, and a calibration of the camera by itself.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...core.errors import InputError
from ...core.rotations import cross, fitted_frame, rotation_matrix, rotation_vector
from .camera import AbstractCamera

_PLANAR = 1e-3  # third singular value of points in a plane, of the first
_FOCAL_LENGTHS = np.geomspace(0.25, 8.0, 16)  # that are tried, of the image's width
_FEW = 10  # images that focal lengths are tried with
_ROUNDS = 40
_LEAST_USUAL = 0.05  # standard deviations, or px where none is known


class Corners(NamedTuple):
    """What images show of known points; absent ones have value and point 0."""

    model: AbstractCamera
    values: Float[np.ndarray, "m c d"]  # px, or mm of a camera that measures points
    points: Float[np.ndarray, "m c 3"]  # mm, in the target's frame
    present: Bool[np.ndarray, "m c"]
    u: Float[np.ndarray, "m c d"]  # standard deviations

    def select(self, images: np.ndarray) -> "Corners":
        """Some of the images."""
        return Corners(self.model, *(part[images] for part in self[1:]))


class Views(NamedTuple):
    """The target in the camera's frame."""

    rotation: Float[np.ndarray, "m 3 3"]
    origin: Float[np.ndarray, "m 3"]

    def moved(self, step: Float[np.ndarray, "m 6"]) -> "Views":
        """Turned by small rotation vectors, and shifted."""
        turn = np.moveaxis(np.asarray(rotation_matrix(step[:, :3].T)), -1, 0)
        return Views(turn @ self.rotation, self.origin + step[:, 3:])

    def where(self, chosen: Bool[np.ndarray, " m"], other: "Views") -> "Views":
        """These views where they are chosen, and else others."""
        rotation = np.where(chosen[:, None, None], self.rotation, other.rotation)
        return Views(rotation, np.where(chosen[:, None], self.origin, other.origin))

    def vectors(self) -> Float[np.ndarray, "m 6"]:
        """As rotation vectors and origins."""
        turns = [rotation_vector(rotation) for rotation in self.rotation]
        return np.concatenate([np.reshape(turns, (-1, 3)), self.origin], axis=1)


class CameraCalibration(NamedTuple):
    """A camera calibrated by itself."""

    intrinsics: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]  # by the standard deviations of the corners
    views: Float[np.ndarray, "m 6"]  # rotation vector (rad) and origin (mm) of the target in the camera's frame
    rms: float  # root mean square of the distances of corners from where the camera has them, px
    chi: float  # root of the sum of squares over its degrees of freedom, of residuals over their standard deviations
    degrees_of_freedom: float

    @property
    def u(self) -> Float[np.ndarray, " k"]:
        """Standard uncertainties of the intrinsics."""
        return np.sqrt(np.diag(self.covariance))

    def far(self, corners: Corners) -> Float[np.ndarray, "m c"]:
        """How far corners are from where the camera has them, over what is usual (1.48 medians of the coordinates);
        0 of those in images without a view."""
        turns = np.moveaxis(np.asarray(rotation_matrix(self.views[:, :3].T)), -1, 0)
        rows = _rows(corners, self.intrinsics, Views(turns, self.views[:, 3:]))[0].reshape(corners.values.shape)
        known = corners.present & np.any(self.views[:, 3:] != 0, axis=1)[:, None]
        usual = max(1.4826 * float(np.median(np.abs(rows[known]))), _LEAST_USUAL)
        return np.where(known, np.abs(rows).max(axis=2), 0.0) / usual


def _rows(
    corners: Corners, intrinsics: Float[np.ndarray, " k"], views: Views
) -> tuple[Float[np.ndarray, "m r"], Float[np.ndarray, "m r 6"], Float[np.ndarray, "m r k"]]:
    """Residuals over their standard deviations, and derivatives by small steps of the views and by the intrinsics."""
    m = len(corners.values)
    turned = np.moveaxis(corners.points @ views.rotation.swapaxes(1, 2), -1, 0)
    seen = corners.model.project(turned + views.origin.T[:, :, None], intrinsics[:, None, None])
    by_point = np.moveaxis(np.asarray(seen.by_point), 1, 0)  # (3, d, m, c)
    flat = by_point.reshape(3, -1)
    by_turn = cross(np.broadcast_to(turned[:, None], by_point.shape).reshape(3, -1), flat).reshape(by_point.shape)
    weight = (corners.present[..., None] / corners.u).reshape(m, -1)

    def rows(values: np.ndarray) -> np.ndarray:  # (..., d, m, c) to (m, r, ...)
        return np.moveaxis(values, (-3, -2, -1), (2, 0, 1)).reshape(m, weight.shape[1], *values.shape[:-3])

    by_view = rows(np.concatenate([by_turn, by_point])) * weight[..., None]
    residual = rows(np.asarray(seen.values)) - corners.values.reshape(m, -1)
    return residual * weight, by_view, rows(np.asarray(seen.by_intrinsics)) * weight[..., None]


def _refined(
    corners: Corners, intrinsics: Float[np.ndarray, " k"], views: Views, rounds: int
) -> tuple[Views, Float[np.ndarray, " m"]]:
    """Each view with the least squares from a start nearby, by Levenberg and Marquardt; and its sum of squares."""
    damping = np.full(len(corners.values), 1e-3)
    rows, by, _ = _rows(corners, intrinsics, views)
    cost = np.sum(rows**2, axis=1)
    for _ in range(rounds):
        gram, slope = by.swapaxes(1, 2) @ by, np.einsum("mri,mr->mi", by, rows)
        diagonal = np.einsum("mii->mi", gram) * damping[:, None] + 1e-12 * np.einsum("mii->m", gram)[:, None] + 1e-300
        step = -np.linalg.solve(gram + diagonal[:, :, None] * np.eye(6), slope[..., None])[..., 0]
        trial = views.moved(step)
        with np.errstate(all="ignore"):
            there = _rows(corners, intrinsics, trial)
            new = np.sum(there[0] ** 2, axis=1)
        better = new < cost
        gained = np.max(np.where(better, (cost - new) / (cost + 1e-300), 0.0), initial=0.0)
        views, cost = trial.where(better, views), np.where(better, new, cost)
        rows, by = np.where(better[:, None], there[0], rows), np.where(better[:, None, None], there[1], by)
        damping = np.clip(np.where(better, 0.1, 10.0) * damping, 1e-9, 1e6)
        if gained < 1e-9 and np.all(better | (damping > 1e-2)):
            break
    return views, cost


def _first(directions: Float[np.ndarray, "3 k"], points: Float[np.ndarray, "3 k"]) -> tuple[np.ndarray, np.ndarray]:
    """A target's rotation and origin from directions towards at least four of its points: by the homography of their
    plane, or by the direct linear transform of at least six points that are not in a plane."""
    middle = points.mean(axis=1, keepdims=True)
    axes, sizes, _ = np.linalg.svd(points - middle)
    axes = axes * np.sign(np.linalg.det(axes))
    planar = sizes[2] < _PLANAR * sizes[0] or points.shape[1] < 6
    scale = sizes[0] / np.sqrt(points.shape[1])
    local = axes.T @ (points - middle) / scale
    columns = np.concatenate([local[: 2 if planar else 3], np.ones((1, points.shape[1]))])
    zero, (x, y, z) = np.zeros_like(columns), directions
    rows = np.concatenate(
        [np.concatenate([z * columns, zero, -x * columns]), np.concatenate([zero, z * columns, -y * columns])], axis=1
    )
    matrix = np.linalg.svd(rows @ rows.T)[0][:, -1].reshape(3, -1)
    matrix = matrix * np.sign(np.sum(directions * (matrix @ columns)))
    turn = matrix[:, :-1] if not planar else np.column_stack([matrix[:, :2], np.cross(*matrix[:, :2].T)])
    if planar:  # the third column has the size of a product
        size = np.linalg.norm(turn[:, :2], axis=0).mean()
        turn[:, 2] *= size / max(float(np.linalg.norm(turn[:, 2])), 1e-300)
    left, sizes, right = np.linalg.svd(turn)
    rotation = left @ np.diag([1, 1, np.sign(np.linalg.det(left @ right))]) @ right @ axes.T
    return rotation, matrix[:, -1] * scale / sizes[:2].mean() - rotation @ middle[:, 0]


def _mirrored(views: Views, corners: Corners) -> Views:
    """Views of which a distant camera would see the same: with the target's depths about its middle inverted."""
    number = np.maximum(corners.present.sum(axis=1), 1)[:, None]
    middle = np.sum(corners.points * corners.present[..., None], axis=1) / number
    origin = views.origin + np.einsum("mij,mj->mi", views.rotation, middle)
    sight = origin / np.maximum(np.linalg.norm(origin, axis=1, keepdims=True), 1e-300)
    flipped = views.rotation - 2 * sight[:, :, None] * (sight[:, None] @ views.rotation)
    rotation = np.stack([flipped[..., 0], flipped[..., 1], np.cross(flipped[..., 0], flipped[..., 1])], axis=-1)
    return Views(rotation, origin - np.einsum("mij,mj->mi", rotation, middle))


def _on_a_line(corners: Corners) -> Bool[np.ndarray, " m"]:
    """Whether the points that an image shows are on one line, about which the target may turn."""
    weights = corners.present[..., None] / np.maximum(corners.present.sum(axis=1), 1)[:, None, None]
    apart = weights * (corners.points - np.sum(weights * corners.points, axis=1, keepdims=True))
    sizes = np.linalg.svd(apart, compute_uv=False)
    return sizes[:, 1] <= _PLANAR * sizes[:, 0]


def views_of(
    corners: Corners, intrinsics: Float[np.ndarray, " k"], rounds: int = _ROUNDS
) -> tuple[Views, Float[np.ndarray, " m"]]:
    """The view of each image that shows at least four points (three for a camera that measures points), and its sum of
    squares; others have the origin 0 and an infinite sum."""
    m, points = len(corners.values), corners.model.dimension == 3
    views = Views(np.tile(np.eye(3), (m, 1, 1)), np.zeros((m, 3)))
    enough = (corners.present.sum(axis=1) >= (3 if points else 4)) & ~_on_a_line(corners)
    if not enough.any():
        return views, np.full(m, np.inf)
    directions = corners.model.directions(np.moveaxis(corners.values, -1, 0), intrinsics)
    for image in np.flatnonzero(enough):
        seen = corners.present[image]
        if points:
            frame = fitted_frame(corners.points[image, seen].T, corners.values[image, seen].T)
            views.rotation[image], views.origin[image] = rotation_matrix(frame[:3]), frame[3:]
        else:
            views.rotation[image], views.origin[image] = _first(
                directions[:, image, seen], corners.points[image, seen].T
            )
    some = corners.select(enough)
    first = Views(views.rotation[enough], views.origin[enough])
    best, cost = _refined(some, intrinsics, first, rounds)
    if not points:
        other, cost_of_other = _refined(some, intrinsics, _mirrored(best, some), min(rounds, 10))
        chosen = cost_of_other < cost
        best, cost = other.where(chosen, best), np.where(chosen, cost_of_other, cost)
    views.rotation[enough], views.origin[enough] = best
    costs = np.full(m, np.inf)
    costs[enough] = cost
    return views, costs


def started_intrinsics(corners: Corners, count: int, image_size: Float[np.ndarray, " 2"]) -> Float[np.ndarray, " k"]:
    """Intrinsics without distortion: the focal length, of several, with which views fit best, and the middle of the
    image."""
    order = np.argsort(-corners.present.sum(axis=1), kind="stable")
    some = corners.select(order[np.linspace(0, max(len(order) // 2, 1), _FEW).astype(int).clip(0, len(order) - 1)])
    costs, tried = [], []
    for focal in _FOCAL_LENGTHS * image_size[0]:
        tried.append(np.concatenate([[focal, focal], (image_size - 1) / 2, np.zeros(count - 4)]))
        cost = views_of(some, tried[-1], rounds=8)[1]
        costs.append(np.sum(np.sqrt(cost[np.isfinite(cost)])))  # less of a single bad image than of many
    return tried[int(np.argmin(costs))]


def calibrated_camera(
    corners: Corners,
    start: Float[np.ndarray, " k"],
    free: Bool[np.ndarray, " k"] | None = None,
    prior: Float[np.ndarray, " k"] | None = None,
) -> CameraCalibration:
    """Intrinsics and views with the least squares of the corners, from a start; Gauss and Newton with the damping of
    Levenberg and Marquardt, where the views are eliminated (Brown 1958).

    Only those intrinsics change that are ``free``; ``prior`` has their standard deviations about the start.

    Raises:
        InputError: no image shows enough points.
    """
    views, cost = views_of(corners, start)
    used = np.isfinite(cost)
    if not used.any():
        raise InputError("no image shows four corners or more, so the camera cannot be calibrated; take other images.")
    some, views = corners.select(used), Views(views.rotation[used], views.origin[used])
    free = np.ones(len(start), dtype=bool) if free is None else free
    weight = np.zeros(len(start)) if prior is None else 1 / prior
    x, damping, steps = start.copy(), 1e-6, 0
    rows, by, head = _rows(some, x, views)
    cost, refused = np.sum(rows**2), 0
    while steps < 200:
        steps += 1
        d = by.swapaxes(1, 2) @ by
        diagonal = np.einsum("mii->mi", d)
        d = d + (damping * diagonal)[:, :, None] * np.eye(6)
        inverse = np.linalg.inv(d)
        own = np.einsum("mri,mr->mi", by, rows)
        crossed = by.swapaxes(1, 2) @ head
        information = np.einsum("mrk,mrl->kl", head, head) + np.diag(weight**2)
        slope = np.einsum("mrk,mr->k", head, rows) + weight**2 * (x - start)
        follow = inverse @ crossed
        schur = information * (1 + damping * np.eye(len(x))) - np.einsum("mik,mil->kl", crossed, follow)
        right = slope - np.einsum("mik,mi->k", follow, own)
        step = np.zeros(len(x))
        scale = 1 / np.sqrt(np.diag(information)[free])
        normed = schur[np.ix_(free, free)] * scale[:, None] * scale
        step[free] = -scale * np.linalg.lstsq(normed, scale * right[free], rcond=1e-15)[0]
        below = -np.einsum("mij,mj->mi", inverse, own) - follow @ step
        trial, there = views.moved(below), x + step
        with np.errstate(all="ignore"):
            new = _rows(some, there, trial)
            new_cost = np.sum(new[0] ** 2) + np.sum((weight * (there - start)) ** 2)
        tiny = np.all(np.abs(step[free]) <= 1e-10 * (np.abs(x[free]) + 1e-3))
        if np.isfinite(new_cost) and new_cost <= cost * (1 + 1e-14):
            x, views, (rows, by, head), cost = there, trial, new, new_cost
            damping, refused = max(damping / 10, 1e-14), 0
            if tiny:
                break
        else:
            damping, refused = damping * 10, refused + 1
            if tiny or refused > 20:
                break
    covariance = np.zeros((len(x), len(x)))
    with np.errstate(all="ignore"):
        covariance[np.ix_(free, free)] = scale[:, None] * np.linalg.pinv(normed, hermitian=True) * scale
    number = some.present.sum()
    degrees_of_freedom = float(some.model.dimension * number - 6 * len(views.origin) - free.sum())
    vectors = np.zeros((len(used), 6))
    vectors[used] = views.vectors()
    distances = np.sum((rows * some.u.reshape(rows.shape)) ** 2)
    return CameraCalibration(
        x, covariance, vectors, float(np.sqrt(distances / number)),
        float(np.sqrt(np.sum(rows**2) / max(degrees_of_freedom, 1.0))), degrees_of_freedom,
    )  # fmt: skip
