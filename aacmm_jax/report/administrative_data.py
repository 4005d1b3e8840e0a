"""Who calibrated what for whom, as people stated it; and what they left out."""

from typing import Any

from .about import _ADDRESS, _ALWAYS, _NOT, _WHERE_STATED, _stated, _temperature
from .elements import Section, Table, text


def administrative_section(about: Any, tested: bool) -> Section:
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
