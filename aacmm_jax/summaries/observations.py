"""Observations as plain dictionaries with the unit in every key: what they are, how they agree, the geometry found."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.record import REPEATABILITY, CalibrationRecord
from ..calibration.results import ObservedMetrics
from ..core.rotations import inverse_frame
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
from ..diagnostics.pose_residuals import (
    ObservationResiduals,
    distances_of,
    observation_residuals,
    rms,
)
from ..model.observed import Observed
from .tables import observed_words

_LITTLE_WEIGHT = 0.5


def capture_observations(capture: Capture) -> list[dict[str, Any]]:
    """What a capture holds besides sockets and lengths: unknowns of each observation, and what is certified of it."""
    return [
        {
            "observation": one.name,
            "kind": one.kind,
            "poses": len(one.q),
            "target": one.target,
            "unknowns": list(_parts(one)),
            "certified": [_row(quantity) for quantity in certified_quantities(one)],
            "stated": [_row(quantity) for quantity in stated_quantities(one)],
            "fixes_scale": bool(one.fixes_scale),
        }
        for one in capture.observations
    ]


def _parts(observation: AbstractObservation) -> dict[str, tuple[str, ...]]:
    """The unknown geometry of an observation, with the place of its target in the last frame."""
    target = {offset_of(observation.target): POINT} if observation.target else {}
    return {**observation.unknowns, **target}


def capture_words(capture: Capture) -> str:
    """How many sockets, other observations and reference lengths a capture has; sockets of a session with a probe of
    its own are sockets like any other."""
    sockets = len(capture.names) + sum(one.kind == "socket" for one in capture.observations)
    return observed_words(sockets, len(capture.names) + len(capture.observations) - sockets, len(capture.lengths))


def _row(quantity: Quantity) -> dict[str, Any]:
    values = np.asarray(quantity.values, dtype=float).tolist()
    return {"quantity": quantity.says, "values": values, "unit": quantity.unit, "u": quantity.u}


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
    return lengths + by_slides + [f"{one.name} ({one.kind})" for one in capture.observations if one.fixes_scale]


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
        "removed": [
            one._asdict() | {"members": list(one.members), "degrees_of_freedom": list(one.degrees_of_freedom)}
            for one in record.removed
        ],
    }
    observed, others = record.observed, record.others
    if not record.sockets_alone:
        residuals = observation_residuals(record)
        before = distances_of(record.recording.capture, nominal)
        pairs = list(zip(residuals, before, strict=True))
        summary["observations"] = [
            {"observation": one.observation.name, "kind": one.observation.kind, "target": one.observation.target}
            | _agreement([(one, distances)])
            for one, distances in pairs
        ]
        for kind in dict.fromkeys(one.observation.kind for one in residuals):
            of_kind = [pair for pair in pairs if pair[0].observation.kind == kind]
            summary["kinds"].append({"kind": kind, "observations": len(of_kind)} | _agreement(of_kind))
        summary["geometry"] = _geometry(record.recording.capture, observed)
        summary["base"] = _base_rows(record, observed)
        summary["less_weight"] = less_weight(residuals)
    if others is not None:
        angles = [None if np.isnan(angle) else float(angle) for angle in others.rms_angle]
        summary["other_poses"] = {
            "poses": int(others.poses.sum()),
            "rms_mm": others.rms_of_all,
            "observations": [
                {"observation": name, "poses": int(poses), "rms_mm": float(distance), "rms_angle_rad": angle}
                for name, poses, distance, angle in zip(others.names, others.poses, others.rms, angles, strict=True)
            ],
        }
    return summary


def _agreement(pairs: list[tuple[ObservationResiduals, np.ndarray]]) -> dict[str, Any]:
    """Root mean squares of some observations together, by the nominal and by the calibrated arm."""
    residuals = [one for one, _ in pairs]
    angles = [one.angle for one in residuals if one.angle is not None]
    rows = np.concatenate([np.full(len(one.distance), one.observation.rows) for one in residuals])
    squares = np.concatenate([one.normalised for one in residuals]) ** 2
    return {
        "poses": len(rows),
        "rms_before_mm": rms(np.concatenate([distances for _, distances in pairs])),
        "rms_after_mm": rms(np.concatenate([one.distance for one in residuals])),
        "rms_angle_rad": rms(np.concatenate(angles)) if angles else None,
        "reduced_chi": float(np.sqrt(np.average(squares, weights=rows))),
    }


def _geometry(capture: Capture, metrics: ObservedMetrics) -> list[dict[str, Any]]:
    """Every part of the geometry with its numbers, in words too, and with the values certified of it."""
    observed, parts = Observed.of(capture, None), {}
    certified = observed.certified()
    for observation in observed.observations:
        for part, units in _parts(observation).items():
            values = np.asarray(metrics.geometry[part])
            of_kind = part in observation.unknowns
            read = partial(observation.quantities, part) if of_kind else partial(quantities_by_unit, units)
            found_u = _u_of_quantities(read, values, metrics.geometry_covariance[part])
            value, u = certified.get(part, (None, None))
            parts[part] = {
                "part": part,
                "units": list(units),
                "values": values.tolist(),
                "u": _known(np.sqrt(np.diag(metrics.geometry_covariance[part]))),
                "quantities": [
                    _row(quantity) | {"u_found": _known(own_u)}
                    for quantity, own_u in zip(read(values), found_u, strict=True)
                ],
                "certified": None if value is None else np.asarray(value).tolist(),
                "certified_u": None if u is None else np.asarray(u).tolist(),
            }
    return [parts[part] for part in observed.blocks]


def _u_of_quantities(
    read: Callable[[np.ndarray], Sequence[Quantity]], values: np.ndarray, covariance: Any
) -> list[np.ndarray]:
    """Standard uncertainties of quantities that are functions of the numbers of a part, to first order."""
    steps = 1e-5 * np.eye(len(values))  # mm, rad
    ends = [[np.concatenate([one.values for one in read(values + sign * step)]) for sign in (1, -1)] for step in steps]
    by_numbers = np.stack([(after - before) / 2e-5 for after, before in ends], axis=1)
    u = np.sqrt(np.diag(by_numbers @ np.asarray(covariance) @ by_numbers.T))
    return np.split(u, np.cumsum([len(one.values) for one in read(values)])[:-1])


def _known(u: np.ndarray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in u]


def _base_rows(record: CalibrationRecord, observed: ObservedMetrics) -> list[dict[str, Any]]:
    """The base frame as seen from each frame with known coordinates (an artefact's, a station's), k = 1."""
    rows = {}
    for one in record.recording.capture.observations:
        part = getattr(one, "frame", None)
        if part is None or getattr(one, "index", None) is not None:  # a placement on a platform is not in the base
            continue
        base, by = inverse_frame(np.asarray(observed.geometry[part]))
        u = _known(np.sqrt(np.diag(by @ observed.geometry_covariance[part] @ by.T)))
        rows[part] = {
            "in": part,
            "position_mm": base[3:].tolist(),
            "position_u_mm": u[3:],
            "rotation_rad": base[:3].tolist(),
            "rotation_u_rad": u[:3],
        }
    return list(rows.values())


def less_weight(residuals: tuple[ObservationResiduals, ...]) -> list[dict[str, Any]]:
    """Poses that a robust loss took half of their weight from or more, the lightest first, with their residuals, which
    are the reason."""
    rows = [
        {
            "observation": one.observation.name,
            "pose": int(i) + 1,
            "weight": float(one.weight[i]),
            "residual_mm": float(one.distance[i]),
            "residual_angle_rad": None if one.angle is None else float(one.angle[i]),
            "normalised": float(one.normalised[i]),
        }
        for one in residuals
        for i in np.flatnonzero(one.weight <= _LITTLE_WEIGHT)
    ]
    return sorted(rows, key=lambda row: (row["weight"], -row["normalised"]))
