"""Covariance of a calibration from observations of all kinds, by the law of propagation (JCGM 100).

Rows are whitened residuals w = R e of the errors e: of the readings and of the seat, which reach them through the arm,
and of what was measured. The estimate follows them as dz = -G A w, with A the whitened derivatives (z, rows) and G the
inverse of the information A A^T, so its covariance is G A C A^T G, with C that of the rows.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import inverse_positive_definite
from ..core.numpy_or_jax import AnyArray, namespace, scan, stop_gradient, while_loop
from ..core.units import ARCSEC
from ..data.noise import Noise, noise_of, one_arcsec
from ..kinematics.chain import ForwardPass, JointKinds
from ..kinematics.jacobian import reading_columns, reading_rotations
from ..model.observed import Linear, Observed, Whitening, whitened
from ..model.robust import bounded_square, median_square

_LEAST_SIGMA = 1e-9  # mm
_ROUNDS, _MEDIAN_ROUNDS, _MOMENT_ROUNDS = 100, 20, 10


class ArmErrors(NamedTuple):
    """How errors of one observation's poses reach its rows."""

    by_readings: Float[AnyArray, "r n m"]  # mm (or rad) a rad, or a mm of prismatic joints
    by_seat: Float[AnyArray, "r c m"]  # of the tip's position, and of its orientation as far as the tip's lever goes
    kinds: JointKinds | None


def arm_errors(forward: ForwardPass, linear: list[Linear], observed: Observed) -> list[ArmErrors]:
    """Of every observation."""
    xp = namespace(forward, [part.jacobian for part in linear])
    readings, rotations = reading_columns(forward), reading_rotations(forward)  # (n, 3, N)
    # An arm whose tips err by s turns them by about s over its size.
    size = xp.sqrt(xp.mean(xp.sum(forward.tip**2, axis=0)))
    found = []
    for part, rows in zip(linear, observed.slices, strict=True):
        by_tip, by_rotation = part.rows.by_tip, part.rows.by_rotation
        by_readings = _product(by_tip, readings[..., rows])
        by_seat = by_tip
        if by_rotation is not None:
            by_readings = by_readings + _product(by_rotation, rotations[..., rows])
            by_seat = xp.concatenate([by_tip, by_rotation / size], axis=1)
        found.append(ArmErrors(by_readings, by_seat, forward.kinds))
    return found


def covariance_of_noise(errors: ArmErrors, noise: Noise) -> Float[AnyArray, "m r r"]:
    """Of one observation's rows by the noise of readings and seat."""
    xp = namespace(errors, noise)
    each = xp.broadcast_to(noise.of_readings(errors.kinds), (errors.by_readings.shape[1],))
    moved = errors.by_readings * each[None, :, None]
    tip = errors.by_seat[:, :3]
    return _squares(moved) + (noise.seating**2 + 1e-12) * _squares(tip)


def covariance_of_sigma(errors: ArmErrors, sigma: Float[AnyArray, ""]) -> Float[AnyArray, "m r r"]:
    """Of one observation's rows, where every coordinate of a tip scatters by ``sigma``, mm."""
    return namespace(errors, sigma).maximum(sigma, _LEAST_SIGMA) ** 2 * _squares(errors.by_seat)


def _squares(rows: Float[AnyArray, "r c m"]) -> Float[AnyArray, "m r r"]:
    return namespace(rows).moveaxis(_product(rows, rows), -1, 0)


def _product(one: Float[AnyArray, "r c m"], other: Float[AnyArray, "s c m"]) -> Float[AnyArray, "r s m"]:
    """A matrix a pose times the transpose of another, as sums: XLA computes many products of small matrices several
    times as slowly."""
    first, *others = (one[:, None, c] * other[None, :, c] for c in range(one.shape[1]))
    return sum(others, first)


def _each(matrices: Float[AnyArray, "m r s"], vectors: Float[AnyArray, "s m"]) -> Float[AnyArray, "r m"]:
    """A matrix a pose times its vector."""
    return _product(namespace(matrices).moveaxis(matrices, 0, -1), vectors[None])[:, 0]


