"""Parameters of a calibration: their changes with U, their errors in a simulation, their position within bounds."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.errors import InputError
from ..core.units import people_read
from ..kinematics.arm import is_length, parameter_unit
from ..summaries.result_tables import listed_apart
from ..summaries.tables import decimals_for, format_number
from .charts import Axis, Chart, Marks, Plot, level, linear, logarithmic, names
from .figures import draw

_LEAST = 1e-5  # mm: an error of zero on a logarithmic axis
_UNITS = {"length": "mm", "angle": "rad"}


def change_chart(unit: str, parameters: Sequence[Mapping[str, Any]]) -> Chart:
    """Calibrated minus nominal value of the parameters of a unit ("mm" or "rad") with U: rows with "parameter",
    "nominal", "calibrated" and "expanded", None of what the data determine only together with others."""
    scale, label = people_read(unit)
    labels = [row["parameter"] for row in parameters]
    x, change = np.arange(len(labels)), scale * np.array([row["calibrated"] - row["nominal"] for row in parameters])
    expanded = np.array([np.nan if row["expanded"] is None else scale * row["expanded"] for row in parameters])
    finite = np.isfinite(expanded)
    words = []
    for name, value, bar in zip(labels, change.tolist(), expanded.tolist(), strict=True):
        decimals = decimals_for(bar)
        u = f"U {format_number(bar, decimals)} {label}" if np.isfinite(bar) else "no uncertainty of its own"
        words.append(f"{name}: {format_number(value, decimals, signed=True)} {label}, {u}")
    words, low, high = np.array(words), (change - expanded)[finite], (change + expanded)[finite]
    marks = [Marks("with U (95 %)", x[finite], change[finite], "dot", "main", words[finite].tolist(), low, high)]
    # What has no uncertainty of its own has an arbitrary value: within the range of the others it has a cross.
    axis = linear(
        f"calibrated − nominal [{label}]", *((change[finite], low, high) if any(finite) else (change,)), [0.0]
    )
    if not np.all(finite):
        at = np.clip(change[~finite], axis.low, axis.high)
        name = "only determined with others, or on a bound"
        marks.append(Marks(name, x[~finite], at, "cross", "accent", words[~finite].tolist()))
    outside = int(np.sum((change < axis.low) | (change > axis.high)))
    plot = Plot(names("", labels), axis, (*marks, level(0.0)), height=260)
    description = "Calibrated minus nominal; bars are U, and smaller than the mark where none is visible."
    if outside:
        description += f" At the edge: {outside} without U, whose values (in the table) lie outside."
    kind = "length" if unit == "mm" else "angle"
    return Chart(f"change-{unit}", f"Change of {kind} parameters", description, (plot,))


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
        calibrated − nominal [deg]
    """
    if kind not in _UNITS:
        raise InputError(f"kind is '{kind}'; it must be length or angle.")
    vectors, expanded = record.vectors(), uncertainty_of(record).expanded()
    rows = [
        {
            "parameter": name,
            "unit": parameter_unit(record.recording.nominal.arm, name),
            "nominal": vectors["nominal"][i],
            "calibrated": vectors["calibrated"][i],
            "expanded": float(expanded[i]) if np.isfinite(expanded[i]) else None,
        }
        for i, name in enumerate(record.names)
    ]
    chosen = [row for row in listed_apart(rows)[0] if row["unit"] == _UNITS[kind]]
    return draw(change_chart(_UNITS[kind], chosen).plots[0], axes)


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
    return draw(error_plot(record), axes)


def error_plot(record: CalibrationRecord) -> Plot:
    """Errors of the length parameters of a simulated arm, by stage."""
    if record.recording.true is None:
        raise InputError("the calibration is not of a simulation, so no true arm is known to draw errors against.")
    vectors, chosen = record.vectors(), [i for i, name in enumerate(record.names) if is_length(name)]
    stages = {"nominal": ("nominal", "dot", "soft"), "stage 1": ("stage1", "triangle", "accent"),
              "calibrated": ("calibrated", "square", "main")}  # fmt: skip
    marks = tuple(
        Marks(name, np.arange(len(chosen)), np.maximum(np.abs(vectors[stage] - vectors["true"])[chosen], _LEAST),
              symbol, tone)
        for name, (stage, symbol, tone) in stages.items()
        if stage != "stage1" or record.stage1_apart
    )  # fmt: skip
    y = logarithmic("error against the true arm [mm]", *(mark.y for mark in marks))
    return Plot(names("", [record.names[i] for i in chosen]), y, marks)


def bounds_chart(labels: Sequence[str], positions: np.ndarray, on_bound: np.ndarray, left_out: int) -> Chart:
    """Positions of parameters within their bounds, -1 at the lower and 1 at the upper one, and which are on one."""
    x = np.arange(len(labels))
    words = np.array([f"{name}: {position:+.2f}" for name, position in zip(labels, positions, strict=True)])
    inside = ~on_bound
    marks = [Marks("within", x[inside], positions[inside], words=words[inside].tolist())]
    if np.any(on_bound):
        # Stage 1 may have been on a bound that the calibrated value has left.
        edge = np.clip(positions[on_bound], -1, 1)
        marks.append(Marks("on a bound", x[on_bound], edge, "diamond", "accent", words[on_bound].tolist()))
    y = Axis("position within bounds", -1.15, 1.15, ((-1.0, "lower"), (0.0, "middle"), (1.0, "upper")), named=True)
    plot = Plot(names("", labels), y, (*marks, level(-1.0, 1.0)), height=220)
    description = "Diamonds are on a bound." if np.any(on_bound) else "None is on a bound."
    if left_out:
        description += f" Not drawn: {left_out} coefficients of harmonics within theirs."
    return Chart("bounds", "Position of every parameter within its bounds", description, (plot,))
