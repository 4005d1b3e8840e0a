"""Parameters of a calibration: changes with U, errors in a simulation, bounds, correlations, functions of joints."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord, function_of_joint, uncertainty_of
from ..core.errors import InputError
from ..core.text import pluralise
from ..core.units import DEG, people_read
from ..diagnostics.pose_residuals import observation_residuals
from ..kinematics.arm import is_length, parameter_unit
from ..kinematics.correction_kinds import Term
from ..pipeline.model_ladder import ComparedModels
from ..summaries.compared_models import compared_models_summary
from ..summaries.result_tables import listed_apart
from ..summaries.tables import decimals_for, format_number, rows_of
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.coverage import U_AT_LEVEL
from ..uncertainty.identifiability import Observability
from .charts import SHADES, Axis, Chart, Marks, Plot, borders, level, linear, logarithmic, names
from .figures import TONES, draw

_LEAST = 1e-5  # mm: an error of zero on a logarithmic axis
_LEAST_SINGULAR = 1e-12  # of the largest singular value: a zero on a logarithmic axis
_UNITS = {"length": "mm", "angle": "rad"}
_SAID, _SIGNED = 0.3, 0.5  # correlations from which they are said under the pointer, and their sign is written
_IN_A_BIN, _MOST_BINS = 8, 80  # poses, and bins of a joint's travel
_WIDTH = 0.38  # of a bar


def change_chart(unit: str, parameters: Sequence[Mapping[str, Any]]) -> Chart:
    """Calibrated minus nominal value of the parameters of a unit ("mm" or "rad") with U: rows with "parameter",
    "nominal", "calibrated" and "expanded", None of what the data determine only together with others."""
    scale, label = people_read(unit)
    x, change = np.arange(len(parameters)), scale * np.array([row["calibrated"] - row["nominal"] for row in parameters])
    expanded = np.array([np.nan if row["expanded"] is None else scale * row["expanded"] for row in parameters])
    finite, words = np.isfinite(expanded), []
    for row, value, bar in zip(parameters, change.tolist(), expanded.tolist(), strict=True):
        decimals = decimals_for(bar)
        u = f"U {format_number(bar, decimals)} {label}" if np.isfinite(bar) else "no uncertainty of its own"
        words.append(f"{row['parameter']}: {format_number(value, decimals, signed=True)} {label}, {u}")
    words, low, high = np.array(words), (change - expanded)[finite], (change + expanded)[finite]
    marks = [Marks(f"with {U_AT_LEVEL}", x[finite], change[finite], "dot", "main", words[finite].tolist(), low, high)]
    # What has no uncertainty of its own has an arbitrary value: within the range of the others it has a cross.
    ends = (change[finite], low, high) if any(finite) else (change,)
    axis = linear(f"calibrated − nominal [{label}]", *ends, [0.0])
    if not np.all(finite):
        at = np.clip(change[~finite], axis.low, axis.high)
        name = "on a bound, or determined only together with other parameters"
        marks.append(Marks(name, x[~finite], at, "cross", "accent", words[~finite].tolist()))
    plot = Plot(names("", [row["parameter"] for row in parameters]), axis, (*marks, level(0.0)), height=260)
    description = "Calibrated minus nominal value. Bars show U; where no bar is visible, U is smaller than the mark."
    if outside := int(np.sum((change < axis.low) | (change > axis.high))):
        description += (
            f" Drawn at the edge of the chart, because outside its range: {pluralise(outside, 'value')} without U; "
            "see the table."
        )
    kind = "length" if unit == "mm" else "angle"
    return Chart(f"change-{unit}", f"Change of {kind} parameters", description, (plot,))


def parameter_changes(record: CalibrationRecord, kind: str = "length", axes: Any = None) -> Any:
    """Plot the change of each parameter from its nominal value, with its expanded uncertainty U.

    Hundreds of coefficients of harmonics are left out: `joint_function` draws them as the function that they are.

    Args:
        record: The calibration.
        kind: ``"length"`` for the length parameters, mm; ``"angle"`` for the angle parameters, deg.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> aj.plot.parameter_changes(record, "angle").figure.savefig("figure.svg")
    """
    if kind not in _UNITS:
        raise InputError(f"kind is '{kind}'; it must be length or angle.")
    vectors, arm = record.vectors(), record.recording.nominal.arm
    rows = rows_of(
        parameter=record.names,
        unit=[parameter_unit(arm, name) for name in record.names],
        nominal=vectors["nominal"],
        calibrated=vectors["calibrated"],
        expanded=uncertainty_of(record).expanded(),
    )
    chosen = [row for row in listed_apart(rows)[0] if row["unit"] == _UNITS[kind]]
    return draw(change_chart(_UNITS[kind], chosen).plots[0], axes)


def length_parameter_errors(record: CalibrationRecord, axes: Any = None) -> Any:
    """Plot the error of each length parameter against the true arm of a simulation, by stage, mm (logarithmic).

    Args:
        record: The calibration of a simulated arm.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> simulated = recording._replace(true=nominal._replace(arm=true))
        >>> aj.plot.length_parameter_errors(aj.calibration.record_of(result, simulated)).figure.savefig("figure.svg")
    """
    return draw(error_plot(record), axes)


def error_plot(record: CalibrationRecord) -> Plot:
    """Errors of the length parameters of a simulated arm, by stage."""
    if record.recording.true is None:
        raise InputError(
            "the calibration is not of a simulated arm, so the true parameters and their errors are not known."
        )
    vectors, chosen = record.vectors(), [i for i, name in enumerate(record.names) if is_length(name)]
    stages = {"nominal": ("nominal", "dot", "soft"), "stage 1": ("stage1", "triangle", "accent"),
              "calibrated": ("calibrated", "square", "main")}  # fmt: skip
    marks = tuple(
        Marks(name, np.arange(len(chosen)), np.maximum(np.abs(vectors[stage] - vectors["true"])[chosen], _LEAST),
              symbol, tone)
        for name, (stage, symbol, tone) in stages.items()
        if stage != "stage1" or record.stage1_apart
    )  # fmt: skip
    y = logarithmic("difference from the true arm [mm]", *(mark.y for mark in marks))
    return Plot(names("", [record.names[i] for i in chosen]), y, marks)


def bounds_chart(labels: Sequence[str], positions: np.ndarray, on_bound: np.ndarray, left_out: int) -> Chart:
    """Positions of parameters within their bounds, -1 at the lower and 1 at the upper one, and which are on one."""
    x, inside = np.arange(len(labels)), ~on_bound
    words = np.array([f"{name}: {position:+.2f}" for name, position in zip(labels, positions, strict=True)])
    marks = [Marks("within", x[inside], positions[inside], words=words[inside].tolist())]
    if np.any(on_bound):
        # Stage 1 may have been on a bound that the calibrated value has left.
        edge = np.clip(positions[on_bound], -1, 1)
        marks.append(Marks("on a bound", x[on_bound], edge, "diamond", "accent", words[on_bound].tolist()))
    y = Axis("position within bounds", -1.15, 1.15, ((-1.0, "lower"), (0.0, "middle"), (1.0, "upper")), named=True)
    plot = Plot(names("", labels), y, (*marks, level(-1.0, 1.0)), height=220)
    description = "Diamonds: on a bound." if np.any(on_bound) else "No parameter is on a bound."
    description += f" Not drawn: {left_out} coefficients of harmonics within their bounds." if left_out else ""
    return Chart("bounds", "Position of every parameter within its bounds", description, (plot,))


def correlation_plot(labels: list[str], table: np.ndarray, title: str = "") -> Plot:
    """Correlations by their size, with the sign written where it is at least 0.5."""
    strength, count = np.abs(np.asarray(table, dtype=float)), len(labels)
    rows, columns = np.nonzero(strength > 0.05)
    pairs = list(zip(rows.tolist(), columns.tolist(), strict=True))
    words = [
        f"{labels[i]} with {labels[j]}: {table[i, j]:+.3f}".replace("-", "−")
        if strength[i, j] >= _SAID and i != j
        else ""
        for i, j in pairs
    ]
    shade = np.minimum((strength[rows, columns] * SHADES).astype(int), SHADES - 1)
    limits = tuple(i / SHADES for i in range(SHADES + 1))
    boxes = Marks("|r|", columns, rows, "boxes", words=words, shade=shade, limits=limits, box=(1.0, 1.0))
    y, x = np.array([(i, j) for i, j in pairs if strength[i, j] >= _SIGNED and i != j], dtype=int).reshape(-1, 2).T
    signed = ["+" if positive else "−" for positive in table[y, x] > 0]
    signs = Marks("", x, y, "text", "page", signed, size=10 if count <= 25 else 6)
    axis = names("", labels)._replace(low=-0.5, high=count - 0.5)
    downwards = Axis("", count - 0.5, -0.5, axis.ticks, named=True)
    return Plot(axis, downwards, (boxes, signs), title=title, height=560, square=True)


def correlation_chart(uncertainty: Uncertainty) -> Chart:
    """Correlations of the parameters; of very many, of those that are correlated most."""
    labels, chosen = list(uncertainty.names), uncertainty.most_correlated()
    most = f"{len(chosen)} of {len(labels)} parameters, those with the strongest correlations"
    part = np.asarray(uncertainty.correlation)[np.ix_(chosen, chosen)]
    plot = correlation_plot([labels[i] for i in chosen], part, most if len(chosen) < len(labels) else "")
    return Chart(
        "correlations",
        "Correlation of the parameters",
        "The colour shows the size of the correlation; the sign is printed where the size is 0.5 or more. The data "
        "determine combinations of strongly correlated parameters better than each of these parameters.",
        (plot,),
    )


def correlation_matrix(uncertainty: Uncertainty, axes: Any = None) -> Any:
    """Plot the correlations of the parameters: darker is stronger, with the sign written where it is at least 0.5.

    Of more than 45 parameters, those that are correlated most are drawn.

    Args:
        uncertainty: Uncertainty of a calibrated arm (`uncertainty_of`).
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> axes = aj.plot.correlation_matrix(aj.uncertainty_of(result))
        >>> print(len(axes.get_xticklabels()), "parameters")
        21 parameters
    """
    return draw(correlation_chart(uncertainty).plots[0], axes, (7.4, 7.6))


def singular_chart(observed: Observability) -> Chart:
    """Singular values of the identification Jacobian; zero ones are crosses at the least that the axis shows."""
    values, rank = np.maximum(observed.singular, _LEAST_SINGULAR * observed.singular.max()), observed.rank
    order = np.arange(1, len(values) + 1)
    words = [f"{i}: {value:.3g}" for i, value in zip(order, observed.singular.tolist(), strict=True)]
    marks = [Marks("determined", order[:rank], values[:rank], words=words[:rank])]
    if rank < len(values):
        marks.append(Marks("not determined", order[rank:], values[rank:], "cross", "accent", words[rank:]))
    plot = Plot(linear("number", order), logarithmic("singular value", values), tuple(marks), height=240)
    what = "Sensitivity of the data to each independent combination of parameters, for changes of 1 mm and 1 mrad."
    return Chart("singular", "Singular values", what, (plot,))


def singular_values(observed: Observability, axes: Any = None) -> Any:
    """Plot the singular values of the identification Jacobian, in steps of 1 mm and 1 mrad; zero ones are crosses.

    Args:
        observed: The result of `observability`.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> axes = aj.plot.singular_values(aj.observability(arm, capture, space))
    """
    return draw(singular_chart(observed).plots[0], axes)


def models_chart(summary: Mapping[str, Any]) -> Chart:
    """RMS errors of models inside and outside what they were fitted to, with the standard error outside; mm."""
    keys = ("rms_inside", "rms_outside", "u_outside")
    inside, outside, u = (np.array([row[key] for row in summary["models"]], dtype=float) for key in keys)
    labels = [row["model"] for row in summary["models"]]
    words = [
        f"{label}: inside {format_number(a)} mm, outside {format_number(b)} ± {format_number(c)} mm"
        for label, a, b, c in zip(labels, inside.tolist(), outside.tolist(), u.tolist(), strict=True)
    ]
    left, box = np.arange(len(labels)) - _WIDTH / 2, (_WIDTH, 0.0)
    low, high, right = outside - u, outside + u, left + _WIDTH
    marks = (
        Marks("poses that were fitted", left, inside, "boxes", "soft", words, box=box),
        Marks("held-out regions, ± one standard error", right, outside, "boxes", "main", words, low, high, box=box),
    )
    named = [f"✓ {label}" if label == summary["recommended"] else label for label in labels]
    y = linear("RMS distance from the geometry [mm]", inside, outside, high, [0.0], zero=True)
    description = (
        "RMS distance of poses from their geometry; models from the simplest to the most complex; ✓: recommended."
    )
    return Chart("models", "Errors by model", description, (Plot(names("", named), y, marks, height=260),))


def model_comparison(compared: ComparedModels, axes: Any = None) -> Any:
    """Plot the errors of compared models inside and outside what they were fitted to, mm.

    Bars with the standard error of `ComparedModel.u_outside`; the recommended model is marked.

    Args:
        compared: What `compare_models` returned.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> compared = aj.compare_models(arm, two_bars, bounds, models=["dh", "harmonics=1"])
        >>> print(len(aj.plot.model_comparison(compared).patches), "bars")
        4 bars
    """
    return draw(models_chart(compared_models_summary(compared, "")).plots[0], axes)


def functions_chart(record: CalibrationRecord) -> Chart | None:
    """What each joint does besides its reading; None for an arm whose joints do what they read."""
    arm = record.calibrated.arm
    plots = [plot for joint in range(1, arm.joints + 1) if (plot := _joint_plot(record, joint, True))]
    if not plots or arm.corrections is None:
        return None
    kinds = [term.kind for term in arm.corrections.functions.terms if isinstance(term, Term)]
    words = [dict.fromkeys(kind.description for kind in kinds if kind.of_own_reading is by) for by in (True, False)]
    drawn, others = map(", ".join, words)
    description = (
        f"Curve: the corrections of each joint that depend only on the reading of this joint ({drawn}), minus their "
        "mean"
        + (f"; not included: {others}" if others else "")
        + ". Marks: the curve plus the additional correction that the residuals of neighbouring poses suggest, with "
        "twice the standard error of this correction. Dashed lines: ends of the measured travel."
    )
    return Chart("functions", "Non-geometric errors of the joints", description, tuple(plots))


def joint_function(
    record: CalibrationRecord, joint: int, axes: Any = None, *, label: str | None = None, color: str = TONES["main"]
) -> Any:
    """Plot what a joint does besides its reading, against its reading; mrad, or mm of a prismatic joint.

    Marks are means over neighbouring poses, with twice their standard error: the change of this joint that alone would
    explain most of their residuals, added to the calibrated function. That function is the curve, with its expanded
    uncertainty U: harmonics and gear ratio of the arm, less their mean over the poses, which a zero offset takes
    up. It goes a little beyond the travel of the poses (between the dashed lines), within the limits of the joint.
    Marks off the curve, or a pattern of marks without a curve, are errors that the model lacks.

    Args:
        record: A calibration from observations or with a prior, the residuals of which are known pose by pose.
        joint: Number of the joint, from 1.
        axes: Axes to plot into, which are returned; new ones if None. Several records may share axes.
        label: For the legend; by default none.
        color: Of marks and curve.

    Example:
        >>> robust = aj.calibrate(arm, two_bars, bounds, robust="huber")
        >>> by_pose = aj.calibration.record_of(robust, aj.Recording(two_bars, nominal), robust="huber")
        >>> axes = aj.plot.joint_function(by_pose, 2)
    """
    joints = record.calibrated.arm.joints
    if not 1 <= joint <= joints:
        raise InputError(f"joint is {joint}; the arm has joints 1 to {joints}.")
    plot = _joint_plot(record, joint)
    assert plot is not None
    marks = [part._replace(tone=color) if part.tone == "main" else part for part in plot.marks]
    marks = [part._replace(name=label or "") if part.symbol == "dot" else part for part in marks]
    return draw(plot._replace(marks=tuple(marks)), axes, legend=False)


def _joint_plot(record: CalibrationRecord, joint: int, only_corrected: bool = False) -> Plot | None:
    """The function of one joint, and what residuals ask of it; ``only_corrected``: None where it has no function."""
    residuals = observation_residuals(record)
    q = np.concatenate([np.asarray(part.observation.q) for part in residuals])
    curve = function_of_joint(record, joint, q)
    if curve is None and only_corrected:
        return None
    asked = np.concatenate([part.by_joint[joint - 1] for part in residuals])
    lever = np.concatenate([part.lever[joint - 1] for part in residuals])
    slides, travel = joint in record.calibrated.arm.prismatic, q[:, joint - 1]
    unit, reading = (1.0, 1.0) if slides else (1e-3, DEG)
    marks: list[Marks] = []
    if curve is not None:
        x, value, expanded = curve.reading / reading, curve.value / unit, curve.expanded / unit
        marks = [Marks("", x, value, "band", low=value - expanded, high=value + expanded), Marks("", x, value, "line"),
                 borders([travel.min() / reading, travel.max() / reading])]  # fmt: skip
        asked = asked + curve.at_poses
    rows = []
    for members in np.array_split(np.argsort(travel), np.clip(len(travel) // _IN_A_BIN, 1, _MOST_BINS)):
        # Weighted by how far the joint moves the tip; standard errors by the scatter.
        weight = lever[members] ** 2 / max(np.sum(lever[members] ** 2), 1e-300)
        value = weight @ asked[members]
        rows.append((travel[members].mean(), value, np.sqrt(np.sum((weight * (asked[members] - value)) ** 2))))
    means, values, u = np.array(rows).T
    y, u, tone = values / unit, u / unit, "main" if curve is None else "accent"
    marks.append(Marks("", means / reading, y, "dot", tone, low=y - 2 * u, high=y + 2 * u, size=4))
    ends = [end for mark in marks for end in (mark.low, mark.high) if end is not None]
    axes = (
        linear(f"reading of joint {joint} [{'mm' if slides else 'deg'}]", *(mark.x for mark in marks), margin=0.02),
        linear(f"joint {joint} [{'mm' if slides else 'mrad'}]", *ends, [0.0]),
    )
    return Plot(*axes, (*marks, level(0.0)), height=150)
