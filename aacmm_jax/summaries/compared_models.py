"""Compared models of an arm's joints, in numbers and sentences."""

import math
from typing import Any

from ..pipeline.model_ladder import ComparedModels
from .result_tables import MODELS_MEANING, model_tables
from .tables import Styled, View, attributes, rms_difference, warnings_of, written_of

_EXCESS = 2.0  # of the mean squared normalised error, from which the uncertainty is said to be too small

_COPIED = (
    *("model", "parameters", "effective_parameters", "rms_inside", "rms_outside", "u_outside", "ratio"),
    *("log_evidence", "cpu_seconds"),
)


def compared_models_summary(compared: ComparedModels, arm: str) -> dict[str, Any]:
    """What ``compare-models`` reports of the arm of this name; mm, and mm^2 of differences of mean squares."""
    chosen, best = compared.recommended, compared.models[compared.best]
    rows = [
        attributes(model, *_COPIED)
        | {
            "difference": difference,
            "u_difference": u_difference,
            "converged": bool(model.result.converged),
            "regions": [
                {"region": row.label, "poses": row.poses, "rms": math.sqrt(row.mean_square), "ratio": row.ratio}
                for row in model.regions
            ],
        }
        for model, (difference, u_difference) in zip(compared.models, compared.differences, strict=True)
    ]
    finding = f"Recommended: {chosen.model}, which predicts held-out regions best of all models compared."
    if chosen is not best:
        difference, u = rms_difference(rows[compared.models.index(chosen)], best.rms_outside)
        finding = (
            f"Recommended: {chosen.model}. The error of this model on held-out regions is not significantly larger "
            f"than the error of the best model ({best.model}): the difference is {difference:.2g} mm, with a standard "
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
    if chosen.ratio >= _EXCESS:
        sentences.append(
            f"With {chosen.model}, errors in held-out regions are {math.sqrt(chosen.ratio):.1f} times as large as the "
            "noise and the prior predict: either all models compared lack an effect, or the poses do not cover the "
            "whole travel of the joints."
        )
    return sentences


def compared_models(summary: dict[str, Any]) -> View:
    """Compared models."""
    yield [
        Styled(summary["arm"]),
        f": {len(summary['models'])} models on {summary['poses']} poses, {len(summary['regions'])} regions held out "
        "in turn",
    ]
    yield from warnings_of(summary)
    yield from summary["findings"]
    by_name, by_region = model_tables(summary)
    yield by_name
    yield MODELS_MEANING
    yield by_region
    yield from written_of(summary)
