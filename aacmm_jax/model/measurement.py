"""A capture as arrays for the residuals: poses, sockets and lengths, and the means over sockets."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import joined
from ..core.errors import InputError
from ..data.capture import Capture
from ..data.noise import Noise, tip_covariances
from ..kinematics.chain import Geometry, SinesCosines, sines_cosines
from ..kinematics.parameters import Parameters
from .weights import Weights, membership

# Standard deviation of a tip coordinate (mm) below which noise-free data would get infinite weight.
LEAST_SIGMA = 1e-9


class Measurement(eqx.Module):
    """A capture as arrays: all poses, socket after socket, and the reference lengths.

    ``sizes`` and ``ends`` are static: they fix the shape of the problem, as the number of poses does. ``sines_cosines``
    are those of q, which every evaluation needs and none changes. With ``weights``, centroids are weighted means.
    """

    q: Float[Array, "N n"]
    sines_cosines: SinesCosines
    nominal: Float[Array, " l"]  # calibrated values of the reference lengths, mm
    u: Float[Array, " l"]  # their standard uncertainties, mm
    sizes: tuple[int, ...] = eqx.field(static=True)
    ends: tuple[tuple[int, int], ...] = eqx.field(static=True)
    weights: Weights | None = None  # None: every pose weighs the same

    @classmethod
    def of(cls, capture: Capture) -> "Measurement":
        """The measurement of a capture."""
        return cls(
            q=capture.q,
            sines_cosines=sines_cosines(capture.q),
            nominal=joined([length.value for length in capture.lengths], new=True)
            if capture.lengths
            else jnp.array(np.zeros(0)),
            u=joined([length.u for length in capture.lengths], new=True) if capture.lengths else jnp.array(np.zeros(0)),
            sizes=capture.sizes,
            ends=tuple((int(start), int(end)) for start, end in capture.ends()),
        )

    def weighted(self, geometry: Geometry, noise: Noise | None) -> "Measurement":
        """The same with weights: the inverse covariances of the tips by ``noise``, for an arm close to this one."""
        if noise is None:
            return self
        weights = Weights.of(tip_covariances(geometry, self.sines_cosines, noise), self.sizes)
        return eqx.tree_at(lambda m: m.weights, self, weights, is_leaf=lambda leaf: leaf is None)

    @property
    def averaging(self) -> Float[np.ndarray, "s N"]:
        """Matrix that takes tips to socket centroids."""
        return averaging_matrix(self.sizes)

    # Sums over sockets are products with this matrix: sockets are few, and a scatter would not vectorise.
    def centroids(self, tips: Float[Array, "N 3"]) -> Float[Array, "s 3"]:
        """Mean of each socket's tips."""
        if self.weights is not None:
            return self.weights.centroids(tips.T, self.sizes).T
        return jnp.asarray(self.averaging) @ tips

    def centred(self, tips: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
        """Tips less the mean of their socket: eliminates the sockets' unknown positions."""
        return tips - jnp.asarray(membership(self.sizes).T) @ self.centroids(tips)

    def whitened(self, centred: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
        """Centred tips in the units of the least squares: standard deviations where there are weights, else mm."""
        return centred if self.weights is None else self.weights.whiten(centred.T).T

    def centroid_covariances(self, sigma: Float[Array, ""]) -> Float[Array, "s 3 3"]:
        """Covariance of each socket's mean, mm^2: by the weights, else ``sigma``^2 of a coordinate over the poses."""
        if self.weights is not None:
            return jnp.einsum("abs,cbs->sac", self.weights.centroid_factor, self.weights.centroid_factor)
        return sigma**2 * jnp.asarray(np.eye(3)[None] / np.asarray(self.sizes, dtype=float)[:, None, None])

    def distances(self, tips: Float[Array, "N 3"]) -> Float[Array, " l"]:
        """Measured reference lengths: distances between the centroids of their end sockets, mm."""
        return jnp.linalg.norm(self.differences @ self.centroids(tips), axis=-1)

    @property
    def differences(self) -> Float[Array, "l s"]:
        """Matrix that takes socket centroids to the vectors between the ends of the lengths."""
        return jnp.asarray(differences_matrix(self.ends, len(self.sizes)))


def differences_matrix(ends: tuple[tuple[int, int], ...], sockets: int) -> Float[np.ndarray, "l s"]:
    """Matrix that takes socket centroids to the vectors between the ends of the lengths."""
    pairs, unit = np.asarray(ends, dtype=int).reshape(-1, 2), np.eye(sockets)
    return unit[pairs[:, 1]] - unit[pairs[:, 0]]


def averaging_matrix(sizes: tuple[int, ...]) -> Float[np.ndarray, "s N"]:
    """Matrix whose product with poses in socket order gives each socket's mean."""
    return membership(sizes) / np.asarray(sizes, dtype=float)[:, None]


def check_joints(capture: Capture, space: Parameters) -> None:
    """Raise `InputError` where capture and arm differ in their number of joints."""
    if capture.joints != space.base.joints:
        raise InputError(
            f"the capture has {capture.joints} columns, but the arm has {space.base.joints} joints; give one column a "
            "joint."
        )


def length_covariance(
    centroids: Float[Array, "s 3"],
    measurement: Measurement,
    sigma: Float[Array, ""],
    scale_factor: Float[Array, "..."] | float = 1.0,
) -> Float[Array, "l l"]:
    """Covariance of measured minus nominal lengths, mm^2, by an arm that is ``scale_factor`` times too large.

    Each length's own u, and the scatter of the poses over their number at each end. Lengths that share a socket share
    its scatter, so they are correlated.
    """
    pull = measurement.differences[:, :, None] * length_directions(centroids, measurement)[:, None, :]
    scatter = jnp.einsum("lsc,scd,ksd->lk", pull, measurement.centroid_covariances(sigma), pull)
    # The least variance, (1e-12 mm)^2, only keeps a noise-free simulation's weights finite.
    return jnp.diag((scale_factor * measurement.u) ** 2 + 1e-24) + scatter


def length_directions(centroids: Float[Array, "s 3"], measurement: Measurement) -> Float[Array, "l 3"]:
    """Unit vectors between the centroids at the ends of every reference length."""
    between = measurement.differences @ centroids
    return between / jnp.linalg.norm(between, axis=-1, keepdims=True)
