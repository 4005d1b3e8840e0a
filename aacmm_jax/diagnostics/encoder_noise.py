"""Encoders that are noisier than stated, or than the others: found by a test, and their noise estimated.

Rows of poses are whitened by the noise of the calibration, V_0. With the columns z_j of the reading of joint j, those T
of the tip in its seat, and F of what was measured, the covariance of a pose is V = F + sum_j v_j z_j z_j' + s T T'.

The test is whether r'A r is too large, with the residuals r = M e and A = z_j z_j' - c T T' pose by pose. It is
compared with r'r of the poses, so that a common factor of all noise does not matter; and c is such that a wrong noise
of the seat does not, to first order: the expectation of r'A r over that of r'r has no derivative by s.

Variances that are not stated are those of restricted maximum likelihood (Patterson and Thompson 1971, Biometrika 58,
545-554). With K = z_j z_j' whitened by V, twice the log likelihood has the derivative r'K r - tr MK by v_j, and the
information tr MKMK / 2, of which the blocks of single poses are taken: enough for Fisher scoring, and for u.
"""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float

from ..calibration.record import CalibrationRecord, record_of
from ..calibration.results import Calibration, Identification, NoisyEncoder
from ..core._compat import inside_trace
from ..core.arrays import is_concrete
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..data.noise import Noise, one_arcsec
from ..data.recording import Recording
from ..kinematics.parameters import ArmSpecification
from .equations import EXACT, Rows, equations_in_chunks, residual_rms
from .group_test import Block
from .missing_terms import found_terms
from .residual_tests import LEVEL, Residuals, chance_above_zero

_ROUNDS = 50  # of Fisher scoring; usually 4 to 8
_TOLERANCE = 1e-3  # of a log variance: a hundredth of its standard uncertainty
_FACTOR = 1.5  # largest change of a log variance in one round
_LEAST = 1e-6  # part of the residuals that a variance explains, below which it is 0
_CLEAR = 1e-4  # probability of a missing term, below which the model is wrong rather than the noise
_FEWEST = 20  # degrees of freedom below which no variance is estimated by joint

Result = TypeVar("Result", Calibration, Identification)


class NoisyJoint(NamedTuple):
    """The joint whose readings seem noisier than those of the others."""

    joint: int
    ratio: float  # of the squares that its column sees, to what the residuals as a whole let expect
    probability: float


class _Variances(NamedTuple):
    readings: Float[np.ndarray, " n"]  # arcsec^2; of a prismatic joint, of what this is at 1 m
    seat: float  # mm^2


