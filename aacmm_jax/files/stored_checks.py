"""Whether the values of an HDF5 file make sense, whoever wrote it: checked when it is loaded, and before it is shown.

Nothing here needs JAX, so that ``aacmm show`` checks a file and prints the summary in it quickly.
"""

import base64
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..core.pictures import picture_size
from .hdf5 import Entries, Stored, StoredTable, check_sense, is_moment, read_tables, undamaged
from .records import check_fields
from .schema import RECORDING, TABLES

_ROUNDING = 1e-6  # of k
_LARGEST_PICTURE = 1000  # px
_LARGEST_U = 0.1  # of k: beyond it the scale is as good as unknown


def read_checked(path: str | os.PathLike, kinds: Sequence[str]) -> Stored:
    """The tables of a capture, calibration or evaluation, with values that they can have. Raises `InputError`."""
    stored = read_tables(path, kinds)
    with undamaged(path):
        check_fields(RECORDING, Entries(path, "entry", {}), stored.attributes)
        for name, fields in TABLES.items():
            if name in stored.tables:
                check_fields(fields, stored.tables[name], stored.tables[name].attributes)
        measured = stored.attributes.get("measured")
        check_sense(path, {"the day of measurement is not a date": measured and not is_moment(measured[:10])})
        if "capture" in stored.tables:
            joints = stored.tables["capture"]["angle"].shape[1]
            arms = [table["alpha"].shape for name, table in stored.tables.items() if name.endswith("_arm")]
            others = any(shape != (joints,) for shape in arms)
            check_sense(path, {"the arm and the readings have different numbers of joints": others})
        if stored.attributes["kind"] == "calibration":
            _check_calibration(path, stored.tables["parameters"], stored.tables["reference"])
        if "uncertainty" in stored.tables:
            covariance = stored.tables["uncertainty"]["covariance"]
            check_sense(
                path,
                {
                    "the covariance matrix has negative eigenvalues or is not symmetric": not _is_semidefinite(
                        covariance
                    )
                },
            )
        if "points" in stored.tables:
            _check_points(path, stored.tables["points"])
        previews = stored.tables.get("images", {}).get("preview", ())
        check_sense(path, {"the picture of an image is not a small JPEG": not all(map(_is_preview, previews))})
    return stored


def _is_preview(text: str) -> bool:
    """Whether a picture is empty, or a JPEG whose header states a small size: a browser is to decode it."""
    try:
        content = base64.b64decode(text, validate=True)
    except ValueError:
        return False
    size = picture_size(content) if content[:2] == b"\xff\xd8" else None
    return not content or (size is not None and max(size) <= _LARGEST_PICTURE)


def check_shown(path: str | os.PathLike, kind: str, summary: Mapping[str, Any]) -> None:
    """Raise `InputError` where values of a file, or the summary in it, make no sense."""
    stored = read_checked(path, (kind,))
    with undamaged(path):
        if kind == "calibration":
            attributes = stored.tables["parameters"].attributes
            names = {"scale_k": "k", "scale_u": "u_k", "converged": "converged"}
            shown = [np.nan if summary[name] is None else summary[name] for name in names]
            held = [attributes[name] for name in names.values()]
            same = np.allclose(np.array(shown, float), np.array(held, float), rtol=0, atol=0, equal_nan=True)
            check_sense(path, {"the summary does not agree with the stored values": not same})


def _check_calibration(path: str | os.PathLike, table: StoredTable, reference: StoredTable) -> None:
    """Raise `InputError` where values of a calibration contradict each other.

    k is a weighted mean of measured over certified lengths, so it lies between the least and the largest of them; its
    lengths are between positions by weighted poses, and those stored between centroids, which differ by less than u.
    """
    attributes, covariance, names = table.attributes, table["covariance"], table["parameter"].tolist()
    k, u_k, converged = (attributes[name] for name in ("k", "u_k", "converged"))
    lengths = [
        reference[f"measured_{stage}"] / reference["value"]
        for stage in ("stage1", "calibrated")
        if len(reference["value"]) and f"measured_{stage}" in reference
    ]
    scaled = attributes["method"] == "two-stage"  # only the division by k needs reference lengths
    finite = all(np.all(np.isfinite(x)) for x in ((k, u_k, covariance) if scaled else (covariance,)))
    slack = _ROUNDING + (3 * u_k if u_k < _LARGEST_U else 0.0)
    of_lengths = any(ratio.min() - slack <= k <= ratio.max() + slack for ratio in lengths)
    needed = converged and lengths and (scaled or not np.isnan(k))
    check_sense(
        path,
        {
            "a parameter is named twice": len(set(names)) != len(names),
            "a parameter is both free and fixed": set(names) & set(attributes["held"] or ()),
            "a lower bound is above its upper bound": not np.all(table["lower"] <= table["upper"]),
            "the scale k is not positive": not k > 0 and not np.isnan(k),
            "a converged calibration has a scale or covariance that is not finite": converged and not finite,
            "the scale k does not agree with the reference lengths": needed and not of_lengths,
            "the covariance matrix has negative eigenvalues or is not symmetric": finite
            and not _is_semidefinite(covariance),
        },
    )


def _check_points(path: str | os.PathLike, table: StoredTable) -> None:
    """Raise `InputError` where the points of an evaluation, or what is stated about the arm's reach, cannot be."""
    position, attributes = table["position"], table.attributes
    shoulder = attributes.get("shoulder_mm", [0.0] * 3)
    finite = position.shape == (len(table["socket"]), 3) and np.all(np.isfinite(position))
    check_sense(
        path,
        {
            "a position does not have three finite coordinates": not finite,
            "the reach is not positive and finite": not 0 < attributes.get("radius_mm", 1.0) < np.inf,
            "the shoulder does not have three finite coordinates": len(shoulder) != 3
            or not np.all(np.isfinite(shoulder)),
        },
    )


def _is_semidefinite(covariance: np.ndarray) -> bool:
    """Whether a matrix is symmetric, and its correlations have no eigenvalue below zero, to rounding."""
    variance = np.diag(covariance)
    if np.any(variance < 0):
        return False
    root = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = covariance / root / root[:, None]
    symmetric = np.allclose(correlation, correlation.T, rtol=0, atol=1e-9)
    return symmetric and bool(np.all(np.linalg.eigvalsh(correlation) > -1e-6))
