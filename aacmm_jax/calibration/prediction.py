"""How a calibrated arm agrees with a capture that it was not identified from: errors found, and errors that its
uncertainty and the noise predict.

The errors of what was measured are normal with some covariance V, so their sum of squares has the mean tr V and the
variance 2 tr V^2: about that of tr V / f times a chi-square variable with f = (tr V)^2 / tr V^2 degrees of freedom
(Satterthwaite). f is small where errors of the parameters move many poses alike. Where the noise behind V was estimated
with n degrees of freedom, the ratio of found to predicted has the F distribution with f and n.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.distributions import chance
from ..core.linear_algebra import inverse_cholesky
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..data.noise import tip_covariances
from ..data.visits import visits_of
from ..kinematics.chain import joint_motion
from ..model.observed import Observed, certified_and_lengths, linear_rows
from ..model.socket_sums import means_over_sockets, sums_over_sockets
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.degrees_of_freedom import LEVEL, Law, coverage_factor, degrees_of_freedom
from ..uncertainty.observed_identifiability import dense_rows
from ..uncertainty.shared_errors import SharedErrors
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS
from .observed_evaluation import fit_geometry

_NULL = 1e-10  # singular values of the geometry below this, of the largest, are zero
_POSITION_ROWS = 3  # of a kind that also has orientations; these rows come after the position
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
        known = [i for i in (range(len(u)) if which is None else which) if np.isfinite(u[i])]
        if not known:
            return NOTHING
        u = np.maximum(u[known], _LEAST_LENGTH_U)
        correlation = self.length_covariance[np.ix_(known, known)] / np.outer(u, u)
        predicted = math.sqrt(np.mean(u**2))
        parts = np.mean(self.length_parts[known] / u[:, None] ** 2, axis=0)
        return Agreement(
            count=len(known),
            rms=predicted * math.sqrt(np.mean((self.length_error[known] / u) ** 2)),
            predicted=predicted,
            degrees_of_freedom=len(known) ** 2 / float(np.sum(correlation**2)),
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
    uncertainty, capture = to_numpy((uncertainty.complete, capture))
    return _of_observations(uncertainty, capture) if capture.observations else _of_sockets(uncertainty, capture)


def _of_sockets(uncertainty: Uncertainty, capture: Capture) -> UnseenErrors:
    """Of sockets and reference lengths: every position is a mean, so nothing is as large as all poses together."""
    arm, owner, sizes = uncertainty.arm, capture.owner, np.asarray(capture.sizes, dtype=float)
    tips, slopes = np.asarray(arm.position(capture.q)), np.asarray(uncertainty.derivatives(capture.q))
    motion = joint_motion(arm.geometry, capture.q)
    noise = np.moveaxis(np.asarray(tip_covariances(arm.geometry, motion, uncertainty.noise)), -1, 0)
    of_one, of_mean = _variances_in_places(uncertainty.shared, capture)
    noise = noise + of_one * np.eye(3)

    def over(sums: Any, values: np.ndarray) -> np.ndarray:
        return np.moveaxis(np.asarray(sums(np.moveaxis(values, 0, -1), capture.sizes)), -1, 0)

    centroids, means = over(means_over_sockets, tips), over(means_over_sockets, slopes)
    residuals, slopes = tips - centroids[owner], slopes - means[owner]
    by_parameters = uncertainty.covariance_of_functions(slopes)
    # tr V and tr V^2 of the errors R of single tips, from which their mean is taken (P), and of the parameters C:
    # V = P R P + S C S^T with S = P S, so tr V^2 = tr (P R)^2 + 2 tr (R S C S^T) + tr (S^T S C)^2.
    own, kept = np.einsum("mcd,mcd->m", noise, noise), 1 - 1 / sizes
    trace = np.trace(by_parameters, axis1=1, axis2=2) + np.trace(noise, axis1=1, axis2=2) * kept[owner]
    square = own * (1 - 2 / sizes[owner]) + 2 * np.einsum("mcd,mcd->m", noise, by_parameters)
    total = over(sums_over_sockets, noise)
    squares = over(sums_over_sockets, square) + np.einsum("scd,scd->s", total, total) / sizes**2
    white = np.einsum("mcd,md->mc", inverse_cholesky(noise), residuals)
    sums = [over(sums_over_sockets, each) for each in (np.sum(residuals**2, axis=1), np.sum(white**2, axis=1), trace)]
    ends_of_sockets = np.cumsum(capture.sizes)
    parts = {}
    for i, (name, size) in enumerate(zip(capture.names, capture.sizes, strict=True)):
        rows = slopes[ends_of_sockets[i] - size : ends_of_sockets[i]].reshape(3 * size, -1)
        found, normalised, expected = (float(values[i]) for values in sums)
        parts[name] = _Part(
            size if size > 1 else 0, found, math.nan, normalised, 3 * size, expected, float(squares[i]), rows.T @ rows
        )
    ends = capture.ends()
    between = centroids[ends[:, 1]] - centroids[ends[:, 0]]
    measured = np.linalg.norm(between, axis=1)
    direction = between / measured[:, None]
    along = np.einsum("lc,lcp->lp", direction, means[ends[:, 1]] - means[ends[:, 0]])
    lengths = capture.lengths
    covariance = uncertainty.covariance_of_functions(along) + np.diag([float(length.u) ** 2 for length in lengths])
    of_means = total / sizes[:, None, None] ** 2 + of_mean[:, None, None] * np.eye(3)
    for one in (0, 1):
        pulled = np.einsum("lcd,ld->lc", of_means[ends[:, one]], direction)
        for other in (0, 1):
            same = ends[:, one][:, None] == ends[:, other][None, :]
            covariance = covariance + np.where(same, 1.0 if one == other else -1.0, 0.0) * (pulled @ direction.T)
    error = measured - np.array([float(length.value) for length in lengths])
    shared, covariance = np.asarray(uncertainty.covariance), np.asarray(covariance)
    stated = np.array([float(length.u) ** 2 for length in lengths])
    by_part = _parts_of_lengths(uncertainty, along, covariance, stated, of_mean[ends].sum(axis=1))
    return UnseenErrors(parts, shared, error, covariance, *by_part, uncertainty.scatter_degrees_of_freedom)


def _parts_of_lengths(
    uncertainty: Uncertainty,
    slopes: Float[np.ndarray, "l p"],
    covariance: Float[np.ndarray, "l l"],
    stated: Float[np.ndarray, " l"],
    in_places: Float[np.ndarray, " l"],
) -> tuple[Float[np.ndarray, "l c"], Law]:
    """Variances of errors of lengths by what they rest on, mm^2: the parts of the calibration's uncertainty, of which
    the first contains the scatter of the poses at the ends, errors of places there, and what is stated of lengths."""
    law = uncertainty.law.joined(Law.of(np.array([np.inf])))
    others = np.column_stack([uncertainty.parts(slopes)[:, 1:], stated])
    if PLACES in (names := () if uncertainty.components is None else uncertainty.components.names):
        others[:, names.index(PLACES)] += in_places
    whole = np.diagonal(covariance)
    return np.column_stack([whole - others.sum(axis=1), others]), law


def _variances_in_places(shared: SharedErrors | None, capture: Capture) -> tuple[float, Float[np.ndarray, " s"]]:
    """What errors that poses share add to the variance of a tip coordinate within each socket, and to that of each
    socket's mean beside the mean of so many independent errors, mm^2."""
    sizes = np.asarray(capture.sizes, dtype=float)
    if shared is None:
        return 0.0, np.zeros(len(sizes))
    within, between = float(shared.sd_of(VISITS, SUCCESSIVE)) ** 2, float(shared.sd_of(PLACES)) ** 2
    visits, length = visits_of(capture), float(shared.correlation_length)

    def part_of_mean(name: str, size: int) -> float:
        if name in visits:
            return float(np.sum((np.unique(visits[name], return_counts=True)[1] / size) ** 2))
        order = np.arange(size)
        return float(np.mean(np.exp(-np.abs(order[:, None] - order) / length))) if np.isfinite(length) else 1.0

    parts = np.array([part_of_mean(name, size) for name, size in zip(capture.names, capture.sizes, strict=True)])
    return within, between + within * (parts - 1 / sizes)


