"""Tests of a calibration's model and noise in sentences, and as JSON has them."""

import math
from collections.abc import Collection, Sequence
from typing import Any

from ..calibration.results import NoisyEncoder
from ..core.text import shorten
from ..core.units import ARCSEC
from ..diagnostics.length_consistency import Lengths
from ..diagnostics.missing_terms import FoundTerm
from ..diagnostics.model_errors import LEVEL, Misfit, ModelTests
from ..kinematics.arm import Arm
from ..kinematics.corrections.kind import Term
from ..kinematics.corrections.kinds import all_sought, model_of
from ..uncertainty.shared_errors import SharedErrors
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS

# Terms that no kind of joint correction has: what residuals follow, of joint {i}, and what causes that.
_OTHERS: dict[str, tuple[str, str]] = {
    "zero": ("the zero of joint {i}, which is fixed", "a wrong zero"),
    "drifting zero": ("a drift of joint {i} from pose to pose", "a zero that drifts"),
    "drifting base": ("a drift of the tip from pose to pose", "a base or socket that moves"),
    "growing arm": ("a growth of the arm from pose to pose", "an arm that warms or cools"),
}
_FAR_MORE = 100.0  # ratio of noise beyond which the number says nothing


def sentences_of_tests(
    tests: ModelTests, method: str = "", shared: SharedErrors | None = None, arm: Arm | None = None
) -> list[str]:
    """What the tests of a calibration found, the most serious first; ``method`` is that of the calibration, ``shared``
    what its uncertainty contains of such errors, and ``arm`` the calibrated arm, whose corrections its model has."""
    found = []
    kinds = set() if shared is None else set(shared.kinds)
    if tests.terms:
        found.append(_terms(tests.terms, bool(kinds - {PLACES, VISITS, SUCCESSIVE}), arm))
    if tests.misfit is not None and tests.misfit.probability < LEVEL:
        found.append(_misfit(tests.misfit))
    if tests.noisy_joint is not None and tests.noisy_joint.probability < LEVEL:
        found.append(
            f"Residuals are larger the more the reading of joint {tests.noisy_joint.joint} moves the tip "
            f"({_chance(tests.noisy_joint.probability)}): is its encoder noisier than the others? State the noise "
            "joint by joint, or look for play in this joint."
        )
    if tests.successive is not None and tests.successive.probability < LEVEL:
        found.append(
            f"Residuals of successive poses are alike (correlation {tests.successive.correlation:.2f}, "
            f"{_chance(tests.successive.probability)}): a seat that shifts at each visit, or errors that the model "
            "lacks. "
            + (
                "Every u contains what they share, as far as residuals show it."
                if kinds & {VISITS, SUCCESSIVE}
                else "Such poses count as independent, so every u is too small."
            )
        )
    if tests.noisy_observations:
        named = [f"{one.name} ({math.sqrt(max(one.test.ratio, 0)):.2g} times)" for one in tests.noisy_observations]
        found.append(
            "Residuals are larger than the uncertainties and the scatter of the tips predict: "
            f"{shorten(named)}; check these observations, or their u."
        )
    if tests.lengths is not None and tests.lengths.probability < LEVEL:
        # Errors of places take the part of what u(k) had for lengths that disagree.
        found.append(_lengths(tests.lengths, "" if PLACES in kinds else method, bool(kinds)))
    return found


def sentence_of_noisy_encoders(encoders: Sequence[NoisyEncoder], slides: Collection[int], given: bool) -> str:
    """That the noise of some encoders was replaced; ``slides`` are the numbers of prismatic joints."""
    named = [
        f"joint {one.joint} scatter by {_noise(one, slides)}, {_times(one)} "
        f"{'given' if given else 'those of the others'} ({_chance(one.probability)})"
        for one in encoders
    ]
    return (
        f"Readings of {shorten(named, 3)}. This noise was estimated, and weights and every u follow from it "
        f"(--keep-noise: from {'the noise as given' if given else 'one noise of all encoders'}). Check the encoder, "
        "and the joint for play."
    )


def _times(one: NoisyEncoder) -> str:
    # Of the others nothing may be left beside the noise of the tip, and what is given may be 0.
    known = one.found < _FAR_MORE * one.expected
    return f"{one.found / one.expected:.2g} times as much as" if known else "far more than"


def _noise(one: NoisyEncoder, slides: Collection[int]) -> str:
    if one.joint in slides:
        return f"{_rounded(1e3 * one.found)} um (u = {_rounded(1e3 * one.u)})"
    return f"{_rounded(one.found / ARCSEC)} arcsec (u = {_rounded(one.u / ARCSEC)})"


def noisy_encoder_rows(encoders: Sequence[NoisyEncoder], slides: Collection[int]) -> list[dict[str, Any]]:
    """Encoders whose noise was replaced, as JSON has them; arcsec, or mm of prismatic joints."""
    rows = []
    for one in encoders:
        unit, factor = ("mm", 1.0) if one.joint in slides else ("arcsec", 1 / ARCSEC)
        values = {name: factor * getattr(one, name) for name in ("expected", "found", "u")}
        rows.append({"joint": one.joint, "probability": one.probability, "unit": unit, **values})
    return rows


def _words(name: str) -> tuple[str, str]:
    """What residuals follow, of joint {i}, and what causes that."""
    found = all_sought().get(name)
    return _OTHERS[name] if found is None else (found[1].follows, found[1].cause)


