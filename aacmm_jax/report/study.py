"""The report of a Monte Carlo study."""

from typing import Any

import numpy as np

from ..study.results import Results
from ..study.statistics import METRICS, study_summary
from . import charts
from .parts import ARCSEC, Cell, Chart, Report, Section, Table, number, shown, text

# What is shown: the figure's name, its factor and unit.
_SHOWN = (
    ("length_error", 1.0, "mm"),
    ("angle_error", ARCSEC, "arcsec"),
    ("de", 1.0, "mm"),
    ("deltam", 1.0, "mm"),
    ("scale_error", 1e6, "parts in a million"),
    ("length_error_stage1", 1.0, "mm"),
    ("angle_error_stage1", ARCSEC, "arcsec"),
    ("de_stage1", 1.0, "mm"),
    ("deltam_stage1", 1.0, "mm"),
    ("k", 1.0, ""),
)
_MOST_CELLS = 400


def study_report(results: Results) -> tuple[Report, dict[str, Any]]:
    """The report, without what names its file; and the summary that it was made from."""
    summary = study_summary(results)
    cells = summary["results"]
    warnings = _warnings(summary)
    ran, converged = summary["trials_run"], sum(cell["trials_run"] * (cell["converged"]["value"] or 0.0) for cell in cells)
    share = converged / ran if ran else 0.0
    present = [(name, factor, unit) for name, factor, unit in _SHOWN if any(name in cell["figures"] for cell in cells)]
    report = Report(
        title=f"Study {summary['name']}".strip() + f" of {summary['arm'] or 'an arm'}",
        subtitle=f"{summary['cells']} cell{'' if summary['cells'] == 1 else 's'} of {summary['trials']:,} simulated calibrations",
        verdict=f"{'Finished' if summary['finished'] else 'Not finished'}: {ran:,} trials run, {100 * share:.4g} % converged",
        verdict_mark="bad"
        if ran and not converged
        else "good"
        if summary["finished"] and share > 0.999 and not warnings
        else "unsure",
        warnings=warnings,
        facts=[
            (
                "Factors",
                "; ".join(f"{name}: {', '.join(_level(x) for x in levels)}" for name, levels in summary["factors"].items())
                or "none varied",
            ),
            ("Seed", str(summary["seed"])),
        ],
        sections=[
            Section("cells", "Cells", [_cell_table(summary)]),
            *(_figure_section(summary, *entry) for entry in present),
            *_parameter_sections(summary),
        ],
    )
    return report, summary


def _warnings(summary: dict[str, Any]) -> list[str]:
    found = []
    if not summary["finished"]:
        found.append(
            "The study is not finished; the same command goes on where it was. Figures are of the trials that were run."
        )
    for cell in summary["results"]:
        if cell["trials_run"] and (cell["converged"]["value"] or 0.0) < 0.99:
            found.append(
                f"Cell {cell['cell']}: only {100 * cell['converged']['value']:.3g} % of {cell['trials_run']} trials converged; its figures are of those, if any."
            )
        if (cell["truth_inside"]["value"] or 0.0) < 1.0 and cell["trials_run"]:
            found.append(
                f"Cell {cell['cell']}: the true arm lies inside the bounds in {100 * cell['truth_inside']['value']:.3g} % of the trials."
            )
    return found[:12] + ([f"And {len(found) - 12} more of this kind; see the table of cells."] if len(found) > 12 else [])


def _level(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float | int) else str(value)


def _labels(summary: dict[str, Any]) -> list[str]:
    varied = [name for name, levels in summary["factors"].items() if len(levels) > 1]
    return [
        f"cell {cell['cell']}" + "".join(f", {name.split('.')[-1]} {_level(cell['factors'][name])}" for name in varied)
        for cell in summary["results"]
    ]


def _uncertain(entry: dict[str, Any] | None, factor: float, mark: str = "") -> Cell:
    """A statistic with its Monte Carlo standard error."""
    if entry is None or entry["value"] is None:
        return number(None)
    value, error = factor * entry["value"], entry["se"]
    if not error:
        return number(value, 4, mark=mark)
    places = min(max(1 - int(np.floor(np.log10(factor * error))), 0), 9)
    return Cell(f"{shown(value, places)} ± {shown(factor * error, places)}", value, mark)


