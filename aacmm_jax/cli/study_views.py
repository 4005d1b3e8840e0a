"""What people see of a study: means with the standard error of their last digits in parentheses."""

from typing import Any

from ..study import tables
from ..study.statistics import METRICS, level_title, metric_title
from ..summaries.tables import Styled
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


def study(summary: dict[str, Any]) -> View:
    """All cells: what converged, the mean of every metric, then standard deviations and percentiles."""
    yield from _heading(summary)
    cells = [cell for cell in summary["results"] if cell["trials_run"]]
    if not cells:
        yield "No trial has ended yet."
        return
    shown = cells[:_MOST]
    fixed = any("de" in cell["figures"] for cell in cells)
    yield tables.cell_table(summary, shown)
    yield tables.means_table(summary, shown, _OVERVIEW if fixed else _STAGE1)
    for name in ("length_error", "angle_error") if len(cells) > 1 else ():
        name = name if fixed else f"{name}_stage1"
        rows = [(str(cell["cell"]), cell, name) for cell in shown if name in cell["figures"]]
        yield tables.distribution_table(f"By cell: {metric_title(name)}", rows)
    if len(cells) > len(shown):
        yield f"\n{len(cells) - len(shown)} more cells: see them with --json, or aacmm_jax.study.open_study."
    yield f"\n{tables.MEANING}"
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
            yield tables.cell_table(summary, [cell])
            yield from _full(cell)
        else:
            yield "No trial of it has ended yet."
    yield from _written(summary)


def _heading(summary: dict[str, Any]) -> View:
    yield [
        Styled(summary["name"] or "Study"),
        f" of {summary['arm']}: {summary['cells']} cells of {summary['trials']:,} trials, seed {summary['seed']}",
    ]
    for warning in tables.warnings_of(summary):
        yield [Styled("Warning:", "yellow"), f" {warning}"]


def _full(cell: dict[str, Any]) -> View:
    """Every metric of a cell, and every parameter's error."""
    rows = [(metric_title(name), cell, name) for name in METRICS if name in cell["figures"]]
    yield tables.distribution_table("Metrics over converged trials", rows)
    yield tables.parameter_table(cell["parameters"])


def _written(summary: dict[str, Any]) -> View:
    for path in summary.get("figures_written", ()):
        yield f"Written: {path}"