def scatter_of(
    linear: list[Linear], errors: list[ArmErrors], degrees_of_freedom: Float[AnyArray, ""] | float
) -> Float[AnyArray, ""]:
    """Standard deviation of a tip coordinate, mm, with which the residuals are as large as they should be.

    The sum of w.w over all rows equals its degrees of freedom (Paule and Mandel 1982); 0 where what was measured
    explains more than all. Its derivative is that of the implicit equation.
    """
    xp = namespace([part.jacobian for part in linear], errors, degrees_of_freedom)

    def excess(log_sigma: Any, linear: list[Linear], errors: list[ArmErrors], expected: Any) -> tuple[Any, Any]:
        """Of the weighted sum over its expectation, and its derivative by the logarithm of sigma."""
        total, slope = -1.0 * expected, 0.0
        for part, error in zip(linear, errors, strict=True):
            of_arm = covariance_of_sigma(error, xp.exp(log_sigma))
            inverse = inverse_positive_definite(part.rows.measured + of_arm)
            solved = _each(inverse, part.rows.values)
            total = total + xp.sum(solved * part.rows.values)
            slope = slope - 2 * xp.sum(solved * _each(of_arm, solved))
        return total, xp.where(slope < 0, slope, -1.0)

    known = stop_gradient((linear, errors, degrees_of_freedom))

    def refine(state: tuple[Any, Any]) -> tuple[Any, Any]:
        count, log_sigma = state
        total, slope = excess(log_sigma, *known)
        # Newton's step in the logarithm; far above the root, where the sum falls as a power of sigma, a longer one.
        longer = xp.where(total > 0, (total + known[2]) / known[2], 1.0)
        step = xp.clip(-total / slope * longer, -2.0, 2.0)
        done = xp.abs(step) < 1e-12
        return xp.where(done, _ROUNDS, count + 1), xp.maximum(log_sigma + step, np.log(_LEAST_SIGMA))

    values = xp.concatenate([xp.reshape(part.rows.values, (-1,)) for part in known[0]])
    first = xp.log(xp.sqrt(xp.mean(values**2)) + _LEAST_SIGMA)
    _, root = while_loop(lambda state: state[0] < _ROUNDS, refine, (xp.asarray(0), first))
    # One more step, which is nothing, but carries the derivatives of the implicit equation.
    total, slope = excess(root, linear, errors, degrees_of_freedom)
    step = xp.where(root > np.log(_LEAST_SIGMA), -total / stop_gradient(slope), 0.0)
    return xp.exp(root + xp.clip(step, -0.1, 0.1))


def robust_scatter_of(
    linear: list[Linear], errors: list[ArmErrors], degrees_of_freedom: Float[AnyArray, ""] | float
) -> Float[AnyArray, ""]:
    """The same from the median of the poses' squared residuals, each over its median for normal errors: a few bad poses
    do not change it much."""
    xp = namespace([part.jacobian for part in linear], errors)
    known, expected = stop_gradient((linear, errors)), stop_gradient(degrees_of_freedom)
    count = sum(part.rows.values.size for part in linear)

    def rescale(log_sigma: Any, _: Any) -> tuple[Any, Any]:
        squares = []
        for part, error in zip(*known, strict=True):
            inverse = inverse_positive_definite(part.rows.measured + covariance_of_sigma(error, xp.exp(log_sigma)))
            square = xp.einsum("rm,mrs,sm->m", part.rows.values, inverse, part.rows.values)
            squares.append(square / median_square(part.rows.values.shape[0]))
        ratio = xp.median(xp.concatenate(squares)) * count / expected
        return xp.maximum(log_sigma + 0.5 * xp.log(ratio + 1e-300), np.log(_LEAST_SIGMA)), xp.zeros(())

    return xp.exp(scan(rescale, xp.log(scatter_of(linear, errors, degrees_of_freedom)), length=_MEDIAN_ROUNDS)[0])


