"""The residuals that the identifications minimise, of a measurement by an arm, and their normal equations."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import inverse_cholesky
from ..core.numpy_or_jax import AnyArray, namespace
from ..kinematics.chain import forward_pass
from ..kinematics.jacobian import stacked_jacobian_columns
from ..kinematics.parameters import Parameters
from ..solver.active_set import QuadraticModel
from .measurement import LEAST_SIGMA, Measurement, between_ends, length_covariance
from .socket_sums import counts, means_over_sockets, sums_over_sockets, to_poses
from .weights import Weights


class JointWeights(NamedTuple):
    """Reference lengths of a joint solve, and the weights of poses and lengths. Leading axes may be a batch."""

    ends: tuple[tuple[int, int], ...]
    nominal: Float[AnyArray, "*batch l"]  # mm
    sigma: Float[AnyArray, "*batch"]  # standard deviation of a tip coordinate, mm
    whitening: Float[AnyArray, "*batch l l"]  # inverse Cholesky factor of the lengths' covariance, 1/mm

    @classmethod
    def of(cls, tips: Float[AnyArray, "N 3"], measurement: Measurement, sigma: Float[AnyArray, ""]) -> "JointWeights":
        """The weights at the tips of a nearly right arm, given the standard deviation of a tip coordinate, mm."""
        xp = namespace(tips, measurement, sigma)
        sigma = xp.maximum(sigma, LEAST_SIGMA)
        whitening = inverse_cholesky(length_covariance(measurement.centroids(tips), measurement, sigma))
        # Weights of poses are in standard deviations already.
        counted = sigma if measurement.weights is None else xp.ones_like(sigma)
        return cls(measurement.ends, measurement.nominal, counted, whitening)


def repeatability_residual(
    vector: Float[AnyArray, " p"], args: tuple[Parameters, Measurement]
) -> Float[AnyArray, "N 3"]:
    """Vectors of all tips from their socket's centroid, mm (Cheng et al. 2018, eq. 13-14, by component); whitened where
    the measurement has weights."""
    space, measurement = args
    return measurement.whitened(measurement.centred(space.arm(vector).position(measurement.q)))


def joint_residual(
    vector: Float[AnyArray, " p"],
    args: tuple[Parameters, Measurement, Float[AnyArray, ""], Float[AnyArray, "l l"]],
) -> tuple[Float[AnyArray, "N 3"], Float[AnyArray, " l"]]:
    """Repeatability and reference lengths together, each in units of its standard deviation.

    ``args`` are the free parameters, the measurement, the standard deviation of a tip coordinate (mm), and the
    whitening of the lengths: the inverse Cholesky factor of their covariance (1/mm).
    """
    space, measurement, sigma, whitening = args
    tips = space.arm(vector).position(measurement.q)
    return measurement.whitened(measurement.centred(tips)) / sigma, whitening @ (
        measurement.distances(tips) - measurement.nominal
    )


def repeatability_normal_equations(
    vector: Float[AnyArray, " p"], args: tuple[Parameters, Measurement]
) -> QuadraticModel:
    """Cost, gradient and Gram matrix of `repeatability_residual`, from the analytic Jacobian columns."""
    space, measurement = args
    tip, columns = _tip_and_columns(vector, space, measurement)
    return normal_equations(tip, columns, measurement.sizes, weights=measurement.weights)


def joint_normal_equations(
    vector: Float[AnyArray, " p"],
    args: tuple[Parameters, Measurement, Float[AnyArray, ""], Float[AnyArray, "l l"]],
) -> QuadraticModel:
    """Cost, gradient and Gram matrix of `joint_residual`."""
    space, measurement, sigma, whitening = args
    joint_weights = JointWeights(measurement.ends, measurement.nominal, sigma, whitening)
    tip, columns = _tip_and_columns(vector, space, measurement)
    return normal_equations(tip, columns, measurement.sizes, joint_weights, measurement.weights)


def _tip_and_columns(
    vector: Float[AnyArray, " p"], space: Parameters, measurement: Measurement
) -> tuple[Float[AnyArray, "... 3 N"], Float[AnyArray, "... p 3 N"]]:
    forward = forward_pass(space.geometry(vector), measurement.motion)
    return forward.tip, stacked_jacobian_columns(forward, space.indices())


def measured_lengths(
    vector: Float[AnyArray, " p"], space: Parameters, measurement: Measurement
) -> tuple[Float[AnyArray, " l"], Float[AnyArray, "l p"]]:
    """Measured reference lengths, mm, and their analytic Jacobian by the free parameters."""
    tip, columns = _tip_and_columns(vector, space, measurement)
    return _distances(tip, columns, measurement.sizes, measurement.ends, measurement.weights)


def normal_equations(
    tip: Float[AnyArray, "*batch 3 N"],
    columns: Float[AnyArray, "*batch p 3 N"],
    sizes: tuple[int, ...],
    joint_weights: JointWeights | None = None,
    weights: Weights | None = None,
) -> QuadraticModel:
    """Cost, gradient and Gram matrix of the repeatability residual, from tips and Jacobian columns; with
    ``joint_weights``, of the joint residual of poses and lengths; with ``weights``, of whitened poses.

    The mean over a socket is subtracted from the Gram matrix as a correction of rank 3 for each socket, J^T J - m mu^T
    mu, so that no centred copy of the columns is needed; nor for the gradient, because centred residuals sum to zero.
    """
    # Centred twice: the rounding error that one pass leaves in the mean (1e-13 mm) would otherwise be multiplied by the
    # columns' means, and exceed the gradient near a perfect fit.
    xp = namespace(tip, columns)
    residual = _centred(tip, sizes)
    if weights is None:
        residual, counted = _centred(residual, sizes), columns
        shifts = sums_over_sockets(columns, sizes) / np.sqrt(counts(sizes, columns.ndim))
    else:
        residual, counted = weights.centred(weights.whiten(residual), sizes), weights.whiten(columns)
        shifts = weights.sums(counted, sizes)
    residual = residual.reshape(*residual.shape[:-2], -1)
    flat = counted.reshape(*counted.shape[:-2], -1)
    weighted = shifts.reshape(*shifts.shape[:-2], -1)
    poses = QuadraticModel(
        0.5 * xp.sum(residual**2, axis=-1),
        (flat @ residual[..., None])[..., 0],
        flat @ flat.swapaxes(-1, -2) - weighted @ weighted.swapaxes(-1, -2),
    )
    if joint_weights is None:
        return poses
    distance, rows = _distances(tip, columns, sizes, joint_weights.ends, weights)
    off = (joint_weights.whitening @ (distance - joint_weights.nominal)[..., None])[..., 0]
    rows = joint_weights.whitening @ rows
    weight = 1 / joint_weights.sigma**2
    return QuadraticModel(
        weight * poses.cost + 0.5 * xp.sum(off**2, axis=-1),
        weight[..., None] * poses.gradient + (off[..., None, :] @ rows)[..., 0, :],
        weight[..., None, None] * poses.gram + rows.swapaxes(-1, -2) @ rows,
    )


def _distances(
    tip: Float[AnyArray, "*batch 3 N"],
    columns: Float[AnyArray, "*batch p 3 N"],
    sizes: tuple[int, ...],
    ends: tuple[tuple[int, int], ...],
    weights: Weights | None,
) -> tuple[Float[AnyArray, "*batch l"], Float[AnyArray, "*batch l p"]]:
    """Distances between the centroids of sockets, mm, and their derivatives."""
    xp, mean = namespace(tip), means_over_sockets if weights is None else weights.centroids
    vectors, derivatives = (between_ends(mean(rows, sizes), ends) for rows in (tip, columns))
    distance = xp.linalg.norm(vectors, axis=-2)
    directions = vectors / distance[..., None, :]
    return distance, xp.einsum("...cl,...pcl->...lp", directions, derivatives)


def _centred(tip: Float[AnyArray, "... 3 N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... 3 N"]:
    return tip - to_poses(means_over_sockets(tip, sizes), sizes)
