"""The elements of a report, independent of how they are shown; tables, charts and views of captures and evaluations."""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from ..acceptance.judgement import Rule
from ..calibration.evaluation import Evaluation
from ..calibration.record import CalibrationRecord
from ..core.numpy_or_jax import AnyArray
from ..core.text import f_text
from ..core.units import people_read
from ..data.capture import Capture
from ..data.observations.held import Artefact
from ..data.observations.observation import POINT, AbstractObservation, offset_of
from ..data.observations.pixels import Pixels
from ..data.observations.touched import ParallelPlanes, Plane, Sphere
from ..diagnostics.pose_residuals import distances_of, observation_residuals
from ..kinematics.arm import Arm
from ..kinematics.workspace import skeleton
from ..model.sockets import pose_outliers
from ..plot.cameras import shapes_of
from ..plot.charts import Chart, Marks, shades, thinned
from ..plot.residuals import Groups, distances_in, pose_chart
from ..summaries.observations import capture_observations
from ..summaries.result_tables import BY_CONSTRUCTION, with_u_digits
from ..summaries.tables import (
    OTHER_RMS,
    Cell,
    Table,
    by_columns,
    decimals_for,
    format_number,
    in_read_unit,
    listed,
    number,
    numbers,
    quantity_words,
)

DRAWN = 1000  # most poses in a chart
_VIEWED = 150  # most poses in the view of the arm
_MANY_BARS = 8  # in one picture
_MANY = "thick: the pose that the slider selects, and its bar; thin lines: the other positions of bars"
_HEADLINE = 90  # characters: a longer beginning of a verdict is no headline
_LEGEND = {
    "bar": "grey bars: certified lengths",
    "plate": "grey areas: plates and faces",
    "ball": "grey balls: what the tip was seated in or touched",
    "sight": "orange lines: fields of view of cameras, and outlines of targets",
}
_NO_GEOMETRY: Mapping[str, Any] = {}


class ArmView(NamedTuple):
    """An interactive view of the arm in its poses."""

    id: str
    title: str
    description: str
    data: dict[str, Any]
    residuals: Marks  # whose shades colour the poses
    legend: Sequence[str] = ()

    @property
    def enlarged(self) -> bool:
        """Whether residuals are drawn as vectors."""
        return any(pose.get("residual") for pose in self.data["poses"])


Block = str | Table | Chart | ArmView


class Section(NamedTuple):
    """A part of a report with a heading."""

    id: str
    title: str
    blocks: Sequence[Block]


class Report(NamedTuple):
    """A whole report, in reading order."""

    title: str
    subtitle: str
    verdict: str
    verdict_mark: str  # "good", "bad", "unsure", or "neutral" where nothing was decided
    warnings: list[str]
    numbers: Sequence[tuple[str, str, str]]  # at most three: title, value, and what else is known of it
    picture: Chart | ArmView | None  # beside verdict and numbers on the first screen
    facts: list[tuple[str, str]]
    sections: list[Section]
    simulated: bool = False
    one_page: bool = False  # printed smaller, to fit
    decision: str | None = None  # of its acceptance tests, all together
    rules: Sequence[Rule] = ()  # by which they were decided
    administrative: Sequence[tuple[str, list[tuple[str, str]]]] = ()  # groups of titles and values

    @property
    def headline(self) -> tuple[str, str]:
        """The verdict in a few words, and the rest of it."""
        for match in re.finditer("[:;.] ", self.verdict[:_HEADLINE]):
            start, rest = self.verdict[: match.start()], self.verdict[match.end() :]
            if start.count("(") == start.count(")"):
                word = rest.split()[0].strip(".,;").replace("-", "").isalpha()  # not a symbol such as "d_5"
                return start, rest[:1].upper() + rest[1:] if word else rest
        return self.verdict, ""


