"""The causes that explain the residuals of a calibration as findings, in the order of how much they explain."""

from collections.abc import Callable, Sequence

import numpy as np

from ..core.text import shorten
from ..core.units import ARCSEC
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS
from .culprits import Culprit, culprits_of
from .determined import effect_of_bounds
from .findings import Case, Finding, chance_text, look_for_play, rounded
from .held_arm import errors_of_held
from .missing_terms import FoundTerm, wider_model

ORDER, NEEDS = 60, "fit"
_SEVERAL = 3  # steps at different poses, from which they are no single events


def test(case: Case) -> list[Finding]:
    """The causes that explain the residuals, in the order of how much they explain."""
    by_kind: dict[str, list[Culprit]] = {}
    for culprit in culprits_of(case):
        by_kind.setdefault(culprit.kind, []).append(culprit)
    # Of what bounds leave that parameters have reached.
    findings, beside_bounds = [], 1 - case.once(effect_of_bounds).share
    if case.once(errors_of_held) is not None:  # `held_arm` says that of all parameters together
        by_kind.pop("fixed", None)
        by_kind["term"] = [c for c in by_kind.get("term", ()) if c.term is not None and c.term.kind != "zero"]
    for kind, culprits in by_kind.items():
        if not culprits:
            continue
        explains = min(sum(culprit.explains for culprit in culprits), 1.0) * beside_bounds
        if kind == "term":
            findings.append(_of_terms(case, [c.term for c in culprits if c.term is not None], explains))
            continue
        probability = max(culprit.probability for culprit in culprits)
        finding = _FINDINGS[kind](culprits)._replace(explains=explains, probability=probability)
        advice = look_for_play(case, len(finding.concerns)) if kind == "noisy joint" else finding.advice
        findings.append(finding._replace(advice=advice))
    return findings


def term_text(term: FoundTerm) -> str:
    """What residuals follow, and how large it is."""
    if term.term.relative and term.kind != "zero":
        return f"{term.term.follows} ({rounded(100 * term.amplitude)} %)"
    unit, size = ("mm", 1.0) if term.joint is None else ("arcsec", ARCSEC)
    return f"{term.term.follows} ({rounded(term.amplitude / size)} {unit})"


def _of_terms(case: Case, terms: Sequence[FoundTerm], explains: float) -> Finding:
    """Terms that the model lacks, in one finding: each explains what those before it leave."""
    events = [term for term in terms if term.term.first >= 0]
    texts = [term_text(term) for term in terms]
    if len(events) >= _SEVERAL:
        # Of one event, all is said; of several, what they have in common: that something was not firm.
        texts = [term_text(term) for term in terms if term.term.first < 0]
        texts.append(f"{len(events)} sudden changes, of which the one that explains most is {term_text(events[0])}")
    named = {term.term.follows for term in terms}
    likely = [text for text in dict.fromkeys(other.follows for term in terms for other in term.others)]
    likely = [text for text in likely if text not in named]
    model = wider_model(terms, case.record.calibrated.arm)
    causes = dict.fromkeys(term.term.cause for term in terms)
    probability = max(term.probability for term in terms)
    shared = set() if case.record.shared is None else set(case.record.shared.kinds)
    return Finding(
        "missing-terms",
        f"Residuals follow {shorten(texts, 3)} ({chance_text(probability)}), which the model does not describe. "
        f"Possible causes: {', '.join(causes)}{f'; try --model {model}' if model else ''}."
        + (f" Equally likely: {shorten(likely, 3)}." if likely and len(events) < _SEVERAL else ""),
        "The stated uncertainties include these errors as estimated from the residuals."
        if shared - {PLACES, VISITS, SUCCESSIVE}
        else "Every stated uncertainty is too small.",
        severity="doubt",
        probability=probability,
        concerns=tuple(dict.fromkeys(term.term.concerns for term in terms)),
        explains=explains,
    )


