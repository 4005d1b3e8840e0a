"""Arms, captures and calibrations as plain dictionaries with the unit in every key; ``--json`` prints them."""

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..calibration.results import NoisyEncoder, PriorMetrics, active_names
from ..core.text import csv_text, pluralise
from ..core.units import ARCSEC, people_read
from ..data.capture import Capture, ReferenceLength
from ..data.noise import linear_encoder_mm
from ..data.recording import Recording
from ..diagnostics.determined import determined
from ..diagnostics.findings import case_of, finding_rows, findings_of, sentences
from ..diagnostics.joint_travel import tried_poses
from ..diagnostics.model_errors import model_tests, rows_of_tests
from ..diagnostics.recorded import findings_of_capture
from ..kinematics.arm import by_joint, correction_names, parameter_unit, value_of
from ..kinematics.corrections import coefficient_of
from ..kinematics.parameters import ArmSpecification, Parameters
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.identifiability import Observability
from ..uncertainty.shared_errors import SharedErrors
from ..uncertainty.volume import VolumetricUncertainty, volumetric_uncertainty
from .observations import capture_observations, observed_summary
from .validation import cross_validation_summary, finite
from .verdicts import calibration_verdict, checked_lengths

_CORRELATED = 0.95


def arm_summary(specification: ArmSpecification) -> dict[str, Any]:
    """An arm, joint by joint, and the parameters that are fixed by default."""
    arm = specification.arm
    joints = [
        {
            "joint": i + 1,
            "alpha_rad": float(arm.alpha[i]),
            "a_mm": float(arm.a[i]),
            "d_mm": float(arm.d[i]),
            "theta_rad": float(arm.theta[i]),
            "beta_rad": None if arm.beta is None else float(arm.beta[i]),
            "kind": "prismatic" if i + 1 in arm.prismatic else "revolute",
            "limits_rad": None if arm.limits is None or i + 1 in arm.prismatic else list(arm.limits[i]),
            "limits_mm": list(arm.limits[i]) if arm.limits is not None and i + 1 in arm.prismatic else None,
        }
        for i in range(arm.joints)
    ]
    return {
        "kind": "arm",
        "name": specification.name,
        "joints": joints,
        "probe_mm": np.asarray(arm.probe).tolist(),
        "corrections": [
            {
                "coefficient": name,
                "of": "" if (found := coefficient_of(name)) is None else found.kind.description,
                "unit": parameter_unit(arm, name),
                "value": float(value_of(arm, name)),
            }
            for name in correction_names(arm)
        ],
        "held": list(specification.space().held),
        "urdf": None
        if specification.urdf is None
        else {"base": specification.urdf.base, "tip": specification.urdf.tip},
    }


def parameters_csv(record: CalibrationRecord) -> str:
    """The free parameters as CSV: name, unit, nominal, calibrated, standard uncertainty."""
    vectors, u = record.vectors(), np.sqrt(np.diag(record.covariance))
    rows: list[list[Any]] = [["parameter", "unit", "nominal", "calibrated", "u"]]
    for i, name in enumerate(record.names):
        values = (vectors["nominal"][i], vectors["calibrated"][i], u[i])
        unit = parameter_unit(record.recording.nominal.arm, name)
        rows.append([name, unit, *(float(value) for value in values)])
    return csv_text(rows)


def capture_summary(recording: Recording) -> dict[str, Any]:
    """A capture: sockets with their poses, lengths, the nominal arm."""
    capture, units = recording.capture, by_joint(recording.nominal.arm, "rad", "mm")
    q = np.asarray(capture.readings)
    warmth = q[:, len(units) :]
    return {
        "kind": "capture",
        "arm": recording.nominal.name,
        "joints": recording.nominal.arm.joints,
        "poses": len(capture.readings),
        "sockets": [{"socket": name, "poses": size} for name, size in zip(capture.names, capture.sizes, strict=True)],
        "observations": capture_observations(capture),
        "lengths": reference_length_rows(capture.lengths),
        "ranges": [
            {"joint": i + 1, f"lowest_{unit}": float(low), f"highest_{unit}": float(high)}
            for i, (low, high, unit) in enumerate(
                zip(np.min(q[:, : len(units)], axis=0), np.max(q[:, : len(units)], axis=0), units, strict=True)
            )
        ],
        "temperature_C": [float(end) for end in (warmth.min(), warmth.max())] if warmth.size else None,
        "simulated": recording.true is not None,
        "warnings": sentences(findings_of_capture(recording)),
    }


def reference_length_rows(lengths: Iterable[ReferenceLength]) -> list[dict[str, Any]]:
    """Reference lengths with their calibrated value and its standard uncertainty, mm."""
    return [
        {"from": length.start, "to": length.end, "value_mm": float(length.value), "u_mm": float(length.u)}
        for length in lengths
    ]


