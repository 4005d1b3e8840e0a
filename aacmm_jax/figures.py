"""Figures of a calibration (matplotlib), readable in grey."""

from pathlib import Path
from typing import Any

import numpy as np

from . import storage
from .arm import Arm
from .calibration_files import CalibrationRecord
from .parameters import is_length
from .residuals import Measurement

_STYLE = {
    "nominal": {"label": "before", "color": "0.65", "marker": "o"},
    "stage1": {"label": "stage 1", "color": "#d95f02", "marker": "^"},
    "calibrated": {"label": "stage 2", "color": "#1b3a6b", "marker": "s"},
}


def calibration_figure(record: CalibrationRecord, path: Path) -> None:
    """Distances from the centroid pose by pose and, where the truth is known, errors of the length parameters; as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    panels = 2 if record.recording.true is not None else 1
    figure, axes = pyplot.subplots(1, panels, figsize=(5.5 * panels, 3.9), layout="constrained", squeeze=False)
    plot_distances(record, axes[0, 0])
    if panels == 2:
        plot_length_errors(record, axes[0, 1])
    with storage.whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150)
    pyplot.close(figure)


def plot_distances(record: CalibrationRecord, axes: Any) -> Any:
    """Distance of every pose's tip from its socket's centroid, by each arm; returns the axes."""
    measurement = Measurement.of(record.recording.capture)
    arms: dict[str, Arm] = {"nominal": record.recording.nominal.arm, "calibrated": record.calibrated.arm}
    for stage, arm in arms.items():
        distances = np.linalg.norm(np.asarray(measurement.centred(arm.position(measurement.q))), axis=1)
        label = "before" if stage == "nominal" else "calibrated"
        style = _STYLE[stage] | {"label": f"{label} (mean {distances.mean():.3g} mm)"}
        axes.plot(np.arange(1, len(distances) + 1), distances, linestyle="none", markersize=3.5, **style)
    for border in np.cumsum(record.recording.capture.sizes)[:-1]:
        axes.axvline(border + 0.5, color="0.3", linewidth=0.8, linestyle="--", zorder=0)
    axes.set_yscale("log")
    axes.set_xlabel("pose (dashed lines separate sockets)" if len(record.recording.capture.sizes) > 1 else "pose")
    axes.set_ylabel("distance from the socket's centroid [mm]")
    axes.grid(True, which="major", axis="y", alpha=0.3)
    axes.legend(loc="center right", framealpha=1, edgecolor="none")
    return axes


def plot_length_errors(record: CalibrationRecord, axes: Any) -> Any:
    """Error of every length parameter against the truth, by stage; returns the axes."""
    vectors = record.vectors()
    chosen = [i for i, name in enumerate(record.names) if is_length(name)]
    for stage, style in _STYLE.items():
        error = np.abs(vectors[stage] - vectors["true"])[chosen]
        axes.plot(np.arange(len(chosen)), np.maximum(error, 1e-5), linestyle="none", markersize=5, **style)
    axes.set_yscale("log")
    axes.set_xticks(np.arange(len(chosen)), [record.names[i] for i in chosen], rotation=60, ha="right")
    axes.set_ylabel("error against the true arm [mm]")
    axes.grid(True, which="major", alpha=0.3)
    axes.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return axes
