"""The pinhole camera with the distortion of Brown (1966) and Conrady, in the form and order of OpenCV."""

import numpy as np
from jaxtyping import Float

from ...core.numpy_or_jax import AnyArray, namespace
from .camera import AbstractLens


class Pinhole(AbstractLens):
    """With x = X / Z, y = Y / Z and r^2 = x^2 + y^2, the image is at

    x L + 2 p1 x y + p2 (r^2 + 2 x^2),   y L + p1 (r^2 + 2 y^2) + 2 p2 x y,
    L = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6).
    """

    name = "pinhole"
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    counts = (4, 8, 9, 12)
    largest = 20.0  # of the radius at unit distance: 87 degrees from the axis

    def distorted(
        self, points: Float[AnyArray, "3 ..."], coefficients: Float[AnyArray, "k ..."]
    ) -> tuple[Float[AnyArray, "2 ..."], Float[AnyArray, "2 3 ..."], list[AnyArray]]:
        xp = namespace(points, coefficients)
        depth = xp.where(xp.abs(points[2]) < 1e-12, 1e-12, points[2])
        x, y = points[0] / depth, points[1] / depth
        count, absent = coefficients.shape[0], [0.0] * 8
        k1, k2, p1, p2, k3, k4, k5, k6 = [*(coefficients[i] for i in range(count)), *absent[count:]]
        r2 = x**2 + y**2
        r4, r6 = r2**2, r2**3
        below = 1 + k4 * r2 + k5 * r4 + k6 * r6
        scale = (1 + k1 * r2 + k2 * r4 + k3 * r6) / below
        slope = (k1 + 2 * k2 * r2 + 3 * k3 * r4 - scale * (k4 + 2 * k5 * r2 + 3 * k6 * r4)) / below
        xy, xx, yy = 2 * x * y, r2 + 2 * x**2, r2 + 2 * y**2
        plane = xp.stack([x * scale + p1 * xy + p2 * xx, y * scale + p1 * yy + p2 * xy])
        across = xy * slope + 2 * p1 * x + 2 * p2 * y
        by_x = xp.stack([scale + 2 * x**2 * slope + 2 * p1 * y + 6 * p2 * x, across]) / depth[None]
        by_y = xp.stack([across, scale + 2 * y**2 * slope + 6 * p1 * y + 2 * p2 * x]) / depth[None]
        by_point = xp.stack([by_x, by_y, -(x[None] * by_x + y[None] * by_y)], axis=1)
        radial, tangential = xp.stack([x, y]) / below[None], [xp.stack([xy, yy]), xp.stack([xx, xy])]
        by = [radial * r2[None], radial * r4[None], *tangential, radial * r6[None]]
        by += [-radial * (scale * power)[None] for power in (r2, r4, r6)]
        return plane, by_point, by[:count]

    def aside(self, points: Float[np.ndarray, "3 ..."]) -> Float[np.ndarray, "..."]:
        behind = points[2] <= 0
        return np.where(behind, np.inf, np.hypot(points[0], points[1]) / np.where(behind, 1.0, points[2]))

    def radius(self, aside: Float[np.ndarray, "..."], coefficients: Float[np.ndarray, " k"]) -> np.ndarray:
        k1, k2, _, _, k3, k4, k5, k6 = np.concatenate([coefficients, np.zeros(8)])[:8]
        r2 = aside**2
        return aside * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))

    def from_aside(self, aside: Float[np.ndarray, "..."]) -> tuple[np.ndarray, np.ndarray]:
        size = np.sqrt(1 + aside**2)
        return aside / size, 1 / size
