"""The measurement results of a certificate: the same readings as found (nominal arm) and as left (calibrated arm)."""

import math
from collections.abc import Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from ..calibration.evaluation import Evaluation
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..data.capture import ReferenceLength
from ..diagnostics.pose_residuals import ObservationResiduals, distances_of, observation_residuals
from ..files.administrative_data import NOT_STATED, AdministrativeData, Reference
from ..kinematics.arm import Arm, parameter_names, parameter_unit
from ..kinematics.parameters import Parameters
from ..summaries.calibration import prior_rows, prior_sentence
from ..summaries.observations import less_weight
from ..uncertainty.arm_uncertainty import Uncertainty
from .observation_results import add_observation_equipment, add_observations
from .xml_elements import (
    CELSIUS,
    LEVEL,
    MILLIMETRE,
    ONE,
    RADIAN,
    add,
    add_english,
    add_identifications,
    add_real,
    add_row,
    add_software,
    add_text,
    decimals_of,
)

_METHODS = {"two-stage": "from repeatability first, and then the scale from the lengths", "joint": "from both jointly"}
_METRICS = {
    "DE": "Mean distance of the tip from its mean position in the socket",
    "Deltam": "Largest half range of a coordinate of the tip in a socket",
    "RMS": "Root mean square distance of the tip from its mean position in the socket",
}


_DECIMALS = 5  # of mm without an uncertainty
_SIMPLE, _SQUARED = (MILLIMETRE, RADIAN), r"\tothe{2}"  # units that are squared as one


class _Stage(NamedTuple):
    name: str
    status: str
    description: str
    arm: Arm
    evaluation: Evaluation


_D_SI = {"mm": MILLIMETRE, "rad": RADIAN, "m": r"\metre", "kN": r"\kilo\newton", "K": r"\kelvin"}


def add_results(
    parent: Element, record: CalibrationRecord, administrative_data: AdministrativeData, command: str
) -> None:
    """Add both measurement results of a calibration."""
    evaluations, residuals = record.evaluations(), observation_residuals(record)
    found = "The readings, evaluated with the nominal parameters, those before the calibration."
    left = "The same readings, evaluated with the calibrated parameters, which were identified from them."
    for stage in (
        _Stage("As found", "beforeAdjustment", found, record.recording.nominal.arm, evaluations["nominal"]),
        _Stage("As left", "afterAdjustment", left, record.calibrated.arm, evaluations["calibrated"]),
    ):
        measurement = add(parent, "measurementResult")
        _add_measurement(measurement, record, administrative_data, stage, command, residuals)


def uncertainty_statement(record: CalibrationRecord) -> str:
    """How the uncertainties were evaluated, and what they do not include."""
    noise = "as it was given" if record.noise_model == "given" else "as estimated from the residuals"
    sources = "uncertainty of the reference lengths"
    if record.recording.capture.observations:
        sources = "uncertainties of what was measured and certified"
    if record.prior is not None:
        groups = ". ".join(map(prior_sentence, prior_rows(record.prior)))
        sources += (
            ", and from what was known of the parameters beforehand, as normal distributions (standard deviation of "
            f"each group: {groups})"
        )
    model = "Denavit-Hartenberg model"
    if record.calibrated.arm.corrections is not None:
        model += " with the joint corrections below"
    return (
        "Expanded uncertainties are standard uncertainties times the coverage factor that is stated with each: of "
        f"Student's t for a coverage probability of {LEVEL:.0%} and the effective degrees of freedom of that quantity, "
        "which follow from what each part of its variance rests on. "
        f"They follow, by the law of propagation of uncertainty, from the noise of the readings, {noise}, and from the "
        f"{sources}. They apply to each parameter alone; the parameters are correlated, as the covariance matrix says. "
        "Expanded uncertainties have two digits, and values are rounded to them. "
        f"Errors that the {model} does not describe are not included."
    )


