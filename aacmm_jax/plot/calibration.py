"""Figures of a calibration: distances of the poses, parameters and reference lengths, nominal and calibrated."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.errors import InputError
from ..core.units import DEG
from ..diagnostics.pose_residuals import ObservationResiduals, distances_of, observation_residuals, rms
from ..kinematics.arm import is_length, parameter_unit
from ..summaries.harmonics import listed_apart
from .style import (
    ACCENT,
    DARK,
    LIGHT,
    axes_or_new,
    label_axes,
    label_parameters,
    logarithmic,
    new_figure,
    save_figure,
)

_STAGES: Mapping[str, Mapping[str, Any]] = {
    "nominal": {"label": "nominal", "color": LIGHT, "marker": "o"},
    "stage1": {"label": "stage 1", "color": ACCENT, "marker": "^"},
    "calibrated": {"label": "calibrated", "color": DARK, "marker": "s"},
}


# Of the kinds of a calibration, in their order; distinct in grey.
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
_COLORS = (DARK, ACCENT, "0.45")
_UNITS = {"mm": "distance from the geometry [mm]", "standard deviations": "residual [standard deviations]",
          "deg": "angle between orientations [deg]"}  # fmt: skip
_LITTLE_WEIGHT = 0.5
_MOST_IN_A_ROW = 3  # panels of a figure
_MOST_NAMES = 30  # of lengths along an axis
_NAMED = 16  # most sockets or observations whose names fit an axis


def pose_distances(record: CalibrationRecord, axes: Any = None) -> Any:
    """Plot the distance of each pose's tip from its socket's centroid, or from the geometry of its observation, nominal
    and calibrated, mm (logarithmic).

    Args:
        record: The calibration.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Example:
        >>> axes = aj.plot.pose_distances(record)
        >>> print(axes.get_ylabel())
        distance from the socket's centroid [mm]
    """
    axes = axes_or_new(axes)
    capture, evaluations = record.recording.capture, record.evaluations()
    by_stage = {stage: distances_of(capture, evaluations[stage]) for stage in ("nominal", "calibrated")}
    if not record.sockets_alone:  # with the geometry of the calibration
        by_stage["calibrated"] = tuple(one.distance for one in observation_residuals(record))
    for stage, distances in by_stage.items():
        distance = np.concatenate(distances)
        style = {**_STAGES[stage]} | {"label": f"{_STAGES[stage]['label']} (RMS {rms(distance):.3g} mm)"}
        axes.plot(np.arange(1, len(distance) + 1), distance, linestyle="none", markersize=3.5, **style)
    logarithmic(axes)
    names = (*capture.names, *(observation.name for observation in capture.observations))
    of = "socket's centroid" if not capture.observations else "geometry"
    word = "observation" if capture.observations else "socket"
    x = _separate(axes, names, [len(distances) for distances in by_stage["nominal"]], word)
    label_axes(axes, x, f"distance from the {of} [mm]")
    _legend_above(axes, 2)
    return axes


def residuals_by_kind(record: CalibrationRecord, unit: str = "mm", axes: Any = None) -> Any:
    """Plot the residual of every pose of a calibration by kind of observation (logarithmic).

    Poses that a robust loss took half of their weight from or more have a ring.

    Args:
        record: The calibration.
        unit: ``"mm"``, ``"standard deviations"``, or ``"deg"`` for orientations.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If the calibration has no such residuals (orientations, for ``"deg"``).

    Example:
        >>> robust = aj.calibrate(arm, capture, bounds, robust="huber")
        >>> axes = aj.plot.residuals_by_kind(aj.calibration.record_of(robust, recording, robust="huber"))
        >>> print(axes.get_ylabel())
        distance from the geometry [mm]
    """
    if unit not in _UNITS:
        raise InputError(f"unit is '{unit}'; it must be mm, standard deviations or deg.")
    found = [one for one in observation_residuals(record) if unit != "deg" or one.angle is not None]
    if not found:
        raise InputError("the calibration has no orientations; draw its residuals in mm or in standard deviations.")
    axes = axes_or_new(axes)
    values = [_in_unit(one, unit) for one in found]
    starts = np.cumsum([0, *(len(one) for one in values)])
    owners = [one.observation.kind for one in found]
    for number, kind in enumerate(dict.fromkeys(owners)):
        mine = [i for i, owner in enumerate(owners) if owner == kind]
        x = np.concatenate([starts[i] + np.arange(1, len(values[i]) + 1) for i in mine])
        style = {"marker": _MARKERS[number % len(_MARKERS)], "color": _COLORS[number % len(_COLORS)]}
        y = np.concatenate([values[i] for i in mine])
        axes.plot(x, y, linestyle="none", markersize=3.5, label=kind, **style)
    light = np.flatnonzero(np.concatenate([one.weight for one in found]) <= _LITTLE_WEIGHT)
    if len(light):
        ring = {"marker": "o", "markersize": 9, "markerfacecolor": "none", "color": ACCENT}
        axes.plot(
            light + 1, np.concatenate(values)[light], linestyle="none", label="half of its weight or less", **ring
        )
    if unit == "standard deviations":
        axes.axhline(1, color="0.4", linewidth=0.8)
    logarithmic(axes)
    word = "observation" if record.recording.capture.observations else "socket"
    x = _separate(axes, [one.observation.name for one in found], [len(one) for one in values], word)
    label_axes(axes, x, _UNITS[unit])
    _legend_above(axes, 3)
    return axes


def _in_unit(one: ObservationResiduals, unit: str) -> np.ndarray:
    if unit == "deg":
        return np.asarray(one.angle) / DEG
    return one.distance if unit == "mm" else one.normalised


def _separate(axes: Any, names: Sequence[str], sizes: Sequence[int], word: str) -> str:
    """Separate groups of poses by dashed lines, name them where there is room, and return the axis' title."""
    if len(sizes) == 1:
        return "pose"
    ends = np.cumsum(sizes)
    for border in ends[:-1] if len(sizes) <= 40 else ():
        axes.axvline(border + 0.5, color="0.3", linewidth=0.8, linestyle="--", zorder=0)
    if len(sizes) <= _NAMED:
        axes.set_xticks(ends - (np.array(sizes) - 1) / 2, names, rotation=30, ha="right")
        return ""
    return f"pose (dashed lines separate {word}s)"


