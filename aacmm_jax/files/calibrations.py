"""A finished calibration as plain tables: made from a `Calibration`, written to and read from HDF5."""

import os
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..calibration.evaluation import Evaluation, evaluate
from ..calibration.results import Calibration, CrossValidation, LeftOut
from ..data.noise import Noise
from ..data.recording import ArmSpecification, Recording
from ..kinematics.parameters import Parameters, is_length
from ..solver.levenberg_marquardt import Reason
from . import storage
from .captures import arm_table, recording_attributes, recording_of, recording_tables, specification_of
from .storage import Table, Variable

STAGES = ("nominal", "stage1", "calibrated")


class CalibrationRecord(NamedTuple):
    """Everything a calibration file holds. Arrays are NumPy's, in mm and rad, in the order of ``names``."""

    recording: Recording  # what it was identified from, and the nominal arm
    stage1: ArmSpecification
    calibrated: ArmSpecification
    names: tuple[str, ...]  # free parameters
    held: tuple[str, ...]
    hold: str | None  # held in stage 1 only
    lower: np.ndarray
    upper: np.ndarray
    active_stage1: np.ndarray  # -1, 0, +1
    active: np.ndarray
    covariance: np.ndarray
    determined: np.ndarray  # False where only a combination with others is determined
    open: np.ndarray  # projector onto the directions that are not determined, in steps of 1 mm and 1 mrad
    stretch: np.ndarray  # of lengths that were held but divided by k: see covariance.Covariance
    noise: Noise  # given, or estimated from the residuals
    form: str  # what the covariance takes errors of tips for: covariance.FORMS
    freedom: float  # degrees of freedom behind the covariance
    misfit: float | None  # residuals in units of the given noise
    k: float
    u_k: float
    method: str
    steps: int
    converged: bool
    reason: str
    validation: CrossValidation | None = None
    # Monte Carlo after JCGM 101: quantity, estimate, u, low, high, linear_u, agrees; and what to say of it.
    sampled: Mapping[str, np.ndarray] | None = None
    sampled_says: str | None = None

    @property
    def fixed_by_one_length(self) -> bool:
        """Whether a single length fixed the scale exactly, so that its own error as left is zero by construction: no measurement."""
        return self.method == "two-stage" and len(self.recording.capture.lengths) == 1

    def vectors(self) -> dict[str, np.ndarray]:
        """Free parameters of the nominal arm, after stage 1, and calibrated; and of the true arm of a simulation."""
        space = Parameters(self.recording.nominal.arm, self.names)
        arms = {"nominal": self.recording.nominal.arm, "stage1": self.stage1.arm, "calibrated": self.calibrated.arm}
        if self.recording.true is not None:
            arms["true"] = self.recording.true.arm
        return {stage: np.asarray(space.vector(arm)) for stage, arm in arms.items()}

    def evaluations(self) -> dict[str, Evaluation]:
        """The three arms on the capture that was identified from."""
        arms = {"nominal": self.recording.nominal.arm, "stage1": self.stage1.arm, "calibrated": self.calibrated.arm}
        return {stage: evaluate(arm, self.recording.capture) for stage, arm in arms.items()}


def record_of(calibration: Calibration, recording: Recording) -> CalibrationRecord:
    """The record of a calibration, given the recording that it was identified from."""
    nominal, stage1 = recording.nominal, calibration.stage1
    result = calibration.result if bool(stage1.converged) else stage1.result
    return CalibrationRecord(
        recording=recording,
        stage1=nominal._replace(arm=stage1.arm, name=f"{nominal.name}, after stage 1"),
        calibrated=nominal._replace(arm=calibration.arm, name=f"{nominal.name}, calibrated"),
        names=calibration.space.names,
        held=calibration.space.held,
        hold=stage1.hold,
        lower=np.asarray(calibration.bounds.lower),
        upper=np.asarray(calibration.bounds.upper),
        active_stage1=np.asarray(stage1.active),
        active=np.asarray(calibration.active),
        covariance=np.asarray(calibration.covariance),
        determined=np.asarray(calibration.determined),
        open=np.asarray(calibration.spread.open),
        stretch=np.asarray(calibration.spread.stretch),
        noise=calibration.noise,
        form=calibration.form,
        freedom=calibration.freedom,
        misfit=None if stage1.misfit is None else float(stage1.misfit),
        k=float(calibration.scale.value),
        u_k=float(calibration.scale.u),
        method=calibration.method,
        steps=int(calibration.steps),
        converged=bool(calibration.converged),
        reason=Reason[result],
    )


