"""What `pipeline.verify` found, in numbers and sentences."""

from typing import Any

from ..calibration.agreement import CrossValidation
from ..core.text import pluralise
from ..pipeline.verification import LEVEL, MARGIN, Accuracy, Verification
from ..uncertainty.coverage import LEVEL_IN_PERCENT, U_AT_LEVEL
from .tables import STYLES, Styled, Table, View, listed, plain, warnings_of

VERDICT_MARKS = {"better": "good", "good": "good", "worse": "bad", "not good": "bad", "equivalent": "neutral"}
_LIKELY = 0.7  # of a limit: errors that D-H parameters do not describe come on top of a predicted RMS error
_LITTLE = 0.1  # of the RMS error: a smaller gain of a recalibration is none
_RMS_ERROR = (
    "RMS error: RMS distance of a pose from its socket, point or board position, after the tip of the tool and the "
    "frames and positions that no maker states were fitted; it includes the repeatability."
)
_REAL_SHARE = (
    "Real share: how much of the difference between nominal and delivered parameters these poses confirm: 1 all, 0.5 "
    "and less no improvement."
)


def verification_summary(
    checked: Verification,
    arm: str,
    delivered: str,
    scaled: bool = True,
    max_rms: float | None = None,
    calibrated: CrossValidation | None = None,
) -> dict[str, Any]:
    """What ``verify`` reports of the nominal arm and the delivered parameters with these names, mm; ``scaled`` says
    whether a certified length, a board or an instrument tests the scale, ``max_rms`` which RMS error the task
    allows, and ``calibrated`` are the held-out poses of a calibration."""
    enough = None if max_rms is None or checked.mismatch else _enough(checked.delivered, max_rms)
    rows = [
        {"parameters": name} | _accuracy(accuracy) | {"length_errors_mm": plain(errors)}
        for name, accuracy, errors in (
            ("nominal", checked.nominal, checked.length_errors[0]),
            ("delivered", checked.delivered, checked.length_errors[1]),
        )
    ]
    share = [None] * 3 if checked.same else [checked.share, checked.share_lower, checked.share_upper]
    held_out = {} if calibrated is None else {"calibrated": _held_out(checked, calibrated)}
    return held_out | {
        "kind": "verification",
        "arm": arm,
        "delivered": delivered,
        "verdict": checked.verdict,
        "max_rms_mm": max_rms,
        "enough": enough,
        "says": _verdict(checked) if max_rms is None or enough is None else _for_task(checked, max_rms, enough),
        "do": _to_do(checked, enough),
        "accuracy": [rows[1] | {"parameters": "delivered (nominal)"}] if checked.same else rows,
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
        "warnings": list(checked.warnings),
        "data_match": not checked.mismatch,
        "achieved": not checked.mismatch
        and (checked.verdict not in ("worse", "not good") if enough is None else enough == "yes"),
        "not_tested": [*_NOT_TESTED, *([] if scaled else ["the scale of the arm: no length is known"])],
    }


_NOT_TESTED = (
    "the tool, the place of the base, and other frames: they were fitted",
    "what the controller computes: only the stated parameters were tested",
    "the working volume far from these poses: the errors expected there follow from D-H parameters alone",
    "other loads, speeds and temperatures, and what changes with time",
)


def _held_out(checked: Verification, calibrated: CrossValidation) -> dict[str, Any]:
    """The error of a calibration in poses that it had not used, beside that of the delivered parameters."""
    groups = pluralise(len(calibrated.groups), "group")
    return {
        "rms_mm": calibrated.rms,
        "groups": len(calibrated.groups),
        "says": f"Calibrated: {calibrated.rms:.3g} mm RMS in held-out poses ({groups}, each held out once, with its "
        f"sockets and frames fitted again), in place of {checked.delivered.rms:.3g} mm as delivered (tip fitted).",
    }


def _accuracy(accuracy: Accuracy) -> dict[str, Any]:
    return {
        "rms_mm": accuracy.rms,
        "expanded_mm": accuracy.expanded,
        "lower_mm": accuracy.lower,
        "upper_mm": accuracy.upper,
        "degrees_of_freedom": accuracy.degrees_of_freedom,
    }


def _enough(error: Accuracy, limit: float) -> str:
    """Whether an RMS error is within a limit, by the interval at `coverage.LEVEL`."""
    return "yes" if error.upper <= limit else "no" if error.lower > limit else "not decided"


def _for_task(checked: Verification, limit: float, enough: str) -> str:
    """Whether the delivered parameters do for a task, and if not whether a calibration would; then the verdict."""
    beyond = int((checked.distances[1] > limit).sum())
    after = ""
    if enough != "yes":
        can = "would probably meet it" if checked.recalibrated <= _LIKELY * limit else "would probably not meet it"
        after = f"; a calibration {can} (at least {checked.recalibrated:.2g} mm)"
    answer = {"yes": "Good enough", "no": "Not good enough", "not decided": "Not decided whether good enough"}[enough]
    return f"{answer} for {limit:g} mm RMS: {beyond} of {checked.poses} poses beyond it{after}. {_verdict(checked)}"


def _to_do(checked: Verification, enough: str | None) -> str:
    """What to do, in a few words."""
    if checked.mismatch:
        return "correct the recording or the manifest"
    if enough == "no" or (enough is None and checked.verdict in ("worse", "not good")):
        return "calibrate"
    if enough == "not decided" or (enough is None and checked.verdict == "not decided"):
        return "record more poses in other places"
    return "keep either" if checked.verdict == "equivalent" else "keep the parameters"


