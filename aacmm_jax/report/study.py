"""The report of a Monte Carlo study."""

from typing import Any

from ..plot.charts import Chart
from ..plot.study import metric_plots
from ..study.results import study_summary
from ..study.store import Results
from ..study.tables import cell_table, factor_title, label, level_text, metric_table, metric_title, parameter_table
from .elements import Report, Section

_SHOWN = (
    *("length_error", "angle_error", "de", "deltam", "scale_error"),
    *("length_error_stage1", "angle_error_stage1", "de_stage1", "deltam_stage1", "k"),
)
_NAMED = 6


def study_report(results: Results) -> Report:
    """The report, except for the origin of its file."""
    summary = study_summary(results)
    cells, warnings, ran = summary["results"], _warnings(summary), summary["trials_run"]
    converged = sum(cell["trials_run"] * (cell["converged"]["value"] or 0.0) for cell in cells)
    fraction = converged / ran if ran else 0.0
    factors = (
        f"{factor_title(name)}: {', '.join(map(level_text, levels))}" for name, levels in summary["factors"].items()
    )
    parameters = parameter_table(summary)._replace(folded=True)
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
            Section("cells", "Cells", [cell_table(summary)]),
            *(
                _metric_section(results, summary, name)
                for name in _SHOWN
                if any(name in cell["figures"] for cell in cells)
            ),
            *([Section("parameters", "Parameters", [parameters])] if parameters.rows else []),
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
        named = [f"{label(summary, cell)} ({100 * share:.3g} %)" for cell, share in shares if share < least]
        if named:
            more = f"; and {len(named) - _NAMED} more cells" if len(named) > _NAMED else ""
            warnings.append(f"{says}: {'; '.join(named[:_NAMED])}{more}.")
    return warnings


def _metric_section(results: Results, summary: dict[str, Any], name: str) -> Section:
    """One metric in every cell: median and 5th to 95th percentile, with a table of its statistics."""
    title = metric_title(name)
    title = title if name == "k" else f"{title[0].upper()}{title[1:]}"
    description = "Marks are medians, bars reach from the 5th to the 95th percentile of the converged trials."
    table = metric_table(summary, name, title)
    return Section(
        f"figure-{name}", title, [Chart(f"chart-{name}", title, description, metric_plots(results, name), table)]
    )
