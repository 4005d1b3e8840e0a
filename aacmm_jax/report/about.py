"""Who calibrated what for whom, as people stated it; and what they left out."""

from typing import Any

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


def _stated(about: Any, part: str, key: str) -> str:
    value = getattr(getattr(about, part), key)
    return "" if value is None else str(value)


def _temperature(certificate: Any) -> str:
    if certificate.temperature_celsius is None:
        return _NOT
    u = certificate.temperature_u_celsius
    return f"{certificate.temperature_celsius:g} °C" + ("" if u is None else f", u = {u:g} °C")
