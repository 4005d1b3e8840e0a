"""The report of compared models: errors inside and outside, region by region."""

from typing import Any

import numpy as np

from ..core.text import pluralise
from ..summaries.tables import difference_from_best
from . import charts
from .elements import Chart, Report, ReportTable, Section, format_number, number_cell, text_cell


def models_report(summary: dict[str, Any]) -> Report:
    """The report, except for the origin of its file.

    Args:
        summary: What `files.load_compared_models` returned.
    """
    models = summary["models"]
    chosen = next(row for row in models if row["model"] == summary["recommended"])
    doubtful = bool(summary["warnings"]) or not chosen["converged"]
    outside = f"{format_number(chosen['rms_outside'])}\u00a0mm"
    facts = [
        ("Recommended model", chosen["model"]),
        ("Its RMS error in unseen regions", outside),
        ("(error / predicted standard deviation)², mean outside", number_cell(chosen["ratio"], 2).text),
    ]
    return Report(
        title=f"Models of the joints compared, {summary['arm'] or 'an arm'}",
        subtitle=f"{pluralise(len(models), 'model')} on {pluralise(summary['poses'], 'pose')}; "
        f"{pluralise(len(summary['regions']), 'region')} left out one by one",
        verdict=" ".join(summary["findings"]),
        verdict_mark="unsure" if doubtful else "good",
        warnings=list(summary["warnings"]),
        facts=facts,
        sections=[
            Section("models", "Errors inside and outside", [_introduction(), _by_model(summary), *_table(models)]),
            Section("regions", "Errors by region", [_by_region(summary)]),
        ],
    )


def _introduction() -> str:
    return (
        "Each model was calibrated with all poses (inside), and without each region in turn, which it then predicted "
        "(outside). Neighbouring poses err alike, so that only regions that were left out whole show what a model is "
        "good for elsewhere. Of the model that is best outside, and simpler ones that regions cannot tell from it, the "
        "simplest that makes the measurement about as probable (evidence) is recommended."
    )


def _by_model(summary: dict[str, Any]) -> Chart:
    models = summary["models"]
    x = np.arange(len(models))
    inside, outside, u = (
        np.array([np.nan if row[key] is None else row[key] for row in models])
        for key in ("rms_inside", "rms_outside", "u_outside")
    )
    hover = [
        f"{row['model']}: inside {format_number(a)} mm, outside {format_number(b)} ± {format_number(c)} mm"
        for row, a, b, c in zip(models, inside.tolist(), outside.tolist(), u.tolist(), strict=True)
    ]
    chosen = [row["model"] for row in models].index(summary["recommended"])
    marks = (
        charts.Marks("inside", x, inside, "square", "soft", size=8),
        charts.Marks("outside, ± one standard error", x, outside, "dot", "main", hover, outside - u, outside + u, 8),
        charts.Marks("recommended", [chosen], [outside[chosen]], "diamond", "accent"),
    )
    y = charts.linear("RMS error [mm]", inside, outside - u, outside + u, [0.0], zero=True)
    axes = charts.names("", [row["model"] for row in models]), y
    description = "The RMS distance of poses from their geometry, from the simplest model to the richest."
    return Chart("models", "Errors by model", description, (charts.Plot(*axes, marks, height=260),))


def _table(models: list[dict[str, Any]]) -> tuple[ReportTable, str]:
    most_probable = max(row["log_evidence"] for row in models)
    least = min(row["rms_outside"] for row in models)
    rows = [
        [
            text_cell(*((row["model"],) if row["converged"] else (f"{row['model']}: did not converge", "unsure"))),
            number_cell(row["parameters"], 0),
            number_cell(row["effective_parameters"], 1),
            *(number_cell(row[key]) for key in ("rms_inside", "rms_outside", "u_outside")),
            *(number_cell(one) for one in difference_from_best(row, least)),
            number_cell(row["ratio"], 2),
            number_cell(row["log_evidence"] - most_probable, 1),
            number_cell(row["cpu_seconds"], 1),
        ]
        for row in models
    ]
    columns = (
        "model",
        "parameters",
        "determined",
        "inside [mm]",
        "outside [mm]",
        "u of it [mm]",
        "to the best outside [mm]",
        "u of it [mm]",
        "ratio",
        "evidence",
        "CPU [s]",
    )
    meaning = (
        "Determined: parameters that the data determine. u of it: standard error of the number before it. To the best: "
        "difference of the error outside to the best one, compared region by region. Ratio: mean of (error / predicted "
        "standard deviation)² outside. Evidence: its logarithm, less that of the most probable model."
    )
    return ReportTable("Models", columns, rows), meaning


def _by_region(summary: dict[str, Any]) -> Chart:
    models = summary["models"]
    table = np.array([[np.nan if one["rms"] is None else one["rms"] for one in row["regions"]] for row in models])
    x, y = (
        charts.names("region that was left out", summary["regions"]),
        charts.linear("RMS error [mm]", table, zero=True),
    )
    plots = []
    for row, errors in zip(models, table, strict=True):
        hover = [
            f"{region}: {format_number(value)} mm"
            for region, value in zip(summary["regions"], errors.tolist(), strict=True)
        ]
        tone = "accent" if row["model"] == summary["recommended"] else "main"
        marks = charts.Marks("", np.arange(len(errors)), errors, "dot", tone, hover, size=7)
        plots.append(charts.Plot(x, y, (marks,), title=row["model"], height=170))
    rows = [
        [
            text_cell(region),
            number_cell(models[0]["regions"][i]["poses"], 0),
            *(number_cell(row["regions"][i]["rms"]) for row in models),
        ]
        for i, region in enumerate(summary["regions"])
    ]
    columns = ("region", "poses", *(row["model"] for row in models))
    description = (
        "The RMS error of each region, predicted from all the others; the recommended model in the other colour."
    )
    return Chart(
        "regions", "Errors by region", description, tuple(plots), ReportTable("RMS error by region [mm]", columns, rows)
    )
