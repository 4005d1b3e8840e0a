"""The report of compared models: errors inside and outside, region by region."""

from typing import Any

import numpy as np

from ..core.text import pluralise
from ..plot.charts import Chart, Marks, Plot, linear, names
from ..plot.parameters import models_chart
from ..summaries.result_tables import MODELS_MEANING, model_tables
from ..summaries.tables import Table, format_number, number
from .elements import Report, Section

_INTRODUCTION = (
    "Each model was calibrated with all poses (inside), and without each region in turn, which it then predicted "
    "(outside). Neighbouring poses have similar errors, so that only regions that were left out whole show how a model "
    "extrapolates. Of the model that is best outside, and simpler ones that regions cannot tell from it, the "
    "simplest that makes the measurement about as probable (evidence) is recommended."
)


def models_report(summary: dict[str, Any]) -> Report:
    """The report, except for the origin of its file.

    Args:
        summary: What `files.load_compared_models` returned.
    """
    models = summary["models"]
    chosen = next(row for row in models if row["model"] == summary["recommended"])
    doubtful = bool(summary["warnings"]) or not chosen["converged"]
    by_name, by_region = model_tables(summary)
    return Report(
        title=f"Models of the joints compared, {summary['arm'] or 'an arm'}",
        subtitle=f"{pluralise(len(models), 'model')} on {pluralise(summary['poses'], 'pose')}; "
        f"{pluralise(len(summary['regions']), 'region')} left out one by one",
        verdict=" ".join(summary["findings"]),
        verdict_mark="unsure" if doubtful else "good",
        warnings=list(summary["warnings"]),
        facts=[
            ("Recommended model", chosen["model"]),
            ("Its RMS error in unseen regions", f"{format_number(chosen['rms_outside'])}\u00a0mm"),
            ("(error / predicted standard deviation)², mean outside", number(chosen["ratio"], 2).text),
        ],
        sections=[
            Section(
                "models", "Errors inside and outside", [_INTRODUCTION, models_chart(summary), by_name, MODELS_MEANING]
            ),
            Section("regions", "Errors by region", [_by_region(summary, by_region)]),
        ],
    )


def _by_region(summary: dict[str, Any], by_region: Table) -> Chart:
    models, regions = summary["models"], summary["regions"]
    rms = np.array(
        [[np.nan if region["rms"] is None else region["rms"] for region in row["regions"]] for row in models]
    )
    axes = names("region that was left out", regions), linear("RMS error [mm]", rms, zero=True)
    plots = []
    for row, errors in zip(models, rms, strict=True):
        words = [f"{region}: {format_number(value)} mm" for region, value in zip(regions, errors.tolist(), strict=True)]
        tone = "accent" if row["model"] == summary["recommended"] else "main"
        marks = Marks("", np.arange(len(errors)), errors, "dot", tone, words, size=7)
        plots.append(Plot(*axes, (marks,), title=row["model"], height=170))
    description = (
        "The RMS error of each region, predicted from all the others; the recommended model in the other colour."
    )
    return Chart("regions", "Errors by region", description, tuple(plots), by_region)
