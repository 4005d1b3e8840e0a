"""Variances of readings and seat, estimated from the residuals by two moments.

The whitened residuals of poses follow their errors e as w = M e with M = I - (B^T D^-1 B + A^T G A) W: A and B are the
derivatives by the head and by the private geometry, of which A has the latter eliminated (`model.elimination`), D and
1/G the information of both, and W the weights of a robust loss. So the expectation of w.Qw, for a block-diagonal Q, is
a trace that is linear in the variances.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import inverse_positive_definite
from ..core.numpy_or_jax import AnyArray, namespace, scan, stop_gradient
from ..core.units import ARCSEC
from ..data.noise import Noise, noise_of, one_arcsec
from ..data.observations.observation import Rows
from ..model.elimination import sums_by_component
from ..model.robust import bounded_square
from ..model.rows import Whitening
from .linear_propagation import Influence
from .tip_errors import ArmErrors, products

_ROUNDS = 10


class Moments(NamedTuple):
    """Estimated variances of the noise: of readings, arcsec^2, and of the seat, mm^2."""

    encoder: Float[AnyArray, ""]
    seat: Float[AnyArray, ""]


class _Covariances(NamedTuple):
    """Of a group's whitened rows."""

    readings: Float[AnyArray, "r r m"]  # D: for 1 arcsec
    seat: Float[AnyArray, "r r m"]  # T: for 1 mm
    measured: Float[AnyArray, "r r m"]  # S: of what was measured


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
    xp = namespace(influence.inverse, sigma)
    inverse = influence.inverse
    known = None if prior is None else inverse @ prior @ inverse
    parts = []
    for part, error, root in zip(rows, errors, whitening.roots, strict=True):
        each = xp.moveaxis(root, 0, -1)
        of_unit = xp.asarray(np.reshape(one_arcsec(error.kinds), (1, -1, 1)))
        readings = _by(each, error.by_readings * of_unit)
        seat = _by(each, error.by_seat)
        measured = _by(_by(each, xp.moveaxis(part.measured, 0, -1)), each, transposed=True)
        parts.append(_Covariances(products(readings, readings), products(seat, seat), measured))
    white = [block.white for block in influence.blocks[: len(rows)]]
    columns = [_Column.of(influence, [getattr(part, name) for part in parts]) for name in _Covariances._fields]
    if not robust:
        counts = [xp.ones(values.shape[1]) for values in white]
        plain = [part.readings for part in parts], [part.seat for part in parts]
        return _solved(influence, white, columns, *plain, counts, sigma, known)

    def again(found: Moments, _: Any) -> tuple[Moments, Any]:
        forms_d, forms_t, counts = [], [], []
        for values, part in zip(white, parts, strict=True):
            by_covariance, count = _bounded(values, part, stop_gradient(found))
            forms_d.append(_by(_by(by_covariance, part.readings), by_covariance))
            forms_t.append(_by(_by(by_covariance, part.seat), by_covariance))
            counts.append(count)
        return _solved(influence, white, columns, forms_d, forms_t, counts, sigma, known), xp.zeros(())

    return scan(again, Moments(xp.zeros(()), sigma**2), length=_ROUNDS)[0]


def _by(
    one: Float[AnyArray, "r s m"], other: Float[AnyArray, "s c m"], transposed: bool = False
) -> Float[AnyArray, "r c m"]:
    """The product of two matrices a pose, or of one with the transpose of the other."""
    return products(one, other if transposed else namespace(other).swapaxes(other, 0, 1))


def _bounded(
    white: Float[AnyArray, "r m"], part: _Covariances, found: Moments
) -> tuple[Float[AnyArray, "r r m"], Float[AnyArray, " m"]]:
    """C^-1 of every pose, and how much its square counts."""
    xp, r = namespace(white, found), white.shape[0]
    # A little of the first weights besides, since C has no inverse where two joints are all that errs.
    covariance = found.encoder * part.readings + found.seat * part.seat + part.measured
    covariance = covariance + 0.01 * xp.asarray(np.eye(r))[:, :, None]
    inverse = xp.moveaxis(inverse_positive_definite(xp.moveaxis(covariance, -1, 0)), 0, -1)
    square = xp.einsum("am,abm,bm->m", white, inverse, white)
    most, expected = bounded_square(r)
    return inverse, xp.minimum(1.0, most / xp.maximum(square, 1e-300)) / expected


def _solved(
    influence: Influence,
    white: list[Float[AnyArray, "_ _"]],
    columns: list["_Column"],
    forms_d: list[Float[AnyArray, "_ _ _"]],
    forms_t: list[Float[AnyArray, "_ _ _"]],
    counts: list[Float[AnyArray, " _"]],
    sigma: Float[AnyArray, ""],
    known: Float[AnyArray, "h h"] | None,
) -> Moments:
    """The variances that explain both sums of quadratic forms of the residuals, of which ``known`` is the part of the
    unknowns' covariance that follows from a prior."""
    xp = namespace(influence.inverse, sigma)

    def seen(forms: list[Any]) -> Any:
        each = zip(white, forms, counts, strict=True)
        return sum(xp.einsum("am,abm,bm,m->", values, form, values, count) for values, form, count in each)

    table = [_expected(influence, forms, columns, known) for forms in (forms_d, forms_t)]
    (dd, dt, ds), (td, tt, ts) = table
    right_d, right_t = seen(forms_d) - ds, seen(forms_t) - ts
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