def save_calibration(path: str | os.PathLike, record: CalibrationRecord) -> None:
    """Write a calibration with its capture and arms to HDF5, whole or not at all."""
    tables = recording_tables(record.recording)
    tables["stage1_arm"] = arm_table(record.stage1)
    tables["calibrated_arm"] = arm_table(record.calibrated)
    tables["parameters"] = _parameter_table(record)
    tables["sockets"] = _socket_table(record)
    reference = tables["reference"].variables
    for stage, evaluation in record.evaluations().items():
        reference[f"measured_{stage}"] = Variable(
            ("length",), np.asarray(evaluation.measured), "mm", f"length as the {stage} arm measures it"
        )
    if record.validation is not None:
        tables["cross_validation"] = _validation_table(record)
    if record.sampled is not None:
        tables["monte_carlo"] = _sampled_table(record)
    attributes = recording_attributes(record.recording) | {
        "sampled_says": record.sampled_says,
        "method": record.method,
        "held": ",".join(record.held),
        "hold": record.hold,
        "scale_k": record.k,
        "scale_u": record.u_k,
        "encoder_arcsec": np.asarray(record.noise.encoder_arcsec),
        "seating_mm": float(record.noise.seating),
        "form": record.form,
        "freedom": record.freedom,
        "stretch_variance": float(record.stretch[-1]),
        "misfit": record.misfit,
        "steps": record.steps,
        "converged": record.converged,
        "reason": record.reason,
    }
    storage.write_tables(path, "calibration", tables, attributes)


def load_calibration(path: str | os.PathLike) -> CalibrationRecord:
    """Read a calibration. Raises `InputError` where the file is missing, damaged, foreign, newer or no calibration."""
    stored = storage.read_tables(path, ("calibration",))
    storage.need(path, stored.tables, "stage1_arm", "calibrated_arm", "parameters")
    with storage.undamaged(path):
        return _record(path, stored)


def _record(path: str | os.PathLike, stored: storage.Stored) -> CalibrationRecord:
    table, attributes = stored.tables["parameters"], stored.attributes
    storage.need(path, table, "parameter", "lower", "upper", "active_stage1", "active", "covariance", "determined", of="entry")
    return CalibrationRecord(
        recording=recording_of(path, stored),
        stage1=specification_of(path, stored, "stage1_arm"),
        calibrated=specification_of(path, stored, "calibrated_arm"),
        names=tuple(str(name) for name in table["parameter"]),
        held=tuple(attributes["held"].split(",")) if attributes.get("held") else (),
        hold=attributes.get("hold"),
        lower=table["lower"],
        upper=table["upper"],
        active_stage1=table["active_stage1"],
        active=table["active"],
        covariance=table["covariance"],
        determined=table["determined"].astype(bool),
        # Files of version 0.1 and before have none of the following.
        open=table.get("open", np.zeros_like(table["covariance"])),
        stretch=np.append(table.get("stretch", np.zeros(len(table["covariance"]))), attributes.get("stretch_variance", 0.0)),
        noise=Noise(
            encoder_arcsec=np.squeeze(np.atleast_1d(attributes.get("encoder_arcsec", 0.0))),
            seating=attributes.get("seating_mm", 0.0),
        ),
        form=attributes.get("form", "common"),
        freedom=float(attributes.get("freedom", np.inf)),
        misfit=attributes.get("misfit"),
        k=attributes["scale_k"],
        u_k=attributes["scale_u"],
        method=attributes["method"],
        steps=attributes["steps"],
        converged=bool(attributes["converged"]),
        reason=attributes["reason"],
        validation=_validation_of(stored),
        sampled=stored.tables.get("monte_carlo"),
        sampled_says=attributes.get("sampled_says"),
    )