def view_of_arm(
    arm: Arm,
    capture: Capture,
    distances: Float[np.ndarray, " m"] | None = None,
    geometry: Mapping[str, Float[AnyArray, " _"]] = _NO_GEOMETRY,
    residuals: Float[np.ndarray, "m 3"] | None = None,
) -> ArmView:
    """The arm in the poses of a capture: marks at sockets and at the points of the geometry (centres, pivots), bars,
    plates, balls, cameras and targets, and up to 150 poses as lines from joint to joint, mm, each with its residual
    (NaN where there is none) and its direction.

    ``geometry`` has the parts of the unknown geometry, mm and rad, of a capture with observations besides sockets;
    ``distances`` are None of poses that are planned; ``residuals`` are by default those of the sockets.
    """
    groups, q = Groups.of(capture), np.asarray(capture.readings)
    owner, labels, chosen = groups.owner, groups.labels, thinned(len(q), _VIEWED)
    tips = np.asarray(arm.position(capture.q))
    marks = {name: tips[capture.owner == i].mean(axis=0) for i, name in enumerate(capture.names)}
    lines, moving = skeleton(arm, q[chosen]), dict[int, np.ndarray]()
    pairs = [(length.start, length.end) for length in capture.lengths]
    many = len(pairs) > _MANY_BARS  # of which the view shows one at a time: it knows their ends by name
    things = [_thing("bar", [marks[a], marks[b]], **({"ends": [a, b]} if many else {})) for a, b in pairs]
    if residuals is None and not capture.observations:
        residuals = tips - np.array([*marks.values()])[owner]
    for i, observation in enumerate(capture.observations, start=len(capture.names)):
        points = [part for part, units in observation.unknowns.items() if units == POINT]
        # A part with certified values has its numbers in a frame of its own.
        marks |= {part: geometry[part] for part in points if part not in observation.certified and part in geometry}
        own, held = owner == i, arm
        if observation.target and offset_of(observation.target) in geometry:
            held = arm.replace(probe=geometry[offset_of(observation.target)])
            lines[own[chosen]] = skeleton(held, q[chosen[own[chosen]]])
        things += _things_of(observation, np.asarray(held.position(q[own])), geometry)
        if isinstance(observation, Pixels) and observation.frame in geometry:
            shapes, shape = shapes_of(arm, observation, geometry)
            moving |= dict(enumerate(shapes, start=int(np.searchsorted(owner, i))))
            things.append(_thing("sight", shape))
            marks[observation.still] = geometry[observation.frame][3:]
    measured = np.full(len(q), np.nan) if distances is None else distances
    shade, limits = shades(measured[chosen])
    poses: list[dict[str, Any]] = []
    for i, line, shown in zip(chosen, lines, shade.tolist(), strict=True):
        pose = {"label": labels[i], "points": np.round(line, 1).tolist()}
        pose |= {"mark": capture.names[owner[i]]} if many and owner[i] < len(capture.names) else {}
        pose["carried"] = np.round(moving.get(int(i), ()), 1).tolist()
        if distances is not None:
            finite = bool(np.isfinite(distances[i]))
            pose |= {"distance": float(f"{distances[i]:.4g}") if finite else None, "shade": shown}
            if residuals is not None and finite and np.all(np.isfinite(residuals[i])):
                pose["residual"] = [float(f"{x:.3g}") for x in residuals[i]]
        poses.append(pose)
    data = {
        "marks": [{"name": name, "at": np.round(at, 1).tolist()} for name, at in marks.items()],
        "things": things,
        "from": "geometry" if capture.observations else "socket's centroid",
        "poses": poses,
    }
    drawn, sights = {thing["kind"] for thing in things}, any(len(pose["carried"]) for pose in poses)
    legend = [_MANY if many else "thick: the pose that the slider selects; grey lines: other poses"]
    legend += [words for kind, words in _LEGEND.items() if kind in drawn or (kind == "sight" and sights)]
    what = f"its {'points' if capture.observations else 'sockets'}, " if marks else ""
    says = "Drag, or use the arrow keys, to rotate the view; press plus or minus to zoom. The slider selects the pose."
    coloured = Marks("", (), (), limits=limits if distances is not None else (), unit="mm")
    arm_words = "The calibrated arm" if distances is not None else "The arm"
    return ArmView("scene", f"{arm_words}, {what}and its poses", says, data, coloured, legend)


def _thing(kind: str, points: Any, **more: Any) -> dict[str, Any]:
    return {"kind": kind, "points": np.round(np.asarray(points), 1).tolist(), **more}