def length_parameter_errors(record: CalibrationRecord, axes: Any = None) -> Any:
    """Plot the error of each length parameter against the true arm of a simulation, by stage, mm (logarithmic).

    Args:
        record: The calibration of a simulated arm.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If the calibration is not of a simulation.

    Example:
        >>> simulated = recording._replace(true=nominal._replace(arm=true))
        >>> of_simulation = aj.calibration.record_of(result, simulated)
        >>> axes = aj.plot.length_parameter_errors(of_simulation)
        >>> print(axes.get_ylabel())
        error against the true arm [mm]
    """
    if record.recording.true is None:
        raise InputError("the calibration is not of a simulation, so no true arm is known to draw errors against.")
    axes = axes_or_new(axes)
    vectors = record.vectors()
    chosen = [i for i, name in enumerate(record.names) if is_length(name)]
    stages = _stages(record)
    for stage, style in stages.items():
        error = np.abs(vectors[stage] - vectors["true"])[chosen]
        axes.plot(np.arange(len(chosen)), np.maximum(error, 1e-5), linestyle="none", markersize=5, **style)
    logarithmic(axes)
    label_parameters(axes, [record.names[i] for i in chosen])
    label_axes(axes, "", "error against the true arm [mm]")
    _legend_above(axes, len(stages))
    return axes


def _stages(record: CalibrationRecord) -> Mapping[str, Mapping[str, Any]]:
    """The arms of a calibration; without that of stage 1 where there was one solve."""
    return {stage: style for stage, style in _STAGES.items() if stage != "stage1" or record.stage1_apart}