def _of_observations(uncertainty: Uncertainty, capture: Capture) -> UnseenErrors:
    """Of observations whose geometry is fitted to the arm.

    With whitened derivatives A by the parameters and G by the geometry, and U an orthonormal basis of G, errors dp of
    the parameters and w of the rows leave K (A dp + w) with K = I - U U^T. In mm, with D the inverse of the whitening,
    V = D (K + K A C A^T K) D^T = D (I + W S W^T) D^T, where W = [U, K A] and S = diag(-I, C).
    """
    observed, noise, shared = Observed.of(capture, uncertainty.arm), uncertainty.noise, uncertainty.shared
    if shared is not None:
        noise = eqx.tree_at(lambda n: n.seating, noise, np.hypot(noise.seating, shared.sd_of(VISITS, SUCCESSIVE)))
    fitted = fit_geometry(uncertainty.arm, observed, {}, noise)
    space = uncertainty.space
    p = len(space.names)
    z = np.concatenate([np.asarray(space.vector()), fitted.geometry])
    linear = linear_rows(space, observed, z)
    rows, white = dense_rows(linear, fitted.whitening.roots, len(z))
    relations, u = certified_and_lengths(observed, z, p)
    count = len(observed.ends)
    rows = np.concatenate([rows, relations[count:] / np.maximum(u[count:], 1e-9)[:, None]])
    basis, singular, vectors = np.linalg.svd(rows[:, p:] * observed.steps, full_matrices=False)
    known = singular > _NULL * singular[0]
    basis, follow = basis[:, known], vectors[known].T / singular[known]
    along = basis.T @ rows[:, :p]
    joined = np.concatenate([basis, rows[:, :p] - basis @ along], axis=1)
    g = basis.shape[1]
    common = np.zeros((g + p, g + p))
    common[:g, :g], common[g:, g:] = -np.eye(g), uncertainty.covariance
    parts, first = {}, 0
    for observation, part, root in zip(observed.observations, linear, fitted.whitening.roots, strict=True):
        values = np.asarray(part.rows.values)
        r, m = values.shape
        mine, whitened = joined[first : first + r * m], white[first : first + r * m]
        first += r * m
        by_pose = mine.reshape(r, m, -1).transpose(1, 0, 2)
        to_mm = np.linalg.inv(np.asarray(root))[:, :_POSITION_ROWS]
        weights = np.einsum("mca,mcb->mab", to_mm, to_mm)
        errors = np.einsum("mav,mbv->mab", by_pose @ common, by_pose)  # W S W^T within a pose
        is_open = not np.all(np.isfinite(uncertainty.covariance_of_functions(to_mm @ by_pose[:, :, g:])))
        weighted = np.einsum("mab,mbw->maw", weights, by_pose)
        parts[observation.name] = _Part(
            poses=0 if observation.kind == "socket" and m == 1 else m,
            found=float(np.sum(values[:_POSITION_ROWS] ** 2)),
            angles=float(np.sum(values[_POSITION_ROWS:] ** 2)) if r > _POSITION_ROWS else math.nan,
            normalised=float(np.sum(whitened**2)),
            rows=r * m,
            trace=math.inf if is_open else float(np.einsum("maa->", weights) + np.sum(weights * errors)),
            square=float(np.sum(weights**2) + 2 * np.einsum("mab,mbc,mca->", weights, weights, errors)),
            shared=np.einsum("maw,mav->wv", by_pose, weighted),
        )
    pull = (relations[:count, p:] * observed.steps) @ follow
    covariance = uncertainty.covariance_of_functions(pull @ along) + pull @ pull.T + np.diag(u[:count] ** 2)
    ends = 0.0 if shared is None else float(shared.sd_of(PLACES))
    covariance = covariance + ends**2 * relations[:count, p:] @ relations[:count, p:].T
    geometry = observed.split(fitted.geometry)
    measured = np.array([float(np.linalg.norm(geometry[end] - geometry[start])) for start, end in observed.ends])
    error = measured - np.asarray(observed.nominal)
    covariance, in_places = np.asarray(covariance), ends**2 * np.sum(relations[:count, p:] ** 2, axis=1)
    by_part = _parts_of_lengths(uncertainty, pull @ along, covariance, u[:count] ** 2, in_places)
    return UnseenErrors(parts, common, error, covariance, *by_part, uncertainty.scatter_degrees_of_freedom)