def metrics(evaluation: Evaluation) -> dict[str, Any]:
    """Repeatability over all sockets, and the errors of the lengths; mm."""
    repeatability, error = evaluation.repeatability, np.asarray(evaluation.error)
    values = {"de_mm": repeatability.de, "deltam_mm": repeatability.deltam, "rms_mm": repeatability.rms}
    # With one pose in every socket none of them is finite: there is no scatter.
    finite_values = {key: float(value) for key, value in values.items() if np.isfinite(value)}
    return finite_values | (length_metrics(error) if len(error) else {})


def length_metrics(error: np.ndarray) -> dict[str, float]:
    """Mean absolute and largest error of lengths, mm."""
    return {
        "length_error_mean_absolute_mm": float(np.mean(np.abs(error))),
        "length_error_largest_mm": float(np.max(np.abs(error))),
    }


def metrics_by_socket_and_length(
    capture: Capture, evaluation: Evaluation, uncertainty: Uncertainty | None = None
) -> dict[str, Any]:
    """Repeatability socket by socket and errors length by length; mm. With the uncertainty of a calibration that the
    lengths belong to, their errors' U."""
    scatter = evaluation.repeatability
    columns = (np.asarray(column) for column in (scatter.socket_de, scatter.socket_deltam, scatter.socket_rms))
    sockets = zip(capture.names, capture.sizes, *columns, strict=True)
    columns = [np.asarray(column) for column in (evaluation.measured, evaluation.error, evaluation.u)]
    stated = np.array([float(length.u) for length in capture.lengths])
    expanded = None if uncertainty is None else uncertainty.expanded_by_scatter(columns[2], stated)
    lengths = list(zip(capture.lengths, *columns, strict=True))
    return {
        "sockets": [
            {"socket": name, "poses": size}
            # One pose shows no scatter.
            | dict(zip(("de_mm", "deltam_mm", "rms_mm"), map(float, values) if size > 1 else (None,) * 3, strict=True))
            for name, size, *values in sockets
        ],
        "lengths": [
            {
                "from": length.start,
                "to": length.end,
                "value_mm": float(length.value),
                "measured_mm": float(measured),
                "error_mm": float(error),
                "error_u_mm": finite(u),
            }
            | ({} if expanded is None else {"expanded_mm": float(expanded[i]) if np.isfinite(u) else None})
            for i, (length, measured, error, u) in enumerate(lengths)
        ],
    }


