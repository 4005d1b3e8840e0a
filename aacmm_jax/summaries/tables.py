"""Titles and rows of tables that command line and report share; imports nothing, for the sake of ``--help``."""

from collections.abc import Mapping
from typing import Any

# Repeatability and errors of lengths, by their keys in a summary.
METRICS = (
    ("de_mm", "DE, mean distance of poses from their socket's centroid"),
    ("deltam_mm", "Deltam, largest half range of a coordinate in a socket"),
    ("rms_mm", "RMS distance of poses from their socket's centroid"),
    ("observed_rms_mm", "RMS distance of poses from their geometry, all kinds"),
    ("length_error_mean_absolute_mm", "length error, mean absolute"),
    ("length_error_largest_mm", "length error, largest"),
)


def volume_rows(volume: Mapping[str, Any], factor: float) -> list[tuple[str, list[float | None]]]:
    """U over the working volume: what it is of, and its median, 95th percentile and largest value, mm."""
    length = f"{volume['length_mm']:g} mm length"
    titles = {
        "u_tip": "tip position, along its worst direction: from the calibration",
        "u_length": f"{length}: from the calibration",
        "u_length_reading": f"{length}: with the noise of both readings",
    }
    u = {key: [volume[f"{key}_{which}_mm"] for which in ("median", "95", "largest")] for key in titles}
    return [(title, [None if x is None else factor * x for x in u[key]]) for key, title in titles.items()]
