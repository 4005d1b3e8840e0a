"""Statistics of the change between two calibrations: its uncertainty, a test of all parameters together, lengths."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.distributions import chi_square_tail, detectable, f_tail
from ..core.numpy_or_jax import AnyArray, compiled, namespace, to_numpy
from ..kinematics.arm import is_length
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.degrees_of_freedom import coverage_factor, degrees_of_freedom

PROBE = ("probe_x", "probe_y", "probe_z")
_REMOUNTED_LEVEL, _REMOUNTED_SHARE = 1e-3, 0.67  # probability by chance; least share of the change that it explains
_PROBE_POSES = 60
FIXED, ON_BOUND = "fixed", "on a bound"  # reasons for which a parameter takes no part in the joint test
_OPEN = 1e-5  # a combination with a larger component along open directions is not determined: see `uncertainty`
_MOST_CAUSES = 4
_POWER = 0.95  # with which a change that is called detectable is found
_SINGULAR = 1e-12  # relative to the largest eigenvalue of a correlation matrix: below, a combination has no variance


class ProbeTest(NamedTuple):
    """The hypothesis that only the probe changed, against none (the joint test) and against all parameters."""

    statistic: float  # left of the joint test's after the probe has changed as fits best
    rank: int
    p: float  # of what is left, by chance
    ratio: float  # F: what the probe explains for each coordinate, over what is left for each combination
    change: tuple[tuple[str, float], ...]  # coordinates of the probe, with their changes, mm
    remounted: bool


class JointTest(NamedTuple):
    """All changes tested together: delta^T (C_old + C_new)^+ delta on combinations that both calibrations determine."""

    statistic: float  # about ``rank`` if nothing moved
    rank: int
    degrees_of_freedom: float  # of the variance: infinite for chi-square, else statistic / rank follows Fisher's F
    p: float  # probability of such a statistic without drift; NaN if there is nothing to test
    names: tuple[str, ...]  # parameters that take part
    # If chance does not explain the statistic: the fewest parameters whose change alone would, found one by one, with
    # their changes (mm, rad); empty if a few do not suffice.
    causes: tuple[tuple[str, float], ...]
    probe: ProbeTest | None = None  # where chance does not explain the statistic
    # Of each parameter that takes part: from which change on the test would find it in 95 % of cases, if nothing else
    # changed; mm, rad or the coefficient's unit, infinite where none would be found.
    detectable: Float[np.ndarray, " q"] = np.zeros(0)


class LengthChange(NamedTuple):
    """Lengths over the volume, from the same readings by the new arm and by the old one, as NumPy arrays; mm."""

    length: float  # by the old arm
    q: Float[np.ndarray, "v n"]
    q_end: Float[np.ndarray, "v n"]
    change: Float[np.ndarray, " v"]  # new less old
    u: Float[np.ndarray, " v"]  # standard uncertainty of the change; infinite if a calibration leaves the length open
    expanded: Float[np.ndarray, " v"]
    scale_change: float  # mean change over mean length: by how much larger the new arm measures, relative
    u_scale_change: float
    expanded_scale_change: float

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
        """Root mean square change expected from the uncertainties of both calibrations alone, mm."""
        return float(np.sqrt(np.mean(self.u**2)))

    @property
    def largest(self) -> float:
        """The change of largest magnitude, with its sign, mm."""
        return float(self.change[np.argmax(np.abs(self.change))])


def joint_test(
    old: CalibrationRecord,
    new: CalibrationRecord,
    names: tuple[str, ...],
    reasons: tuple[str, ...],
    change: Float[np.ndarray, " p"],
    level: float,
) -> JointTest:
    """The generalised chi-square of all changes on the subspace that both covariances determine; F for estimated noise.

    Parameters that the data leave open take part with the combinations that are determined; those that are fixed or on
    a bound in one of the calibrations do not take part.
    """
    chosen = [i for i, reason in enumerate(reasons) if FIXED not in reason and ON_BOUND not in reason]
    tested = tuple(names[i] for i in chosen)
    if not tested:
        return JointTest(math.nan, 0, math.inf, math.nan, (), ())
    steps = _steps(tested)  # the units of the projectors: `Parameters.scale`
    rows = [(record, [record.names.index(name) for name in tested]) for record in (old, new)]
    left, size, _ = np.linalg.svd(np.concatenate([record.open[index] for record, index in rows], axis=1))
    determined = left[:, int(np.sum(size > _OPEN)) :]
    moved = determined.T @ (change[chosen] / steps)
    covariance = sum(record.covariance[np.ix_(index, index)] for record, index in rows) / np.outer(steps, steps)
    covariance = determined.T @ covariance @ determined
    # Scaled by each combination's own uncertainty, so that eigenvalues are comparable.
    u = np.sqrt(np.maximum(np.diag(covariance), 0.0))  # rounding makes variances of exact data negative
    u = np.where(u > 0, u, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(u, u))
    regular = values > _SINGULAR * values[-1] if len(values) else np.zeros(0, dtype=bool)
    root = vectors[:, regular] / np.sqrt(values[regular]) / u[:, None]  # root root^T = C^+ on what is determined
    rank = int(regular.sum())
    whitened = root.T @ moved
    statistic = float(np.sum(whitened**2))
    # Welch and Satterthwaite of the trace: with whitened parts P_k of the covariance, sum over P_k of the identity,
    # rank / nu = sum_k |P_k|^2 / nu_k, where |.| is the Frobenius norm.
    combined = determined @ root / steps[:, None]
    denominator = sum(
        float(np.sum((combined.T @ matrix[np.ix_(index, index)] @ combined) ** 2)) / freedom
        for record, index in rows
        for matrix, freedom in _parts_of(record)
    )
    freedom = rank / denominator if denominator > 0 else math.inf
    robust = "robust" in (old.noise_model, new.noise_model)

    def probability(remaining: float, fitted: int) -> float:
        return _probability(remaining, rank - fitted, freedom, robust)

    columns = root.T @ determined.T  # whitened change for a change of each parameter by one step
    causes = _causes(whitened, columns, lambda remaining, fitted: probability(remaining, fitted) >= 1 - level)
    named = tuple((tested[i], float(amount * steps[i])) for i, amount in causes)
    p = probability(statistic, 0)
    probe = None
    if p < 1 - level:
        of_probe = columns @ (_changes_of_probe(new, tested) / steps[:, None])
        probe = _probe_test(whitened, of_probe, columns, probability)
    sizes = _detectable(columns, rank, freedom, level) * steps
    return JointTest(statistic, rank, freedom, p, tested, named, probe, sizes)


def _detectable(columns: Float[np.ndarray, "r p"], rank: int, freedom: float, level: float) -> np.ndarray:
    """Changes of single parameters that the test finds in 95 % of cases, in steps: a change by one step has the
    noncentrality of the sum of squares of its column."""
    with np.errstate(divide="ignore"):
        return np.sqrt(detectable(rank, freedom, level, _POWER) / np.sum(columns**2, axis=0))


def _steps(names: Sequence[str]) -> Float[np.ndarray, " p"]:
    return np.where([is_length(name) for name in names], 1.0, 1e-3)


def _parts_of(record: CalibrationRecord) -> list[tuple[Float[np.ndarray, "p p"], float]]:
    """Parts of the covariance of a calibration's parameters, each with its degrees of freedom."""
    uncertainty = uncertainty_of(record)
    others = [] if uncertainty.components is None else list(np.asarray(uncertainty.components.matrices))
    freedom = degrees_of_freedom(np.eye(1 + len(others)), uncertainty.law)
    scatter = record.covariance - sum(others, np.zeros_like(record.covariance))
    return list(zip([scatter, *others], freedom, strict=True))


