"""Arms, captures and calibrations as plain dictionaries with the unit in every key; ``--json`` prints them."""

import contextlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..calibration.agreement import Agreement, CrossValidation
from ..calibration.evaluation import Evaluation
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..calibration.results import PriorMetrics
from ..core.errors import InputError
from ..core.text import csv_text, pluralise
from ..core.units import ARCSEC, people_read
from ..data.capture import Capture, ReferenceLength
from ..data.noise import linear_encoder_mm
from ..data.recording import Recording
from ..diagnostics.determined import determined
from ..diagnostics.findings import case_of, finding_rows, findings_of, sentences
from ..diagnostics.joint_travel import tried_poses
from ..diagnostics.model_errors import model_tests, rows_of_tests
from ..diagnostics.pose_residuals import rms
from ..diagnostics.recorded import findings_of_capture
from ..diagnostics.usability import on_bounds
from ..kinematics.arm import Arm, by_joint, correction_names, parameter_unit, value_of
from ..kinematics.corrected_arm import loads_of
from ..kinematics.corrections import coefficient_of
from ..kinematics.parameters import ArmSpecification
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.covariance import SharedErrors
from ..uncertainty.volume import VolumetricUncertainty, volumetric_uncertainty
from .cameras import camera_rows, image_rows
from .observations import capture_observations, observed_summary
from .tables import attributes, plain, rows_of
from .verdicts import calibration_verdict, checked_lengths, geometry_verdict

_CORRELATED = 0.95


def arm_summary(specification: ArmSpecification) -> dict[str, Any]:
    """An arm, joint by joint, and the parameters that are fixed by default."""
    arm, urdf = specification.arm, specification.urdf
    joints = range(1, arm.joints + 1)
    slides = [joint in arm.prismatic for joint in joints]
    none = [None] * arm.joints
    limits = list(zip(none if arm.limits is None else arm.limits, slides, strict=True))
    kinds = {name: coefficient_of(name) for name in correction_names(arm)}
    return {
        "kind": "arm",
        "name": specification.name,
        "joints": rows_of(
            joint=joints,
            alpha_rad=arm.alpha,
            a_mm=arm.a,
            d_mm=arm.d,
            theta_rad=arm.theta,
            beta_rad=none if arm.beta is None else arm.beta,
            kind=["prismatic" if slide else "revolute" for slide in slides],
            limits_rad=[None if slide else limit for limit, slide in limits],
            limits_mm=[limit if slide else None for limit, slide in limits],
        ),
        "probe_mm": plain(arm.probe),
        "corrections": [
            {
                "coefficient": name,
                "of": "" if coefficient is None else coefficient.kind.description,
                "unit": parameter_unit(arm, name),
                "value": float(value_of(arm, name)),
            }
            for name, coefficient in kinds.items()
        ],
        "held": list(specification.space().held),
        "urdf": None if urdf is None else {"format": urdf.format, "base": urdf.base, "tip": ", ".join(urdf.tips)},
    }


def parameters_csv(record: CalibrationRecord) -> str:
    """The free parameters as CSV: name, unit, nominal, calibrated, standard uncertainty."""
    vectors, u = record.vectors(), np.sqrt(np.diag(record.covariance))
    units = [parameter_unit(record.recording.nominal.arm, name) for name in record.names]
    columns = (plain(vectors["nominal"]), plain(vectors["calibrated"]), u.tolist())
    rows = zip(record.names, units, *columns, strict=True)
    return csv_text([("parameter", "unit", "nominal", "calibrated", "u"), *rows])


