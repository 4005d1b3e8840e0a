"""Evaluations and acceptance tests on a terminal."""

from typing import Any

from rich.console import Console
from rich.markup import escape

from ..core.text import pluralise
from ..core.units import DEG
from ..summaries.tables import decimals_for
from .calibration_display import print_stages
from .display import (
    formatted,
    new_console,
    new_table,
    print_table,
    print_verdict,
    print_verdicts,
    print_warnings,
    print_written,
)
from .parameter_display import print_lengths

_STYLES = {"conforms": "green", "fails": "red", "undecided": "yellow", None: "default"}


def evaluation(summary: dict[str, Any]) -> None:
    """One evaluation: decisions first, then held-out data, since they are what counts."""
    console = new_console()
    console.print(f"[bold]{escape(summary['arm'])}[/bold]")
    print_verdict(console, summary)
    print_warnings(console, summary)
    print_verdicts(console, summary)
    if summary["acceptance"] or summary["standards"]:
        _acceptance(console, summary)
    for sentence in summary.get("calibration_warnings", ()):
        console.print(f"[yellow]Warning of the calibration:[/yellow] {escape(sentence)}")
    for group, text in (
        ("held_out", "Held-out data, which the calibration has not used"),
        ("identified_from", "Data used for identification"),
    ):
        part = summary[group]
        if part is None:
            continue
        fitted = part["fixed_by_one_length"]
        print_stages(console, f"\n{text} [mm]", part, ("nominal", "calibrated"), fitted=fitted)
        predicted = part.get("predicted")
        _sockets(console, part["sockets"], predicted is not None)
        _observations(console, part, predicted is not None)
        if part["lengths"] and predicted is not None:
            _predicted_lengths(console, part["lengths"], predicted, fitted)
        elif part["lengths"]:
            print_lengths(console, part["lengths"], fitted=fitted)
    print_written(console, summary)


def _sockets(console: Console, rows: list[dict[str, Any]], predicted: bool) -> None:
    """Repeatability socket by socket; of held-out ones, the predicted RMS too."""
    if not rows:
        return
    keys = ("de_mm", "deltam_mm", "rms_mm", *(["rms_predicted_mm"] if predicted else []))
    headings = ("DE [mm]", "Deltam [mm]", "RMS [mm]", *(["predicted [mm]"] if predicted else []))
    table = new_table("", "socket", "poses", *headings)
    for row in rows:
        table.add_row(escape(row["socket"]), str(row["poses"]), *(formatted(row[key]) for key in keys))
    print_table(console, table)


def _observations(console: Console, part: dict[str, Any], predicted: bool) -> None:
    """Residuals of the other observations; of held-out ones also by kind, and by what shares a geometry or a length."""
    rows = part["observations"]
    if rows:
        headings = ("nominal", "RMS", *(["predicted"] if predicted else []), "in s.d.")
        table = new_table(
            "\nObservations, RMS distance of poses from their geometry [mm]", "observation", "kind", "poses", *headings
        )
        keys = ("nominal_rms_mm", "rms_mm", *(["rms_predicted_mm"] if predicted else []))
        for row in rows:
            cells = (*(formatted(row[key]) for key in keys), formatted(row["reduced_chi"], 2))
            table.add_row(escape(row["observation"]), row["kind"], str(row["poses"]), *cells)
        print_table(console, table)
        for row in rows:
            if row["rms_angle_rad"] is not None:
                angle = row["rms_angle_rad"] / DEG
                console.print(f"Orientation of {escape(row['observation'])}: RMS {angle:.4f} deg.")
    if not predicted:
        return
    for what, key in (("kind", "kinds"), ("group", "groups")):
        alone = all(len(row["members"]) == 1 for row in part[key]) if key == "groups" else not rows
        if len(part[key]) > 1 and not alone:
            title = "\nBy kind [mm]" if key == "kinds" else "\nGroups that share a length or an unknown geometry [mm]"
            table = new_table(title, what, "poses", "RMS", "predicted", "in s.d.")
            for row in part[key]:
                cells = (
                    *(formatted(row[name]) for name in ("rms_mm", "rms_predicted_mm")),
                    formatted(row["reduced_chi"], 2),
                )
                table.add_row(escape(row[what]), str(row["poses"]), *cells)
            print_table(console, table)
    poses = part["predicted"]["poses"]
    if poses["rms_mm"] is not None:
        prediction = poses["rms_predicted_mm"]
        console.print(
            f"All held-out poses: RMS {formatted(poses['rms_mm'])} mm, predicted "
            + (f"{formatted(prediction)} mm" if prediction is not None else "not, because something is not determined")
            + " by the uncertainty of the calibration"
            + (" and the noise (in s.d.: in standard deviations)." if rows else " and the noise.")
        )


def _predicted_lengths(console: Console, rows: list[dict[str, Any]], predicted: dict[str, Any], fitted: bool) -> None:
    """Held-out reference lengths: U contains the uncertainty of the calibration and of the length, and the noise."""
    table = new_table("\nReference lengths [mm]; U: 95 %", "between", "value", "measured", "error", "U", "error / U")
    for row in rows:
        ratio = row["error_over_expanded"]
        decimals = decimals_for(row["expanded_mm"])
        error = "fixed the scale" if fitted else formatted(row["error_mm"], decimals)
        mark = "-" if ratio is None or fitted else f"{ratio:+.2f}"
        table.add_row(
            escape(f"{row['from']} - {row['to']}"),
            formatted(row["value_mm"]),
            formatted(row["measured_mm"], decimals),
            error,
            formatted(row["expanded_mm"], decimals),
            f"[red]{mark}[/red]" if ratio is not None and abs(ratio) > 1 and not fitted else mark,
        )
    print_table(console, table)


