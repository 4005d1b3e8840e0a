"""Measurement x arm -> residual: what the identifications minimise."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import joined
from ..data.capture import Capture
from ..data.noise import Noise, tip_covariances
from ..kinematics.chain import Geometry, Turns, stacked_columns, turns_of, walk
from ..kinematics.parameters import Parameters
from ..solver.levenberg_marquardt import Model
from .weights import Weights, membership


class Measurement(eqx.Module):
    """A capture in the form that residuals take: all poses, which socket each belongs to, and the lengths.

    ``sizes`` and ``ends`` are static: they fix the shape of the problem, as the number of poses does. ``turns`` are the
    cosines and sines of q, which every evaluation needs and none changes. With ``weights``, centroids are weighted means.
    """

    q: Float[Array, "N n"]
    turns: Turns
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
            turns=turns_of(capture.q),
            nominal=joined([length.value for length in capture.lengths], new=True)
            if capture.lengths
            else jnp.array(np.zeros(0)),
            u=joined([length.u for length in capture.lengths], new=True) if capture.lengths else jnp.array(np.zeros(0)),
            sizes=capture.sizes,
            ends=tuple((int(start), int(end)) for start, end in capture.ends()),
        )

    def weighed(self, geometry: Geometry, noise: Noise | None) -> "Measurement":
        """The same with poses weighed by the inverse covariance that ``noise`` gives their tips in an arm about this one."""
        if noise is None:
            return self
        weights = Weights.of(tip_covariances(geometry, self.turns, noise), self.sizes)
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
        """Centred tips as a least squares counts them: in standard deviations where there are weights, else in mm."""
        return centred if self.weights is None else self.weights.whiten(centred.T).T

    def centroid_covariances(self, sigma: Float[Array, ""]) -> Float[Array, "s 3 3"]:
        """Covariance of each socket's mean, mm^2: what the weights say, or ``sigma``^2 of a tip coordinate over the poses."""
        if self.weights is not None:
            return jnp.einsum("abs,cbs->sac", self.weights.spread, self.weights.spread)
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


class Weighing(NamedTuple):
    """What a joint solve needs besides the poses: the lengths, and how both are weighed. Leading axes may be lanes."""

    ends: tuple[tuple[int, int], ...]
    nominal: Float[Array, "*lanes l"]  # mm
    sigma: Float[Array, "*lanes"]  # standard deviation of a tip coordinate, mm
    whitening: Float[Array, "*lanes l l"]  # inverse Cholesky factor of the lengths' covariance, 1/mm


def repeatability_residual(vector: Float[Array, " p"], args: tuple[Parameters, Measurement]) -> Float[Array, "N 3"]:
    """Distance vectors of all tips from their socket's centroid, mm (Cheng et al. 2018, eq. 13-14, by component); whitened
    where the measurement has weights."""
    space, measurement = args
    return measurement.whitened(measurement.centred(space.arm(vector).position(measurement.q)))


def joint_residual(
    vector: Float[Array, " p"],
    args: tuple[Parameters, Measurement, Float[Array, ""], Float[Array, "l l"]],
) -> tuple[Float[Array, "N 3"], Float[Array, " l"]]:
    """Repeatability and reference lengths together, each in units of its standard deviation.

    args: free parameters, measurement, standard deviation of a tip coordinate (mm), and the whitening of the lengths: the
    inverse Cholesky factor of their covariance (1/mm).
    """
    space, measurement, sigma, whitening = args
    tips = space.arm(vector).position(measurement.q)
    return measurement.whitened(measurement.centred(tips)) / sigma, whitening @ (
        measurement.distances(tips) - measurement.nominal
    )


def repeatability_model(vector: Float[Array, " p"], args: tuple[Parameters, Measurement]) -> Model:
    """Cost, gradient and Gram matrix of `repeatability_residual`, from the analytic columns."""
    space, measurement = args
    geometry = space.arm(vector).geometry
    return model_of(geometry, measurement.turns, measurement.sizes, space.entries(), weights=measurement.weights)


def joint_model(
    vector: Float[Array, " p"],
    args: tuple[Parameters, Measurement, Float[Array, ""], Float[Array, "l l"]],
) -> Model:
    """Cost, gradient and Gram matrix of `joint_residual`."""
    space, measurement, sigma, whitening = args
    weighing = Weighing(measurement.ends, measurement.nominal, sigma, whitening)
    geometry = space.arm(vector).geometry
    return model_of(geometry, measurement.turns, measurement.sizes, space.entries(), weighing, measurement.weights)


