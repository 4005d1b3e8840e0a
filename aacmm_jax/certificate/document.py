"""The Digital Calibration Certificate (DCC) of a calibration: XML after PTB's schema, version 3.3.0; and a reader of its values."""

import datetime
import uuid
from collections.abc import Sequence
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ..calibration.record import CalibrationRecord
from ..core.errors import InputError
from ..files.administrative_data import NOT_STATED, AdministrativeData, check_conformity, held_by_xml
from ..summaries.warnings import of_calibration, plausible
from .measurement_results import add_results, uncertainty_says
from .xml_elements import DCC, SI, XSI, contact, identifications, ours, put, software, theirs, written

VERSION = "3.3.0"
_PREFIXES = {"dcc": DCC, "si": SI}


class Certified(NamedTuple):
    """A value of a certificate, its unit in D-SI syntax, and its expanded uncertainty, where it has one."""

    value: float
    unit: str
    expanded: float | None


def dcc(
    record: CalibrationRecord, about: AdministrativeData, *, created: str, sources: Sequence[str] = (), command: str = ""
) -> str:
    """The certificate of a calibration: the text of an XML file in UTF-8.

    ``created``: when the calibration was computed (ISO 8601, as calibration files say); ``sources``: names of the files that it
    was made of; ``command``: what computed it. The same input gives the same text: without a number in ``about`` the unique
    identifier is a UUID of the content.

    Raises `InputError` for a calibration that did not converge or whose scale is impossible, for names that XML cannot hold, and
    for dates that are out of order.
    """
    if not record.converged:
        reason = record.reason.partition(";")[0].rstrip(".")
        raise InputError(f"a calibration that failed has no certificate ({reason}); calibrate again until it converges.")
    if not plausible(record.k):
        raise InputError(
            f"k = {record.k:.6g} is the scale of no arm, so there is no certificate; mend the lengths and calibrate."
        )
    check_conformity(about, simulated=record.recording.true is not None)
    _check_texts(record, sources, command)
    root = Element("dcc:digitalCalibrationCertificate")
    for name, value in (("xmlns:dcc", DCC), ("xmlns:si", SI), ("xmlns:xsi", XSI)):
        root.set(name, value)
    root.set("xsi:schemaLocation", f"{DCC} {DCC}/v{VERSION}/dcc.xsd")
    root.set("schemaVersion", VERSION)
    day = _day(record.recording.measured or created)
    identifier = _administrative(put(root, "administrativeData"), record, about, day, sources)
    add_results(put(root, "measurementResults"), record, about, command)
    identifier.text = about.certificate.number or str(uuid.uuid5(uuid.NAMESPACE_URL, written(root)))
    return written(root)


def _check_texts(record: CalibrationRecord, sources: Sequence[str], command: str) -> None:
    for name in record.recording.capture.names:
        held_by_xml(name, f"the name of socket {name!r}")
    held_by_xml(record.recording.nominal.name, f"the name of arm {record.recording.nominal.name!r}")
    for source in sources:
        held_by_xml(source, f"the name of file {source!r}")
    held_by_xml(command, "the command")


def _day(created: str) -> datetime.date:
    try:
        return datetime.datetime.fromisoformat(created).date()
    except ValueError as error:
        raise InputError(
            f"created is '{created}'; give a date and time after ISO 8601, such as 2026-01-31T12:00:00."
        ) from error


def _administrative(
    data: Element, record: CalibrationRecord, about: AdministrativeData, day: datetime.date, sources: Sequence[str]
) -> Element:
    """Fill in the administrative data; returns the element for the unique identifier, still empty."""
    software(data, "dccSoftware")
    identifier = _core(put(data, "coreData"), about, day)
    given, item = about.item, put(put(data, "items"), "item")
    theirs(item, "name", given.name or record.recording.nominal.name or "articulated-arm coordinate measuring machine")
    if given.manufacturer is not None:
        theirs(put(item, "manufacturer"), "name", given.manufacturer)
    if given.model is not None:
        put(item, "model", given.model)
    serial = ("manufacturer", given.serial_number or NOT_STATED, "Serial number")
    identifications(item, [serial, ("customer", given.customer_number, "Customer's number")])
    laboratory = put(data, "calibrationLaboratory")
    if about.laboratory.code is not None:
        put(laboratory, "calibrationLaboratoryCode", about.laboratory.code)
    contact(laboratory, "contact", about.laboratory)
    _persons(put(data, "respPersons"), about)
    contact(data, "customer", about.customer)
    _statements(put(data, "statements"), record, about, sources)
    return identifier