def capture_summary(recording: Recording) -> dict[str, Any]:
    """A capture: sockets with their poses, lengths, the nominal arm."""
    capture, arm = recording.capture, recording.nominal.arm
    q, units, beside = np.asarray(capture.readings), by_joint(arm, "rad", "mm"), arm.beside.slices(capture.columns)
    torques, load, warmth = (q[:, beside[name]] for name in ("torques", "load", "thermometer"))
    ends = zip(units, q.min(axis=0).tolist(), q.max(axis=0).tolist(), strict=False)
    return {
        "kind": "capture",
        "arm": recording.nominal.name,
        "joints": recording.nominal.arm.joints,
        "poses": len(q),
        "sockets": rows_of(socket=capture.names, poses=capture.sizes),
        "observations": capture_observations(capture),
        "images": image_rows(recording),
        "notes": list(recording.notes),
        "lengths": reference_length_rows(capture.lengths, u_mm=[float(length.u) for length in capture.lengths]),
        "ranges": [
            {"joint": i, f"lowest_{unit}": low, f"highest_{unit}": high}
            for i, (unit, low, high) in enumerate(ends, start=1)
        ],
        "largest_torques_Nm": np.abs(torques).max(axis=0).tolist() if torques.size else None,
        "load_kg": [float(load.min()), float(load.max())] if load.size else None,
        "temperature_C": [float(warmth.min()), float(warmth.max())] if warmth.size else None,
        "simulated": recording.true is not None,
        "warnings": sentences(findings_of_capture(recording)),
    }


def masses_sentence(arm: Arm) -> str | None:
    """Which masses the bending of an arm's joints was computed with; None where masses are not taken as known."""
    loads = None if arm.corrections is None else loads_of(arm)
    if arm.corrections is None or loads is None or not np.any(arm.corrections.functions.by_gravity):
        return None
    links = ", ".join(f"{mass:.3g}" for mass in loads.mass)
    return (
        f"Masses taken as known (gravity=masses): {links} kg by link, {sum(loads.mass):.3g} kg in all. A tool or "
        "payload counts only if it is part of these; --model gravity needs no masses."
    )


def reference_length_rows(lengths: Sequence[ReferenceLength], **columns: Any) -> list[dict[str, Any]]:
    """Reference lengths with their calibrated value and other columns, mm."""
    ends = {"from": [length.start for length in lengths], "to": [length.end for length in lengths]}
    return rows_of(**ends, value_mm=[float(length.value) for length in lengths], **columns)


def metrics(evaluation: Evaluation) -> dict[str, Any]:
    """Repeatability over all sockets, and the errors of the lengths; mm."""
    repeatability, error = evaluation.repeatability, np.asarray(evaluation.error)
    values = {"de_mm": repeatability.de, "deltam_mm": repeatability.deltam, "rms_mm": repeatability.rms}
    if np.isfinite(repeatability.rms):
        values["distance_largest_mm"] = np.asarray(evaluation.distances).max()
    # With one pose in every socket none of them is finite: there is no scatter.
    return {key: float(value) for key, value in values.items() if np.isfinite(value)} | length_metrics(error)


def length_metrics(error: np.ndarray) -> dict[str, float]:
    """Mean absolute and largest error of lengths, mm; nothing of no lengths."""
    if not len(error):
        return {}
    size = np.abs(error)
    return {"length_error_mean_absolute_mm": float(size.mean()), "length_error_largest_mm": float(size.max())}


def metrics_by_socket_and_length(
    capture: Capture, evaluation: Evaluation, uncertainty: Uncertainty | None = None
) -> dict[str, Any]:
    """Repeatability socket by socket and errors length by length; mm. With the uncertainty of a calibration that the
    lengths belong to, their errors' U."""
    scatter, u = evaluation.repeatability, np.asarray(evaluation.u)
    by_socket = {"de_mm": scatter.socket_de, "deltam_mm": scatter.socket_deltam, "rms_mm": scatter.socket_rms}
    scattered = np.asarray(capture.sizes) > 1  # one pose shows no scatter
    by_socket = {key: np.where(scattered, np.asarray(values), np.nan) for key, values in by_socket.items()}
    by_length = {"measured_mm": evaluation.measured, "error_mm": evaluation.error, "error_u_mm": u}
    if uncertainty is not None:
        stated = np.array([float(length.u) for length in capture.lengths])
        by_length["expanded_mm"] = np.where(np.isfinite(u), uncertainty.expanded_by_scatter(u, stated), np.nan)
    return {
        "sockets": rows_of(socket=capture.names, poses=capture.sizes, **by_socket),
        "lengths": reference_length_rows(capture.lengths, **by_length),
    }


