"""How a calibrated arm agrees with a capture that it was not identified from: errors found, and errors that its
uncertainty and the noise predict.

The errors of what was measured are normal with some covariance V, so their sum of squares has the mean tr V and the
variance 2 tr V^2: about that of tr V / f times a chi-square variable with f = (tr V)^2 / tr V^2 degrees of freedom
(Satterthwaite). f is small where errors of the parameters move many poses alike. Where the noise behind V was estimated
with n degrees of freedom, the ratio of found to predicted has the F distribution with f and n.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.distributions import chance
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..data.capture import Capture, visits_of
from ..data.observations.held import position_of
from ..model.elimination import flat, followed
from ..model.observed import Observed, ends_of
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.degrees_of_freedom import LEVEL, Law, coverage_factor, degrees_of_freedom
from ..uncertainty.linear_propagation import Influence
from ..uncertainty.linearisation import Linearisation, ObservationRows
from ..uncertainty.shared_errors import SharedErrors
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS
from .evaluation import fit_geometry
from .task import without_lengths

_NULL = 1e-10  # singular values of the geometry below this, of the largest, are zero
_POSITION_ROWS = 3  # of a kind that also has orientations; these rows come after the position
_LEAST = 1e-4  # smallest standard uncertainty of what is certified, of a tip coordinate's standard deviation
_LEAST_LENGTH_U = 1e-6  # mm: an error of a millionth of a millimetre is rounding


class Agreement(NamedTuple):
    """Distances of poses from their geometry, or errors of reference lengths: found, and predicted; mm."""

    count: int  # of poses or lengths
    rms: float  # root mean square, found
    predicted: float  # infinite where the calibration leaves a direction open that matters
    degrees_of_freedom: float  # effective, of the predicted sum of squares
    noise_degrees_of_freedom: float  # of what the prediction rests on; infinite where the noise was given
    reduced_chi: float = math.nan  # root mean square of a residual in standard deviations of the noise alone
    rms_angle: float = math.nan  # rad, where orientations were measured

    @property
    def probability(self) -> float:
        """Of at least such a sum of squares by chance where the prediction is right; NaN where nothing is predicted."""
        return chance(self.rms, self.predicted, self.degrees_of_freedom, self.noise_degrees_of_freedom)


NOTHING = Agreement(0, math.nan, math.nan, math.nan, math.inf)  # where there is nothing to compare


class _Part(NamedTuple):
    """Sums of squares of one observation: found, and of what the trace of V, and that of its square, consist."""

    poses: int  # 0 for the only pose of a socket, which shows no scatter
    found: float  # mm^2
    angles: float  # rad^2; NaN where no orientation was measured
    normalised: float  # of the residuals in standard deviations
    rows: int  # of them
    trace: float
    square: float  # tr V^2 but for the errors that it shares with other observations
    shared: Float[np.ndarray, "w w"]


class UnseenErrors(NamedTuple):
    """Errors of a calibrated arm on a capture that it was not identified from, found and predicted."""

    parts: dict[str, _Part]  # of sockets first, then of other observations
    common: Float[np.ndarray, "w w"]  # covariance of what they share
    length_error: Float[np.ndarray, " l"]  # of the reference lengths, mm
    length_covariance: Float[np.ndarray, "l l"]  # predicted, mm^2
    length_parts: Float[np.ndarray, "l c"]  # variances of them by what they rest on, mm^2
    law: Law  # how well each part is known
    noise_degrees_of_freedom: float

    @property
    def length_u(self) -> Float[np.ndarray, " l"]:
        """Standard uncertainty of the error of every reference length, mm."""
        return np.sqrt(np.diagonal(self.length_covariance))

    def expanded(self, level: float = LEVEL) -> Float[np.ndarray, " l"]:
        """Expanded uncertainty of the error of every reference length, mm."""
        return coverage_factor(level, self.length_parts, self.law) * self.length_u

    def of(self, names: Iterable[str]) -> Agreement:
        """Some sockets and observations together."""
        parts = [self.parts[name] for name in names if self.parts[name].poses]
        poses = sum(part.poses for part in parts)
        if not poses:
            return NOTHING
        trace, effective = sum(part.trace for part in parts), math.nan
        if 0 < trace < math.inf:
            both = np.sum([part.shared for part in parts], axis=0) @ self.common
            effective = trace**2 / (sum(part.square for part in parts) + float(np.sum(both * both.T)))
        turned = [part for part in parts if math.isfinite(part.angles)]
        return Agreement(
            count=poses,
            rms=math.sqrt(sum(part.found for part in parts) / poses),
            predicted=math.sqrt(trace / poses),
            degrees_of_freedom=effective,
            noise_degrees_of_freedom=self.noise_degrees_of_freedom,
            reduced_chi=math.sqrt(sum(part.normalised for part in parts) / sum(part.rows for part in parts)),
            rms_angle=math.sqrt(sum(part.angles for part in turned) / sum(part.poses for part in turned))
            if turned
            else math.nan,
        )

    def of_lengths(self, which: Iterable[int] | None = None) -> Agreement:
        """Some of the reference lengths, or all, as far as their errors can be predicted; both root mean squares weigh
        each error by its own standard uncertainty, so that their ratio is that of the normalised errors."""
        u = self.length_u
        chosen = [i for i in (range(len(u)) if which is None else which) if np.isfinite(u[i])]
        if not chosen:
            return NOTHING
        u = np.maximum(u[chosen], _LEAST_LENGTH_U)
        correlation = self.length_covariance[np.ix_(chosen, chosen)] / np.outer(u, u)
        predicted = math.sqrt(np.mean(u**2))
        parts = np.mean(self.length_parts[chosen] / u[:, None] ** 2, axis=0)
        return Agreement(
            count=len(chosen),
            rms=predicted * math.sqrt(np.mean((self.length_error[chosen] / u) ** 2)),
            predicted=predicted,
            degrees_of_freedom=len(chosen) ** 2 / float(np.sum(correlation**2)),
            noise_degrees_of_freedom=float(degrees_of_freedom(parts, self.law)),
        )


def unseen_errors(uncertainty: Uncertainty, capture: Capture) -> UnseenErrors:
    """Compare the errors of a calibrated arm on a capture with what its uncertainty predicts; all is NumPy's.

    The geometry (positions of sockets, frames, centres) is fitted to the arm. The poses must be others than those that
    the arm was identified from, whose residuals are smaller.

    Args:
        uncertainty: the calibrated arm and its uncertainty, from `uncertainty_of`.
        capture: sockets, reference lengths and other observations, mm and rad.

    Returns:
        Errors of every socket, observation and reference length, found and predicted.

    Example:
        >>> unseen = aj.calibration.unseen_errors(aj.uncertainty_of(result), two_bars)
        >>> print(unseen.length_error.round(3), unseen.length_u.round(3))
        [-0.003 -0.001] [0.005 0.008]
    """
    uncertainty, capture = to_numpy((to_numpy(uncertainty).complete, capture))
    problem = _Unseen.of(uncertainty, capture)
    parts = {part.observation.name: _part_of(problem, number, part) for number, part in enumerate(problem.parts)}
    lengths = _of_lengths(problem, capture)
    return UnseenErrors(parts, problem.common, *lengths, uncertainty.scatter_degrees_of_freedom)


class _Unseen(NamedTuple):
    """A capture by a calibrated arm, with the geometry that fits it.

    With whitened derivatives A by the parameters and G by the geometry, and U an orthonormal basis of G, errors dp of
    the parameters and w of the rows leave K (A dp + w) with K = I - U U^T. In mm, with D the inverse of the whitening,
    V = D (K + K A C A^T K) D^T = D (I + W S W^T) D^T, where W = [U, K A] and S = diag(-I, C). The part of U for one
    observation's own geometry concerns that observation alone.
    """

    uncertainty: Uncertainty
    linear: Linearisation
    influence: Influence
    parts: list[ObservationRows]
    white: Sequence[Float[AnyArray, "_ _"]]
    own: Sequence[Float[AnyArray, "_ _ _"]]  # U of each observation's own geometry
    joined: Sequence[Float[AnyArray, "w _ _"]]  # W but for these: of the shared geometry, and K A
    common: Float[np.ndarray, "w w"]  # S for these
    basis: Float[np.ndarray, "s b"]  # of the shared geometry's numbers, with which its columns are orthonormal
    along: Float[np.ndarray, "b p"]  # components of A along them

    @classmethod
    def of(cls, uncertainty: Uncertainty, capture: Capture) -> "_Unseen":
        """Reference lengths take no part: they are to be measured."""
        noise, shared = uncertainty.noise, uncertainty.shared
        if shared is not None:
            seating = np.hypot(noise.seating, shared.sd_of(VISITS, SUCCESSIVE))
            noise = eqx.tree_at(lambda n: n.seating, noise, seating)
        observed = to_numpy(Observed.of(without_lengths(capture), uncertainty.arm))
        fitted = fit_geometry(uncertainty.arm, observed, {}, noise)
        space, p = uncertainty.space, len(uncertainty.space.names)
        z = np.concatenate([np.asarray(space.vector()), np.asarray(fitted.geometry)])
        least = max(_LEAST * float(fitted.sigma), 1e-12)
        linear = Linearisation.at(observed, space, z, noise=noise, least=least)
        influence, groups = linear.influence(), len(observed.layout.groups)
        scale = np.asarray(space.scale)[:, None, None]
        of_shared, of_parameters = (
            [np.asarray(r)[part] for r in influence.rows] for part in (slice(p, None), slice(p))
        )
        values, vectors = np.linalg.eigh(sum(flat(rows) @ flat(rows).T for rows in of_shared))
        large = values > _NULL * values.max(initial=0.0)
        basis = vectors[:, large] / np.sqrt(values[large])
        of_shared = [np.einsum("sb,srm->brm", basis, rows) for rows in of_shared]
        of_parameters = [rows / scale for rows in of_parameters]
        along = np.sum([flat(b) @ flat(a).T for b, a in zip(of_shared, of_parameters, strict=True)], axis=0)
        joined = [
            np.concatenate([b, a - np.einsum("bp,brm->prm", along, b)])
            for b, a in zip(of_shared[:groups], of_parameters[:groups], strict=True)
        ]
        common = np.zeros((len(basis.T) + p,) * 2)
        common[: len(basis.T), : len(basis.T)] = -np.eye(len(basis.T))
        common[len(basis.T) :, len(basis.T) :] = uncertainty.covariance
        own = [_own_basis(influence, number) for number in range(groups)]
        by_observation = observed.by_observation
        return cls(
            uncertainty, linear, influence, linear.parts(), linear.white(), by_observation(own), by_observation(joined),
            common, basis, along,
        )  # fmt: skip


def _own_basis(influence: Influence, number: int) -> Float[np.ndarray, "k r m"]:
    """Orthonormal columns of the private geometry of a group's components."""
    rows, block = influence.own_rows(number), influence.blocks[number]
    if rows is None:
        return np.zeros((0, *block.white.shape))
    values, vectors = np.linalg.eigh(np.asarray(influence.own[block.of]))
    roots = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
    return np.asarray(followed(np.asarray(rows), np.swapaxes(roots, 1, 2), block.sizes))


