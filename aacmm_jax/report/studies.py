"""The reports of many calibrations: of a Monte Carlo study, and of compared models, inside and outside, by region."""

import math
from typing import Any

import numpy as np

from ..core.text import pluralise
from ..plot.charts import Chart, Marks, Plot, linear, names
from ..plot.parameters import models_chart
from ..plot.study import metric_plots
from ..study.results import study_summary
from ..study.store import Results
from ..study.tables import (
    cell_table,
    factor_title,
    label,
    level_text,
    metric_table,
    metric_title,
    parameter_table,
    shown_unit,
)
from ..summaries.compared_models import MODELS_MEANING, model_tables
from ..summaries.tables import format_number
from .elements import Report, Section

_SHOWN = (
    *("length_error", "angle_error", "de", "deltam", "scale_error"),
    *("length_error_stage1", "angle_error_stage1", "de_stage1", "deltam_stage1", "k"),
)
_NAMED = 6
_PERCENTILES = "Marks are medians; bars reach from the 5th to the 95th percentile of the converged trials."
_MODELS = (
    "Each model was fitted to all poses (inside). Then each region was held out in turn, and predicted by the model "
    "fitted to the other regions (outside). Neighbouring poses have similar errors, so only whole held-out regions "
    "show how well a model extrapolates. Candidates are the model with the smallest outside error and all models "
    "whose outside error is not significantly larger. The recommended model is the simplest candidate under which the "
    "measurements are about as probable (evidence) as under the most probable candidate."
)


def study_report(results: Results) -> Report:
    """The report, except for the origin of its file."""
    summary = study_summary(results)
    cells, warnings, ran = summary["results"], _warnings(summary), summary["trials_run"]
    converged = sum(cell["trials_run"] * (cell["converged"]["value"] or 0.0) for cell in cells)
    fraction = converged / ran if ran else 0.0
    factors = (
        f"{factor_title(name)}: {', '.join(map(level_text, levels))}" for name, levels in summary["factors"].items()
    )
    parameters, sections = parameter_table(summary)._replace(folded=True), []
    metrics = [name for name in _SHOWN if any(name in cell["figures"] for cell in cells)]
    picture = None
    if metrics:
        plots = metric_plots(results, metrics[0], together=True)
        picture = Chart("first", f"Study: {metric_title(metrics[0])}", _PERCENTILES, plots[:1])
    for name in metrics:
        title = metric_title(name) if name == "k" else metric_title(name)[0].upper() + metric_title(name)[1:]
        table, plots = metric_table(summary, name, title), metric_plots(results, name)
        sections.append(Section(f"figure-{name}", title, [Chart(f"chart-{name}", title, _PERCENTILES, plots, table)]))
    mark = "good" if summary["finished"] and fraction > 0.999 and not warnings else "unsure"
    return Report(
        title=f"Study {summary['name']}".strip() + f" of {summary['arm'] or 'an arm'}",
        subtitle=f"{summary['cells']} cell{'' if summary['cells'] == 1 else 's'} of {summary['trials']:,} simulated "
        "calibrations",
        verdict=summary["finding"] or f"No trial has converged ({ran:,} trials run).",
        verdict_mark="bad" if ran and not converged else mark,
        warnings=warnings,
        numbers=[
            ("Trials run", f"{ran:,}", f"{100 * fraction:.4g} % converged"),
            *(_spread(cells, name) for name in metrics[:2]),
        ],
        picture=picture,
        facts=[
            ("Factors", "; ".join(factors) or "none varied"),
            ("Seed", str(summary["seed"])),
        ],
        sections=[
            Section("cells", "Cells", [cell_table(summary)]),
            *sections,
            *([Section("parameters", "Parameters", [parameters])] if parameters.rows else []),
        ],
    )


def _spread(cells: list[dict[str, Any]], name: str) -> tuple[str, str, str]:
    """The medians of a metric over the cells."""
    unit, factor = shown_unit(name)
    known = [factor * cell["figures"][name]["p50"]["value"] for cell in cells if name in cell["figures"]]
    ends = dict.fromkeys(
        np.format_float_positional(end, 3, unique=False, fractional=False, trim="-") for end in (min(known), max(known))
    )
    note = "median of the converged trials" + (" of a cell" if len(known) > 1 else "")
    title = metric_title(name).partition(" [")[0]
    return title[:1].upper() + title[1:], f"{' to '.join(ends)} {unit}".strip(), note


def _warnings(summary: dict[str, Any]) -> list[str]:
    warnings = []
    if not summary["finished"]:
        warnings.append(
            "The study is not finished; repeat the command to continue the study. Metrics are computed from the "
            "trials run so far."
        )
    for key, least, says in (
        ("converged", 0.99, "Not all trials converged; metrics are computed from the converged trials"),
        ("truth_inside", 1.0, "The true arm is within the bounds in only some of the trials"),
    ):
        shares = [(cell, cell[key]["value"] or 0.0) for cell in summary["results"] if cell["trials_run"]]
        named = [f"{label(summary, cell)} ({100 * share:.3g} %)" for cell, share in shares if share < least]
        if named:
            more = f"; and {len(named) - _NAMED} more cells" if len(named) > _NAMED else ""
            warnings.append(f"{says}: {'; '.join(named[:_NAMED])}{more}.")
    return warnings


def models_report(summary: dict[str, Any]) -> Report:
    """The report of compared models (`files.load_compared_models`), except for the origin of its file."""
    models = summary["models"]
    chosen = next(row for row in models if row["model"] == summary["recommended"])
    doubtful = bool(summary["warnings"]) or not chosen["converged"]
    by_name, by_region = model_tables(summary)
    regions, rms = summary["regions"], [[region["rms"] for region in row["regions"]] for row in models]
    rms = np.array(rms, dtype=float)
    axes = names("held-out region", regions), linear("RMS error [mm]", rms, zero=True)
    plots = []
    for row, errors in zip(models, rms, strict=True):
        words = [f"{region}: {format_number(value)} mm" for region, value in zip(regions, errors.tolist(), strict=True)]
        tone = "accent" if row["model"] == summary["recommended"] else "main"
        marks = Marks("", np.arange(len(errors)), errors, "dot", tone, words, size=7)
        plots.append(Plot(*axes, (marks,), title=row["model"], height=170))
    title = "Errors by region"
    says = (
        "The RMS error in each region when the model is fitted to all the other regions; the recommended model is "
        "highlighted."
    )
    return Report(
        title=f"Comparison of joint models, {summary['arm'] or 'an arm'}",
        subtitle=f"{pluralise(len(models), 'model')} on {pluralise(summary['poses'], 'pose')}; "
        f"{pluralise(len(regions), 'region')} held out in turn",
        verdict=" ".join(summary["findings"]),
        verdict_mark="unsure" if doubtful else "good",
        warnings=list(summary["warnings"]),
        numbers=[
            ("Recommended model", chosen["model"], ""),
            ("Its RMS error in held-out regions", f"{format_number(chosen['rms_outside'])}\u00a0mm", ""),
            ("Its error / the predicted error", f"{math.sqrt(chosen['ratio']):.2f}", "RMS; 1 is expected"),
        ],
        picture=models_chart(summary),
        facts=[],
        sections=[
            Section("models", "Errors inside and outside", [_MODELS, by_name, MODELS_MEANING]),
            Section("regions", title, [Chart("regions", title, says, tuple(plots), by_region)]),
        ],
    )