def _wider_model(terms: tuple[FoundTerm, ...], arm: Arm | None) -> str:
    """The model that the arm has, with the terms that were found besides; empty where that is no other model."""
    each = () if arm is None or arm.corrections is None else arm.corrections.functions.terms
    own = [term for term in each if isinstance(term, Term)]
    sought, added = all_sought(), []
    for kind, one in (sought[term.kind] for term in terms if term.kind in sought):
        # All of its default functions where the model has none yet, as a first harmonic is seldom alone.
        option = one.option if any(term.kind.model == kind.model for term in own) else ""
        joints = 1 if arm is None else arm.joints
        added += kind.terms(max(joints, *(term.joint or 1 for term in terms)), option, None)
    wider = model_of([*own, *added]) if added else ""
    return "" if own and wider == model_of(own) else wider


def _terms(terms: tuple[FoundTerm, ...], in_uncertainty: bool, arm: Arm | None) -> str:
    named = [f"{_words(term.kind)[0].format(i=term.joint)} ({_amplitude(term)})" for term in terms]
    kinds = dict.fromkeys(term.kind for term in terms)
    model = _wider_model(terms, arm)
    hint = f"; try --model {model}" if model else ""
    found = {(term.kind, term.joint) for term in terms}
    others = dict.fromkeys(other for term in terms for other in term.alternatives if other not in found)
    as_well = [_words(kind)[0].format(i=joint) for kind, joint in others]
    return (
        f"Residuals follow {shorten(named, 3)} ({_chance(max(term.probability for term in terms))}), which the model "
        f"lacks: {', '.join(_words(kind)[1] for kind in kinds)}{hint}. "
        + (f"As good an explanation: {shorten(as_well, 3)}. " if as_well else "")
        + (
            "Every u contains such errors, as far as residuals show them."
            if in_uncertainty
            else "Every u is too small."
        )
    )


def _amplitude(term: FoundTerm) -> str:
    if term.term.relative and term.kind != "zero":
        return f"{_rounded(100 * term.amplitude)} %"
    return f"{_rounded(term.amplitude)} mm" if term.joint is None else f"{_rounded(term.amplitude / ARCSEC)} arcsec"


def _rounded(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def _misfit(misfit: Misfit) -> str:
    chance = _chance(misfit.probability)
    if misfit.usual:
        return (
            f"Residuals are {misfit.ratio:.2g} times what is usual for such an arm ({misfit.usual}; {chance}): errors "
            "that the model lacks, or worse encoders."
        )
    word = "small" if misfit.ratio > 1 else "large"
    return (
        f"Residuals are {misfit.ratio:.3g} times what the given noise predicts ({chance}), and every uncertainty "
        f"follows from that noise: it is about {max(misfit.ratio, 1 / misfit.ratio):.3g} times too {word}, or the "
        "model lacks something. Check the noise, or leave it out to have it estimated."
    )


def _lengths(lengths: Lengths, method: str, shared: bool) -> str:
    odd = f"; without {lengths.odd} ({lengths.difference:+.3g} mm) the others agree" if lengths.odd else ""
    enlarged = " u(k) allows for it." if method == "two-stage" else ""
    predicted = "u, the poses and the errors that these share" if shared and not odd else "u and the poses"
    return (
        f"Reference lengths that disagree with the arm: the {lengths.number} err {lengths.birge_ratio:.2g} times as "
        f"much as their {predicted} predict (Birge ratio, {_chance(lengths.probability)}){odd}.{enlarged} "
        "Look for a wrong length, or for errors outside the D-H model."
    )


def _chance(probability: float) -> str:
    return "p < 0.0001" if probability < 1e-4 else f"p = {probability:.1g}"


def summary_of_tests(tests: ModelTests) -> dict[str, Any]:
    """The tests as JSON has them: probabilities where nothing is wrong, and what was found; mm, rad."""
    misfit, lengths, noisy, successive = tests.misfit, tests.lengths, tests.noisy_joint, tests.successive
    return {
        "level": LEVEL,
        "misfit": None
        if misfit is None
        else {
            "ratio": misfit.ratio,
            "degrees_of_freedom": misfit.degrees_of_freedom,
            "probability": misfit.probability,
            "against": misfit.usual or "given noise",
        },
        "lengths": None
        if lengths is None
        else {
            "birge_ratio": lengths.birge_ratio,
            "degrees_of_freedom": lengths.degrees_of_freedom,
            "probability": lengths.probability,
            "odd": lengths.odd or None,
        },
        "noisy_joint": None if noisy is None else {"joint": noisy.joint, "probability": noisy.probability},
        "successive_poses": None
        if successive is None
        else {"correlation": successive.correlation, "probability": successive.probability},
        "noisy_observations": [{"name": one.name, "probability": one.probability} for one in tests.noisy_observations],
        "missing_terms": [
            {
                "term": term.kind,
                "joint": term.joint,
                "amplitude": term.amplitude,
                "f": term.test.ratio,
                "degrees_of_freedom": list(term.test.degrees_of_freedom),
                "probability": term.probability,
                "alternatives": [{"term": kind, "joint": joint} for kind, joint in term.alternatives],
            }
            for term in tests.terms
        ],
    }
