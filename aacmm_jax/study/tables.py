"""Tables of a study, made of its summary, and its metrics and factors in words: terminal and report show the same."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.units import ARCSEC, error_unit
from ..summaries.tables import Cell, Styled, Table, View, format_number, listed, number
from .blocks import METRICS
from .specification import unit

_MOST_CELLS, _MOST_ROWS = 400, 2000
_STATISTICS = {"mean": "mean", "standard deviation": "spread", "5 %": "p5", "50 %": "p50", "95 %": "p95"}
_FACTORS = {
    "bounds.length_mm": "half-width of lengths [mm]",
    "bounds.angle_deg": "half-width of angles [deg]",
    "bounds.length_shift_mm": "shift of the centre, lengths [mm]",
    "bounds.angle_shift_deg": "shift of the centre, angles [deg]",
    "identification.hold": "scale anchor",
    "identification.model": "model of the joints",
    "deviation.model": "model of the true joints",
    "deviation.harmonics_arcsec": "encoder harmonics [arcsec]",
    "deviation.gear_ppm": "errors of gear ratios [ppm]",
    "deviation.coupled_ppm": "couplings of joints [ppm]",
    "deviation.gravity_mrad_per_m": "compliance under gravity [mrad/m]",
    "deviation.gravity_mrad_per_knm": "compliance under gravity [mrad/(kN m)]",
    "noise.encoder_arcsec": "encoder noise [arcsec]",
    "noise.linear_encoder_mm": "noise of linear encoders [mm]",
    "noise.seating_mm": "seating noise [mm]",
    "capture.poses": "poses per socket",
    "reference.positions": "positions of the reference length",
}


def shown_unit(metric: str) -> tuple[str, float]:
    """The unit in which people read a metric, and the factor to it from mm and rad."""
    if metric == "scale_error":
        return "parts in a million", 1e6
    return {"1": ("", 1.0), "mm": ("mm", 1.0), "rad": ("arcsec", 1 / ARCSEC)}[METRICS[metric].units]


def metric_title(metric: str) -> str:
    """What a metric is, with the unit in which people read it."""
    shown, _ = shown_unit(metric)
    return METRICS[metric].long_name + (f" [{shown}]" if shown else "")


def factor_title(name: str) -> str:
    """What a factor is, with its unit: ``noise.encoder_arcsec`` is "encoder noise [arcsec]"."""
    if name in _FACTORS:
        return _FACTORS[name]
    table, _, key = name.partition(".")
    words = key.removesuffix(f"_{unit(name)}").replace("_", " ")
    prefix = {"reference": "reference ", "deviation": "deviation of "}.get(table, "")
    return prefix + words + (f" [{unit(name)}]" if unit(name) != "1" else "")


def level_title(name: str, level: float | str) -> str:
    """A factor and one of its levels with the unit: "encoder noise 2 arcsec"."""
    words, _, measure = factor_title(name).partition(" [")
    return f"{words} {level_text(level)}" + (f" {measure.removesuffix(']')}" if measure else "")


def level_text(level: float | str) -> str:
    """A level of a factor: numbers in their shortest form."""
    return level if isinstance(level, str) else f"{level:g}"


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


def study_view(summary: dict[str, Any]) -> View:
    """What people see of a study, or of one cell with every parameter: its finding first."""
    if summary["finding"]:
        yield Styled(summary["finding"])
    yield [
        Styled(summary["name"] or "Study"),
        f" of {summary['arm']}: {summary['cells']} cells of {summary['trials']:,} trials, seed {summary['seed']}",
    ]
    if not summary["finished"]:
        yield [Styled("Not finished:", "yellow"), f" {summary['trials_run']:,} trials so far."]
    if any(cell["trials_run"] for cell in summary["results"]):
        yield cell_table(summary)
        yield from metric_tables(summary)
        yield "Length error and angle error: the largest error of any length parameter and of any angle parameter."
        if len(summary["results"]) == 1:
            yield parameter_table(summary)
        else:
            yield "--cell N shows one cell with the bias of every parameter; --figures FOLDER writes the figures."
    else:
        yield "No trial has ended yet."
    yield from (f"Written: {path}" for path in summary.get("figures_written", ()))