def _add_measurement(
    measurement: Element,
    record: CalibrationRecord,
    given: AdministrativeData,
    stage: _Stage,
    command: str,
    residuals: tuple[ObservationResiduals, ...],
) -> None:
    add_english(measurement, "name", stage.name)
    add_english(measurement, "description", stage.description)
    capture = record.recording.capture
    lengths = capture.lengths
    _add_methods(add(measurement, "usedMethods"), record, residuals)
    add_software(measurement, "usedSoftware", command)
    equipments = add(measurement, "measuringEquipments")
    _add_references(equipments, given.reference)
    if lengths:
        _add_length_equipment(equipments, lengths, any_artefact_stated=bool(given.reference))
    add_observation_equipment(equipments, residuals, any_artefact_stated=bool(given.reference))
    _add_conditions(add(measurement, "influenceConditions"), given, stage)
    results = add(measurement, "results")
    uncertainty = uncertainty_of(record)
    _add_repeatability(results, stage)
    left = stage.name == "As left"
    if lengths:
        _add_lengths(results, lengths, stage, uncertainty, fixed_scale=left and record.fixed_by_one_length)
    if not record.sockets_alone:
        data = _add_result(results, "Observations", "Distances of the tip from the geometry of each observation.")
        add_observations(data, residuals, distances_of(capture, stage.evaluation), left)
    _add_parameters(results, record, stage, uncertainty)
    if left:
        _add_covariance(results, record)
    if left and not math.isnan(record.k):
        _add_scale(results, record, uncertainty)


def _add_methods(parent: Element, record: CalibrationRecord, residuals: tuple[ObservationResiduals, ...]) -> None:
    capture = record.recording.capture
    poses = f"Number of sockets in which the tip was seated: {len(capture.sizes)}; of poses: {sum(capture.sizes)}; of "
    lengths = f"reference lengths between sockets: {len(capture.lengths)}"
    squares = "Parameters were identified by bounded least squares"
    words = (
        f"{poses}{lengths}. {squares}, {_METHODS[record.final_method]}: those with which the positions of "
        "the tip in each socket agree best, and the distances between the sockets with the reference lengths."
    )
    if not record.sockets_alone:
        others = len(capture.observations)
        words = (
            f"{poses}{lengths}; of other observations: {others}, of their poses: "
            f"{len(capture.readings) - sum(capture.sizes)}. {squares} together with the unknown geometry of each "
            "observation, weighted by the uncertainties of what was measured and by the scatter of the tip."
        )
    if record.robust:
        words += (
            f" The robust loss '{record.robust}' took weight from poses with large residuals; "
            f"{len(less_weight(residuals))} have half of their weight or less."
        )
    if record.removed:
        groups = ", ".join(f"{removed.kind} {removed.group}" for removed in record.removed)
        words += (
            f" Left out, because they contradict the rest by an F test: {groups}; see the statements on data left out."
        )
    method = add(parent, "usedMethod")
    add_english(method, "name", "Identification of Denavit-Hartenberg parameters")
    add_english(method, "description", words)
    method = add(parent, "usedMethod", ref_type="basic_methodMeasurementUncertainty")
    add_english(method, "name", "Evaluation of measurement uncertainty")
    add_english(method, "description", uncertainty_statement(record))
    add(method, "norm", "JCGM 100:2008")


def _add_references(parent: Element, references: Sequence[Reference]) -> None:
    for reference in references:
        equipment = add(parent, "measuringEquipment")
        add_text(equipment, "name", reference.name)
        if reference.manufacturer is not None:
            add_text(add(equipment, "manufacturer"), "name", reference.manufacturer)
        if reference.model is not None:
            add(equipment, "model", reference.model)
        serial = ("manufacturer", reference.serial_number, "Serial number")
        certificate = ("other", reference.certificate_number, "Number of its calibration certificate")
        add_identifications(equipment, [serial, certificate])


