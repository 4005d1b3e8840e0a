"""A study's results on a terminal: means with the standard error of their last digits in parentheses."""

from typing import Any

from rich.console import Console
from rich.markup import escape

from ..core.units import error_unit
from ..study.statistics import METRICS, concise, factor_title, level_text, level_title, metric_title, shown_unit
from .display import new_console, new_table, print_table

_MOST = 40  # cells in a table
_OVERVIEW = {
    "k": "k",
    "de": "DE [mm]",
    "deltam": "Deltam [mm]",
    "length_error_stage1": "length error before [mm]",
    "length_error": "and after [mm]",
    "angle_error": "angle error [arcsec]",
}
_STAGE1 = {
    "scale": "scale",
    "de_stage1": "DE [mm]",
    "deltam_stage1": "Deltam [mm]",
    "length_error_stage1": "length error [mm]",
    "angle_error_stage1": "angle error [arcsec]",
}


def _both(pair: dict[str, Any] | None, factor: float = 1.0) -> str:
    if pair is None or pair["value"] is None:
        return "-"
    return concise(factor * pair["value"], None if pair["se"] is None else factor * pair["se"])


def _percent(pair: dict[str, Any]) -> str:
    return _both(pair, 100.0)


def _text(level: float | str) -> str:
    return escape(level_text(level))


def study(summary: dict[str, Any]) -> None:
    """All cells: what converged, the mean of every metric, then standard deviations and percentiles."""
    console = new_console()
    _heading(console, summary)
    cells = [cell for cell in summary["results"] if cell["trials_run"]]
    if not cells:
        console.print("No trial has ended yet.")
        return
    shown, factors = cells[:_MOST], list(summary["factors"])
    names = [factor_title(name) for name in factors]
    _identified(console, shown, names)
    fixed = any("de" in cell["figures"] for cell in cells)
    metrics = _OVERVIEW if fixed else _STAGE1
    table = new_table("\nMeans over converged trials", "cell", *names, *metrics.values())
    for cell in shown:
        values = (_both(cell["figures"].get(name, {}).get("mean"), shown_unit(name)[1]) for name in metrics)
        table.add_row(str(cell["cell"]), *map(_text, cell["factors"].values()), *values)
    print_table(console, table)
    if len(cells) > 1:
        _distributions(
            console, shown, ("length_error", "angle_error") if fixed else ("length_error_stage1", "angle_error_stage1")
        )
    if len(cells) > len(shown):
        console.print(f"\n{len(cells) - len(shown)} more cells: see them with --json, or aacmm_jax.study.open_study.")
    console.print(
        "\nDigits in parentheses: Monte Carlo standard error of the last digits. Length and angle error: the largest "
        "of all parameters."
    )
    if len(cells) == 1:
        _full(console, cells[0])
    else:
        console.print("One cell in full, with every parameter's bias: --cell N. Figures: --figures FOLDER.")
    _written(console, summary)


def one_cell(summary: dict[str, Any]) -> None:
    """One cell in full."""
    console = new_console()
    _heading(console, summary)
    for cell in summary["results"]:
        levels = ", ".join(escape(level_title(name, level)) for name, level in cell["factors"].items())
        console.print(f"Cell {cell['cell']}{': ' + levels if levels else ''}")
        if cell["trials_run"]:
            _identified(console, [cell], [factor_title(name) for name in cell["factors"]])
            _full(console, cell)
        else:
            console.print("No trial of it has ended yet.")
    _written(console, summary)


def _heading(console: Console, summary: dict[str, Any]) -> None:
    console.print(
        f"[bold]{escape(summary['name'] or 'Study')}[/bold] of {escape(summary['arm'])}: {summary['cells']} cells of "
        f"{summary['trials']:,} trials, seed {summary['seed']}"
    )
    if not summary["finished"]:
        console.print(f"[yellow]Not finished:[/yellow] {summary['trials_run']:,} trials so far.")


def _identified(console: Console, cells: list[dict[str, Any]], names: list[str]) -> None:
    often = [_most_often_on_a_bound(cell) for cell in cells]
    headings = ["cell", *names, "trials", "converged [%]", "truth within bounds [%]", "on a bound [%]"]
    table = new_table("\nIdentifications", *headings, *(["most often"] if any(often) else []))
    for cell, parameter in zip(cells, often, strict=True):
        rates = (_percent(cell[key]) for key in ("converged", "truth_inside", "on_a_bound"))
        levels = map(_text, cell["factors"].values())
        last = [parameter] if any(often) else []
        table.add_row(str(cell["cell"]), *levels, f"{cell['trials_run']:,}", *rates, *last)
    print_table(console, table)
    words = {
        "max_steps": "reached the step limit",
        "stalled": "stalled",
        "nonfinite": "had a pose that the true arm cannot take",
    }
    failed = {reason: sum(cell["reasons"][reason] for cell in cells) for reason in words}
    for reason, count in failed.items():
        if count:
            console.print(
                f"[yellow]{count:,} trial{'s' if count > 1 else ''} {words[reason]};[/yellow] left out of the means."
            )


def _most_often_on_a_bound(cell: dict[str, Any]) -> str:
    """The parameter that is on a bound in most trials, and in how many; empty if none ever is."""
    worst = max(cell["parameters"], key=lambda row: row["on_a_bound"]["value"], default=None)
    if worst is None or not worst["on_a_bound"]["value"]:
        return ""
    return f"{worst['parameter']} {_percent(worst['on_a_bound'])} %"


def _distributions(console: Console, cells: list[dict[str, Any]], names: tuple[str, ...]) -> None:
    for name in names:
        title = metric_title(name)
        table = new_table(
            f"\n{title[0].upper()}{title[1:]}", "cell", "mean", "standard deviation", "5 %", "50 %", "95 %"
        )
        for cell in cells:
            if name in cell["figures"]:
                table.add_row(str(cell["cell"]), *_row(cell, name))
        if table.row_count:
            print_table(console, table)


def _row(cell: dict[str, Any], metric: str) -> list[str]:
    statistics, (_, factor) = cell["figures"][metric], shown_unit(metric)
    return [_both(statistics.get(key), factor) for key in ("mean", "spread", "p5", "p50", "p95")]


def _full(console: Console, cell: dict[str, Any]) -> None:
    table = new_table("\nMetrics over converged trials", "", "mean", "standard deviation", "5 %", "50 %", "95 %")
    for name in METRICS:
        if name in cell["figures"]:
            table.add_row(escape(metric_title(name)), *_row(cell, name))
    print_table(console, table)
    table = new_table(
        "\nParameters: estimate less truth", "parameter", "unit", "bias", "standard deviation", "on a bound [%]",
    )  # fmt: skip
    for row in cell["parameters"]:
        factor, unit = error_unit(row["unit"])
        numbers = (_both(row["bias"], factor), _both(row["spread"], factor), _percent(row["on_a_bound"]))
        table.add_row(row["parameter"], unit, *numbers)
    print_table(console, table)


def _written(console: Console, summary: dict[str, Any]) -> None:
    for path in summary.get("figures_written", ()):
        console.print(f"Written: {escape(path)}")
