"""Tests of a calibration's model and noise by its own residuals: their size, by observation, and pose after pose.

Each of the five families of tests of model and noise (`missing_terms`, `noisy_encoders`,
`scale`, and two here) raises a false alarm in at most `LEVEL` of the calibrations in which nothing
is wrong, so all of them together in at most 5 % (Bonferroni). Within a family, that level is divided among its tests
(Holm 1979, Scandinavian Journal of Statistics 6: the most significant one first, each at the level over the number of
those left). All of them take the parameters, the unknown geometry and the correlations between residuals into account.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from ..calibration.record import CalibrationRecord
from ..calibration.results import Calibration, Identification
from ..core.distributions import chi_square_tail, f_tail
from ..core.text import shorten
from ..core.units import ARCSEC
from ..data.capture import Capture
from ..data.noise import Noise
from ..uncertainty.shared_kinds import SUCCESSIVE, VISITS
from .culprits import culprits_of, explained, missing, selection
from .findings import Case, Finding, case_of, chance_text
from .missing_terms import FoundTerm
from .noisy_encoders import NoisyJoint, noisiest_joint
from .residual_tests import LEVEL, SURE, Residuals, alike, form_test, in_succession
from .scale import Lengths, lengths_of

ORDER, NEEDS = 62, "fit"
# Of the noise of a class: its members differ by a quarter or so, which is what 8 degrees of freedom say (JCGM 100,
# G.4.2), so that only an arm whose residuals are over twice as large is outside its class.
CLASS_DEGREES_OF_FREEDOM = 8.0


class Misfit(NamedTuple):
    """Residuals against the noise that was given, or that of the arm's class."""

    ratio: float  # of the root mean square to that of the noise
    degrees_of_freedom: float
    probability: float  # of a ratio as far from 1, where the noise is right; of what is usual: as large
    usual: str = ""  # what is usual for such an arm, in words; empty where the noise was given


class NoisyObservation(NamedTuple):
    """An observation whose residuals are larger than its noise."""

    name: str
    ratio: float  # of the sum of their squares to its expectation
    probability: float


class Successive(NamedTuple):
    """Whether residuals of successive poses of one socket or observation are alike."""

    correlation: float
    probability: float


def test(case: Case) -> list[Finding]:
    """Of all residuals together, of single observations, and of successive poses."""
    findings, misfit, successive = [], case.once(unexplained_misfit), case.once(successive_of)
    if misfit is not None and misfit.probability < LEVEL:
        findings.append(_misfit(misfit))
    if successive is not None and successive.probability < LEVEL:
        what = "seat" if case.record.recording.capture.sizes else "target, instrument or artefact"
        shared = set() if case.record.shared is None else set(case.record.shared.kinds)
        findings.append(
            Finding(
                "successive-poses",
                f"Residuals of successive poses are autocorrelated (correlation {successive.correlation:.2f}, "
                f"{chance_text(successive.probability)}): either the {what} shifts at each visit, or there "
                "are errors that the model does not describe.",
                "The stated uncertainties include the shared errors of successive poses, as estimated from the "
                "residuals."
                if shared & {VISITS, SUCCESSIVE}
                else (
                    "The calibration treats successive poses as independent, so every stated uncertainty is too small."
                ),
                severity="doubt",
                probability=successive.probability,
            )
        )
    said = {culprit.name for culprit in culprits_of(case) if culprit.kind == "scatter"}
    noisy = [part for part in case.once(noisy_observations) if part.name not in said]
    if noisy:
        texts = [f"{part.name} ({math.sqrt(max(part.ratio, 0)):.2g} times)" for part in noisy]
        findings.append(
            Finding(
                "noisy-observations",
                f"Residuals are larger than the uncertainties and the scatter of the tips predict: {shorten(texts)}.",
                advice="Check these observations and their stated standard uncertainties.",
                severity="doubt",
                probability=max(part.probability for part in noisy),
                concerns=tuple(part.name for part in noisy),
            )
        )
    return findings


