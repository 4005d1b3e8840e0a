"""What people see of evaluations, acceptance tests, and plans of acceptance tests."""

from typing import Any

from ..core.text import pluralise
from ..summaries.tables import (
    Styled,
    Table,
    decimals_for,
    formatted,
    limits_of,
    listed,
    verdict_of,
    warnings_of,
    written_of,
)
from .calibration_views import View, by_stage, lengths, orientations

_STYLES = {"conforms": "green", "fails": "red", "undecided": "yellow", None: "default"}
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
        yield by_stage(f"\n{text} [mm]", part, ("nominal", "calibrated"), fitted=fitted)
        predicted = part.get("predicted")
        of_prediction = {} if predicted is None else {"predicted [mm]": "rms_predicted_mm"}
        if part["sockets"]:
            columns = {"socket": "socket", "poses": "poses", "DE [mm]": "de_mm", "Deltam [mm]": "deltam_mm"}
            yield listed("", part["sockets"], columns | {"RMS [mm]": "rms_mm"} | of_prediction)
        yield from _observations(part, predicted is not None)
        if part["lengths"] and predicted is not None:
            yield _predicted_lengths(part["lengths"], fitted)
        elif part["lengths"]:
            yield lengths(part["lengths"], fitted=fitted)
    yield from written_of(summary)


def _observations(part: dict[str, Any], predicted: bool) -> View:
    """Residuals of the other observations; of held-out ones also by kind, and by what shares a geometry or a length."""
    numbers: dict[str, Any] = {"RMS": "rms_mm"} | ({"predicted": "rms_predicted_mm"} if predicted else {})
    numbers["in s.d."] = lambda row: formatted(row["reduced_chi"], 2)
    rows = part["observations"]
    if rows:
        columns = {"observation": "observation", "kind": "kind", "poses": "poses", "nominal": "nominal_rms_mm"}
        yield listed("\nObservations, RMS distance of poses from their geometry [mm]", rows, columns | numbers)
        yield from orientations(rows)
    if not predicted:
        return
    kinds, groups = part["kinds"], part["groups"]
    if len(kinds) > 1 and rows:
        yield listed("\nBy kind [mm]", kinds, {"kind": "kind", "poses": "poses"} | numbers)
    if len(groups) > 1 and any(len(row["members"]) > 1 for row in groups):
        title = "\nGroups that share a length or an unknown geometry [mm]"
        yield listed(title, groups, {"group": "group", "poses": "poses"} | numbers)
    poses = part["predicted"]["poses"]
    if poses["rms_mm"] is not None:
        prediction = poses["rms_predicted_mm"]
        yield (
            f"All held-out poses: RMS {formatted(poses['rms_mm'])} mm, predicted "
            + (f"{formatted(prediction)} mm" if prediction is not None else "not, because something is not determined")
            + " by the uncertainty of the calibration"
            + (" and the noise (in s.d.: in standard deviations)." if rows else " and the noise.")
        )


def _predicted_lengths(rows: list[dict[str, Any]], fitted: bool) -> Table:
    """Held-out reference lengths: U contains the uncertainty of the calibration and of the length, and the noise."""
    cells = []
    for row in rows:
        ratio, decimals = row["error_over_expanded"], decimals_for(row["expanded_mm"])
        measured, error, expanded = (formatted(row[f"{key}_mm"], decimals) for key in ("measured", "error", "expanded"))
        mark: str | Styled = "-" if ratio is None or fitted else f"{ratio:+.2f}"
        if ratio is not None and abs(ratio) > 1 and not fitted:
            mark = Styled(mark, "red")
        ends = f"{row['from']} - {row['to']}"
        cells.append((ends, row["value_mm"], measured, "fixed the scale" if fitted else error, expanded, mark))
    headings = ("between", "value", "measured", "error", "U", "error / U")
    return Table("\nReference lengths [mm]; U: 95 %", headings, cells)


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
    metrics = [metric for test in tests for metric in test["figures"]]
    before = any(metric["as_found_mm"] is not None for metric in metrics)
    limited = any(metric["limit_mm"] is not None for metric in metrics)

    def decision(metric: dict[str, Any]) -> Styled:
        failing, parts = metric["failing"], len(metric["parts"])
        count = f" ({failing} of {parts})" if failing and parts > 1 else ""
        return Styled((metric["decision"] or "-") + count, _STYLES[metric["decision"]])

    rows = []
    for test in tests:
        for metric in test["figures"]:
            decimals = decimals_for(metric["expanded_mm"])
            cells = [formatted(metric["as_found_mm"], decimals)] if before else []
            cells += [formatted(metric["value_mm"], decimals), formatted(metric["expanded_mm"] or None, decimals)]
            cells += [metric["limit_mm"], decision(metric)] if limited else []
            # Summaries that earlier versions stored name the standard only.
            rows.append((test.get("called", test["standard"]), metric["name"], *cells, metric["where"]))
    headings = ["standard", "result", *(["nominal"] if before else []), "calibrated" if before else "value", "U (k=2)"]
    headings += [*(["MPE", "decision"] if limited else []), "worst at"]
    yield Table("\nAcceptance tests, single readings [mm]", headings, rows, left=(0, 1, -1), keys=2)
    symbols = [metric["symbol"] for metric in metrics if metric.get("symbol", metric["name"]) != metric["name"]]
    if symbols:
        yield f"Symbols: {', '.join(symbols)}."
    for test in tests:
        if test["missing"]:
            yield f"{test.get('called', test['standard'])}, {test['title']}: not the full procedure."
            yield from (f"  - {sentence}" for sentence in test["missing"])
    rules = dict.fromkeys(test.get("rule", "ISO 14253-1") for test in tests if test.get("decision", limited))
    of_test = summary["u_test_mm"] or any(summary.get("influences", {}).values())
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
    yield Table("", headings, rows, left=(0, 1))
    yield (
        "Checked: joint limits, reach, that nothing comes below the table, and that spheres are touched from outside. "
        "Not checked: obstacles, collisions of the arm with itself, and how artefacts are mounted."
    )
    yield from written_of(summary)


def _at(point: list[float]) -> str:
    return ", ".join(f"{value:.0f}" for value in point)
