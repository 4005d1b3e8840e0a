"""Evaluations and acceptance tests on a terminal."""

from typing import Any

from rich.console import Console
from rich.markup import escape

from .display import _console, _lengths, _number, _stages, _table, _verdicts, _warnings, _written

_STYLES = {"conforms": "green", "fails": "red", "undecided": "yellow", None: "default"}


def evaluation(summary: dict[str, Any]) -> None:
    """One evaluation: held-out sockets first, since they are what counts."""
    console = _console()
    console.print(f"[bold]{escape(summary['arm'])}[/bold]")
    _warnings(console, summary)
    for group, text in (("held_out", "Sockets never identified from"), ("identified_from", "Sockets identified from")):
        part = summary[group]
        if part is None:
            continue
        _stages(console, f"\n{text} [mm]", part, ("nominal", "calibrated"))
        table = _table("", "socket", "poses", "DE [mm]", "Deltam [mm]", "RMS [mm]")
        for row in part["sockets"]:
            cells = (_number(row[key]) for key in ("de_mm", "deltam_mm", "rms_mm"))
            table.add_row(escape(row["socket"]), str(row["poses"]), *cells)
        console.print(table)
        if part["lengths"]:
            _lengths(console, part["lengths"])
    _verdicts(console, summary)
    _acceptance(console, summary)
    _written(console, summary)


def report(summary: dict[str, Any]) -> None:
    """A report that was written."""
    console = _console()
    console.print(f"[bold]{escape(summary['title'])}[/bold]: {escape(summary['verdict'])}")
    _warnings(console, summary)
    console.print(
        f"Written: {escape(summary['written'])} ({summary['bytes'] / 1e6:.1f} MB; open it in a browser, print it from there)"
    )


def points(summary: dict[str, Any]) -> None:
    """Acceptance tests of points."""
    console = _console()
    console.print(
        f"{summary['points']} points: {summary['sockets']} sockets, {summary['lengths']} lengths, {summary['spheres']} spheres"
    )
    _warnings(console, summary)
    _acceptance(console, summary)
    _written(console, summary)


def _acceptance(console: Console, summary: dict[str, Any]) -> None:
    """One row a figure, with its worst part; then what full procedures would need."""
    tests = summary["acceptance"]
    if not tests:
        console.print(
            "There is nothing here that an acceptance test looks at: no socket of several poses, no length, no sphere."
        )
        return
    before = any(figure["as_found_mm"] is not None for test in tests for figure in test["figures"])
    limited = any(figure["limit_mm"] is not None for test in tests for figure in test["figures"])
    headings = ["standard", "figure", *(["as found"] if before else []), "as left" if before else "value", "U (k=2)"]
    table = _table(
        "\nAcceptance figures, single readings [mm]", *headings, *(["MPE", "decision"] if limited else []), "worst at"
    )
    for test in tests:
        for figure in test["figures"]:
            cells = [_number(figure["as_found_mm"])] if before else []
            cells += [_number(figure["value_mm"]), _number(figure["expanded_mm"] or None)]
            if limited:
                decision = figure["decision"]
                count = (
                    f" ({figure['failing']} of {len(figure['parts'])})"
                    if figure["failing"] and len(figure["parts"]) > 1
                    else ""
                )
                cells += [_number(figure["limit_mm"]), f"[{_STYLES[decision]}]{decision or '-'}{count}[/]"]
            table.add_row(test["standard"], figure["name"], *cells, escape(figure["where"]))
    for column in table.columns[1], table.columns[-1]:
        column.justify = "left"
    console.print(table)
    for test in tests:
        if test["missing"]:
            lacking = "; ".join(test["missing"])
            console.print(f"Not the full procedure of {test['standard']}, {test['title']}: it also needs {escape(lacking)}.")
    console.print(
        "U is what the artefacts" + (" and --test-u-mm" if summary["u_test_mm"] else "") + " bring; decisions by ISO 14253-1."
    )


def procedure(summary: dict[str, Any]) -> None:
    """A planned acceptance test: what stands where, and how many poses to take."""
    console = _console()
    x, y, z = summary["shoulder_mm"]
    console.print(
        f"[bold]{escape(summary['arm'])}[/bold]: {summary['standard']}, {summary['poses']} poses. "
        f"Reach {summary['reach_mm']:.0f} mm from the shoulder at ({x:.0f}, {y:.0f}, {z:.0f}) mm"
    )
    _warnings(console, summary)
    for bar in summary["bars"]:
        console.print(f"A bar of about {bar['length_mm']:.0f} mm, in {bar['positions']} positions")
    for sphere in summary["spheres"]:
        console.print(f"A sphere of {sphere['diameter_mm']:g} mm for the test '{sphere['test']}'")
    table = _table("", "test", "name", "group", "at (x, y, z) [mm]", "to (x, y, z) [mm]", "poses")
    table.columns[1].justify = "left"
    rows = {row["name"]: row for row in summary["items"]}
    for row in summary["items"]:
        base, _, side = row["name"].rpartition("/")
        other = rows.get(f"{base}/b") if side == "a" else None
        if side == "b" and f"{base}/a" in rows:
            continue  # stands in the row of the bar's other end
        end = "" if other is None else _place(other)
        poses = str(row["poses"]) + ("" if other is None else f" + {other['poses']}")
        table.add_row(row["test"], escape(base if other else row["name"]), str(row["group"]), _place(row), end, poses)
    console.print(table)
    console.print(
        "Looked at: joint limits, reach, that nothing comes below the table, and that spheres are touched from outside. Not looked at: "
        "obstacles, the arm's own body, and how artefacts are held."
    )
    _written(console, summary)


def _place(row: dict[str, Any]) -> str:
    return ", ".join(f"{value:.0f}" for value in row["position_mm"])
