"""The fisheye lens of Kannala and Brandt (2006), in the form and order of OpenCV's module fisheye."""

import math

import numpy as np
from jaxtyping import Float

from ...core.numpy_or_jax import AnyArray, namespace
from .camera import AbstractLens


class Fisheye(AbstractLens):
    """A point at the angle t from the axis appears at the distance t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) from the
    centre of the image at unit distance."""

    name = "fisheye"
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    counts = (4, 8)
    largest = math.pi  # of the angle

    @property
    def steps(self) -> tuple[float, ...]:
        return (1.0,) * 4 + (0.01,) * 4

    def distorted(
        self, points: Float[AnyArray, "3 ..."], coefficients: Float[AnyArray, "k ..."]
    ) -> tuple[Float[AnyArray, "2 ..."], Float[AnyArray, "2 3 ..."], list[AnyArray]]:
        xp = namespace(points, coefficients)
        across, depth = points[:2], points[2]
        r2 = xp.sum(across**2, axis=0)
        square = r2 + depth**2
        middle = r2 < 1e-14 * square  # where the direction across is undetermined, and its factor is 1 / Z
        r2 = xp.where(middle, 1.0, r2)
        r = xp.sqrt(r2)
        t = xp.where(middle, 0.0, xp.arctan2(r, depth))
        powers = [t ** (2 * i + 1) for i in range(1 + coefficients.shape[0])]
        terms = list(zip([1.0, *(coefficients[i] for i in range(coefficients.shape[0]))], powers, strict=True))
        factor = xp.where(middle, 1 / xp.where(middle, depth, 1.0), sum(k * power for k, power in terms) / r)
        slope = 1.0 + sum((2 * i + 1) * k * t ** (2 * i) for i, (k, _) in enumerate(terms) if i)
        by_radius = xp.where(middle, 0.0, (slope * depth / square - factor) / r2)  # over the radius
        by_across = across[:, None] * across[None] * by_radius[None, None]
        by_across = by_across + factor[None, None] * np.eye(2).reshape(2, 2, *[1] * r2.ndim)
        by_depth = -across * (slope / square)[None]
        by_coefficients = [across * xp.where(middle, 0.0, power / r)[None] for power in powers[1:]]
        return across * factor[None], xp.concatenate([by_across, by_depth[:, None]], axis=1), by_coefficients

    def aside(self, points: Float[np.ndarray, "3 ..."]) -> Float[np.ndarray, "..."]:
        return np.arctan2(np.hypot(points[0], points[1]), points[2])

    def radius(self, aside: Float[np.ndarray, "..."], coefficients: Float[np.ndarray, " k"]) -> np.ndarray:
        return aside * sum((k * aside ** (2 * i) for i, k in enumerate(coefficients, 1)), np.ones_like(aside))

    def from_aside(self, aside: Float[np.ndarray, "..."]) -> tuple[np.ndarray, np.ndarray]:
        return np.sin(aside), np.cos(aside)
