"""One line on a result, in the terms of who uses the arm: what it is good for, and whether its numbers can be trusted.

Terminal and report begin with it. Its mark is "good", "unsure", "bad", or "neutral" where nothing was decided.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..calibration.agreement import SIGNIFICANCE
from ..core.text import shorten
from ..core.units import DEG
from ..diagnostics.findings import Finding
from ..diagnostics.held_out import IN_TURN
from ..uncertainty.coverage import U_AT_LEVEL
from .result_tables import BEFORE
from .tables import two_digits

_LACKING = "the residuals show errors that the model does not describe"  # what tests of residuals doubt
_LARGER = 1.25  # times what is predicted: less is as good as predicted
# A prediction so many times what was found is of no use, and what is found so many times the prediction refutes it,
# whatever the number of degrees of freedom. A single length is so near its value by chance in 8 of 100 cases.
_FAR, _FEWEST_LENGTHS = 10.0, 2
# Errors over their prediction, up to which a difference that many poses show does not matter: a variance that is off
# by a quarter.
_NOTABLE = 1.25**0.5
_WORSE = 2.0  # times the errors of lengths by the nominal arm: the calibration made them worse


class Verdict(NamedTuple):
    """A mark and a sentence, and whether the result is what was asked for: else commands end with exit code 1."""

    mark: str
    says: str
    achieved: bool = True


def calibration_verdict(
    findings: Sequence[Finding],
    uncertainty: Mapping[str, Any],
    held_out: Mapping[str, Any] | None,
    simulated: bool,
    single_poses: bool = False,
) -> Verdict:
    """Of a calibration: by its findings, the most serious first, and by the uncertainty and the cross-validation of its
    summary. ``single_poses`` of groups were held out: they lie among those that were used, so that they confirm little,
    and a line of their own says what they show."""
    unusable = [finding for finding in findings if finding.severity == "unusable"]
    if unusable:
        says = unusable[0].doubt
        return Verdict("bad", f"Not usable: {says}." if says else f"Not usable. {unusable[0].says}", False)
    doubts = list(dict.fromkeys(finding.doubt or _LACKING for finding in findings if finding.severity == "doubt"))
    values, length = length_uncertainty(uncertainty), uncertainty["volume"]["length_mm"]
    stated = f"{U_AT_LEVEL} of a measured length of {length:.4g} mm is {values}"
    if values is None:
        doubts = ["the data do not determine lengths everywhere in the working volume", *doubts]
        return Verdict("unsure", f"To be used with care: {'; '.join(doubts)}.")
    if doubts:
        says = f"To be used with care: {'; '.join(doubts)}, so errors may exceed the stated uncertainty. {stated}."
        return Verdict("unsure", says)
    agrees = held_out is not None and held_out["rms_mm"] is not None
    checked = "held-out data agree with this U" if agrees else "no held-out data confirm this U"
    prefix = "Calibrated, in simulation" if simulated else "Calibrated"
    says = f"{prefix}: {stated}." if single_poses and not agrees else f"{prefix}: {stated}; {checked}."
    return Verdict("good" if agrees else "neutral", says)


def geometry_verdict(
    findings: Sequence[Finding], cameras: Sequence[Mapping[str, Any]], uncertainty: Mapping[str, Any]
) -> Verdict:
    """Of a calibration that held all parameters of the arm."""
    doubts = list(dict.fromkeys(finding.doubt or _LACKING for finding in findings if finding.severity == "doubt"))
    factor = uncertainty["coverage_factor_geometry_95"]
    mounts = {row["mount"]["of"]: row["mount"] for row in cameras}
    said = [
        f"{U_AT_LEVEL} of the mount of {name} is {two_digits(factor * mount['position_u_mm'])} mm and "
        f"{two_digits(factor * mount['rotation_u_rad'] / DEG)} deg"
        for name, mount in mounts.items()
        if mount["position_u_mm"] is not None and mount["rotation_u_rad"] is not None
    ]
    says = "; ".join(["Only the geometry was identified, with the arm as it is", *said, *doubts])
    return Verdict("unsure" if doubts else "neutral", f"{says}.")


def length_uncertainty(uncertainty: Mapping[str, Any]) -> str | None:
    """U of a measured length, where poses were taken and over all joint limits, of the summary of an uncertainty: its
    median and, over all limits, its largest value; None where the data do not determine lengths."""
    volume, near = uncertainty["volume"], uncertainty.get("where_poses_were_taken")

    def of(region: Mapping[str, Any] | None, which: str) -> str | None:
        value = None if region is None else region[f"expanded_length_reading_{which}_mm"]
        return None if value is None else f"{two_digits(value)} mm"

    median, largest, taken = of(volume, "median"), of(volume, "largest"), of(near, "median")
    if median is None or largest is None:
        return None
    everywhere = f"{median} over all joint limits (at worst {largest})"
    return everywhere if taken is None else f"{taken} where poses were taken, {everywhere}"


def checked_lengths(
    lengths: Sequence[Mapping[str, Any]], held_out: Mapping[str, Any] | None, fixed_by_one: bool
) -> dict[str, Any] | None:
    """What a calibration says of the lengths that it was tried on, mm; None without reference lengths.

    Of the rows of its summary, with the summary of a cross-validation; the error of the only length is 0 by
    construction where that fixed the scale.
    """
    if not lengths:
        return None
    values, held, u = [row["value_mm"] for row in lengths], 0, [row["error_u_mm"] for row in lengths]
    rms = predicted = None
    if held_out and held_out["length_error_rms_mm"] is not None:
        held = min(sum(group["lengths"] for group in held_out.get("left_out", [])), len(lengths))
    if held_out and held:
        rms, predicted = held_out["length_error_rms_mm"], held_out["length_u_mm"]
    elif not fixed_by_one:
        rms = math.sqrt(sum(row["error_mm"] ** 2 for row in lengths) / len(lengths))
        predicted = None if None in u else math.sqrt(sum(value**2 for value in u) / len(u))
    ends = {"shortest_mm": min(values), "longest_mm": max(values)}
    return {"lengths": len(lengths), "held_out": held, **ends, "rms_mm": rms, "predicted_mm": predicted}


def overall_decision(summary: Mapping[str, Any]) -> str | None:
    """The decision on all limits together: "fails", "undecided" or "conforms"; None without limits."""
    decisions = [metric["decision"] for test in summary["acceptance"] for metric in test["figures"]]
    if summary["failed"] or "fails" in decisions:
        return "fails"
    if summary.get("undecided") or "undecided" in decisions:
        return "undecided"
    return "conforms" if "conforms" in decisions or summary["kept"] else None


def evaluation_verdict(summary: Mapping[str, Any], own_warnings: int = 0) -> Verdict:
    """Of the summary of an evaluation, or of acceptance tests of points.

    ``own_warnings``: how many warnings concern this evaluation, so that "conforms" is not said without reserve.
    """
    decision = overall_decision(summary)
    metrics = [metric for test in summary["acceptance"] for metric in test["figures"]]
    names = [metric["name"] for metric in metrics if metric["decision"] == decision]
    if decision == "fails":
        failed = (sentence.rstrip(".") for sentence in summary["failed"])
        reasons = [*(f"{name} is over its limit" for name in names), *failed]
        return Verdict("bad", f"Fails: {shorten(reasons, 3)}.", False)
    if unusable := summary.get("calibration_unusable"):
        return Verdict("bad", f"Not usable, because the calibration is not: {unusable}.", False)
    if decision == "undecided":
        sentences = [_undecided(metric) for metric in metrics if metric["decision"] == decision]
        return Verdict("unsure", f"Undecided: {' '.join([*sentences, *summary.get('undecided', ())][:3])}", False)
    if decision == "conforms":
        incomplete = any(test["missing"] for test in summary["acceptance"] if test["decision"])
        without = dict.fromkeys(metric["name"] for metric in metrics if metric["decision"] is None)
        before = {stage: {row["name"]: row.get(f"{stage}_decision") for row in metrics} for stage in BEFORE}
        says = f"Conforms{' (calibrated arm)' if any(before['nominal'].values()) else ''}: all limits given are met"
        says += f" ({shorten(list(dict.fromkeys(names)))})" if names else ""
        for stage, words in (("nominal", "the nominal arm"), ("as_found", "the arm as found")):
            failed = [name for name, decision in before[stage].items() if decision == "fails"]
            failed += summary.get("failed_before", {}).get(stage, [])
            says += f"; {words} fails ({shorten(failed)})" if failed else ""
        says += f"; no limit was given for {shorten(list(without))}" if without else ""
        says += "; the procedure of a test was not complete." if incomplete else "."
        return Verdict("unsure" if incomplete or own_warnings else "good", says)
    if summary.get("held_out") is None:
        return Verdict("neutral", "Measured; no limit was given.")
    in_turn = any(IN_TURN in warning for warning in summary.get("calibration_warnings", ()))
    return _as_predicted(summary["held_out"], in_turn)


def _undecided(metric: Mapping[str, Any]) -> str:
    """What would decide on a metric of an acceptance test: a smaller uncertainty of the test itself."""
    name, needed = metric["name"], metric.get("deciding_mm")
    if not needed:
        return f"the measurement is too uncertain for a decision on {name}."
    return (
        f"the measurement is too uncertain for a decision on {name}: its U at {metric['where']} would have to be at "
        f"most {two_digits(needed)} mm instead of {two_digits(metric['expanded_mm'])} mm (artefact, seat, temperature)."
    )


def _as_predicted(held_out: Mapping[str, Any], in_turn: bool) -> Verdict:
    """Of errors on held-out data, which no limit was given for; ``in_turn``: whether the cross-validation of the
    calibration found larger errors than predicted.

    Lengths that are all within their U raise no doubt, however their errors are distributed within it.
    """
    predicted = held_out.get("predicted") or {"poses": {}, "lengths": {}}
    of_lengths, rows = predicted["lengths"], held_out.get("lengths", [])
    over = [row["error_over_expanded"] for row in rows if row.get("error_over_expanded") is not None]
    beyond = any(abs(value) > 1 for value in over)
    errors = [held_out.get(stage, {}).get("length_error_mean_absolute_mm") for stage in ("nominal", "calibrated")]
    if errors[0] and errors[1] and errors[1] > _WORSE * errors[0] and (beyond or not over):
        says = f"their errors ({errors[1]:.3g} mm on average) are {errors[1] / errors[0]:.2g} times as large"
        return Verdict("bad", f"Held-out lengths are worse than with the nominal arm: {says}.", False)
    poses, ratio = predicted["poses"], of_lengths.get("normalised_error_rms")
    if poses.get("rms_mm") is None or poses.get("rms_predicted_mm") is None:
        return Verdict("neutral", "Measured on held-out data; no limit was given.")
    measured, expected = poses["rms_mm"], poses["rms_predicted_mm"]
    rms = f"held-out poses deviate by {measured:.3g} mm RMS from their geometry, where {expected:.3g} mm was predicted"
    if ratio is not None:
        rms += f", and length errors are {ratio:.2g} times as large as predicted"
        rms += ", but within U" if ratio > 1 and not beyond else ""
    chances = [row.get("probability") for row in (poses, *([of_lengths] if beyond else []))]
    chances = [chance for chance in chances if chance is not None]
    larger = max(measured / expected if expected else 0.0, ratio if ratio and beyond else 0.0)
    by_more_than_chance = any(chance < SIGNIFICANCE / len(chances) for chance in chances)
    if larger > _FAR or (by_more_than_chance and larger > _NOTABLE):
        by_chance = f" (p = {min(chances):.1g})" if chances else ""
        return Verdict("unsure", f"Errors on held-out data exceed the prediction{by_chance}: {rms}.", False)
    few = of_lengths.get("lengths", 0) < _FEWEST_LENGTHS
    if expected >= _FAR * measured or (ratio is not None and ratio <= 1 / _FAR and not few):
        says = f"the prediction is over {_FAR:g} times what was found, so it is of no use here: {rms}"
        return Verdict("unsure", f"Not confirmed: {says}.", False)
    if larger > _LARGER:
        return Verdict("unsure", f"Errors on held-out data are larger than predicted, but this may be chance: {rms}.")
    here = (
        " This holds for these data: poses of the calibration itself, held out in turn, have larger errors than "
        "predicted (see its warnings)."
    )
    says = f"Errors on held-out data are about as predicted, or smaller: {rms}.{here * in_turn}"
    return Verdict("neutral", f"{says} No largest permitted error was given.")