def calibration_summary(record: CalibrationRecord, volume: VolumetricUncertainty | None = None) -> dict[str, Any]:
    """A calibration: method, metrics by arm, scale, parameters, uncertainty and warnings.

    ``volume`` (`volumetric_uncertainty`) is computed if not given.
    """
    findings, recording = findings_of(record), record.recording
    fits = record.plausible_scale and not record.implausible_residual
    units = [parameter_unit(recording.nominal.arm, name) for name in record.names]
    evaluations, vectors, uncertainty = record.evaluations(), record.vectors(), uncertainty_of(record)
    u, sides = np.sqrt(np.diag(record.covariance)), {-1: "lower", 1: "upper"}
    u = np.where(np.asarray(record.determined) & (u > 0), u, np.nan)
    summary: dict[str, Any] = {
        "kind": "calibration",
        "arm": recording.nominal.name,
        **attributes(record, "method", "converged", "reason", "steps", "fixed_by_one_length", "held", "hold"),
        **attributes(record, scale_plausible="plausible_scale", scale_k="k", scale_u="u_k", monte_carlo="sampled_says"),
        "residual_plausible": not record.implausible_residual,
        "poses": len(recording.capture.readings),
        "sockets_used": list(recording.capture.names),
        "scale_expanded": uncertainty.expanded_k() if math.isfinite(record.u_k) else None,
        "decisions": list(record.decisions),
        "masses": masses_sentence(record.calibrated.arm),
        "active_stage1": on_bounds(record),
        "active": on_bounds(record, final=True),
        **{stage: metrics(evaluation) for stage, evaluation in evaluations.items()},
        **metrics_by_socket_and_length(recording.capture, evaluations["calibrated"], uncertainty),
        "parameters": rows_of(
            parameter=record.names,
            unit=units,
            u=u,
            expanded=uncertainty.factor() * u,
            **vectors,
            bound=[sides.get(int(side)) for side in record.active],
        ),
        "uncertainty": _uncertainty_summary(record, volume),
        "cross_validation": record.validation
        and cross_validation_summary(record.validation, bool(record.recording.capture.sizes)),
        "model_tests": rows_of_tests(model_tests(record)) if fits else None,
        "prior": None if record.prior is None else prior_rows(record.prior),
        "shared_errors": None if record.shared is None else shared_rows(record.shared),
        "findings": finding_rows(findings),
        "warnings": sentences(findings),
        "cameras": camera_rows(record),
        **observed_summary(record, evaluations["nominal"]),
    }
    if "true" in vectors:
        summary["truth"] = {}
        for stage in ("nominal", "stage1", "calibrated"):
            largest = {unit: 0.0 for unit in ("mm", "rad")}
            for unit, error in zip(units, np.abs(vectors[stage] - vectors["true"]).tolist(), strict=True):
                largest[unit] = max(largest.get(unit, 0.0), error)
            truth = {"length_error_largest_mm": largest["mm"], "angle_error_largest_rad": largest["rad"]}
            summary["truth"][stage] = truth
    held_out = summary["cross_validation"]
    summary["lengths_tested"] = checked_lengths(summary["lengths"], held_out, record.fixed_by_one_length)
    verdict = calibration_verdict(
        findings, summary["uncertainty"], held_out, "truth" in summary, "held_out_poses" in summary
    )
    if not record.names and verdict.achieved:
        verdict = geometry_verdict(findings, summary["cameras"], summary["uncertainty"])
    return summary | {"verdict": verdict._asdict()}