def _changes_of_probe(record: CalibrationRecord, names: tuple[str, ...]) -> Float[np.ndarray, "p 3"]:
    """Changes of the compared parameters for one of each coordinate of the probe, 1 a mm.

    A coordinate that is fixed shows in what moves the tips most like it (a_6 where alpha_6 turns about the same axis).
    """
    arm, q = to_numpy((record.calibrated.arm, np.asarray(record.recording.capture.readings)))
    q = q[np.unique(np.linspace(0, len(q) - 1, _PROBE_POSES).astype(int))]
    every = (*names, *(name for name in PROBE if name not in names))
    by = np.moveaxis(np.asarray(arm.jacobian(q, every)), -1, 0).reshape(len(every), -1).T
    steps, changes = _steps(names), np.zeros((len(names), 3))
    for i, name in enumerate(PROBE):
        if name in names:
            changes[names.index(name), i] = 1.0
        else:
            alike = np.linalg.lstsq(by[:, : len(names)] * steps, by[:, every.index(name)], rcond=1e-6)[0]
            changes[:, i] = alike * steps
    return changes


def _probe_test(
    whitened: Float[np.ndarray, " r"],
    of_probe: Float[np.ndarray, "r 3"],
    columns: Float[np.ndarray, "r p"],
    probability: Callable[[float, int], float],
) -> ProbeTest | None:
    """Whether a change of the probe explains nearly all, and better than that of any one parameter would.

    What is left may be more than chance explains: errors outside the model change with the poses of a calibration. A
    probe was remounted where it explains several times as much for each unknown (F against what is left).
    """

    def left_by(which: Float[np.ndarray, "r k"]) -> tuple[float, int, np.ndarray]:
        factors, _, rank, _ = np.linalg.lstsq(which, whitened, rcond=1e-9)
        return float(np.sum((whitened - which @ factors) ** 2)), int(rank), factors

    explained = float(np.sum(whitened**2))
    left, fitted, factors = left_by(of_probe)
    explained -= left
    redundancy = len(whitened) - fitted
    if fitted == 0 or redundancy < 1:
        return None
    ratio = explained / fitted / max(left / redundancy, 1e-300)
    remounted = (
        f_tail(ratio, fitted, redundancy) < _REMOUNTED_LEVEL
        and explained > _REMOUNTED_SHARE * (explained + left)
        and left < min(left_by(columns[:, [i]])[0] for i in range(columns.shape[1]))
    )
    change = tuple(zip(PROBE, map(float, factors), strict=True))
    return ProbeTest(left, redundancy, probability(left, fitted), ratio, change, remounted)


