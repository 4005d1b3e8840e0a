"""A reader of the values in a Digital Calibration Certificate."""

from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ..core.errors import InputError
from ..core.text import number, quoted
from .xml_elements import DCC, SI

_PREFIXES = {"dcc": DCC, "si": SI}
_LARGEST = 1e100  # no quantity is as large in any unit


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
    try:
        root = ElementTree.fromstring(text, ElementTree.XMLParser(target=_NoDocumentType()))
    except (ElementTree.ParseError, UnicodeError) as error:
        raise InputError(f"the certificate is not valid XML: {error}; export it again.") from error
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        raise InputError(f"the XML is a '{root.tag}', not a digital calibration certificate; give a DCC.")
    values: dict[tuple[str, ...], CertifiedValue] = {}
    for result in root.iterfind("dcc:measurementResults/dcc:measurementResult", _PREFIXES):
        _collect(result, (), values)
    return values


class _NoDocumentType(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise InputError(f"the XML has a document type, '{name}', as no certificate has; leave it out.")


def _collect(element: Element, path: tuple[str, ...], values: dict[tuple[str, ...], CertifiedValue]) -> None:
    name = element.find("dcc:name/dcc:content", _PREFIXES)
    path = path if name is None else (*path, name.text or "")
    real = element.find("si:real", _PREFIXES)
    if real is not None:
        expanded = real.findtext(
            "si:measurementUncertaintyUnivariate/si:expandedMU/si:valueExpandedMU", None, _PREFIXES
        )
        value = _number(real.findtext("si:value", "", _PREFIXES), "value", path)
        u = None if expanded is None else _number(expanded, "expanded uncertainty", path)
        values[path] = CertifiedValue(value, real.findtext("si:unit", "", _PREFIXES), u)
    for tag in ("results", "result", "data", "list", "quantity"):
        for child in element.iterfind(f"dcc:{tag}", _PREFIXES):
            _collect(child, path, values)


def _number(text: str, what: str, path: tuple[str, ...]) -> float:
    """A number as XML Schema's decimal and double write it, as far as a quantity can have it."""
    try:
        value = number(text.strip(" \t\r\n"))
        if abs(value) < _LARGEST and (value >= 0 or what == "value"):
            return value
    except ValueError:
        pass
    raise InputError(f"the {what} of {quoted(' / '.join(path))} is no number; export the certificate again.")
