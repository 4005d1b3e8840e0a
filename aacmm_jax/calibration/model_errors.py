"""Tests of a calibration's model and noise by its own residuals, each with a stated rate of false alarms.

Each of five families of tests raises a false alarm in at most `LEVEL` of the calibrations in which nothing is wrong, so
all of them together in at most 5 % (Bonferroni). Within a family, that level is divided among its tests (Holm 1979,
Scandinavian Journal of Statistics 6: the most significant one first, each at the level over the number of those left).
All of them take the parameters, the unknown geometry and the correlations between residuals into account.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.distributions import chi_square_tail, f_tail
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.recording import Recording
from ..kinematics.parameters import ArmSpecification
from ..uncertainty.group_test import Block
from ..uncertainty.residual_tests import Form, FormTest, Residuals, ScoreTest, form_test, score_tests
from .group_equations import Rows, equations_of
from .length_consistency import Lengths, length_test
from .missing_terms import Kind, MissingTerm, columns_of, missing_terms
from .record import CalibrationRecord, record_of
from .results import Calibration, Identification

LEVEL = 0.01
# Of the noise of a class: its members differ by a quarter or so, which is what 8 degrees of freedom say (JCGM 100,
# G.4.2), so that only an arm whose residuals are over twice as large is outside its class.
CLASS_DEGREES_OF_FREEDOM = 8.0
_MOST_TERMS = 6  # that are looked for one after the other
_AS_WELL = 6.0  # difference of the information criterion (Akaike 1974) below which another term explains as much
_FEWEST = 6  # degrees of freedom below which residuals say nothing
_MOST_POSES = 2000  # that are looked at: more would only find errors that do not matter
_CHUNK = 100  # poses of one observation that are kept together
_EXACT = 1e-6  # mm: smaller residuals are rounding errors of a simulation without noise


class Misfit(NamedTuple):
    """Residuals against the noise that was given, or that of the arm's class."""

    ratio: float  # of the root mean square to that of the noise
    degrees_of_freedom: float
    probability: float  # of a ratio as far from 1, where the noise is right; of the class: as large
    of_class: bool


class NoisyObservation(NamedTuple):
    """An observation whose residuals are larger than its noise."""

    name: str
    test: FormTest
    probability: float


class FoundTerm(NamedTuple):
    """A term that explains residuals, and what explains them as well."""

    kind: Kind
    joint: int | None
    test: ScoreTest
    probability: float  # Holm's: of all candidates
    amplitude: float  # half the range of what the term adds over the poses, rad or mm; of a gear ratio, relative
    alternatives: tuple[tuple[Kind, int | None], ...]


class NoisyJoint(NamedTuple):
    """The joint whose readings seem noisier than those of the others."""

    joint: int
    test: FormTest
    probability: float


class Successive(NamedTuple):
    """Whether residuals of successive poses of one socket or observation are alike."""

    correlation: float
    probability: float


class ModelTests(NamedTuple):
    """All tests of one calibration; None and nothing where there is too little to test.

    Each has its ``probability`` where nothing is wrong, already that of its whole family; below `LEVEL` it is a
    warning.
    """

    misfit: Misfit | None = None
    lengths: Lengths | None = None
    noisy_observations: tuple[NoisyObservation, ...] = ()  # those that are too noisy
    terms: tuple[FoundTerm, ...] = ()  # those that were found, the most important first
    noisy_joint: NoisyJoint | None = None
    successive: Successive | None = None

    @property
    def warns(self) -> bool:
        """Whether something is wrong."""
        probabilities = [
            one.probability for one in (self.misfit, self.lengths, self.noisy_joint, self.successive) if one
        ]
        return bool(self.terms or self.noisy_observations or any(p < LEVEL for p in probabilities))


def model_tests(
    result: Calibration | Identification | CalibrationRecord,
    capture: Capture | None = None,
    *,
    class_noise: Noise | None = None,
) -> ModelTests:
    """Test model and noise of a calibration by its residuals. It takes some milliseconds.

    Args:
        result: What `calibrate` or `identify` returned, or the record of a calibration.
        capture: What it was calibrated from; not with a record, which holds it.
        class_noise: Noise of encoders and seat that is usual for this class of arms, for a calibration whose noise was
            estimated.

    Returns:
        The tests; those that found something have a probability below `LEVEL`.
    """
    if isinstance(result, CalibrationRecord):
        record = result
    elif capture is None:
        raise InputError("the result does not hold its capture; give the capture that it was calibrated from.")
    else:
        record = record_of(result, Recording(capture, ArmSpecification(result.space.base)))
    with np.errstate(all="ignore"):
        return _tests(record, class_noise)