class _Equations(NamedTuple):
    """Equations whose rows are whitened by some variances."""

    rows: Sequence[Rows]
    relations: Sequence[Block]
    unit: Float[np.ndarray, " n"]  # of the readings' columns, for a standard deviation of 1 arcsec
    variances: _Variances

    @classmethod
    def of(cls, record: CalibrationRecord, rows: Sequence[Rows], relations: Sequence[Block]) -> "_Equations":
        kinds, joints = record.calibrated.arm.geometry.kinds, record.calibrated.arm.joints
        unit = np.broadcast_to(one_arcsec(kinds), (joints,))
        steps = np.where(np.zeros(joints, dtype=bool) if kinds is None else kinds.mask(), 1.0, 1e-3)
        stated = np.broadcast_to(to_numpy(record.noise.of_readings(kinds)), (joints,)) / unit
        return cls(rows, relations, unit / steps, _Variances(stated**2, float(record.noise.seating) ** 2))

    def readings(self, rows: Rows) -> Float[np.ndarray, "m r n"]:
        return rows.extra[..., : len(self.unit)] * self.unit

    def left(self) -> Residuals:
        return Residuals.of([*(each.block("") for each in self.rows), *self.relations])

    def weighted(self, new: _Variances) -> "_Equations":
        """The same rows, whitened by other variances."""
        rows, more, seat = [], new.readings - self.variances.readings, new.seat - self.variances.seat
        for each in self.rows:
            z, t = self.readings(each), each.by_tip
            covariance = (z * more) @ z.swapaxes(1, 2) + seat * t @ t.swapaxes(1, 2)
            # Some noise of its own: where nothing else errs, poses with fewer than three errors would be singular.
            covariance += (1 + 1e-9) * np.eye(z.shape[1])
            factor = np.linalg.cholesky(0.5 * (covariance + covariance.swapaxes(1, 2)))
            root = np.linalg.inv(factor)
            whitened = {name: root @ getattr(each, name) for name in ("shared", "own", "extra", "by_tip")}
            residual = np.einsum("mab,mb->ma", root, each.residual)
            rows.append(each._replace(residual=residual, in_mm=each.in_mm @ factor, **whitened))
        return self._replace(rows=rows, variances=new)

    def blocks(self, left: Residuals) -> list[Float[np.ndarray, "_ _ _"]]:
        """M of single poses."""
        found = []
        for each, rows, own in zip(self.rows, left.slices, left.own, strict=False):
            columns = np.concatenate([own, left.basis[rows]], axis=1).reshape(*each.residual.shape, -1)
            found.append(np.eye(columns.shape[1]) - columns @ columns.swapaxes(1, 2))
        return found

    def estimated(self, groups: Sequence[Sequence[int]], seat: bool) -> tuple["_Equations", Float[np.ndarray, " k"]]:
        """With variances of groups of joints, one each, and of the seat, by restricted maximum likelihood.

        Returns:
            The equations whitened by them, and the standard uncertainty of the log of each variance.
        """
        last = len(groups)
        now, log = self, np.zeros(last + seat)
        for i, group in enumerate(groups):
            log[i] = np.log(max(np.mean(self.variances.readings[list(group)]), 1e-6))
        for number in range(_ROUNDS):
            left = now.left()
            blocks, spare = now.blocks(left), left.degrees_of_freedom
            if number == 0 and seat:
                each = zip(now.rows, blocks, strict=True)
                sees = sum(float(np.sum(rows.by_tip * (block @ rows.by_tip))) for rows, block in each)
                # From nothing it would not rise.
                log[last] = np.log(max(self.variances.seat, 0.05 * spare / max(sees, 1e-300)))
                now = self.weighted(_of_groups(self.variances, log, groups, seat))
                continue
            slope, information, sees = now._scores(left, blocks, groups, seat)
            variances = np.exp(log)
            slope, information = slope * variances, information * variances * variances[:, None]
            # One that explains nothing, and would have to be negative, stays where it is.
            moving = (variances * sees > _LEAST * spare) | (slope > 0)
            step = np.zeros(len(log))
            damped = information[np.ix_(moving, moving)] + 1e-9 * np.eye(int(moving.sum()))
            step[moving] = np.clip(np.linalg.solve(damped, slope[moving]), -_FACTOR, _FACTOR)
            log = log + step
            now = self.weighted(_of_groups(self.variances, log, groups, seat))
            if np.max(np.abs(step), initial=0.0) < _TOLERANCE:
                break
        u = np.sqrt(np.diag(np.linalg.pinv(information)))
        return now, u

    def _scores(
        self, left: Residuals, blocks: Sequence[np.ndarray], groups: Sequence[Sequence[int]], seat: bool
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
        """Derivatives of the log likelihood by the variances, their information, and tr MK."""
        count = len(groups) + seat
        slope, information, sees = np.zeros(count), np.zeros((count, count)), np.zeros(count)
        for each, rows, block in zip(self.rows, left.slices, blocks, strict=False):
            r, z = left.values[rows].reshape(each.residual.shape), self.readings(each)
            columns = [*(z[..., list(group)] for group in groups), *([each.by_tip] if seat else [])]
            seen = [block @ column for column in columns]
            for k, column in enumerate(columns):
                trace = float(np.sum(column * seen[k]))
                sees[k] += trace
                slope[k] += 0.5 * (float(np.sum(np.einsum("mac,ma->mc", column, r) ** 2)) - trace)
                for other in range(count):
                    information[k, other] += 0.5 * float(np.sum((column.swapaxes(1, 2) @ seen[other]) ** 2))
        return slope, information, sees

    def tests(self, joints: Sequence[int]) -> NoisyJoint | None:
        """The joint (from 0) of some whose readings are the noisiest; its probability is Holm's, of all."""
        left = self.left()
        blocks = self.blocks(left)
        poses = [left.values[rows].reshape(e.residual.shape) for e, rows in zip(self.rows, left.slices, strict=False)]
        # Rows of priors, which may be far wider than what they say, are not what the others are compared with.
        cost, spare = (float(sum(map(np.sum, of))) for of in ([r**2 for r in poses], [_traced(b) for b in blocks]))
        tips = [each.by_tip @ each.by_tip.swapaxes(1, 2) for each in self.rows]
        trace_t, trace_tt = (sum(np.sum(x) for x in of) for of in _traces(blocks, tips, tips))
        none, found = [None] * (len(left.slices) - len(self.rows)), []
        for joint in joints:
            columns = [self.readings(each)[..., joint, None] for each in self.rows]
            kernels = [column @ column.swapaxes(1, 2) for column in columns]
            trace, trace_both = (sum(np.sum(x) for x in of) for of in _traces(blocks, kernels, tips))
            ratio = _value(kernels, poses) * spare / max(trace * cost, 1e-300)
            below = spare * trace_tt - trace_t**2
            known = self.variances.seat * trace_t > _LEAST * spare and below > 1e-9 * trace_t**2
            c = (spare * trace_both - trace * trace_t) / below if known else 0.0
            kernels = [k - c * t for k, t in zip(kernels, tips, strict=True)]
            x = _value(kernels, poses) / max(cost, 1e-300)
            chance = chance_above_zero(left, [*(k - x * np.eye(k.shape[1]) for k in kernels), *none])
            if trace > 0:
                found.append(NoisyJoint(joint + 1, ratio, chance))
        if not found:
            return None
        worst = min(found, key=lambda one: (one.probability, -one.ratio))
        return worst._replace(probability=min(worst.probability * len(found), 1.0))


def _traced(matrices: Float[np.ndarray, "m r r"]) -> Float[np.ndarray, " m"]:
    return np.einsum("maa->m", matrices)


def _value(kernels: Sequence[np.ndarray], residuals: Sequence[np.ndarray]) -> float:
    each = zip(kernels, residuals, strict=True)
    return float(sum(np.einsum("ma,mab,mb->", r, kernel, r) for kernel, r in each))


def _traces(blocks: Sequence[np.ndarray], one: Sequence[np.ndarray], other: Sequence[np.ndarray]):
    """tr MK pose by pose, and tr MKML by the blocks of single poses."""
    first = [np.einsum("mab,mba->m", b, k) for b, k in zip(blocks, one, strict=True)]
    both = [np.einsum("mab,mba->m", b @ k, b @ n) for b, k, n in zip(blocks, one, other, strict=True)]
    return first, both


def _of_groups(before: _Variances, log: Float[np.ndarray, " k"], groups: Sequence[Sequence[int]], seat: bool):
    readings = before.readings.copy()
    for group, value in zip(groups, np.exp(log), strict=False):
        readings[list(group)] = value
    return _Variances(readings, float(np.exp(log[-1])) if seat else before.seat)


def noisy_joint(record: CalibrationRecord, rows: Sequence[Rows], relations: Sequence[Block]) -> NoisyJoint | None:
    """The joint in whose direction residuals are larger than in those of the others.

    Args:
        record: The calibration.
        rows: Its equations of poses, with the terms that its model lacks.
        relations: Its other equations.
    """
    return _noisy_joint(record, _Equations.of(record, rows, relations))[0]


def _noisy_joint(record: CalibrationRecord, equations: _Equations) -> tuple[NoisyJoint | None, _Equations]:
    """The joint, and the equations as the test weighted them."""
    every = range(len(equations.unit))
    found = equations.tests(every)
    if found is None or found.probability >= LEVEL or record.given_noise is not None:
        return found, equations
    # The noise of the calibration comes from two moments; its seat is often 0, and then poses that hardly see the
    # encoders in some direction count too much there.
    equations, _ = equations.estimated([list(every)], seat=True)
    return equations.tests(every), equations


def _noisy_within_observations(equations: _Equations, joint: int) -> bool:
    """Whether a joint (from 1) is noisy even where its zero may differ from one observation to the next.

    A zero that is off in some of them, as after a slip, moves all of their poses alike: these contradict the others,
    and that is what has to be said.
    """
    own = [np.concatenate([each.own, each.extra[..., [joint - 1]]], axis=2) for each in equations.rows]
    rows = [each._replace(own=columns) for each, columns in zip(equations.rows, own, strict=True)]
    found = equations._replace(rows=rows).tests([joint - 1])
    return found is not None and found.probability < LEVEL


def noise_by_joint(record: CalibrationRecord) -> tuple[Noise, tuple[NoisyEncoder, ...]] | None:
    """The noise of a calibration with that of noisy encoders as the residuals show it; None where there are none.

    The noise of all others stays as it is stated; where nothing is stated, it is estimated anew without them. Where a
    term is clearly missing all the same, the model is what is wrong, and the noise stays.

    Args:
        record: The calibration.
    """
    rows, relations = equations_in_chunks(record)
    if not rows or residual_rms(rows) < EXACT:
        return None
    equations = _Equations.of(record, rows, relations)
    if equations.left().degrees_of_freedom < _FEWEST:
        return None
    given, joints = record.given_noise is not None, len(equations.unit)
    noisy, probabilities, u = [], [], np.zeros(0)
    found, now = _noisy_joint(record, equations)
    if found is not None and found.probability < LEVEL and not _noisy_within_observations(now, found.joint):
        return None
    while found is not None and found.probability < LEVEL and len(noisy) < joints - 1:
        noisy.append(found.joint - 1)
        probabilities.append(found.probability)
        others = [joint for joint in range(joints) if joint not in noisy]
        groups = [[joint] for joint in noisy] + ([] if given else [others])
        now, u = equations.estimated(groups, seat=not given)
        found = now.tests(others)
    if not noisy:
        return None
    stated = equations.variances.readings if given else np.full(joints, now.variances.readings[others[0]])
    if np.any(now.variances.readings[noisy] <= stated[noisy]):
        return None
    arm, q = record.calibrated.arm, np.asarray(record.recording.capture.readings)
    if any(term.probability < _CLEAR for term in found_terms(arm, q, now.rows, now.relations)):
        return None
    kinds = arm.geometry.kinds
    units = np.broadcast_to(one_arcsec(kinds), (joints,))
    expected, sd = np.sqrt(stated) * units, np.sqrt(now.variances.readings) * units
    noise = Noise(
        encoder_arcsec=np.sqrt(now.variances.readings),
        seating=float(record.noise.seating) if given else np.sqrt(now.variances.seat),
        linear_encoder=None if kinds is None else np.where(kinds.mask(), sd, 0.0),
    )
    each = zip(noisy, u, probabilities, strict=False)
    encoders = [NoisyEncoder(j + 1, float(expected[j]), float(sd[j]), float(sd[j] * x / 2), p) for j, x, p in each]
    return noise, tuple(sorted(encoders))


def with_noise_by_joint(result: Result, capture: Capture, again: Callable[[Noise], Result]) -> Result:
    """A result, or where it has noisy encoders that which their noise leads to.

    Args:
        result: Of `calibrate` or `identify`.
        capture: What it was found from.
        again: The same calibration with a noise that is given.
    """
    known = not inside_trace() and is_concrete(*jax.tree.leaves((result, capture)))
    if not known or not bool(result.converged) or result.implausible_residual:
        return result
    with np.errstate(all="ignore"):
        found = noise_by_joint(record_of(result, Recording(capture, ArmSpecification(result.space.base))))
    if found is None:
        return result
    noise, encoders = found
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the first calibration has said it
        weighted = again(noise)
    changes = {"noisy_encoders": encoders}
    first = result if isinstance(result, Identification) else result.stage1
    if result.given_noise is None:  # it is still one that was estimated
        same = ("noise_model", "fitted_degrees_of_freedom", "reduced_chi")
        changes |= {name: getattr(first, name) for name in same}
    if isinstance(weighted, Identification):
        return dataclasses.replace(weighted, **changes)
    return dataclasses.replace(weighted, stage1=dataclasses.replace(weighted.stage1, **changes))
