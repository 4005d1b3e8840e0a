"""Compared models of an arm's joints, in numbers and sentences."""

import math
from typing import Any

from ..pipeline.model_ladder import ComparedModel, ComparedModels
from .tables import rms_difference

_EXCESS = 2.0  # of the mean squared normalised error, from which the uncertainty is said to be too small


def compared_models_summary(found: ComparedModels, arm: str) -> dict[str, Any]:
    """What ``compare-models`` reports; mm, and mm^2 of differences of mean squares.

    Args:
        found: What `compare_models` returned.
        arm: Name of the arm.
    """
    rows = [_row(model, *difference) for model, difference in zip(found.models, found.differences, strict=True)]
    chosen = found.recommended
    return {
        "arm": arm,
        "regions": [region.label for region in chosen.regions],
        "models": rows,
        "best": found.models[found.best].model,
        "recommended": chosen.model,
        "findings": [_finding(found)],
        "warnings": _warnings(found),
    }


def _row(model: ComparedModel, difference: float, u_difference: float) -> dict[str, Any]:
    return {
        "model": model.model,
        "parameters": model.parameters,
        "effective_parameters": model.effective_parameters,
        "rms_inside": model.rms_inside,
        "rms_outside": model.rms_outside,
        "u_outside": model.u_outside,
        "ratio": model.ratio,
        "log_evidence": model.log_evidence,
        "difference": difference,
        "u_difference": u_difference,
        "converged": bool(model.result.converged),
        "cpu_seconds": model.cpu_seconds,
        "regions": [
            {"region": one.label, "poses": one.poses, "rms": math.sqrt(one.mean_square), "ratio": one.ratio}
            for one in model.regions
        ],
    }


def _finding(found: ComparedModels) -> str:
    chosen, best = found.recommended, found.models[found.best]
    if chosen is best:
        return f"Recommended: {chosen.model}, which predicts regions that it has not seen best."
    difference, u = rms_difference(_row(chosen, *found.differences[found.models.index(chosen)]), best.rms_outside)
    return (
        f"Recommended: {chosen.model}. Regions that it has not seen cannot tell it from the best outside "
        f"({best.model}): its error is larger by {difference:.2g} mm, standard error {u:.2g} mm, region by region. It "
        "is the simplest of such models that makes the measurement as probable."
    )


def _warnings(found: ComparedModels) -> list[str]:
    chosen = found.recommended
    sentences = [f"{model.model} did not converge." for model in found.models if not model.result.converged]
    if chosen.ratio >= _EXCESS:
        sentences.append(
            f"With {chosen.model}, errors outside are {math.sqrt(chosen.ratio):.1f} times what its noise and prior "
            "predict: it lacks an effect that none of these models has, or poses all over the joints' travel."
        )
    return sentences
