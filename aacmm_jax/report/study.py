"""The report of a Monte Carlo study."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..core.units import error_unit
from ..plot.charts import Chart
from ..plot.study import metric_plots, metric_unit
from ..study.results import Results
from ..study.statistics import METRICS, factor_title, level_text, level_title, study_summary
from ..summaries.tables import Cell, Table, format_number, listed, number
from .elements import Report, Section

_SHOWN = (
    *("length_error", "angle_error", "de", "deltam", "scale_error"),
    *("length_error_stage1", "angle_error_stage1", "de_stage1", "deltam_stage1", "k"),
)
_MOST_CELLS, _MOST_ROWS, _NAMED = 400, 2000, 6
_STATISTICS = {"mean": "mean", "standard deviation": "spread", "5 %": "p5", "50 %": "p50", "95 %": "p95"}


def study_report(results: Results) -> Report:
    """The report, except for the origin of its file."""
    summary = study_summary(results)
    cells, warnings, ran = summary["results"], _warnings(summary), summary["trials_run"]
    converged = sum(cell["trials_run"] * (cell["converged"]["value"] or 0.0) for cell in cells)
    fraction = converged / ran if ran else 0.0
    factors = (
        f"{factor_title(name)}: {', '.join(map(level_text, levels))}" for name, levels in summary["factors"].items()
    )
    mark = "good" if summary["finished"] and fraction > 0.999 and not warnings else "unsure"
    return Report(
        title=f"Study {summary['name']}".strip() + f" of {summary['arm'] or 'an arm'}",
        subtitle=f"{summary['cells']} cell{'' if summary['cells'] == 1 else 's'} of {summary['trials']:,} simulated "
        "calibrations",
        verdict=f"{'Finished' if summary['finished'] else 'Not finished'}: {ran:,} trials run, "
        f"{100 * fraction:.4g} % converged",
        verdict_mark="bad" if ran and not converged else mark,
        warnings=warnings,
        facts=[("Factors", "; ".join(factors) or "none varied"), ("Seed", str(summary["seed"]))],
        sections=[
            Section("cells", "Cells", [_cell_table(summary)]),
            *(
                _metric_section(results, summary, name)
                for name in _SHOWN
                if any(name in cell["figures"] for cell in cells)
            ),
            *_parameter_sections(summary),
        ],
    )


def _warnings(summary: dict[str, Any]) -> list[str]:
    warnings = []
    if not summary["finished"]:
        warnings.append(
            "The study is not finished; the same command continues it. Metrics are of the trials that were run."
        )
    for key, least, says in (
        ("converged", 0.99, "Not all trials converged, and metrics are of those that did"),
        ("truth_inside", 1.0, "The true arm lies within the bounds in some of the trials only"),
    ):
        shares = [(cell, cell[key]["value"] or 0.0) for cell in summary["results"] if cell["trials_run"]]
        named = [f"{_label(summary, cell)} ({100 * share:.3g} %)" for cell, share in shares if share < least]
        if named:
            more = f"; and {len(named) - _NAMED} more cells" if len(named) > _NAMED else ""
            warnings.append(f"{says}: {'; '.join(named[:_NAMED])}{more}.")
    return warnings


def _label(summary: dict[str, Any], cell: dict[str, Any]) -> str:
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


def _cell_table(summary: dict[str, Any]) -> Table:
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
        "mean evaluations": lambda cell: number(cell["steps_mean"], 1),
    }
    return listed("Trials by cell", summary["results"], columns)


def _metric_section(results: Results, summary: dict[str, Any], name: str) -> Section:
    """One metric in every cell: median and 5th to 95th percentile, with a table of its statistics."""
    unit, factor = metric_unit(name)
    title = METRICS[name] if name == "k" else f"{METRICS[name][0].upper()}{METRICS[name][1:]}"
    heading = f"{title} [{unit}]" if unit else title
    columns = {"cell": lambda cell: _label(summary, cell)} | {
        words: lambda cell, key=key: _statistic((cell["figures"].get(name) or {}).get(key), factor)
        for words, key in _STATISTICS.items()
    }
    cells = listed(f"{heading}; ± one Monte Carlo standard error", summary["results"][:_MOST_CELLS], columns)
    plots = metric_plots(results, name, lambda chosen: factor * _ends(summary, name, chosen))
    description = "Marks are medians, bars reach from the 5th to the 95th percentile of the converged trials."
    return Section(f"figure-{name}", title, [Chart(f"chart-{name}", heading, description, plots, cells)])


def _ends(summary: dict[str, Any], name: str, cells: Sequence[int]) -> np.ndarray:
    """5th, 50th and 95th percentile of a metric in each cell; NaN where no trial converged."""
    figures = [summary["results"][cell]["figures"].get(name) or {} for cell in cells]
    keys = ("p5", "p50", "p95")
    return np.array([[(row.get(key) or {}).get("value") for row in figures] for key in keys], dtype=float)


def _parameter_sections(summary: dict[str, Any]) -> list[Section]:
    """Bias and standard deviation of every parameter, cell by cell."""
    most = _MOST_ROWS // max(summary["cells"], 1)
    rows = [{"cell": cell["cell"]} | row for cell in summary["results"] for row in cell.get("parameters", [])[:most]]
    columns = {
        "cell": "cell",
        "parameter": "parameter",
        "unit": lambda row: error_unit(row.get("unit", "mm"))[1],
    } | {
        words: lambda row, key=key: _statistic(row.get(key), error_unit(row.get("unit", "mm"))[0])
        for words, key in (("bias", "bias"), ("standard deviation", "spread"))
    }
    caption = "Errors of the parameters; ± one Monte Carlo standard error"
    return [Section("parameters", "Parameters", [listed(caption, rows, columns, folded=True)])] if rows else []