class Moments(NamedTuple):
    """Estimated variances of the noise: of readings, arcsec^2, and of the seat, mm^2."""

    encoder: Float[AnyArray, ""]
    seat: Float[AnyArray, ""]


def stacked(
    linear: list[Linear], observed: Observed, whitening: Whitening, size: int
) -> list[Float[AnyArray, "_ _ _"]]:
    """The whitened derivatives of each observation by all unknowns."""
    found = []
    for part, root in zip(linear, whitening.roots, strict=True):
        _, jacobian = whitened(part, root)
        xp = namespace(jacobian)
        chosen = (np.arange(size)[:, None] == part.indices[None, :]).astype(float)
        found.append(xp.einsum("zk,krm->zrm", xp.asarray(chosen), jacobian))
    return found


class _Parts(NamedTuple):
    """What `moments` needs of one observation, in whitened rows."""

    white: Float[AnyArray, "r m"]
    readings: Float[AnyArray, "r r m"]  # D: covariance for 1 arcsec
    seat: Float[AnyArray, "r r m"]  # T: for 1 mm
    measured: Float[AnyArray, "r r m"]  # S: of what was measured
    rows: Float[AnyArray, "z r m"]  # A
    influence: Float[AnyArray, "z r m"]  # A W, as the loss of the estimate weights them


def moments(
    linear: list[Linear],
    errors: list[ArmErrors],
    rows: list[Float[AnyArray, "_ _ _"]],
    influence: list[Float[AnyArray, "_ _ _"]],
    whitening: Whitening,
    inverse: Float[AnyArray, "z z"],
    sigma: Float[AnyArray, ""],
    robust: bool = False,
    prior: Float[AnyArray, "z z"] | None = None,
) -> Moments:
    """Both variances from two moments of the whitened residuals w = M e, M = I - A^T G A W.

    With D and T the parts of a row's covariance for 1 arcsec and 1 mm, and S that of what was measured,
    E[w.Dw] = v tr(DMDM^T) + s tr(DMTM^T) + tr(DMSM^T), and likewise with T (Henderson 1953). A negative variance is set
    to 0 and the other taken from the total scatter ``sigma``. With the information P of a prior, whose errors have
    these variances too, A^T G P G A is added to the residuals' covariance.

    ``robust``: so that outliers have little influence, the forms are C^-1 D C^-1 and C^-1 T C^-1, with C = v D + s T +
    S by the variances so far, and a pose with w.C^-1 w above the 95 % point of chi-square counts as one at that point,
    over the expectation of this for normal errors (Huber's proposal 2 of 1964, here for two variances).
    """
    xp = namespace(inverse, sigma, rows)
    known = None if prior is None else inverse @ prior @ inverse
    parts = []
    for part, error, root, j, weighted in zip(linear, errors, whitening.roots, rows, influence, strict=True):
        of_unit = xp.asarray(np.reshape(one_arcsec(error.kinds), (1, -1, 1)))
        readings = xp.einsum("mab,bnm->anm", root, error.by_readings * of_unit)
        seat = xp.einsum("mab,bnm->anm", root, error.by_seat)
        parts.append(
            _Parts(
                white=xp.einsum("mab,bm->am", root, part.rows.values),
                readings=xp.einsum("anm,bnm->abm", readings, readings),
                seat=xp.einsum("anm,bnm->abm", seat, seat),
                measured=xp.einsum("mab,mbc,mdc->adm", root, part.rows.measured, root),
                rows=j,
                influence=weighted,
            )
        )
    if not robust:
        counts = [xp.ones(part.white.shape[1]) for part in parts]
        plain = [part.readings for part in parts], [part.seat for part in parts]
        return _solved(parts, *plain, counts, inverse, sigma, known)

    def again(found: Moments, _: Any) -> tuple[Moments, Any]:
        forms_d, forms_t, counts = [], [], []
        for part in parts:
            by_covariance, count = _bounded(part, stop_gradient(found))
            forms_d.append(xp.einsum("abm,bcm,cdm->adm", by_covariance, part.readings, by_covariance))
            forms_t.append(xp.einsum("abm,bcm,cdm->adm", by_covariance, part.seat, by_covariance))
            counts.append(count)
        return _solved(parts, forms_d, forms_t, counts, inverse, sigma, known), xp.zeros(())

    return scan(again, Moments(xp.zeros(()), sigma**2), length=_MOMENT_ROUNDS)[0]


