"""The measurement results of a certificate: the same readings as found, with the nominal arm, and as left, with the calibrated one."""

import math
from collections.abc import Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..data.capture import ReferenceLength
from ..files.administrative_data import NOT_STATED, AdministrativeData, Reference
from ..kinematics.arm import Arm, is_length, parameter_names
from ..kinematics.parameters import Parameters
from .xml import CELSIUS, LEVEL, MILLIMETRE, ONE, RADIAN, identifications, ours, put, real, software, theirs

_METHODS = {"two-stage": "from repeatability first, and then the scale from the lengths", "joint": "from both jointly"}
_FIGURES = {
    "DE": "Mean distance of the tip from its mean position in the socket",
    "Deltam": "Largest half range of a coordinate of the tip in a socket",
    "RMS": "Root mean square distance of the tip from its mean position in the socket",
}


class _Stage(NamedTuple):
    name: str
    status: str
    says: str
    arm: Arm
    evaluation: Evaluation


def add_results(results: Element, record: CalibrationRecord, about: AdministrativeData, command: str) -> None:
    """Add both measurement results of a calibration."""
    evaluations = record.evaluations()
    found = "The readings, evaluated with the nominal parameters, those before the calibration."
    left = "The same readings, evaluated with the calibrated parameters, which were identified from them."
    for stage in (
        _Stage("As found", "beforeAdjustment", found, record.recording.nominal.arm, evaluations["nominal"]),
        _Stage("As left", "afterAdjustment", left, record.calibrated.arm, evaluations["calibrated"]),
    ):
        _measurement(put(results, "measurementResult"), record, about, stage, command)


def uncertainty_says(record: CalibrationRecord) -> str:
    """How the uncertainties were evaluated, and what they do not hold."""
    noise = "as it was given" if record.noise_model == "given" else "as estimated from the residuals"
    freedom = "infinitely many" if math.isinf(record.degrees_of_freedom) else f"{record.degrees_of_freedom:.4g}"
    return (
        f"Expanded uncertainties are standard uncertainties times {uncertainty_of(record).factor(LEVEL):.4g}, the coverage factor of "
        f"Student's t for {freedom} degrees of freedom and a coverage probability of {LEVEL:.0%}. They follow, by the law of propagation "
        f"of uncertainty, from the noise of the readings, {noise}, and from the uncertainty of the reference lengths. They hold for "
        "each parameter alone; the parameters are correlated. Errors that the Denavit-Hartenberg model does not describe are not in them."
    )


def _measurement(
    measurement: Element, record: CalibrationRecord, about: AdministrativeData, stage: _Stage, command: str
) -> None:
    ours(measurement, "name", stage.name)
    ours(measurement, "description", stage.says)
    lengths = record.recording.capture.lengths
    _methods(put(measurement, "usedMethods"), record)
    software(measurement, "usedSoftware", command)
    _equipment(put(measurement, "measuringEquipments"), lengths, about.reference)
    _conditions(put(measurement, "influenceConditions"), about, stage)
    results = put(measurement, "results")
    factor = uncertainty_of(record).factor(LEVEL)
    _repeatability(results, stage)
    fixed = stage.name == "As left" and record.fixed_by_one_length
    _lengths(results, lengths, stage, factor, fixed)
    _parameters(results, record, stage, factor)
    if stage.name == "As left":
        _scale(results, record, factor)


def _methods(methods: Element, record: CalibrationRecord) -> None:
    capture = record.recording.capture
    method = put(methods, "usedMethod")
    ours(method, "name", "Identification of Denavit-Hartenberg parameters")
    ours(
        method,
        "description",
        f"The tip rested in {len(capture.sizes)} sockets, in {sum(capture.sizes)} poses; the sockets are {len(capture.lengths)} reference "
        f"lengths apart. Parameters were identified by bounded least squares, {_METHODS.get(record.method, record.method)}: those with which "
        "the positions of the tip in each socket agree best, and the distances between the sockets with the reference lengths.",
    )
    method = put(methods, "usedMethod", refers="basic_methodMeasurementUncertainty")
    ours(method, "name", "Evaluation of measurement uncertainty")
    ours(method, "description", uncertainty_says(record))
    put(method, "norm", "JCGM 100:2008")


def _equipment(equipments: Element, lengths: Sequence[ReferenceLength], references: Sequence[Reference]) -> None:
    for reference in references:
        equipment = put(equipments, "measuringEquipment")
        theirs(equipment, "name", reference.name)
        if reference.manufacturer is not None:
            theirs(put(equipment, "manufacturer"), "name", reference.manufacturer)
        if reference.model is not None:
            put(equipment, "model", reference.model)
        serial = ("manufacturer", reference.serial_number, "Serial number")
        identifications(equipment, [serial, ("other", reference.certificate_number, "Number of its calibration certificate")])
    equipment = put(equipments, "measuringEquipment")
    ours(equipment, "name", "Reference lengths")
    if not references:
        ours(equipment, "description", f"Artefact: {NOT_STATED}")
    quantities = put(equipment, "measuringEquipmentQuantities")
    for number, length in enumerate(lengths, start=1):
        quantity = put(quantities, "measuringEquipmentQuantity")
        theirs(quantity, "name", _length_name(number, length))
        real(quantity, float(length.value), MILLIMETRE, float(length.u))


