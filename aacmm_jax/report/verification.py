"""The page of a verification: whether the maker's calibration is good, for who was not there."""

from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.text import pluralise
from ..data.capture import Capture, names_in
from ..pipeline.verification import Verification
from ..plot.residuals import Groups, arms_chart
from ..summaries.verification import accuracy_table, counted, length_errors, mark_of, meaning
from ..uncertainty.coverage import LEVEL_IN_PERCENT
from .elements import DRAWN, Report, Section


def _with_what_to_do(summary: dict[str, Any]) -> str:
    """The verdict with what to do in its headline."""
    headline, found, rest = summary["says"].partition(": ")
    return f"{headline} ({summary['do']}){found}{rest}"


def _held_out_in_order(calibration: CalibrationRecord, capture: Capture) -> np.ndarray | None:
    """Distances of the poses of a capture from their geometry when a calibration with these poses held them out, mm;
    None where it has other poses, or held out regions of joint space."""
    used, distances = calibration.recording.capture, np.full(len(capture.readings), np.nan)
    if names_in(used) != names_in(capture) or not np.array_equal(used.readings, capture.readings):
        return None
    groups = Groups.of(capture)
    for group in () if calibration.validation is None else calibration.validation.groups:
        poses = np.isin(np.asarray(groups.names)[groups.owner], group.sockets)
        if group.distances is None or poses.sum() != len(group.distances):
            return None
        distances[poses] = group.distances
    return distances if np.isfinite(distances).any() else None


def verification_report(
    checked: Verification, capture: Capture, summary: dict[str, Any], calibration: CalibrationRecord | None = None
) -> Report:
    """The report of a verification, except for its origin, from its summary; with the held-out poses of a calibration
    in its picture."""
    arms = {"nominal": checked.nominal, "delivered": checked.delivered}
    shown = {name: distances for name, distances in zip(arms, checked.distances, strict=True)}
    if checked.same:
        del arms["nominal"], shown["nominal"]
    calibrated_poses = None if calibration is None else _held_out_in_order(calibration, capture)
    if calibrated_poses is not None:
        shown = {"delivered": shown["delivered"], "calibrated": calibrated_poses}
    picture = arms_chart(capture, shown, DRAWN, summary["max_rms_mm"])
    held_out = "" if calibrated_poses is None else " Of the calibrated arm: each pose when it was held out."
    description = f"{picture.description}{held_out}"
    errors = [
        (
            f"RMS error, {name}",
            f"{found.rms:.3g} mm",
            f"{LEVEL_IN_PERCENT}: {found.lower:.3g} to {found.upper:.3g} mm; tip fitted",
        )
        for name, found in reversed(arms.items())
    ]
    tables = [] if checked.same else [accuracy_table(summary)]  # one row repeats the numbers beside the picture
    last = (length_errors(summary), f"{meaning(summary)} {counted(summary)}")
    volume = ("Expected over the working volume", f"{checked.volume:.2g} mm", "RMS, as delivered")
    found, not_tested = (summary["poses_say"], summary["gain_says"]), "; ".join(summary["not_tested"])
    left = f"over the working volume, in place of {checked.volume:.2g} mm"
    calibrated = ("After a calibration with these poses", f"at least {checked.recalibrated:.2g} mm", left)
    if "calibrated" in summary:
        tested = summary["calibrated"]
        calibrated = ("Calibrated, held-out poses", f"{tested['rms_mm']:.3g} mm", tested["of_poses"])
        found = (" ".join(filter(None, [tested["says"], summary["next"]])), *found[: 1 if checked.same else None])
    return Report(
        title=f"Verification of delivered parameters, {summary['arm'] or 'an arm'}",
        subtitle=f"{summary['tested']} {pluralise(checked.poses, 'pose')}.",
        verdict=_with_what_to_do(summary),
        verdict_mark=mark_of(summary),
        warnings=summary["warnings"],
        numbers=[
            *errors,
            *([volume] if checked.same and not checked.mismatch else []),
            *([] if checked.mismatch else [calibrated]),
        ],
        picture=picture._replace(table=None, description=description),
        one_page=True,
        facts=[],
        sections=[
            Section("found", "What was found", [*filter(None, found), *tables, *filter(None, last)]),
            Section("not-tested", "What was not tested", [not_tested[:1].upper() + not_tested[1:] + "."]),
        ],
    )
