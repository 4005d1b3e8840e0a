"""The elements that a Digital Calibration Certificate is put together from: texts, contacts, software, values with units after D-SI.

Elements and their order are those of the published schemas, https://ptb.de/dcc/v3.3.0/dcc.xsd and
https://ptb.de/si/v2.2.1/SI_Format.xsd.
"""

from collections.abc import Iterable
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from ..files.administrative_data import NOT_STATED, Contact

DCC, SI, XSI = "https://ptb.de/dcc", "https://ptb.de/si", "http://www.w3.org/2001/XMLSchema-instance"
LEVEL = 0.95  # coverage probability of every expanded uncertainty
MILLIMETRE, RADIAN, ONE, CELSIUS = r"\milli\metre", r"\radian", r"\one", r"\degreecelsius"


def put(parent: Element, tag: str, text: str | None = None, refers: str | None = None) -> Element:
    """A new last child in the namespace of the DCC; ``refers`` is its ``refType``."""
    element = SubElement(parent, f"dcc:{tag}")
    element.text = text
    if refers is not None:
        element.set("refType", refers)
    return element


def ours(parent: Element, tag: str, text: str) -> None:
    """A child that holds a term or sentence of this package, in English."""
    put(put(parent, tag), "content", text).set("lang", "en")


def theirs(parent: Element, tag: str, text: str) -> None:
    """A child that holds a name or text given by people, in whatever language."""
    put(put(parent, tag), "content", text)


def real(parent: Element, value: float, unit: str, u: float | None = None, factor: float | None = None) -> None:
    """A value with its uncertainty, where it has one: standard ``u``, and expanded by ``factor`` where that is given."""
    quantity = SubElement(parent, "si:real")
    # The shortest text that is read back as the same number.
    SubElement(quantity, "si:value").text = repr(float(value))
    SubElement(quantity, "si:unit").text = unit
    if u is None:
        return
    uncertainty = SubElement(quantity, "si:measurementUncertaintyUnivariate")
    if factor is None:
        standard = SubElement(uncertainty, "si:standardMU")
        SubElement(standard, "si:valueStandardMU").text = repr(float(u))
        return
    expanded = SubElement(uncertainty, "si:expandedMU")
    SubElement(expanded, "si:valueExpandedMU").text = repr(float(factor * u))
    SubElement(expanded, "si:coverageFactor").text = repr(float(factor))
    SubElement(expanded, "si:coverageProbability").text = repr(LEVEL)


def identifications(parent: Element, entries: Iterable[tuple[str, str | None, str]]) -> None:
    """Identifications (issuer, value, name); those without a value are left out."""
    given = [entry for entry in entries if entry[1] is not None]
    if not given:
        return
    listed = put(parent, "identifications")
    for issuer, value, name in given:
        identification = put(listed, "identification")
        put(identification, "issuer", issuer)
        put(identification, "value", value)
        ours(identification, "name", name)


def contact(parent: Element, tag: str, given: Contact) -> None:
    """A name with an address; the schema wants a location, so it says where none is stated."""
    element = put(parent, tag)
    theirs(element, "name", given.name)
    for child, text in (("eMail", given.email), ("phone", given.phone)):
        if text is not None:
            put(element, child, text)
    location = put(element, "location")
    address = {"city": given.city, "countryCode": given.country, "postCode": given.postal_code, "street": given.street}
    for child, text in address.items():
        if text is not None:
            put(location, child, text)
    if not len(location):
        ours(location, "further", NOT_STATED)


def software(parent: Element, tag: str, command: str = "") -> None:
    """This package and its release, and with which command it was run."""
    from importlib import metadata

    element = put(put(parent, tag), "software")
    theirs(element, "name", "aacmm_jax")
    put(element, "release", f"v{metadata.version('aacmm_jax')}")
    put(element, "type", "application")
    if command:
        theirs(element, "description", command)


def written(root: Element) -> str:
    """The text of a file in UTF-8."""
    ElementTree.indent(root)
    # Readers take a bare carriage return for a line feed.
    body = ElementTree.tostring(root, encoding="unicode").replace("\r", "&#13;")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{body}\n'
