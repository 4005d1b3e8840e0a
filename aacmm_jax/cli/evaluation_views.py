"""What people see of evaluations, acceptance tests and reports."""

from typing import Any

from ..core.text import pluralise
from ..core.units import DEG
from ..summaries.result_tables import acceptance_tables, metrics_table, observations_table
from ..summaries.tables import Styled, View, formatted, limits_of, listed, number, verdict_of, warnings_of, written_of
from .calibration_views import lengths

_ARMS = {"nominal": "nominal", "calibrated": "calibrated"}
_GROUPS = {
    "held_out": "Held-out data, which the calibration has not used",
    "identified_from": "Data used for identification",
}


def evaluation(summary: dict[str, Any]) -> View:
    """One evaluation: decisions first, then held-out data, since they are what counts."""
    yield Styled(summary["arm"])
    yield from verdict_of(summary)
    yield from warnings_of(summary)
    yield from limits_of(summary)
    if summary["acceptance"] or summary["standards"]:
        yield from _acceptance(summary)
    yield from warnings_of(summary, "Warning of the calibration:", "calibration_warnings")
    for group, text in _GROUPS.items():
        part = summary[group]
        if part is None:
            continue
        fixed_scale, predicted = part["fixed_by_one_length"], part.get("predicted") is not None
        yield metrics_table(f"{text} [mm]", part, _ARMS, fixed_scale=fixed_scale)
        if part["sockets"]:
            yield listed("", part["sockets"], {
                "socket": "socket",
                "poses": "poses",
                "DE [mm]": "de_mm",
                "Deltam [mm]": "deltam_mm",
                "RMS [mm]": "rms_mm",
                "predicted [mm]": "rms_predicted_mm" if predicted else None,
            })  # fmt: skip
        if part["observations"]:
            title = "Observations, RMS distance of poses from their geometry [mm]"
            yield observations_table(title, part["observations"])
        for row in part["observations"]:
            if row["rms_angle_rad"] is not None:
                yield f"Orientation of {row['observation']}: RMS {row['rms_angle_rad'] / DEG:.4f} deg."
        if predicted:
            yield from _predicted(part)
        if part["lengths"]:
            yield lengths(part["lengths"], fixed_scale=fixed_scale, predicted=predicted)
    yield from written_of(summary)


def _predicted(part: dict[str, Any]) -> View:
    """Residuals of held-out data by kind, and by what shares a geometry or a length."""
    kinds, groups, poses = part["kinds"], part["groups"], part["predicted"]["poses"]
    numbers: dict[str, Any] = {"poses": "poses", "RMS": "rms_mm", "predicted": "rms_predicted_mm"}
    numbers["in standard deviations"] = lambda row: number(row["reduced_chi"], 2)
    if len(kinds) > 1 and part["observations"]:
        yield listed("By kind [mm]", kinds, {"kind": "kind"} | numbers)
    if len(groups) > 1 and any(len(row["members"]) > 1 for row in groups):
        title = "Groups that share a length or an unknown geometry [mm]"
        yield listed(title, groups, {"group": "group"} | numbers)
    if poses["rms_mm"] is not None:
        prediction = poses["rms_predicted_mm"]
        predicted = "not, because something is not determined" if prediction is None else f"{formatted(prediction)} mm"
        yield (
            f"All held-out poses: RMS {formatted(poses['rms_mm'])} mm, predicted {predicted} by the uncertainty of the "
            "calibration and the noise."
        )


def report(summary: dict[str, Any]) -> View:
    """A report that was written."""
    yield [Styled(summary["title"]), f": {summary['verdict']}"]
    yield from warnings_of(summary)
    yield f"Written: {summary['written']} ({summary['bytes'] / 1e6:.1f} MB; open it in a browser)"


def points(summary: dict[str, Any]) -> View:
    """Acceptance tests of points."""
    counts = (pluralise(summary[f"{noun}s"], noun) for noun in ("socket", "length", "sphere"))
    yield f"{pluralise(summary['points'], 'point')}: {', '.join(counts)}"
    yield from verdict_of(summary)
    yield from warnings_of(summary)
    yield from _acceptance(summary)
    yield from written_of(summary)


def _acceptance(summary: dict[str, Any]) -> View:
    """Every metric with its limit, and what the full procedure of each test would need."""
    tests = summary["acceptance"]
    if not tests:
        yield "No acceptance test applies: there is no socket with several poses, no length and no sphere for it."
        return
    yield "\nAcceptance tests, single readings"
    for test, metrics in zip(tests, acceptance_tables(tests, brief=True), strict=True):
        yield metrics
        if test["missing"]:
            yield "Not the full procedure:"
            yield from (f"  - {sentence}" for sentence in test["missing"])
    limited = any(metric["limit_mm"] is not None for test in tests for metric in test["figures"])
    rules = dict.fromkeys(test["rule"] for test in tests if test["decision"])
    of_test = summary["u_test_mm"] or any(summary["influences"].values())
    stated = " and of the test (--test-u-mm, --expansion)" if of_test else ""
    yield f"U: the uncertainty of the artefacts{stated}." + (f" Decisions: {'; '.join(rules)}." if limited else "")
