"""Residuals that are larger or smaller than the noise, given or usual for the arm, and the scatter of the tips predict.

Each of the five families of tests of model and noise (`missing_terms`, `noise_level`, `noisy_encoders`,
`successive_poses`, `length_consistency`) raises a false alarm in at most `LEVEL` of the calibrations in which nothing
is wrong, so all of them together in at most 5 % (Bonferroni). Within a family, that level is divided among its tests
(Holm 1979, Scandinavian Journal of Statistics 6: the most significant one first, each at the level over the number of
those left). All of them take the parameters, the unknown geometry and the correlations between residuals into account.
"""

import math
from typing import NamedTuple

import numpy as np

from ..core.distributions import chi_square_tail, f_tail
from ..core.text import shorten
from .equations import equations_of, in_chunks
from .findings import Case, Finding, chance_text
from .residual_tests import LEVEL, FormTest, Residuals, pose_form_test

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
    test: FormTest
    probability: float


def test(case: Case) -> list[Finding]:
    """Of all residuals together, and of single observations."""
    misfit, findings = case.once(misfit_of), []
    if misfit is not None and misfit.probability < LEVEL:
        findings.append(_misfit(misfit))
    noisy = case.once(noisy_observations)
    if noisy:
        texts = [f"{one.name} ({math.sqrt(max(one.test.ratio, 0)):.2g} times)" for one in noisy]
        findings.append(
            Finding(
                "noisy-observations",
                f"Residuals are larger than the uncertainties and the scatter of the tips predict: {shorten(texts)}.",
                advice="Check these observations, or their u.",
                severity="doubt",
                probability=max(one.probability for one in noisy),
                concerns=tuple(one.name for one in noisy),
            )
        )
    return findings


def _misfit(misfit: Misfit) -> Finding:
    chance = chance_text(misfit.probability)
    if misfit.usual:
        return Finding(
            "residuals-unusual",
            f"Residuals are {misfit.ratio:.2g} times what is usual for such an arm ({misfit.usual}; {chance}): errors "
            "that the model lacks, or worse encoders.",
            severity="doubt",
            probability=misfit.probability,
        )
    small = misfit.ratio > 1
    return Finding(
        "residuals-not-as-given",
        f"Residuals are {misfit.ratio:.3g} times what the given noise predicts ({chance}).",
        "Every uncertainty follows from that noise: it is about "
        f"{max(misfit.ratio, 1 / misfit.ratio):.3g} times too {'small' if small else 'large'}, or the model lacks "
        "something.",
        "Check the noise, or leave it out to have it estimated.",
        severity="doubt" if small else "note",  # noise given too large makes every uncertainty too large
        probability=misfit.probability,
    )


def misfit_of(case: Case) -> Misfit | None:
    """Residuals against the noise that was given, or that of the arm's class; None where neither is known."""
    if not case.shows_noise:
        return None
    if case.record.given_noise is not None:
        freedom = case.left.degrees_of_freedom
        upper = chi_square_tail(case.left.cost, freedom)
        return Misfit(float(np.sqrt(case.left.cost / freedom)), freedom, min(2 * min(upper, 1 - upper), 1.0))
    usual = case.usual
    if usual is None:
        return None
    rows, relations = in_chunks(equations_of(case.record._replace(noise=usual.noise)))
    left = Residuals.of([*(part.block("") for part in rows), *relations])
    freedom, ratio = left.degrees_of_freedom, left.cost / left.degrees_of_freedom
    probability = f_tail(ratio, freedom, CLASS_DEGREES_OF_FREEDOM)
    return Misfit(float(np.sqrt(ratio)), freedom, probability, usual.source or usual.arm_class)


def noisy_observations(case: Case) -> tuple[NoisyObservation, ...]:
    """Observations whose residuals are too large, of a calibration with others than sockets."""
    given = case.record.given_noise is not None
    if not case.shows_noise or not case.record.recording.capture.observations:
        return ()
    rows, left = case.chunks[0], case.left
    names = list(dict.fromkeys(part.name for part in rows))
    if len(names) < 2 and not given:
        return ()
    tests = []
    for name in names:
        sizes = [part.residual.shape if part.name == name else None for part in rows]
        kernels = [None if size is None else np.broadcast_to(np.eye(size[1]), (*size, size[1])) for size in sizes]
        none = [None] * (len(left.slices) - len(kernels))
        tests.append((pose_form_test(left, [*kernels, *none], not given), name))
    noisy, tests = [], sorted(tests, key=lambda pair: pair[0].probability)
    for number, (form, name) in enumerate(tests):
        probability = min(form.probability * (len(tests) - number), 1.0)
        if probability >= LEVEL:
            break
        noisy.append(NoisyObservation(name, form, probability))
    return tuple(noisy)
