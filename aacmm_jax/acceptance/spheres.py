"""Spheres through measured points: the one of least squares, and the smallest that holds them all."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError

_LEAST = 4  # points that a sphere needs
_ONE_PLACE = 1e-7  # of the points' spread


class FittedSphere(NamedTuple):
    """The least-squares sphere of points, mm."""

    centre: Float[np.ndarray, " 3"]
    radius: float
    residuals: Float[np.ndarray, " m"]  # distance of each point from the centre, less the radius

    @property
    def form(self) -> float:
        """Span of the points' distances from the centre, largest less smallest, mm."""
        return float(np.ptp(self.residuals))


def fit_sphere(points: Numbers) -> FittedSphere:
    """The sphere whose surface is nearest to points ``(m, 3)``, mm, in the sense of least squares of distances (not of their squares).

    Solved by SciPy's Levenberg-Marquardt (MINPACK) from the algebraic solution. Raises `InputError` for fewer than four points, and
    for points that lie in a plane or too close together to fix a sphere.
    """
    from scipy import optimize

    given = points_of(points, "points on a sphere")
    if len(given) < _LEAST:
        raise InputError(f"a sphere needs at least {_LEAST} points, but {len(given)} are given; touch it in more places.")
    middle = given.mean(axis=0)
    centred = given - middle
    size = float(np.linalg.norm(centred, axis=1).max())
    if size == 0 or np.linalg.svd(centred / size, compute_uv=False)[2] < 1e-6:
        raise InputError("the points on a sphere lie in one plane, so they fix none; touch it all round.")
    # |p|^2 = 2 c.p + (r^2 - |c|^2) is linear in the centre; with lengths of about 1 it is also well conditioned.
    scaled = centred / size
    rows = np.column_stack([2 * scaled, np.ones(len(scaled))])
    start = np.linalg.lstsq(rows, np.sum(scaled**2, axis=1), rcond=None)[0]
    radius = np.sqrt(max(start[3] + start[:3] @ start[:3], 1e-12))

    def distances(unknown: np.ndarray) -> np.ndarray:
        return np.linalg.norm(scaled - unknown[:3], axis=1) - unknown[3]

    def slopes(unknown: np.ndarray) -> np.ndarray:
        away = unknown[:3] - scaled
        return np.column_stack([away / np.linalg.norm(away, axis=1, keepdims=True), -np.ones(len(scaled))])

    guess = np.append(start[:3], radius)
    found = optimize.least_squares(distances, guess, slopes, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)  # pyright: ignore[reportArgumentType]
    return FittedSphere(middle + size * found.x[:3], float(size * found.x[3]), size * found.fun)


def enclosing_sphere(points: Numbers) -> tuple[Float[np.ndarray, " 3"], float]:
    """Centre and radius, mm, of the smallest sphere that holds all points ``(m, 3)`` (Welzl's algorithm, by the package miniball)."""
    import miniball

    given = points_of(points, "points")
    middle = given.mean(axis=0)
    size = float(np.abs(given - middle).max())
    if size == 0:
        return middle, 0.0
    # Two points in nearly one place would make the algorithm's small systems singular; all points count again in the radius.
    apart: list[np.ndarray] = []
    for point in (given - middle) / size:
        if all(np.linalg.norm(point - other) > _ONE_PLACE for other in apart):
            apart.append(point)
    found: Any = miniball.get_bounding_ball(np.array(apart), rng=np.random.default_rng(0))
    centre = middle + size * found[0]
    return centre, float(np.linalg.norm(given - centre, axis=1).max())


def points_of(points: Numbers, what: str) -> Float[np.ndarray, "m 3"]:
    """Points ``(m, 3)``, at least one, as a NumPy array, or `InputError` that names ``what``."""
    array = np.asarray(as_floats(points, what))
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise InputError(f"{what} have shape {array.shape}; give one row (x, y, z) in mm a point, and at least one.")
    return array