def _misfit(misfit: Misfit) -> Finding:
    chance, small = chance_text(misfit.probability), misfit.ratio > 1
    if misfit.usual:
        return Finding(
            "residuals-unusual",
            f"Residuals are {misfit.ratio:.2g} times as large as is usual for such an arm ({misfit.usual}; "
            f"{chance}): either there are errors that the model does not describe, or the encoders are worse than "
            "usual.",
            severity="doubt",
            probability=misfit.probability,
        )
    return Finding(
        "residuals-not-as-given",
        f"Residuals are {misfit.ratio:.3g} times as large as the given noise predicts ({chance}).",
        "All uncertainties are computed from the given noise. Either all uncertainties are about "
        f"{max(misfit.ratio, 1 / misfit.ratio):.3g} times too {'small' if small else 'large'}, or the model lacks an "
        "effect.",
        "Check the given noise, or omit it; the noise is then estimated.",
        severity="doubt" if small else "note",  # noise given too large makes every uncertainty too large
        probability=misfit.probability,
    )


def unexplained_misfit(case: Case) -> Misfit | None:
    """The same of what remains without the causes that are named, and with encoders as noisy as they proved."""
    if not culprits_of(case) and not case.record.noisy_encoders:
        return case.once(misfit_of)
    return misfit_of(case, case.once(selection).remaining)


def _usual_with_noisy(case: Case, usual: Noise) -> Noise:
    """The noise of a class, with that of the encoders whose noise was replaced."""
    encoder, slides = np.zeros(case.record.calibrated.arm.joints), case.record.calibrated.arm.prismatic
    for noisy in case.record.noisy_encoders:
        if noisy.joint not in slides:
            encoder[noisy.joint - 1] = noisy.found / ARCSEC
    arcsec = np.maximum(encoder, np.asarray(usual.encoder_arcsec))
    linear = usual.linear_encoder
    return Noise(encoder_arcsec=arcsec, seating=usual.seating, linear_encoder=linear)


def misfit_of(case: Case, remaining: float | None = None) -> Misfit | None:
    """Residuals against the noise that was given, or that of the arm's class; None where neither is known.

    ``remaining`` is the part of their squares that no named cause explains, where that is to be tested.
    """
    usual, given = case.usual, case.record.given_noise is not None
    if not case.shows_noise or not (given or usual is not None):
        return None
    left = case.left
    if usual is not None and not given:
        noise = usual.noise if remaining is None else _usual_with_noisy(case, usual.noise)
        left = Case(case.record._replace(noise=noise)).left
    cost, freedom = left.cost * (1.0 if remaining is None else remaining), left.degrees_of_freedom
    ratio = cost / freedom
    if usual is None or given:
        upper = chi_square_tail(cost, freedom)
        return Misfit(float(np.sqrt(ratio)), freedom, min(2 * min(upper, 1 - upper), 1.0))
    probability = f_tail(ratio, freedom, CLASS_DEGREES_OF_FREEDOM)
    return Misfit(float(np.sqrt(ratio)), freedom, probability, usual.source or usual.arm_class)


def noisy_observations(case: Case) -> tuple[NoisyObservation, ...]:
    """Observations whose residuals are too large, of a calibration with others than sockets."""
    given = case.record.given_noise is not None
    if not case.shows_noise or not case.record.recording.capture.observations:
        return ()
    rows, relations = case.once(explained)
    left = case.left if not culprits_of(case) else Residuals.of([*(part.block("") for part in rows), *relations])
    names = list(dict.fromkeys(part.name for part in rows))
    if len(names) < 2 and not given:
        return ()
    tests = []
    for name in names:
        sizes = [part.residual.shape if part.name == name else None for part in rows]
        kernels = [None if size is None else np.broadcast_to(np.eye(size[1]), (*size, size[1])) for size in sizes]
        form = form_test(left, kernels, not given)
        tests.append(NoisyObservation(name, form.ratio, form.probability))
    noisy = [
        NoisyObservation(culprit.name, culprit.size, culprit.probability)
        for culprit in culprits_of(case)
        if culprit.kind == "scatter"
    ]
    tests = sorted(tests, key=lambda test: test.probability)
    for number, test in enumerate(tests):
        probability = min(test.probability * (len(tests) - number), 1.0)
        if probability >= LEVEL:
            break
        noisy.append(test._replace(probability=probability))
    return tuple(noisy)