def _core(core: Element, about: AdministrativeData, day: datetime.date) -> Element:
    given = about.certificate
    begin = given.begin or given.end or day
    end = given.end or max(day, begin)
    if given.received is not None and given.received > begin:
        raise InputError(
            f"certificate.received is {given.received}, after the calibration began on {begin}; mend it, or state begin."
        )
    if given.issued is not None and given.issued < end:
        raise InputError(f"certificate.issued is {given.issued}, before the calibration ended on {end}; mend it, or state end.")
    put(core, "countryCodeISO3166_1", about.country)
    put(core, "usedLangCodeISO639_1", "en")
    put(core, "mandatoryLangCodeISO639_1", "en")
    identifier = put(core, "uniqueIdentifier")
    if given.received is not None:
        put(core, "receiptDate", given.received.isoformat())
    put(core, "beginPerformanceDate", begin.isoformat())
    put(core, "endPerformanceDate", end.isoformat())
    put(core, "performanceLocation", given.place)
    if given.issued is not None:
        put(core, "issueDate", given.issued.isoformat())
    return identifier


def _persons(persons: Element, about: AdministrativeData) -> None:
    for person in about.person:
        element = put(persons, "respPerson")
        theirs(put(element, "person"), "name", person.name)
        if person.role is not None:
            put(element, "role", person.role)
        put(element, "mainSigner", "true" if person.main_signer else "false")
    if not about.person:
        ours(put(put(persons, "respPerson"), "person"), "name", NOT_STATED)


def _statements(statements: Element, record: CalibrationRecord, about: AdministrativeData, sources: Sequence[str]) -> None:
    if record.recording.true is not None:
        _state(statements, "Simulation", "The readings are simulated, so this is no certificate of a real arm.")
    _state(
        statements,
        "Scale",
        "The scale of the arm comes from the reference lengths alone: what it measures is traceable as far as they are, and has no "
        "other tie to the metre.",
    )
    _state(statements, "Uncertainty", uncertainty_says(record), norm="JCGM 100:2008")
    if record.sampled_says:
        _state(statements, "Monte Carlo", record.sampled_says, norm="JCGM 101:2008")
    for sentence in of_calibration(record):
        _state(statements, "Caution", sentence)
    if sources:
        _state(statements, "Files", ", ".join(sources))
    if about.conformity is not None:
        statement = _state(statements, "Conformity", about.conformity.decision_rule, norm=about.conformity.specification)
        put(statement, "conformity", about.conformity.verdict)
    if about.certificate.remarks is not None:
        statement = put(statements, "statement")
        ours(statement, "name", "Remarks")
        theirs(statement, "declaration", about.certificate.remarks)


def _state(statements: Element, name: str, text: str, *, norm: str | None = None) -> Element:
    statement = put(statements, "statement")
    ours(statement, "name", name)
    if norm is not None:
        put(statement, "norm", norm)
    ours(statement, "declaration", text)
    return statement


def parse_dcc(text: str) -> dict[tuple[str, ...], Certified]:
    """The single values (``si:real``) among the results of a DCC, by the names of measurement result, result, list and quantity.

    Such as ``("As left", "Denavit-Hartenberg parameters", "a_2")``. Where several stand under one path, the last is returned.

    Raises `InputError` where the text is no XML, no DCC, or has a document type: its entities could name files elsewhere.
    """
    try:
        root = ElementTree.fromstring(text, ElementTree.XMLParser(target=_NoDocumentType()))
    except (ElementTree.ParseError, UnicodeError) as error:
        raise InputError(f"the certificate is not valid XML: {error}; export it again.") from error
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        raise InputError(f"the XML is a '{root.tag}', not a digital calibration certificate; give a DCC.")
    found: dict[tuple[str, ...], Certified] = {}
    for result in root.iterfind("dcc:measurementResults/dcc:measurementResult", _PREFIXES):
        _collect(result, (), found)
    return found


class _NoDocumentType(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise InputError(f"the XML has a document type, '{name}', as no certificate has; leave it out.")


def _collect(element: Element, path: tuple[str, ...], found: dict[tuple[str, ...], Certified]) -> None:
    name = element.find("dcc:name/dcc:content", _PREFIXES)
    path = path if name is None else (*path, name.text or "")
    real = element.find("si:real", _PREFIXES)
    if real is not None:
        expanded = real.findtext("si:measurementUncertaintyUnivariate/si:expandedMU/si:valueExpandedMU", None, _PREFIXES)
        try:
            value = float(real.findtext("si:value", "", _PREFIXES))
            found[path] = Certified(
                value, real.findtext("si:unit", "", _PREFIXES), None if expanded is None else float(expanded)
            )
        except ValueError as error:
            raise InputError(f"the value of {' / '.join(path)!r} is no number; export the certificate again.") from error
    for tag in ("results", "result", "data", "list", "quantity"):
        for child in element.iterfind(f"dcc:{tag}", _PREFIXES):
            _collect(child, path, found)
