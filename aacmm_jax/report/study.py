"""The report of a Monte Carlo study."""

from typing import Any

import numpy as np

from ..core.units import error_unit
from ..study.results import Results
from ..study.statistics import METRICS, factor_title, level_text, level_title, shown_unit, study_summary
from . import charts
from .elements import Cell, Chart, Report, ReportTable, Section, format_number, number_cell, text_cell

_SHOWN = (
    *("length_error", "angle_error", "de", "deltam", "scale_error"),
    *("length_error_stage1", "angle_error_stage1", "de_stage1", "deltam_stage1", "k"),
)
_MOST_CELLS, _MOST_ROWS, _NAMED, _MOST_PLOTS = 400, 2000, 6, 12


def study_report(results: Results) -> tuple[Report, dict[str, Any]]:
    """The report, except for the origin of its file; and the summary that it was made from."""
    summary = study_summary(results)
    cells, warnings = summary["results"], _warnings(summary)
    ran, converged = (
        summary["trials_run"],
        sum(cell["trials_run"] * (cell["converged"]["value"] or 0.0) for cell in cells),
    )
    fraction = converged / ran if ran else 0.0
    present = [name for name in _SHOWN if any(name in cell["figures"] for cell in cells)]
    factors = (
        f"{factor_title(name)}: {', '.join(map(level_text, levels))}" for name, levels in summary["factors"].items()
    )
    mark = "good" if summary["finished"] and fraction > 0.999 and not warnings else "unsure"
    report = Report(
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
            *(_metric_section(summary, name) for name in present),
            *_parameter_sections(summary),
        ],
    )
    return report, summary


def _warnings(summary: dict[str, Any]) -> list[str]:
    found = []
    if not summary["finished"]:
        found.append(
            "The study is not finished; the same command continues it. Metrics are of the trials that were run."
        )
    cells = zip(_labels(summary), summary["results"], strict=True)
    ran = [(label, cell) for label, cell in cells if cell["trials_run"]]
    for key, least, says in (
        ("converged", 0.99, "Not all trials converged, and metrics are of those that did"),
        ("truth_inside", 1.0, "The true arm lies within the bounds in some of the trials only"),
    ):
        shares = [(label, cell[key]["value"] or 0.0) for label, cell in ran]
        named = [f"{label} ({100 * share:.3g} %)" for label, share in shares if share < least]
        if named:
            more = f"; and {len(named) - _NAMED} more cells" if len(named) > _NAMED else ""
            found.append(f"{says}: {'; '.join(named[:_NAMED])}{more}.")
    return found


def _varied(summary: dict[str, Any]) -> list[str]:
    return [name for name, levels in summary["factors"].items() if len(levels) > 1]


def _labels(summary: dict[str, Any]) -> list[str]:
    return [
        f"cell {cell['cell']}" + "".join(f", {level_title(name, cell['factors'][name])}" for name in _varied(summary))
        for cell in summary["results"]
    ]


def _statistic_cell(entry: dict[str, Any] | None, factor: float) -> Cell:
    """A statistic with its Monte Carlo standard error."""
    if entry is None or entry["value"] is None:
        return number_cell(None)
    value, error = factor * entry["value"], entry["se"]
    if not error:
        return number_cell(value, 4)
    decimals = min(max(1 - int(np.floor(np.log10(factor * error))), 0), 9)
    return Cell(f"{format_number(value, decimals)} ± {format_number(factor * error, decimals)}", value)


def _cell_table(summary: dict[str, Any]) -> ReportTable:
    names, rows = list(summary["factors"]), []
    for cell in summary["results"]:
        levels, fraction = [cell["factors"][name] for name in names], cell["converged"]["value"]
        mark = "unsure" if fraction is not None and fraction < 0.99 else ""
        rows.append([
            number_cell(cell["cell"], 0),
            *(Cell(level_text(level), float(level) if isinstance(level, float) else None) for level in levels),
            number_cell(cell["trials_run"], 0),
            number_cell(None if fraction is None else 100 * fraction, 2, mark=mark),
            number_cell(100 * (cell["truth_inside"]["value"] or 0.0), 2),
            number_cell(cell["steps_mean"], 1),
        ])  # fmt: skip
    columns = (
        "cell",
        *map(factor_title, names),
        "trials run",
        "converged [%]",
        "truth within bounds [%]",
        "mean evaluations",
    )
    return ReportTable("Trials by cell", columns, rows)


