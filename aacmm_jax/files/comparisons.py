"""Comparisons of calibrations in HDF5: what ``aacmm compare`` found."""

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

from .hdf5 import check_sense, opened, undamaged, write_tables
from .records import Fields, number, rows_table, text

KIND = "comparison"
_UNIT = "see unit"
_CHANGES: Fields = {
    "calibration": text("calibration that is compared with the first"),
    "parameter": text("parameter"),
    "unit": text("unit of the parameter"),
    "old": number("value in the first calibration", _UNIT),
    "new": number("value in this calibration", _UNIT),
    "change": number("change from the first calibration", _UNIT),
    "u": number("standard uncertainty of the change", _UNIT),
    "expanded": number("expanded uncertainty of the change", _UNIT),
}
_LENGTHS: Fields = {
    "calibration": text("calibration that is compared with the first"),
    "length_mm": number("length", "mm", name="length"),
    "rms_mm": number("RMS change of lengths over the working volume", "mm", name="rms"),
    "rms_by_chance_mm": number("RMS change expected from the uncertainties", "mm", name="rms_by_chance"),
    "largest_mm": number("largest change", "mm", name="largest"),
    "mean_mm": number("mean change", "mm", name="mean"),
}


def save_comparison(path: str | os.PathLike, summary: Mapping[str, Any], sources: Sequence[str] = ()) -> None:
    """Write a comparison of calibrations to HDF5, whole or not at all.

    Args:
        path: The file to write.
        summary: What `summaries.drift.compared_summary` returned.
        sources: Names and digests of the files that were read.

    Example:
        >>> from aacmm_jax.summaries.drift import compared_summary
        >>> trend = aj.drift.trend([record, record_in_june], ["2026-01-31", "2026-06-30"], points=20)
        >>> aj.files.save_comparison("drift.h5", compared_summary(trend, ["january", "june"], nominal.name))
        >>> print(aj.files.load_comparison("drift.h5")["new"])
        june
    """
    others = summary["trend"][1:]
    changes = [{"calibration": row["calibration"]} | change for row in others for change in row["parameters"]]
    lengths = [{"calibration": row["calibration"]} | row["lengths"] for row in others]
    tables = {  # for other programs: the summary has all of it
        "changes": rows_table("row", changes, _CHANGES),
        "lengths": rows_table("calibration", lengths, _LENGTHS),
    }
    write_tables(path, KIND, tables, {"sources": list(sources) or None}, summary=summary)


def load_comparison(path: str | os.PathLike) -> dict[str, Any]:
    """Read a comparison of calibrations: the summary that was saved.

    Args:
        path: The file to read.

    Raises:
        InputError: the file does not exist, is damaged, or is not of this kind.

    Example:
        >>> from aacmm_jax.summaries.drift import compared_summary
        >>> trend = aj.drift.trend([record, record_in_june], ["2026-01-31", "2026-06-30"], points=20)
        >>> aj.files.save_comparison("drift.h5", compared_summary(trend, ["january", "june"], nominal.name))
        >>> print(len(aj.files.load_comparison("drift.h5")["trend"]))
        2
    """
    with undamaged(path), opened(path, (KIND,)) as file:
        summary = json.loads(file["summary"].asstr()[()])
        names = [[row["parameter"] for row in part["parameters"]] for part in summary["trend"][1:]]
        check_sense(
            path,
            {
                "it compares fewer than two calibrations": not names,
                "the calibrations have different parameters": any(part != names[0] for part in names),
                "a coverage probability is not between 0 and 1": not 0 < summary["level"] < 1,
            },
        )
        return summary