def _tests(record: CalibrationRecord, class_noise: Noise | None) -> ModelTests:
    rows, relations = limited_equations(record)
    if not rows:
        return ModelTests()
    left = Residuals.of([*(each.block("") for each in rows), *relations])
    if left.degrees_of_freedom < _FEWEST:
        return ModelTests()
    lengths = length_test(record, rows, relations, left.degrees_of_freedom)
    if _rms(rows) < _EXACT:
        return ModelTests(lengths=lengths)
    terms, explained = _terms(record, rows, left)
    if weighted_by_loss(record):  # a robust loss makes residuals smaller, and less scattered, than the noise
        return ModelTests(lengths=lengths, terms=terms)
    return ModelTests(
        misfit=_misfit(record, left, class_noise),
        lengths=lengths,
        noisy_observations=_noisy_observations(record, rows, left),
        terms=terms,
        # Where even these terms do not explain the residuals, what they miss looks like noise.
        noisy_joint=None if len(terms) == _MOST_TERMS else _noisy_joint(record.calibrated.arm.joints, rows, explained),
        successive=_successive(rows, explained),
    )


def weighted_by_loss(record: CalibrationRecord) -> bool:
    """Whether a robust loss took weight from poses, so that residuals are smaller than the noise."""
    observed = record.observed
    return observed is not None and any(bool(np.any(np.asarray(weights) < 1)) for weights in observed.weights)


