"""Calibrations compared, on a terminal."""

import math
from typing import Any

from rich.console import Console
from rich.markup import escape

from ..core.units import people_read, people_read_change
from ..summaries.harmonics import listed_apart
from .display import (
    formatted,
    new_console,
    new_table,
    print_table,
    print_verdicts,
    print_warnings,
    print_written,
)

_COLUMNS = 9  # calibrations side by side


def comparison(summary: dict[str, Any]) -> None:
    """Findings in sentences, then the numbers: the last against the first; of three or more, all against the first."""
    console = new_console()
    console.print(
        f"[bold]{escape(summary['arm'])}[/bold]: {escape(summary['new'])} ({_day(summary['new_created'])}) against "
        f"{escape(summary['old'])} ({_day(summary['old_created'])})"
    )
    print_warnings(console, summary)
    for sentence in summary["findings"]:
        console.print(escape(sentence))
    _parameters(console, summary)
    _lengths(console, summary)
    if len(summary["trend"]) > 2:
        _trend(console, summary["trend"])
        _changes(console, summary["trend"])
    print_verdicts(console, summary)
    print_written(console, summary)


def _parameters(console: Console, summary: dict[str, Any]) -> None:
    """Values to the digits that the uncertainty of their change allows, changes in small units: um, arcsec."""
    table = new_table(
        f"\nParameters: change with its expanded uncertainty U ({100 * summary['level']:g} %)",
        "parameter", "unit", "old", "new", "unit", "change", "U", "",
    )  # fmt: skip
    names = _listed([summary["parameters"]])
    for row in (row for row in summary["parameters"] if row["parameter"] in names):
        (factor, unit), (fine, small_unit) = people_read(row["unit"]), people_read_change(row["unit"])
        expanded = row["expanded"]
        decimals = _decimals(None if expanded is None else factor * expanded, 5)
        small = _decimals(None if expanded is None else fine * expanded, 2)
        table.add_row(
            row["parameter"],
            unit,
            *(f"{factor * row[which]:.{decimals}f}" for which in ("old", "new")),
            small_unit,
            f"{fine * row['change']:+.{small}f}",
            "-" if expanded is None else f"{fine * expanded:.{small}f}",
            row["without"] or ("[bold]* beyond U[/bold]" if row["moved"] else ""),
        )
    print_table(console, table)
    if len(names) < len(summary["parameters"]):
        left_out = len(summary["parameters"]) - len(names)
        console.print(f"Not listed: {left_out} coefficients of harmonics that did not move beyond U; --json, --csv.")


def _listed(tables: list[list[dict[str, Any]]]) -> set[str]:
    """Names of the parameters to print: of hundreds of harmonics, those that moved."""
    moved = {row["parameter"] for rows in tables for row in rows if row["moved"]}
    return moved | {row["parameter"] for row in listed_apart(tables[0])[0]}


def _lengths(console: Console, summary: dict[str, Any]) -> None:
    found = summary["lengths"]
    title = f"\nLengths of {found['length_mm']:g} mm, new minus old, at {found['places']} positions in the volume [mm]"
    table = new_table(title, "RMS", "RMS by the uncertainties alone", "95th percentile", "largest", "mean")
    keys = ("rms_mm", "rms_by_chance_mm", "percentile_95_mm", "largest_mm", "mean_mm")
    table.add_row(*(formatted(found[key]) if found[key] is not None else "not determined" for key in keys))
    print_table(console, table)


def _trend(console: Console, rows: list[dict[str, Any]]) -> None:
    table = new_table(
        "\nEach calibration against the first (whose own error is in all of them)",
        *("", "calibration", "date", "beyond U", "p together"),
        *("RMS [mm]", "by chance [mm]", "largest [mm]", "mean [um/m]"),
    )
    table.columns[1].justify = "left"
    for number, row in enumerate(rows, start=1):
        cells = ["-"] * 6
        if number > 1:
            lengths = row["lengths"]
            cells = [
                str(row["moved"]),
                "-" if row["p"] is None else "< 0.0001" if row["p"] < 1e-4 else f"{row['p']:.2g}",
            ]
            cells += [formatted(lengths[key]) for key in ("rms_mm", "rms_by_chance_mm", "largest_mm")]
            cells.append(f"{lengths['mean_um_per_m']:+.1f}")
        table.add_row(str(number), escape(row["calibration"]), _day(row["created"]), *cells)
    print_table(console, table)


def _changes(console: Console, rows: list[dict[str, Any]]) -> None:
    """Change of every parameter from the first calibration, of many calibrations, the last ones."""
    shown = list(enumerate(rows, start=1))[1:][-_COLUMNS:]
    left_out = len(rows) - 1 - len(shown)
    title = "\nChange from the first calibration (*: beyond its uncertainty)"
    title += f", the last {_COLUMNS}; --csv and --json have all" if left_out else ""
    table = new_table(title, "parameter", "unit", *(str(number) for number, _ in shown))
    names = _listed([row["parameters"] for _, row in shown])
    for i, first in enumerate(shown[0][1]["parameters"]):
        if first["parameter"] not in names:
            continue
        fine, small_unit = people_read_change(first["unit"])
        cells = []
        for _, row in shown:
            found = row["parameters"][i]
            cells.append(
                f"{fine * found['change']:+.1f}" + ("*" if found["moved"] else "?" if found["moved"] is None else " ")
            )
        table.add_row(first["parameter"], small_unit, *cells)
    print_table(console, table)
    if any(row["moved"] is None for _, entry in shown for row in entry["parameters"]):
        console.print("?: without an uncertainty, since it is fixed, on a bound or not determined in one of the two.")


def _decimals(expanded: float | None, default: int) -> int:
    """Decimals that show two significant digits of an uncertainty."""
    return default if not expanded else min(max(1 - math.floor(math.log10(expanded)), 0), 9)


def _day(moment: str) -> str:
    return moment[:10]