def _bounded(part: _Parts, found: Moments) -> tuple[Float[AnyArray, "r r m"], Float[AnyArray, " m"]]:
    """C^-1 of every pose, and how much its square counts."""
    xp, r = namespace(part.white, found), part.white.shape[0]
    # A little of the first weights besides, since C has no inverse where two joints are all that errs.
    covariance = found.encoder * part.readings + found.seat * part.seat + part.measured
    covariance = covariance + 0.01 * xp.asarray(np.eye(r))[:, :, None]
    inverse = xp.moveaxis(inverse_positive_definite(xp.moveaxis(covariance, -1, 0)), 0, -1)
    square = xp.einsum("am,abm,bm->m", part.white, inverse, part.white)
    most, expected = bounded_square(r)
    return inverse, xp.minimum(1.0, most / xp.maximum(square, 1e-300)) / expected


def _solved(
    parts: list[_Parts],
    forms_d: list[Float[AnyArray, "_ _ _"]],
    forms_t: list[Float[AnyArray, "_ _ _"]],
    counts: list[Float[AnyArray, " _"]],
    inverse: Float[AnyArray, "z z"],
    sigma: Float[AnyArray, ""],
    known: Float[AnyArray, "z z"] | None,
) -> Moments:
    """The variances that explain both sums of quadratic forms of the residuals, of which ``known`` is the part of the
    unknowns' covariance that follows from a prior."""
    xp = namespace(inverse, sigma)
    d, t, s = ([getattr(part, name) for part in parts] for name in ("readings", "seat", "measured"))

    def seen(forms: list[Any]) -> Any:
        each = zip(parts, forms, counts, strict=True)
        return sum(xp.einsum("am,abm,bm,m->", part.white, form, part.white, count) for part, form, count in each)

    dd, dt, td, tt = (_expected(parts, form, by, inverse) for form in (forms_d, forms_t) for by in (d, t))
    right_d = seen(forms_d) - _expected(parts, forms_d, s, inverse)
    right_t = seen(forms_t) - _expected(parts, forms_t, s, inverse)
    if known is not None:
        right_d, right_t = (
            right
            - xp.sum(
                known * sum(_outer(_product(part.rows, f), part.rows) for part, f in zip(parts, forms, strict=True))
            )
            for right, forms in ((right_d, forms_d), (right_t, forms_t))
        )
    determinant = dd * tt - dt * td
    apart = determinant > 1e-9 * dd * tt
    safe = xp.where(apart, determinant, 1.0)
    encoder, seat = (tt * right_d - dt * right_t) / safe, (dd * right_t - td * right_d) / safe
    alone = xp.maximum(right_d / xp.where(dd > 0, dd, 1.0), 0.0)
    positive = apart & (encoder > 0)
    return Moments(
        xp.where(positive, xp.where(seat > 0, encoder, alone), 0.0),
        xp.where(positive, xp.maximum(seat, 0.0), sigma**2),
    )


def _expected(parts: list[_Parts], forms: list[Any], covariances: list[Any], inverse: Float[AnyArray, "z z"]) -> Any:
    """tr(Q M C M^T), the expectation of w.Qw where e has the covariance C."""
    both, of_form, of_covariance, mixed = 0.0, 0.0, 0.0, 0.0
    for part, form, covariance in zip(parts, forms, covariances, strict=True):
        both = both + namespace(form, covariance).sum(form * covariance)
        by_form, by_covariance = _product(part.rows, form), _product(part.influence, covariance)  # both symmetric
        of_form = of_form + _outer(by_form, part.rows)
        of_covariance = of_covariance + _outer(by_covariance, part.influence)
        mixed = mixed + _outer(by_form, by_covariance)
    return (
        both
        - 2 * namespace(mixed).sum(inverse * mixed)
        + namespace(mixed).sum((inverse @ of_form) * (inverse @ of_covariance).T)
    )


