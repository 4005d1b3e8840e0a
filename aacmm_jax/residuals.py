"""Measurement x arm -> residual: what the identifications minimise."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .capture import Capture
from .chain import tip_jacobian
from .parameters import Parameters


class Measurement(eqx.Module):
    """A capture in the form that residuals take: all poses, which socket each belongs to, and the lengths.

    ``sizes`` and ``ends`` are static: they fix the shape of the problem, as the number of poses does.
    """

    q: Float[Array, "N n"]
    nominal: Float[Array, " l"]  # calibrated values of the reference lengths, mm
    u: Float[Array, " l"]  # their standard uncertainties, mm
    sizes: tuple[int, ...] = eqx.field(static=True)
    ends: tuple[tuple[int, int], ...] = eqx.field(static=True)

    @classmethod
    def of(cls, capture: Capture) -> "Measurement":
        """The measurement of a capture."""
        return cls(
            q=capture.q,
            nominal=jnp.stack([length.value for length in capture.lengths]) if capture.lengths else jnp.zeros(0),
            u=jnp.stack([length.u for length in capture.lengths]) if capture.lengths else jnp.zeros(0),
            sizes=capture.sizes,
            ends=tuple((int(start), int(end)) for start, end in capture.ends()),
        )

    @property
    def averaging(self) -> Float[np.ndarray, "s N"]:
        """Matrix that takes tips to socket centroids."""
        owner = np.repeat(np.arange(len(self.sizes)), self.sizes)
        return (owner[None, :] == np.arange(len(self.sizes))[:, None]) / np.asarray(self.sizes, dtype=float)[:, None]

    def centroids(self, tips: Float[Array, "N k"]) -> Float[Array, "s k"]:
        """Mean of each socket's rows."""
        return jnp.asarray(self.averaging) @ tips

    def centred(self, tips: Float[Array, "N k"]) -> Float[Array, "N k"]:
        """Rows less the mean of their socket: eliminates the sockets' unknown positions."""
        spread = jnp.asarray((self.averaging > 0).astype(float))
        return tips - spread.T @ self.centroids(tips)

    def distances(self, tips: Float[Array, "N 3"]) -> Float[Array, " l"]:
        """Measured reference lengths: distances between the centroids of their end sockets, mm."""
        start, end = self._end_indices()
        centroids = self.centroids(tips)
        return jnp.linalg.norm(centroids[end] - centroids[start], axis=-1)

    def averaging_variance(self) -> Float[np.ndarray, " l"]:
        """Variance of a measured length per unit variance of a tip coordinate: 1/m at each end."""
        start, end = self._end_indices()
        inverse = 1 / np.asarray(self.sizes, dtype=float)
        return inverse[start] + inverse[end]

    def _end_indices(self) -> tuple[Int[np.ndarray, " l"], Int[np.ndarray, " l"]]:
        ends = np.asarray(self.ends, dtype=int).reshape(-1, 2)
        return ends[:, 0], ends[:, 1]


def repeatability_residual(
    vector: Float[Array, " p"], args: tuple[Parameters, Measurement]
) -> Float[Array, "N 3"]:
    """Distance vectors of all tips from their socket's centroid, mm (Cheng et al. 2018, eq. 13-14, by component)."""
    space, measurement = args
    return measurement.centred(space.arm(vector).position(measurement.q))


def joint_residual(
    vector: Float[Array, " p"],
    args: tuple[Parameters, Measurement, Float[Array, ""], Float[Array, " l"]],
) -> tuple[Float[Array, "N 3"], Float[Array, " l"]]:
    """Repeatability and reference lengths together, each divided by its standard deviation: no unit.

    args: free parameters, measurement, standard deviation of a tip coordinate (mm), and that of each length (mm).
    """
    space, measurement, sigma, length_sigma = args
    tips = space.arm(vector).position(measurement.q)
    return measurement.centred(tips) / sigma, (measurement.distances(tips) - measurement.nominal) / length_sigma


def derivatives(
    vector: Float[Array, " p"], space: Parameters, measurement: Measurement
) -> tuple[Float[Array, "N3 p"], Float[Array, "l p"]]:
    """Analytic Jacobians, by the free parameters, of the repeatability residual and of the measured lengths."""
    arm = space.arm(vector)
    columns = tip_jacobian(arm.geometry, measurement.q, space.entries())
    flat = columns.reshape(columns.shape[0], -1)
    centred = measurement.centred(flat).reshape(-1, len(space.names))
    start, end = measurement._end_indices()
    centroids = measurement.centroids(arm.position(measurement.q))
    mean_columns = measurement.centroids(flat).reshape(len(measurement.sizes), 3, -1)
    between = centroids[end] - centroids[start]
    direction = between / jnp.linalg.norm(between, axis=-1, keepdims=True)
    return centred, jnp.einsum("li,lip->lp", direction, mean_columns[end] - mean_columns[start])