def report(summary: dict[str, Any]) -> None:
    """A report that was written."""
    console = new_console()
    console.print(f"[bold]{escape(summary['title'])}[/bold]: {escape(summary['verdict'])}")
    print_warnings(console, summary)
    console.print(f"Written: {escape(summary['written'])} ({summary['bytes'] / 1e6:.1f} MB; open it in a browser)")


def points(summary: dict[str, Any]) -> None:
    """Acceptance tests of points."""
    console = new_console()
    console.print(
        f"{pluralise(summary['points'], 'point')}: {pluralise(summary['sockets'], 'socket')}, "
        f"{pluralise(summary['lengths'], 'length')}, {pluralise(summary['spheres'], 'sphere')}"
    )
    print_verdict(console, summary)
    print_warnings(console, summary)
    _acceptance(console, summary)
    print_written(console, summary)


def _acceptance(console: Console, summary: dict[str, Any]) -> None:
    """One row a result, with its worst part; then what full procedures would need."""
    tests = summary["acceptance"]
    if not tests:
        console.print(
            "No acceptance test applies: there is no socket with several poses, no length and no sphere for it."
        )
        return
    before = any(metric["as_found_mm"] is not None for test in tests for metric in test["figures"])
    limited = any(metric["limit_mm"] is not None for test in tests for metric in test["figures"])
    headings = ["standard", "result", *(["as found"] if before else []), "as left" if before else "value", "U (k=2)"]
    table = new_table(
        "\nAcceptance tests, single readings [mm]", *headings, *(["MPE", "decision"] if limited else []), "worst at"
    )
    for test in tests:
        for metric in test["figures"]:
            decimals = decimals_for(metric["expanded_mm"])
            cells = [formatted(metric["as_found_mm"], decimals)] if before else []
            cells += [formatted(metric["value_mm"], decimals), formatted(metric["expanded_mm"] or None, decimals)]
            if limited:
                decision = metric["decision"]
                count = (
                    f" ({metric['failing']} of {len(metric['parts'])})"
                    if metric["failing"] and len(metric["parts"]) > 1
                    else ""
                )
                cells += [formatted(metric["limit_mm"]), f"[{_STYLES[decision]}]{decision or '-'}{count}[/]"]
            # Summaries that earlier versions stored name the standard only.
            table.add_row(test.get("called", test["standard"]), metric["name"], *cells, escape(metric["where"]))
    rules = dict.fromkeys(test.get("rule", "ISO 14253-1") for test in tests if test.get("decision", limited))
    of_test = summary["u_test_mm"] or any(summary.get("influences", {}).values())
    for column in table.columns[1], table.columns[-1]:
        column.justify = "left"
    print_table(console, table, keys=2)
    metrics = [metric for test in tests for metric in test["figures"]]
    symbols = [metric["symbol"] for metric in metrics if metric.get("symbol", metric["name"]) != metric["name"]]
    if symbols:
        console.print(f"Symbols: {', '.join(symbols)}.")
    for test in tests:
        if test["missing"]:
            console.print(f"{test.get('called', test['standard'])}, {test['title']}: not the full procedure.")
            for sentence in test["missing"]:
                console.print(f"  - {escape(sentence)}")
    console.print(
        "U: the uncertainty of the artefacts"
        + (" and of the test (--test-u-mm, --expansion)" if of_test else "")
        + "."
        + (f" Decisions: {'; '.join(rules)}." if limited else "")
        + (" As found: the nominal arm; as left: the calibrated one." if before else "")
    )


def procedure(summary: dict[str, Any]) -> None:
    """A planned acceptance test: positions of the artefacts, and number of poses."""
    console = new_console()
    x, y, z = summary["shoulder_mm"]
    stated = "" if summary["measuring_range_stated"] else " (twice the reach; state the maker's)"
    console.print(
        f"[bold]{escape(summary['arm'])}[/bold]: {summary['standard']}, {summary['poses']} poses. "
        f"Measuring range {summary['measuring_range_mm']:.0f} mm{stated}. "
        f"Reach {summary['reach_mm']:.0f} mm from the shoulder at ({x:.0f}, {y:.0f}, {z:.0f}) mm"
    )
    print_warnings(console, summary)
    for bar in summary["bars"]:
        console.print(f"A bar of about {bar['length_mm']:.0f} mm, in {bar['positions']} positions")
    for sphere in summary["spheres"]:
        console.print(f"A sphere of {sphere['diameter_mm']:g} mm for the test '{sphere['test']}'")
    table = new_table("", "test", "name", "group", "at (x, y, z) [mm]", "to (x, y, z) [mm]", "poses")
    table.columns[1].justify = "left"
    rows = {row["name"]: row for row in summary["items"]}
    for row in summary["items"]:
        base, _, side = row["name"].rpartition("/")
        other = rows.get(f"{base}/b") if side == "a" else None
        if side == "b" and f"{base}/a" in rows:
            continue  # in the row of the bar's other end
        end = "" if other is None else _position(other)
        poses = str(row["poses"]) + ("" if other is None else f" + {other['poses']}")
        table.add_row(
            row["test"], escape(base if other else row["name"]), str(row["group"]), _position(row), end, poses
        )
    print_table(console, table)
    console.print(
        "Checked: joint limits, reach, that nothing comes below the table, and that spheres are touched from outside. "
        "Not checked: obstacles, collisions of the arm with itself, and how artefacts are mounted."
    )
    print_written(console, summary)


def _position(row: dict[str, Any]) -> str:
    return ", ".join(f"{value:.0f}" for value in row["position_mm"])
