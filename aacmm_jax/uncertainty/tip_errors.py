"""How errors of readings and seat reach the rows of a problem, and how far tips scatter by the residuals."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import inverse_positive_definite
from ..core.numpy_or_jax import AnyArray, namespace, scan, stop_gradient, while_loop
from ..data.noise import Noise
from ..data.observations.observation import Rows
from ..kinematics.chain import ForwardPass, JointKinds
from ..kinematics.jacobian import reading_columns, reading_rotations
from ..model.observed import Observed
from ..model.robust import median_square
from ..model.rows import PointRows

_LEAST_SIGMA = 1e-9  # mm
_ROUNDS, _MEDIAN_ROUNDS = 100, 20


class ArmErrors(NamedTuple):
    """How errors of a group's poses reach its rows."""

    by_readings: Float[AnyArray, "r n m"]  # mm (or rad) a rad, or a mm of prismatic joints
    by_seat: Float[AnyArray, "r c m"]  # of the tip's position, and of its orientation as far as the tip's lever goes
    kinds: JointKinds | None


def arm_errors(point: PointRows, observed: Observed) -> list[ArmErrors]:
    """Of every group."""
    forward = point.forward
    assert isinstance(forward, ForwardPass)  # nobody asks for these where rows are those of a batch
    xp = namespace(forward)
    readings, rotations = reading_columns(forward), reading_rotations(forward)  # (n, 3, N)
    # An arm whose tips err by s turns them by about s over its size.
    size = xp.sqrt(xp.mean(xp.sum(forward.tip**2, axis=0)))
    errors = []
    for part, group in zip(point.rows, observed.layout.groups, strict=True):
        by_tip, by_rotation, poses = part.by_tip, part.by_rotation, group.index
        by_readings = products(by_tip, readings[..., poses])
        by_seat = by_tip
        if by_rotation is not None:
            by_readings = by_readings + products(by_rotation, rotations[..., poses])
            by_seat = xp.concatenate([by_tip, by_rotation / size], axis=1)
        errors.append(ArmErrors(by_readings, by_seat, forward.kinds))
    return errors


def covariance_of_noise(errors: ArmErrors, noise: Noise) -> Float[AnyArray, "m r r"]:
    """Of a group's rows by the noise of readings and seat."""
    xp = namespace(errors, noise)
    spread = xp.broadcast_to(noise.of_readings(errors.kinds), (errors.by_readings.shape[1],))
    moved = errors.by_readings * spread[None, :, None]
    tip = errors.by_seat[:, :3]
    return squares(moved) + (noise.seating**2 + 1e-12) * squares(tip)


def covariance_of_sigma(errors: ArmErrors, sigma: Float[AnyArray, ""]) -> Float[AnyArray, "m r r"]:
    """Of a group's rows, where every coordinate of a tip scatters by ``sigma``, mm."""
    return namespace(errors, sigma).maximum(sigma, _LEAST_SIGMA) ** 2 * squares(errors.by_seat)


def squares(rows: Float[AnyArray, "r c m"]) -> Float[AnyArray, "m r r"]:
    """A matrix a pose times its own transpose."""
    return namespace(rows).moveaxis(products(rows, rows), -1, 0)


def products(left: Float[AnyArray, "r c m"], right: Float[AnyArray, "s c m"]) -> Float[AnyArray, "r s m"]:
    """A matrix a pose times the transpose of another, as sums: XLA computes many products of small matrices several
    times as slowly."""
    first, *others = (left[:, None, c] * right[None, :, c] for c in range(left.shape[1]))
    return sum(others, first)


def matrix_products(left: Float[AnyArray, "r s m"], right: Float[AnyArray, "s c m"]) -> Float[AnyArray, "r c m"]:
    """The product of two matrices a pose."""
    return products(left, namespace(right).swapaxes(right, 0, 1))


def _each(matrices: Float[AnyArray, "m r s"], vectors: Float[AnyArray, "s m"]) -> Float[AnyArray, "r m"]:
    """A matrix a pose times its vector."""
    return products(namespace(matrices).moveaxis(matrices, 0, -1), vectors[None])[:, 0]


