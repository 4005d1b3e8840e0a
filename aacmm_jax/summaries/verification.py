"""What `pipeline.verify` found, in numbers and sentences."""

from typing import Any

from ..core.text import pluralise
from ..pipeline.verification import LEVEL, MARGIN, Accuracy, Verification
from ..uncertainty.coverage import LEVEL_IN_PERCENT, U_AT_LEVEL
from .tables import STYLES, Styled, View, listed, plain

_VERDICTS = {"better": "good", "worse": "bad", "equivalent": "neutral", "not decided": "unsure"}
_LITTLE = 0.1  # of the RMS error: a smaller gain of a recalibration is none
_RMS_ERROR = (
    "RMS error: RMS distance of a pose from its socket, point or board position, after the tip of the tool and the "
    "frames and positions that no maker states were fitted; it includes the repeatability."
)
_REAL_SHARE = (
    "Real share: how much of the difference between nominal and delivered parameters these poses confirm: 1 all, 0.5 "
    "and less no improvement."
)


def verification_summary(checked: Verification, arm: str, delivered: str) -> dict[str, Any]:
    """What ``verify`` reports of the nominal arm and the delivered parameters with these names; mm."""
    rows = [
        {"parameters": name} | _accuracy(accuracy) | {"length_errors_mm": plain(errors)}
        for name, accuracy, errors in (
            ("nominal", checked.nominal, checked.length_errors[0]),
            ("delivered", checked.delivered, checked.length_errors[1]),
        )
    ]
    share = [None] * 3 if checked.same else [checked.share, checked.share_lower, checked.share_upper]
    return {
        "kind": "verification",
        "arm": arm,
        "delivered": delivered,
        "verdict": checked.verdict,
        "says": _verdict(checked),
        "accuracy": rows,
        "share": dict(zip(("value", "lower", "upper"), share, strict=True)),  # of no difference there is none
        "volume_ratio": {"lower": checked.ratio_lower, "upper": checked.ratio_upper, "margin": MARGIN},
        "probability": checked.probability,
        "poses": checked.poses,
        "equations": checked.equations,
        "unknowns": checked.unknowns,
        "poses_that_decide": checked.decided_by,
        "poses_say": _poses(checked),
        "verdict_here": checked.verdict_here,
        "volume_rms_mm": checked.volume,
        "recalibrated_rms_mm": checked.recalibrated,
        "gain_mm": checked.gain,
        "gain_says": _gain(checked),
    }


def _accuracy(accuracy: Accuracy) -> dict[str, Any]:
    return {
        "rms_mm": accuracy.rms,
        "expanded_mm": accuracy.expanded,
        "lower_mm": accuracy.lower,
        "upper_mm": accuracy.upper,
        "degrees_of_freedom": accuracy.degrees_of_freedom,
    }


def _verdict(checked: Verification) -> str:
    nominal, delivered = checked.nominal, checked.delivered
    of_delivered = f"{delivered.rms:.3g} mm RMS ({LEVEL_IN_PERCENT}: {delivered.lower:.3g} to {delivered.upper:.3g} mm)"
    if checked.same:
        return f"No difference: in these poses, both sets of parameters are the same, and err by {of_delivered}."
    against = (
        f"with the delivered parameters the tip errs by {of_delivered}, with the nominal ones by {nominal.rms:.3g} mm"
    )
    if checked.verdict == "not decided":
        return (
            f"Not decided: these poses do not show whether the delivered parameters are better than the nominal ones; "
            f"{against}."
        )
    if checked.verdict == "equivalent":
        return (
            "No difference that matters: over the working volume the errors of the delivered and of the nominal "
            f"parameters differ by less than {1 - MARGIN:.0%} of the larger; {against}."
        )
    comparison = "better than" if checked.verdict == "better" else "worse than"
    return f"The delivered parameters are {comparison} the nominal ones: {against}."


def _poses(checked: Verification) -> str:
    """How many poses decide."""
    errors = f"(of two equally good sets, {50 * LEVEL:g} % are called better and {50 * LEVEL:g} % worse)"
    if checked.same:
        return ""
    if checked.verdict == "equivalent":
        here = checked.verdict_here
        return ("" if here == "not decided" else f"In poses such as these they are {here}. ") + (
            f"Of two sets that differ by {1 - MARGIN:.0%}, at most {LEVEL:.0%} are called equivalent. More poses could "
            "tell which of the two is a little better."
        )
    if checked.verdict != "not decided":
        assert checked.decided_by is not None
        enough = min(checked.decided_by, checked.poses)
        return f"Poses such as these decide from about {enough} on {errors}."
    if checked.verdict_here != "not decided":
        return (
            f"They are {checked.verdict_here} in poses such as these, which do not show whether they are so in "
            "the rest of the working volume. Record poses in other places, far apart."
        )
    if checked.decided_by is None:
        return "At this real share, not even a thousand poses would decide which is better."
    more = max(checked.decided_by - checked.poses, 1)
    return f"If the real share stays as it is, about {pluralise(more, 'more pose')} would decide {errors}."


def _gain(checked: Verification) -> str:
    """What a recalibration gains."""
    volume = f"Over the working volume, the delivered parameters are expected to err by {checked.volume:.2g} mm RMS"
    if not checked.same:
        volume += f", {checked.ratio_lower:.2g} to {checked.ratio_upper:.2g} times as much as the nominal ones (90 %)"
    left = f"a calibration with these poses by {checked.recalibrated:.2g} mm"
    if checked.gain > _LITTLE * checked.volume:
        return f"{volume}, and {left}: it would gain {checked.gain:.2g} mm."
    return f"{volume}, and {left}: it would gain nothing. More poses, in more places, determine the arm better."


def verification(summary: dict[str, Any]) -> View:
    """What people see of it."""
    yield Styled(summary["says"], STYLES[_VERDICTS[summary["verdict"]]])
    yield from filter(None, (summary["poses_say"], summary["gain_says"]))

    def lengths(row: dict[str, Any]) -> str:
        return ", ".join(f"{error:.3f}" for error in row["length_errors_mm"]) or "-"

    columns: dict[str, Any] = {
        "parameters": "parameters",
        "RMS error [mm]": "rms_mm",
        U_AT_LEVEL: "expanded_mm",
        "errors of lengths [mm]": lengths,
    }
    yield listed(f"{summary['arm']}; delivered: {summary['delivered']}", summary["accuracy"], columns)
    share, real = summary["share"], ""
    if share["value"] is not None:
        interval = f"{LEVEL_IN_PERCENT}: {share['lower']:.2f} to {share['upper']:.2f}"
        real = f"Real share of the difference: {share['value']:.2f} ({interval}). "
    poses = pluralise(summary["poses"], "pose")
    yield f"{real}{poses}, {summary['equations']} equations, {summary['unknowns']} unknowns."
    yield f"{_RMS_ERROR} {_REAL_SHARE}" if real else _RMS_ERROR
