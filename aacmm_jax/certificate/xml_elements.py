"""The elements of a Digital Calibration Certificate as nested values, written and read: texts, contacts, D-SI values.

    element("item", text("name", "arm 7"), element("model", "X1"))

Elements and their order are those of the published schemas, https://ptb.de/dcc/v3.3.0/dcc.xsd and
https://ptb.de/si/v2.2.1/SI_Format.xsd.
"""

import uuid
from collections.abc import Iterable
from importlib import metadata
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ..core.errors import InputError
from ..core.text import number, quoted
from ..files.administrative_data import NOT_STATED, CalibratedItem, Contact, Reference, held_by_xml
from ..uncertainty.coverage import LEVEL

DCC, SI, XSI = "https://ptb.de/dcc", "https://ptb.de/si", "http://www.w3.org/2001/XMLSchema-instance"
MILLIMETRE, RADIAN, ONE, CELSIUS = r"\milli\metre", r"\radian", r"\one", r"\degreecelsius"
PREFIXES = {"dcc": DCC, "si": SI}
LEFT_OUT_NAMES = " Sockets, observations or poses left out: "  # before their names in the statement on them
_LARGEST = 1e100  # no quantity is as large in any unit

Child = Element | str | None | Iterable[Any]  # whose items are children, too


def element(tag: str, *children: Child, ref_type: str | None = None, prefix: str = "dcc") -> Element:
    """An element with its text or its children in their order; lists are taken apart, and None is left out."""
    parent = Element(f"{prefix}:{tag}", {} if ref_type is None else {"refType": ref_type})
    for child in children:
        _put(parent, child)
    return parent


def _put(parent: Element, child: Child) -> None:
    if isinstance(child, str):
        # Names that people gave stand in many texts: that which XML cannot hold is refused by name.
        for word in child.split(" "):
            held_by_xml(word, f"{word!r} in the certificate")
        parent.text = child
    elif isinstance(child, Element):
        parent.append(child)
    elif child is not None:
        for part in child:
            _put(parent, part)


def adjustment_status(stage: str) -> Element | None:
    """Whether results are those before or after the adjustment. Nominal parameters are neither, unless somebody says
    that the arm arrived with them."""
    return optional("status", {"as_found": "beforeAdjustment", "calibrated": "afterAdjustment"}.get(stage))


def optional(tag: str, words: str | None) -> Element | None:
    """An element with a text; None where there is none."""
    return None if words is None else element(tag, words)


def text(tag: str, words: str, lang: str | None = None) -> Element:
    """A name or text given by people, in whatever language where none is stated."""
    content = element("content", words)
    if lang is not None:
        content.set("lang", lang)
    return element(tag, content)


def english(tag: str, words: str) -> Element:
    """A term or sentence of this package, in English."""
    return text(tag, words, "en")


def named(tag: str, name: str, *children: Child, says: str = "", ref_type: str | None = None) -> Element:
    """An element that begins with a name of this package and, if there is one, its description of it."""
    described = english("description", says) if says else None
    return element(tag, english("name", name), described, *children, ref_type=ref_type)


def result(name: str, description: str, *data: Element | Iterable[Element]) -> Element:
    """A measurement result with its data."""
    return named("result", name, element("data", *data), says=description)


def method(name: str, says: str, norm: str | None = None, *, of_uncertainty: bool = False) -> Element:
    """A method that was used, with the document that describes it."""
    ref_type = "basic_methodMeasurementUncertainty" if of_uncertainty else None
    return named("usedMethod", name, optional("norm", norm), says=says, ref_type=ref_type)


def equipment_quantity(name: str, value: float, unit: str, u: float | None) -> Element:
    """A certified value of an artefact with its standard uncertainty, as it was given; 0: it is taken as exact."""
    exact = english("description", "Taken as exact") if u == 0 else None
    return element("measuringEquipmentQuantity", text("name", name), exact, real(value, unit, u or None))


def rounded(value: float, decimals: int) -> str:
    """A decimal number with so many decimals; negative ones round to tens, hundreds and so on."""
    return f"{round(float(value), decimals) + 0.0:.{max(decimals, 0)}f}"


def decimals_of(uncertainty: float) -> int:
    """Decimals of an uncertainty that is stated with two significant digits (JCGM 100:2008, 7.2.6)."""
    exponent = int(f"{uncertainty:.1e}".partition("e")[2])  # of the rounded number: 0.0996 becomes 0.10
    return 1 - exponent


def real(
    value: float,
    unit: str,
    u: float | None = None,
    factor: float | None = None,
    decimals: int | None = None,
    digits: int = 2,
) -> Element:
    """A value, perhaps with its uncertainty: the standard one ``u``, as it was given; or expanded by ``factor``, which
    is stated with two digits, or ``digits``, and the value rounded to them. ``decimals``: of a value without
    uncertainty.
    """
    uncertainty = None
    if u is not None and factor is not None:
        decimals = decimals_of(factor * u) + digits - 2
        uncertainty = si(
            "expandedMU",
            si("valueExpandedMU", rounded(factor * u, decimals)),
            si("coverageFactor", f"{factor:.4g}"),
            si("coverageProbability", repr(LEVEL)),
        )
    elif u is not None:
        uncertainty = si("standardMU", si("valueStandardMU", repr(float(u))))
    return si(
        "real",
        # repr is the shortest text that is read back as the same number.
        si("value", repr(float(value)) if decimals is None else rounded(value, decimals)),
        si("unit", unit),
        None if uncertainty is None else si("measurementUncertaintyUnivariate", uncertainty),
    )


def si(tag: str, *children: Child) -> Element:
    """An element of the schema of values with units."""
    return element(tag, *children, prefix="si")


