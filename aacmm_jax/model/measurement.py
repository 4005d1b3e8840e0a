"""A capture as arrays for the residuals: poses, sockets and lengths, and the means over sockets."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, namespace, to_numpy
from ..data.capture import Capture, check_one_capture, check_readings, check_sockets_only
from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import Arm, check_columns
from ..kinematics.chain import Geometry, JointMotion, joint_motion
from ..kinematics.parameters import Parameters
from .socket_sums import means_over_sockets, to_poses
from .weights import Weights

# Standard deviation of a tip coordinate (mm) below which noise-free data would get infinite weight.
LEAST_SIGMA = 1e-9
_FEW = 1000  # sockets


class Measurement(eqx.Module):
    """A capture as arrays: all poses, socket after socket, and the reference lengths.

    ``sizes`` and ``ends`` are static: they fix the shape of the problem, as the number of poses does. ``motion`` is
    what q does to the joints, which every evaluation needs and none changes. With ``weights``, centroids are weighted
    means.
    """

    q: Float[AnyArray, "N n"]
    motion: JointMotion
    nominal: Float[AnyArray, " l"]  # calibrated values of the reference lengths, mm
    u: Float[AnyArray, " l"]  # their standard uncertainties, mm
    sizes: tuple[int, ...] = eqx.field(static=True)
    ends: tuple[tuple[int, int], ...] = eqx.field(static=True)
    weights: Weights | None = None  # None: every pose weighs the same

    @classmethod
    def of(cls, capture: Capture, arm: Arm) -> "Measurement":
        """The measurement of a capture by an arm with such joints, which may be the nominal one.

        Raises `InputError` for a batch of captures.
        """
        check_one_capture(capture)
        check_sockets_only(capture, "this function")
        capture = to_numpy(capture)
        check_readings(capture, arm)
        xp = namespace(capture)
        return cls(
            q=capture.q,
            motion=joint_motion(arm.geometry, capture.q),
            nominal=xp.stack([length.value for length in capture.lengths]) if capture.lengths else np.zeros(0),
            u=xp.stack([length.u for length in capture.lengths]) if capture.lengths else np.zeros(0),
            sizes=capture.sizes,
            ends=tuple((int(start), int(end)) for start, end in capture.ends()),
        )

    def weighted(self, geometry: Geometry, noise: Noise | None) -> "Measurement":
        """The same with weights: the inverse covariances of the tips by ``noise``, for an arm close to this one."""
        if noise is None:
            return self
        weights = Weights.of(tip_covariances(geometry, self.motion, noise), self.sizes)
        return eqx.tree_at(lambda m: m.weights, self, weights, is_leaf=lambda leaf: leaf is None)

    def centroids(self, tips: Float[AnyArray, "N 3"]) -> Float[AnyArray, "s 3"]:
        """Mean of each socket's tips."""
        if self.weights is not None:
            return self.weights.centroids(tips.T, self.sizes).T
        return means_over_sockets(tips.T, self.sizes).T

    def centred(self, tips: Float[AnyArray, "N 3"]) -> Float[AnyArray, "N 3"]:
        """Tips less the mean of their socket: eliminates the sockets' unknown positions."""
        return tips - to_poses(self.centroids(tips).T, self.sizes).T

    def whitened(self, centred: Float[AnyArray, "N 3"]) -> Float[AnyArray, "N 3"]:
        """Centred tips in the units of the least squares: standard deviations where there are weights, else mm."""
        return centred if self.weights is None else self.weights.whiten(centred.T).T

    def centroid_covariances(self, sigma: Float[AnyArray, ""]) -> Float[AnyArray, "s 3 3"]:
        """Covariance of each socket's mean, mm^2: by the weights, else ``sigma``^2 of a coordinate over the poses."""
        xp = namespace(self.weights, sigma)
        if self.weights is not None:
            return xp.einsum("abs,cbs->sac", self.weights.centroid_factor, self.weights.centroid_factor)
        return sigma**2 * xp.asarray(np.eye(3)[None] / np.asarray(self.sizes, dtype=float)[:, None, None])

    def distances(self, tips: Float[AnyArray, "N 3"]) -> Float[AnyArray, " l"]:
        """Measured reference lengths: distances between the centroids of their end sockets, mm."""
        return namespace(tips).linalg.norm(between_ends(self.centroids(tips).T, self.ends), axis=0)


def between_ends(centroids: Float[AnyArray, "... s"], ends: tuple[tuple[int, int], ...]) -> Float[AnyArray, "... l"]:
    """The differences between both ends of every length, of values that sockets have."""
    pairs = np.asarray(ends, dtype=int).reshape(-1, 2)
    if namespace(centroids) is np or centroids.shape[-1] > _FEW:
        return centroids[..., pairs[:, 1]] - centroids[..., pairs[:, 0]]
    unit = np.eye(centroids.shape[-1])
    return centroids @ (unit[pairs[:, 1]] - unit[pairs[:, 0]]).T  # a product, for the reason given in `socket_sums`


def check_joints(capture: Capture, space: Parameters) -> None:
    """Raise `InputError` where capture and arm differ in their number of joints."""
    check_columns(space.base, capture.columns)


def length_covariance(
    centroids: Float[AnyArray, "s 3"],
    measurement: Measurement,
    sigma: Float[AnyArray, ""],
    scale_factor: Float[AnyArray, "..."] | float = 1.0,
) -> Float[AnyArray, "l l"]:
    """Covariance of measured minus nominal lengths, mm^2, by an arm that is ``scale_factor`` times too large.

    Each length's own u, and the scatter of the poses over their number at each end. Lengths that share a socket share
    its scatter, so they are correlated.
    """
    xp = namespace(centroids, measurement)
    differences = between_ends(np.eye(len(measurement.sizes)), measurement.ends).T
    pull = xp.asarray(differences)[:, :, None] * length_directions(centroids, measurement)[:, None, :]
    moved = xp.einsum("lsc,scd->lsd", pull, measurement.centroid_covariances(sigma))
    scatter = moved.reshape(len(pull), 3 * pull.shape[1]) @ pull.reshape(len(pull), 3 * pull.shape[1]).T
    # The least variance, (1e-12 mm)^2, only keeps a noise-free simulation's weights finite.
    return xp.diag((scale_factor * measurement.u) ** 2 + 1e-24) + scatter


def length_directions(centroids: Float[AnyArray, "s 3"], measurement: Measurement) -> Float[AnyArray, "l 3"]:
    """Unit vectors between the centroids at the ends of every reference length."""
    between = between_ends(centroids.T, measurement.ends).T
    return between / namespace(centroids).linalg.norm(between, axis=-1, keepdims=True)
