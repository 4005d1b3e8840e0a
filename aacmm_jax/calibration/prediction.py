"""How a calibrated arm agrees with poses that it was not identified from: errors found, and errors that its uncertainty
and the noise predict.

The errors of what was measured are normal with some covariance V, so their sum of squares has the mean tr V and the
variance 2 tr V^2: about that of tr V / f times a chi-square variable with f = (tr V)^2 / tr V^2 degrees of freedom
(Satterthwaite). f is small where errors of the parameters move many poses alike. Where the noise behind V was estimated
with n degrees of freedom, the ratio of found to predicted has the F distribution with f and n.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, to_numpy
from ..data.capture import Capture
from ..data.observations.held import position_of
from ..data.observations.observation import OTHER_UNITS
from ..model.elimination import flat, followed
from ..model.observed import Observed, ends_of
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.between_groups import BetweenGroups
from ..uncertainty.coverage import LEVEL
from ..uncertainty.degrees_of_freedom import Law, coverage_factor, degrees_of_freedom
from ..uncertainty.kept_geometry import KeptGeometry, head_of
from ..uncertainty.linear_propagation import Influence
from ..uncertainty.linearisation import Linearisation, ObservationRows
from ..uncertainty.shared_kinds import PLACES
from .agreement import NOTHING, Agreement
from .evaluation import fit_geometry
from .pose_table import noise_of_poses
from .redrawn import variances_in_places
from .task import without_lengths

_NULL = 1e-10  # singular values of the geometry below this, of the largest, are zero
_LEAST = 1e-4  # smallest standard uncertainty of what is certified, of a tip coordinate's standard deviation
_LEAST_LENGTH_U = 1e-6  # mm: an error of a millionth of a millimetre is rounding


class _Part(NamedTuple):
    """Sums of squares of one observation: found, and of what the trace of V, and that of its square, consist."""

    poses: int  # 0 for the only pose of a socket, which shows no scatter
    squares: float  # mm^2
    others: Float[np.ndarray, " 2"]  # numbers of poses with residuals in each of `OTHER_UNITS`
    other_squares: Float[np.ndarray, " 2"]  # of these residuals, in these units
    normalised: float  # of the residuals in standard deviations
    rows: int  # of them
    trace: float
    square: float  # tr V^2 but for the errors that it shares with other observations
    shared: Float[np.ndarray, "w w"]


class UnseenErrors(NamedTuple):
    """Errors of a calibrated arm on a capture that it was not identified from, found and predicted."""

    parts: dict[str, _Part]  # of sockets first, then of other observations
    distances: dict[str, Float[np.ndarray, " _"]]  # of their poses, mm; NaN for the only pose of a socket
    common: Float[np.ndarray, "w w"]  # covariance of what they share
    length_error: Float[np.ndarray, " l"]  # of the reference lengths, mm
    length_covariance: Float[np.ndarray, "l l"]  # predicted, mm^2
    length_parts: Float[np.ndarray, "l c"]  # variances of them by what they rest on, mm^2
    law: Law  # how well each part is known
    noise_degrees_of_freedom: float
    between: BetweenGroups | None = None  # what groups that were held out have shown of such predictions

    @property
    def length_u(self) -> Float[np.ndarray, " l"]:
        """Standard uncertainty of the error of every reference length, mm."""
        return np.sqrt(np.diagonal(self.length_covariance))

    def expanded(self, level: float = LEVEL) -> Float[np.ndarray, " l"]:
        """Its expanded uncertainty, mm."""
        return coverage_factor(level, self.length_parts, self.law) * self.length_u

    def of(self, names: Iterable[str]) -> Agreement:
        """Some sockets and observations together."""
        parts = [self.parts[name] for name in names if self.parts[name].poses]
        if not parts:
            return NOTHING
        sums: list[Any] = [sum(column) for column in zip(*parts, strict=True)]
        whole, effective = _Part(*sums), math.nan
        if 0 < whole.trace < math.inf:
            both = whole.shared @ self.common
            effective = whole.trace**2 / (whole.square + float(np.sum(both * both.T)))
        others = zip(whole.other_squares, whole.others, strict=True)
        rms_angle, rms_px = (math.sqrt(square / count) if count else math.nan for square, count in others)
        agreement = Agreement(
            count=whole.poses,
            rms=math.sqrt(whole.squares / whole.poses),
            predicted=math.sqrt(whole.trace / whole.poses),
            degrees_of_freedom=effective,
            noise_degrees_of_freedom=self.noise_degrees_of_freedom,
            reduced_chi=math.sqrt(whole.normalised / whole.rows),
            rms_angle=rms_angle,
            rms_px=rms_px,
        )
        return agreement.by_groups(self.between)

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
    problem, freedom = _Unseen.of(uncertainty, capture), uncertainty.scatter_degrees_of_freedom
    parts = {part.observation.name: _part_of(problem, number, part) for number, part in enumerate(problem.parts)}
    distances = {part.observation.name: _distances_of(part) for part in problem.parts}
    return UnseenErrors(parts, distances, problem.common, *_of_lengths(problem, capture), freedom, uncertainty.between)


class _Unseen(NamedTuple):
    """A capture by a calibrated arm, with the geometry that fits it.

    With whitened derivatives A by the parameters and G by the geometry, and U an orthonormal basis of G, errors dp of
    the parameters and w of the rows leave K (A dp + w) with K = I - U U^T. In mm, with D the inverse of the whitening,
    V = D (K + K A C A^T K) D^T = D (I + W S W^T) D^T, where W = [U, K A] and S = diag(-I, C). The part of U for one
    observation's own geometry concerns that observation alone. Geometry that is kept is not in G: with the derivatives
    O by its numbers, which follow the parameters and have the covariance F for given parameters (`kept_geometry`),
    W = [U, K O, K (A + O dk/dx)] and S = diag(-I, F, C).
    """

    uncertainty: Uncertainty
    linear: Linearisation
    influence: Influence
    parts: list[ObservationRows]
    private: Sequence[Float[AnyArray, "_ _ _"]]  # U of each observation's own geometry
    joined: Sequence[Float[AnyArray, "w _ _"]]  # W but for these: of the shared geometry, and K A
    common: Float[np.ndarray, "w w"]  # S for these
    basis: Float[np.ndarray, "s b"]  # of the shared geometry's numbers, with which its columns are orthonormal
    along: Float[np.ndarray, "b q"]  # components of O and A along them
    kept: KeptGeometry | None

    @classmethod
    def of(cls, uncertainty: Uncertainty, capture: Capture) -> "_Unseen":
        """Reference lengths take no part: they are to be measured."""
        noise, given = noise_of_poses(uncertainty), () if uncertainty.kept is None else uncertainty.kept.names
        observed = to_numpy(Observed.of(without_lengths(capture), uncertainty.arm, shared=given))
        kept = None if uncertainty.kept is None else uncertainty.kept.select(observed.blocks)
        fitted = fit_geometry(uncertainty.arm, observed, {} if kept is None else kept.parts, noise)
        space = uncertainty.space
        z = np.concatenate([np.asarray(space.vector()), np.asarray(fitted.geometry)])
        linear = Linearisation.at(observed, space, z, noise=noise, least=max(_LEAST * float(fitted.sigma), 1e-12))
        influence, groups = linear.influence(), len(observed.layout.groups)
        head = head_of(linear, kept)
        of_shared, of_given = zip(*(head.split(np.asarray(rows)) for rows in influence.rows), strict=True)
        values, vectors = np.linalg.eigh(sum(flat(rows) @ flat(rows).T for rows in of_shared))
        large = values > _NULL * values.max(initial=0.0)
        basis = vectors[:, large] / np.sqrt(values[large])
        of_shared = [np.einsum("sb,srm->brm", basis, rows) for rows in of_shared]
        pairs = list(zip(of_shared, of_given, strict=True))
        along = np.sum([flat(b) @ flat(a).T for b, a in pairs], axis=0)
        joined = [np.concatenate([b, a - np.einsum("bp,brm->prm", along, b)]) for b, a in pairs[:groups]]
        own = np.zeros((0, 0)) if kept is None else np.asarray(kept.covariance)
        common, private = _diagonal(-np.eye(len(basis.T)), own, np.asarray(uncertainty.covariance)), []
        for number, block in enumerate(influence.blocks[:groups]):
            rows = influence.own_rows(number)
            if rows is None:
                private.append(np.zeros((0, *block.white.shape)))
                continue
            values, vectors = np.linalg.eigh(np.asarray(influence.d_inverses[block.class_index]))
            roots = np.sqrt(np.maximum(values, 0.0))[:, None, :] * vectors
            private.append(np.asarray(followed(np.asarray(rows), roots, block.sizes)))
        private, joined = observed.by_observation(private), observed.by_observation(joined)
        return cls(uncertainty, linear, influence, linear.parts(), private, joined, common, basis, along, kept)


def _distances_of(part: ObservationRows) -> Float[np.ndarray, " m"]:
    """Of the poses from their geometry, mm; the only pose of a socket shows no scatter."""
    distances = np.linalg.norm(part.observation.in_mm(np.asarray(part.values), np.asarray(part.by_tip)), axis=0)
    return np.full(1, np.nan) if part.observation.kind == "socket" and len(distances) == 1 else distances


def _part_of(problem: _Unseen, number: int, part: ObservationRows) -> _Part:
    values = np.asarray(part.values)
    m = values.shape[1]
    private, joined = (np.moveaxis(np.asarray(rows[number]), -1, 0) for rows in (problem.private, problem.joined))
    observation, by_tip = part.observation, np.asarray(part.by_tip)
    to_mm = np.moveaxis(np.linalg.inv(np.asarray(part.root)), 0, -1)
    to_mm = np.moveaxis(np.asarray(observation.in_mm(to_mm, by_tip)), -1, 0)
    has_unit = np.array([unit == observation.other_unit for unit in OTHER_UNITS], dtype=float)
    weights = np.einsum("mca,mcb->mab", to_mm, to_mm)
    common, p = problem.common, len(problem.uncertainty.space.names)
    by_common = np.einsum("mwa,wv->mva", joined, common)
    errors = np.einsum("mva,mvb->mab", by_common, joined) - np.einsum("mka,mkb->mab", private, private)
    along = np.swapaxes(joined[:, joined.shape[1] - p :], 1, 2)
    is_open = not np.all(np.isfinite(problem.uncertainty.covariance_of_functions(to_mm @ along)))
    of_private = private @ weights
    alone, crossed = np.einsum("mka,mla->kl", of_private, private), np.einsum("mka,mwa->kw", of_private, joined)
    square = np.sum(weights**2) + 2 * np.einsum("mab,mbc,mca->", weights, weights, errors)
    square = square + np.sum(alone * alone.T) - 2 * np.sum((crossed @ common) * crossed)
    return _Part(
        poses=0 if observation.kind == "socket" and m == 1 else m,
        squares=float(np.sum(observation.in_mm(values, by_tip) ** 2)),
        others=m * has_unit,
        other_squares=np.sum(observation.other_sizes(values) ** 2) * has_unit,
        normalised=float(np.sum(np.asarray(part.white) ** 2)),
        rows=int(observation.pose_equations.sum()),
        trace=math.inf if is_open else float(np.einsum("maa->", weights) + np.sum(weights * errors)),
        square=float(square),
        shared=np.einsum("mwa,mva->wv", joined @ weights, joined),
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
    for name, variance in zip(capture.names, variances_in_places(uncertainty.shared, capture), strict=True):
        if variance:
            by_place = by_geometry[:, observed.positions[position_of(name)]]
            places += variance * by_place @ by_place.T
    head, components = observed.by_unknowns(by_geometry, p)
    by_head = np.asarray(influence.eliminated(head, components))
    of_shared, of_given = head_of(linear, problem.kept).split(by_head.T)
    pull = of_shared.T @ problem.basis
    along = of_given.T - pull @ problem.along
    pairs = zip(components, influence.d_inverses, strict=True)
    scatter = np.sum([np.einsum("lKk,Kkj,gKj->lg", part, inverse, part) for part, inverse in pairs], axis=0)
    along, by_kept = along[:, along.shape[1] - p :], along[:, : along.shape[1] - p]
    of_kept = 0.0 if problem.kept is None else by_kept @ np.asarray(problem.kept.covariance) @ by_kept.T
    of_geometry = scatter + pull @ pull.T + of_kept
    covariance = uncertainty.covariance_of_functions(along) + of_geometry + places + np.diag(u**2)
    error = np.asarray(measured) - np.array([float(length.value) for length in capture.lengths])
    # What they rest on: the parts of the calibration's uncertainty, of which the first contains the scatter of the
    # poses at the ends, errors of places there, and what is stated of lengths.
    law = uncertainty.law.joined(Law.of(np.array([np.inf])))
    others = np.column_stack([uncertainty.parts(along)[:, 1:], u**2])
    if PLACES in (names := () if uncertainty.components is None else uncertainty.components.names):
        others[:, names.index(PLACES)] += np.diagonal(places)
    return error, covariance, np.column_stack([np.diagonal(covariance) - others.sum(axis=1), others]), law


def _diagonal(*blocks: Float[np.ndarray, "_ _"]) -> Float[np.ndarray, "s s"]:
    """Blocks along the diagonal: SciPy, which has this, takes 0.2 s to import."""
    ends = np.cumsum([0, *map(len, blocks)])
    whole = np.zeros((ends[-1], ends[-1]))
    for block, first, end in zip(blocks, ends, ends[1:], strict=False):
        whole[first:end, first:end] = block
    return whole
