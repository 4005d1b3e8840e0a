"""The parts of a certificate on observations besides sockets and lengths: their certified values and residuals."""

import math
from collections.abc import Iterator
from xml.etree.ElementTree import Element

import numpy as np

from ..data.observations.observation import AbstractObservation, Quantity, certified_quantities
from ..diagnostics.pose_residuals import ObservationResiduals, rms
from ..files.administrative_data import NOT_STATED
from .xml_elements import MILLIMETRE, ONE, RADIAN, add, add_english, add_real, add_text

_DECIMALS = {MILLIMETRE: 5, ONE: 3, RADIAN: 8}  # of residuals, which have no uncertainty
_UNITS = {"mm": MILLIMETRE, "rad": RADIAN, "1": ONE}


def texts_of(observation: AbstractObservation) -> Iterator[str]:
    """Every text of an observation that a certificate holds, given by people."""
    yield observation.name
    yield from (quantity.says for quantity in certified_quantities(observation))


def add_observation_equipment(
    parent: Element, residuals: tuple[ObservationResiduals, ...], any_artefact_stated: bool
) -> None:
    """The artefacts and instruments behind observations, with certified values and uncertainties as they were given.

    Observations with the same certified values are of one artefact in several placements, which is named once.
    """
    equipments: dict[tuple, tuple[list[str], str, list[Quantity]]] = {}
    for one in residuals:
        quantities = list(certified_quantities(one.observation))
        key = tuple((quantity.says, *np.asarray(quantity.values).tolist(), quantity.u) for quantity in quantities)
        measured = _measured(one)
        if quantities or measured:
            where = (one.observation.kind, *(key if quantities and not measured else (one.observation.name,)))
            names, _, _ = equipments.setdefault(where, ([], one.observation.kind, [*quantities, *measured]))
            names.append(one.observation.name)
    for names, kind, quantities in equipments.values():
        equipment = add(parent, "measuringEquipment")
        add_text(equipment, "name", ", ".join(names))
        unknown = "" if any_artefact_stated else f"; artefact or instrument: {NOT_STATED}"
        add_english(equipment, "description", f"Kind of observation: {kind}{unknown}")
        element = add(equipment, "measuringEquipmentQuantities")
        for quantity in quantities:
            _add_quantity(element, quantity)


def _measured(one: ObservationResiduals) -> list[Quantity]:
    """The standard uncertainties of what an instrument measured, as they were given."""
    found = []
    if one.u > 0:
        found.append(Quantity("standard uncertainty of a measured coordinate or distance", np.array([one.u]), "mm"))
    if one.u_angle is not None:
        says = "standard uncertainty of a measured orientation about each axis"
        found.append(Quantity(says, np.array([one.u_angle]), "rad"))
    return found


def _add_quantity(parent: Element, quantity: Quantity) -> None:
    """A quantity, with each of its numbers on its own."""
    count = len(quantity.values)
    labels = [""] if count == 1 else [f", {axis}" for axis in ("xyz" if count == 3 else range(1, count + 1))]
    for label, value in zip(labels, quantity.values, strict=True):
        element = add(parent, "measuringEquipmentQuantity")
        add_text(element, "name", quantity.says + label)
        if quantity.u == 0:
            add_english(element, "description", "Taken as exact")
        add_real(element, float(value), _UNITS[quantity.unit], quantity.u or None)


def add_observations(
    data: Element, residuals: tuple[ObservationResiduals, ...], distances: tuple[np.ndarray, ...], left: bool
) -> None:
    """Residuals of every observation: in mm, and of the calibrated arm (``left``) in standard deviations too."""
    for number, (one, of_arm) in enumerate(zip(residuals, distances, strict=True), start=1):
        row = add(data, "list")
        # Numbered, since names may contain anything.
        add_text(row, "name", f"{number}: {one.observation.name}")
        target = f", tip: {one.observation.target}" if one.observation.target else ""
        add_text(row, "description", f"{one.observation.kind}{target}; {len(one.distance)} poses")
        values = [("RMS residual", rms(one.distance if left else of_arm), MILLIMETRE)]
        if left:
            values.append(("RMS residual in standard deviations", rms(one.normalised), ONE))
            if one.angle is not None:
                values.append(("RMS residual of the orientation", rms(one.angle), RADIAN))
        for name, value, unit in values:
            if math.isfinite(value):
                quantity = add(row, "quantity")
                add_english(quantity, "name", name)
                add_real(quantity, value, unit, decimals=_DECIMALS[unit])