def measured_lengths(
    vector: Float[Array, " p"], space: Parameters, measurement: Measurement
) -> tuple[Float[Array, " l"], Float[Array, "l p"]]:
    """Measured reference lengths, mm, and their analytic Jacobian by the free parameters."""
    walked = walk(space.arm(vector).geometry, measurement.turns)
    columns = stacked_columns(walked, space.entries())
    return _distances(walked.tip, columns, measurement.sizes, measurement.ends, measurement.weights)


def model_of(
    geometry: Geometry,
    turns: Turns,
    sizes: tuple[int, ...],
    entries: tuple[tuple[str, int], ...],
    weighing: Weighing | None = None,
    weights: Weights | None = None,
) -> Model:
    """Cost, gradient and Gram matrix of the repeatability residual, for any batch of arms and poses that broadcast; with
    ``weighing``, of the joint residual of poses and lengths; with ``weights``, of whitened poses.

    The mean over a socket is taken off the Gram matrix as a correction of rank 3 a socket, J^T J - m mu^T mu, which spares
    a centred copy of the columns; the gradient needs none, because centred residuals sum to zero.
    """
    walked = walk(geometry, turns)
    columns = stacked_columns(walked, entries)
    # Centred twice: the rounding that one pass leaves in the mean (1e-13 mm) would otherwise be multiplied by the columns'
    # means, and near a perfect fit outweigh the gradient.
    averaging = averaging_matrix(sizes)
    residual = _centred_rows(walked.tip, averaging)
    if weights is None:
        residual, counted = _centred_rows(residual, averaging), columns
        shifts = columns @ jnp.asarray((averaging * np.sqrt(np.asarray(sizes, dtype=float))[:, None]).T)
    else:
        residual, counted = weights.centred(weights.whiten(residual), sizes), weights.whiten(columns)
        shifts = weights.sums(counted, sizes)
    residual = residual.reshape(*residual.shape[:-2], -1)
    flat = counted.reshape(*counted.shape[:-2], -1)
    weighted = shifts.reshape(*shifts.shape[:-2], -1)
    poses = Model(
        0.5 * jnp.sum(residual**2, axis=-1),
        (flat @ residual[..., None])[..., 0],
        flat @ jnp.swapaxes(flat, -1, -2) - weighted @ jnp.swapaxes(weighted, -1, -2),
    )
    if weighing is None:
        return poses
    distance, rows = _distances(walked.tip, columns, sizes, weighing.ends, weights)
    off = (weighing.whitening @ (distance - weighing.nominal)[..., None])[..., 0]
    rows = weighing.whitening @ rows
    weight = 1 / weighing.sigma**2
    return Model(
        weight * poses.cost + 0.5 * jnp.sum(off**2, axis=-1),
        weight[..., None] * poses.gradient + (off[..., None, :] @ rows)[..., 0, :],
        weight[..., None, None] * poses.gram + jnp.swapaxes(rows, -1, -2) @ rows,
    )


def _distances(
    tip: Float[Array, "*lanes 3 N"],
    columns: Float[Array, "*lanes p 3 N"],
    sizes: tuple[int, ...],
    ends: tuple[tuple[int, int], ...],
    weights: Weights | None,
) -> tuple[Float[Array, "*lanes l"], Float[Array, "*lanes l p"]]:
    """Distances between the centroids of sockets, mm, and their derivatives."""
    between = differences_matrix(ends, len(sizes)).T
    if weights is None:
        between = averaging_matrix(sizes).T @ between
        vectors, derivatives = tip @ jnp.asarray(between), columns @ jnp.asarray(between)
    else:
        vectors, derivatives = (weights.centroids(rows, sizes) @ jnp.asarray(between) for rows in (tip, columns))
    distance = jnp.linalg.norm(vectors, axis=-2)
    directions = vectors / distance[..., None, :]
    return distance, jnp.einsum("...cl,...pcl->...lp", directions, derivatives)


def _centred_rows(tip: Float[Array, "... 3 N"], averaging: np.ndarray) -> Float[Array, "... 3 N"]:
    return tip - (tip @ jnp.asarray(averaging.T)) @ jnp.asarray((averaging > 0).astype(float))