def item(tag: str, name: str, given: CalibratedItem | Reference, *numbers: tuple[str, str | None, str]) -> Element:
    """A thing with its maker, model and numbers (issuer, value, name), those that were stated."""
    identifications = [
        element("identification", element("issuer", issuer), element("value", value), english("name", words))
        for issuer, value, words in numbers
        if value is not None
    ]
    return element(
        tag,
        text("name", name),
        text("description", condition) if (condition := getattr(given, "condition", None)) else None,
        None if given.manufacturer is None else element("manufacturer", text("name", given.manufacturer)),
        optional("model", given.model),
        element("identifications", identifications) if identifications else None,
    )


def contact(tag: str, who: Contact) -> Element:
    """A name with an address. The schema requires a location; it says so if none is stated."""
    place = {"city": who.city, "countryCode": who.country, "postCode": who.postal_code, "street": who.street}
    location = [optional(key, words) for key, words in place.items() if words is not None]
    return element(
        tag,
        text("name", who.name),
        optional("eMail", who.email),
        optional("phone", who.phone),
        element("location", location or english("further", NOT_STATED)),
    )


def software(tag: str, command: str = "") -> Element:
    """This package, its release, and the command that was run."""
    release = element("release", f"v{metadata.version('aacmm_jax')}")
    described = text("description", command) if command else None
    name = text("name", "aacmm_jax")
    return element(tag, element("software", name, release, element("type", "application"), described))


def xml_text(root: Element) -> str:
    """The text of an XML file in UTF-8."""
    ElementTree.indent(root)
    # XML readers take a bare carriage return for a line feed.
    body = ElementTree.tostring(root, encoding="unicode").replace("\r", "&#13;")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{body}\n'


def identifier_of(text: str) -> str:
    """The UUID of a certificate's text in which the unique identifier is empty: what identifies the certificate if no
    number is stated."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, text))


def states_number(text: str, identifier: str) -> bool:
    """Whether the unique identifier of a certificate is a number that the laboratory stated."""
    tag = "dcc:uniqueIdentifier"
    return identifier != identifier_of(text.replace(f"<{tag}>{identifier}</{tag}>", f"<{tag} />", 1))


class CertifiedValue(NamedTuple):
    """A value of a certificate.

    Example:
        >>> text = aj.certificate.dcc_xml(record, aj.files.AdministrativeData(), created="2026-01-31T12:00:00Z")
        >>> de = aj.certificate.parse_dcc(text)["Nominal parameters", "Repeatability", "DE"]
        >>> print(de.value, de.expanded)
        1.8803 None
    """

    value: float
    unit: str  # in D-SI syntax
    expanded: float | None  # expanded uncertainty; None if there is none


def parse_dcc(text: str) -> dict[tuple[str, ...], CertifiedValue]:
    """Read the single values (``si:real``) among the results of a Digital Calibration Certificate.

    Returns the values by the names of measurement result, result, list and quantity, such as ``("Calibrated
    parameters", "Denavit-Hartenberg parameters", "a_2")``; of several with the same names, the last. `InputError` if
    the text is no XML, no DCC, or has a document type, whose entities could name other files.

    Args:
        text: The XML of the certificate.

    Example:
        >>> text = aj.certificate.dcc_xml(record, aj.files.AdministrativeData(), created="2026-01-31T12:00:00Z")
        >>> a_3 = aj.certificate.parse_dcc(text)["Calibrated parameters", "Denavit-Hartenberg parameters", "a_3"]
        >>> print(a_3.value, "mm, U =", a_3.expanded, "mm")
        -0.3224 mm, U = 0.0039 mm
    """
    root = root_of(text)
    values: dict[tuple[str, ...], CertifiedValue] = {}
    for result in root.iterfind("dcc:measurementResults/dcc:measurementResult", PREFIXES):
        _collect(result, (), values)
    return values


def root_of(text: str) -> Element:
    """The root of a certificate's XML. Raises `InputError` as `parse_dcc` says."""
    try:
        root = ElementTree.fromstring(text, ElementTree.XMLParser(target=_NoDocumentType()))
    except (ElementTree.ParseError, UnicodeError) as error:
        raise InputError(f"the certificate is not valid XML: {error}; export the certificate again.") from error
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        raise InputError(f"the XML is a '{root.tag}', not a digital calibration certificate; give a DCC.")
    return root


class _NoDocumentType(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise InputError(f"the XML declares a document type, '{name}', which a certificate must not have; remove it.")


def _collect(element: Element, path: tuple[str, ...], values: dict[tuple[str, ...], CertifiedValue]) -> None:
    name, real = element.find("dcc:name/dcc:content", PREFIXES), element.find("si:real", PREFIXES)
    path = path if name is None else (*path, name.text or "")
    if real is not None:
        stated = "si:measurementUncertaintyUnivariate/si:expandedMU/si:valueExpandedMU"
        expanded = real.findtext(stated, None, PREFIXES)
        value = _number(real.findtext("si:value", "", PREFIXES), "value", path)
        u = None if expanded is None else _number(expanded, "expanded uncertainty", path)
        values[path] = CertifiedValue(value, real.findtext("si:unit", "", PREFIXES), u)
    for tag in ("results", "result", "data", "list", "quantity"):
        for child in element.iterfind(f"dcc:{tag}", PREFIXES):
            _collect(child, path, values)


def _number(text: str, what: str, path: tuple[str, ...]) -> float:
    """A number as XML Schema's decimal and double write it, as far as a quantity can have it."""
    try:
        value = number(text.strip(" \t\r\n"))
        if abs(value) < _LARGEST and (value >= 0 or what == "value"):
            return value
    except ValueError:
        pass
    raise InputError(f"the {what} of {quoted(' / '.join(path))} is not a number; export the certificate again.")
