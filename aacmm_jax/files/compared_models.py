"""Compared models of an arm's joints in HDF5: what `compare-models` found, model by model and region by region."""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .hdf5 import Table, columns, need, numbering, read_tables, undamaged, write_tables

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
_TEXTS = ("arm", "best", "recommended")
_LISTS = ("findings", "warnings", "regions")


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
    models = summary["models"]
    named: dict[str, Any] = {"model": ([row["model"] for row in models], "", "model of the joints")}
    named |= {key: ([_number(row[key]) for row in models], unit, text) for key, (unit, text) in _MODELS.items()}
    named["converged"] = ([int(row["converged"]) for row in models], "1", "whether its calibration converged")
    rows = [(row["model"], one) for row in models for one in row["regions"]]
    by_region = columns(
        "row",
        model=([model for model, _ in rows], "", "model of the joints"),
        region=([one["region"] for _, one in rows], "", "region that was left out"),
        poses=([one["poses"] for _, one in rows], "1", "its poses"),
        rms=([_number(one["rms"]) for _, one in rows], "mm", "RMS error of its poses"),
        ratio=([_number(one["ratio"]) for _, one in rows], "1", "mean of (error / predicted standard deviation)^2"),
    )
    tables = {
        "models": Table(columns("model", **named)),
        "by_region": Table(numbering("row", len(rows)) | by_region),
    }
    attributes = {key: summary[key] for key in _TEXTS} | {key: list(summary[key]) or None for key in _LISTS}
    attributes |= {"poses": int(summary["poses"]), "sources": list(sources) or None, "seed": seed}
    write_tables(path, KIND, tables, attributes, summary=dict(summary))


def load_compared_models(path: str | os.PathLike) -> dict[str, Any]:
    """Read compared models: the summary that was saved.

    Args:
        path: The file to read.

    Raises:
        InputError: The file does not exist, is damaged, is not of this kind, or was written by a newer version.

    Example:
        >>> from aacmm_jax.summaries.compared_models import compared_models_summary
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> summary = compared_models_summary(compared, nominal.name) | {"poses": 60}
        >>> aj.files.save_compared_models("models.h5", summary)
        >>> print(aj.files.load_compared_models("models.h5")["recommended"])
        dh
    """
    stored = read_tables(path, (KIND,))
    need(path, stored.tables, "models", "by_region")
    with undamaged(path):
        models, regions, attributes = stored.tables["models"], stored.tables["by_region"], stored.attributes
        found: dict[str, Any] = {key: str(attributes[key]) for key in _TEXTS}
        found |= {key: [str(one) for one in np.atleast_1d(attributes.get(key) or [])] for key in _LISTS}
        found["poses"] = int(attributes["poses"])
        found["models"] = [
            {"model": str(name)}
            | {key: _finite(models[key][i]) for key in _MODELS}
            | {"parameters": int(models["parameters"][i]), "converged": bool(models["converged"][i])}
            | {
                "regions": [
                    {
                        "region": str(regions["region"][k]),
                        "poses": int(regions["poses"][k]),
                        "rms": _finite(regions["rms"][k]),
                        "ratio": _finite(regions["ratio"][k]),
                    }
                    for k in np.flatnonzero(regions["model"] == name)
                ]
            }
            for i, name in enumerate(models["model"])
        ]
        return found


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
