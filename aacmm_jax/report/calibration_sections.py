"""Sections of the report of a calibration, one for each subject after its stages and its scale."""

import math
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.record import CalibrationRecord
from ..core.units import DEG, people_read
from ..diagnostics.joint_travel import tried_poses
from ..diagnostics.pose_residuals import observation_residuals, signed_residuals
from ..kinematics.arm import joint_limits, parameter_unit
from ..model.sockets import pose_outliers
from ..plot.cameras import coverage_chart, distortion_chart, images_of, picture_charts, residual_chart
from ..plot.charts import Chart, Marks, Plot, linear, names, thinned
from ..plot.lengths import tried_chart, volume_chart
from ..plot.parameters import bounds_chart, change_chart, correlation_chart, functions_chart, singular_chart
from ..plot.residuals import Groups, distances_in, kinds_chart, pattern_charts
from ..summaries.camera_tables import camera_view, images_words
from ..summaries.cameras import image_rows
from ..summaries.result_tables import (
    geometry_table,
    harmonics_table,
    listed_apart,
    parameter_table,
    volume_table,
    weights_table,
    with_u_digits,
)
from ..summaries.tables import (
    Cell,
    by_columns,
    factor_words,
    listed,
    noise_sentence,
    number,
    numbers,
    tried_sentence,
)
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.coverage import LEVEL_IN_PERCENT
from ..uncertainty.identifiability import Observability
from ..uncertainty.volume import VolumetricUncertainty
from .elements import DRAWN, Block, Section, socket_table, view_of_arm
from .elements import residual_chart as pose_residuals

_INDICES = {
    "O1": "geometric mean of the singular values (Menq, Borm)",
    "O2": "smallest singular value divided by the largest (Driels, Pathre)",
    "O3": "smallest singular value (Nahvi)",
    "O4": "square of the smallest singular value divided by the largest (Nahvi, Hollerbach)",
    "O5": "harmonic sum of the singular values (Sun, Hollerbach)",
}
_TRAVELLED = 400  # most readings of a joint that are drawn
_FULL_TURN = 360.0


