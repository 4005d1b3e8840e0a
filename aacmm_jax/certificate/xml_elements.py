"""The elements of a Digital Calibration Certificate as nested values: texts, contacts, values with units after D-SI.

    element("item", text("name", "arm 7"), element("model", "X1"))

Elements and their order are those of the published schemas, https://ptb.de/dcc/v3.3.0/dcc.xsd and
https://ptb.de/si/v2.2.1/SI_Format.xsd.
"""

from collections.abc import Iterable, Sequence
from importlib import metadata
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ..files.administrative_data import NOT_STATED, Contact
from ..uncertainty.degrees_of_freedom import LEVEL

DCC, SI, XSI = "https://ptb.de/dcc", "https://ptb.de/si", "http://www.w3.org/2001/XMLSchema-instance"
MILLIMETRE, RADIAN, ONE, CELSIUS = r"\milli\metre", r"\radian", r"\one", r"\degreecelsius"

Child = Element | str | None | Iterable[Any]  # whose items are children, too


def element(tag: str, *children: Child, ref_type: str | None = None, prefix: str = "dcc") -> Element:
    """An element with its text or its children in their order; lists are taken apart, and None is left out."""
    parent = Element(f"{prefix}:{tag}", {} if ref_type is None else {"refType": ref_type})
    for child in children:
        _put(parent, child)
    return parent


def _put(parent: Element, child: Child) -> None:
    if isinstance(child, str):
        parent.text = child
    elif isinstance(child, Element):
        parent.append(child)
    elif child is not None:
        for part in child:
            _put(parent, part)


def optional(tag: str, words: str | None) -> Element | None:
    """An element with a text; None where there is none."""
    return None if words is None else element(tag, words)


def english(tag: str, words: str) -> Element:
    """A term or sentence of this package, in English."""
    content = element("content", words)
    content.set("lang", "en")
    return element(tag, content)


def text(tag: str, words: str) -> Element:
    """A name or text given by people, in whatever language."""
    return element(tag, element("content", words))


def named(tag: str, name: str, *children: Child, says: str = "", ref_type: str | None = None) -> Element:
    """An element that begins with a name of this package and, if there is one, its description of it."""
    described = english("description", says) if says else None
    return element(tag, english("name", name), described, *children, ref_type=ref_type)


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
    value: float, unit: str, u: float | None = None, factor: float | None = None, decimals: int | None = None
) -> Element:
    """A value, perhaps with its uncertainty: the standard one ``u``, as it was given; or expanded by ``factor``, which
    is stated with two digits, and the value rounded to them. ``decimals``: of a value without uncertainty.
    """
    uncertainty = None
    if u is not None and factor is not None:
        decimals = decimals_of(factor * u)
        uncertainty = _si(
            "expandedMU",
            _si("valueExpandedMU", rounded(factor * u, decimals)),
            _si("coverageFactor", f"{factor:.4g}"),
            _si("coverageProbability", repr(LEVEL)),
        )
    elif u is not None:
        uncertainty = _si("standardMU", _si("valueStandardMU", repr(float(u))))
    return _si(
        "real",
        # repr is the shortest text that is read back as the same number.
        _si("value", repr(float(value)) if decimals is None else rounded(value, decimals)),
        _si("unit", unit),
        None if uncertainty is None else _si("measurementUncertaintyUnivariate", uncertainty),
    )


def table_row(name: str, values: Sequence[float], units: Sequence[str]) -> Element:
    """A row of a table: numbers with eight significant digits, and the unit of each."""
    numbers = _si("valueXMLList", " ".join(f"{value:.8g}" for value in values))
    row = _si("realListXMLList", numbers, _si("unitXMLList", " ".join(units)))
    return element("quantity", text("name", name), row)


def _si(tag: str, *children: Child) -> Element:
    return element(tag, *children, prefix="si")


def identifications(*entries: tuple[str, str | None, str]) -> Element | None:
    """Identifications (issuer, value, name); those without a value are left out."""
    given = [
        element("identification", element("issuer", issuer), element("value", value), english("name", name))
        for issuer, value, name in entries
        if value is not None
    ]
    return element("identifications", given) if given else None


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
