"""Calibrations in HDF5: the capture, the arms of each stage, parameters with their covariance, and what tests them."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..calibration.agreement import CrossValidation, LeftOut
from ..calibration.evaluation import Evaluation
from ..calibration.pose_table import PoseResiduals
from ..calibration.record import CalibrationRecord, Removed
from ..calibration.results import NoisyEncoder, ObservedMetrics, PriorMetrics
from ..data.capture import Capture
from ..kinematics.arm import parameter_unit
from ..model.observed import Observed
from ..uncertainty.covariance import NOISE_MODELS, SharedErrors
from ..uncertainty.degrees_of_freedom import Components
from . import schema
from .captures import arm_table, recording_attributes, recording_of, recording_tables, specification_of
from .hdf5 import Stored, StoredTable, Table, Variable, check_sense, columns, undamaged, write_tables
from .records import Within, records_within, rows_in, rows_table, table_of, tables_within, values_in
from .stored_checks import read_checked

# Records within the record that are a table each.
_RECORDS = {
    "sampled": Within("monte_carlo", dict, schema.SAMPLED),
    "held_out": Within("held_out_poses", PoseResiduals, schema.HELD_OUT),
    "prior": Within("prior", PriorMetrics, schema.PRIOR),
    "shared": Within("shared_errors", SharedErrors, schema.SHARED_ERRORS),
    "components": Within("components", Components, schema.COMPONENTS),
    "removed": Within("removed", Removed, schema.REMOVED, "removed_group"),
    "noisy_encoders": Within("noisy_encoders", NoisyEncoder, schema.NOISY_ENCODERS, "noisy_encoder"),
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
    tables, evaluations = recording_tables(record.recording), record.evaluations()
    measured = {
        f"measured_{stage}": (np.asarray(evaluation.measured), "mm", f"length measured by the {stage} arm")
        for stage, evaluation in evaluations.items()
    }
    tables["reference"] = Table(tables["reference"].variables | columns("length", **measured))
    tables |= {"stage1_arm": arm_table(record.stage1), "calibrated_arm": arm_table(record.calibrated)}
    tables["parameters"] = _parameter_table(record)
    tables["sockets"] = _socket_table(record.recording.capture, evaluations)
    if record.validation is not None:
        tables["cross_validation"] = rows_table("group", record.validation.groups, schema.LEFT_OUT)
    tables |= _observed_tables(record.observed, Observed.of(record.recording.capture, None).blocks)
    tables |= tables_within(record, _RECORDS)
    write_tables(path, "calibration", tables, recording_attributes(record.recording), summary=summary)


def load_calibration(path: str | os.PathLike) -> CalibrationRecord:
    """Read a calibration that `save_calibration` or ``aacmm calibrate`` wrote.

    Args:
        path: the file to read.

    Returns:
        The record, with arrays in mm and rad.

    Raises:
        InputError: the file does not exist, is damaged, is not of this kind, or was written by another version.

    Example:
        >>> aj.files.save_calibration("calibration.h5", record)
        >>> loaded = aj.files.load_calibration("calibration.h5")
        >>> print(loaded.calibrated.arm.position(q).round(3))
        [  36.875  104.896 -111.419]
    """
    with undamaged(path):
        stored = read_checked(path, ("calibration",))
        tables, recording = stored.tables, recording_of(path, stored)
        groups, table = tables.get("cross_validation"), tables["parameters"]
        record = CalibrationRecord(
            recording=recording,
            stage1=specification_of(path, stored, "stage1_arm"),
            calibrated=specification_of(path, stored, "calibrated_arm"),
            observed=_observed_of(path, stored, recording.capture),
            validation=None if groups is None else CrossValidation(rows_in(LeftOut, schema.LEFT_OUT, "group", groups)),
            **records_within(stored.tables, _RECORDS),
            **values_in(CalibrationRecord, schema.CALIBRATION, table, table.attributes),
        )
        check_sense(path, {"the noise model is unknown": record.noise_model not in NOISE_MODELS})
        return record


def _parameter_table(record: CalibrationRecord) -> Table:
    table = table_of(record, schema.CALIBRATION)
    units = [parameter_unit(record.calibrated.arm, name) for name in record.names]
    derived = {
        "unit": (units, "", "unit of the parameter"),
        "u": (np.sqrt(np.diag(record.covariance)), "see unit", "standard uncertainty"),
    }
    derived |= {stage: (vector, "see unit", f"value in the {stage} arm") for stage, vector in record.vectors().items()}
    return Table(table.variables | columns("parameter", **derived), table.attributes)


def _socket_table(capture: Capture, evaluations: Mapping[str, Evaluation]) -> Table:
    """For other programs: what the arms of all stages do in every socket."""
    variables = columns(
        "socket", socket=(capture.names, "", "socket"), poses=(np.array(capture.sizes), "1", "number of poses")
    )
    for stage, evaluation in evaluations.items():
        metrics = evaluation.repeatability
        for name, values, says in (
            ("de", metrics.socket_de, "mean distance from the centroid"),
            ("deltam", metrics.socket_deltam, "largest half range"),
            ("rms", metrics.socket_rms, "RMS distance from the centroid"),
        ):
            variables |= columns("socket", **{f"{name}_{stage}": (np.asarray(values), "mm", f"{says}, {stage} arm")})
    centroids = np.asarray(evaluations["calibrated"].repeatability.centroids)
    return Table(variables | {"centroid": Variable(("socket", "axis"), centroids, "mm", "socket position")})


def _observed_tables(observed: ObservedMetrics, units: Mapping[str, tuple[str, ...]]) -> dict[str, Table]:
    metrics = observed.rms_before, observed.rms_after, observed.reduced_chi
    rows = zip(observed.names, observed.kinds, *metrics, observed.weights, strict=True)
    agreements = [dict(zip(schema.OBSERVED, row, strict=True)) for row in rows]
    table = rows_table("observation", agreements, schema.OBSERVED)
    attributes = {"sigma_mm": float(observed.sigma), "reduced_chi_of_all": float(observed.reduced_chi_of_all)}
    numbers = [
        {"part": name, "unit": unit, "value": float(value), "covariance": np.asarray(row)}
        for name, values in observed.geometry.items()
        for unit, value, row in zip(units[name], values, observed.geometry_covariance[name], strict=True)
    ]
    geometry = rows_table("number", numbers, schema.GEOMETRY)
    return {"observed": table._replace(attributes=attributes), "geometry": geometry}


def _observed_of(path: str | os.PathLike, stored: Stored, capture: Capture) -> ObservedMetrics:
    """How sockets and other observations of a file agree with its arm."""
    table: StoredTable = stored.tables["observed"]
    geometry = stored.tables["geometry"]
    rows = rows_in(dict, schema.OBSERVED, "observation", table)
    numbers = rows_in(dict, schema.GEOMETRY, "number", geometry)
    names = dict.fromkeys(geometry["part"])
    parts = {name: [number for number in numbers if number["part"] == name] for name in names}
    expected = (*capture.names, *(observation.name for observation in capture.observations))
    sizes = {name: len(units) for name, units in Observed.of(capture, None).blocks.items()}
    square = all(len(number["covariance"]) == len(part) for part in parts.values() for number in part)
    check_sense(
        path,
        {
            "the results and the observations have different names": tuple(row["name"] for row in rows) != expected,
            "the estimated geometry does not belong to the observations": {
                name: len(part) for name, part in parts.items()
            }
            != sizes,
            "the covariance of the estimated geometry has the wrong size": not square,
            "a weight is above 1": np.any(table["weights"] > 1),
        },
    )
    return ObservedMetrics(
        names=expected,
        kinds=tuple(row["kind"] for row in rows),
        rms_before=table["rms_before"],
        rms_after=table["rms_after"],
        reduced_chi=table["reduced_chi"],
        reduced_chi_of_all=np.asarray(table.attributes["reduced_chi_of_all"]),
        sigma=np.asarray(table.attributes["sigma_mm"]),
        geometry={name: np.array([number["value"] for number in part]) for name, part in parts.items()},
        geometry_covariance={name: np.array([number["covariance"] for number in part]) for name, part in parts.items()},
        weights=tuple(row["weights"] for row in rows),
    )