def successive_of(case: Case) -> Successive | None:
    """Errors of the tip that successive poses of one observation share (a score test of their covariance)."""
    if not case.shows_noise:
        return None
    rows, relations = case.once(explained)
    left = case.left if not culprits_of(case) else Residuals.of([*(part.block("") for part in rows), *relations])
    # The derivative of the covariance by a correlation with the pose before, and the one after.
    kernels = [alike(part.by_tip, in_succession(len(part.poses))) for part in rows]
    if not any(np.any(kernel) for kernel in kernels):
        return None
    product = total = 0.0
    for part, selected in zip(rows, left.slices, strict=False):
        tips = np.einsum("mrc,mr->mc", part.by_tip, left.values[selected].reshape(part.residual.shape))
        product += float(np.sum(tips[1:] * tips[:-1]))
        total += float(np.sum(tips[1:] ** 2) + np.sum(tips[:-1] ** 2)) / 2
    return Successive(product / total if total else 0.0, form_test(left, kernels, relative=True).probability)


class ModelTests(NamedTuple):
    """All tests of one calibration; None and nothing where there is too little to test.

    Each has its ``probability`` where nothing is wrong, already that of its whole family; below `LEVEL`, of a noisy
    joint below `SURE`, it is a finding.
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
        tests = (self.misfit, self.lengths, self.successive)
        significant = any(test.probability < LEVEL for test in tests if test is not None)
        noisy = self.noisy_joint is not None and self.noisy_joint.probability < SURE
        return bool(self.terms or self.noisy_observations or noisy or significant)


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
        class_noise: Noise of encoders and seat that is usual for this class of arms, as for `findings_of`.

    Returns:
        The tests; those that found something have a probability below `LEVEL`.

    Example:
        >>> tests = aj.diagnostics.model_tests(result, capture)
        >>> print(tests.warns, len(tests.terms))
        False 0
    """
    case = case_of(result, capture, class_noise)
    return ModelTests(
        misfit=case.once(misfit_of),
        lengths=case.once(lengths_of),
        noisy_observations=case.once(noisy_observations),
        terms=case.once(missing),
        noisy_joint=case.once(noisiest_joint),
        successive=case.once(successive_of),
    )


def rows_of_tests(tests: ModelTests) -> dict[str, Any]:
    """The tests as JSON has them: probabilities where nothing is wrong, and what was found; mm, rad."""

    def values(test: Any, *names: str) -> dict[str, Any] | None:
        return None if test is None else {name: getattr(test, name) for name in names}

    misfit = values(tests.misfit, "ratio", "degrees_of_freedom", "probability")
    if misfit is not None and tests.misfit is not None:
        misfit["against"] = tests.misfit.usual or "given noise"
    lengths = values(tests.lengths, "birge_ratio", "degrees_of_freedom", "probability", "odd")
    if lengths is not None:
        lengths["odd"] = lengths["odd"] or None
    return {
        "level": LEVEL,
        "misfit": misfit,
        "lengths": lengths,
        "noisy_joint": values(tests.noisy_joint, "joint", "probability"),
        "successive_poses": values(tests.successive, "correlation", "probability"),
        "noisy_observations": [values(test, "name", "probability") for test in tests.noisy_observations],
        "missing_terms": [
            {
                "term": term.kind,
                "joint": term.joint,
                "amplitude": term.amplitude,
                "f": term.test.ratio,
                "degrees_of_freedom": list(term.test.degrees_of_freedom),
                "probability": term.probability,
                "alternatives": [{"term": other.kind, "joint": other.joint} for other in term.others],
            }
            for term in tests.terms
        ],
    }
