"""One line on a result, in the terms of who uses the arm: what it is good for, and whether its numbers can be trusted.

Terminal and report begin with it. Its mark is "good", "unsure", "bad", or "neutral" where nothing was decided.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..calibration.prediction import LEVEL
from ..core.text import shorten
from ..diagnostics.findings import Finding
from .tables import two_digits

_LACKING = "the residuals show errors that the model lacks"  # what tests of residuals doubt
_LARGER = 1.25  # times what is predicted: less is as good as predicted


class Verdict(NamedTuple):
    """A mark and a sentence."""

    mark: str
    says: str


def calibration_verdict(
    findings: Sequence[Finding], volume: Mapping[str, Any], held_out: Mapping[str, Any] | None, simulated: bool
) -> Verdict:
    """Of a calibration.

    Args:
        findings: What diagnostics say of it, the most serious first.
        volume: The uncertainty over the working volume, of its summary.
        held_out: The summary of its cross-validation.
        simulated: Whether its readings are simulated.
    """
    unusable = [finding for finding in findings if finding.severity == "unusable"]
    if unusable:
        says = unusable[0].doubt
        return Verdict("bad", f"Not usable: {says}." if says else f"Not usable. {unusable[0].says}")
    doubts = list(dict.fromkeys(finding.doubt or _LACKING for finding in findings if finding.severity == "doubt"))
    median, largest = (volume[f"expanded_length_reading_{which}_mm"] for which in ("median", "largest"))
    if median is None or largest is None:
        doubts = ["the data do not determine lengths all over the working volume", *doubts]
        return Verdict("unsure", f"To be used with care: {'; '.join(doubts)}.")
    stated = (
        f"U (95 %) of a measured length of {volume['length_mm']:g} mm, {two_digits(median)} mm "
        f"(at worst {two_digits(largest)} mm)"
    )
    if doubts:
        return Verdict(
            "unsure", f"To be used with care: {'; '.join(doubts)}, so errors may exceed the stated {stated}."
        )
    agrees = held_out is not None and held_out["rms_mm"] is not None
    checked = "held-out data agree with it" if agrees else "no held-out data confirm it"
    prefix = "Calibrated, in simulation" if simulated else "Calibrated"
    return Verdict("good" if agrees else "neutral", f"{prefix}: {stated}; {checked}.")


def checked_lengths(
    lengths: Sequence[Mapping[str, Any]], held_out: Mapping[str, Any] | None, fixed_by_one: bool
) -> dict[str, Any] | None:
    """What a calibration says of the lengths that it was tried on, mm; None without reference lengths.

    Args:
        lengths: Rows of a summary, with errors of the calibrated arm.
        held_out: The summary of a cross-validation.
        fixed_by_one: Whether a single length fixed the scale, so that its error is 0 by construction.
    """
    if not lengths:
        return None
    values = [row["value_mm"] for row in lengths]
    checked = {"lengths": len(lengths), "held_out": 0, "shortest_mm": min(values), "longest_mm": max(values)}
    checked |= {"rms_mm": None, "predicted_mm": None}
    held = sum(group["lengths"] for group in held_out.get("left_out", [])) if held_out else 0
    if held_out and held and held_out["length_error_rms_mm"] is not None:
        return checked | {
            "held_out": min(held, len(lengths)),
            "rms_mm": held_out["length_error_rms_mm"],
            "predicted_mm": held_out["length_u_mm"],
        }
    if fixed_by_one:
        return checked
    u = [row["error_u_mm"] for row in lengths]
    return checked | {
        "rms_mm": _root_mean_square([row["error_mm"] for row in lengths]),
        "predicted_mm": None if None in u else _root_mean_square(u),
    }


def _root_mean_square(values: Sequence[float]) -> float:
    return math.sqrt(sum(value**2 for value in values) / len(values))


def overall_decision(summary: Mapping[str, Any]) -> str | None:
    """The decision on all limits together: "fails", "undecided" or "conforms"; None without limits."""
    decisions = [metric["decision"] for test in summary["acceptance"] for metric in test["figures"]]
    if summary["failed"] or "fails" in decisions:
        return "fails"
    if "undecided" in decisions:
        return "undecided"
    return "conforms" if "conforms" in decisions or summary["kept"] else None


def evaluation_verdict(summary: Mapping[str, Any], own_warnings: int = 0) -> Verdict:
    """Of the summary of an evaluation, or of acceptance tests of points.

    Args:
        summary: What `evaluation_summary` or `points_summary` returned.
        own_warnings: How many warnings concern this evaluation, so that "conforms" is not said without reserve.
    """
    decision = overall_decision(summary)
    metrics = [metric for test in summary["acceptance"] for metric in test["figures"]]
    names = [metric["name"] for metric in metrics if metric["decision"] == decision]
    if decision == "fails":
        reasons = [*(f"{name} is over its limit" for name in names), *(one.rstrip(".") for one in summary["failed"])]
        return Verdict("bad", f"Fails: {shorten(reasons, 3)}.")
    if decision == "undecided":
        return Verdict("unsure", f"Undecided: the measurement is too uncertain for {shorten(names)}.")
    if decision == "conforms":
        incomplete = any(test["missing"] for test in summary["acceptance"] if test["decision"])
        without = dict.fromkeys(metric["name"] for metric in metrics if metric["decision"] is None)
        before = {metric["name"]: metric["as_found_decision"] for metric in metrics}
        says = f"Conforms{' (calibrated arm)' if any(before.values()) else ''}: every limit given is kept"
        says += f" ({shorten(list(dict.fromkeys(names)))})" if names else ""
        failed = [name for name, decision in before.items() if decision == "fails"]
        says += f"; the nominal arm fails ({shorten(failed)})" if failed else ""
        says += f"; no limit was given for {shorten(list(without))}" if without else ""
        says += "; a procedure was not complete." if incomplete else "."
        return Verdict("unsure" if incomplete or own_warnings else "good", says)
    return _without_limits(summary)


def _without_limits(summary: Mapping[str, Any]) -> Verdict:
    held_out = summary.get("held_out")
    if held_out is None:
        return Verdict("neutral", "Measured; no limit was given.")
    predicted = held_out.get("predicted") or {"poses": {}, "lengths": {}}
    poses = predicted["poses"]
    if poses.get("rms_mm") is None or poses.get("rms_predicted_mm") is None:
        return Verdict("neutral", "Measured on held-out data; no limit was given.")
    measured, expected = poses["rms_mm"], poses["rms_predicted_mm"]
    chances = [one["probability"] for one in (poses, predicted["lengths"]) if one["probability"] is not None]
    rms = f"held-out poses are {measured:.3g} mm RMS from their geometry, predicted {expected:.3g} mm"
    ratio = predicted["lengths"]["normalised_error_rms"]
    if ratio is not None:
        rms += f", and lengths err by {ratio:.2g} times what is predicted"
    if any(chance < LEVEL / len(chances) for chance in chances):
        chance = min(chances)
        return Verdict("unsure", f"Errors on held-out data exceed the prediction (p = {chance:.1g}): {rms}.")
    if max(measured / expected if expected else 0.0, ratio or 0.0) > _LARGER:
        return Verdict("unsure", f"Errors on unseen data are larger than predicted, but may be so by chance: {rms}.")
    return Verdict("neutral", f"The calibration holds on unseen data: {rms}. No limit was given.")
