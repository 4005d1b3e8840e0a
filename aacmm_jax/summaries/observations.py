"""Observations as plain dictionaries with the unit in every key: what they are, how they agree, the geometry found."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from ..calibration.evaluation import Evaluation
from ..calibration.pose_table import HELD_OUT, USED, PoseResiduals
from ..calibration.record import REPEATABILITY, CalibrationRecord
from ..calibration.results import ObservedMetrics
from ..core.rotations import inverse_frame, rotation_vector
from ..core.text import csv_text
from ..data.capture import Capture
from ..data.observations.observation import (
    POINT,
    AbstractObservation,
    Quantity,
    certified_quantities,
    offset_of,
    quantities_by_unit,
    stated_quantities,
)
from ..diagnostics.contradictions import session_metrics
from ..diagnostics.pose_residuals import ObservationResiduals, distances_of, observation_residuals, rms
from ..kinematics.arm import without_corrections
from ..kinematics.robots import base_derivatives, chains_of
from ..model.observed import Observed
from ..pipeline.hold_out import residuals_of
from .tables import OTHER_RMS, attributes, observed_words, plain, rows_of

_LITTLE_WEIGHT = 0.5


def capture_observations(capture: Capture) -> list[dict[str, Any]]:
    """What a capture holds besides sockets and lengths: unknowns of each observation, and what is certified of it."""
    return [
        attributes(observation, "kind", "target", "fixes_scale", observation="name")
        | {
            "poses": len(observation.q),
            "unknowns": list(_parts(observation)),
            "certified": list(map(_row, certified_quantities(observation))),
            "stated": list(map(_row, stated_quantities(observation))),
        }
        for observation in capture.observations
    ]


def _parts(observation: AbstractObservation) -> dict[str, tuple[str, ...]]:
    """The unknown geometry of an observation, with the place of its target in the last frame."""
    target = {offset_of(observation.target): POINT} if observation.target else {}
    return {**observation.unknowns, **target}


def _row(quantity: Quantity) -> dict[str, Any]:
    values = np.asarray(quantity.values, dtype=float).tolist()
    return {"quantity": quantity.says, "values": values, "unit": quantity.unit, "u": quantity.u}


def capture_words(capture: Capture) -> str:
    """How many sockets, other observations and reference lengths a capture has; sockets of a session with a probe of
    its own are sockets like any other."""
    others = sum(observation.kind != "socket" for observation in capture.observations)
    sockets = len(capture.names) + len(capture.observations) - others
    return observed_words(sockets, others, len(capture.lengths))


def scale_sources(record: CalibrationRecord) -> list[str]:
    """What the scale of the calibrated arm comes from: reference lengths and observations, by their names; none where
    it is that of the nominal arm."""
    capture = record.recording.capture
    slides = [name.removeprefix("q_") for name in record.scale_set_by if name.startswith("q_")]
    by_slides = [f"the readings of joint {', '.join(slides)}"] if slides else []
    # Where something else sets the scale in two stages, lengths change nothing.
    if record.method == REPEATABILITY or (record.scale_set_by and record.method == "two-stage"):
        return by_slides
    lengths = ["the reference lengths"] if capture.lengths else []
    named = [f"{observation.name} ({observation.kind})" for observation in capture.observations
             if observation.fixes_scale]  # fmt: skip
    return lengths + by_slides + named


def observed_summary(record: CalibrationRecord, nominal: Evaluation) -> dict[str, Any]:
    """How each observation and each kind agree, the geometry found, poses that lost weight, and poses not calibrated
    with; ``nominal`` is the evaluation of the nominal arm, with the geometry that fits it best."""
    summary: dict[str, Any] = {
        "robust": record.robust,
        "scale_from": scale_sources(record),
        "observations": [],
        "kinds": [],
        "geometry": [],
        "less_weight": [],
        "sessions": [
            {"session": session, "poses": poses, "rms_mm": together, "rms_alone_mm": alone}
            for session, (poses, together, alone) in session_metrics(record).items()
        ],
        "removed": [plain(group._asdict()) for group in record.removed],
        "robot_bases": robot_base_rows(record),
    }
    if not record.sockets_alone:
        residuals = observation_residuals(record)
        pairs = list(zip(residuals, distances_of(record.recording.capture, nominal), strict=True))
        for pair in pairs:
            observation = pair[0].observation
            row = {"observation": observation.name, "kind": observation.kind, "target": observation.target}
            summary["observations"].append(row | _agreement([pair]))
        for kind in dict.fromkeys(part.observation.kind for part in residuals):
            of_kind = [pair for pair in pairs if pair[0].observation.kind == kind]
            summary["kinds"].append({"kind": kind, "observations": len(of_kind)} | _agreement(of_kind))
        summary["geometry"] = _geometry(record.recording.capture, record.observed)
        summary["base"] = _base_rows(record)
        summary["less_weight"] = less_weight(residuals)
    if record.held_out is not None:
        summary["held_out_poses"] = _held_out_summary(record, nominal)
    return summary


def _held_out_summary(record: CalibrationRecord, nominal: Evaluation) -> dict[str, Any]:
    """Distances of held-out poses from their geometry, all together and by observation, and those of the used poses;
    where the arm was calibrated, by the nominal arm too."""
    rows, by_nominal = residuals_of(record), record.held_out_nominal
    used, held_out = rows.used_as(USED), rows.used_as(HELD_OUT)
    of_used = None if by_nominal is None else np.concatenate(distances_of(record.recording.capture, nominal))
    names = np.array(held_out.observation, dtype=object)
    by_name = {name: names == name for name in dict.fromkeys(names)}
    return {
        "held_out": distances_row(held_out, by_nominal),
        "used": distances_row(used, of_used),
        "observations": [
            {"observation": name}
            | distances_row(held_out.select(mask), None if by_nominal is None else by_nominal[mask])
            for name, mask in by_name.items()
        ],
    }


def distances_row(rows: PoseResiduals, nominal: Float[np.ndarray, " m"] | None = None) -> dict[str, Any]:
    """RMS, mean and largest distance of poses from their geometry, the RMS that is predicted, and that of the distances
    by the nominal arm, mm; and the RMS of residuals that are no lengths."""
    known = np.isfinite(rows.distance)  # not of the only pose of a socket
    distance = rows.distance[known]
    row = {
        "poses": len(distance),
        "rms_nominal_mm": None if nominal is None else rms(nominal[known]),
        "rms_mm": rms(distance),
        "mean_mm": float(distance.mean()) if len(distance) else None,
        "largest_mm": float(distance.max()) if len(distance) else None,
        "rms_predicted_mm": rms(rows.u[known]),
    }
    others = {"rad": rows.angle, "px": rows.pixels}
    measured = {key: others[unit][np.isfinite(others[unit])] for unit, key in OTHER_RMS.items()}
    return plain(row | {key: rms(values) for key, values in measured.items()})


def residuals_csv(rows: PoseResiduals) -> str:
    """The residual of every pose as CSV: in the base frame, mm, with its distance and the u that is predicted for it;
    empty where there is none."""
    headings = ("observation", "pose", "use", *(f"residual_{axis}_mm" for axis in "xyz"), "distance_mm", "u_mm")
    columns = (*rows.residual.T, rows.distance, rows.u, rows.angle, rows.pixels)
    numbers = [["" if value is None else value for value in plain(column)] for column in columns]
    cells = zip(rows.observation, rows.pose.tolist(), rows.use, *numbers, strict=True)
    return csv_text([(*headings, "residual_rad", "residual_px"), *cells])


def _agreement(pairs: Sequence[tuple[ObservationResiduals, np.ndarray]]) -> dict[str, Any]:
    """Root mean squares of some observations together, by the nominal and by the calibrated arm."""
    residuals = [part for part, _ in pairs]
    others = {unit: [part for part in residuals if unit in part.other] for unit in OTHER_RMS}
    rows = np.concatenate([np.full(len(part.distance), part.observation.rows) for part in residuals])
    squares = np.concatenate([part.normalised for part in residuals]) ** 2
    return {
        "poses": len(rows),
        "rms_before_mm": rms(np.concatenate([distances for _, distances in pairs])),
        "rms_after_mm": rms(np.concatenate([part.distance for part in residuals])),
        **{key: _other_rms(others[unit], unit) if others[unit] else None for unit, key in OTHER_RMS.items()},
        "reduced_chi": float(np.sqrt(np.average(squares, weights=rows))),
    }


def _other_rms(residuals: Sequence[ObservationResiduals], unit: str) -> float:
    """Root mean square of residuals that are not in mm, over all corners of images."""
    counts = np.concatenate([part.observation.other_counts for part in residuals])
    return float(np.sqrt(np.average(np.concatenate([part.other[unit] for part in residuals]) ** 2, weights=counts)))


def _geometry(capture: Capture, metrics: ObservedMetrics) -> list[dict[str, Any]]:
    """Every part of the geometry with its numbers, in words too, and with the values certified of it."""
    observed, parts = Observed.of(capture, None), {}
    certified = observed.certified()
    for observation in observed.observations:
        for part, units in _parts(observation).items():
            values, covariance = np.asarray(metrics.geometry[part]), np.asarray(metrics.geometry_covariance[part])
            of_kind = part in observation.unknowns
            read = partial(observation.quantities, part) if of_kind else partial(quantities_by_unit, units)
            # Quantities are functions of the numbers of a part; their uncertainty is that to first order.
            columns = []
            for step in 1e-5 * np.eye(len(values)):  # mm, rad
                ends = [np.concatenate([quantity.values for quantity in read(values + sign * step)])
                        for sign in (1, -1)]  # fmt: skip
                columns.append((ends[0] - ends[1]) / 2e-5)
            by_numbers, quantities = np.stack(columns, axis=1), read(values)
            u = np.sqrt(np.diag(by_numbers @ covariance @ by_numbers.T))
            u_found = np.split(u, np.cumsum([len(quantity.values) for quantity in quantities])[:-1])
            value, stated_u = certified.get(part, (None, None))
            parts[part] = {
                "part": part,
                "units": list(units),
                "values": values.tolist(),
                "u": plain(np.sqrt(np.diag(covariance))),
                "quantities": [
                    _row(quantity) | {"u_found": plain(u_of_it)}
                    for quantity, u_of_it in zip(quantities, u_found, strict=True)
                ],
                "certified": None if value is None else np.asarray(value).tolist(),
                "certified_u": None if stated_u is None else np.asarray(stated_u).tolist(),
            }
    return [parts[part] for part in observed.blocks]


def robot_base_rows(record: CalibrationRecord) -> list[dict[str, Any]]:
    """The base of each chain of a robot in that of the first, k = 1; rotations as vectors, with u about the axes of the
    first base."""
    robot, rows = record.calibrated.arm, []
    if robot.corrections is not None:
        robot = without_corrections(robot)
    for name, chain in chains_of(robot).items():
        if chain.mount:
            by = base_derivatives(robot, chain, record.names)
            u = plain(np.sqrt(np.diag(by @ np.asarray(record.covariance) @ by.T)))
            turn = np.asarray(rotation_vector(chain.base[:3, :3]))
            row = {"in": name, "of": robot.chains[0][0], "position_mm": chain.base[:3, 3].tolist()}
            row |= {"position_u_mm": u[:3], "rotation_rad": turn.tolist(), "rotation_u_rad": u[3:]}
            rows.append(row)
    return rows


def _base_rows(record: CalibrationRecord) -> list[dict[str, Any]]:
    """The base frame as seen from each frame with known coordinates (an artefact's, a station's), k = 1."""
    rows = []
    for part in dict.fromkeys(frames_in_base(record).values()):
        base, by = inverse_frame(np.asarray(record.observed.geometry[part]))
        u = plain(np.sqrt(np.diag(by @ record.observed.geometry_covariance[part] @ by.T)))
        position = {"in": part, "position_mm": base[3:].tolist(), "position_u_mm": u[3:]}
        rows.append(position | {"rotation_rad": base[:3].tolist(), "rotation_u_rad": u[:3]})
    return rows


def frames_in_base(record: CalibrationRecord) -> dict[str, str]:
    """The frames of stations, boards and placements in the base frame, as parts of the geometry, by the names of the
    observations in them."""
    frames = {}
    for observation in record.recording.capture.observations:
        part = getattr(observation, "frame", None)
        # A placement on a platform is not in the base.
        if part is not None and getattr(observation, "index", None) is None:
            frames[observation.name] = part
    return frames


def less_weight(residuals: tuple[ObservationResiduals, ...]) -> list[dict[str, Any]]:
    """Poses that a robust loss took half of their weight from or more, the lightest first, with their residuals, which
    are the reason."""
    rows = []
    for part in residuals:
        i = np.flatnonzero(part.weight <= _LITTLE_WEIGHT)
        rows += rows_of(
            observation=[part.observation.name] * len(i),
            pose=i + 1,
            weight=part.weight[i],
            residual_mm=part.distance[i],
            residual_angle_rad=part.other["rad"][i] if "rad" in part.other else [None] * len(i),
            residual_px=part.other["px"][i] if "px" in part.other else [None] * len(i),
            normalised=part.normalised[i],
        )
    return sorted(rows, key=lambda row: (row["weight"], -row["normalised"]))
