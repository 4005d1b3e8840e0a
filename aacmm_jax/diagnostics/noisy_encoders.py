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

import numpy as np
from jaxtyping import Float

from ..calibration.record import CalibrationRecord
from ..calibration.results import Calibration, Identification, NoisyEncoder
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..core.text import shorten
from ..data.noise import Noise, one_arcsec
from .culprits import MOST_CAUSES, culprits_of, explained, is_clear
from .equations import Block, Rows
from .findings import Case, Finding, by_equations, chance_text, look_for_play, reading_text
from .residual_tests import SURE, Residuals, chance_above_zero

ORDER, NEEDS = 40, "scale"
_ROUNDS = 50  # of Fisher scoring; usually 4 to 8
_TOLERANCE = 1e-3  # of a log variance: a hundredth of its standard uncertainty
_FACTOR = 1.5  # largest change of a log variance in one round
_LEAST = 1e-6  # part of the residuals that a variance explains, below which it is 0
_CLEAR = 1e-4  # probability of another cause, below which that is wrong rather than the noise
_FEWEST = 20  # degrees of freedom below which no variance is estimated by joint
_FAR_MORE = 100.0  # ratio of noise beyond which the number has no meaning

Result = TypeVar("Result", Calibration, Identification)


def test(case: Case) -> list[Finding]:
    """Encoders whose noise was replaced, and one that seems noisier than it was taken to be."""
    record, findings, texts = case.record, [], []
    slides, given = record.calibrated.arm.prismatic, record.given_noise is not None
    others, kept = (
        ("given", "keeps the given noise")
        if given
        else ("those of the other joints", "keeps one noise for all encoders")
    )
    for encoder in record.noisy_encoders:
        # Of the others nothing may be left beside the noise of the tip, and what is given may be 0.
        comparable = encoder.found < _FAR_MORE * encoder.expected
        times = f"{encoder.found / encoder.expected:.2g} times as much as" if comparable else "far more than"
        scatter, u = (reading_text(value, encoder.joint in slides) for value in (encoder.found, encoder.u))
        texts.append(
            f"joint {encoder.joint} scatter by {scatter} (u = {u.split(' ')[0]}), {times} {others} "
            f"({chance_text(encoder.probability)})"
        )
    if texts:
        findings.append(
            Finding(
                "noisy-encoders-replaced",
                f"Readings of {shorten(texts, 3)}.",
                "The noise of these encoders was re-estimated; weights and uncertainties use the estimate "
                f"(--keep-noise {kept}).",
                "Check the encoder, and look for play in the joint.",
                probability=max(encoder.probability for encoder in record.noisy_encoders),
                concerns=tuple(f"joint {encoder.joint}" for encoder in record.noisy_encoders),
            )
        )
    noisiest = None if record.implausible_residual else case.once(noisiest_joint)
    said = any(culprit.kind == "noisy joint" for culprit in culprits_of(case))
    if noisiest is not None and noisiest.probability < SURE and not said:
        findings.append(
            Finding(
                "noisy-encoder",
                f"Residuals are larger where the reading of joint {noisiest.joint} moves the tip more "
                f"({chance_text(noisiest.probability)}), as if the encoder of this joint were noisier than the "
                "others.",
                advice=look_for_play(case),
                severity="doubt",
                probability=noisiest.probability,
                concerns=(f"joint {noisiest.joint}",),
            )
        )
    return findings


class NoisyJoint(NamedTuple):
    """The joint whose readings seem noisier than those of the others."""

    joint: int
    ratio: float  # of the squares that its column sees, to what the residuals as a whole let expect
    probability: float


