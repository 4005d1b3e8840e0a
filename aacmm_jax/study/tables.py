"""Tables of a study, made of its summary: terminal and report show the same ones."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.units import error_unit
from ..summaries.tables import Cell, Table, format_number, listed, number
from .statistics import METRICS, factor_title, level_text, level_title, metric_title, shown_unit

_MOST_CELLS, _MOST_ROWS = 400, 2000
_STATISTICS = {"mean": "mean", "standard deviation": "spread", "5 %": "p5", "50 %": "p50", "95 %": "p95"}


def label(summary: Mapping[str, Any], cell: Mapping[str, Any]) -> str:
    """A cell with the levels of the factors that are varied."""
    varied = [name for name, levels in summary["factors"].items() if len(levels) > 1]
    return f"cell {cell['cell']}" + "".join(f", {level_title(name, cell['factors'][name])}" for name in varied)


def _statistic(entry: Mapping[str, Any] | None, factor: float) -> Cell:
    """A statistic with its Monte Carlo standard error."""
    if entry is None or entry["value"] is None:
        return number(None)
    value, error = factor * entry["value"], entry["se"]
    if not error:
        return number(value)
    decimals = min(max(1 - int(np.floor(np.log10(factor * error))), 0), 9)
    return Cell(f"{format_number(value, decimals)} ± {format_number(factor * error, decimals)}", value)


def cell_table(summary: Mapping[str, Any]) -> Table:
    """How many trials of each cell converged, and how many ended on a bound."""

    def level(cell: dict[str, Any], name: str) -> Cell:
        value = cell["factors"][name]
        return Cell(level_text(value), float(value) if isinstance(value, float) else None)

    def converged(cell: dict[str, Any]) -> Cell:
        fraction = cell["converged"]["value"]
        if fraction is None:
            return number(None)
        return number(100 * fraction, 2, mark="unsure" if fraction < 0.99 else "")

    columns = {"cell": "cell"}
    columns |= {factor_title(name): lambda cell, name=name: level(cell, name) for name in summary["factors"]}
    columns |= {
        "trials run": "trials_run",
        "converged [%]": converged,
        "truth within bounds [%]": lambda cell: number(100 * (cell["truth_inside"]["value"] or 0.0), 2),
        "on a bound [%]": lambda cell: number(100 * (cell["on_a_bound"]["value"] or 0.0), 2),
        "mean evaluations": lambda cell: number(cell["steps_mean"], 1),
    }
    return listed("Trials by cell", summary["results"], columns)


def metric_table(summary: Mapping[str, Any], name: str, heading: str) -> Table:
    """The distribution of a metric in each cell."""
    factor = shown_unit(name)[1]
    columns = {"cell": lambda cell: label(summary, cell)} | {
        words: lambda cell, key=key: _statistic((cell["figures"].get(name) or {}).get(key), factor)
        for words, key in _STATISTICS.items()
    }
    return listed(f"{heading}; ± one Monte Carlo standard error", summary["results"][:_MOST_CELLS], columns)


def metric_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Those of all metrics that the study has."""
    names = [name for name in METRICS if any(name in cell["figures"] for cell in summary["results"])]
    return [metric_table(summary, name, metric_title(name)) for name in names]


def parameter_table(summary: Mapping[str, Any]) -> Table:
    """Bias and standard deviation of every parameter, cell by cell."""
    most = _MOST_ROWS // max(summary["cells"], 1)
    rows = [{"cell": cell["cell"]} | row for cell in summary["results"] for row in cell.get("parameters", [])[:most]]

    def scaled(key: str) -> Any:
        return lambda row: _statistic(row.get(key), error_unit(row.get("unit", "mm"))[0])

    return listed("Errors of the parameters; ± one Monte Carlo standard error", rows, {
        "cell": "cell",
        "parameter": "parameter",
        "unit": lambda row: error_unit(row.get("unit", "mm"))[1],
        "bias": scaled("bias"),
        "standard deviation": scaled("spread"),
    })  # fmt: skip