def alone(
    linear: list[Linear],
    rows: list[Float[AnyArray, "_ _ _"]],
    whitening: Whitening,
    inverse: Float[AnyArray, "z z"],
) -> list[Float[AnyArray, "_ _ _"]]:
    """Covariance of every pose's whitened rows from its own residual, as it were without the pose in the fit."""
    found = []
    for part, root, j in zip(linear, whitening.roots, rows, strict=True):
        xp = namespace(inverse, j)
        leverage = xp.einsum("zam,zbm->mab", j, xp.einsum("zy,ybm->zbm", inverse, j))
        redundancy = inverse_positive_definite(1.05 * xp.asarray(np.eye(j.shape[1]))[None] - leverage)
        white = xp.einsum("mab,bm->am", root, part.rows.values)
        left = xp.einsum("mab,bm->ma", redundancy, white)
        found.append(left[:, :, None] * left[:, None, :])
    return found


def _outer(one: Float[AnyArray, "z r m"], other: Float[AnyArray, "z r m"]) -> Float[AnyArray, "z z"]:
    return one.reshape(one.shape[0], -1) @ other.reshape(other.shape[0], -1).T


def of_measurements(
    linear: list[Linear], rows: list[Float[AnyArray, "_ _ _"]], whitening: Whitening
) -> Float[AnyArray, "z z"]:
    """What errors of measured values contribute to the middle of the covariance."""
    xp = namespace(rows)
    total = xp.zeros((len(rows[0]), len(rows[0])))
    for part, root, j in zip(linear, whitening.roots, rows, strict=True):
        moved = xp.einsum("zam,mab->zbm", j, root)
        total = total + _outer(xp.einsum("zam,mab->zbm", moved, part.rows.measured), moved)
    return total


def propagated(
    linear: list[Linear],
    errors: list[ArmErrors],
    rows: list[Float[AnyArray, "_ _ _"]],
    whitening: Whitening,
    inverse: Float[AnyArray, "z z"],
    stated: Float[AnyArray, "z z"],
    noise: Noise,
    pose: np.ndarray,
) -> Float[AnyArray, "z z"]:
    """Covariance of the unknowns by the noise; ``stated`` is what lengths, certified and measured values contribute to
    its middle.

    Rows with one number in ``pose`` were read at once, so they share the errors of their readings.
    """
    xp = namespace(inverse, stated, noise, rows)
    total, by_readings = stated, []
    for error, root, j in zip(errors, whitening.roots, rows, strict=True):
        moved = xp.einsum("zam,mab->zbm", j, root)  # by the unwhitened rows
        seat = xp.einsum("zam,acm->zcm", moved, error.by_seat)
        total = total + noise.seating**2 * _outer(seat, seat)
        by_readings.append(xp.einsum("zam,anm->znm", moved, error.by_readings))
    readings = xp.concatenate(by_readings, axis=2)
    if len(np.unique(pose)) < len(pose):
        readings = readings @ xp.asarray((pose[:, None] == np.unique(pose)[None, :]).astype(float))
    each = xp.broadcast_to(noise.of_readings(errors[0].kinds), (readings.shape[1],))
    readings = readings * each[None, :, None]
    return inverse @ (total + _outer(readings, readings)) @ inverse


def noise_from(found: Moments) -> Noise:
    """The noise of both variances, one encoder for all."""
    return noise_of(ARCSEC * _root(found.encoder), _root(found.seat))


def _root(value: Float[AnyArray, ""]) -> Float[AnyArray, ""]:
    # The square root has no derivative at 0, the value of a variance whose estimate is negative.
    xp = namespace(value)
    return xp.where(value > 0, xp.sqrt(xp.where(value > 0, value, 1.0)), 0.0)