def _uncertainty_summary(record: CalibrationRecord, volume: VolumetricUncertainty | None) -> dict[str, Any]:
    """Noise behind the uncertainty, standard uncertainties (k = 1) over the working volume, and observability."""
    uncertainty, observability = uncertainty_of(record), case_of(record).once(determined)
    volume = volumetric_uncertainty(uncertainty) if volume is None else volume
    readings, nearby, noisy = np.asarray(record.recording.capture.readings), None, []
    if len(readings) > 1:  # a single pose has no distance from another
        poses = tried_poses(record.calibrated.arm, readings, volume.q)
        nearby = {"poses": len(poses.distance), "tried": int(poses.tried.sum()), "spacing_rad": poses.spacing}
    pairs, near = uncertainty.correlated(_CORRELATED), None
    with contextlib.suppress(InputError):  # where no two poses are as far apart as the length
        near = volumetric_uncertainty(uncertainty, length=volume.length, near=readings).summary
    for encoder in record.noisy_encoders:
        unit, size = ("mm", 1.0) if encoder.joint in record.calibrated.arm.prismatic else ("arcsec", ARCSEC)
        values = {name: getattr(encoder, name) / size for name in ("expected", "found", "u")}
        noisy.append({"joint": encoder.joint, "probability": encoder.probability, "unit": unit, **values})
    return {
        **attributes(record, form="noise_model", misfit="reduced_chi"),
        "encoder_arcsec": np.asarray(record.noise.encoder_arcsec).tolist(),
        "linear_encoder_mm": linear_encoder_mm(record.noise, record.calibrated.arm),
        "seating_mm": float(record.noise.seating),
        "noisy_encoders": noisy,
        # Of the unknown geometry, whose uncertainty follows from the scatter of single poses.
        "coverage_factor_geometry_95": float(uncertainty.expanded_by_scatter(np.ones(1), np.zeros(1))[0]),
        "volume": plain(volume.summary),
        "where_poses_were_taken": plain(near),
        "correlated": [{"one": first, "other": second, "r": r} for first, second, r in pairs],
        **attributes(observability, "rank", "condition", "indices"),
        "parameters": len(observability.names),
        "tried": nearby,
    }


def prior_rows(prior: PriorMetrics) -> list[dict[str, Any]]:
    """A prior, group by group; the standard deviation in mm or rad, or in steps of 1 mm and 1 mrad."""
    return rows_of(
        group=prior.groups,
        learned=prior.learned,
        parameters=prior.parameters,
        sd=prior.sd,
        unit=prior.units,
        effective_parameters=prior.effective,
        supported=prior.supported,
    )


def prior_sentence(row: Mapping[str, Any]) -> str:
    """One group of a prior in words."""
    spent = f"{row['effective_parameters']:.1f} of {pluralise(row['parameters'], 'parameter')} determined by the data"
    if not row["supported"]:
        return (
            f"{row['group']}: learned; the data support no deviation from the mean, so the group is treated as "
            f"exact; {spent}"
        )
    scale, unit = people_read(row["unit"])
    deviation = f"{row['sd'] * scale:.3g} {unit}".strip()
    return f"{row['group']}: {'learned' if row['learned'] else 'given'}, {deviation}; {spent}"


def shared_rows(shared: SharedErrors) -> list[dict[str, Any]]:
    """Shared errors, kind by kind, with their standard deviations in mm, or in the unit of coefficients."""
    return rows_of(kind=shared.kinds, sd=shared.sd, unit=shared.units)


def cross_validation_summary(validation: CrossValidation, of_sockets: bool = True) -> dict[str, Any]:
    """All groups together, and every group, the most improbable first; mm."""
    chances = [min(filter(math.isfinite, chances), default=math.nan) for chances in validation.probabilities]
    rows = []
    for i, (label, group, chance) in enumerate(zip(validation.labels, validation.groups, chances, strict=True)):
        error, u = (rms(values) for values in (group.length_error, group.length_u))
        names = {"members": "sockets", "rms_mm": "rms", "rms_predicted_mm": "rms_predicted"}
        names |= {"rms_nominal_mm": "rms_nominal"}
        row = {"group": label, **attributes(group, "poses", "converged", **names), "lengths": len(group.length_error)}
        row |= {"length_error_rms_mm": plain(error), "length_u_mm": plain(u)}
        rows.append(row | {"probability": plain(chance), "disagrees": i in validation.disagreeing})
    names = {"rms_mm": "rms", "rms_predicted_mm": "rms_predicted", "length_error_rms_mm": "length_rms"}
    names |= {"rms_nominal_mm": "rms_nominal"}
    by_chance = sorted(rows, key=lambda row: 2.0 if row["probability"] is None else row["probability"])
    return {
        "groups": len(rows),
        "of_sockets": of_sockets,
        **attributes(validation, "excess", "surprising", **names, length_u_mm="length_u"),
        "left_out": by_chance,
    }


def agreement_row(agreement: Agreement) -> dict[str, Any]:
    """Errors found and predicted of some poses, mm and in standard deviations."""
    names = {"rms_mm": "rms", "rms_predicted_mm": "predicted", "rms_angle_rad": "rms_angle"}
    return attributes(agreement, "reduced_chi", "probability", "rms_px", poses="count", **names)
