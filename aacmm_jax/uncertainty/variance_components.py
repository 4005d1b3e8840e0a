"""How far tips scatter by the residuals, and variances of readings and seat, estimated from these by two moments.

The whitened residuals of poses follow their errors e as w = M e with M = I - U, U = (B^T D^-1 B + A^T G A) W: A and B
are the derivatives by the head and by the private geometry, of which A has the latter eliminated (`model.elimination`),
D and 1/G the information of both, and W the weights of a robust loss. So for a block-diagonal Q and errors of the
covariance C, the expectation of w.Qw is a trace that is linear in the variances,

    tr(Q M C M^T) = tr(QC) - 2 tr(QUC) + tr(QUCU^T),

each a sum over small matrices.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import inverse_positive_definite, matrix_products, products
from ..core.numpy_or_jax import AnyArray, namespace, scan, stop_gradient, while_loop
from ..core.units import ARCSEC
from ..data.noise import Noise, noise_of, one_arcsec
from ..data.observations.observation import Rows
from ..data.observations.reduced_rows import MOVED
from ..model.elimination import flat, sums_by_component
from ..model.robust import bounded_square, median_square
from ..model.rows import Whitening
from .linear_propagation import (
    LEAST_SIGMA,
    ArmErrors,
    Influence,
    covariance_of_sigma,
    row_errors,
)

_ROUNDS, _NEWTON_ROUNDS, _MEDIAN_ROUNDS = 10, 100, 20


class Moments(NamedTuple):
    """Estimated variances of the noise: of readings, arcsec^2, and of the seat, mm^2."""

    encoder: Float[AnyArray, ""]
    seat: Float[AnyArray, ""]


def moments(
    influence: Influence,
    rows: list[Rows],
    errors: list[ArmErrors],
    whitening: Whitening,
    sigma: Float[AnyArray, ""],
    robust: bool = False,
    prior: Float[AnyArray, "h h"] | None = None,
) -> Moments:
    """Both variances from two moments of the whitened residuals.

    With D and T the parts of a row's covariance for 1 arcsec and 1 mm, and S that of what was measured,
    E[w.Dw] = v tr(DMDM^T) + s tr(DMTM^T) + tr(DMSM^T), and likewise with T (Henderson 1953). A negative variance is set
    to 0 and the other taken from the total scatter ``sigma``. With the information P of a prior, whose errors have
    these variances too, A^T G P G A is added to the residuals' covariance.

    ``robust``: so that outliers have little influence, the forms are C^-1 D C^-1 and C^-1 T C^-1, with C = v D + s T +
    S by the variances so far, and a pose with w.C^-1 w above the 95 % point of chi-square counts as one at that point,
    over the expectation of this for normal errors (Huber's proposal 2 of 1964, here for two variances).
    """
    xp, inverse = namespace(influence.inverse, sigma), influence.inverse
    of_prior = None if prior is None else inverse @ prior @ inverse
    parts = []
    for part, error, root in zip(rows, errors, whitening.roots, strict=True):
        readings, seat, measured = row_errors(part, error, root, xp.asarray(one_arcsec(error.kinds)))
        parts.append((products(readings, readings), products(seat, seat), measured))
    plain = [list(matrices) for matrices in zip(*parts, strict=True)]  # D, T and S of each group
    white = [
        block.white if part.basis is None else xp.where(_not_moved(block.white), 0.0, block.white)
        for part, block in zip(rows, influence.blocks, strict=False)
    ]
    columns = [_Sums.of(influence, matrices, weighted=True) for matrices in plain]

    def solved(forms: list[list[Any]], counts: list[Any]) -> Moments:
        """The variances that explain both sums of quadratic forms of the residuals; the expectations of a form are
        those for 1 arcsec, for 1 mm and of what was measured."""
        table, seen = [], []
        for of_form in forms:
            poses = zip(white, of_form, counts, strict=True)
            seen.append(sum(xp.einsum("am,abm,bm,m->", values, form, values, count) for values, form, count in poses))
            sums = _Sums.of(influence, of_form, weighted=False)
            row = [_expectation(influence, sums, column) for column in columns]
            table.append([*row[:2], row[2] if of_prior is None else row[2] + xp.sum(of_prior * sums.head)])
        (dd, dt, ds), (td, tt, ts) = table
        right_d, right_t = seen[0] - ds, seen[1] - ts
        determinant = dd * tt - dt * td
        apart = determinant > 1e-9 * dd * tt
        safe = xp.where(apart, determinant, 1.0)
        encoder, seat = (tt * right_d - dt * right_t) / safe, (dd * right_t - td * right_d) / safe
        without_seat = xp.maximum(right_d / xp.where(dd > 0, dd, 1.0), 0.0)
        positive = apart & (encoder > 0)
        return Moments(
            xp.where(positive, xp.where(seat > 0, encoder, without_seat), 0.0),
            xp.where(positive, xp.maximum(seat, 0.0), sigma**2),
        )

    if not robust:
        return solved(plain[:2], [xp.ones(values.shape[1]) for values in white])

    def again(last: Moments, _: Any) -> tuple[Moments, Any]:
        forms, counts = ([], []), []
        encoder, seat = stop_gradient(last)
        for values, (of_readings, of_seat, measured) in zip(white, parts, strict=True):
            # A little of the first weights besides, since C has no inverse where two joints are all that errs.
            r = values.shape[0]
            covariance = encoder * of_readings + seat * of_seat + measured + 0.01 * xp.asarray(np.eye(r))[:, :, None]
            inverse = xp.moveaxis(inverse_positive_definite(xp.moveaxis(covariance, -1, 0)), 0, -1)
            square, (most, expected) = xp.einsum("am,abm,bm->m", values, inverse, values), bounded_square(r)
            counts.append(xp.minimum(1.0, most / xp.maximum(square, 1e-300)) / expected)
            for form, matrix in zip(forms, (of_readings, of_seat), strict=True):
                form.append(matrix_products(matrix_products(inverse, matrix), inverse))
        return solved(list(forms), counts), xp.zeros(())

    return scan(again, Moments(xp.zeros(()), sigma**2), length=_ROUNDS)[0]


class _Sums(NamedTuple):
    """Sums over poses of A N A^T, B N B^T and B N A^T, with a matrix N for each pose; A and B ``weighted`` by W or not.

    N is a form Q, of rows that are not weighted, or a covariance C, of weighted ones.
    """

    matrices: list[Any]  # N
    by_head: list[Any]  # A N of each group
    by_private: list[Any]  # B N of each group; None without private geometry
    head: Any
    private: list[Any]  # of each class
    crossed: list[Any]

    @classmethod
    def of(cls, influence: Influence, matrices: list[Any], weighted: bool) -> "_Sums":
        xp = namespace(influence.inverse, matrices)
        private, crossed = (
            [xp.zeros_like(zero) for zero in zeros] for zeros in (influence.d_inverses, influence.follow)
        )
        head, by_head, by_private = xp.zeros_like(influence.inverse), [], []
        for number, matrix in enumerate(matrices):
            block, a, b = influence.blocks[number], influence.rows[number], influence.own_rows(number)
            if weighted:
                a, b = influence.weighted(number, a), None if b is None else influence.weighted(number, b)
            by_head.append(products(a, matrix))
            by_private.append(None if b is None else products(b, matrix))
            head = head + _outer(by_head[-1], a)
            if b is not None:
                k = block.class_index
                private[k] = private[k] + sums_by_component(by_private[-1], b, block.sizes)
                crossed[k] = crossed[k] + sums_by_component(by_private[-1], a, block.sizes)
        return cls(matrices, by_head, by_private, head, private, crossed)


def _expectation(influence: Influence, form: _Sums, column: _Sums) -> Any:
    """tr(Q M C M^T), by the module's equation: U has a part of the head, and one of the components."""
    xp, inverse = namespace(influence.inverse), influence.inverse
    total: Any = xp.sum((inverse @ form.head) * (inverse @ column.head).T)
    for number, block in enumerate(influence.blocks[: len(form.matrices)]):
        total = total + xp.sum(form.matrices[number] * column.matrices[number])
        total = total - 2 * xp.sum(inverse * _outer(form.by_head[number], column.by_head[number]))
        if block.class_index >= 0:
            both = sums_by_component(form.by_private[number], column.by_private[number], block.sizes)
            total = total - 2 * xp.sum(influence.d_inverses[block.class_index] * both)
    classes = zip(influence.d_inverses, form.private, form.crossed, column.private, column.crossed, strict=True)
    for inverse_private, form_private, form_crossed, private, crossed in classes:
        total = total + xp.sum((inverse_private @ form_private) * xp.swapaxes(inverse_private @ private, -1, -2))
        total = total + 2 * xp.sum((inverse_private @ crossed @ inverse) * form_crossed)
    return total


def _outer(left: Float[AnyArray, "h r m"], right: Float[AnyArray, "h r m"]) -> Float[AnyArray, "h h"]:
    return flat(left) @ flat(right).T


def noise_from(variances: Moments) -> Noise:
    """The noise of both variances, one encoder for all."""
    return noise_of(ARCSEC * root_of_sum(variances.encoder), root_of_sum(variances.seat))


def _each(matrices: Float[AnyArray, "m r s"], vectors: Float[AnyArray, "s m"]) -> Float[AnyArray, "r m"]:
    """A matrix a pose times its vector."""
    return products(namespace(matrices).moveaxis(matrices, 0, -1), vectors[None])[:, 0]


def only_moved_rows(rows: list[Rows]) -> list[Rows]:
    """Rows of which those are 0 that errors of the arm do not reach (`data.observations.reduced_rows`)."""
    xp = namespace([part.values for part in rows])
    kept = [part.values if part.basis is None else xp.where(_not_moved(part.values), 0.0, part.values) for part in rows]
    return [part._replace(values=values) for part, values in zip(rows, kept, strict=True)]


def _not_moved(values: Float[AnyArray, "r m"]) -> np.ndarray:
    return np.broadcast_to(np.arange(len(values))[:, None] >= MOVED, values.shape)


def scatter_of(
    rows: list[Rows], errors: list[ArmErrors], degrees_of_freedom: Float[AnyArray, ""] | float
) -> Float[AnyArray, ""]:
    """Standard deviation of a tip coordinate, mm, with which the residuals are as large as they should be.

    The sum of w.w over all rows equals its degrees of freedom (Paule and Mandel 1982); 0 where what was measured
    explains more than all. Its derivative is that of the implicit equation.
    """
    xp, rows = namespace([part.values for part in rows], errors, degrees_of_freedom), only_moved_rows(rows)

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
        return xp.where(done, _NEWTON_ROUNDS, count + 1), xp.maximum(log_sigma + step, np.log(LEAST_SIGMA))

    values = xp.concatenate([xp.reshape(part.values, (-1,)) for part in constant[0]])
    first = xp.log(xp.sqrt(xp.mean(values**2)) + LEAST_SIGMA)
    _, root = while_loop(lambda state: state[0] < _NEWTON_ROUNDS, refine, (xp.asarray(0), first))
    # One more step, which is nothing, but carries the derivatives of the implicit equation.
    total, slope = excess(root, rows, errors, degrees_of_freedom)
    step = xp.where(root > np.log(LEAST_SIGMA), -total / stop_gradient(slope), 0.0)
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
    xp, rows = namespace([part.values for part in rows], errors), only_moved_rows(rows)
    constant, expected = stop_gradient((rows, errors)), stop_gradient(degrees_of_freedom)
    lengths = [len(part.values) if part.basis is None else MOVED for part in rows]
    count = sum(length * part.values.shape[1] for length, part in zip(lengths, rows, strict=True))

    def rescale(log_sigma: Any, _: Any) -> tuple[Any, Any]:
        squares = []
        for part, error, length in zip(*constant, lengths, strict=True):
            inverse = inverse_positive_definite(part.measured + covariance_of_sigma(error, xp.exp(log_sigma)))
            square = xp.einsum("rm,mrs,sm->m", part.values, inverse, part.values)
            squares.append(square / median_square(length))
        ratio = xp.median(xp.concatenate(squares)) * count / expected
        return xp.maximum(log_sigma + 0.5 * xp.log(ratio + 1e-300), np.log(LEAST_SIGMA)), xp.zeros(())

    return xp.exp(scan(rescale, xp.log(scatter_of(rows, errors, degrees_of_freedom)), length=_MEDIAN_ROUNDS)[0])