def calibration_summary(
    record: CalibrationRecord,
    volume: VolumetricUncertainty | None = None,
) -> dict[str, Any]:
    """A calibration: method, metrics by arm, scale, parameters, uncertainty and warnings.

    ``volume`` (`volumetric_uncertainty`) is computed if not given.
    """
    case, findings = case_of(record), findings_of(record)
    observability = case.once(determined)
    tests = None if record.implausible_residual or not record.plausible_scale else rows_of_tests(model_tests(record))
    evaluations, vectors = record.evaluations(), record.vectors()
    uncertainty, u = uncertainty_of(record), np.sqrt(np.diag(record.covariance))
    expanded = uncertainty.factor() * u
    parameters = [
        {
            "parameter": name,
            "unit": parameter_unit(record.recording.nominal.arm, name),
            "u": float(u[i]) if record.determined[i] and u[i] > 0 else None,
            "expanded": float(expanded[i]) if record.determined[i] and u[i] > 0 else None,
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
        "residual_plausible": not record.implausible_residual,
        "scale_plausible": record.plausible_scale,
        "reason": record.reason,
        "steps": record.steps,
        "poses": len(record.recording.capture.readings),
        "sockets_used": list(record.recording.capture.names),
        "scale_k": finite(record.k),
        "scale_u": finite(record.u_k),
        "scale_expanded": uncertainty.expanded_k() if np.isfinite(record.u_k) else None,
        "fixed_by_one_length": record.fixed_by_one_length,
        "held": list(record.held),
        "hold": record.hold,
        "active_stage1": active_names_of(record, record.active_stage1),
        "active": active_names_of(record, record.active),
        **{stage: metrics(evaluation) for stage, evaluation in evaluations.items()},
        **metrics_by_socket_and_length(record.recording.capture, evaluations["calibrated"], uncertainty),
        "parameters": parameters,
        "uncertainty": uncertainty_summary(record, observability, volume),
        "cross_validation": None if record.validation is None else cross_validation_summary(record.validation),
        "monte_carlo": record.sampled_says,
        "model_tests": tests,
        "prior": None if record.prior is None else prior_rows(record.prior),
        "shared_errors": None if record.shared is None else shared_rows(record.shared),
        "findings": finding_rows(findings),
        "warnings": sentences(findings),
        **observed_summary(record, evaluations["nominal"]),
    }
    if "true" in vectors:
        summary["truth"] = {
            stage: truth_errors(record, vectors, stage) for stage in ("nominal", "stage1", "calibrated")
        }
    checked = checked_lengths(summary["lengths"], summary["cross_validation"], record.fixed_by_one_length)
    volume_row, held_out = summary["uncertainty"]["volume"], summary["cross_validation"]
    verdict = calibration_verdict(findings, volume_row, held_out, "truth" in summary)
    return summary | {"lengths_tested": checked, "verdict": verdict._asdict()}


def prior_rows(prior: PriorMetrics) -> list[dict[str, Any]]:
    """A prior, group by group; the standard deviation in mm or rad, or in steps of 1 mm and 1 mrad."""
    return [
        {
            "group": group,
            "learned": prior.learned[i],
            "parameters": prior.parameters[i],
            "sd": float(prior.sd[i]),
            "unit": prior.units[i],
            "effective_parameters": float(prior.effective[i]),
            "supported": bool(prior.supported[i]),
        }
        for i, group in enumerate(prior.groups)
    ]


def prior_sentence(row: Mapping[str, Any]) -> str:
    """One group of a prior in words."""
    spent = f"{row['effective_parameters']:.1f} of {pluralise(row['parameters'], 'parameter')} determined by the data"
    if not row["supported"]:
        return f"{row['group']}: learned, no deviation from the mean is supported, so it counts as exact; {spent}"
    scale, unit = people_read(row["unit"])
    scale_in_words = f"{row['sd'] * scale:.3g} {unit}".strip()
    return f"{row['group']}: {'learned' if row['learned'] else 'given'}, {scale_in_words}; {spent}"


def noisy_encoder_rows(encoders: Iterable[NoisyEncoder], slides: Collection[int]) -> list[dict[str, Any]]:
    """Encoders whose noise was replaced; arcsec, or mm of prismatic joints."""
    rows = []
    for encoder in encoders:
        unit, factor = ("mm", 1.0) if encoder.joint in slides else ("arcsec", 1 / ARCSEC)
        values = {name: factor * getattr(encoder, name) for name in ("expected", "found", "u")}
        rows.append({"joint": encoder.joint, "probability": encoder.probability, "unit": unit, **values})
    return rows


def shared_rows(shared: SharedErrors) -> list[dict[str, Any]]:
    """Errors that poses share, kind by kind, with their standard deviations in mm, or in the unit of coefficients."""
    return [{"kind": kind, "sd": float(shared.sd[i]), "unit": shared.units[i]} for i, kind in enumerate(shared.kinds)]


def uncertainty_summary(
    record: CalibrationRecord, observability: Observability, volume: VolumetricUncertainty | None = None
) -> dict[str, Any]:
    """Noise behind the uncertainty, standard uncertainties (k = 1) over the working volume, and observability."""
    uncertainty = uncertainty_of(record)
    volume = volumetric_uncertainty(uncertainty) if volume is None else volume
    readings, nearby = np.asarray(record.recording.capture.readings), None
    if len(readings) > 1:  # a single pose has no distance from another
        poses = tried_poses(record.calibrated.arm, readings, volume.q)
        nearby = {"poses": len(poses.distance), "tried": int(poses.tried.sum()), "spacing_rad": poses.spacing}
    return {
        "form": record.noise_model,
        "encoder_arcsec": np.asarray(record.noise.encoder_arcsec).tolist(),
        "linear_encoder_mm": linear_encoder_mm(record.noise, record.calibrated.arm),
        "seating_mm": float(record.noise.seating),
        "noisy_encoders": noisy_encoder_rows(record.noisy_encoders, record.calibrated.arm.prismatic),
        "misfit": record.reduced_chi,
        # Of the unknown geometry, whose uncertainty follows from the scatter of single poses.
        "coverage_factor_geometry_95": float(uncertainty.expanded_by_scatter(np.ones(1), np.zeros(1))[0]),
        "volume": {key: finite(value) for key, value in volume.summary.items()},
        "correlated": [
            dict(zip(("one", "other", "r"), pair, strict=True)) for pair in uncertainty.correlated(_CORRELATED)
        ],
        "rank": observability.rank,
        "parameters": len(observability.names),
        "condition": finite(observability.condition),
        "indices": observability.indices,
        "tried": nearby,
    }


def active_names_of(record: CalibrationRecord, active: np.ndarray) -> dict[str, str]:
    """Parameters on a bound: name -> side."""
    return active_names(Parameters(record.recording.nominal.arm, record.names), active)


def truth_errors(record: CalibrationRecord, vectors: dict[str, np.ndarray], stage: str) -> dict[str, float]:
    """Largest parameter errors against the true arm of a simulation."""
    difference = np.abs(vectors[stage] - vectors["true"])
    units = np.array([parameter_unit(record.calibrated.arm, name) for name in record.names])
    return {
        "length_error_largest_mm": float(difference[units == "mm"].max(initial=0.0)),
        "angle_error_largest_rad": float(difference[units == "rad"].max(initial=0.0)),
    }
