"""Shared errors, as random effects: how large they are by the residuals.

The model of a calibration leaves residuals r = M e of whitened errors e, M the projector onto what its unknowns cannot
explain (`residual_tests`). Shared errors are e = w + sum_g Z_g c_g: independent ones w of one variance s, and
columns Z_g (the tips of all poses of a visit move alike; a joint turns by an unknown coefficient times a known
function) times coefficients of variance v_g. The likelihood of r depends on the variances through D_g = M Z_g alone
(REML: Patterson and Thompson 1971, Biometrika 58, 545-554). The calibration stays as it is. Its parameters follow a
shared error as they follow any other error of the tips, z = K c, so its covariance grows by K v K^T.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration.record import CalibrationRecord
from ..calibration.stages import Sensitivities
from ..uncertainty.evidence import Groups, PriorModel, covariance_of_log_variances, learned_log_variances
from .equations import LEAST_U, PRIOR, Block, Rows, lengths_in_solve
from .residual_tests import Residuals
from .scale import lengths_of_sockets

_ROUNDS = 40  # of the variance of independent errors; usually 5
_TOLERANCE = 1e-6
_EXPLAINED = 1e-3  # part of a column that the model leaves, below which it counts as the model's own
_NULL = 1e-6  # eigenvalues of an effect's information below this, of the largest, are zero
# Standard deviations at which the likelihood of one effect is computed: how many, and between which parts of the usual.
_GRID, _RANGE = 80, (0.01, 100.0)
_LEAST_LOG = 2 * np.log(1e-4)  # smallest log variance of a learned group, in natural steps


class Effects(NamedTuple):
    """Effects that are known so far next to independent errors: columns, and the variance of each coefficient.

    Whatever a further effect is compared with has the covariance ``variance`` I + D diag(variances) D^T.
    """

    left: Residuals
    given: bool  # whether the variance of independent errors is 1, as given
    columns: Float[np.ndarray, "R k"]
    variances: Float[np.ndarray, " k"]
    variance: float  # of independent errors

    @classmethod
    def none(cls, left: Residuals, given: bool) -> "Effects":
        """Nothing but independent errors."""
        variance = 1.0 if given else left.cost / left.degrees_of_freedom
        return cls(left, given, np.zeros((len(left.values), 0)), np.zeros(0), variance)

    def product(self, a: Float[np.ndarray, "R a"], b: Float[np.ndarray, "R b"]) -> Float[np.ndarray, "a b"]:
        """a^T (I + D diag(variances / variance) D^T)^-1 b."""
        if not len(self.variances):
            return a.T @ b
        d = self.columns * np.sqrt(self.variances / self.variance)
        return a.T @ b - (a.T @ d) @ np.linalg.solve(np.eye(d.shape[1]) + d.T @ d, d.T @ b)

    def spectrum(self, columns: Float[np.ndarray, "R c"], errors: Float[np.ndarray, " R"]) -> np.ndarray:
        """What some errors show of a further effect: eigenvalues of its information that are not 0, and in the second
        row the squared projections of the errors on their vectors."""
        values, vectors = np.linalg.eigh(self.product(columns, columns))
        present = values > _NULL * max(values.max(initial=0.0), 1e-300)
        seen = vectors[:, present].T @ self.product(columns, errors[:, None])[:, 0]
        return np.stack([values[present], seen**2])

    def joined(self, columns: Float[np.ndarray, "R c"], variances: Float[np.ndarray, " c"]) -> "Effects":
        """With a further effect, whose columns the model has not explained; the variance of independent errors is the
        one with which the residuals are as large as they should be."""
        effects = self._replace(
            columns=np.concatenate([self.columns, columns], axis=1),
            variances=np.concatenate([self.variances, variances]),
        )
        if self.given:
            return effects
        d, r, cost = effects.columns * np.sqrt(effects.variances), self.left.values, self.left.cost
        values, vectors = np.linalg.eigh(d.T @ d)
        seen, values = (vectors.T @ (d.T @ r)) ** 2, np.maximum(values, 0.0)
        variance = self.variance
        for _ in range(_ROUNDS):
            explained = float(np.sum(seen / (variance + values)))
            new = max(cost - explained, 1e-12 * cost) / self.left.degrees_of_freedom
            change, variance = abs(np.log(new / variance)), new
            if change < _TOLERANCE:
                break
        return effects._replace(variance=variance)


class OneVariance(NamedTuple):
    """An effect of one variance, every coefficient a displacement of the tip: how large the variance may be."""

    variance: float  # as stated, mm^2
    ratios: Float[np.ndarray, " k"]  # of those that are possible to that one
    weights: Float[np.ndarray, " k"]  # their probabilities
    log_likelihood: float  # its maximum over that without the effect


def one_variance(
    effects: Effects, columns: Float[np.ndarray, "R c"], usual: float, probability: float = 1.0
) -> OneVariance:
    """The variance of one more effect, with its posterior distribution.

    Beforehand there is such an effect with a ``probability``, and its standard deviation then has a half-Cauchy
    distribution: as probable anywhere below what is ``usual``, and less and less above, which few data would not
    exclude (Gelman 2006, Bayesian Analysis 1, 515-534, section 7, for just such effects of a few groups; with a
    probability of one half, Jeffreys' prior of a test for an effect: 1961, Theory of Probability, section 5.2). What
    residuals show is the sum of the effect and of the independent errors in its place; stated is the geometric mean of
    that sum, less the errors. Intervals do not follow from it alone, but from the whole distribution
    (`degrees_of_freedom`).

    ``columns`` are those of the effect, as far as the model does not explain them; ``usual`` is in mm.
    """
    r, freedom = effects.left.values, effects.left.degrees_of_freedom
    values, squares = effects.spectrum(columns, r)
    total = float(effects.product(r[:, None], r[:, None])[0, 0])
    ratio = (usual * np.geomspace(*_RANGE, _GRID)) ** 2 / effects.variance
    cost = total - np.sum(ratio[:, None] * squares / (1 + ratio[:, None] * values), axis=1)
    log_sum = np.sum(np.log1p(ratio[:, None] * values), axis=1)
    # Of the effect, and of what independent errors add to the mean of a coefficient's tips.
    variance = ratio if effects.given else ratio * cost / freedom
    of_errors = variance / ratio / np.mean(values)
    of_cost = cost - total if effects.given else freedom * np.log(cost / total)
    likelihood = -0.5 * (of_cost + log_sum)
    weight = likelihood + 0.5 * np.log(variance / usual**2) - np.log1p(variance / usual**2)
    highest = max(float(weight.max()), 0.0)  # without the effect, the logarithm of the likelihood is 0
    # Half-Cauchy by the logarithm of the standard deviation; the last is that there is no effect.
    share = probability * 2 / np.pi * np.log(_RANGE[1] / _RANGE[0]) / (_GRID - 1)
    weight = np.append(share * np.exp(weight - highest), (1 - probability) * np.exp(-highest))
    weight = weight / weight.sum()
    variance, of_errors = np.append(variance, 0.0), np.append(of_errors, effects.variance / np.mean(values))
    stated = float(np.exp(weight @ np.log(variance + of_errors)) - weight @ of_errors)
    stated = max(stated, float(variance[0]))
    return OneVariance(stated, variance / stated, weight, float(np.max(likelihood)))


def group_deviations(
    effects: Effects, columns: Float[np.ndarray, "R k"], members: Float[np.ndarray, "g k"]
) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
    """Standard deviations of groups of effects at which the residuals are most probable, natural steps, and the degrees
    of freedom that the residuals and what is expected beforehand give each: 2 over the variance of its log variance.

    Each group is expected, to a factor of 4.5, to explain an equal share of the residuals: else groups of which the
    data say little would be as large as anybody fears, or collapse (`benchmarks/NOTES.md`). ``columns`` are those of
    all groups in natural steps, as far as the model does not explain them; ``members`` is 1 where a column is a
    group's.
    """
    r, freedom = effects.left.values[:, None], effects.left.degrees_of_freedom
    information, right = effects.product(columns, columns), effects.product(columns, r)[:, 0]
    total, none = float(effects.product(r, r)[0, 0]), np.zeros(columns.shape[1])
    variance, every = effects.variance, np.ones(len(members), dtype=bool)
    sizes = np.maximum(members @ np.diag(information), 1e-300) / freedom
    logs = np.log(total / freedom / (sizes * len(members)))
    groups = Groups(members, logs, every, every, _LEAST_LOG)
    for _ in range(_ROUNDS):
        model = PriorModel(information / variance, right / variance, none, none.astype(bool))
        logs = learned_log_variances(model, groups, logs)
        if effects.given:
            break
        inner = information + np.diag(variance * np.exp(-logs @ groups.members))
        new = max((total - right @ np.linalg.solve(inner, right)) / freedom, 1e-300)
        change, variance = abs(np.log(new / variance)), new
        if change < _TOLERANCE:
            break
    spread = np.diag(covariance_of_log_variances(model, groups, logs, logs > _LEAST_LOG + 1e-9))
    return np.exp(0.5 * logs), 2 / np.where(spread > 0, spread, 1e-9)


def second_moments(
    effects: Effects, columns: Float[np.ndarray, "R k"], sd: Float[np.ndarray, " g"], members: Float[np.ndarray, "g k"]
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "g k k"]]:
    """Second moments about 0 of the coefficients of groups, given the residuals and the groups' standard deviations;
    and their derivatives by the groups' log variances.

    A calibration without the effect has the error that these coefficients make, whose mean square is this.
    """
    weights = members / sd[:, None] ** 2
    inner = effects.product(columns, columns) / effects.variance + np.diag(weights.sum(axis=0))
    covariance = np.linalg.inv(inner)
    mean = covariance @ effects.product(columns, effects.left.values[:, None]) / effects.variance
    by_group = []
    for weight in weights:
        moved = covariance @ (weight[:, None] * mean) @ mean.T
        by_group.append(covariance @ (weight[:, None] * covariance) + moved + moved.T)
    return covariance + mean @ mean.T, np.array(by_group)


class SharedProblem(NamedTuple):
    """The equations of a calibration, and how its parameters follow its data."""

    record: CalibrationRecord
    rows: list[Rows]
    left: Residuals
    sensitivities: Sensitivities
    lengths: Float[np.ndarray, "l k"] | None  # whitening of the lengths between means of sockets, their last rows

    def moved(self, patterns: Float[np.ndarray, "M c"]) -> Float[np.ndarray, "R k"]:
        """Columns of tips that move by a pattern over the poses, along x, y and z each."""
        of_poses = [
            np.einsum("mra,mc->mrca", part.by_tip, patterns[part.poses]).reshape(part.residual.size, -1)
            for part in self.rows
        ]
        return self._columns(of_poses, np.einsum("laN,Nc->lca", self.sensitivities.lengths, patterns))

    def turned(
        self, values: Float[np.ndarray, "M k"], joints: np.ndarray, steps: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, "R k"]:
        """Columns of joints that turn by functions of the readings times a step."""
        arm, q = self.record.calibrated.arm, np.asarray(self.record.recording.capture.readings)
        natural = np.array([1.0 if i + 1 in arm.prismatic else 1e-3 for i in range(arm.joints)])
        factors = values * (steps / natural[joints])
        of_poses = [
            (part.extra[..., joints] * factors[part.poses][:, None]).reshape(part.residual.size, -1)
            for part in self.rows
        ]
        of_lengths = np.zeros((len(self.sensitivities.lengths), len(steps)))
        if len(of_lengths):
            names = [f"{'d' if i + 1 in arm.prismatic else 'theta'}_{i + 1}" for i in range(arm.joints)]
            slopes = np.einsum("laN,Naj->ljN", self.sensitivities.lengths, np.asarray(arm.jacobian(q, names)))
            of_lengths = np.einsum("lkN,Nk->lk", slopes[:, joints], values * steps)
        return self._columns(of_poses, of_lengths)

    def _columns(self, of_poses: list[np.ndarray], of_lengths: np.ndarray) -> np.ndarray:
        poses = np.concatenate(of_poses)
        whole = np.pad(poses, ((0, len(self.left.values) - len(poses)), (0, 0)))
        if self.lengths is not None:
            whole[-len(self.lengths) :] = self.lengths @ of_lengths.reshape(len(of_lengths), -1)
        return self.left.unexplained(whole)


def scale_of_lengths(record: CalibrationRecord, relations: list[Block]) -> Block:
    """That the lengths together say how large the arm is.

    Residuals of sockets are in proportion to the arm: where all lengths are free, a smaller arm would take them away.
    """
    lengths = record.recording.capture.lengths
    weights = np.array([float(length.value) / max(float(length.u), LEAST_U) for length in lengths])
    block = next(block for block in relations if block.fixture != PRIOR)
    shared = weights @ block.shared[: len(weights)] / np.linalg.norm(weights)
    return Block(PRIOR, None, np.zeros(1), shared[None], np.zeros((1, 0)))


def with_lengths(problem: SharedProblem, relations: list[Block]) -> SharedProblem:
    """The same with what lengths and certified values say, of all but the scale.

    Fixed lengths or a prior may contradict the scale of all lengths, which errors of single places do not explain.
    """
    record, lengths, whitening, related = problem.record, problem.record.recording.capture.lengths, None, None
    blocks = [*(part.block("") for part in problem.rows), *relations]
    first = sum(part.residual.size for part in problem.rows)
    by_scale = np.array([float(length.value) / max(float(length.u), LEAST_U) for length in lengths])
    if lengths and not lengths_in_solve(record):
        related = lengths_of_sockets(record, problem.rows)
        if related is None:
            return problem
        whitening = np.linalg.inv(np.linalg.cholesky(related.covariance))
        block = related.relations
        blocks.append(block._replace(residual=whitening @ block.residual, shared=whitening @ block.shared))
        by_scale = whitening @ np.array([float(length.value) for length in lengths])
        if related.scale is not None:
            # The scale anchor, which the lengths determine, is one more unknown. Residuals are in proportion to the
            # arm: where every length is free, a shorter anchor, and all else in proportion, takes them away. That is
            # no error of the anchor, so its column is taken at right angles to them.
            of_rows, r = related.scale[0], problem.left.values[: len(related.scale[0])]
            of_rows = of_rows - r * (r @ of_rows) / max(float(r @ r), 1e-300)
            column = np.concatenate([of_rows, whitening @ related.scale[1]])
            parts = np.split(column, np.cumsum([len(block.residual) for block in blocks])[:-1])
            pairs = zip(blocks, parts, strict=True)
            blocks = [block._replace(shared=np.column_stack([block.shared, part])) for block, part in pairs]
    left = Residuals.of(blocks)
    if related is None or related.scale is None:
        # Beside a scale anchor, the scale of the lengths is no further unknown: what the anchor leaves of it is along
        # the residuals of the lengths, which it would take away.
        column = np.zeros((len(left.values), 1))
        column[first : first + len(by_scale), 0] = by_scale
        if np.linalg.norm(left.unexplained(column)) > _EXPLAINED * np.linalg.norm(column):
            left = left.extended(column)
    return problem._replace(left=left, lengths=whitening)