class _Column(NamedTuple):
    """What the expectations of all forms need of one list of covariances, a form for each pose."""

    covariances: list[Any]
    by_rows: list[Any]  # of each group, its weighted rows times them; by those of the components besides
    own_by_rows: list[Any]
    of_head: Any  # sums over the rows
    of_own: list[Any]  # of each class, None without rows of poses
    of_both: list[Any]

    @classmethod
    def of(cls, influence: Influence, covariances: list[Any]) -> "_Column":
        """Of covariances of the rows of every group."""
        classes = len(influence.own)
        by_rows, own_by_rows, of_head = [], [], 0.0
        of_own: list[Any] = [0.0] * classes
        of_both: list[Any] = [0.0] * classes
        for number, covariance in enumerate(covariances):
            block, weighted, b = influence.blocks[number], influence.weighted_rows(number), influence.own_rows(number)
            by = products(weighted, covariance)
            by_rows.append(by)
            of_head = of_head + _outer(by, weighted)
            own_by_rows.append(None)
            if b is not None:
                own = influence.weighted(number, b)
                own_by_rows[-1] = own_by = products(own, covariance)
                of_own[block.of] = of_own[block.of] + sums_by_component(own_by, own, block.sizes)
                of_both[block.of] = of_both[block.of] + sums_by_component(own_by, weighted, block.sizes)
        return cls(covariances, by_rows, own_by_rows, of_head, of_own, of_both)


def _expected(
    influence: Influence, forms: list[Any], columns: list[_Column], known: Float[AnyArray, "h h"] | None
) -> list[Any]:
    """tr(Q M C M^T), the expectation of w.Qw, for each list of covariances C; that of the last with ``known``.

    With U = I - M and its two parts, of the head and of the components, this is
    tr(QC) - 2 tr(QUC) + tr(QUCU^T), each a sum over small matrices.
    """
    xp, inverse, classes = namespace(influence.inverse), influence.inverse, len(influence.own)
    of_form: Any = 0.0
    own_form: list[Any] = [None] * classes
    form_by_head: list[Any] = [None] * classes
    found: list[Any] = [0.0] * len(columns)
    for number, form in enumerate(forms):
        block, a, b = influence.blocks[number], influence.rows[number], influence.own_rows(number)
        by_form = products(a, form)
        of_form = of_form + _outer(by_form, a)
        for i, column in enumerate(columns):
            both = xp.sum(form * column.covariances[number])
            found[i] = found[i] + both - 2 * xp.sum(inverse * _outer(by_form, column.by_rows[number]))
        if b is not None:
            of, own_by_form = block.of, products(b, form)
            sums = sums_by_component(own_by_form, b, block.sizes), sums_by_component(own_by_form, a, block.sizes)
            own_form[of], form_by_head[of] = (
                one if before is None else before + one
                for before, one in zip((own_form[of], form_by_head[of]), sums, strict=True)
            )
            for i, column in enumerate(columns):
                crossed = sums_by_component(own_by_form, column.own_by_rows[number], block.sizes)
                found[i] = found[i] - 2 * xp.sum(influence.own[of] * crossed)
    for i, column in enumerate(columns):
        found[i] = found[i] + xp.sum((inverse @ of_form) * (inverse @ column.of_head).T)
        for d, own, by_head, of_own, of_both in zip(
            influence.own, own_form, form_by_head, column.of_own, column.of_both, strict=True
        ):
            if own is None:
                continue  # a class of relations alone
            found[i] = found[i] + xp.sum((d @ own) * xp.swapaxes(d @ of_own, -1, -2))
            found[i] = found[i] + 2 * xp.sum((d @ of_both @ inverse) * by_head)
    if known is not None:
        found[-1] = found[-1] + xp.sum(known * of_form)
    return found


def _outer(one: Float[AnyArray, "h r m"], other: Float[AnyArray, "h r m"]) -> Float[AnyArray, "h h"]:
    return one.reshape(one.shape[0], -1) @ other.reshape(other.shape[0], -1).T


def noise_from(found: Moments) -> Noise:
    """The noise of both variances, one encoder for all."""
    return noise_of(ARCSEC * _root(found.encoder), _root(found.seat))


def _root(value: Float[AnyArray, ""]) -> Float[AnyArray, ""]:
    # The square root has no derivative at 0, the value of a variance whose estimate is negative.
    xp = namespace(value)
    return xp.where(value > 0, xp.sqrt(xp.where(value > 0, value, 1.0)), 0.0)