class _Equations(NamedTuple):
    """Equations whose rows are whitened by some variances."""

    rows: Sequence[Rows]
    relations: Sequence[Block]
    unit: Float[np.ndarray, " n"]  # of the readings' columns, for a standard deviation of 1 arcsec
    # Of the readings, arcsec^2 (of a prismatic joint, of what this is at 1 m), and of the seat, mm^2.
    variances: Float[np.ndarray, " n+1"]

    @classmethod
    def of(cls, record: CalibrationRecord, rows: Sequence[Rows], relations: Sequence[Block]) -> "_Equations":
        kinds, joints = record.calibrated.arm.geometry.kinds, record.calibrated.arm.joints
        unit = np.broadcast_to(one_arcsec(kinds), (joints,))
        steps = np.where(np.zeros(joints, dtype=bool) if kinds is None else kinds.mask(), 1.0, 1e-3)
        stated = np.broadcast_to(to_numpy(record.noise.of_readings(kinds)), (joints,)) / unit
        return cls(rows, relations, unit / steps, np.append(stated, float(record.noise.seating)) ** 2)

    def left(self) -> Residuals:
        return Residuals.of([*(rows.block("") for rows in self.rows), *self.relations])

    def columns(self, rows: Rows, group: Sequence[int]) -> Float[np.ndarray, "m r _"]:
        """The z_j of a variance that some joints have in common, or T, whose number is that of the joints."""
        joints = len(self.unit)
        return rows.by_tip if joints in group else (rows.extra[..., :joints] * self.unit)[..., list(group)]

    def poses(self, left: Residuals) -> list[tuple[Rows, Float[np.ndarray, "m r"], Float[np.ndarray, "m r r"]]]:
        """The rows of each part, their residuals, and the blocks of M that belong to single poses."""
        parts = []
        for rows, part, private in zip(self.rows, left.slices, left.private, strict=False):
            explained = np.concatenate([private, left.basis[part]], axis=1).reshape(*rows.residual.shape, -1)
            block = np.eye(explained.shape[1]) - explained @ explained.swapaxes(1, 2)
            parts.append((rows, left.values[part].reshape(rows.residual.shape), block))
        return parts

    def moments(
        self, left: Residuals, groups: Sequence[Sequence[int]]
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """r'K r, tr MK and tr MKML of the K of some groups, by the blocks of single poses."""
        count = len(groups)
        values, traces, products = np.zeros(count), np.zeros(count), np.zeros((count, count))
        for rows, r, block in self.poses(left):
            columns = [self.columns(rows, group) for group in groups]
            projected = [block @ column for column in columns]
            for k, column in enumerate(columns):
                values[k] += float(np.sum(np.einsum("mac,ma->mc", column, r) ** 2))
                traces[k] += float(np.sum(column * projected[k]))
                for other in range(count):
                    products[k, other] += float(np.sum((column.swapaxes(1, 2) @ projected[other]) ** 2))
        return values, traces, products

    def weighted(self, groups: Sequence[Sequence[int]], variances: Float[np.ndarray, " k"]) -> "_Equations":
        """The same rows, whitened by other variances of some groups."""
        weighted, new = [], self.variances.copy()
        for group, variance in zip(groups, variances, strict=True):
            new[list(group)] = variance
        more, every = new - self.variances, range(len(self.unit))
        for rows in self.rows:
            z, t = self.columns(rows, every), rows.by_tip
            covariance = (z * more[:-1]) @ z.swapaxes(1, 2) + more[-1] * t @ t.swapaxes(1, 2)
            # Some noise of its own: where nothing else errs, poses with fewer than three errors would be singular.
            covariance += (1 + 1e-9) * np.eye(z.shape[1])
            weighted.append(rows.whitened(covariance))
        return self._replace(rows=weighted, variances=new)

    def estimated(self, groups: Sequence[Sequence[int]]) -> tuple["_Equations", Float[np.ndarray, " k"]]:
        """With one variance for each group of joints, the seat being the last group, by restricted maximum likelihood;
        and the standard uncertainty of the log of each variance."""
        now, u = self, np.zeros(len(groups))
        log = np.array([np.log(max(np.mean(self.variances[list(group)]), 1e-6)) for group in groups])
        if len(self.unit) in groups[-1]:  # from nothing it would not rise
            left = self.left()
            trace = self.moments(left, groups[-1:])[1][0]
            log[-1] = np.log(max(self.variances[-1], 0.05 * left.degrees_of_freedom / max(trace, 1e-300)))
            now = self.weighted(groups, np.exp(log))
        for _ in range(_ROUNDS):
            left, variances = now.left(), np.exp(log)
            values, traces, products = now.moments(left, groups)
            # By the logarithms: d/d(log v) = v d/dv.
            slope = 0.5 * (values - traces) * variances
            information = 0.5 * products * variances * variances[:, None]
            u = np.sqrt(np.diag(np.linalg.pinv(information)))
            # One that explains nothing, and would have to be negative, stays where it is.
            moving = (variances * traces > _LEAST * left.degrees_of_freedom) | (slope > 0)
            step = np.zeros(len(log))
            damped = information[np.ix_(moving, moving)] + 1e-9 * np.eye(int(moving.sum()))
            step[moving] = np.clip(np.linalg.solve(damped, slope[moving]), -_FACTOR, _FACTOR)
            log = log + step
            now = self.weighted(groups, np.exp(log))
            if np.max(np.abs(step), initial=0.0) < _TOLERANCE:
                break
        return now, u

    def noisiest(self, joints: Sequence[int]) -> NoisyJoint | None:
        """The joint (from 0) of some whose readings are the noisiest; its probability is Holm's, of all."""
        left = self.left()
        values, traces, products = self.moments(left, [*([joint] for joint in joints), [len(self.unit)]])
        poses, tests = self.poses(left), []
        # Rows of priors, which may be far wider than what they say, are not what the others are compared with.
        cost = max(float(sum(np.sum(r**2) for _, r, _ in poses)), 1e-300)
        freedom = float(sum(np.sum(np.einsum("maa->m", block)) for *_, block in poses))
        below = freedom * products[-1, -1] - traces[-1] ** 2
        seated = self.variances[-1] * traces[-1] > _LEAST * freedom and below > 1e-9 * traces[-1] ** 2
        for k, joint in enumerate(joints):
            if traces[k] <= 0:
                continue
            ratio = values[k] * freedom / max(traces[k] * cost, 1e-300)
            c = (freedom * products[k, -1] - traces[k] * traces[-1]) / below if seated else 0.0
            x, kernels = (values[k] - c * values[-1]) / cost, []
            for rows in self.rows:
                z, t = self.columns(rows, [joint]), rows.by_tip
                kernels.append(z @ z.swapaxes(1, 2) - c * (t @ t.swapaxes(1, 2)) - x * np.eye(z.shape[1]))
            tests.append(NoisyJoint(joint + 1, ratio, chance_above_zero(left, kernels)))
        if not tests:
            return None
        worst = min(tests, key=lambda test: (test.probability, -test.ratio))
        return worst._replace(probability=min(worst.probability * len(tests), 1.0))


def noisiest_joint(case: Case) -> NoisyJoint | None:
    """The joint in whose direction residuals are larger than in those of the others, with the terms that the model
    lacks taken into account; where even these do not explain the residuals, what they miss looks like noise."""
    causes = culprits_of(case)
    for culprit in causes:
        if culprit.kind == "noisy joint":
            return NoisyJoint(int(culprit.name.split()[1]), culprit.size, culprit.probability)
    if not case.shows_noise or len(causes) >= MOST_CAUSES:
        return None
    if not causes:
        return case.once(_without_terms)[0]
    return _noisiest(case.record, _Equations.of(case.record, *case.once(explained)))[0]


@by_equations
def _without_terms(case: Case) -> tuple[NoisyJoint | None, _Equations]:
    """The joint by the equations of the calibration as they are, and these as the test weighted them."""
    return _noisiest(case.record, _Equations.of(case.record, *case.chunks))


def _noisiest(record: CalibrationRecord, equations: _Equations) -> tuple[NoisyJoint | None, _Equations]:
    """The joint, and the equations as the test weighted them."""
    joints = range(len(equations.unit))
    noisiest = equations.noisiest(joints)
    if noisiest is None or noisiest.probability >= SURE or record.given_noise is not None:
        return noisiest, equations
    # The noise of the calibration comes from two moments; its seat is often 0, and then poses whose tip encoders move
    # little in some direction count too much there.
    equations, _ = equations.estimated([joints, [len(joints)]])
    return equations.noisiest(joints), equations


def noise_by_joint(case: Case) -> tuple[Noise, tuple[NoisyEncoder, ...]] | None:
    """The noise of a calibration with that of noisy encoders as the residuals show it; None where there are none.

    The noise of all others stays as it is stated; where nothing is stated, it is estimated anew without them. Where a
    term is clearly missing all the same, the model is what is wrong, and the noise stays.
    """
    record = case.record
    if not case.scatters or case.left.degrees_of_freedom < _FEWEST:
        return None
    noisiest, now = case.once(_without_terms)
    if noisiest is None or noisiest.probability >= SURE:
        return None
    equations = _Equations.of(record, *case.chunks)
    given, joints = record.given_noise is not None, len(equations.unit)
    # A zero that is off in some observations, as after a slip, moves all of their poses alike: these contradict the
    # others, and that is what has to be said. So the joint must be noisy where its zero may differ between them.
    j = noisiest.joint - 1
    loose = [part._replace(private=np.concatenate([part.private, part.extra[..., [j]]], axis=2)) for part in now.rows]
    within = now._replace(rows=loose).noisiest([j])
    if within is None or within.probability >= SURE or is_clear(case, _CLEAR):
        return None
    noisy, u, others = [], np.zeros(0), list(range(joints))
    while noisiest is not None and noisiest.probability < SURE and len(noisy) < joints - 1:
        noisy.append(noisiest)
        others.remove(noisiest.joint - 1)
        groups = [[test.joint - 1] for test in noisy] + ([] if given else [others, [joints]])
        now, u = equations.estimated(groups)
        noisiest = now.noisiest(others)
    variances, index = now.variances[:-1], [test.joint - 1 for test in noisy]
    stated = equations.variances[:-1] if given else np.full(joints, variances[others[0]])
    if np.any(variances[index] <= stated[index]):
        return None
    kinds = record.calibrated.arm.geometry.kinds
    units = np.broadcast_to(one_arcsec(kinds), (joints,))
    expected, sd = np.sqrt(stated) * units, np.sqrt(variances) * units
    noise = Noise(
        encoder_arcsec=np.sqrt(variances),
        seating=float(record.noise.seating) if given else np.sqrt(now.variances[-1]),
        linear_encoder=None if kinds is None else np.where(kinds.mask(), sd, 0.0),
    )
    try:
        noise.check(joints)
    except (
        InputError
    ):  # more than any encoder has: poses in which the joint moves the tip little do not determine its noise
        return None
    encoders = []
    for test, i, u_log in zip(noisy, index, u, strict=False):
        # u of a standard deviation is half of it times u of its log variance.
        encoders.append(
            NoisyEncoder(test.joint, float(expected[i]), float(sd[i]), float(sd[i] * u_log / 2), test.probability)
        )
    return noise, tuple(sorted(encoders))


def amend(result: Result, case: Case, again: Callable[[Noise], Result]) -> Result:
    """A result, or where it has noisy encoders that which their noise leads to; ``again`` calibrates likewise with a
    noise that is given."""
    replaced = case.once(noise_by_joint)
    if replaced is None:
        return result
    noise, encoders = replaced
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the first calibration has said it
        try:
            weighted = again(noise)
        except InputError:  # more noise than any arm has: the data do not match the arm, and that is what is wrong
            return result
    changes = {"noisy_encoders": encoders}
    if result.given_noise is None:  # it is still one that was estimated
        first = result if isinstance(result, Identification) else result.stage1
        same = ("noise_model", "fitted_degrees_of_freedom", "reduced_chi")
        changes |= {name: getattr(first, name) for name in same}
    if isinstance(weighted, Identification):
        return dataclasses.replace(weighted, **changes)
    return dataclasses.replace(weighted, stage1=dataclasses.replace(weighted.stage1, **changes))
