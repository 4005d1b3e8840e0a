"""Evaluations and acceptance tests on a terminal."""

from typing import Any

from rich.console import Console
from rich.markup import escape

from ..core.text import pluralise
from .calibration_display import print_lengths, print_stages
from .display import (
    formatted,
    new_console,
    new_table,
    print_table,
    print_verdicts,
    print_warnings,
    print_written,
)

_STYLES = {"conforms": "green", "fails": "red", "undecided": "yellow", None: "default"}


def evaluation(summary: dict[str, Any]) -> None:
    """One evaluation: held-out sockets come first, since they are what counts."""
    console = new_console()
    console.print(f"[bold]{escape(summary['arm'])}[/bold]")
    print_warnings(console, summary)
    for group, text in (
        ("held_out", "Held-out sockets, which the calibration has not used"),
        ("identified_from", "Sockets used for identification"),
    ):
        part = summary[group]
        if part is None:
            continue
        fitted = part["fixed_by_one_length"]
        print_stages(console, f"\n{text} [mm]", part, ("nominal", "calibrated"), fitted=fitted)
        table = new_table("", "socket", "poses", "DE [mm]", "Deltam [mm]", "RMS [mm]")
        for row in part["sockets"]:
            cells = (formatted(row[key]) for key in ("de_mm", "deltam_mm", "rms_mm"))
            table.add_row(escape(row["socket"]), str(row["poses"]), *cells)
        print_table(console, table)
        if part["lengths"]:
            print_lengths(console, part["lengths"], fitted=fitted)
    print_verdicts(console, summary)
    _acceptance(console, summary)
    print_written(console, summary)


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
    print_warnings(console, summary)
    _acceptance(console, summary)
    print_written(console, summary)


def _acceptance(console: Console, summary: dict[str, Any]) -> None:
    """One row a result, with its worst part; then what full procedures would need."""
    tests = summary["acceptance"]
    if not tests:
        console.print("No acceptance test applies: there is no socket with several poses, no length and no sphere.")
        return
    before = any(metric["as_found_mm"] is not None for test in tests for metric in test["figures"])
    limited = any(metric["limit_mm"] is not None for test in tests for metric in test["figures"])
    headings = ["standard", "result", *(["as found"] if before else []), "as left" if before else "value", "U (k=2)"]
    table = new_table(
        "\nAcceptance tests, single readings [mm]", *headings, *(["MPE", "decision"] if limited else []), "worst at"
    )
    for test in tests:
        for metric in test["figures"]:
            cells = [formatted(metric["as_found_mm"])] if before else []
            cells += [formatted(metric["value_mm"]), formatted(metric["expanded_mm"] or None)]
            if limited:
                decision = metric["decision"]
                count = (
                    f" ({metric['failing']} of {len(metric['parts'])})"
                    if metric["failing"] and len(metric["parts"]) > 1
                    else ""
                )
                cells += [formatted(metric["limit_mm"]), f"[{_STYLES[decision]}]{decision or '-'}{count}[/]"]
            table.add_row(test["standard"], metric["name"], *cells, escape(metric["where"]))
    for column in table.columns[1], table.columns[-1]:
        column.justify = "left"
    print_table(console, table, keys=2)
    for test in tests:
        if test["missing"]:
            lacking = "; ".join(test["missing"])
            console.print(
                f"Not the full procedure of {test['standard']}, {test['title']}: it also needs {escape(lacking)}."
            )
    console.print(
        "U: the uncertainty of the artefacts"
        + (" and --test-u-mm" if summary["u_test_mm"] else "")
        + "."
        + (" Decisions by ISO 14253-1." if limited else "")
        + (" As found: the nominal arm; as left: the calibrated one." if before else "")
    )


def procedure(summary: dict[str, Any]) -> None:
    """A planned acceptance test: positions of the artefacts, and number of poses."""
    console = new_console()
    x, y, z = summary["shoulder_mm"]
    console.print(
        f"[bold]{escape(summary['arm'])}[/bold]: {summary['standard']}, {summary['poses']} poses. "
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
