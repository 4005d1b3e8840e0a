"""The report of a Monte Carlo study."""

from typing import Any

from ..plot.charts import Chart
from ..plot.study import metric_plots
from ..study import tables
from ..study.results import Results
from ..study.statistics import factor_title, level_text, metric_title, study_summary
from .elements import Report, Section

_SHOWN = (
    *("length_error", "angle_error", "de", "deltam", "scale_error"),
    *("length_error_stage1", "angle_error_stage1", "de_stage1", "deltam_stage1", "k"),
)
_MOST_CELLS, _MOST_ROWS = 400, 2000


def study_report(results: Results) -> Report:
    """The report, except for the origin of its file."""
    summary = study_summary(results)
    cells, warnings, ran = summary["results"], tables.warnings_of(summary), summary["trials_run"]
    converged = sum(cell["trials_run"] * (cell["converged"]["value"] or 0.0) for cell in cells)
    fraction = converged / ran if ran else 0.0
    factors = (
        f"{factor_title(name)}: {', '.join(map(level_text, levels))}" for name, levels in summary["factors"].items()
    )
    mark = "good" if summary["finished"] and fraction > 0.999 and not warnings else "unsure"
    most = _MOST_ROWS // max(summary["cells"], 1)
    rows = [{"cell": cell["cell"]} | row for cell in cells for row in cell.get("parameters", [])[:most]]
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
            Section("cells", "Cells", [tables.cell_table(summary, cells), tables.MEANING]),
            *(
                _metric_section(results, summary, name)
                for name in _SHOWN
                if any(name in cell["figures"] for cell in cells)
            ),
            *([Section("parameters", "Parameters", [tables.parameter_table(rows, by_cell=True)])] if rows else []),
        ],
    )


def _metric_section(results: Results, summary: dict[str, Any], name: str) -> Section:
    """One metric in every cell: median and 5th to 95th percentile, with a table of its statistics."""
    title = metric_title(name)
    title = title if name == "k" else f"{title[0].upper()}{title[1:]}"
    rows = [(tables.cell_label(summary, cell), cell, name) for cell in summary["results"][:_MOST_CELLS]]
    description = "Marks are medians, bars reach from the 5th to the 95th percentile of the converged trials."
    table = tables.distribution_table(title, rows)
    return Section(
        f"figure-{name}", title, [Chart(f"chart-{name}", title, description, metric_plots(results, name), table)]
    )