def _cell_table(summary: dict[str, Any]) -> Table:
    names = list(summary["factors"])
    rows = []
    for cell in summary["results"]:
        share = cell["converged"]["value"]
        levels = [
            Cell(
                _level(cell["factors"][name]),
                float(cell["factors"][name]) if isinstance(cell["factors"][name], float) else None,
            )
            for name in names
        ]
        rows.append(
            [
                number(cell["cell"], 0),
                *levels,
                number(cell["trials_run"], 0),
                number(None if share is None else 100 * share, 2, mark="unsure" if share is not None and share < 0.99 else ""),
                number(100 * (cell["truth_inside"]["value"] or 0.0), 2),
                number(cell["steps_mean"], 1),
            ]
        )
    return Table(
        "Trials by cell", ("cell", *names, "trials run", "converged [%]", "truth in the box [%]", "mean evaluations"), rows
    )


def _figure_section(summary: dict[str, Any], name: str, factor: float, unit: str) -> Section:
    """One figure of merit in every cell: median and 5th to 95th percentile, with the table behind."""
    labels = _labels(summary)[:_MOST_CELLS]
    cells = [(label, cell["figures"].get(name)) for label, cell in zip(labels, summary["results"], strict=False)]
    rows = [
        [
            text(label),
            *(_uncertain(None if found is None else found[key], factor) for key in ("mean", "spread", "p5", "p50", "p95")),
        ]
        for label, found in cells
    ]
    there = [(i + 1, label, found) for i, (label, found) in enumerate(cells) if found is not None]
    places = [place for place, *_ in there]
    low, middle, high = (np.array([factor * found[key]["value"] for *_, found in there]) for key in ("p5", "p50", "p95"))
    hover = [
        f"{label}: median {shown(float(m))} {unit}, 5 % {shown(float(a))}, 95 % {shown(float(b))}"
        for (_, label, _), a, m, b in zip(there, low, middle, high, strict=True)
    ]
    trace = charts.dots("median, 5 to 95 %", places, middle, charts.DARK, "square", hover=hover)
    error = {"type": "data", "symmetric": False, "color": charts.DARK, "thickness": 1.4, "width": 5}
    trace["error_y"] = error | {"array": (high - middle).tolist(), "arrayminus": (middle - low).tolist()}
    title = METRICS[name]
    heading = title if name == "k" else f"{title[0].upper()}{title[1:]}"
    axis, axis_title = _cell_axis(summary, places)
    # Positive figures over a wide span of cells are read on a logarithmic axis.
    wide = len(low) > 0 and low.min() > 0 and high.max() > 20 * low.min()
    layout = charts.layout(
        axis_title, f"{unit or name}", xaxis=axis, yaxis=charts.logarithmic(low, high) if wide else {}, showlegend=False
    )
    unit_text = f" [{unit}]" if unit else ""
    behind = Table(
        f"{heading}{unit_text}; ± one Monte Carlo standard error", ("cell", "mean", "spread", "5 %", "50 %", "95 %"), rows
    )
    words = "Squares are medians, bars reach from the 5th to the 95th percentile of the converged trials."
    return Section(
        f"figure-{name}",
        heading,
        [Chart(f"chart-{name}", f"{heading}{unit_text}", words, {"data": [trace], "layout": layout}, behind, 320)],
    )


def _cell_axis(summary: dict[str, Any], places: list[int]) -> tuple[dict[str, Any], str]:
    """Cells along the axis, with the levels of what was varied where there is room to write them."""
    varied = [name for name, levels in summary["factors"].items() if len(levels) > 1]
    if not varied or len(places) > 16:
        return ({"dtick": 1} if len(places) <= 24 else {}), "cell"
    cells = {cell["cell"]: cell["factors"] for cell in summary["results"]}
    ticks = [f"{place}<br>" + "<br>".join(charts.plain(_level(cells[place][name])[:14]) for name in varied) for place in places]
    title = "cell, and under it " + ", ".join(charts.plain(name.split(".")[-1].replace("_", " ")) for name in varied)
    return {"tickvals": places, "ticktext": ticks, "tickangle": 0}, title


def _parameter_sections(summary: dict[str, Any]) -> list[Section]:
    """Bias and spread of every parameter, cell by cell."""
    rows = []
    for label, cell in zip(_labels(summary), summary["results"], strict=True):
        for row in cell.get("parameters", [])[: 4000 // max(summary["cells"], 1)]:
            factor, unit = (ARCSEC, "arcsec") if row.get("unit") == "rad" else (1.0, "mm")
            rows.append(
                [
                    text(label),
                    text(row["parameter"]),
                    text(unit),
                    *(_uncertain(row.get(key), factor) for key in ("bias", "spread")),
                ]
            )
    if not rows:
        return []
    table = Table(
        "Errors of the parameters; ± one Monte Carlo standard error", ("cell", "parameter", "unit", "bias", "spread"), rows
    )
    return [Section("parameters", "Parameters", [table])]