def _parameter_table(record: CalibrationRecord) -> Table:
    names = list(record.names)
    units = ["mm" if is_length(name) else "rad" for name in names]
    both = "mm or rad, see unit"
    variables = {
        "parameter": Variable(("parameter",), names, "", "free parameter"),
        "parameter_2": Variable(("parameter_2",), names, "", "free parameter, second axis of the covariance"),
        "unit": Variable(("parameter",), units, "", "unit of the parameter"),
        "lower": Variable(("parameter",), record.lower, both, "lower bound of the identification"),
        "upper": Variable(("parameter",), record.upper, both, "upper bound of the identification"),
        "u": Variable(("parameter",), np.sqrt(np.diag(record.covariance)), both, "standard uncertainty"),
        "active_stage1": Variable(
            ("parameter",), record.active_stage1, "1", "-1 on the lower bound, +1 on the upper, in stage 1"
        ),
        "active": Variable(("parameter",), record.active, "1", "-1 on the lower bound, +1 on the upper"),
        "determined": Variable(("parameter",), record.determined.astype(np.int8), "1", "0: only a combination is determined"),
        "stretch": Variable(("parameter",), record.stretch[:-1], both, "covariance with the relative error of held lengths"),
        "open": Variable(
            ("parameter", "parameter_2"), record.open, "1", "projector onto what is not determined, in mm and mrad"
        ),
        "covariance": Variable(("parameter", "parameter_2"), record.covariance, "products of units", "covariance"),
    }
    for stage, vector in record.vectors().items():
        variables[stage] = Variable(("parameter",), vector, both, f"value in the {stage} arm")
    return Table(variables)


def _validation_table(record: CalibrationRecord) -> Table:
    assert record.validation is not None
    groups = record.validation.groups
    number = np.concatenate([np.full(len(group.length_error), i) for i, group in enumerate(groups)])
    variables = {
        "group": Variable(("group",), [",".join(group.sockets) for group in groups], "", "sockets left out together"),
        "poses": Variable(("group",), [group.poses for group in groups], "1", "poses in sockets with more than one"),
        "rms": Variable(("group",), [group.rms for group in groups], "mm", "RMS distance from the centroid, found"),
        "rms_predicted": Variable(("group",), [group.rms_predicted for group in groups], "mm", "the same, predicted"),
        "converged": Variable(("group",), [int(group.converged) for group in groups], "1", "1: the others converged"),
        "left_out_length": Variable(("left_out_length",), np.arange(len(number)), "1", "lengths left out, one after the other"),
        "number": Variable(("left_out_length",), number, "1", "which group a length is of, from 0"),
        "length_error": Variable(
            ("left_out_length",), np.concatenate([group.length_error for group in groups]), "mm", "error of a length left out"
        ),
        "length_u": Variable(
            ("left_out_length",),
            np.concatenate([group.length_u for group in groups]),
            "mm",
            "its standard uncertainty, predicted",
        ),
    }
    return Table(variables)


def _validation_of(stored: storage.Stored) -> CrossValidation | None:
    table = stored.tables.get("cross_validation")
    if table is None:
        return None
    groups = []
    for i, names in enumerate(table["group"]):
        of = table["number"] == i
        groups.append(
            LeftOut(
                sockets=tuple(str(names).split(",")),
                poses=int(table["poses"][i]),
                rms=float(table["rms"][i]),
                rms_predicted=float(table["rms_predicted"][i]),
                length_error=table["length_error"][of],
                length_u=table["length_u"][of],
                converged=bool(table["converged"][i]),
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
    variables = {
        "quantity": Variable(("quantity",), [str(x) for x in record.sampled["quantity"]], "", "parameter, k or length")
    }
    for name, text in texts.items():
        variables[name] = Variable(("quantity",), record.sampled[name], "mm or rad; 1 for k", text)
    agrees = np.asarray(record.sampled["agrees"], dtype=np.int8)
    variables["agrees"] = Variable(("quantity",), agrees, "1", "1: the linear interval is within the tolerance of JCGM 101")
    return Table(variables)


def _socket_table(record: CalibrationRecord) -> Table:
    capture = record.recording.capture
    variables = {
        "socket": Variable(("socket",), list(capture.names), "", "socket"),
        "axis": Variable(("axis",), ["x", "y", "z"], "", "axis of the base frame"),
        "poses": Variable(("socket",), list(capture.sizes), "1", "number of poses"),
    }
    for stage, evaluation in record.evaluations().items():
        figures = evaluation.repeatability
        for name, values, text in (
            ("de", figures.socket_de, "mean distance from the centroid"),
            ("deltam", figures.socket_deltam, "largest half range"),
            ("rms", figures.socket_rms, "root mean square distance from the centroid"),
        ):
            variables[f"{name}_{stage}"] = Variable(("socket",), np.asarray(values), "mm", f"{text}, {stage} arm")
        if stage == "calibrated":
            variables["centroid"] = Variable(("socket", "axis"), np.asarray(figures.centroids), "mm", "socket position")
    return Table(variables)