def _metric_section(summary: dict[str, Any], name: str) -> Section:
    """One metric in every cell: median and 5th to 95th percentile, with a table of its statistics."""
    unit, factor = ("parts in a million", 1e6) if name == "scale_error" else shown_unit(name)
    labels = _labels(summary)[:_MOST_CELLS]
    cells = [(label, cell["figures"].get(name)) for label, cell in zip(labels, summary["results"], strict=False)]
    keys = ("mean", "spread", "p5", "p50", "p95")
    rows = [
        [text_cell(label), *(_statistic_cell(None if found is None else found[key], factor) for key in keys)]
        for label, found in cells
    ]
    title = METRICS[name] if name == "k" else f"{METRICS[name][0].upper()}{METRICS[name][1:]}"
    heading = f"{title} [{unit}]" if unit else title
    columns = ("cell", "mean", "standard deviation", "5 %", "50 %", "95 %")
    table = ReportTable(f"{heading}; ± one Monte Carlo standard error", columns, rows)
    description = "Marks are medians, bars reach from the 5th to the 95th percentile of the converged trials."
    plots = _plots(summary, name, unit, factor)
    return Section(f"figure-{name}", title, [Chart(f"chart-{name}", heading, description, plots, table)])


def _plots(summary: dict[str, Any], name: str, unit: str, factor: float) -> tuple[charts.Plot, ...]:
    """The metric against the factor with the most levels, one plot for each combination of the others."""
    varied = sorted(_varied(summary), key=lambda one: -len(summary["factors"][one]))
    along = varied[0] if varied else None
    groups: dict[str, list[tuple[int, str, np.ndarray]]] = {}
    for label, cell in zip(_labels(summary), summary["results"], strict=True):
        found = cell["figures"].get(name)
        if found is None or any(found[key]["value"] is None for key in ("p5", "p50", "p95")):
            continue
        words = ", ".join(level_title(other, cell["factors"][other]) for other in varied[1:])
        at = 0 if along is None else summary["factors"][along].index(cell["factors"][along])
        values = factor * np.array([found[key]["value"] for key in ("p5", "p50", "p95")])
        groups.setdefault(words, []).append((at, label, values))
    shown = dict(list(groups.items())[:_MOST_PLOTS])
    if not shown:
        return ()
    every = np.concatenate([values for group in shown.values() for _, _, values in group])
    # Positive values that span a wide range need a logarithmic axis.
    wide = every.min() > 0 and every.max() > 20 * every.min()
    y = charts.logarithmic(unit or name, every) if wide else charts.linear(unit or name, every)
    levels = ["all trials"] if along is None else [level_text(level) for level in summary["factors"][along]]
    x = charts.names("" if along is None else factor_title(along), levels)
    plots = []
    for words, group in shown.items():
        at, low, middle, high = np.array([(at, *values) for at, _, values in group]).T
        hover = [
            f"{label}: median {format_number(m)} {unit}, 5 % {format_number(a)}, 95 % {format_number(b)}"
            for (_, label, _), a, m, b in zip(group, low.tolist(), middle.tolist(), high.tolist(), strict=True)
        ]
        marks = charts.Marks("median, 5 to 95 %", at, middle, "square", "main", hover, low, high, size=7)
        height = 280 if len(shown) == 1 else 200
        plots.append(charts.Plot(x, y, (marks,), title=words[:1].upper() + words[1:], height=height))
    return tuple(plots)


def _parameter_sections(summary: dict[str, Any]) -> list[Section]:
    """Bias and standard deviation of every parameter, cell by cell."""
    rows = []
    for cell in summary["results"]:
        for row in cell.get("parameters", [])[: _MOST_ROWS // max(summary["cells"], 1)]:
            factor, unit = error_unit(row.get("unit", "mm"))
            statistics = (_statistic_cell(row.get(key), factor) for key in ("bias", "spread"))
            rows.append([number_cell(cell["cell"], 0), text_cell(row["parameter"]), text_cell(unit), *statistics])
    if not rows:
        return []
    columns = ("cell", "parameter", "unit", "bias", "standard deviation")
    table = ReportTable("Errors of the parameters; ± one Monte Carlo standard error", columns, rows, folded=True)
    return [Section("parameters", "Parameters", [table])]
