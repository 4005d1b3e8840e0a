"""The page of a verification: whether the maker's calibration is good, for who was not there."""

from typing import Any

from ..data.capture import Capture
from ..pipeline.verification import Verification
from ..plot.residuals import arms_chart
from ..summaries.verification import accuracy_table, counted, mark_of, meaning
from ..uncertainty.coverage import LEVEL_IN_PERCENT
from .elements import DRAWN, Report, Section


def _with_what_to_do(summary: dict[str, Any]) -> str:
    """The verdict with what to do in its headline."""
    headline, found, rest = summary["says"].partition(": ")
    return f"{headline} ({summary['do']}){found}{rest}"


def verification_report(checked: Verification, capture: Capture, summary: dict[str, Any]) -> Report:
    """The report of a verification, except for its origin, from its summary."""
    arms = {"nominal": checked.nominal, "delivered": checked.delivered}
    shown = {name: distances for name, distances in zip(arms, checked.distances, strict=True)}
    if checked.same:
        del arms["nominal"], shown["nominal"]
    picture = arms_chart(capture, shown, DRAWN, summary["max_rms_mm"])
    errors = [
        (
            f"RMS error, {name}",
            f"{found.rms:.3g} mm",
            f"{LEVEL_IN_PERCENT}: {found.lower:.3g} to {found.upper:.3g} mm; tip fitted",
        )
        for name, found in reversed(arms.items())
    ]
    volume = ("Expected over the working volume", f"{checked.volume:.2g} mm", "RMS, as delivered")
    found, not_tested = (summary["poses_say"], summary["gain_says"]), "; ".join(summary["not_tested"])
    left = f"over the working volume, in place of {checked.volume:.2g} mm"
    calibrated = ("After a calibration with these poses", f"at least {checked.recalibrated:.2g} mm", left)
    if "calibrated" in summary:
        tested = summary["calibrated"]
        calibrated = ("Calibrated, held-out poses", f"{tested['rms_mm']:.3g} mm", f"RMS; {tested['groups']} groups")
        found = (tested["says"], *found)
    return Report(
        title=f"Verification of delivered parameters, {summary['arm'] or 'an arm'}",
        subtitle=f"{counted(summary)} Delivered: {summary['delivered']}",
        verdict=_with_what_to_do(summary),
        verdict_mark=mark_of(summary),
        warnings=summary["warnings"],
        numbers=[
            *errors,
            *([volume] if checked.same and not checked.mismatch else []),
            *([] if checked.mismatch else [calibrated]),
        ],
        picture=picture._replace(table=None),
        one_page=True,
        facts=[],
        sections=[
            Section("found", "What was found", [*filter(None, found), accuracy_table(summary), meaning(summary)]),
            Section("not-tested", "What was not tested", [not_tested[:1].upper() + not_tested[1:] + "."]),
        ],
    )
