"""The section of administrative data: laboratory, customer, item, persons and dates, and what is not stated of them."""

from ..files.administrative_data import NOT_STATED, AdministrativeData
from .elements import ReportTable, Section, text_cell

# Part, key and title: shown always, and shown if stated.
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
_IF_STATED = (
    ("laboratory", "code", "Accreditation of the laboratory"),
    ("item", "name", "Arm"),
    ("item", "customer_number", "Customer's number of the arm"),
    ("certificate", "received", "Received on"),
    ("certificate", "issued", "Issued on"),
    ("certificate", "place", "Place"),
    ("certificate", "remarks", "Remarks"),
)
_ADDRESS = ("street", "postal_code", "city", "country", "email", "phone")


def administrative_section(given: AdministrativeData, tested: bool) -> Section:
    """The administrative data of a report; ``tested``: whether the report contains acceptance tests."""

    def stated(part: str, key: str) -> str:
        value = getattr(getattr(given, part), key)
        return "" if value is None else str(value)

    rows = [(title, stated(part, key) or NOT_STATED) for part, key, title in _ALWAYS]
    for part in ("laboratory", "customer"):
        address = ", ".join(filter(None, (stated(part, key) for key in _ADDRESS)))
        rows += [(f"Address of the {part}", address)] if address else []
    rows += [(title, value) for part, key, title in _IF_STATED if (value := stated(part, key)) and value != "other"]
    temperature, u = given.certificate.temperature_celsius, given.certificate.temperature_u_celsius
    words = NOT_STATED if temperature is None else f"{temperature:g} °C" + ("" if u is None else f", u = {u:g} °C")
    rows.append(("Temperature", words))
    for person in given.person:
        parts = (person.name, person.role, "signs the certificate" if person.main_signer else "")
        rows.append(("Responsible", ", ".join(filter(None, parts))))
    if not given.person:
        rows.append(("Responsible", NOT_STATED))
    for artefact in given.reference:
        number = artefact.certificate_number and f"certificate {artefact.certificate_number}"
        parts = (artefact.name, artefact.manufacturer, artefact.model, artefact.serial_number, number)
        rows.append(("Reference artefact", ", ".join(filter(None, parts))))
    if not given.reference:
        rows.append(("Reference artefacts", NOT_STATED))
    if given.conformity is not None:
        source = "" if tested else " (stated by the laboratory; this file contains no acceptance test)"
        conformity = given.conformity
        words = f"{conformity.verdict}: {conformity.specification}; {conformity.decision_rule}{source}"
        rows.append(("Statement of conformity", words))
    table = ReportTable("As stated", ("", ""), [[text_cell(title), text_cell(value)] for title, value in rows])
    return Section("about", "Laboratory, customer and item", [table])
