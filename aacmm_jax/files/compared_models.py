"""Compared models of an arm's joints in HDF5: what `compare-models` found, model by model and region by region."""

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .hdf5 import Table, check_sense, columns, opened, undamaged, write_tables

KIND = "model comparison"
# Columns of the table of models: unit and meaning.
_MODELS = {
    "parameters": ("1", "free parameters"),
    "effective_parameters": ("1", "parameters that the data determine"),
    "rms_inside": ("mm", "RMS distance of the poses that the model was fitted to"),
    "rms_outside": ("mm", "RMS error in regions that the model has not seen"),
    "u_outside": ("mm", "standard error of rms_outside, by the scatter of the regions"),
    "ratio": ("1", "mean of (error / predicted standard deviation)^2 outside"),
    "log_evidence": ("1", "log of the evidence, but for what all models have in common"),
    "difference": ("mm2", "mean square outside less that of the best model"),
    "u_difference": ("mm2", "standard error of the difference"),
    "cpu_seconds": ("s", "CPU time"),
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

    Raises:
        InputError: The file cannot be written, or a name holds a character that no file can hold.

    Example:
        >>> from aacmm_jax.summaries.compared_models import compared_models_summary
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> summary = compared_models_summary(compared, nominal.name) | {"poses": 60}
        >>> aj.files.save_compared_models("models.h5", summary)
        >>> print(aj.files.load_compared_models("models.h5")["arm"])
        Cheng 2018, simulated arm
    """
    models, rows = summary["models"], [(row["model"], region) for row in summary["models"] for region in row["regions"]]
    by_model = {
        name: (np.array([row[name] for row in models], float), unit, says) for name, (unit, says) in _MODELS.items()
    }
    by_region = columns(
        "row",
        model=([model for model, _ in rows], "", "model of the joints"),
        region=([region["region"] for _, region in rows], "", "region that was left out"),
        poses=([region["poses"] for _, region in rows], "1", "its poses"),
        rms=(np.array([region["rms"] for _, region in rows], float), "mm", "RMS error of its poses"),
        ratio=(
            np.array([region["ratio"] for _, region in rows], float),
            "1",
            "mean of (error / predicted standard deviation)^2",
        ),
    )
    converged = np.array([bool(row["converged"]) for row in models])
    tables = {  # for other programs: the summary has all of it
        "models": Table(
            columns("model", model=([row["model"] for row in models], "", "model of the joints"), **by_model)
            | columns("model", converged=(converged, "", "whether its calibration converged"))
        ),
        "by_region": Table(by_region),
    }
    write_tables(path, KIND, tables, {"sources": list(sources) or None, "seed": seed}, summary=summary)


def load_compared_models(path: str | os.PathLike) -> dict[str, Any]:
    """Read compared models: the summary that was saved.

    Args:
        path: The file to read.

    Raises:
        InputError: The file does not exist, is damaged, is not of this kind, or was written by another version.

    Example:
        >>> from aacmm_jax.summaries.compared_models import compared_models_summary
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> summary = compared_models_summary(compared, nominal.name) | {"poses": 60}
        >>> aj.files.save_compared_models("models.h5", summary)
        >>> print(aj.files.load_compared_models("models.h5")["recommended"])
        dh
    """
    with undamaged(path), opened(path, (KIND,)) as content:
        summary = json.loads(str(content.values(content.file.id, "summary")))
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
