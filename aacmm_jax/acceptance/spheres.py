"""Spheres: fitted by least squares, and the smallest around points; and what the tests of touched spheres share."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError

EXACT_POINTS = 4  # a sphere goes through so many points exactly, so they have no form error
_COINCIDENT = 1e-7  # distance of two points, relative to the extent of all, below which they count as one


class FittedSphere(NamedTuple):
    """The least-squares sphere of points, mm."""

    centre: Float[np.ndarray, " 3"]
    radius: float
    residuals: Float[np.ndarray, " m"]  # distance of each point from the centre, less the radius

    @property
    def form(self) -> float:
        """Largest less smallest distance of the points from the centre, mm."""
        return float(np.ptp(self.residuals))


def fit_sphere(points: Numbers) -> FittedSphere:
    """Fit a sphere by least squares of the points' distances from its surface.

    Solved by SciPy's Levenberg-Marquardt method (MINPACK), from the algebraic solution.

    Args:
        points: Points ``(m, 3)``, mm.

    Returns:
        The sphere, mm.

    Raises:
        InputError: There are fewer than four points, or they lie in one plane.

    Example:
        >>> directions = np.concatenate([np.eye(3), -np.eye(3)])
        >>> sphere = aj.acceptance.fit_sphere([100.0, 0.0, 0.0] + 12.5 * directions)
        >>> print(sphere.centre.round(6), round(sphere.radius, 6))
        [100.   0.   0.] 12.5
    """
    from scipy import optimize

    given = points_of(points, "points on a sphere")
    if len(given) < EXACT_POINTS:
        raise InputError(
            f"a sphere needs at least {EXACT_POINTS} points, but {len(given)} are given; touch it at more points."
        )
    middle = given.mean(axis=0)
    centred = given - middle
    size = float(np.linalg.norm(centred, axis=1).max())
    if size == 0 or np.linalg.svd(centred / size, compute_uv=False)[2] < 1e-6:
        raise InputError("the points on a sphere lie in one plane, which determines no sphere; touch it on all sides.")
    # |p|^2 = 2 c.p + (r^2 - |c|^2) is linear in the centre; with lengths of about 1 it is also well conditioned.
    scaled = centred / size
    rows = np.column_stack([2 * scaled, np.ones(len(scaled))])
    start = np.linalg.lstsq(rows, np.sum(scaled**2, axis=1), rcond=None)[0]
    radius = np.sqrt(max(start[3] + start[:3] @ start[:3], 1e-12))

    def residuals(unknown: np.ndarray) -> np.ndarray:
        return np.linalg.norm(scaled - unknown[:3], axis=1) - unknown[3]

    def jacobian(unknown: np.ndarray) -> np.ndarray:
        away = unknown[:3] - scaled
        return np.column_stack([away / np.linalg.norm(away, axis=1, keepdims=True), -np.ones(len(scaled))])

    guess = np.append(start[:3], radius)
    solve: Any = optimize.least_squares
    solution = solve(residuals, guess, jacobian, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return FittedSphere(middle + size * solution.x[:3], float(size * solution.x[3]), size * solution.fun)


def enclosing_sphere(points: Numbers) -> tuple[Float[np.ndarray, " 3"], float]:
    """Find the smallest sphere that contains all points, by Welzl's algorithm (package miniball).

    Args:
        points: Points ``(m, 3)``, mm.

    Returns:
        Its centre ``(3,)`` and its radius, mm.

    Raises:
        InputError: ``points`` has another shape, or no rows.

    Example:
        >>> centre, radius = aj.acceptance.enclosing_sphere([[0, 0, 0], [2, 0, 0], [1, 0.5, 0]])
        >>> print(centre, radius)
        [1. 0. 0.] 1.0
    """
    import miniball

    given = points_of(points, "points")
    middle = given.mean(axis=0)
    size = float(np.abs(given - middle).max())
    if size == 0:
        return middle, 0.0
    # Nearly coincident points would make the algorithm's small systems singular; all points count again in the radius.
    apart: list[np.ndarray] = []
    for point in (given - middle) / size:
        if all(np.linalg.norm(point - other) > _COINCIDENT for other in apart):
            apart.append(point)
    ball: Any = miniball.get_bounding_ball(np.array(apart), rng=np.random.default_rng(0))
    centre = middle + size * ball[0]
    return centre, float(np.linalg.norm(given - centre, axis=1).max())


def size_error(points: Numbers, diameter: float, stylus: float = 0.0) -> float:
    """Diameter of the least-squares sphere, less the diameters of the probe's ball and of the calibrated sphere.

    Source: of 25 points P_Size.Sph.1x25 (ISO 10360-12:2016), of 9 the error of the effective diameter (ASME
    B89.4.22-2004); the formula is stated from secondary sources.

    Args:
        points: Points ``(m, 3)`` of the probe's centre, mm.
        diameter: Calibrated diameter, mm.
        stylus: Diameter of the probe's ball, mm; 0 if the points lie on the sphere itself.

    Returns:
        The error, mm.

    Raises:
        InputError: The points do not determine a sphere.

    Example:
        >>> directions = np.concatenate([np.eye(3), -np.eye(3)])
        >>> print(f"{aj.acceptance.size_error(15.51 * directions, 25.0, stylus=6.0):.4f} mm")
        0.0200 mm
    """
    return 2 * fit_sphere(points).radius - stylus - diameter


def points_of(points: Numbers, what: str) -> Float[np.ndarray, "m 3"]:
    """Points ``(m, 3)``, at least one, as a NumPy array, or `InputError` that names ``what``."""
    array = np.asarray(as_floats(points, what))
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise InputError(f"{what} have shape {array.shape}; give (x, y, z) in mm, one row per point, at least one row.")
    return array
