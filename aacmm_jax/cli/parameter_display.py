"""The free parameters of a calibration on a terminal: one by one, and hundreds of coefficients by groups."""

from typing import Any

from rich.console import Console

from ..core.text import pluralise
from ..core.units import people_read, people_read_change
from ..summaries.tables import decimals_for
from .display import new_table, print_table

_MOST_ROWS = 60  # parameters that are printed one by one


def print_parameters(console: Console, rows: list[dict[str, Any]]) -> None:
    """Every free parameter; of many coefficients of joint corrections a line for each group."""
    if len(rows) <= _MOST_ROWS:
        _every(console, rows)
        return
    from ..summaries.calibration import coefficient_groups

    groups = coefficient_groups(rows)
    grouped = {name for group in groups for name in group["names"]}
    _every(console, [row for row in rows if row["parameter"] not in grouped])
    table = new_table(
        f"\n{pluralise(len(grouped), 'coefficient')} of joint corrections by group, one by one with --json",
        *("group", "unit", "coefficients", "RMS", "largest", "u", "of", "joint"),
    )
    for group in groups:
        factor, unit = people_read_change(group["unit"])
        values = (None if value is None else factor * value for value in (group["rms"], group["largest"], group["u"]))
        cells = ("-" if value is None else f"{value:.3g}" for value in values)
        joint = "-" if group["joint"] is None else str(group["joint"])
        table.add_row(group["group"], unit, str(group["parameters"]), *cells, group["of"], joint)
    print_table(console, table)


def _every(console: Console, rows: list[dict[str, Any]]) -> None:
    """Each parameter in its own unit, to two digits of its standard uncertainty."""
    table = new_table(
        "\nFree parameters, with standard uncertainty u",
        *("parameter", "unit", "nominal", "calibrated", "change", "u", "bound"),
    )
    for row in rows:
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