def _conditions(conditions: Element, about: AdministrativeData, stage: _Stage) -> None:
    condition, given = put(conditions, "influenceCondition"), about.certificate
    ours(condition, "name", "Ambient temperature")
    put(condition, "status", stage.status)
    data = put(condition, "data")
    if given.temperature_celsius is None:
        ours(data, "text", NOT_STATED)
        return
    quantity = put(data, "quantity")
    ours(quantity, "name", "Ambient temperature")
    real(quantity, given.temperature_celsius, CELSIUS, given.temperature_u_celsius)


def _result(results: Element, name: str, says: str) -> Element:
    result = put(results, "result")
    ours(result, "name", name)
    ours(result, "description", says)
    return put(result, "data")


def _repeatability(results: Element, stage: _Stage) -> None:
    spread = stage.evaluation.repeatability
    figures = {"DE": float(spread.de), "Deltam": float(spread.deltam), "RMS": float(spread.rms)}
    if not all(map(math.isfinite, figures.values())):  # one pose in every socket
        return
    data = _result(results, "Repeatability", "Over all sockets with more than one pose.")
    for name, value in figures.items():
        quantity = put(data, "quantity")
        ours(quantity, "name", name)
        ours(quantity, "description", _FIGURES[name])
        real(quantity, value, MILLIMETRE)


def _length_name(number: int, length: ReferenceLength) -> str:
    """Numbered: names of sockets may hold anything, so two pairs of them can read alike."""
    return f"{number}: {length.start} - {length.end}"


def _lengths(results: Element, lengths: Sequence[ReferenceLength], stage: _Stage, factor: float, fixed: bool) -> None:
    data = _result(
        results,
        "Reference lengths",
        "An error is the measured value minus the calibrated one; its uncertainty is that of the calibrated value and of the scatter of "
        "the poses at both ends.",
    )
    columns = (np.asarray(column) for column in (stage.evaluation.measured, stage.evaluation.error, stage.evaluation.u))
    for number, (length, measured, error, error_u) in enumerate(zip(lengths, *columns, strict=True), start=1):
        row = put(data, "list")
        theirs(row, "name", _length_name(number, length))
        entries = [
            ("calibrated value", "basic_referenceValue", length.value, float(length.u)),
            ("measured value", "basic_measuredValue", measured, math.nan),
            ("error", "basic_measurementError", error, float(error_u)),
        ]
        if fixed:  # zero by construction: no measurement
            ours(
                row,
                "description",
                "This length fixed the scale, so that the arm measures it as calibrated by construction; no error was measured.",
            )
            entries = entries[:1]
        for name, refers, value, u in entries:
            quantity = put(row, "quantity", refers=refers)
            ours(quantity, "name", name)
            if name == "calibrated value" and u == 0:
                ours(quantity, "description", "Taken as exact")
            real(quantity, float(value), MILLIMETRE, u if _is_known(u) else None, factor)


def _parameters(results: Element, record: CalibrationRecord, stage: _Stage, factor: float) -> None:
    data = _result(
        results,
        "Denavit-Hartenberg parameters",
        "Standard convention; of one joint: Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta). The probe is the tip in the last frame.",
    )
    for name, value in _values(stage.arm).items():
        words, u = ("", None) if stage.name == "As found" else _knowledge(record, name)
        quantity = put(data, "quantity")
        ours(quantity, "name", name)
        if words:
            ours(quantity, "description", words)
        real(quantity, value, MILLIMETRE if is_length(name) else RADIAN, u, factor)


def _values(arm: Arm) -> dict[str, float]:
    """All parameters of an arm by name, mm and rad."""
    names = parameter_names(arm)
    return dict(zip(names, map(float, np.asarray(Parameters(arm, names).vector())), strict=True))


def _knowledge(record: CalibrationRecord, name: str) -> tuple[str, float | None]:
    """What is to be said of a calibrated parameter, and its standard uncertainty, where it has one of its own."""
    if name not in record.names:
        return "Not identified: held at its nominal value", None
    i = record.names.index(name)
    u = float(np.sqrt(record.covariance[i, i]))
    if record.active[i]:
        bound = f"On its {'lower' if record.active[i] < 0 else 'upper'} bound"
        return f"{bound}, so it has no uncertainty of its own", None
    if not (record.determined[i] and _is_known(u)):
        return "Determined only together with other parameters, so it has no uncertainty of its own", None
    return "", u


def _scale(results: Element, record: CalibrationRecord, factor: float) -> None:
    says = "Reference lengths as the arm measured them before its scale was set, over their calibrated values."
    quantity = put(_result(results, "Scale", says), "quantity")
    ours(quantity, "name", "k")
    real(quantity, record.k, ONE, record.u_k if _is_known(record.u_k) else None, factor)


def _is_known(u: float) -> bool:
    return math.isfinite(u) and u > 0
