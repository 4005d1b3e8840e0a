"""Tests of a calibration's model and noise by its own residuals, each with a stated rate of false alarms.

Each of five families of tests raises a false alarm in at most `LEVEL` of the calibrations in which nothing is wrong, so
all of them together in at most 5 % (Bonferroni). Within a family, that level is divided among its tests (Holm 1979,
Scandinavian Journal of Statistics 6: the most significant one first, each at the level over the number of those left).
All of them take the parameters, the unknown geometry and the correlations between residuals into account.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..calibration.record import CalibrationRecord, record_of
from ..calibration.results import Calibration, Identification
from ..core.distributions import chi_square_tail, f_tail
from ..core.errors import InputError
from ..data.arm_classes import ArmNoise
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.recording import Recording
from ..kinematics.parameters import ArmSpecification
from .encoder_noise import NoisyJoint, noisy_joint
from .equations import EXACT, Rows, equations_in_chunks, residual_rms
from .length_consistency import Lengths, length_test
from .missing_terms import MOST_TERMS, FoundTerm, found_terms, with_terms
from .residual_tests import (
    LEVEL,
    FormTest,
    Residuals,
    block_diagonal,
    form_of_poses,
    form_test,
    pose_form_test,
)

# Of the noise of a class: its members differ by a quarter or so, which is what 8 degrees of freedom say (JCGM 100,
# G.4.2), so that only an arm whose residuals are over twice as large is outside its class.
CLASS_DEGREES_OF_FREEDOM = 8.0
_FEWEST = 6  # degrees of freedom below which residuals say nothing


class Misfit(NamedTuple):
    """Residuals against the noise that was given, or that of the arm's class."""

    ratio: float  # of the root mean square to that of the noise
    degrees_of_freedom: float
    probability: float  # of a ratio as far from 1, where the noise is right; of what is usual: as large
    usual: str = ""  # what is usual for such an arm, in words; empty where the noise was given


class NoisyObservation(NamedTuple):
    """An observation whose residuals are larger than its noise."""

    name: str
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
            estimated; by default that which the arm's file states, where the record has it.

    Returns:
        The tests; those that found something have a probability below `LEVEL`.

    Example:
        >>> tests = aj.diagnostics.model_tests(result, capture)
        >>> print(tests.warns, len(tests.terms))
        False 0
    """
    if isinstance(result, CalibrationRecord):
        record = result
    elif capture is None:
        raise InputError("the result does not hold its capture; give the capture that it was calibrated from.")
    else:
        record = record_of(result, Recording(capture, ArmSpecification(result.space.base)))
    usual = record.recording.usual if class_noise is None else ArmNoise("as given", class_noise, "")
    with np.errstate(all="ignore"):
        return _tests(record, usual)


def _tests(record: CalibrationRecord, usual: ArmNoise | None) -> ModelTests:
    rows, relations = equations_in_chunks(record)
    if not rows:
        return ModelTests()
    left = Residuals.of([*(each.block("") for each in rows), *relations])
    if left.degrees_of_freedom < _FEWEST:
        return ModelTests()
    lengths = length_test(record, rows, relations, left.degrees_of_freedom)
    if residual_rms(rows) < EXACT:
        return ModelTests(lengths=lengths)
    arm, q = record.calibrated.arm, np.asarray(record.recording.capture.readings)
    terms = found_terms(arm, q, rows, relations)
    if weighted_by_loss(record):  # a robust loss makes residuals smaller, and less scattered, than the noise
        return ModelTests(lengths=lengths, terms=terms)
    of_all, others = with_terms(rows, relations, terms, arm.joints)
    explained = Residuals.of([*(each.block("") for each in of_all), *others]) if terms else left
    return ModelTests(
        misfit=_misfit(record, left, usual),
        lengths=lengths,
        noisy_observations=_noisy_observations(record, rows, left),
        terms=terms,
        # Where even these terms do not explain the residuals, what they miss looks like noise.
        noisy_joint=None if len(terms) == MOST_TERMS else noisy_joint(record, of_all, others),
        successive=_successive(rows, explained),
    )


def weighted_by_loss(record: CalibrationRecord) -> bool:
    """Whether a robust loss took weight from poses, so that residuals are smaller than the noise."""
    return any(bool(np.any(np.asarray(weights) < 1)) for weights in record.observed.weights)


def _misfit(record: CalibrationRecord, left: Residuals, usual: ArmNoise | None) -> Misfit | None:
    given = record.given_noise
    if given is not None:
        spare = left.degrees_of_freedom
        upper = chi_square_tail(left.cost, spare)
        return Misfit(float(np.sqrt(left.cost / spare)), spare, min(2 * min(upper, 1 - upper), 1.0))
    if usual is None:
        return None
    rows, relations = equations_in_chunks(record._replace(noise=usual.noise))
    left = Residuals.of([*(each.block("") for each in rows), *relations])
    spare, ratio = left.degrees_of_freedom, left.cost / left.degrees_of_freedom
    return Misfit(
        float(np.sqrt(ratio)), spare, f_tail(ratio, spare, CLASS_DEGREES_OF_FREEDOM), usual.source or usual.arm_class
    )


def _noisy_observations(
    record: CalibrationRecord, rows: Sequence[Rows], left: Residuals
) -> tuple[NoisyObservation, ...]:
    """Those of a calibration with other observations than sockets."""
    names = list(dict.fromkeys(each.name for each in rows))
    if not record.recording.capture.observations or (len(names) < 2 and record.given_noise is None):
        return ()
    tests = []
    for name in names:
        sizes = [each.residual.shape if each.name == name else None for each in rows]
        kernels = [None if size is None else np.broadcast_to(np.eye(size[1]), (*size, size[1])) for size in sizes]
        none = [None] * (len(left.slices) - len(kernels))
        tests.append((pose_form_test(left, [*kernels, *none], record.given_noise is None), name))
    found, tests = [], sorted(tests, key=lambda pair: pair[0].probability)
    for number, (test, name) in enumerate(tests):
        probability = min(test.probability * (len(tests) - number), 1.0)
        if probability >= LEVEL:
            break
        found.append(NoisyObservation(name, test, probability))
    return tuple(found)


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