def parameter_changes(record: CalibrationRecord, kind: str = "length", axes: Any = None) -> Any:
    """Plot the change of each parameter from its nominal value, with its expanded uncertainty (95 %).

    Hundreds of coefficients of harmonics are left out: `joint_function` draws them as the function that they are.

    Args:
        record: The calibration.
        kind: ``"length"`` for the length parameters, mm; ``"angle"`` for the angle parameters, deg.
        axes: Axes to plot into; new ones if None.

    Returns:
        The axes.

    Raises:
        InputError: If ``kind`` is neither.

    Example:
        >>> axes = aj.plot.parameter_changes(record, "angle")
        >>> print(axes.get_ylabel())
        calibrated - nominal [deg]
    """
    if kind not in ("length", "angle"):
        raise InputError(f"kind is '{kind}'; it must be length or angle.")
    axes = axes_or_new(axes)
    uncertainty, vectors, wanted = uncertainty_of(record), record.vectors(), "mm" if kind == "length" else "rad"
    rows = [{"parameter": name, "unit": parameter_unit(record.recording.nominal.arm, name)} for name in record.names]
    listed = {row["parameter"] for row in listed_apart(rows)[0] if row["unit"] == wanted}
    chosen = [i for i, name in enumerate(record.names) if name in listed]
    scale = 1.0 if kind == "length" else 1 / DEG
    change = scale * (vectors["calibrated"] - vectors["nominal"])[chosen]
    expanded = scale * uncertainty.expanded()[chosen]
    known = np.isfinite(expanded)
    axes.axhline(0, color="0.4", linewidth=0.8)
    style = {"fmt": "o", "color": DARK, "capsize": 3, "markersize": 4, "label": "with U (95 %)"}
    axes.errorbar(np.flatnonzero(known), change[known], yerr=expanded[known], **style)
    if not np.all(known):
        # Such values are arbitrary: they do not stretch the axis of those that are known.
        low, high = axes.get_ylim()
        style = {"color": ACCENT, "markersize": 8, "label": "only determined with others"}
        shown = np.clip(change[~known], low, high) if np.any(known) else change[~known]
        axes.plot(np.flatnonzero(~known), shown, "x", clip_on=False, **style)
        if np.any(known):
            axes.set_ylim(low, high)
    label_parameters(axes, [record.names[i] for i in chosen])
    label_axes(axes, "", f"calibrated - nominal [{'mm' if kind == 'length' else 'deg'}]")
    _legend_above(axes, 2)
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

    Example:
        >>> axes = aj.plot.reference_length_errors(record)
        >>> print(axes.get_ylabel())
        measured - value [mm]
    """
    lengths = record.recording.capture.lengths
    if not lengths:
        raise InputError("the calibration has no reference lengths, so there are no errors of lengths to draw.")
    axes = axes_or_new(axes)
    stage1, calibrated = (record.evaluations()[stage] for stage in ("stage1", "calibrated"))
    x = np.arange(len(lengths))
    two = "stage1" in _stages(record)
    if two:
        axes.plot(x - 0.1, np.asarray(stage1.error), linestyle="none", **_STAGES["stage1"])
    u = np.asarray(calibrated.u)
    stated = np.array([float(length.u) for length in lengths])
    expanded = uncertainty_of(record).expanded_by_scatter(u, stated)
    bars = np.where(np.isfinite(u), expanded, 0.0)
    style = {"fmt": "s", "color": DARK, "capsize": 3, "markersize": 4, "label": "calibrated, with U (95 %)"}
    axes.errorbar(x + 0.1 * two, np.asarray(calibrated.error), yerr=bars, **style)
    axes.axhline(0, color="0.4", linewidth=0.8)
    label_parameters(axes, _names_of_lengths([(length.start, length.end) for length in lengths]))
    axes.set_xlim(-0.5, len(lengths) - 0.5)
    label_axes(axes, "", "measured - value [mm]")
    _legend_above(axes, 2)
    return axes


def _names_of_lengths(ends: Sequence[tuple[str, str]]) -> list[str]:
    """The placement of each length where that is one of its own ("front" of "front/0" and "front/1"), else both ends;
    where there are very many, some of them."""
    folders = [
        start.rpartition("/")[0] if start.rpartition("/")[0] == end.rpartition("/")[0] else "" for start, end in ends
    ]
    alone = [folder if folder and folders.count(folder) == 1 else "" for folder in folders]
    names = [name or f"{start} - {end}" for name, (start, end) in zip(alone, ends, strict=True)]
    every = -(-len(names) // _MOST_NAMES)
    return [name if i % every == 0 else "" for i, name in enumerate(names)]


def _legend_above(axes: Any, columns: int) -> None:
    """A legend outside the axes, where it cannot cover data."""
    axes.legend(frameon=False, ncols=columns, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def save_calibration_figure(record: CalibrationRecord, path: Path) -> None:
    """Write the distances of the poses; of observations also the residuals in standard deviations and those of
    orientations; and, if the truth is known, the errors of the length parameters.

    Args:
        record: The calibration.
        path: The file to write, whole or not at all; its name ends in ``.png``, ``.svg`` or ``.pdf``.

    Raises:
        InputError: For another format, or if the file cannot be written.

    Example:
        >>> from pathlib import Path
        >>> aj.plot.save_calibration_figure(record, Path("calibration.svg"))
    """
    found = observation_residuals(record)
    draw: list[Callable[..., Any]] = [pose_distances]
    if not record.sockets_alone:
        draw.append(lambda record, axes: residuals_by_kind(record, "standard deviations", axes))
    if any(one.angle is not None for one in found):
        draw.append(lambda record, axes: residuals_by_kind(record, "deg", axes))
    if record.recording.true is not None:
        draw.append(length_parameter_errors)
    columns = len(draw) if len(draw) <= _MOST_IN_A_ROW else 2
    rows = -(-len(draw) // columns)
    figure = new_figure((5.5 * columns, 3.9 * rows))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for function, axes in zip(draw, panels, strict=False):
        function(record, axes)
    for axes in panels[len(draw) :]:
        axes.remove()
    save_figure(figure, path)
