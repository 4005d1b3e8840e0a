"""Parameters of a calibration and reference lengths on the terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape

from ..core.text import pluralise, shorten
from ..core.units import people_read, people_read_change
from ..summaries.harmonics import harmonics_by_joint, listed_apart
from ..summaries.tables import decimals_for
from .display import formatted, new_table, print_table


def print_parameters(console: Console, rows: list[dict[str, Any]]) -> None:
    """Every free parameter in its own unit, to two digits of its standard uncertainty; hundreds of coefficients joint
    by joint."""
    table = new_table(
        "\nFree parameters, with standard uncertainty u",
        *("parameter", "unit", "nominal", "calibrated", "change", "u", "bound"),
    )
    listed, harmonics = listed_apart(rows)
    for row in listed:
        factor, unit = people_read(row["unit"])
        nominal, value = factor * row["nominal"], factor * row["calibrated"]
        u = None if row["u"] is None else factor * row["u"]
        decimals = 9 if u == 0 else decimals_for(u)
        numbers = (
            f"{nominal:z.4f}",
            f"{value:z.{decimals}f}",
            f"{value - nominal:+z.{decimals}f}",
            "-" if u is None else f"{u:.{decimals}f}",
        )
        table.add_row(row["parameter"], unit, *numbers, row["bound"] or "")
    print_table(console, table)
    if harmonics:
        _harmonics(console, harmonics)


def _harmonics(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Coefficients of harmonics, joint by joint: their RMS over a revolution, and the largest."""
    title = "\nHarmonics of the joints; every coefficient: --json, or aacmm export --format csv"
    table = new_table(title, "joint", "coefficients", "orders", "unit", "RMS", "largest", "its value", "its u")
    for row in harmonics_by_joint(rows):
        factor, unit = people_read(row["unit"])
        largest = row["largest"]
        u = None if largest["u"] is None else factor * largest["u"]
        decimals = decimals_for(u)
        cells = (
            str(row["joint"]),
            str(row["coefficients"]),
            row["orders"],
            unit,
            f"{factor * row['rms']:.{decimals}f}",
        )
        value = f"{factor * largest['calibrated']:+z.{decimals}f}"
        table.add_row(*cells, largest["parameter"], value, formatted(u, decimals))
    print_table(console, table)


def print_corrections(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """The coefficients of an arm's corrections that are known, and what the others are."""
    known = [row for row in rows if row["value"] != 0]
    if known:
        table = new_table("\nJoint corrections", "coefficient", "value", "unit", "")
        for row in known:
            scale, unit = people_read_change(row["unit"]) if row["unit"] == "rad" else people_read(row["unit"])
            table.add_row(row["coefficient"], f"{scale * row['value']:.4g}", unit, row["of"])
        print_table(console, table)
    zero: dict[str, list[str]] = {}
    for row in rows:
        if row["value"] == 0 and row["of"]:  # not the direction of gravity
            zero.setdefault(row["of"], []).append(row["coefficient"])
    for of, names in zero.items():
        amount = pluralise(len(names), "coefficient")
        console.print(escape(f"Joint corrections of 0, until they are calibrated: {amount}, {of} ({shorten(names)})."))


def print_prior(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Each group of parameters that has a prior: its standard deviation, and how many of them the data determine."""
    columns = ("group", "standard deviation", "", "parameters", "determined by the data")
    table = new_table("\nPriors of the parameters", *columns)
    for row in rows:
        scale, unit = people_read(row["unit"])
        deviation = f"{row['sd'] * scale:.3g} {unit}".strip() if row["supported"] else "0: not supported by the data"
        counts = (str(row["parameters"]), f"{row['effective_parameters']:.1f}")
        table.add_row(escape(row["group"]), deviation, "learned" if row["learned"] else "given", *counts)
    print_table(console, table)


def print_lengths(console: Console, rows: list[dict[str, Any]], *, fitted: bool = False) -> None:
    """Reference lengths; ``fitted``: a single one fixed the scale, so that its error is zero by construction."""
    table = new_table("\nReference lengths", "between", "value [mm]", "measured [mm]", "error [mm]", "u of error [mm]")
    for row in rows:
        decimals = decimals_for(row["error_u_mm"])
        error = "fixed the scale" if fitted else formatted(row["error_mm"], decimals)
        table.add_row(
            escape(f"{row['from']} - {row['to']}"),
            formatted(row["value_mm"]),
            formatted(row["measured_mm"], decimals),
            error,
            formatted(row["error_u_mm"], decimals),
        )
    print_table(console, table)