def scatter_of(
    rows: list[Rows], errors: list[ArmErrors], degrees_of_freedom: Float[AnyArray, ""] | float
) -> Float[AnyArray, ""]:
    """Standard deviation of a tip coordinate, mm, with which the residuals are as large as they should be.

    The sum of w.w over all rows equals its degrees of freedom (Paule and Mandel 1982); 0 where what was measured
    explains more than all. Its derivative is that of the implicit equation.
    """
    xp = namespace([part.values for part in rows], errors, degrees_of_freedom)

    def excess(log_sigma: Any, rows: list[Rows], errors: list[ArmErrors], expected: Any) -> tuple[Any, Any]:
        """Of the weighted sum over its expectation, and its derivative by the logarithm of sigma."""
        total, slope = -1.0 * expected, 0.0
        for part, error in zip(rows, errors, strict=True):
            of_arm = covariance_of_sigma(error, xp.exp(log_sigma))
            inverse = inverse_positive_definite(part.measured + of_arm)
            solved = _each(inverse, part.values)
            total = total + xp.sum(solved * part.values)
            slope = slope - 2 * xp.sum(solved * _each(of_arm, solved))
        return total, xp.where(slope < 0, slope, -1.0)

    constant = stop_gradient((rows, errors, degrees_of_freedom))

    def refine(state: tuple[Any, Any]) -> tuple[Any, Any]:
        count, log_sigma = state
        total, slope = excess(log_sigma, *constant)
        # Newton's step in the logarithm; far above the root, where the sum falls as a power of sigma, a longer one.
        longer = xp.where(total > 0, (total + constant[2]) / constant[2], 1.0)
        step = xp.clip(-total / slope * longer, -2.0, 2.0)
        done = xp.abs(step) < 1e-12
        return xp.where(done, _ROUNDS, count + 1), xp.maximum(log_sigma + step, np.log(_LEAST_SIGMA))

    values = xp.concatenate([xp.reshape(part.values, (-1,)) for part in constant[0]])
    first = xp.log(xp.sqrt(xp.mean(values**2)) + _LEAST_SIGMA)
    _, root = while_loop(lambda state: state[0] < _ROUNDS, refine, (xp.asarray(0), first))
    # One more step, which is nothing, but carries the derivatives of the implicit equation.
    total, slope = excess(root, rows, errors, degrees_of_freedom)
    step = xp.where(root > np.log(_LEAST_SIGMA), -total / stop_gradient(slope), 0.0)
    return xp.exp(root + xp.clip(step, -0.1, 0.1))


def root_of_sum(value: Float[AnyArray, ""]) -> Float[AnyArray, ""]:
    """The square root of a sum of squares; its derivative at 0, where it has none, is set to 0."""
    xp, positive = namespace(value), value > 0
    return xp.where(positive, xp.sqrt(xp.where(positive, value, 1.0)), 0.0)


def robust_scatter_of(
    rows: list[Rows], errors: list[ArmErrors], degrees_of_freedom: Float[AnyArray, ""] | float
) -> Float[AnyArray, ""]:
    """The same from the median of the poses' squared residuals, each over its median for normal errors: a few bad poses
    do not change it much."""
    xp = namespace([part.values for part in rows], errors)
    constant, expected = stop_gradient((rows, errors)), stop_gradient(degrees_of_freedom)
    count = sum(part.values.size for part in rows)

    def rescale(log_sigma: Any, _: Any) -> tuple[Any, Any]:
        squares = []
        for part, error in zip(*constant, strict=True):
            inverse = inverse_positive_definite(part.measured + covariance_of_sigma(error, xp.exp(log_sigma)))
            square = xp.einsum("rm,mrs,sm->m", part.values, inverse, part.values)
            squares.append(square / median_square(part.values.shape[0]))
        ratio = xp.median(xp.concatenate(squares)) * count / expected
        return xp.maximum(log_sigma + 0.5 * xp.log(ratio + 1e-300), np.log(_LEAST_SIGMA)), xp.zeros(())

    return xp.exp(scan(rescale, xp.log(scatter_of(rows, errors, degrees_of_freedom)), length=_MEDIAN_ROUNDS)[0])