def _add_length_equipment(parent: Element, lengths: Sequence[ReferenceLength], any_artefact_stated: bool) -> None:
    equipment = add(parent, "measuringEquipment")
    add_english(equipment, "name", "Reference lengths")
    if not any_artefact_stated:
        add_english(equipment, "description", f"Artefact: {NOT_STATED}")
    quantities = add(equipment, "measuringEquipmentQuantities")
    for number, length in enumerate(lengths, start=1):
        quantity = add(quantities, "measuringEquipmentQuantity")
        add_text(quantity, "name", _length_name(number, length))
        add_real(quantity, float(length.value), MILLIMETRE, float(length.u))


def _add_conditions(parent: Element, given: AdministrativeData, stage: _Stage) -> None:
    condition = add(parent, "influenceCondition")
    add_english(condition, "name", "Ambient temperature")
    add(condition, "status", stage.status)
    data = add(condition, "data")
    if given.certificate.temperature_celsius is None:
        add_english(data, "text", NOT_STATED)
        return
    quantity = add(data, "quantity")
    add_english(quantity, "name", "Ambient temperature")
    add_real(quantity, given.certificate.temperature_celsius, CELSIUS, given.certificate.temperature_u_celsius)


def _add_result(parent: Element, name: str, description: str) -> Element:
    result = add(parent, "result")
    add_english(result, "name", name)
    add_english(result, "description", description)
    return add(result, "data")


def _add_repeatability(results: Element, stage: _Stage) -> None:
    found = stage.evaluation.repeatability
    metrics = {"DE": float(found.de), "Deltam": float(found.deltam), "RMS": float(found.rms)}
    if not all(map(math.isfinite, metrics.values())):  # one pose in every socket
        return
    data = _add_result(results, "Repeatability", "Over all sockets with more than one pose.")
    for name, value in metrics.items():
        quantity = add(data, "quantity")
        add_english(quantity, "name", name)
        add_english(quantity, "description", _METRICS[name])
        add_real(quantity, value, MILLIMETRE, decimals=_DECIMALS)


def _length_name(number: int, length: ReferenceLength) -> str:
    """Numbered, since different pairs of sockets can read alike: their names may contain anything."""
    return f"{number}: {length.start} - {length.end}"


def _add_lengths(
    results: Element, lengths: Sequence[ReferenceLength], stage: _Stage, uncertainty: Uncertainty, fixed_scale: bool
) -> None:
    data = _add_result(
        results,
        "Reference lengths",
        "An error is the measured value minus the calibrated one; its uncertainty is that of the calibrated value and "
        "of the scatter of the poses at both ends.",
    )
    columns = [np.asarray(column) for column in (stage.evaluation.measured, stage.evaluation.error, stage.evaluation.u)]
    stated = np.array([float(length.u) for length in lengths])
    columns.append(uncertainty.expanded_by_scatter(columns[2], stated, LEVEL))
    for number, (length, measured, error, error_u, expanded) in enumerate(zip(lengths, *columns, strict=True), start=1):
        factor = float(expanded / error_u) if _is_known(float(error_u)) else None
        row = add(data, "list")
        add_text(row, "name", _length_name(number, length))
        decimals = decimals_of(float(expanded)) if factor is not None else _DECIMALS
        # The reference has the uncertainty of its own certificate, not that of this calibration's coverage factor.
        values = [
            ("calibrated value", "basic_referenceValue", length.value, float(length.u), None),
            ("measured value", "basic_measuredValue", measured, math.nan, decimals),
            ("error", "basic_measurementError", error, float(error_u), decimals),
        ]
        if fixed_scale:
            add_english(
                row,
                "description",
                "This length fixed the scale, so that the arm measures it as calibrated by construction; no error was "
                "measured.",
            )
            values = values[:1]
        for name, ref_type, value, u, digits in values:
            quantity = add(row, "quantity", ref_type=ref_type)
            add_english(quantity, "name", name)
            if name == "calibrated value" and u == 0:
                add_english(quantity, "description", "Taken as exact")
            scale = None if digits is None else factor
            add_real(quantity, float(value), MILLIMETRE, u if _is_known(u) else None, scale, digits)


