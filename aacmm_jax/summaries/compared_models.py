"""Compared models of an arm's joints, in numbers and sentences."""

import math
from collections.abc import Mapping
from typing import Any

from ..core.text import listed as listed_words
from ..pipeline.model_ladder import ComparedModels, rms_difference
from .tables import (
    Cell,
    Columns,
    Styled,
    Table,
    View,
    attributes,
    listed,
    number,
    warnings_of,
    written_of,
)

_EXCESS = 2.0  # of the mean squared normalised error, from which the uncertainty is said to be too small

_COPIED = (
    *("model", "parameters", "effective_parameters", "rms_inside", "rms_outside", "u_outside", "ratio"),
    *("log_evidence", "cpu_seconds"),
)
MODELS_MEANING = (
    "Determined: number of parameters that the data determine. Inside: RMS distance of all poses from their geometry. "
    "Outside: RMS distance of held-out poses, with each region held out in turn. Excess: outside error minus the "
    "outside error of the best model, from the differences in each region. u: standard errors from the scatter of the "
    "regions. Ratio: mean of (error / predicted standard deviation)² of held-out poses. Evidence: logarithm of the "
    "evidence, minus the value of the most probable model."
)


def compared_models_summary(compared: ComparedModels, arm: str) -> dict[str, Any]:
    """What ``compare-models`` reports of the arm of this name; mm, and mm^2 of differences of mean squares."""
    chosen, best = compared.recommended, compared.models[compared.best]
    rows = [
        attributes(model, *_COPIED)
        | {
            "difference": difference,
            "u_difference": u_difference,
            "excess": excess,  # mm
            "u_excess": u_excess,
            "converged": bool(model.result.converged),
            "regions": [
                {"region": row.label, "poses": row.poses, "rms": math.sqrt(row.mean_square), "ratio": row.ratio}
                for row in model.regions
            ],
        }
        for model, (difference, u_difference) in zip(compared.models, compared.differences, strict=True)
        for excess, u_excess in [compared.excess(model.model)]
    ]
    finding = f"{chosen.model} is recommended: it predicts held-out regions best of all models compared."
    if chosen is not best:
        difference, u = compared.excess(chosen.model)
        finding = (
            f"{chosen.model} is recommended: its error on held-out regions is not significantly larger "
            f"than that of the best model ({best.model}): the difference is {difference:.2g} mm, with a standard "
            f"error of {u:.2g} mm from the scatter of the regions. {chosen.model} is the simplest model for which "
            "this holds and under which the measurements are about equally probable."
        )
    return {
        "arm": arm,
        "regions": [region.label for region in chosen.regions],
        "models": rows,
        "best": best.model,
        "recommended": chosen.model,
        "findings": [finding],
        "warnings": _warnings(compared),
    }


def _warnings(compared: ComparedModels) -> list[str]:
    chosen = compared.recommended
    sentences = [f"{model.model} did not converge." for model in compared.models if not model.result.converged]
    if compared.skipped:
        sentences.append(f"Not compared, because the data are too few for them: {listed_words(compared.skipped)}.")
    if chosen.ratio >= _EXCESS:
        sentences.append(
            f"With {chosen.model}, errors in held-out regions are {math.sqrt(chosen.ratio):.1f} times as large as the "
            "noise and the prior predict: either all models compared lack an effect, or the poses do not cover the "
            "whole travel of the joints."
        )
    return sentences


def model_tables(summary: Mapping[str, Any]) -> tuple[Table, Table]:
    """Compared models, and their errors region by region."""
    models, regions = summary["models"], summary["regions"]
    most_probable = max(row["log_evidence"] for row in models)
    least = min(row["rms_outside"] for row in models)

    def to_best(row: Mapping[str, Any]) -> tuple[float | None, float | None]:
        """None for the best model itself, and where too few regions are compared."""
        if row["difference"] is None or row["u_difference"] is None or row["rms_outside"] <= least:
            return None, None
        return rms_difference(row["difference"], row["u_difference"], row["rms_outside"], least)

    by_name = listed("Models", models, {
        "model": lambda row: (
            row["model"] if row["converged"] else Cell(f"{row['model']}: did not converge", None, "unsure")
        ),
        "parameters": "parameters",
        "determined": lambda row: number(row["effective_parameters"], 1),
        "inside [mm]": "rms_inside",
        "outside [mm]": "rms_outside",
        "u of outside": "u_outside",
        "excess [mm]": lambda row: to_best(row)[0],
        "u of excess": lambda row: to_best(row)[1],
        "ratio": lambda row: number(row["ratio"], 2),
        "evidence": lambda row: number(row["log_evidence"] - most_probable, 1),
        "CPU [s]": lambda row: number(row["cpu_seconds"], 1),
    })  # fmt: skip
    of_region: Columns = {"region": lambda i: regions[i], "poses": lambda i: models[0]["regions"][i]["poses"]}
    of_region |= {row["model"]: lambda i, row=row: row["regions"][i]["rms"] for row in models}
    return by_name, listed("RMS error of each region [mm]", range(len(regions)), of_region)


def compared_models(summary: dict[str, Any]) -> View:
    """Compared models: the recommended one first."""
    yield from (Styled(finding) for finding in summary["findings"])
    yield [
        Styled(summary["arm"]),
        f": {len(summary['models'])} models on {summary['poses']} poses, {len(summary['regions'])} regions held out "
        "in turn",
    ]
    yield from warnings_of(summary)
    by_name, by_region = model_tables(summary)
    yield by_name
    yield MODELS_MEANING
    yield by_region
    yield from written_of(summary)