def parameters(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    """Every parameter with its expanded uncertainty; hundreds of coefficients joint by joint, and on demand."""
    others, harmonics = listed_apart(summary["parameters"])
    introduction = (
        f"U is the expanded uncertainty ({LEVEL_IN_PERCENT}), with the coverage factor that follows from the degrees "
        "of freedom of each parameter. No U is stated for a parameter that is on a bound, or that the data determine "
        "only together with other parameters."
    )
    by_unit = {unit: [row for row in others if row["unit"] == unit] for unit in ("mm", "rad")}
    functions = functions_chart(record)
    blocks: list[Block] = [
        introduction,
        *(change_chart(unit, rows) for unit, rows in by_unit.items() if rows),
        parameter_table("Parameters", others),
        *([] if functions is None else [functions]),
    ]
    if harmonics:
        blocks += [
            f"The {len(harmonics)} coefficients of harmonics are not printed. On screen, the table below lists the "
            "coefficients; aacmm export --format csv writes them to a file.",
            harmonics_table(harmonics),
            parameter_table("Coefficients of harmonics", harmonics)._replace(folded=True),
        ]
    return Section("parameters", "Parameters", blocks)


def residuals(record: CalibrationRecord, summary: dict[str, Any], evaluation: Evaluation) -> list[Section]:
    """Residuals of the calibrated arm, pose by pose; of observations in mm, in standard deviations, in deg and px,
    with the poses that a robust loss took weight from, and the geometry."""
    capture = record.recording.capture
    if record.sockets_alone:
        introduction = (
            "The distance of each pose's tip from the centroid of its socket, computed with the calibrated arm. Poses "
            "with more than eight times the median distance are marked: check how the tip was seated in these poses."
        )
        blocks = [introduction, socket_table(capture, evaluation), pose_residuals(capture, evaluation)]
        return [Section("residuals", "Residuals by socket and pose", blocks)]
    parts, groups = observation_residuals(record), Groups.of(capture)
    introduction = (
        "The distance of each pose's tip from the geometry of its observation, computed with the calibrated arm, in mm "
        "and in standard deviations. A standard deviation includes the uncertainty of the measured values and the "
        "arm's own scatter; the root mean square over the coordinates of a pose should be about 1. "
    )
    normalised = np.concatenate([part.normalised for part in parts])
    far = None  # those that lost weight
    if not summary["robust"]:
        introduction += "Poses with more than eight times the median distance, in standard deviations, are marked."
        far = "far from its geometry", pose_outliers(normalised, groups.sizes)[0]
    charts = (kinds_chart(record, unit, far, DRAWN) for unit in ("mm", "standard deviations", "deg", "px"))
    blocks = [introduction, *([weights_table(summary)] if summary["robust"] else []), *filter(None, charts)]
    introduction = (
        "The unknown geometry of the observations was determined together with the parameters. Positions and frames "
        "are given in the base frame, rotations as vectors along their axis. Offsets and orientations of targets are "
        "given in the last frame, placements on an indexed platform in the platform's frame."
    )
    factor = summary["uncertainty"]["coverage_factor_geometry_95"]
    return [
        Section("residuals", "Residuals by observation and pose", blocks),
        Section("geometry", "Geometry found", [introduction, geometry_table(summary["geometry"], factor)]),
    ]


def cameras(record: CalibrationRecord, summary: dict[str, Any]) -> list[Section]:
    """Mounts, places of targets and intrinsics; and for each camera where it saw corners, their residuals, and its
    distortion."""
    blocks: list[Block] = [*images_words(image_rows(record.recording)), *camera_view(summary)]
    for image in images_of(record):
        charts = coverage_chart(image), residual_chart(image, DRAWN), *picture_charts(image), distortion_chart(image)
        blocks += filter(None, charts)
    return [Section("cameras", "Cameras", blocks)] if blocks else []


def patterns(record: CalibrationRecord) -> list[Section]:
    """Residuals with their sign."""
    charts = pattern_charts(record)
    introduction = (
        "Residuals that scatter evenly about zero are noise; errors that the model does not describe show as a "
        "pattern. The band is the mean of neighbouring poses with twice its standard error. Where the band does not "
        "include zero, the residuals depend on the quantity along the horizontal axis."
    )
    return [Section("patterns", "Patterns in the residuals", [introduction, *charts])] if charts else []


def arm_in_poses(record: CalibrationRecord, evaluation: Evaluation) -> Section:
    """The calibrated arm in its poses."""
    arm, capture = record.calibrated.arm, record.recording.capture
    if record.sockets_alone:
        return Section("arm", "The arm in its poses", [view_of_arm(arm, capture, distances_in(capture, evaluation))])
    distances = np.concatenate([part.distance for part in observation_residuals(record)])
    signed, vectors = signed_residuals(record), np.full((len(distances), 3), np.nan)
    if signed is not None:
        vectors[signed.poses] = signed.vector
    view = view_of_arm(arm, capture, distances, record.observed.geometry, vectors)
    return Section("arm", "The arm in its poses", [view])


def volume(volume: VolumetricUncertainty, summary: dict[str, Any]) -> Section:
    """Expanded uncertainty of tips and lengths over the working volume."""
    statistics, taken = summary["uncertainty"]["volume"], summary["uncertainty"]["where_poses_were_taken"]
    near = [] if taken is None else [volume_table("Expanded uncertainty where poses were taken [mm]", taken)]
    ends = zip("xyz", volume.start.min(axis=0), volume.start.max(axis=0), strict=True)
    box = ", ".join(f"{axis} from {low:.0f} to {high:.0f}" for axis, low, high in ends).replace("-", "−")
    introduction = (
        f"Expanded uncertainty at the tip positions of {len(volume.start)} random poses within the joint limits "
        f"({box} mm), for a coverage of {LEVEL_IN_PERCENT} ({factor_words(statistics)})."
    )
    positions = {f"{axis} [mm]": numbers(volume.start[:, k], 0) for k, axis in enumerate("xyz")}
    for name, u in (
        ("U of the tip [mm]", volume.expanded_tip),
        (f"U of a {volume.length:.4g} mm length [mm]", volume.expanded_length),
        ("with noise of both readings [mm]", volume.expanded_length_reading),
    ):
        positions[name] = [with_u_digits(float(value)) for value in u]
    blocks = [
        *near,
        introduction,
        volume_table("Expanded uncertainty over all joint limits [mm]", statistics),
        volume_chart(volume)._replace(table=by_columns("All positions", positions)),
        noise_sentence(summary),
    ]
    return Section("volume", "Uncertainty over the working volume", blocks)


def coverage(record: CalibrationRecord, volume: VolumetricUncertainty) -> list[Section]:
    """How much of the working volume and of the travel of the joints the poses of the calibration cover."""
    readings, arm = np.asarray(record.recording.capture.readings), record.calibrated.arm
    if len(readings) < 2:
        return []
    poses = tried_poses(arm, readings, volume.q)
    summary = {"poses": len(poses.distance), "tried": int(poses.tried.sum()), "spacing_rad": poses.spacing}
    chart = tried_chart(volume, np.asarray(arm.position(readings)), poses)
    sentence = tried_sentence(summary)
    return [Section("tried", "Coverage of the working volume", [sentence, chart, _travel(record, readings)])]


def _travel(record: CalibrationRecord, readings: np.ndarray) -> Chart:
    arm = record.calibrated.arm
    slides = [joint + 1 in arm.prismatic for joint in range(arm.joints)]
    units = np.where(slides, 1.0, DEG)
    limits, shown = np.asarray(joint_limits(arm, None)) / units[:, None], readings[:, : arm.joints] / units
    x, used = np.arange(arm.joints), []
    for values, (low, high), slide in zip(shown.T, limits, slides, strict=True):
        # The part of the travel, in twentieths, that has readings; the full turn of a joint without limits.
        high = high if slide else min(high, low + _FULL_TURN)
        around = values if slide else (values - low) % _FULL_TURN + low
        used.append(np.mean(np.histogram(around, 20, (low, high))[0] > 0))
    columns = {
        "joint": (x + 1).tolist(),
        "unit": ["mm" if slide else "deg" for slide in slides],
        "lowest limit": numbers(limits[:, 0], 1),
        "highest limit": numbers(limits[:, 1], 1),
        "lowest reading": numbers(shown.min(axis=0), 1),
        "highest reading": numbers(shown.max(axis=0), 1),
        "travel covered [%]": numbers(100 * np.array(used), 0),
    }
    drawn = shown[thinned(len(shown), _TRAVELLED)]
    marks = (
        Marks("travel", x, limits.mean(axis=1), "bars", "soft", low=limits[:, 0], high=limits[:, 1], size=14),
        Marks("readings of the calibration", np.repeat(x, len(drawn)), drawn.T.ravel(), "square", size=3),
    )
    axis = linear("reading [deg]" + (" or [mm]" if any(slides) else ""), limits, shown)
    plot = Plot(names("", [f"joint {i + 1}" for i in x]), axis, marks, height=260)
    description = "The range of each joint within its limits, and the readings of the calibration poses."
    return Chart("travel", "Travel of the joints", description, (plot,), by_columns("Travel by joint", columns))


def monte_carlo(record: CalibrationRecord) -> list[Section]:
    """The Monte Carlo evaluation after JCGM 101, if it was run."""
    sampled = record.sampled
    if sampled is None:
        return []
    keys = {"value": "estimate", "u by Monte Carlo": "u", "u by propagation": "linear_u", "from": "low", "to": "high"}
    columns = {
        "quantity": map(str, sampled["quantity"]),
        **{name: numbers(sampled[key], 6) for name, key in keys.items()},
        "agree": ["yes" if agrees else Cell("no", None, "unsure") for agrees in sampled["agrees"]],
    }
    quantities = by_columns("Quantities, in mm and rad; coverage intervals", columns)
    return [Section("monte-carlo", "Monte Carlo (JCGM 101)", [record.sampled_says or "", quantities])]


def correlations(uncertainty: Uncertainty) -> Section:
    """Correlations of the parameters."""
    columns = {
        "parameter": lambda pair: pair[0],
        "with": lambda pair: pair[1],
        "correlation": lambda pair: number(pair[2], 3, signed=True),
    }
    pairs = listed("Pairs with a correlation of 0.5 or more", uncertainty.correlated(0.5), columns)
    return Section("correlations", "Correlations", [correlation_chart(uncertainty)._replace(table=pairs)])


def observability(observability: Observability) -> Section:
    """What the data determine, and how strongly."""
    count, rank = len(observability.names), observability.rank
    determined = f"These data determine all {count} parameters."
    if rank < count:
        determined = (
            f"These data determine {rank} independent combinations of the {count} parameters. Together with the "
            "priors, they determine all parameters."
        )
    rows = [
        ("rank", f"{rank} of {count}", "number of independent combinations of parameters that the data determine"),
        (
            "condition",
            f"{observability.condition:.3g}",
            "condition number for the determined combinations, with scaled columns",
        ),
        *((name, f"{x:.3g}", f"{_INDICES[name]}; larger is better") for name, x in observability.indices.items()),
    ]
    metrics = by_columns("Metrics", dict(zip(("", "value", "meaning"), zip(*rows, strict=True), strict=True)))
    values = observability.singular
    columns = {"number": range(1, 1 + len(values)), "value": numbers(values, 6)}
    chart = singular_chart(observability)._replace(table=by_columns("Singular values", columns))
    sentences = " ".join(observability.sentences() or [determined])
    return Section("observability", "Observability", [sentences, metrics, chart])


def bounds(record: CalibrationRecord, summary: dict[str, Any]) -> Section:
    """Which bounds are active, and the position of each parameter within its bounds."""
    vector, lower, upper = record.vectors()["calibrated"], np.asarray(record.lower), np.asarray(record.upper)
    active, stage1 = summary["active"], summary["active_stage1"]
    on_bound = sorted({*active, *stage1})
    others, harmonics = listed_apart(summary["parameters"])
    shown = [*(row["parameter"] for row in others), *(r["parameter"] for r in harmonics if r["parameter"] in on_bound)]
    index = [record.names.index(name) for name in shown]

    def in_unit(values: np.ndarray) -> Any:
        arm = record.recording.nominal.arm
        return lambda i: number(people_read(parameter_unit(arm, record.names[i]))[0] * float(values[i]))

    def state(i: int) -> Cell:
        name = record.names[i]
        side = active.get(name) or stage1.get(name)
        words = f"on the {side} bound" + ("" if name in active else " in stage 1") if side else ""
        return Cell(words, None, "unsure" if side else "")

    columns = {
        "parameter": lambda i: record.names[i],
        "unit": lambda i: people_read(parameter_unit(record.recording.nominal.arm, record.names[i]))[1],
        "lower": in_unit(lower),
        "calibrated": in_unit(vector),
        "upper": in_unit(upper),
        "": state,
    }
    introduction = f"On a bound: {', '.join(on_bound)}." if on_bound else "No bound is active."
    if record.final_method == "two-stage":
        introduction += " The bounds apply to stage 1 only; the scale is fixed after stage 1."
    width = upper - lower
    with np.errstate(invalid="ignore", divide="ignore"):
        within = np.where(np.isfinite(width) & (width > 0), 2 * (vector - lower) / width - 1, math.nan)[index]
    on = np.array([name in on_bound for name in shown])
    chart = bounds_chart(shown, within, on, len(record.names) - len(shown))
    return Section("bounds", "Bounds", [introduction, chart._replace(table=listed("Bounds", index, columns))])