def _things_of(
    observation: AbstractObservation, tips: Float[np.ndarray, "m 3"], geometry: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """What an observation touched, as far as the tips in it show: the bar or plate of an artefact, a ball, a face."""
    if isinstance(observation, Artefact):
        seats = [tips[observation.owner == point].mean(axis=0) for point in np.unique(observation.owner)]
        balls = [_thing("ball", [seat]) for seat in seats] if len(seats) > 1 else []
        named = {"name": observation.name}
        if len(seats) == 2:
            return [_thing("bar", seats, **named), *balls]
        return [*([_thing("plate", _outline(np.array(seats)), **named)] if len(seats) > 2 else []), *balls]
    if isinstance(observation, Sphere) and observation.geometry in geometry:
        centre = np.asarray(geometry[observation.geometry])[:3]
        return [_thing("ball", [centre], radius=float(np.median(np.linalg.norm(tips - centre, axis=1))))]
    if isinstance(observation, Plane) and len(tips) > 2:
        faces = [tips]
        if isinstance(observation, ParallelPlanes):
            faces = [tips[np.array(observation.side) == side] for side in dict.fromkeys(observation.side)]
        return [_thing("plate", _outline(face)) for face in faces if len(face) > 2]
    return []


def _outline(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "h 3"]:
    """The corners of the convex outline of points in the plane nearest to them, in their order around it."""
    apart = points - points.mean(axis=0)
    flat = apart @ np.linalg.svd(apart, full_matrices=False)[2][:2].T
    if len(points) < 4 or np.linalg.matrix_rank(flat, tol=1.0) < 2:  # mm: a row of points has none
        return points
    return points[ConvexHull(flat).vertices]


def socket_table(capture: Capture, evaluation: Evaluation) -> Table:
    """Repeatability and number of outliers, socket by socket."""
    scatter = evaluation.repeatability
    outliers, _ = pose_outliers(np.asarray(evaluation.distances), capture.sizes)
    far = np.bincount(capture.owner[outliers], minlength=len(capture.names)).tolist()
    scattered = np.asarray(capture.sizes) > 1
    metrics = {"DE": scatter.socket_de, "Deltam": scatter.socket_deltam, "RMS": scatter.socket_rms}
    columns = {
        "socket": capture.names,
        "poses": capture.sizes,
        **{name: numbers(np.where(scattered, values, np.nan)) for name, values in metrics.items()},
        "marked poses": [number(count, 0, mark="outlier" if count else "") for count in far],
    }
    return by_columns("Repeatability by socket [mm]", columns)


def residual_chart(capture: Capture, evaluation: Evaluation) -> Chart:
    """Distances of all poses by the calibrated arm; those far off are marked, and a table lists the largest."""
    groups, distances = Groups.of(capture), distances_in(capture, evaluation)
    far = pose_outliers(np.concatenate(distances_of(capture, evaluation)), groups.sizes)[0]
    says = "far from its socket" if groups.word == "socket" else "far from its geometry"
    title = "Residuals of the calibrated arm"
    return pose_chart("residuals", title, groups, {"calibrated": distances}, far=(says, far), most=DRAWN)


def length_table(
    caption: str,
    rows: Sequence[Mapping[str, Any]],
    before: Mapping[str, np.ndarray],
    fixed_scale: int | None = None,
) -> Table:
    """Lengths: value, errors by earlier arms, error of the calibrated arm, and its U.

    ``fixed_scale``: index of the length that fixed the scale, so that its error is zero by construction.
    """

    def error(i: int, value: float) -> Cell:
        return number(value, decimals_for(rows[i]["expanded_mm"]), signed=True)

    return listed(
        caption,
        range(len(rows)),
        {
            "between": lambda i: f"{rows[i]['from']} – {rows[i]['to']}",
            "value": lambda i: rows[i]["value_mm"],
            **{f"error, {arm}": lambda i, errors=errors: error(i, float(errors[i])) for arm, errors in before.items()},
            "error, calibrated": lambda i: BY_CONSTRUCTION if i == fixed_scale else error(i, rows[i]["error_mm"]),
            "U of error": lambda i: with_u_digits(rows[i]["expanded_mm"]),
        },
    )


def observation_tables(record: CalibrationRecord) -> list[Table]:
    """What was observed besides sockets and lengths, what is certified of it, and what else was stated."""
    capture = record.recording.capture
    if not capture.observations:
        return []
    u = {part.observation.name: part.u for part in observation_residuals(record)}
    rows: list[dict[str, Any]] = [
        row | {f"u_{unit}": value or None for unit, value in u[row["observation"]].items()}
        for row in capture_observations(capture)
    ]
    units = [unit for unit in ("mm", *OTHER_RMS) if any(row.get(f"u_{unit}") for row in rows)]
    certified = [{"observation": row["observation"]} | quantity for row in rows for quantity in row["certified"]]
    columns = {
        "observation": "observation",
        "kind": "kind",
        "tip": lambda row: row["target"] or "own probe",
        "poses": "poses",
        "unknown geometry": lambda row: ", ".join(row["unknowns"]),
        **{
            f"u of measured values [{people_read(unit)[1]}]": partial(in_read_unit, unit, f"u_{unit}") for unit in units
        },
        "stated": lambda row: "; ".join(f"{quantity['quantity']} {_words(quantity)}" for quantity in row["stated"]),
    }
    if not any(row["stated"] for row in rows):
        del columns["stated"]
    of_certified = {
        "observation": "observation",
        "quantity": "quantity",
        "certified value": _words,
        "u [mm]": lambda quantity: "taken as exact" if quantity["u"] == 0 else number(quantity["u"]),
    }
    tables = [listed("Observations", rows, columns)]
    return [*tables, *([listed("Certified values", certified, of_certified)] if certified else [])]


def removed_tables(record: CalibrationRecord) -> list[Table]:
    """What was left out because it contradicts the rest, why, and what that changed."""
    columns = {
        "group": lambda left_out: left_out.group,
        "kind": lambda left_out: left_out.kind,
        "its sockets and observations": lambda left_out: ", ".join(left_out.members),
        "F": lambda left_out: f_text(left_out.ratio).removeprefix("= "),
        "degrees of freedom": lambda left_out: "{} and {}".format(*left_out.degrees_of_freedom),
        "p": lambda left_out: left_out.probability if left_out.probability >= 1e-4 else "< 0.0001",
        "RMS of the other data, fitted with the group [mm]": lambda left_out: left_out.rms_with,
        "without the group [mm]": lambda left_out: left_out.rms_without,
        "parameter changed most": lambda left_out: f"{left_out.changed_most}, by {format_number(left_out.change, 1)} u",
    }
    caption = "Data left out, because they contradict the rest"
    return [listed(caption, record.removed, columns)] if record.removed else []


def _words(quantity: dict[str, Any]) -> str:
    return quantity_words(quantity, u=False).replace("-", "−")