def _causes(
    whitened: Float[np.ndarray, " r"], columns: Float[np.ndarray, "r p"], explained: Callable[[float, int], bool]
) -> list[tuple[int, float]]:
    """The fewest columns, with factors, that leave a remainder which chance explains; none if `_MOST_CAUSES` do not.

    Orthogonal matching pursuit: the column that explains most first, then the next.
    """
    chosen: list[int] = []
    factors, left = np.zeros(0), whitened
    while not explained(float(left @ left), len(chosen)):
        if len(chosen) >= min(_MOST_CAUSES, len(whitened) - 1):
            return []
        # By how much each column, orthogonal to those already chosen, would reduce the remainder.
        basis = np.linalg.qr(columns[:, chosen])[0]
        across = columns - basis @ (basis.T @ columns)
        size = np.linalg.norm(across, axis=0)
        usable = size > 1e-6 * np.linalg.norm(columns, axis=0)
        reduction = np.where(usable, np.abs(across.T @ left) / np.where(usable, size, 1.0), -1.0)
        chosen.append(int(np.argmax(reduction)))
        factors = np.linalg.lstsq(columns[:, chosen], whitened, rcond=None)[0]
        left = whitened - columns[:, chosen] @ factors
    return list(zip(chosen, factors.tolist(), strict=True))


def _probability(statistic: float, rank: int, degrees_of_freedom: float, robust: bool) -> float:
    """Probability of such a statistic, or a larger one, by chance.

    If one or two variances are estimated, statistic / rank follows F. The robust noise model estimates the whole
    covariance from as many poses as it has degrees of freedom, so its statistic is treated as Hotelling's T^2 (1931);
    its variances are rather too large, so such a p is too large rather than too small.
    """
    if rank == 0:
        return math.nan
    if math.isinf(degrees_of_freedom):
        return chi_square_tail(statistic, rank)
    # Hotelling: T^2 (nu - r + 1) / (nu r) follows F with r and nu - r + 1 degrees of freedom.
    second = degrees_of_freedom - rank + 1 if robust else degrees_of_freedom
    if second < 1:
        return math.nan
    return f_tail(statistic / rank * second / degrees_of_freedom, rank, second)


def length_change(
    old: CalibrationRecord, new: CalibrationRecord, level: float, lengths: tuple[float, np.ndarray, np.ndarray]
) -> LengthChange:
    """Change of ``lengths``: their length, mm, and the configurations at both ends (``(v, n)`` each)."""
    length, start, end = lengths
    uncertainties = [uncertainty_of(record) for record in (old, new)]
    measured = [map(np.asarray, _measured(item, start, end)) for item in uncertainties]
    (before, after), *pairs = zip(*measured, strict=True)
    law = uncertainties[0].law.joined(uncertainties[1].law)
    parts, of_mean = (np.concatenate(pair, axis=-1) for pair in pairs)
    u, u_scale_change = np.sqrt(parts.sum(axis=-1)), float(np.sqrt(of_mean.sum()) / np.mean(before))
    return LengthChange(
        length=length,
        q=start,
        q_end=end,
        change=after - before,
        u=u,
        expanded=coverage_factor(level, parts, law) * u,
        scale_change=float(np.mean(after - before) / np.mean(before)),
        u_scale_change=u_scale_change,
        expanded_scale_change=float(coverage_factor(level, of_mean, law)) * u_scale_change,
    )


@compiled(jit=eqx.filter_jit)
def _measured(
    uncertainty: Uncertainty, start: Float[AnyArray, "v n"], end: Float[AnyArray, "v n"]
) -> tuple[Float[AnyArray, " v"], Float[AnyArray, "v c"], Float[AnyArray, " c"]]:
    """Lengths by an arm, mm; their variances and that of their mean, part by part, mm^2."""
    xp = namespace(uncertainty, start, end)
    between = uncertainty.arm.position(end) - uncertainty.arm.position(start)
    measured = xp.linalg.norm(between, axis=-1)
    slopes = uncertainty.derivatives(end) - uncertainty.derivatives(start)
    along = xp.einsum("vc,vcw->vw", between / measured[:, None], slopes)
    return measured, uncertainty.parts_of_functions(along), uncertainty.parts_of_functions(xp.mean(along, axis=0))