def _part_of(problem: _Unseen, number: int, part: ObservationRows) -> _Part:
    values, observation = np.asarray(part.values), part.observation
    r, m = values.shape
    own, joined = (np.moveaxis(np.asarray(rows[number]), -1, 0) for rows in (problem.own, problem.joined))  # (m, w, r)
    to_mm = np.linalg.inv(np.asarray(part.root))[:, :_POSITION_ROWS]
    weights = np.einsum("mca,mcb->mab", to_mm, to_mm)
    common, p = problem.common, len(problem.uncertainty.space.names)
    by_common = np.einsum("mwa,wv->mva", joined, common)
    errors = np.einsum("mva,mvb->mab", by_common, joined) - np.einsum("mka,mkb->mab", own, own)
    along = np.swapaxes(joined[:, joined.shape[1] - p :], 1, 2)
    is_open = not np.all(np.isfinite(problem.uncertainty.covariance_of_functions(to_mm @ along)))
    weighted, of_own = joined @ weights, own @ weights
    alone, crossed = np.einsum("mka,mla->kl", of_own, own), np.einsum("mka,mwa->kw", of_own, joined)
    square = np.sum(weights**2) + 2 * np.einsum("mab,mbc,mca->", weights, weights, errors)
    square = square + np.sum(alone * alone.T) - 2 * np.sum((crossed @ common) * crossed)
    return _Part(
        poses=0 if observation.kind == "socket" and m == 1 else m,
        found=float(np.sum(values[:_POSITION_ROWS] ** 2)),
        angles=float(np.sum(values[_POSITION_ROWS:] ** 2)) if r > _POSITION_ROWS else math.nan,
        normalised=float(np.sum(np.asarray(problem.white[number]) ** 2)),
        rows=r * m,
        trace=math.inf if is_open else float(np.einsum("maa->", weights) + np.sum(weights * errors)),
        square=float(square),
        shared=np.einsum("mwa,mva->wv", weighted, joined),
    )


