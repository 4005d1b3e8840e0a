"""What people see of a study: means with the standard error of their last digits in parentheses."""

from typing import Any

from ..core.units import error_unit
from ..study.statistics import METRICS, concise, factor_title, level_text, level_title, metric_title, shown_unit
from ..summaries.tables import Cell, Styled, listed, number
from .calibration_views import View

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
_DISTRIBUTION = {"mean": "mean", "spread": "standard deviation", "p5": "5 %", "p50": "50 %", "p95": "95 %"}
_FAILED = {
    "max_steps": "reached the step limit",
    "stalled": "stalled",
    "nonfinite": "had a pose that the true arm cannot take",
}


def _both(pair: dict[str, Any] | None, factor: float = 1.0) -> Cell:
    """A mean with its standard error."""
    if pair is None or pair["value"] is None:
        return number(None)
    value = factor * pair["value"]
    return Cell(concise(value, None if pair["se"] is None else factor * pair["se"]), value)


def study(summary: dict[str, Any]) -> View:
    """All cells: what converged, the mean of every metric, then standard deviations and percentiles."""
    yield from _heading(summary)
    cells = [cell for cell in summary["results"] if cell["trials_run"]]
    if not cells:
        yield "No trial has ended yet."
        return
    shown, factors = cells[:_MOST], [factor_title(name) for name in summary["factors"]]
    yield from _identified(shown, factors)
    fixed = any("de" in cell["figures"] for cell in cells)
    metrics = _OVERVIEW if fixed else _STAGE1
    rows = [
        (
            *(cell["cell"], *map(level_text, cell["factors"].values())),
            *(_both(cell["figures"].get(name, {}).get("mean"), shown_unit(name)[1]) for name in metrics),
        )
        for cell in shown
    ]
    yield listed("Means over converged trials", rows, ("cell", *factors, *metrics.values()))
    for name in ("length_error", "angle_error") if len(cells) > 1 else ():
        name = name if fixed else f"{name}_stage1"
        title = metric_title(name)
        rows = [(cell["cell"], *_distribution(cell, name)) for cell in shown if name in cell["figures"]]
        if rows:
            yield listed(f"{title[0].upper()}{title[1:]}", rows, ("cell", *_DISTRIBUTION.values()))
    if len(cells) > len(shown):
        yield f"\n{len(cells) - len(shown)} more cells: see them with --json, or aacmm_jax.study.open_study."
    yield (
        "\nDigits in parentheses: Monte Carlo standard error of the last digits. Length and angle error: the largest "
        "of all parameters."
    )
    if len(cells) == 1:
        yield from _full(cells[0])
    else:
        yield "One cell in full, with every parameter's bias: --cell N. Figures: --figures FOLDER."
    yield from _written(summary)


def one_cell(summary: dict[str, Any]) -> View:
    """One cell in full."""
    yield from _heading(summary)
    for cell in summary["results"]:
        levels = ", ".join(level_title(name, level) for name, level in cell["factors"].items())
        yield f"Cell {cell['cell']}{': ' + levels if levels else ''}"
        if cell["trials_run"]:
            yield from _identified([cell], [factor_title(name) for name in cell["factors"]])
            yield from _full(cell)
        else:
            yield "No trial of it has ended yet."
    yield from _written(summary)


def _heading(summary: dict[str, Any]) -> View:
    yield [
        Styled(summary["name"] or "Study"),
        f" of {summary['arm']}: {summary['cells']} cells of {summary['trials']:,} trials, seed {summary['seed']}",
    ]
    if not summary["finished"]:
        yield [Styled("Not finished:", "yellow"), f" {summary['trials_run']:,} trials so far."]


def _identified(cells: list[dict[str, Any]], factors: list[str]) -> View:
    """How many trials converged, and which parameters ended on a bound."""
    often = [_most_often_on_a_bound(cell) for cell in cells]
    headings = ["cell", *factors, "trials", "converged [%]", "truth within bounds [%]", "on a bound [%]"]
    rows = [
        (
            *(cell["cell"], *map(level_text, cell["factors"].values()), f"{cell['trials_run']:,}"),
            *(_both(cell[key], 100.0) for key in ("converged", "truth_inside", "on_a_bound")),
            *([parameter] if any(often) else []),
        )
        for cell, parameter in zip(cells, often, strict=True)
    ]
    yield listed("Identifications", rows, [*headings, *(["most often"] if any(often) else [])])
    for reason, words in _FAILED.items():
        count = sum(cell["reasons"][reason] for cell in cells)
        if count:
            yield [
                Styled(f"{count:,} {'trial' if count == 1 else 'trials'} {words};", "yellow"),
                " left out of the means.",
            ]


def _most_often_on_a_bound(cell: dict[str, Any]) -> str:
    """The parameter that is on a bound in most trials, and in how many; empty if none ever is."""
    worst = max(cell["parameters"], key=lambda row: row["on_a_bound"]["value"], default=None)
    if worst is None or not worst["on_a_bound"]["value"]:
        return ""
    return f"{worst['parameter']} {_both(worst['on_a_bound'], 100.0).text} %"


def _distribution(cell: dict[str, Any], metric: str) -> list[Cell]:
    return [_both(cell["figures"][metric].get(key), shown_unit(metric)[1]) for key in _DISTRIBUTION]


def _full(cell: dict[str, Any]) -> View:
    """Every metric of a cell, and every parameter's error."""
    rows = [(metric_title(name), *_distribution(cell, name)) for name in METRICS if name in cell["figures"]]
    yield listed("Metrics over converged trials", rows, ("", *_DISTRIBUTION.values()))
    rows = []
    for row in cell["parameters"]:
        factor, unit = error_unit(row["unit"])
        numbers = _both(row["bias"], factor), _both(row["spread"], factor), _both(row["on_a_bound"], 100.0)
        rows.append((row["parameter"], unit, *numbers))
    headings = ("parameter", "unit", "bias", "standard deviation", "on a bound [%]")
    yield listed("Parameters: estimate less truth", rows, headings)


def _written(summary: dict[str, Any]) -> View:
    for path in summary.get("figures_written", ()):
        yield f"Written: {path}"