def limited_equations(record: CalibrationRecord) -> tuple[list[Rows], list[Block]]:
    """The equations of poses in chunks, or of very many an even choice of these, and those of relations.

    Unknowns of an observation that is divided become shared ones.
    """
    equations = equations_of(record)
    divided = [each for each in equations.rows if len(each.poses) > _CHUNK]
    added = sum(each.own.shape[2] for each in divided)
    chunks, position = [], 0
    for each in equations.rows:
        shared = np.pad(each.shared, ((0, 0), (0, 0), (0, added)))
        if len(each.poses) <= _CHUNK:
            chunks.append(each._replace(shared=shared))
            continue
        width = each.own.shape[2]
        shared[..., each.shared.shape[2] + position :][..., :width] = each.own
        position += width
        whole = each._replace(shared=shared, own=each.own[..., :0])
        for start in range(0, len(each.poses), _CHUNK):
            of = slice(start, start + _CHUNK)
            chunks.append(whole._replace(**{name: getattr(whole, name)[of] for name in Rows._fields if name != "name"}))
    step = -(-sum(len(each.poses) for each in chunks) // _MOST_POSES)
    wider = ((0, 0), (0, added))
    relations = [block._replace(shared=np.pad(block.shared, wider)) for block in equations.relations]
    return chunks[:: max(step, 1)], relations


def _rms(rows: Sequence[Rows]) -> float:
    squares = [np.sum(np.einsum("mcr,mr->mc", each.in_mm, each.residual) ** 2, axis=1) for each in rows]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _misfit(record: CalibrationRecord, left: Residuals, class_noise: Noise | None) -> Misfit | None:
    given = record.given_noise
    if given is not None:
        spare = left.degrees_of_freedom
        upper = chi_square_tail(left.cost, spare)
        return Misfit(float(np.sqrt(left.cost / spare)), spare, min(2 * min(upper, 1 - upper), 1.0), False)
    if class_noise is None:
        return None
    rows, relations = limited_equations(record._replace(noise=class_noise))
    left = Residuals.of([*(each.block("") for each in rows), *relations])
    spare, ratio = left.degrees_of_freedom, left.cost / left.degrees_of_freedom
    return Misfit(float(np.sqrt(ratio)), spare, f_tail(ratio, spare, CLASS_DEGREES_OF_FREEDOM), True)


def _noisy_observations(
    record: CalibrationRecord, rows: Sequence[Rows], left: Residuals
) -> tuple[NoisyObservation, ...]:
    """Those of a calibration with other observations than sockets."""
    names = list(dict.fromkeys(each.name for each in rows))
    if not record.recording.capture.observations or (len(names) < 2 and record.given_noise is None):
        return ()
    tests = []
    for name in names:
        columns = [np.eye(each.residual.size) if each.name == name else None for each in rows]
        tests.append((form_test(left, form_of_poses(left, columns), record.given_noise is None), name))
    found, tests = [], sorted(tests, key=lambda pair: pair[0].probability)
    for number, (test, name) in enumerate(tests):
        probability = min(test.probability * (len(tests) - number), 1.0)
        if probability >= LEVEL:
            break
        found.append(NoisyObservation(name, test, probability))
    return tuple(found)


def form_of_poses(
    left: Residuals, columns: Sequence[np.ndarray | None], kernel: Sequence[np.ndarray | None] | None = None
) -> Form:
    """A form of the rows of poses; relations, which come last, have no part in it."""
    none = (None,) * (len(left.slices) - len(columns))
    kernel = (None,) * len(columns) if kernel is None else kernel
    return Form((*columns, *none), (*kernel, *none))


def _terms(record: CalibrationRecord, rows: Sequence[Rows], left: Residuals) -> tuple[tuple[FoundTerm, ...], Residuals]:
    """Terms that the model lacks, the one that explains most first; and the residuals with them in the model."""
    arm, q = to_numpy((record.calibrated.arm, record.recording.capture.readings))
    candidates = missing_terms(arm, np.asarray(q))
    relations = left.slices[-1].stop - left.slices[len(rows) - 1].stop
    columns = [np.pad(each, ((0, relations), (0, 0))) for each in columns_of(candidates, rows, arm.joints)]
    chosen: list[tuple[int, ScoreTest, float, list[int]]] = []
    explained = left
    for _ in range(_MOST_TERMS):
        tests = score_tests(explained, columns)
        number = sum(test.degrees_of_freedom[0] > 0 for test in tests)
        significant = [i for i, test in enumerate(tests) if test.probability * number < LEVEL]
        if not significant:
            break
        criterion = [_criterion(explained, test) for test in tests]
        best = min(significant, key=lambda i: criterion[i])
        others = [i for i in significant if i != best and criterion[i] < criterion[best] + _AS_WELL]
        others.sort(key=lambda i: criterion[i])
        chosen.append((best, tests[best], min(tests[best].probability * number, 1.0), others))
        explained = explained.extended(columns[best])
    if not chosen:
        return (), left
    (together,) = score_tests(left, [np.concatenate([columns[i] for i, *_ in chosen], axis=1)])
    coefficients = np.split(together.coefficients, np.cumsum([columns[i].shape[1] for i, *_ in chosen])[:-1])
    return tuple(
        FoundTerm(
            *(candidates[i].kind, candidates[i].joint, test, probability),
            amplitude=_amplitude(candidates[i], own),
            alternatives=tuple((candidates[j].kind, candidates[j].joint) for j in others),
        )
        for (i, test, probability, others), own in zip(chosen, coefficients, strict=True)
    ), explained


def _criterion(left: Residuals, test: ScoreTest) -> float:
    """Akaike's, less what is common to all."""
    rows, (added, _) = len(left.values), test.degrees_of_freedom
    return rows * float(np.log(max(left.cost - test.gain, 1e-300) / left.cost)) + 2 * added if added else np.inf


def _amplitude(term: MissingTerm, coefficients: Float[np.ndarray, " k"]) -> float:
    if term.kind in ("gear ratio", "zero"):
        return float(abs(coefficients[0])) * 1e-3
    added = term.values @ coefficients
    half = float(np.linalg.norm(np.ptp(added.reshape(len(added), -1), axis=0))) / 2
    return half if term.joint is None else half * 1e-3


def _noisy_joint(joints: int, rows: Sequence[Rows], left: Residuals) -> NoisyJoint | None:
    """The joint in whose direction residuals are larger than in those of the others (a score test of its variance)."""
    tests = []
    for joint in range(joints):
        columns = [block_diagonal(each.extra[..., joint, None]) for each in rows]
        tests.append((form_test(left, form_of_poses(left, columns), relative=True), joint + 1))
    known = [(test, joint) for test, joint in tests if np.isfinite(test.ratio)]
    if not known:
        return None
    test, joint = min(known, key=lambda pair: pair[0].probability)
    return NoisyJoint(joint, test, min(test.probability * len(known), 1.0))


def block_diagonal(columns: Float[np.ndarray, "m r c"]) -> Float[np.ndarray, "R C"]:
    """Columns of single poses, 0 in the rows of all others."""
    poses, size, width = columns.shape
    found = np.zeros((poses, size, poses, width))
    found[np.arange(poses), :, np.arange(poses)] = columns
    return found.reshape(poses * size, poses * width)


def _successive(rows: Sequence[Rows], left: Residuals) -> Successive | None:
    """Errors of the tip that successive poses of one observation share (a score test of their covariance)."""
    columns = [block_diagonal(each.by_tip) for each in rows]
    kernel = [np.kron(np.eye(len(each.poses), k=1) + np.eye(len(each.poses), k=-1), np.eye(3)) / 2 for each in rows]
    if not any(np.any(matrix) for matrix in kernel):
        return None
    test = form_test(left, form_of_poses(left, columns, kernel), relative=True)
    product = total = 0.0
    for each, of in zip(rows, left.slices, strict=False):
        tips = np.einsum("mrc,mr->mc", each.by_tip, left.values[of].reshape(each.residual.shape))
        product += float(np.sum(tips[1:] * tips[:-1]))
        total += float(np.sum(tips[1:] ** 2) + np.sum(tips[:-1] ** 2)) / 2
    return Successive(product / total if total else 0.0, test.probability)