def _of_lengths(
    problem: _Unseen, capture: Capture
) -> tuple[Float[np.ndarray, " l"], Float[np.ndarray, "l l"], Float[np.ndarray, "l c"], Law]:
    """Errors of the reference lengths, their covariance, and its parts, mm and mm^2."""
    linear, influence, uncertainty = problem.linear, problem.influence, problem.uncertainty
    observed, p, count = linear.observed, len(linear.space.names), len(capture.lengths)
    u = np.array([float(length.u) for length in capture.lengths])
    measured, by_geometry = observed.distances(np.asarray(linear.z)[p:], ends_of(capture))
    places = np.zeros((count, count))
    for name, variance in zip(capture.names, _variances_in_places(uncertainty.shared, capture), strict=True):
        if variance:
            by_place = by_geometry[:, observed.positions[position_of(name)]]
            places += variance * by_place @ by_place.T
    head, components = observed.by_unknowns(by_geometry, p)
    by_head = np.asarray(influence.eliminated(head, components))
    pull = by_head[:, p:] @ problem.basis
    along = by_head[:, :p] / np.asarray(linear.space.scale) - pull @ problem.along
    pairs = zip(components, influence.own, strict=True)
    scatter = np.sum([np.einsum("lKk,Kkj,gKj->lg", part, own, part) for part, own in pairs], axis=0)
    covariance = uncertainty.covariance_of_functions(along) + scatter + pull @ pull.T + places + np.diag(u**2)
    error = np.asarray(measured) - np.array([float(length.value) for length in capture.lengths])
    # What they rest on: the parts of the calibration's uncertainty, of which the first contains the scatter of the
    # poses at the ends, errors of places there, and what is stated of lengths.
    law = uncertainty.law.joined(Law.of(np.array([np.inf])))
    others = np.column_stack([uncertainty.parts(along)[:, 1:], u**2])
    if PLACES in (names := () if uncertainty.components is None else uncertainty.components.names):
        others[:, names.index(PLACES)] += np.diagonal(places)
    return error, covariance, np.column_stack([np.diagonal(covariance) - others.sum(axis=1), others]), law


def _variances_in_places(shared: SharedErrors | None, capture: Capture) -> Float[np.ndarray, " s"]:
    """What errors that poses share add to the variance of a coordinate of each socket's mean, beside the mean of so
    many independent errors, mm^2."""
    if shared is None:
        return np.zeros(len(capture.sizes))
    within, between = float(shared.sd_of(VISITS, SUCCESSIVE)) ** 2, float(shared.sd_of(PLACES)) ** 2
    visits, length = visits_of(capture), float(shared.correlation_length)

    def part_of_mean(name: str, size: int) -> float:
        if name in visits:
            return float(np.sum((np.unique(visits[name], return_counts=True)[1] / size) ** 2))
        order = np.arange(size)
        return float(np.mean(np.exp(-np.abs(order[:, None] - order) / length))) if np.isfinite(length) else 1.0

    parts = np.array([part_of_mean(name, size) for name, size in zip(capture.names, capture.sizes, strict=True)])
    return between + within * (parts - 1 / np.asarray(capture.sizes, dtype=float))
