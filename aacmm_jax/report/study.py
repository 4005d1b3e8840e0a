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
_MOST_CELLS, _MOST_ROWS, _MOST_WARNINGS = 400, 4000, 12


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
    for cell in summary["results"]:
        if cell["trials_run"] and (cell["converged"]["value"] or 0.0) < 0.99:
            found.append(
                f"Cell {cell['cell']}: only {100 * cell['converged']['value']:.3g} % of {cell['trials_run']} trials "
                "converged; its metrics are of those, if any."
            )
        if (cell["truth_inside"]["value"] or 0.0) < 1.0 and cell["trials_run"]:
            found.append(
                f"Cell {cell['cell']}: the true arm lies within the bounds in "
                f"{100 * cell['truth_inside']['value']:.3g} % of the trials."
            )
    more = len(found) - _MOST_WARNINGS
    return found[:_MOST_WARNINGS] + ([f"And {more} more of this kind; see the table of cells."] if more > 0 else [])


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
    known = [(i + 1, label, found) for i, (label, found) in enumerate(cells) if found is not None]
    x = [number for number, *_ in known]
    low, middle, high = (
        np.array([factor * found[key]["value"] for *_, found in known]) for key in ("p5", "p50", "p95")
    )
    hover = [
        f"{label}: median {format_number(m)} {unit}, 5 % {format_number(a)}, 95 % {format_number(b)}"
        for (_, label, _), a, m, b in zip(known, low.tolist(), middle.tolist(), high.tolist(), strict=True)
    ]
    trace = charts.markers("median, 5 to 95 %", x, middle, charts.DARK, "square", hover=hover)
    error = {"type": "data", "symmetric": False, "color": charts.DARK, "thickness": 1.4, "width": 5}
    trace["error_y"] = error | {"array": (high - middle).tolist(), "arrayminus": (middle - low).tolist()}
    title = METRICS[name] if name == "k" else f"{METRICS[name][0].upper()}{METRICS[name][1:]}"
    axis, axis_title = _cell_axis(summary, x)
    # Positive values that span a wide range need a logarithmic axis.
    wide = len(low) > 0 and low.min() > 0 and high.max() > 20 * low.min()
    y_axis = charts.logarithmic(low, high) if wide else {}
    layout = charts.layout(axis_title, unit or name, xaxis=axis, yaxis=y_axis, showlegend=False)
    heading = f"{title} [{unit}]" if unit else title
    columns = ("cell", "mean", "standard deviation", "5 %", "50 %", "95 %")
    table = ReportTable(f"{heading}; ± one Monte Carlo standard error", columns, rows)
    description = "Squares are medians, bars reach from the 5th to the 95th percentile of the converged trials."
    figure = {"data": [trace], "layout": layout}
    return Section(f"figure-{name}", title, [Chart(f"chart-{name}", heading, description, figure, table, 320)])


def _cell_axis(summary: dict[str, Any], numbers: list[int]) -> tuple[dict[str, Any], str]:
    """The axis of cells, labelled with the levels of the varied factors if there are few cells; and its title."""
    varied = _varied(summary)
    if not varied or len(numbers) > 16:
        return ({"dtick": 1} if len(numbers) <= 24 else {}), "cell"
    cells = {cell["cell"]: cell["factors"] for cell in summary["results"]}
    ticks = [
        "<br>".join([str(number), *(charts.escaped(level_text(cells[number][name])[:14]) for name in varied)])
        for number in numbers
    ]
    names = ", ".join(charts.escaped(factor_title(name)) for name in varied)
    return {"tickvals": numbers, "ticktext": ticks, "tickangle": 0}, f"cell, and under it {names}"


def _parameter_sections(summary: dict[str, Any]) -> list[Section]:
    """Bias and standard deviation of every parameter, cell by cell."""
    rows = []
    for label, cell in zip(_labels(summary), summary["results"], strict=True):
        for row in cell.get("parameters", [])[: _MOST_ROWS // max(summary["cells"], 1)]:
            factor, unit = error_unit(row.get("unit", "mm"))
            statistics = (_statistic_cell(row.get(key), factor) for key in ("bias", "spread"))
            rows.append([text_cell(label), text_cell(row["parameter"]), text_cell(unit), *statistics])
    if not rows:
        return []
    columns = ("cell", "parameter", "unit", "bias", "standard deviation")
    table = ReportTable("Errors of the parameters; ± one Monte Carlo standard error", columns, rows)
    return [Section("parameters", "Parameters", [table])]
