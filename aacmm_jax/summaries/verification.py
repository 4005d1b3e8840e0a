"""What `pipeline.verify` found, in numbers and sentences."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

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
_WORDS = {"yes": "good enough", "no": "not good enough", "not decided": "not decided whether good enough"}


class Calibrated(NamedTuple):
    """A calibration of the arm, with its held-out poses, for who asks whether it meets what the task allows."""

    validation: CrossValidation
    file: str
    corrections: bool  # of its joints, which no URDF holds
    caution: str  # why it is to be used with care, in a sentence or two; empty where it is not

    def enough(self, limit: float) -> str:
        """Whether the RMS error of held-out poses is within a limit: by its interval, if there is one."""
        low, high = self.validation.interval or 2 * (self.validation.rms,)
        return "yes" if high <= limit else "no" if low > limit else "not decided"

    def says(self, limit: float | None) -> str:
        """The errors of held-out poses."""
        interval, distances = self.validation.interval, self.validation.distances
        said = f"{self.validation.rms:.3g} mm RMS"
        if interval is not None:
            said += f" ({LEVEL_IN_PERCENT}: {interval[0]:.3g} to {interval[1]:.3g} mm)"
        return f"{said} in held-out poses{''.join(f', {part}' for part in _of_poses(distances, limit))}"


def _of_poses(distances: np.ndarray | None, limit: float | None) -> list[str]:
    """How many are beyond a limit, and the largest; nothing where they are not known."""
    if distances is None or not len(distances):
        return []
    beyond = [] if limit is None else [f"{int((distances > limit).sum())} of {len(distances)} beyond {limit:g} mm"]
    return [*beyond, f"largest error {distances.max():.3g} mm"]


def verification_summary(
    checked: Verification,
    arm: str,
    delivered: str,
    scaled: bool = True,
    max_rms: float | None = None,
    calibrated: Calibrated | None = None,
    lengths: Sequence[str] = (),
) -> dict[str, Any]:
    """What ``verify`` reports of the nominal arm and the delivered parameters with these names, mm; ``scaled`` says
    whether a certified length, a board or an instrument tests the scale, ``max_rms`` which RMS error the task
    allows; ``calibrated`` has the held-out poses of a calibration, and ``lengths`` the names of the reference lengths.
    """
    enough = None if max_rms is None or checked.mismatch else _enough(checked.delivered, max_rms)
    meets = None if calibrated is None or max_rms is None or checked.mismatch else calibrated.enough(max_rms)
    does = _to_do(checked, enough, meets, calibrated)
    rows = [
        {"parameters": name} | _accuracy(accuracy) | {"length_errors_mm": plain(errors)}
        for name, accuracy, errors in (
            ("nominal", checked.nominal, checked.length_errors[0]),
            ("delivered", checked.delivered, checked.length_errors[1]),
        )
    ]
    share = [None] * 3 if checked.same else [checked.share, checked.share_lower, checked.share_upper]
    held_out = {} if calibrated is None else {"calibrated": _held_out(calibrated, max_rms, meets)}
    return held_out | {
        "kind": "verification",
        "arm": arm,
        "delivered": delivered,
        "verdict": checked.verdict,
        "max_rms_mm": max_rms,
        "enough": enough,
        "says": _says(checked, max_rms, enough, calibrated),
        "do": does,
        "next": "" if calibrated is None else _next(does, calibrated),
        "tested": _tested(checked, delivered),
        "lengths": list(lengths) or [f"length {i + 1}" for i in range(checked.length_errors.shape[1])],
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
        "same": checked.same,
        "volume_rms_mm": checked.volume,
        "recalibrated_rms_mm": checked.recalibrated,
        "gain_mm": checked.gain,
        "gain_says": _gain(checked, calibrated is not None),
        "warnings": [*checked.warnings, *filter(None, [calibrated.caution if calibrated is not None else ""])],
        "data_match": not checked.mismatch,
        "achieved": not checked.mismatch
        and (checked.verdict not in ("worse", "not good") if enough is None else "yes" in (enough, meets)),
        "not_tested": [*_NOT_TESTED, *([] if scaled else ["the scale of the arm: no length is known"])],
    }


_NOT_TESTED = (
    "the tool, the place of the base, and other frames: they were fitted",
    "what the controller computes: only the stated parameters were tested",
    "the working volume far from these poses: the errors expected there follow from D-H parameters alone",
    "other loads, speeds and temperatures, and what changes with time",
)


def _held_out(calibrated: Calibrated, limit: float | None, meets: str | None) -> dict[str, Any]:
    """The error of a calibration in poses that it had not used."""
    validation, found = calibrated.validation, calibrated.validation.distances
    distances = None if found is None or not len(found) else found
    low, high = validation.interval or (None, None)
    groups = pluralise(len(validation.groups), "group")
    return {
        "rms_mm": validation.rms,
        "lower_mm": low,
        "upper_mm": high,
        "groups": len(validation.groups),
        "poses": None if distances is None else len(distances),
        "beyond": None if distances is None or limit is None else int((distances > limit).sum()),
        "largest_mm": None if distances is None else float(distances.max()),
        "enough": meets,
        "of_poses": "; ".join(["RMS", *_of_poses(distances, limit)]),
        "says": f"Held-out poses: {groups}, each held out once, with its sockets and frames fitted again.",
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


def _says(checked: Verification, limit: float | None, enough: str | None, calibrated: Calibrated | None) -> str:
    """The verdict: for the task, where its largest error was stated, and on the calibrated arm, where it is given."""
    if limit is None or enough is None:
        if calibrated is None or checked.mismatch:
            return _verdict(checked)
        return f"{_verdict(checked, tested=True)} Calibrated: {calibrated.says(None)}."
    if calibrated is None:
        return _for_task(checked, limit, enough)
    said, of_poses = _of_delivered(checked), _of_poses(checked.distances[1], limit)[0]
    delivered = f"{said} with the tip fitted, {of_poses}"
    first = ("As delivered", enough, delivered)
    second = ("Calibrated", calibrated.enough(limit), calibrated.says(limit))
    if enough != "yes":
        first, second = second, first
    return (
        f"{first[0]}, {_WORDS[first[1]]} for {limit:g} mm RMS: {first[2]}. {second[0]}, {_WORDS[second[1]]}: "
        f"{second[2]}."
    )


def _for_task(checked: Verification, limit: float, enough: str) -> str:
    """Whether the delivered parameters do for a task, and if not whether a calibration would; then the verdict."""
    beyond, words = int((checked.distances[1] > limit).sum()), _WORDS[enough]
    after = ""
    if enough != "yes":
        can = "would probably meet it" if checked.recalibrated <= _LIKELY * limit else "would probably not meet it"
        after = f"; a calibration {can} (at least {checked.recalibrated:.2g} mm)"
    answer = f"{words.capitalize()} for {limit:g} mm RMS"
    return f"{answer}: {beyond} of {checked.poses} poses beyond {limit:g} mm{after}. {_verdict(checked)}"


_USE, _FIND = "use the calibration", "find the cause of the remaining errors"


def _to_do(checked: Verification, enough: str | None, meets: str | None, calibrated: Calibrated | None) -> str:
    """What to do, in a few words."""
    if checked.mismatch:
        return "correct the recording or the manifest"
    if meets is not None and enough != "yes":
        return {"yes": _USE, "no": _FIND}.get(meets, "record more poses in other places")
    if enough is None and calibrated is not None:
        gains = calibrated.validation.rms < MARGIN * checked.delivered.rms
        return _USE if gains else "keep either" if checked.verdict == "equivalent" else "keep the parameters"
    if enough == "no" or (enough is None and checked.verdict in ("worse", "not good")):
        return "calibrate"
    if enough == "not decided" or (enough is None and checked.verdict == "not decided"):
        return "record more poses in other places"
    return "keep either" if checked.verdict == "equivalent" else "keep the parameters"


def _next(does: str, calibrated: Calibrated) -> str:
    """How to use a calibration, or to improve it."""
    if does == _FIND:
        return f"The warnings of the calibration name causes: aacmm show {calibrated.file}"
    if does != _USE:
        return ""
    model = " of a calibration with --model dh" if calibrated.corrections else ""
    return (
        f"Write the parameters{model} to a URDF or a file of the controller (aacmm export), or, if the controller "
        "keeps the parameters tested here, correct targets "
        f"(aacmm correct {calibrated.file} TARGETS.csv -o corrected.csv)."
    )


def _tested(checked: Verification, delivered: str) -> str:
    """Which parameters were tested."""
    if checked.same:
        return "Tested as delivered: the published nominal parameters, not what your controller computes."
    return f"Delivered: {delivered}."


def _of_delivered(checked: Verification) -> str:
    found = checked.delivered
    return f"{found.rms:.3g} mm RMS ({LEVEL_IN_PERCENT}: {found.lower:.3g} to {found.upper:.3g} mm)"


def _verdict(checked: Verification, tested: bool = False) -> str:
    """Of the delivered parameters; ``tested``: a calibration was, so that nothing is predicted of it."""
    nominal, of_delivered = checked.nominal, _of_delivered(checked)
    if checked.mismatch:
        return f"Not decided: {checked.mismatch} ({of_delivered} with the delivered parameters and the tip fitted)."
    if checked.same:
        left = {
            "good": f"a calibration with these poses would gain less than {1 - MARGIN:.0%}",
            "not good": f"a calibration with these poses would leave at least {checked.recalibrated:.2g} mm: calibrate",
            "not decided": f"these poses do not show whether a calibration would gain more than {1 - MARGIN:.0%}",
        }[checked.verdict]
        after = "" if tested else f"; {left}"
        return f"{checked.verdict.capitalize()}: {of_delivered} in these poses, with the tip fitted{after}."
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
        return "Record poses in other places, far apart." if checked.verdict == "not decided" else ""
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


def _gain(checked: Verification, tested: bool) -> str:
    """What a recalibration gains; nothing of it where one was tested, or where the data do not match the arm."""
    if checked.mismatch:
        return ""
    volume = f"Over the working volume, the delivered parameters are expected to err by {checked.volume:.2g} mm RMS"
    if not checked.same:
        volume += f", {checked.ratio_lower:.2g} to {checked.ratio_upper:.2g} times as much as the nominal ones (90 %)"
    if tested:
        return f"{volume}."
    left = f"{volume}, and D-H parameters of a calibration with these poses by at least {checked.recalibrated:.2g} mm"
    if checked.gain > _LITTLE * checked.volume:
        return (
            f"{left}: it would gain {checked.gain:.2g} mm at most. Bending and gear errors, which that leaves out, "
            "come on top: aacmm calibrate tests its result on held-out poses."
        )
    return f"{left}: it would gain nothing. More poses, in more places, determine the arm better."


def accuracy_table(summary: dict[str, Any]) -> Table:
    """The errors by the nominal and the delivered parameters, one row if these are the same."""
    columns: dict[str, Any] = {
        "parameters": "parameters",
        "RMS error, tip fitted [mm]": "rms_mm",
        U_AT_LEVEL: "expanded_mm",
    }
    return listed(f"{summary['arm']}; delivered: {summary['delivered']}", summary["accuracy"], columns)


def length_errors(summary: dict[str, Any]) -> str:
    """The error of each reference length by its name, of the nominal and the delivered parameters."""
    if not summary["lengths"]:
        return ""
    said = []
    for row in summary["accuracy"]:
        errors = zip(summary["lengths"], row["length_errors_mm"], strict=True)
        said.append(f"{row['parameters']}: {', '.join(f'{name} {error:.3f}' for name, error in errors)}")
    return f"Errors of lengths between the centroids of poses in two sockets [mm], {'; '.join(said)}."


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
    """The mark of the verdict: for the task, where its largest error was stated, of the calibrated arm if it was tested
    and the delivered parameters are not good enough."""
    marks, enough = {"yes": "good", "no": "bad", "not decided": "unsure"}, summary["enough"]
    if enough != "yes" and "calibrated" in summary:
        enough = summary["calibrated"]["enough"]
    return marks.get(enough) or VERDICT_MARKS.get(summary["verdict"], "unsure")


def verification(summary: dict[str, Any]) -> View:
    """What people see of it."""
    yield Styled(summary["says"], STYLES[mark_of(summary)])
    held_out = summary["calibrated"]["says"] if "calibrated" in summary else ""
    said = f"To do: {summary['do']}.", summary["next"], held_out, summary["tested"] if summary["same"] else ""
    yield from filter(None, (*said, summary["poses_say"], summary["gain_says"]))
    yield from warnings_of(summary)
    yield accuracy_table(summary)
    yield from filter(None, (length_errors(summary), counted(summary)))
    yield meaning(summary)
    if "written" in summary:
        yield f"Written: {summary['written']}"
