"""The elements of a Digital Calibration Certificate: texts, contacts, software, values with units after D-SI.

Elements and their order are those of the published schemas, https://ptb.de/dcc/v3.3.0/dcc.xsd and
https://ptb.de/si/v2.2.1/SI_Format.xsd.
"""

from collections.abc import Iterable, Sequence
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from ..files.administrative_data import NOT_STATED, Contact

DCC, SI, XSI = "https://ptb.de/dcc", "https://ptb.de/si", "http://www.w3.org/2001/XMLSchema-instance"
LEVEL = 0.95  # coverage probability of every expanded uncertainty
MILLIMETRE, RADIAN, ONE, CELSIUS = r"\milli\metre", r"\radian", r"\one", r"\degreecelsius"


def add(parent: Element, tag: str, text: str | None = None, ref_type: str | None = None) -> Element:
    """A new last child in the namespace of the DCC."""
    element = SubElement(parent, f"dcc:{tag}")
    element.text = text
    if ref_type is not None:
        element.set("refType", ref_type)
    return element


def add_english(parent: Element, tag: str, text: str) -> None:
    """A child with a term or sentence of this package, in English."""
    add(add(parent, tag), "content", text).set("lang", "en")


def add_text(parent: Element, tag: str, text: str) -> None:
    """A child with a name or text given by people, in whatever language."""
    add(add(parent, tag), "content", text)


def rounded(value: float, decimals: int) -> str:
    """A decimal number with so many decimals; negative ones round to tens, hundreds and so on."""
    return f"{round(float(value), decimals) + 0.0:.{max(decimals, 0)}f}"


def decimals_of(uncertainty: float) -> int:
    """Decimals of an uncertainty that is stated with two significant digits (JCGM 100:2008, 7.2.6)."""
    exponent = int(f"{uncertainty:.1e}".partition("e")[2])  # of the rounded number: 0.0996 becomes 0.10
    return 1 - exponent


def add_real(
    parent: Element,
    value: float,
    unit: str,
    u: float | None = None,
    factor: float | None = None,
    decimals: int | None = None,
) -> None:
    """A value, perhaps with its uncertainty: the standard one ``u``, as it was given; or expanded by ``factor``, which
    is stated with two digits, and the value rounded to them. ``decimals``: of a value without uncertainty.
    """
    quantity = SubElement(parent, "si:real")
    if u is not None and factor is not None:
        decimals = decimals_of(factor * u)
    # repr is the shortest text that is read back as the same number.
    SubElement(quantity, "si:value").text = repr(float(value)) if decimals is None else rounded(value, decimals)
    SubElement(quantity, "si:unit").text = unit
    if u is None:
        return
    uncertainty = SubElement(quantity, "si:measurementUncertaintyUnivariate")
    if factor is None or decimals is None:
        standard = SubElement(uncertainty, "si:standardMU")
        SubElement(standard, "si:valueStandardMU").text = repr(float(u))
        return
    expanded = SubElement(uncertainty, "si:expandedMU")
    SubElement(expanded, "si:valueExpandedMU").text = rounded(factor * u, decimals)
    SubElement(expanded, "si:coverageFactor").text = f"{factor:.4g}"
    SubElement(expanded, "si:coverageProbability").text = repr(LEVEL)


def add_row(parent: Element, name: str, values: Sequence[float], units: Sequence[str]) -> None:
    """A row of a table: numbers with eight significant digits, and the unit of each."""
    quantity = add(parent, "quantity")
    add_text(quantity, "name", name)
    row = SubElement(quantity, "si:realListXMLList")
    SubElement(row, "si:valueXMLList").text = " ".join(f"{value:.8g}" for value in values)
    SubElement(row, "si:unitXMLList").text = " ".join(units)


def add_identifications(parent: Element, entries: Iterable[tuple[str, str | None, str]]) -> None:
    """Identifications (issuer, value, name); those without a value are left out."""
    given = [entry for entry in entries if entry[1] is not None]
    if not given:
        return
    identifications = add(parent, "identifications")
    for issuer, value, name in given:
        identification = add(identifications, "identification")
        add(identification, "issuer", issuer)
        add(identification, "value", value)
        add_english(identification, "name", name)


def add_contact(parent: Element, tag: str, contact: Contact) -> None:
    """A name with an address. The schema requires a location; it says so if none is stated."""
    element = add(parent, tag)
    add_text(element, "name", contact.name)
    for child, text in (("eMail", contact.email), ("phone", contact.phone)):
        if text is not None:
            add(element, child, text)
    location = add(element, "location")
    for child, text in (
        ("city", contact.city),
        ("countryCode", contact.country),
        ("postCode", contact.postal_code),
        ("street", contact.street),
    ):
        if text is not None:
            add(location, child, text)
    if not len(location):
        add_english(location, "further", NOT_STATED)


def add_software(parent: Element, tag: str, command: str = "") -> None:
    """This package, its release, and the command that was run."""
    from importlib import metadata

    element = add(add(parent, tag), "software")
    add_text(element, "name", "aacmm_jax")
    add(element, "release", f"v{metadata.version('aacmm_jax')}")
    add(element, "type", "application")
    if command:
        add_text(element, "description", command)


def xml_text(root: Element) -> str:
    """The text of an XML file in UTF-8."""
    ElementTree.indent(root)
    # XML readers take a bare carriage return for a line feed.
    body = ElementTree.tostring(root, encoding="unicode").replace("\r", "&#13;")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{body}\n'
