"""Compared models of an arm's joints in HDF5: what `compare-models` found, model by model and region by region."""

import json
import os
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

from .hdf5 import check_sense, opened, undamaged, write_tables
from .records import Fields, number, rows_table, text, truth

KIND = "model comparison"
_MODELS: Fields = {
    "parameters": number("free parameters", "1"),
    "effective_parameters": number("parameters that the data determine", "1"),
    "rms_inside": number("RMS distance of the poses that the model was fitted to", "mm"),
    "rms_outside": number("RMS error in regions that the model has not seen", "mm"),
    "u_outside": number("standard error of rms_outside, by the scatter of the regions", "mm"),
    "ratio": number("mean of (error / predicted standard deviation)^2 outside", "1"),
    "log_evidence": number("log of the evidence, but for what all models have in common", "1"),
    "difference": number("mean square outside less that of the best model", "mm2"),
    "u_difference": number("standard error of the difference", "mm2"),
    "cpu_seconds": number("CPU time", "s"),
}
_REGIONS: Fields = {
    "model": text("model of the joints"),
    "region": text("region that was left out"),
    "poses": number("its poses", "1"),
    "rms": number("RMS error of its poses", "mm"),
    "ratio": number("mean of (error / predicted standard deviation)^2", "1"),
}
_NEEDED = ("parameters", "effective_parameters", "rms_inside", "rms_outside", "log_evidence", "cpu_seconds")
_LARGEST = 1e12


def save_compared_models(
    path: str | os.PathLike, summary: Mapping[str, Any], sources: Sequence[str] = (), seed: int | None = None
) -> None:
    """Write compared models to HDF5, whole or not at all.

    Args:
        path: The file to write.
        summary: What `summaries.compared_models_summary` returned, with the number of poses.
        sources: Names and digests of the files that were read.
        seed: Seed of a random choice of poses.

    Example:
        >>> from aacmm_jax.summaries.compared_models import compared_models_summary
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> summary = compared_models_summary(compared, nominal.name) | {"poses": 60}
        >>> aj.files.save_compared_models("models.h5", summary)
        >>> print(aj.files.load_compared_models("models.h5")["arm"])
        Cheng 2018, simulated arm
    """
    models = [SimpleNamespace(**row) for row in summary["models"]]
    regions = [SimpleNamespace(model=row.model, **region) for row in models for region in row.regions]
    fields = {"model": text("model of the joints"), **_MODELS, "converged": truth("whether its calibration converged")}
    tables = {  # for other programs: the summary has all of it
        "models": rows_table("model", models, fields),
        "by_region": rows_table("row", regions, _REGIONS),
    }
    write_tables(path, KIND, tables, {"sources": list(sources) or None, "seed": seed}, summary=summary)


def load_compared_models(path: str | os.PathLike) -> dict[str, Any]:
    """Read compared models: the summary that was saved.

    Args:
        path: The file to read.

    Example:
        >>> from aacmm_jax.summaries.compared_models import compared_models_summary
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> summary = compared_models_summary(compared, nominal.name) | {"poses": 60}
        >>> aj.files.save_compared_models("models.h5", summary)
        >>> print(aj.files.load_compared_models("models.h5")["recommended"])
        dh
    """
    with undamaged(path), opened(path, (KIND,)) as file:
        summary = json.loads(file["summary"].asstr()[()])
        _check(path, summary)
        return summary


def _check(path: str | os.PathLike, summary: Mapping[str, Any]) -> None:
    """Raise `InputError` where values make no sense."""
    models = summary["models"]
    names = [row["model"] for row in models]
    numbers = [row[key] for row in models for key in _MODELS]
    numbers += [region[key] for row in models for region in row["regions"] for key in ("rms", "ratio")]
    chosen = {summary["best"], summary["recommended"]}
    uneven = any([region["region"] for region in row["regions"]] != summary["regions"] for row in models)
    positive = [row[key] for row in models for key in _NEEDED[:4]]
    positive += [region["rms"] or 0.0 for row in models for region in row["regions"]]
    check_sense(
        path,
        {
            "it holds no models": not models,
            "a model is named twice": len(set(names)) != len(names),
            "the recommended model is not one of its models": not chosen <= set(names),
            "a model lacks a region": uneven,
            "a model lacks a number": any(row[key] is None for row in models for key in _NEEDED),
            "a number is larger than any can be": any(abs(value) > _LARGEST for value in numbers if value is not None),
            "a number is negative that cannot be": any(value is not None and value < 0 for value in positive),
        },
    )
