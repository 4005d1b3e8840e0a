"""The administrative data of a report: laboratory, customer, item, persons, dates; and what is not stated of them."""

from collections.abc import Iterable

from ..files.administrative_data import NOT_STATED, AdministrativeData

# Group of rows: part, key, title, and whether it is shown where it is not stated.
_ROWS: dict[str, tuple[tuple[str, str, str, bool], ...]] = {
    "Laboratory": (("laboratory", "name", "Name", True), ("laboratory", "code", "Accreditation", False)),
    "Customer": (("customer", "name", "Name", True),),
    "Item": (
        ("item", "name", "Arm", False),
        ("item", "manufacturer", "Manufacturer", True),
        ("item", "model", "Model", True),
        ("item", "serial_number", "Serial number", True),
        ("item", "customer_number", "Customer's number", False),
    ),
    "Calibration": (
        ("certificate", "number", "Certificate number", True),
        ("certificate", "received", "Received on", False),
        ("certificate", "begin", "Begun on", True),
        ("certificate", "end", "Ended on", True),
        ("certificate", "issued", "Issued on", False),
        ("certificate", "place", "Place", False),
        ("certificate", "remarks", "Remarks", False),
    ),
}
_ADDRESS = ("street", "postal_code", "city", "country", "email", "phone")

Groups = list[tuple[str, list[tuple[str, str]]]]


def administrative_groups(given: AdministrativeData, tested: bool) -> Groups:
    """The administrative data of a report, in the order in which they are read: groups of titles and values.

    Args:
        given: What was stated.
        tested: Whether the report contains acceptance tests.
    """

    def stated(part: str, key: str) -> str:
        value = getattr(getattr(given, part), key)
        return "" if value is None or value == "other" else str(value)

    groups: Groups = []
    for group, rows in _ROWS.items():
        values = [(title, stated(part, key), always) for part, key, title, always in rows]
        shown = [(title, value or NOT_STATED) for title, value, always in values if always or value]
        if group in ("Laboratory", "Customer"):
            address = _joined(stated(group.lower(), key) for key in _ADDRESS)
            shown += [("Address", address)] if address else []
        groups.append((group, shown))
    temperature, u = given.certificate.temperature_celsius, given.certificate.temperature_u_celsius
    celsius = NOT_STATED if temperature is None else f"{temperature:g} °C" + ("" if u is None else f", u = {u:g} °C")
    groups[-1][1].append(("Temperature", celsius))
    artefacts = [
        _joined((part.name, part.manufacturer, part.model, part.serial_number,
                 part.certificate_number and f"certificate {part.certificate_number}"))
        for part in given.reference
    ]  # fmt: skip
    persons = [
        _joined((person.name, person.role, "signs the certificate" if person.main_signer else None))
        for person in given.person
    ]
    for title, lines in (("Reference artefacts", artefacts), ("Responsible", persons)):
        groups.append((title, [("", line) for line in lines or [NOT_STATED]]))
    if given.conformity is not None:
        source = "" if tested else " (stated by the laboratory; this file contains no acceptance test)"
        conformity = given.conformity
        words = f"{conformity.verdict}: {conformity.specification}; {conformity.decision_rule}{source}"
        groups.append(("Statement of conformity", [("", words)]))
    return groups


def _joined(parts: Iterable[str | None]) -> str:
    return ", ".join(filter(None, parts))
