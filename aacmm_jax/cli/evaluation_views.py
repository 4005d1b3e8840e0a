"""What people see of evaluations, acceptance tests, and plans of acceptance tests."""

from typing import Any

from ..core.text import pluralise
from ..summaries.result_tables import BY_CONSTRUCTION, acceptance_tables, metrics_table, observations_table
from ..summaries.tables import (
    Cell,
    Styled,
    Table,
    decimals_for,
    formatted,
    limits_of,
    listed,
    number,
    verdict_of,
    warnings_of,
    written_of,
)
from .calibration_views import View, lengths, orientations

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
    yield from warnings_of({"warnings": summary.get("calibration_warnings", ())}, "Warning of the calibration:")
    for group, text in _GROUPS.items():
        part = summary[group]
        if part is None:
            continue
        fitted = part["fixed_by_one_length"]
        yield metrics_table(f"{text} [mm]", part, _ARMS, fixed_scale=fitted)
        predicted = part.get("predicted")
        of_prediction = {} if predicted is None else {"predicted [mm]": "rms_predicted_mm"}
        if part["sockets"]:
            columns = {"socket": "socket", "poses": "poses", "DE [mm]": "de_mm", "Deltam [mm]": "deltam_mm"}
            yield listed("", part["sockets"], columns | {"RMS [mm]": "rms_mm"} | of_prediction)
        yield from _observations(part, predicted is not None)
        if part["lengths"] and predicted is not None:
            yield _predicted_lengths(part["lengths"], fitted)
        elif part["lengths"]:
            yield lengths(part["lengths"], fixed_scale=fitted)
    yield from written_of(summary)


def _observations(part: dict[str, Any], predicted: bool) -> View:
    """Residuals of the other observations; of held-out ones also by kind, and by what shares a geometry or a length."""
    rows = part["observations"]
    if rows:
        yield observations_table("Observations, RMS distance of poses from their geometry [mm]", rows)
        yield from orientations(rows)
    if not predicted:
        return
    kinds, groups = part["kinds"], part["groups"]
    numbers: dict[str, Any] = {"poses": "poses", "RMS": "rms_mm", "predicted": "rms_predicted_mm"}
    numbers["in standard deviations"] = lambda row: number(row["reduced_chi"], 2)
    if len(kinds) > 1 and rows:
        yield listed("By kind [mm]", kinds, {"kind": "kind"} | numbers)
    if len(groups) > 1 and any(len(row["members"]) > 1 for row in groups):
        title = "Groups that share a length or an unknown geometry [mm]"
        yield listed(title, groups, {"group": "group"} | numbers)
    poses = part["predicted"]["poses"]
    if poses["rms_mm"] is not None:
        prediction = poses["rms_predicted_mm"]
        yield (
            f"All held-out poses: RMS {formatted(poses['rms_mm'])} mm, predicted "
            + (f"{formatted(prediction)} mm" if prediction is not None else "not, because something is not determined")
            + " by the uncertainty of the calibration and the noise."
        )


def _predicted_lengths(rows: list[dict[str, Any]], fitted: bool) -> Table:
    """Held-out reference lengths: U contains the uncertainty of the calibration and of the length, and the noise."""

    def to_u_digits(key: str) -> Any:
        return lambda row: number(row[key], decimals_for(row["expanded_mm"]))

    def ratio(row: dict[str, Any]) -> Cell:
        value = None if fitted else row["error_over_expanded"]
        return number(value, 2, signed=True, mark="bad" if value is not None and abs(value) > 1 else "")

    return listed("Reference lengths [mm]; U: 95 %", rows, {
        "between": lambda row: f"{row['from']} - {row['to']}",
        "value": "value_mm",
        "measured": to_u_digits("measured_mm"),
        "error": (lambda row: BY_CONSTRUCTION) if fitted else to_u_digits("error_mm"),
        "U": to_u_digits("expanded_mm"),
        "error / U": ratio,
    })  # fmt: skip


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
    yield (
        "U: the uncertainty of the artefacts"
        + (" and of the test (--test-u-mm, --expansion)" if of_test else "")
        + "."
        + (f" Decisions: {'; '.join(rules)}." if limited else "")
    )


def procedure(summary: dict[str, Any]) -> View:
    """A planned acceptance test: positions of the artefacts, and number of poses."""
    stated = "" if summary["measuring_range_stated"] else " (twice the reach; state the maker's)"
    yield [
        Styled(summary["arm"]),
        f": {summary['standard']}, {summary['poses']} poses. Measuring range {summary['measuring_range_mm']:.0f} mm"
        f"{stated}. Reach {summary['reach_mm']:.0f} mm from the shoulder at ({_at(summary['shoulder_mm'])}) mm",
    ]
    yield from warnings_of(summary)
    for bar in summary["bars"]:
        yield f"A bar of about {bar['length_mm']:.0f} mm, in {bar['positions']} positions"
    for sphere in summary["spheres"]:
        yield f"A sphere of {sphere['diameter_mm']:g} mm for the test '{sphere['test']}'"
    rows, by_name = [], {row["name"]: row for row in summary["items"]}
    for row in summary["items"]:
        bar, _, side = row["name"].rpartition("/")
        other = by_name.get(f"{bar}/b") if side == "a" else None
        if side == "b" and f"{bar}/a" in by_name:
            continue  # in the row of the bar's other end
        end, poses = ("", "") if other is None else (_at(other["position_mm"]), f" + {other['poses']}")
        name = row["name"] if other is None else bar
        rows.append((row["test"], name, row["group"], _at(row["position_mm"]), end, f"{row['poses']}{poses}"))
    headings = ("test", "name", "group", "at (x, y, z) [mm]", "to (x, y, z) [mm]", "poses")
    yield listed("", rows, headings)
    yield (
        "Checked: joint limits, reach, that nothing comes below the table, and that spheres are touched from outside. "
        "Not checked: obstacles, collisions of the arm with itself, and how artefacts are mounted."
    )
    yield from written_of(summary)


def _at(point: list[float]) -> str:
    return ", ".join(f"{value:.0f}" for value in point)
