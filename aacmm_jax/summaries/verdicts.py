"""One line on a result, in the terms of who uses the arm: what it is good for, and whether its numbers can be trusted.

Terminal and report begin with it. Its mark is "good", "unsure", "bad", or "neutral" where nothing was decided.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..calibration.left_out import LEVEL
from ..core.text import shorten
from .tables import two_digits

_LARGER = 1.25  # times what is predicted: less is as good as predicted


class Verdict(NamedTuple):
    """A mark and a sentence."""

    mark: str
    says: str


def calibration_verdict(summary: Mapping[str, Any]) -> Verdict:
    """Of the summary of a calibration.

    Args:
        summary: What `calibration_summary` returned; one of an earlier version has fewer keys.
    """
    if not summary["converged"]:
        return Verdict("bad", f"Not to be used. {summary['reason']}")
    if not summary["residual_plausible"]:
        return Verdict("bad", "Not to be used: data and arm do not belong together.")
    if not summary.get("scale_plausible", True):
        return Verdict("bad", "Not to be used: the reference lengths give the arm a scale that it cannot have.")
    doubts, stated = _doubts(summary), _stated(summary)
    if stated is None:
        return Verdict("unsure", _sentence(["the data do not determine lengths all over the working volume", *doubts]))
    if doubts:
        return Verdict("unsure", _sentence(doubts, f"errors may exceed the stated {stated}"))
    held_out = summary["cross_validation"]
    agrees = held_out is not None and held_out["rms_mm"] is not None
    checked = "held-out data agree with it" if agrees else "no held-out data confirm it"
    prefix = "Calibrated, in simulation" if "truth" in summary else "Calibrated"
    return Verdict("good" if agrees else "neutral", f"{prefix}: {stated}; {checked}.")


def _sentence(doubts: list[str], consequence: str = "") -> str:
    reasons = "; ".join(doubts)
    return f"To be used with care: {reasons}" + (f", so {consequence}." if consequence else ".")


def _stated(summary: Mapping[str, Any]) -> str | None:
    """The expanded uncertainty of a length, with the noise of its readings; None where it is not determined."""
    found = summary["uncertainty"]
    volume = found["volume"]
    median, largest = (volume[f"expanded_length_reading_{which}_mm"] for which in ("median", "largest"))
    if median is None or largest is None:
        return None
    return (
        f"U (95 %) of a measured length of {volume['length_mm']:g} mm, {two_digits(median)} mm "
        f"(at worst {two_digits(largest)} mm)"
    )


def _doubts(summary: Mapping[str, Any]) -> list[str]:
    """What makes the stated uncertainties too small."""
    found = []
    held_out, tests = summary["cross_validation"], summary.get("model_tests")
    if held_out and held_out.get("surprising"):
        found.append("held-out data disagree by more than predicted")
    if tests and _model_fails(tests):
        found.append("the residuals show errors that the model lacks")
    on_bound = sorted({*summary["active"], *summary["active_stage1"]} if summary["hold"] else summary["active"])
    if on_bound:
        found.append(f"on a bound: {shorten(on_bound, 3)}")
    if summary["method"] == "repeatability" and not summary.get("scale_from"):
        found.append("nothing that was measured set its scale")
    return found


def _model_fails(tests: Mapping[str, Any]) -> bool:
    level = tests["level"]
    single = [tests[name] for name in ("misfit", "lengths", "noisy_joint", "successive_poses")]
    if single[0] is not None and single[0]["ratio"] < 1:
        single[0] = None  # noise given too large makes every U too large, as a warning says
    return bool(tests["missing_terms"] or tests["noisy_observations"]) or any(
        one is not None and one["probability"] is not None and one["probability"] < level for one in single
    )


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
    found = {"lengths": len(lengths), "held_out": 0, "shortest_mm": min(values), "longest_mm": max(values)}
    found |= {"rms_mm": None, "predicted_mm": None}
    held = sum(group["lengths"] for group in held_out.get("left_out", [])) if held_out else 0
    if held_out and held and held_out["length_error_rms_mm"] is not None:
        return found | {
            "held_out": min(held, len(lengths)),
            "rms_mm": held_out["length_error_rms_mm"],
            "predicted_mm": held_out["length_u_mm"],
        }
    if fixed_by_one:
        return found
    u = [row["error_u_mm"] for row in lengths]
    return found | {
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
        found = {metric["name"]: metric["as_found_decision"] for metric in metrics}
        says = f"Conforms{' as left' if any(found.values()) else ''}: every limit given is kept"
        says += f" ({shorten(list(dict.fromkeys(names)))})" if names else ""
        failed = [name for name, decision in found.items() if decision == "fails"]
        says += f"; as found, it fails ({shorten(failed)})" if failed else ""
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
    found, expected = poses["rms_mm"], poses["rms_predicted_mm"]
    chances = [one["probability"] for one in (poses, predicted["lengths"]) if one["probability"] is not None]
    rms = f"held-out poses are {found:.3g} mm RMS from their geometry, predicted {expected:.3g} mm"
    ratio = predicted["lengths"]["normalised_error_rms"]
    if ratio is not None:
        rms += f", and lengths err by {ratio:.2g} times what is predicted"
    if any(chance < LEVEL / len(chances) for chance in chances):
        return Verdict("unsure", f"The calibration does not hold here: {rms}.")
    if max(found / expected if expected else 0.0, ratio or 0.0) > _LARGER:
        return Verdict("unsure", f"Errors on unseen data are larger than predicted, but may be so by chance: {rms}.")
    return Verdict("neutral", f"The calibration holds on unseen data: {rms}. No limit was given.")
