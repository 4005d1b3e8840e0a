"""Statistics of the difference between two calibrations: its uncertainty, all parameters tested at once, lengths over the volume."""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..calibration.record import CalibrationRecord, uncertainty_of
from ..data.noise import Noise
from ..kinematics.arm import is_length
from ..uncertainty.arm_uncertainty import Uncertainty

_FOLLOWS = 1e-5  # more than this of a direction that is open, and a combination is not determined: see `uncertainty`
_FEW = 4  # parameters that explain a change in a few words
_SINGULAR = 1e-12  # of the largest eigenvalue of a correlation matrix: below, a combination has no variance of its own


class Joint(NamedTuple):
    """All changes tested at once: delta^T (C_old + C_new)^+ delta on the combinations that both calibrations determine."""

    statistic: float  # about ``rank`` where nothing moved
    rank: int
    degrees_of_freedom: float  # of the variance behind it: infinite for chi-square, else statistic / rank follows Fisher's F
    p: float  # probability of as much without any drift; NaN where there is nothing to test
    names: tuple[str, ...]  # parameters that take part
    # Where chance does not explain the statistic: the fewest parameters whose change alone would, found one by one, and by how much
    # each would have changed (mm, rad); empty where a few do not suffice.
    causes: tuple[tuple[str, float], ...]


class LengthChange(NamedTuple):
    """Lengths all over the volume, from the same readings by the new arm and by the old one, as NumPy arrays; mm."""

    length: float  # how long they are by the old arm
    q: Float[np.ndarray, "v n"]
    q_end: Float[np.ndarray, "v n"]
    change: Float[np.ndarray, " v"]  # new less old
    u: Float[np.ndarray, " v"]  # standard uncertainty of the change; infinite where a calibration leaves the length open
    expanded: Float[np.ndarray, " v"]
    size: float  # the mean change over the length: how much larger the new arm measures everything, relative
    u_size: float
    expanded_size: float

    @property
    def moved(self) -> Bool[np.ndarray, " v"]:
        """Which lengths changed beyond their expanded uncertainty."""
        return np.abs(self.change) > self.expanded

    @property
    def rms(self) -> float:
        """Root mean square change, mm."""
        return float(np.sqrt(np.mean(self.change**2)))

    @property
    def rms_by_chance(self) -> float:
        """Root mean square change that the uncertainties of both calibrations alone lead one to expect, mm."""
        return float(np.sqrt(np.mean(self.u**2)))

    @property
    def largest(self) -> float:
        """The change of largest magnitude, with its sign, mm."""
        return float(self.change[np.argmax(np.abs(self.change))])

    @property
    def percentile_95(self) -> float:
        """95th percentile of the magnitude, mm."""
        return float(np.quantile(np.abs(self.change), 0.95))


def effective_freedom(
    u_old: Float[np.ndarray, " m"], freedom_old: float, u_new: Float[np.ndarray, " m"], freedom_new: float
) -> Float[np.ndarray, " m"]:
    """Degrees of freedom of differences of two independent estimates (Welch and Satterthwaite; JCGM 100, G.4.1)."""
    # Shares of the variance, so that angles of a microradian do not underflow.
    largest = np.maximum(u_old, u_new)
    safe = np.where((largest > 0) & np.isfinite(largest), largest, 1.0)
    one, two = (np.where(np.isfinite(u), u / safe, 1.0) ** 2 for u in (u_old, u_new))
    below = one**2 / freedom_old + two**2 / freedom_new
    return np.where(below > 0, (one + two) ** 2 / np.where(below > 0, below, 1.0), np.inf)


