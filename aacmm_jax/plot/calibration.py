"""Figures of a calibration: distances of the poses, parameters and reference lengths, nominal and calibrated."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.errors import InputError
from ..core.units import ARCSEC
from ..kinematics.arm import is_length
from ..model.measurement import Measurement
from .style import ACCENT, DARK, LIGHT, axes_or_new, label_axes, label_parameters, save_figure

_STAGES: Mapping[str, Mapping[str, Any]] = {
    "nominal": {"label": "nominal", "color": LIGHT, "marker": "o"},
    "stage1": {"label": "stage 1", "color": ACCENT, "marker": "^"},
    "calibrated": {"label": "calibrated", "color": DARK, "marker": "s"},
}


def pose_distances(record: CalibrationRecord, axes: Any = None) -> Any:
    """Plot the distance of each pose's tip from its socket's centroid, nominal and calibrated, mm (logarithmic).

    Args:
        record: The calibration.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.
    """
    axes = axes_or_new(axes)
    measurement = Measurement.of(record.recording.capture)
    for stage, arm in (("nominal", record.recording.nominal.arm), ("calibrated", record.calibrated.arm)):
        distance = np.linalg.norm(np.asarray(measurement.centred(arm.position(measurement.q))), axis=1)
        style = {**_STAGES[stage]} | {"label": f"{_STAGES[stage]['label']} (mean {distance.mean():.3g} mm)"}
        axes.plot(np.arange(1, len(distance) + 1), distance, linestyle="none", markersize=3.5, **style)
    sizes = record.recording.capture.sizes
    for border in np.cumsum(sizes)[:-1] if len(sizes) <= 40 else ():
        axes.axvline(border + 0.5, color="0.3", linewidth=0.8, linestyle="--", zorder=0)
    axes.set_yscale("log")
    x = "pose (dashed lines separate sockets)" if len(sizes) > 1 else "pose"
    label_axes(axes, x, "distance from the socket's centroid [mm]")
    _legend_above(axes, 2)
    return axes


def length_parameter_errors(record: CalibrationRecord, axes: Any = None) -> Any:
    """Plot the error of each length parameter against the true arm of a simulation, by stage, mm (logarithmic).

    Args:
        record: The calibration of a simulated arm.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If the calibration is not of a simulation.
    """
    if record.recording.true is None:
        raise InputError("the calibration is not of a simulation, so no true arm is known to draw errors against.")
    axes = axes_or_new(axes)
    vectors = record.vectors()
    chosen = [i for i, name in enumerate(record.names) if is_length(name)]
    for stage, style in _STAGES.items():
        error = np.abs(vectors[stage] - vectors["true"])[chosen]
        axes.plot(np.arange(len(chosen)), np.maximum(error, 1e-5), linestyle="none", markersize=5, **style)
    axes.set_yscale("log")
    label_parameters(axes, [record.names[i] for i in chosen])
    label_axes(axes, "", "error against the true arm [mm]")
    _legend_above(axes, 3)
    return axes


def parameter_changes(record: CalibrationRecord, kind: str = "length", axes: Any = None) -> Any:
    """Plot the change of each parameter from its nominal value, with its expanded uncertainty (95 %).

    Args:
        record: The calibration.
        kind: ``"length"`` for the length parameters, mm; ``"angle"`` for the angle parameters, arcsec.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If ``kind`` is neither.
    """
    if kind not in ("length", "angle"):
        raise InputError(f"kind is '{kind}'; it must be length or angle.")
    axes = axes_or_new(axes)
    uncertainty, vectors = uncertainty_of(record), record.vectors()
    chosen = [i for i, name in enumerate(record.names) if is_length(name) == (kind == "length")]
    scale = 1.0 if kind == "length" else 1 / ARCSEC
    change = scale * (vectors["calibrated"] - vectors["nominal"])[chosen]
    expanded = scale * uncertainty.factor() * np.asarray(uncertainty.u)[chosen]
    known = np.isfinite(expanded)
    axes.axhline(0, color="0.4", linewidth=0.8)
    style = {"fmt": "o", "color": DARK, "capsize": 3, "markersize": 4, "label": "with U (95 %)"}
    axes.errorbar(np.arange(len(chosen)), change, yerr=np.where(known, expanded, 0.0), **style)
    if not np.all(known):
        style = {"color": ACCENT, "markersize": 8, "label": "only determined with others"}
        axes.plot(np.flatnonzero(~known), change[~known], "x", **style)
    label_parameters(axes, [record.names[i] for i in chosen])
    label_axes(axes, "", f"calibrated - nominal [{'mm' if kind == 'length' else 'arcsec'}]")
    axes.legend(frameon=False)
    return axes


def reference_length_errors(record: CalibrationRecord, axes: Any = None) -> Any:
    """Plot the errors of the reference lengths before and after the scale fix, mm, with expanded uncertainty (95 %).

    Args:
        record: The calibration.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If the calibration has no reference lengths.
    """
    lengths = record.recording.capture.lengths
    if not lengths:
        raise InputError("the calibration has no reference lengths, so there are no errors of lengths to draw.")
    axes = axes_or_new(axes)
    stage1, calibrated = (record.evaluations()[stage] for stage in ("stage1", "calibrated"))
    x = np.arange(len(lengths))
    axes.plot(x - 0.1, np.asarray(stage1.error), linestyle="none", **_STAGES["stage1"])
    u = np.asarray(calibrated.u)
    bars = np.where(np.isfinite(u), uncertainty_of(record).factor() * u, 0.0)
    style = {"fmt": "s", "color": DARK, "capsize": 3, "markersize": 4, "label": "calibrated, with U (95 %)"}
    axes.errorbar(x + 0.1, np.asarray(calibrated.error), yerr=bars, **style)
    axes.axhline(0, color="0.4", linewidth=0.8)
    names = [f"{length.start} - {length.end}" for length in lengths]
    label_parameters(axes, names if len(names) <= 20 else [str(i + 1) for i in x])
    label_axes(axes, "", "measured - value [mm]")
    axes.legend(frameon=False)
    return axes


def _legend_above(axes: Any, columns: int) -> None:
    """A legend outside the axes, where it cannot cover data."""
    axes.legend(frameon=False, ncols=columns, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def save_calibration_figure(record: CalibrationRecord, path: Path) -> None:
    """Write the distances of the poses and, if the truth is known, the errors of the length parameters.

    Args:
        record: The calibration.
        path: The file to write, whole or not at all; its name ends in ``.png``, ``.svg`` or ``.pdf``.

    Raises:
        InputError: For another format, or if the file cannot be written.
    """
    from matplotlib.figure import Figure

    panels = 2 if record.recording.true is not None else 1
    figure = Figure(figsize=(5.5 * panels, 3.9), layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False)
    pose_distances(record, axes[0, 0])
    if panels == 2:
        length_parameter_errors(record, axes[0, 1])
    save_figure(figure, path)
