"""What files hold, as plain dictionaries with the unit in every key: printed by the command line, and its ``--json``."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .arm_files import ArmSpecification
from .calibrate import active_names
from .calibration_files import CalibrationRecord
from .capture import Capture
from .evaluate import Evaluation, evaluate
from .manifest import Recording
from .parameters import Parameters, is_length

# Above this a unit in the last place of the encoder or the seat cannot explain a misfit; the scale surely slid.
_SUSPICIOUS_SHRINK = 0.005


def arm_summary(specification: ArmSpecification) -> dict[str, Any]:
    """An arm, joint by joint, and what is not identified of it by default."""
    arm = specification.arm
    joints = [
        {
            "joint": i + 1,
            "alpha_rad": float(arm.alpha[i]),
            "a_mm": float(arm.a[i]),
            "d_mm": float(arm.d[i]),
            "theta_rad": float(arm.theta[i]),
            "beta_rad": None if arm.beta is None else float(arm.beta[i]),
            "limits_rad": None if arm.limits is None else list(arm.limits[i]),
        }
        for i in range(arm.joints)
    ]
    return {
        "kind": "arm",
        "name": specification.name,
        "joints": joints,
        "probe_mm": np.asarray(arm.probe).tolist(),
        "held": list(Parameters.free_of(arm, held=specification.held).held),
    }


def parameters_csv(record: CalibrationRecord) -> str:
    """The free parameters as CSV: name, unit, nominal, calibrated, standard uncertainty."""
    vectors, u = record.vectors(), np.sqrt(np.diag(record.covariance))
    lines = ["parameter,unit,nominal,calibrated,u"]
    for i, name in enumerate(record.names):
        values = (vectors["nominal"][i], vectors["calibrated"][i], u[i])
        lines.append(",".join([name, "mm" if is_length(name) else "rad", *(repr(float(value)) for value in values)]))
    return "\n".join(lines) + "\n"


def capture_summary(recording: Recording) -> dict[str, Any]:
    """A capture: sockets with their poses, lengths, the nominal arm."""
    capture = recording.capture
    return {
        "kind": "capture",
        "arm": recording.nominal.name,
        "joints": capture.joints,
        "poses": sum(capture.sizes),
        "sockets": [{"socket": name, "poses": size} for name, size in zip(capture.names, capture.sizes, strict=True)],
        "lengths": [
            {"from": length.start, "to": length.end, "value_mm": float(length.value), "u_mm": float(length.u)}
            for length in capture.lengths
        ],
        "simulated": recording.true is not None,
    }


def figures(evaluation: Evaluation) -> dict[str, Any]:
    """Repeatability over all sockets, and the errors of the lengths; mm."""
    spread, error = evaluation.repeatability, np.asarray(evaluation.error)
    found = {"de_mm": float(spread.de), "deltam_mm": float(spread.deltam), "rms_mm": float(spread.rms)}
    if len(error):
        found["length_error_mean_absolute_mm"] = float(np.mean(np.abs(error)))
        found["length_error_largest_mm"] = float(np.max(np.abs(error)))
    return found


def tables(capture: Capture, evaluation: Evaluation) -> dict[str, Any]:
    """Figures socket by socket and length by length."""
    spread = evaluation.repeatability
    sockets = zip(capture.names, capture.sizes, spread.socket_de, spread.socket_deltam, spread.socket_rms, strict=True)
    lengths = zip(capture.lengths, np.asarray(evaluation.measured), np.asarray(evaluation.error), strict=True)
    return {
        "sockets": [
            {"socket": name, "poses": size, "de_mm": float(de), "deltam_mm": float(deltam), "rms_mm": float(rms)}
            for name, size, de, deltam, rms in sockets
        ],
        "lengths": [
            {
                "from": length.start,
                "to": length.end,
                "value_mm": float(length.value),
                "measured_mm": float(measured),
                "error_mm": float(error),
            }
            for length, measured, error in lengths
        ],
    }


def calibration_summary(record: CalibrationRecord) -> dict[str, Any]:
    """A calibration: what was done, before and after, the scale, the parameters, and what to be wary of."""
    evaluations, vectors = record.evaluations(), record.vectors()
    u = np.sqrt(np.diag(record.covariance))
    parameters = [
        {
            "parameter": name,
            "unit": "mm" if is_length(name) else "rad",
            "u": float(u[i]),
            **{stage: float(vector[i]) for stage, vector in vectors.items()},
            "bound": {-1: "lower", 1: "upper"}.get(int(record.active[i])),
        }
        for i, name in enumerate(record.names)
    ]
    summary: dict[str, Any] = {
        "kind": "calibration",
        "arm": record.recording.nominal.name,
        "method": record.method,
        "converged": record.converged,
        "reason": record.reason,
        "steps": record.steps,
        "poses": sum(record.recording.capture.sizes),
        "sockets_used": list(record.recording.capture.names),
        "scale_k": record.k,
        "scale_u": record.u_k,
        "held": list(record.held),
        "hold": record.hold,
        "active_stage1": active_names_of(record, record.active_stage1),
        "active": active_names_of(record, record.active),
        **{stage: figures(evaluation) for stage, evaluation in evaluations.items()},
        **tables(record.recording.capture, evaluations["calibrated"]),
        "parameters": parameters,
        "warnings": warnings(record),
    }
    if "true" in vectors:
        summary["truth"] = {stage: truth_errors(record, vectors, stage) for stage in ("nominal", "stage1", "calibrated")}
    return summary


def active_names_of(record: CalibrationRecord, active: np.ndarray) -> dict[str, str]:
    """Parameters on a bound: name -> side."""
    return active_names(Parameters(record.recording.nominal.arm, record.names), active)


def warnings(record: CalibrationRecord) -> list[str]:
    """What a user should know before trusting the result, one sentence each."""
    found = []
    if not record.converged:
        found.append(record.reason)
    stage1 = active_names_of(record, record.active_stage1)
    if record.hold is None and stage1:
        sides = ", ".join(f"{name} ({side})" for name, side in stage1.items())
        word = "shrank" if record.k < 1 else "stretched"
        found.append(
            f"Stage 1 ran with every length free and {word} the arm to k = {record.k:.5f} until a bound stopped it: {sides}. "
            "The scale fix undoes that; hold a length (--hold) to avoid it."
        )
    elif stage1:
        sides = ", ".join(f"{name} ({side})" for name, side in stage1.items())
        found.append(
            f"On a bound: {sides}. Widen the bounds unless they are known limits; uncertainties ignore such parameters."
        )
    if record.hold is not None and abs(record.k - 1) > _SUSPICIOUS_SHRINK:
        found.append(
            f"k = {record.k:.5f} is far from 1: is {record.hold} at its nominal value, and is each reference length right?"
        )
    lengths = record.recording.capture.lengths
    if len(lengths) == 1:
        found.append(
            "A single reference length fixes the scale, so its error after calibration says nothing; keep another for checking."
        )
    return found


def truth_errors(record: CalibrationRecord, vectors: dict[str, np.ndarray], stage: str) -> dict[str, float]:
    """Largest parameter errors against the true arm of a simulation."""
    difference = np.abs(vectors[stage] - vectors["true"])
    length = np.array([is_length(name) for name in record.names])
    return {
        "length_error_largest_mm": float(difference[length].max(initial=0.0)),
        "angle_error_largest_rad": float(difference[~length].max(initial=0.0)),
    }


def evaluation_summary(record: CalibrationRecord, capture: Capture) -> dict[str, Any]:
    """The nominal and the calibrated arm on a capture, apart for what was identified from and what was held out."""
    known = record.recording.capture.sockets
    used = [
        name
        for name, q in capture.sockets.items()
        if any(np.array_equal(np.asarray(q), np.asarray(other)) for other in known.values())
    ]
    groups = {"identified_from": used, "held_out": [name for name in capture.names if name not in used]}
    summary: dict[str, Any] = {"kind": "evaluation", "arm": record.recording.nominal.name}
    for group, names in groups.items():
        if not names:
            summary[group] = None
            continue
        part = capture.select(names)
        evaluations = {stage: evaluate(specification.arm, part) for stage, specification in _arms(record).items()}
        summary[group] = {
            **{stage: figures(evaluation) for stage, evaluation in evaluations.items()},
            **tables(part, evaluations["calibrated"]),
        }
    return summary


def _arms(record: CalibrationRecord) -> dict[str, ArmSpecification]:
    return {"nominal": record.recording.nominal, "calibrated": record.calibrated}


def exceeded(summary: dict[str, Any], limits: Sequence[tuple[str, float | None]]) -> list[str]:
    """Sentences for figures of the calibrated arm, over held-out sockets if there are any, that exceed a limit."""
    group = summary["held_out"] or summary["identified_from"]
    found = []
    for key, limit in limits:
        if limit is None:
            continue
        value = group["calibrated"].get(key)
        if value is None:
            found.append(f"{key} has a limit of {limit:g} mm, but the capture holds no reference length.")
        elif not value <= limit:
            found.append(f"{key} is {value:.4f} mm, over the limit of {limit:g} mm.")
    return found
