"""Who calibrated what for whom, as people stated it; and what they left out."""

from typing import Any

from .parts import Section, Table, text

_NOT = "not stated"
# Part, key, and what it is called.
_ALWAYS = (
    ("laboratory", "name", "Laboratory"),
    ("customer", "name", "Customer"),
    ("item", "manufacturer", "Manufacturer of the arm"),
    ("item", "model", "Model"),
    ("item", "serial_number", "Serial number"),
    ("certificate", "number", "Certificate number"),
    ("certificate", "begin", "Begun on"),
    ("certificate", "end", "Ended on"),
)
_WHERE_STATED = (
    ("laboratory", "code", "Accreditation of the laboratory"),
    ("item", "name", "Arm"),
    ("item", "customer_number", "Customer's number of the arm"),
    ("certificate", "received", "Received on"),
    ("certificate", "issued", "Issued on"),
    ("certificate", "place", "Place"),
    ("certificate", "remarks", "Remarks"),
)
_ADDRESS = ("street", "postal_code", "city", "country", "email", "phone")


def about_section(about: Any, tested: bool) -> Section:
    """What an `about.About` states, and which of the usual entries it leaves out. ``tested``: acceptance tests stand in the report."""
    rows = [[text(title), text(_stated(about, part, key) or _NOT)] for part, key, title in _ALWAYS]
    for part, title in (("laboratory", "Address of the laboratory"), ("customer", "Address of the customer")):
        address = ", ".join(filter(None, (_stated(about, part, key) for key in _ADDRESS)))
        rows += [[text(title), text(address)]] if address else []
    rows += [
        [text(title), text(value)]
        for part, key, title in _WHERE_STATED
        if (value := _stated(about, part, key)) and value != "other"
    ]
    rows.append([text("Temperature"), text(_temperature(about.certificate))])
    for person in about.person:
        words = ", ".join(filter(None, (person.name, person.role, "signs the certificate" if person.main_signer else "")))
        rows.append([text("Responsible"), text(words)])
    if not about.person:
        rows.append([text("Responsible"), text(_NOT)])
    for reference in about.reference:
        number = reference.certificate_number
        parts = (
            reference.name,
            reference.manufacturer,
            reference.model,
            reference.serial_number,
            number and f"certificate {number}",
        )
        rows.append([text("Reference artefact"), text(", ".join(filter(None, parts)))])
    if not about.reference:
        rows.append([text("Reference artefacts"), text(_NOT)])
    if about.conformity is not None:
        source = "" if tested else " (stated by the laboratory; this file holds no acceptance test)"
        words = f"{about.conformity.verdict}: {about.conformity.specification}; {about.conformity.decision_rule}{source}"
        rows.append([text("Statement of conformity"), text(words)])
    return Section("about", "Laboratory, customer and item", [Table("As stated", ("", ""), rows)])


def _stated(about: Any, part: str, key: str) -> str:
    value = getattr(getattr(about, part), key)
    return "" if value is None else str(value)


def _temperature(certificate: Any) -> str:
    if certificate.temperature_celsius is None:
        return _NOT
    u = certificate.temperature_u_celsius
    return f"{certificate.temperature_celsius:g} °C" + ("" if u is None else f", u = {u:g} °C")