def coverage_factor(level: float, degrees_of_freedom: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Student's t for a coverage of ``level``; the normal distribution's where the degrees of freedom are infinite."""
    from scipy import stats

    tail, endless = 0.5 + level / 2, np.isinf(degrees_of_freedom)
    return np.where(endless, stats.norm.ppf(tail), stats.t.ppf(tail, np.where(endless, 1.0, degrees_of_freedom)))


def tested(
    old: CalibrationRecord,
    new: CalibrationRecord,
    names: tuple[str, ...],
    without: tuple[str, ...],
    change: Float[np.ndarray, " p"],
    level: float,
) -> Joint:
    """The generalised chi-square of all changes, on the subspace that both covariances determine; or F where the noise behind them
    was estimated.

    Single parameters that the data leave open take part with the combinations that they do determine. Those on a bound or held
    in one of the two do not.
    """
    chosen = [i for i, reason in enumerate(without) if "held" not in reason and "on a bound" not in reason]
    part = tuple(names[i] for i in chosen)
    if not part:
        return Joint(math.nan, 0, math.inf, math.nan, (), ())
    steps = np.where([is_length(name) for name in part], 1.0, 1e-3)  # as `Parameters.scale`: the projectors are in them
    index = [[record.names.index(name) for name in part] for record in (old, new)]
    lost = np.concatenate([record.open[rows] for record, rows in zip((old, new), index, strict=True)], axis=1)
    left, size, _ = np.linalg.svd(lost)
    kept = left[:, int(np.sum(size > _FOLLOWS)) :]
    moved = kept.T @ (change[chosen] / steps)
    covariances = [
        kept.T @ (record.covariance[np.ix_(rows, rows)] / np.outer(steps, steps)) @ kept
        for record, rows in zip((old, new), index, strict=True)
    ]
    # Eigenvalues are cut off where combinations are comparable: each in units of its own uncertainty.
    alone = np.sqrt(np.diag(covariances[0] + covariances[1]))
    alone = np.where(alone > 0, alone, 1.0)
    values, vectors = np.linalg.eigh((covariances[0] + covariances[1]) / np.outer(alone, alone))
    seen = values > _SINGULAR * values[-1] if len(values) else np.zeros(0, dtype=bool)
    root = vectors[:, seen] / np.sqrt(values[seen]) / alone[:, None]
    rank = int(seen.sum())
    statistic = float(np.sum((root.T @ moved) ** 2))
    weights = [float(np.sum((root.T @ matrix @ root) ** 2)) for matrix in covariances]
    below = weights[0] / old.degrees_of_freedom + weights[1] / new.degrees_of_freedom
    degrees_of_freedom = rank / below if below > 0 else math.inf
    robust = "robust" in (old.noise_model, new.noise_model)

    def chance(remaining: float, fitted: int) -> float:
        return _probability(remaining, rank - fitted, degrees_of_freedom, robust)

    columns = root.T @ kept.T  # of a change of each parameter by one step, in units of the noise
    few = _few(root.T @ moved, columns, lambda remaining, fitted: chance(remaining, fitted) >= 1 - level)
    causes = tuple((part[i], float(amount * steps[i])) for i, amount in few)
    return Joint(statistic, rank, degrees_of_freedom, chance(statistic, 0), part, causes)


def _few(
    found: Float[np.ndarray, " r"], columns: Float[np.ndarray, "r p"], enough: Callable[[float, int], bool]
) -> list[tuple[int, float]]:
    """The columns, at most `_FEW`, that leave no more of ``found`` than is ``enough``, and their factors: the one that explains most
    first, then the next (orthogonal matching pursuit). None where that many do not suffice."""
    chosen: list[int] = []
    factors, left = np.zeros(0), found
    while not enough(float(left @ left), len(chosen)):
        if len(chosen) >= min(_FEW, len(found) - 1):
            return []
        # By how much each further column, less what those already chosen explain of it, would lower the rest.
        basis = np.linalg.qr(columns[:, chosen])[0]
        spare = columns - basis @ (basis.T @ columns)
        size = np.linalg.norm(spare, axis=0)
        usable = size > 1e-6 * np.linalg.norm(columns, axis=0)
        gain = np.where(usable, np.abs(spare.T @ left) / np.where(usable, size, 1.0), -1.0)
        chosen.append(int(np.argmax(gain)))
        factors = np.linalg.lstsq(columns[:, chosen], found, rcond=None)[0]
        left = found - columns[:, chosen] @ factors
    return list(zip(chosen, factors.tolist(), strict=True))


def _probability(statistic: float, rank: int, degrees_of_freedom: float, robust: bool) -> float:
    """Probability of a statistic as large by chance.

    Where one variance (or two) is estimated, statistic / rank follows F. The robust form estimates the whole covariance from as
    many poses as it has degrees of freedom, so its statistic is taken for Hotelling's T^2 (1931); as the form's variances are
    rather too large, such a p is on the safe side.
    """
    from scipy import stats

    if rank == 0:
        return math.nan
    if math.isinf(degrees_of_freedom):
        return float(stats.chi2.sf(statistic, rank))
    spare = degrees_of_freedom - rank + 1 if robust else degrees_of_freedom
    if spare < 1:
        return math.nan
    return float(stats.f.sf(statistic / rank * spare / degrees_of_freedom, rank, spare))


def length_change(
    old: CalibrationRecord, new: CalibrationRecord, level: float, readings: tuple[float, np.ndarray, np.ndarray]
) -> LengthChange:
    """Lengths by both arms from ``readings``: how long they are, and the poses at both ends (``(v, n)`` each)."""
    length, start, end = readings
    both = [_measured(_plain(record), jnp.asarray(start), jnp.asarray(end)) for record in (old, new)]
    (before, u_old, mean_old), (after, u_new, mean_new) = ([np.asarray(part) for part in found] for found in both)
    degrees_of_freedom = effective_freedom(u_old, old.degrees_of_freedom, u_new, new.degrees_of_freedom)
    u = np.hypot(u_old, u_new)
    mean_freedom = effective_freedom(mean_old[None], old.degrees_of_freedom, mean_new[None], new.degrees_of_freedom)
    u_size = float(np.hypot(mean_old, mean_new) / np.mean(before))
    return LengthChange(
        length=length,
        q=start,
        q_end=end,
        change=after - before,
        u=u,
        expanded=coverage_factor(level, degrees_of_freedom) * u,
        size=float(np.mean(after - before) / np.mean(before)),
        u_size=u_size,
        expanded_size=float(coverage_factor(level, mean_freedom)[0]) * u_size,
    )


def _plain(record: CalibrationRecord) -> Uncertainty:
    """A calibration's uncertainty less what lengths do not follow, so that one compiled program serves all calibrations."""
    return dataclasses.replace(uncertainty_of(record), degrees_of_freedom=math.inf, noise=Noise(), u_k=None)


@eqx.filter_jit
def _measured(
    uncertainty: Uncertainty, start: Float[Array, "v n"], end: Float[Array, "v n"]
) -> tuple[Float[Array, " v"], Float[Array, " v"], Float[Array, ""]]:
    """Lengths by an arm, their standard uncertainties, and that of their mean; mm."""
    between = uncertainty.arm.position(end) - uncertainty.arm.position(start)
    measured = jnp.linalg.norm(between, axis=-1)
    slopes = uncertainty.derivatives(end) - uncertainty.derivatives(start)
    along = jnp.einsum("vc,vcw->vw", between / measured[:, None], slopes)
    each = uncertainty.covariance_of_functions(along[:, None, :])[:, 0, 0]
    return measured, jnp.sqrt(each), jnp.sqrt(uncertainty.covariance_of_functions(jnp.mean(along, axis=0)[None, :])[0, 0])