def _add_parameters(results: Element, record: CalibrationRecord, stage: _Stage, uncertainty: Uncertainty) -> None:
    data = _add_result(
        results,
        "Denavit-Hartenberg parameters",
        "Standard convention; of one joint: Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta). The probe is the tip in the "
        "last frame."
        + (
            ""
            if stage.arm.corrections is None
            else " To theta (d of a prismatic joint) each joint correction adds its "
            "coefficient times a known function of the readings; gravity is its direction in the base frame."
        ),
    )
    factors = dict(zip(record.names, map(float, uncertainty.factor(LEVEL)), strict=True))
    for name, value in _values(stage.arm).items():
        note, u = "", None
        factor = factors.get(name)
        if stage.name == "As left":
            note, u = _note_and_uncertainty(record, name)
        quantity = add(data, "quantity")
        add_english(quantity, "name", name)
        if note:
            add_english(quantity, "description", note)
        add_real(quantity, value, _in_d_si(parameter_unit(stage.arm, name)), u, factor)


def _in_d_si(unit: str) -> str:
    """A unit such as "rad/(kN m)" in D-SI, with factors below the stroke as negative powers."""
    above, _, below = unit.partition("/")
    factors = [] if above == "1" else [_D_SI[above]]
    return "".join([*factors, *(_D_SI[one] + r"\tothe{-1}" for one in below.strip("()").split())]) or ONE


def _add_covariance(results: Element, record: CalibrationRecord) -> None:
    """The covariance matrix of the parameters that have an uncertainty of their own, a row each."""
    own = [i for i, name in enumerate(record.names) if _note_and_uncertainty(record, name)[1] is not None]
    if not own:
        return
    data = _add_result(
        results,
        "Covariance matrix",
        "Of the parameters with an uncertainty of their own, a row each, columns in the same order. The diagonal has "
        "the squares of the standard uncertainties. Expanded uncertainties elsewhere are rounded; what is computed of "
        "several parameters needs this table.",
    )
    table = add(data, "list")
    add_english(table, "name", "Covariance")
    units = [_in_d_si(parameter_unit(record.calibrated.arm, record.names[i])) for i in own]
    for row, unit in zip(own, units, strict=True):
        products = [f"{unit}{_SQUARED}" if unit == other and unit in _SIMPLE else unit + other for other in units]
        add_row(table, record.names[row], np.asarray(record.covariance)[row, own].tolist(), products)


def _values(arm: Arm) -> dict[str, float]:
    """All parameters of an arm by name, mm and rad."""
    names = parameter_names(arm)
    return dict(zip(names, map(float, np.asarray(Parameters(arm, names).vector())), strict=True))


def _note_and_uncertainty(record: CalibrationRecord, name: str) -> tuple[str, float | None]:
    """A note on a calibrated parameter, and its standard uncertainty if it has one of its own."""
    if name not in record.names:
        return "Not identified: fixed at its nominal value", None
    i = record.names.index(name)
    u = float(np.sqrt(record.covariance[i, i]))
    if record.active[i]:
        bound = f"On its {'lower' if record.active[i] < 0 else 'upper'} bound"
        return f"{bound}, so it has no uncertainty of its own", None
    if not (record.determined[i] and _is_known(u)):
        return "Determined only together with other parameters, so it has no uncertainty of its own", None
    return "", u


def _add_scale(results: Element, record: CalibrationRecord, uncertainty: Uncertainty) -> None:
    description = "Reference lengths as the arm measured them before its scale was set, over their calibrated values."
    quantity = add(_add_result(results, "Scale", description), "quantity")
    add_english(quantity, "name", "k")
    u = record.u_k if _is_known(record.u_k) else None
    add_real(quantity, record.k, ONE, u, None if u is None else uncertainty.expanded_k(LEVEL) / u)


def _is_known(u: float) -> bool:
    return math.isfinite(u) and u > 0
