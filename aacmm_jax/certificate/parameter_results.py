"""The Denavit-Hartenberg parameters of a certificate, with their uncertainties and covariances."""

import math
from xml.etree.ElementTree import Element

import numpy as np

from ..calibration.record import CalibrationRecord
from ..kinematics.arm import parameter_names, parameter_unit
from ..kinematics.parameters import Parameters
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.coverage import LEVEL
from . import xml_elements as xml
from .xml_elements import MILLIMETRE, ONE, RADIAN, element, named, real, result, text

_SIMPLE, _SQUARED = (MILLIMETRE, RADIAN), r"\tothe{2}"  # units that are squared as one
_D_SI = {
    "mm": MILLIMETRE,
    "rad": RADIAN,
    "m": r"\metre",
    "kN": r"\kilo\newton",
    "K": r"\kelvin",
    "px": ONE,
}  # D-SI has no pixel


def parameters_result(record: CalibrationRecord, stage: str, uncertainty: Uncertainty) -> Element:
    """The parameters of a stage; of the calibrated ones also U."""
    factors = dict(zip(record.names, map(float, uncertainty.factor(LEVEL)), strict=True))
    recording, calibrated = record.recording, stage == "calibrated"
    specification = record.calibrated if calibrated else recording.nominal
    arm = (recording.as_found if stage == "as_found" and recording.as_found is not None else specification).arm
    names, quantities = parameter_names(arm), []
    for name, value in zip(names, np.asarray(Parameters(arm, names).vector()).tolist(), strict=True):
        note, u = _note_and_uncertainty(record, name) if calibrated else ("", None)
        unit = in_d_si(parameter_unit(arm, name))
        # Angles are printed in degrees: with two digits in rad, the two in degrees would be those of rounding.
        measured = real(value, unit, u, factors.get(name), digits=4 if unit == RADIAN else 2)
        quantities.append(named("quantity", name, measured, says=note))
    corrections = (
        " Each joint correction adds its coefficient times a known function of the readings to theta (to d for a "
        "prismatic joint). The gravity components give the direction of gravity in the base frame."
    )
    return result(
        "Denavit-Hartenberg parameters",
        "Standard convention; the transform of a joint is Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta). The probe is "
        "the tip in the last frame." + ("" if arm.corrections is None else corrections),
        *quantities,
    )


def in_d_si(unit: str) -> str:
    """A unit such as "rad/(kN m)" in D-SI, with factors below the stroke as negative powers."""
    above, _, below = unit.partition("/")
    factors = [] if above == "1" else [_D_SI[above]]
    return "".join([*factors, *(_D_SI[factor] + r"\tothe{-1}" for factor in below.strip("()").split())]) or ONE


def covariance_result(record: CalibrationRecord) -> Element | None:
    """The covariance matrix of the parameters that have an uncertainty of their own, a row each."""
    index = [i for i, name in enumerate(record.names) if _note_and_uncertainty(record, name)[1] is not None]
    if not index:
        return None
    units = [in_d_si(parameter_unit(record.calibrated.arm, record.names[i])) for i in index]
    covariance = np.asarray(record.covariance)[np.ix_(index, index)]
    rows = []
    for i, values, unit in zip(index, covariance.tolist(), units, strict=True):
        products = [f"{unit}{_SQUARED}" if unit == other and unit in _SIMPLE else unit + other for other in units]
        numbers = xml.si("valueXMLList", " ".join(f"{value:.8g}" for value in values))
        row = xml.si("realListXMLList", numbers, xml.si("unitXMLList", " ".join(products)))
        rows.append(element("quantity", text("name", record.names[i]), row))
    return result(
        "Covariance matrix",
        "Covariances of the parameters that have an uncertainty of their own: one row per parameter, columns in the "
        "same order. The diagonal contains the squares of the standard uncertainties. Expanded uncertainties elsewhere "
        "in the certificate are rounded; use this matrix for quantities that depend on several parameters.",
        named("list", "Covariance", rows),
    )


def _note_and_uncertainty(record: CalibrationRecord, name: str) -> tuple[str, float | None]:
    """A note on a calibrated parameter, and its standard uncertainty if it has one of its own."""
    if name not in record.names:
        return "Not identified: fixed at its nominal value", None
    i = record.names.index(name)
    u = float(np.sqrt(record.covariance[i, i]))
    if record.active[i]:
        bound = f"On its {'lower' if record.active[i] < 0 else 'upper'} bound"
        return f"{bound}, so it has no uncertainty of its own", None
    if not (record.determined[i] and is_known(u)):
        return "Determined only together with other parameters, so it has no uncertainty of its own", None
    return "", u


def is_known(u: float) -> bool:
    """Whether an uncertainty is one: finite and above 0."""
    return math.isfinite(u) and u > 0
