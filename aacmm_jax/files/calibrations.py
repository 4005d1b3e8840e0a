"""Calibrations in HDF5: the capture, the arms of each stage, parameters with their covariance, and cross-validation."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.left_out import CrossValidation, LeftOut
from ..calibration.record import CalibrationRecord
from ..calibration.results import NoisyEncoder
from ..core.errors import InputError
from ..kinematics.arm import parameter_unit
from ..uncertainty.covariance import NOISE_MODELS
from .calibration_observations import observed_of, observed_tables, other_poses_of, removed_of
from .calibration_prior import prior_metrics_of, prior_tables
from .calibration_shared import component_tables, components_of, shared_errors_of, shared_tables
from .captures import (
    arm_table,
    linear_encoder_attribute,
    noise_of_attributes,
    recording_attributes,
    recording_of,
    recording_tables,
    specification_of,
)
from .hdf5 import (
    Stored,
    Table,
    Variable,
    axes,
    check_sense,
    columns,
    names_in,
    need,
    read_tables,
    undamaged,
    write_tables,
)
from .sense import check_calibration

# Of cross-validation; earlier files have none.
_DEGREES_OF_FREEDOM = {
    "rms_degrees_of_freedom": "effective degrees of freedom of rms_predicted",
    "length_degrees_of_freedom": "effective degrees of freedom of length_u",
    "noise_degrees_of_freedom": "degrees of freedom of the noise behind both",
}


def save_calibration(
    path: str | os.PathLike, record: CalibrationRecord, summary: Mapping[str, Any] | None = None
) -> None:
    """Write a calibration with its capture and arms to HDF5, whole or not at all.

    Args:
        path: the file to write.
        record: the calibration, from `calibration.record_of`.
        summary: what ``aacmm show`` prints of the file; without it, ``show`` computes it, which takes longer.

    Raises:
        InputError: the file cannot be written, or a name holds a character that no file can hold.

    Example:
        >>> aj.files.save_calibration("calibration.h5", record)
        >>> print(aj.files.load_calibration("calibration.h5").names == record.names)
        True
    """
    tables = recording_tables(record.recording)
    tables["stage1_arm"] = arm_table(record.stage1)
    tables["calibrated_arm"] = arm_table(record.calibrated)
    tables["parameters"] = _parameter_table(record)
    evaluations = record.evaluations()
    tables["sockets"] = _socket_table(record, evaluations)
    reference = tables["reference"].variables
    for stage, evaluation in evaluations.items():
        reference[f"measured_{stage}"] = Variable(
            ("length",), np.asarray(evaluation.measured), "mm", f"length as the {stage} arm measures it"
        )
    if record.validation is not None:
        tables["cross_validation"] = _validation_table(record)
    if record.sampled is not None:
        tables["monte_carlo"] = _sampled_table(record)
    if record.noisy_encoders:
        tables["noisy_encoders"] = _noisy_table(record)
    tables |= observed_tables(record) | prior_tables(record) | shared_tables(record.shared)
    tables |= component_tables(record.components)
    attributes = recording_attributes(record.recording) | {
        "robust": record.robust,
        "sampled_says": record.sampled_says,
        "method": record.method,
        "held": list(record.held) or "",
        "hold": record.hold,
        "scale_set_by": list(record.scale_set_by) or "",
        "scale_k": record.k,
        "scale_u": record.u_k,
        "scale_surplus": record.surplus_k,
        "encoder_arcsec": np.asarray(record.noise.encoder_arcsec),
        "linear_encoder_mm": linear_encoder_attribute(record.noise),
        "seating_mm": float(record.noise.seating),
        "form": record.noise_model,
        "freedom": record.degrees_of_freedom,
        "misfit": record.reduced_chi,
        "steps": record.steps,
        "converged": record.converged,
        "reason": record.reason,
        "divided": record.divided,
        "against_division": list(record.against_division) or "",
    }
    write_tables(path, "calibration", tables, attributes, summary=summary)


def load_calibration(path: str | os.PathLike) -> CalibrationRecord:
    """Read a calibration that `save_calibration` or ``aacmm calibrate`` wrote.

    Args:
        path: the file to read.

    Returns:
        The record, with arrays in mm and rad.

    Raises:
        InputError: the file does not exist, is damaged, is not of this kind, or was written by a newer version.

    Example:
        >>> aj.files.save_calibration("calibration.h5", record)
        >>> loaded = aj.files.load_calibration("calibration.h5")
        >>> print(loaded.calibrated.arm.position(q).round(3))
        [  36.875  104.896 -111.419]
    """
    stored = read_tables(path, ("calibration",))
    need(path, stored.tables, "stage1_arm", "calibrated_arm", "parameters")
    with undamaged(path):
        record = _record(path, stored)
        check_calibration(path, stored)
        check_sense(path, {"the noise model is unknown": record.noise_model not in NOISE_MODELS})
        return record


def _record(path: str | os.PathLike, stored: Stored) -> CalibrationRecord:
    table, attributes = stored.tables["parameters"], stored.attributes
    if "observed" not in stored.tables:
        raise InputError(
            f"{path} is from an earlier version, which did not store residuals and positions of sockets; calibrate "
            "again from its capture."
        )
    entries = ("parameter", "lower", "upper", "active_stage1", "active", "covariance", "determined", "open")
    need(path, table, *entries, of="entry")
    recording, names = recording_of(path, stored), tuple(str(name) for name in table["parameter"])
    return CalibrationRecord(
        recording=recording,
        stage1=specification_of(path, stored, "stage1_arm"),
        calibrated=specification_of(path, stored, "calibrated_arm"),
        names=names,
        held=names_in(attributes.get("held")),
        hold=attributes.get("hold"),
        scale_set_by=names_in(attributes.get("scale_set_by")),
        lower=table["lower"],
        upper=table["upper"],
        active_stage1=table["active_stage1"],
        active=table["active"],
        covariance=table["covariance"],
        determined=table["determined"].astype(bool),
        open=table["open"],
        noise=noise_of_attributes(attributes),
        noise_model=attributes["form"],
        degrees_of_freedom=float(attributes["freedom"]),
        reduced_chi=attributes.get("misfit"),
        k=attributes["scale_k"],
        u_k=attributes["scale_u"],
        method=attributes["method"],
        steps=attributes["steps"],
        converged=bool(attributes["converged"]),
        reason=attributes["reason"],
        observed=observed_of(path, stored, recording.capture),
        # Of versions before 5 only joint solves are read.
        divided=bool(attributes.get("divided", False)),
        against_division=names_in(attributes.get("against_division")),
        validation=_validation_of(stored),
        sampled=stored.tables.get("monte_carlo"),
        sampled_says=attributes.get("sampled_says"),
        robust=attributes.get("robust"),
        others=other_poses_of(stored),
        removed=removed_of(stored),
        prior=prior_metrics_of(stored),
        noisy_encoders=_noisy_of(stored),
        shared=shared_errors_of(stored),
        components=components_of(stored),
        surplus_k=float(attributes.get("scale_surplus", 0.0)),
    )


def _parameter_table(record: CalibrationRecord) -> Table:
    names = list(record.names)
    units = [parameter_unit(record.calibrated.arm, name) for name in names]
    both, square = "see unit", ("parameter", "parameter_2")
    variables = columns("parameter", parameter=(names, "", "free parameter"))
    variables |= columns("parameter_2", parameter_2=(names, "", "free parameter, second axis of the covariance"))
    variables |= columns(
        "parameter",
        unit=(units, "", "unit of the parameter"),
        lower=(record.lower, both, "lower bound of the identification"),
        upper=(record.upper, both, "upper bound of the identification"),
        u=(np.sqrt(np.diag(record.covariance)), both, "standard uncertainty"),
        active_stage1=(record.active_stage1, "1", "-1 on the lower bound, +1 on the upper, in stage 1"),
        active=(record.active, "1", "-1 on the lower bound, +1 on the upper"),
        determined=(record.determined.astype(np.int8), "1", "0: only a combination is determined"),
    )
    variables["open"] = Variable(square, record.open, "1", "projector onto what is not determined, in mm and mrad")
    variables["covariance"] = Variable(square, record.covariance, "products of units", "covariance")
    for stage, vector in record.vectors().items():
        variables[stage] = Variable(("parameter",), vector, both, f"value in the {stage} arm")
    return Table(variables)


def _noisy_table(record: CalibrationRecord) -> Table:
    both, of = "rad, or mm of a prismatic joint", record.noisy_encoders
    return Table(
        columns(
            "noisy_encoder",
            noisy_encoder=([one.joint for one in of], "1", "joint whose encoder is noisier than expected"),
            expected=([one.expected for one in of], both, "standard deviation as given, or as that of the others"),
            found=([one.found for one in of], both, "standard deviation, estimated"),
            u=([one.u for one in of], both, "its standard uncertainty"),
            probability=([one.probability for one in of], "1", "of such residuals, were the noise as expected"),
        )
    )


def _noisy_of(stored: Stored) -> tuple[NoisyEncoder, ...]:
    table = stored.tables.get("noisy_encoders")
    if table is None:
        return ()
    rows = zip(*(table[name] for name in ("noisy_encoder", "expected", "found", "u", "probability")), strict=True)
    return tuple(NoisyEncoder(int(joint), *map(float, numbers)) for joint, *numbers in rows)


def _validation_table(record: CalibrationRecord) -> Table:
    assert record.validation is not None
    groups = record.validation.groups
    sockets = [(number, name) for number, group in enumerate(groups) for name in group.sockets]
    number = np.concatenate([np.full(len(group.length_error), i) for i, group in enumerate(groups)])
    errors, u = (np.concatenate([getattr(group, key) for group in groups]) for key in ("length_error", "length_u"))
    by_group = columns(
        "group",
        group=([", ".join(group.sockets) for group in groups], "", "sockets left out together, as a label"),
        poses=([group.poses for group in groups], "1", "poses in sockets with more than one"),
        rms=([group.rms for group in groups], "mm", "RMS distance from the centroid, found"),
        rms_predicted=([group.rms_predicted for group in groups], "mm", "the same, predicted"),
        converged=([int(group.converged) for group in groups], "1", "1: the others converged"),
        rms_degrees_of_freedom=(
            [group.degrees_of_freedom[0] for group in groups],
            "1",
            "effective degrees of freedom of rms_predicted",
        ),
        length_degrees_of_freedom=(
            [group.degrees_of_freedom[1] for group in groups],
            "1",
            "effective degrees of freedom of length_u",
        ),
        noise_degrees_of_freedom=(
            [group.noise_degrees_of_freedom for group in groups],
            "1",
            "degrees of freedom of the noise behind both",
        ),
    )
    by_socket = columns(
        "left_out_socket",
        left_out_socket=([name for _, name in sockets], "", "sockets left out, one after the other"),
        socket_number=([i for i, _ in sockets], "1", "which group a socket is of, from 0"),
    )
    by_length = columns(
        "left_out_length",
        left_out_length=(np.arange(len(number)), "1", "lengths left out, one after the other"),
        number=(number, "1", "which group a length is of, from 0"),
        length_error=(errors, "mm", "error of a length left out"),
        length_u=(u, "mm", "its standard uncertainty, predicted"),
    )
    return Table(by_group | by_socket | by_length)


def _validation_of(stored: Stored) -> CrossValidation | None:
    table = stored.tables.get("cross_validation")
    if table is None:
        return None
    groups = []
    for i, label in enumerate(table["group"]):
        of = table["number"] == i
        # Files of version 0.1 and before have the sockets in the label only.
        names = table["left_out_socket"][table["socket_number"] == i] if "left_out_socket" in table else names_in(label)
        groups.append(
            LeftOut(
                sockets=tuple(map(str, names)),
                poses=int(table["poses"][i]),
                rms=float(table["rms"][i]),
                rms_predicted=float(table["rms_predicted"][i]),
                length_error=table["length_error"][of],
                length_u=table["length_u"][of],
                converged=bool(table["converged"][i]),
                **{name: float(table[name][i]) for name in _DEGREES_OF_FREEDOM if name in table},
            )
        )
    return CrossValidation(tuple(groups))


def _sampled_table(record: CalibrationRecord) -> Table:
    assert record.sampled is not None
    texts = {
        "estimate": "value of the calibration",
        "u": "standard uncertainty by Monte Carlo",
        "low": "lower end of the Monte Carlo interval",
        "high": "upper end of the Monte Carlo interval",
        "linear_u": "standard uncertainty by the law of propagation",
    }
    quantities = [str(x) for x in record.sampled["quantity"]]
    values = {name: (record.sampled[name], "mm or rad; 1 for k", text) for name, text in texts.items()}
    agrees = np.asarray(record.sampled["agrees"], dtype=np.int8)
    return Table(
        columns(
            "quantity",
            quantity=(quantities, "", "parameter, k or length"),
            **values,
            agrees=(agrees, "1", "1: the linear interval is within the tolerance of JCGM 101"),
        )
    )


def _socket_table(record: CalibrationRecord, evaluations: Mapping[str, Evaluation]) -> Table:
    capture = record.recording.capture
    variables = columns("socket", socket=(list(capture.names), "", "socket")) | axes("axis of the base frame")
    variables |= columns("socket", poses=(list(capture.sizes), "1", "number of poses"))
    for stage, evaluation in evaluations.items():
        metrics = evaluation.repeatability
        for name, values, text in (
            ("de", metrics.socket_de, "mean distance from the centroid"),
            ("deltam", metrics.socket_deltam, "largest half range"),
            ("rms", metrics.socket_rms, "root mean square distance from the centroid"),
        ):
            variables[f"{name}_{stage}"] = Variable(("socket",), np.asarray(values), "mm", f"{text}, {stage} arm")
        if stage == "calibrated":
            variables["centroid"] = Variable(("socket", "axis"), np.asarray(metrics.centroids), "mm", "socket position")
    return Table(variables)