def _of_poses(culprits: Sequence[Culprit]) -> Finding:
    texts = [f"{culprit.name} ({culprit.says})" for culprit in culprits]
    return Finding(
        "outlying-poses",
        f"Far from where all other poses put the tip: {shorten(texts)}.",
        advice="Check the readings, and whether the tip was seated in these poses; leave them out, or use --robust "
        "tukey.",
        severity="doubt",
        doubt=f"single poses are far off: {shorten([culprit.name for culprit in culprits], 3)}",
        concerns=tuple(culprit.name for culprit in culprits),
    )


def _of_fixed(culprits: Sequence[Culprit]) -> Finding:
    texts = [f"{culprit.name} (off by {culprit.says})" for culprit in culprits]
    names = [culprit.name for culprit in culprits]
    return Finding(
        "wrong-fixed",
        f"Fixed at a value that the data contradict: {shorten(texts, 3)}.",
        "Errors of other parameters make up for it.",
        f"Free it (--free {','.join(names)}), or correct its value in the arm's file.",
        severity="doubt",
        doubt=f"fixed at a wrong value: {shorten(names, 3)}",
        concerns=tuple(names),
    )


def _of_values(culprits: Sequence[Culprit]) -> Finding:
    names = list(dict.fromkeys(culprit.name for culprit in culprits))
    others = list(dict.fromkeys(name for culprit in culprits for name in culprit.others if name not in names))
    also = f" Equally likely: {shorten(others, 3)}, so that the artefact may also be bent." if others else ""
    if len(culprits) > 1:
        also = " Where several values are wrong, the artefact may be bent." + also
    return Finding(
        "lengths-disagree",
        f"A certified value differs from what the poses and the other values say: {shorten(names, 3)} "
        f"({chance_text(max(culprit.probability for culprit in culprits))}).{also}",
        advice="Compare these values with the certificate, or measure them again.",
        severity="doubt",
        doubt=f"a certified value seems wrong: {shorten(names, 3)}",
        concerns=tuple(names),
    )


def _of_joints(culprits: Sequence[Culprit]) -> Finding:
    joints = list(dict.fromkeys(culprit.name for culprit in culprits))  # one may be taken twice, larger each time
    chance = chance_text(max(culprit.probability for culprit in culprits))
    several = len(joints) > 1
    encoders = "the encoders of these joints were" if several else "the encoder of this joint were"
    return Finding(
        "noisy-encoder",
        f"Residuals are larger where the reading of {shorten(joints, 3)} moves the tip more ({chance}), as if "
        f"{encoders} noisier than the others.",
        severity="doubt",
        concerns=tuple(joints),
    )


def _of_scatter(culprits: Sequence[Culprit]) -> Finding:
    names = [culprit.name for culprit in culprits]
    texts = [f"{culprit.name} ({np.sqrt(culprit.size):.2g} times)" for culprit in culprits]
    return Finding(
        "noisy-observations",
        f"Residuals are larger than the uncertainties and the scatter of the tips predict: {shorten(texts)}.",
        advice="Check these observations and their stated standard uncertainties.",
        severity="doubt",
        concerns=tuple(names),
    )


def _of_stated(culprits: Sequence[Culprit]) -> Finding:
    names = [culprit.name for culprit in culprits]
    texts = [f"{culprit.name} (residuals {np.sqrt(culprit.size):.2g} times as large)" for culprit in culprits]
    return Finding(
        "u-too-small",
        f"The stated u is too small: {shorten(texts)}.",
        "These values have too much weight.",
        "State the u that the instrument reaches in such poses.",
        severity="doubt",
        doubt=f"the stated u is too small: {shorten(names, 3)}",
        concerns=tuple(names),
    )


_FINDINGS: dict[str, Callable[[Sequence[Culprit]], Finding]] = {
    "pose": _of_poses,
    "fixed": _of_fixed,
    "certified": _of_values,
    "noisy joint": _of_joints,
    "scatter": _of_scatter,
    "stated u": _of_stated,
}
