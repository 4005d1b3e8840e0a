"""The report of compared models: errors inside and outside, region by region."""

from typing import Any

import numpy as np

from ..core.text import pluralise
from ..plot.charts import Chart, Marks, Plot, linear, names
from ..plot.joint_models import models_chart
from ..summaries.tables import Cell, Table, difference_from_best, format_number, listed, number
from .elements import Report, Section

_INTRODUCTION = (
    "Each model was calibrated with all poses (inside), and without each region in turn, which it then predicted "
    "(outside). Neighbouring poses have similar errors, so that only regions that were left out whole show how a model "
    "extrapolates. Of the model that is best outside, and simpler ones that regions cannot tell from it, the "
    "simplest that makes the measurement about as probable (evidence) is recommended."
)
_MEANING = (
    "Determined: parameters that the data determine. u of it: standard error of the number before it. To the best: "
    "difference of the error outside to the best one, compared region by region. Ratio: mean of (error / predicted "
    "standard deviation)² outside. Evidence: its logarithm, less that of the most probable model."
)


def models_report(summary: dict[str, Any]) -> Report:
    """The report, except for the origin of its file.

    Args:
        summary: What `files.load_compared_models` returned.
    """
    models = summary["models"]
    recommended = [row["model"] for row in models].index(summary["recommended"])
    chosen = models[recommended]
    doubtful = bool(summary["warnings"]) or not chosen["converged"]
    columns = (np.array([row[key] for row in models], dtype=float)
               for key in ("rms_inside", "rms_outside", "u_outside"))  # fmt: skip
    by_model = models_chart([row["model"] for row in models], recommended, *columns)
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
            Section("models", "Errors inside and outside", [_INTRODUCTION, by_model, _model_table(models), _MEANING]),
            Section("regions", "Errors by region", [_by_region(summary)]),
        ],
    )


def _model_table(models: list[dict[str, Any]]) -> Table:
    most_probable = max(row["log_evidence"] for row in models)
    least = min(row["rms_outside"] for row in models)
    columns = {
        "model": lambda row: (
            row["model"] if row["converged"] else Cell(f"{row['model']}: did not converge", None, "unsure")
        ),
        "parameters": "parameters",
        "determined": lambda row: number(row["effective_parameters"], 1),
        "inside [mm]": "rms_inside",
        "outside [mm]": "rms_outside",
        "u of it [mm]": "u_outside",
        "to the best outside [mm]": lambda row: difference_from_best(row, least)[0],
        "u of the difference [mm]": lambda row: difference_from_best(row, least)[1],
        "ratio": lambda row: number(row["ratio"], 2),
        "evidence": lambda row: number(row["log_evidence"] - most_probable, 1),
        "CPU [s]": lambda row: number(row["cpu_seconds"], 1),
    }
    return listed("Models", models, columns)


def _by_region(summary: dict[str, Any]) -> Chart:
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
    columns = {"region": lambda i: regions[i], "poses": lambda i: models[0]["regions"][i]["poses"]}
    columns |= {row["model"]: lambda i, row=row: row["regions"][i]["rms"] for row in models}
    by_region = listed("RMS error by region [mm]", range(len(regions)), columns)
    description = (
        "The RMS error of each region, predicted from all the others; the recommended model in the other colour."
    )
    return Chart("regions", "Errors by region", description, tuple(plots), by_region)