def _verdict(checked: Verification) -> str:
    nominal, delivered = checked.nominal, checked.delivered
    of_delivered = f"{delivered.rms:.3g} mm RMS ({LEVEL_IN_PERCENT}: {delivered.lower:.3g} to {delivered.upper:.3g} mm)"
    if checked.mismatch:
        return f"Not decided: {checked.mismatch} ({of_delivered} with the delivered parameters and the tip fitted)."
    if checked.same:
        left = {
            "good": f"a calibration with these poses would gain less than {1 - MARGIN:.0%}",
            "not good": f"a calibration with these poses would leave at least {checked.recalibrated:.2g} mm: calibrate",
            "not decided": f"these poses do not show whether a calibration would gain more than {1 - MARGIN:.0%}",
        }[checked.verdict]
        return f"{checked.verdict.capitalize()}: {of_delivered} in these poses, with the tip fitted; {left}."
    against = (
        f"with the delivered parameters the tip errs by {of_delivered}, with the nominal ones by {nominal.rms:.3g} mm "
        "(in these poses, with the tip fitted)"
    )
    if checked.verdict == "not decided":
        return (
            f"Not decided: these poses do not show whether the delivered parameters are better than the nominal ones; "
            f"{against}."
        )
    if checked.verdict == "equivalent":
        return (
            "No difference that matters (equivalent): over the working volume the errors of the delivered and of the "
            f"nominal parameters differ by less than {1 - MARGIN:.0%} of the larger; {against}."
        )
    comparison = "better than" if checked.verdict == "better" else "worse than"
    return f"The delivered parameters are {comparison} the nominal ones: {against}."


def _poses(checked: Verification) -> str:
    """How many poses decide."""
    if checked.mismatch:
        return ""
    errors = f"(of two equally good sets, {50 * LEVEL:g} % are called better and {50 * LEVEL:g} % worse)"
    if checked.same:
        alone = "The delivered parameters are the nominal ones, so that they are compared with a calibration only."
        return alone + (" Record poses in other places, far apart." if checked.verdict == "not decided" else "")
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
    """What a recalibration gains; nothing where the data do not match the arm."""
    if checked.mismatch:
        return ""
    volume = f"Over the working volume, the delivered parameters are expected to err by {checked.volume:.2g} mm RMS"
    if not checked.same:
        volume += f", {checked.ratio_lower:.2g} to {checked.ratio_upper:.2g} times as much as the nominal ones (90 %)"
    left = f"{volume}, and D-H parameters of a calibration with these poses by at least {checked.recalibrated:.2g} mm"
    if checked.gain > _LITTLE * checked.volume:
        return (
            f"{left}: it would gain {checked.gain:.2g} mm at most. Bending and gear errors, which that leaves out, "
            "come on top: aacmm calibrate tests its result on held-out poses."
        )
    return f"{left}: it would gain nothing. More poses, in more places, determine the arm better."


def accuracy_table(summary: dict[str, Any]) -> Table:
    """The errors by the nominal and the delivered parameters, one row if these are the same."""

    def lengths(row: dict[str, Any]) -> str:
        return ", ".join(f"{error:.3f}" for error in row["length_errors_mm"]) or "-"

    columns: dict[str, Any] = {
        "parameters": "parameters",
        "RMS error, tip fitted [mm]": "rms_mm",
        U_AT_LEVEL: "expanded_mm",
        "errors of lengths [mm]": lengths,
    }
    return listed(f"{summary['arm']}; delivered: {summary['delivered']}", summary["accuracy"], columns)


def counted(summary: dict[str, Any]) -> str:
    """The real share, and how many poses, equations and unknowns there are."""
    share, shared = summary["share"], ""
    if share["value"] is not None:
        of_share = f"{share['value']:.2f} ({LEVEL_IN_PERCENT}: {share['lower']:.2f} to {share['upper']:.2f})"
        shared = f"Real share of the difference: {of_share}. "
    counts = f"{summary['equations']} equations, {summary['unknowns']} unknowns"
    return f"{shared}{pluralise(summary['poses'], 'pose')}, {counts}."


def meaning(summary: dict[str, Any]) -> str:
    """What the numbers are."""
    return _RMS_ERROR if summary["share"]["value"] is None else f"{_RMS_ERROR} {_REAL_SHARE}"


def mark_of(summary: dict[str, Any]) -> str:
    """The mark of the verdict: for the task, where its largest error was stated."""
    marks = {"yes": "good", "no": "bad", "not decided": "unsure"}
    return marks.get(summary["enough"]) or VERDICT_MARKS.get(summary["verdict"], "unsure")


def verification(summary: dict[str, Any]) -> View:
    """What people see of it."""
    yield Styled(summary["says"], STYLES[mark_of(summary)])
    held_out = summary["calibrated"]["says"] if "calibrated" in summary else ""
    yield from filter(None, (f"To do: {summary['do']}.", held_out, summary["poses_say"], summary["gain_says"]))
    yield from warnings_of(summary)
    yield accuracy_table(summary)
    yield counted(summary)
    yield meaning(summary)
    if "written" in summary:
        yield f"Written: {summary['written']}"
