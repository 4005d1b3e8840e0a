"""The Digital Calibration Certificate (DCC) of a calibration: XML after PTB's schema, version 3.3.0."""

import datetime
import uuid
from collections.abc import Sequence
from xml.etree.ElementTree import Element

from ..acceptance.record import EvaluationRecord, same_arm
from ..calibration.record import REPEATABILITY, CalibrationRecord
from ..core.errors import InputError
from ..diagnostics.contradictions import LEFT_OUT
from ..diagnostics.findings import findings_of
from ..files.administrative_data import NOT_STATED, AdministrativeData, check_conformity, held_by_xml
from ..summaries.observations import scale_sources
from .acceptance_results import add_acceptance, overall
from .measurement_results import add_results, uncertainty_statement
from .observation_results import texts_of
from .xml_elements import (
    DCC,
    SI,
    XSI,
    add,
    add_contact,
    add_english,
    add_identifications,
    add_software,
    add_text,
    xml_text,
)

VERSION = "3.3.0"


def dcc_xml(
    record: CalibrationRecord,
    administrative_data: AdministrativeData,
    *,
    created: str,
    sources: Sequence[str] = (),
    command: str = "",
    evaluation: EvaluationRecord | None = None,
) -> str:
    """Make the Digital Calibration Certificate of a calibration.

    The same input gives the same text: without a stated number, the unique identifier is a UUID of the content.

    Args:
        record: The calibration.
        administrative_data: Laboratory, customer, item, persons, dates and artefacts.
        created: When the calibration was computed, ISO 8601, as calibration files say.
        sources: Names of the files that the calibration was made of.
        command: The command that computed it.
        evaluation: An evaluation of the same calibration, whose acceptance tests are added. A statement of conformity
            rests on them, and is refused without them.

    Returns:
        The text of an XML file in UTF-8.

    Raises:
        InputError: If the calibration did not converge, its scale is impossible or the nominal arm's, a name has
            characters that XML does not allow, the dates are out of order, the evaluation is of another arm, or a
            conformity is stated that no result supports.

    Example:
        >>> data = aj.files.AdministrativeData(laboratory={"name": "Metrology Laboratory"})
        >>> text = aj.certificate.dcc_xml(record, data, created="2026-01-31T12:00:00Z")
        >>> print(text[:38], "Metrology Laboratory" in text)
        <?xml version="1.0" encoding="UTF-8"?> True
    """
    if not record.converged:
        reason = record.reason.partition(";")[0].rstrip(".")
        raise InputError(
            f"a calibration that failed has no certificate ({reason}); calibrate again until it converges."
        )
    if record.method == REPEATABILITY:
        raise InputError(
            "a certificate states a scale that is traceable, but this calibration took that of the nominal arm "
            "(--scale nominal); calibrate with a reference length, or with another observation that fixes the scale."
        )
    if not record.plausible_scale:
        raise InputError(
            f"k = {record.k:.6g} cannot be the scale of an arm, so there is no certificate; correct the lengths and "
            "calibrate again."
        )
    _check_evaluation(record, administrative_data, evaluation)
    _check_texts(record, sources, command)
    root = Element("dcc:digitalCalibrationCertificate")
    for name, value in (("xmlns:dcc", DCC), ("xmlns:si", SI), ("xmlns:xsi", XSI)):
        root.set(name, value)
    root.set("xsi:schemaLocation", f"{DCC} {DCC}/v{VERSION}/dcc.xsd")
    root.set("schemaVersion", VERSION)
    day = _day(record.recording.measured or created)
    identifier = _add_administrative(add(root, "administrativeData"), record, administrative_data, day, sources)
    results = add(root, "measurementResults")
    add_results(results, record, administrative_data, command)
    if evaluation is not None:
        add_acceptance(results, evaluation)
    identifier.text = administrative_data.certificate.number or str(uuid.uuid5(uuid.NAMESPACE_URL, xml_text(root)))
    return xml_text(root)


def _check_evaluation(
    record: CalibrationRecord, administrative_data: AdministrativeData, evaluation: EvaluationRecord | None
) -> None:
    """Refuse an evaluation of another arm, and a conformity without results that it rests on."""
    simulated = record.recording.true is not None
    if evaluation is None:
        check_conformity(administrative_data, simulated=simulated)
        if administrative_data.conformity is not None:
            raise InputError(
                "conformity is stated, but the certificate has no acceptance results that it rests on; give an "
                "evaluation with limits (--evaluation), or leave [conformity] out."
            )
        return
    if not same_arm(record.calibrated.arm, evaluation.calibrated.arm):
        raise InputError("the evaluation is of another calibration; evaluate this one.")
    for name in evaluation.recording.capture.names:
        held_by_xml(name, f"the name of socket {name!r}")
    for sphere in evaluation.recording.spheres:
        held_by_xml(sphere.name, f"the name of sphere {sphere.name!r}")
    simulated |= evaluation.recording.true is not None
    check_conformity(administrative_data, simulated=simulated, decision=overall(evaluation), tested=True)


def _check_texts(record: CalibrationRecord, sources: Sequence[str], command: str) -> None:
    for name in record.recording.capture.names:
        held_by_xml(name, f"the name of socket {name!r}")
    for observation in record.recording.capture.observations:
        for text in texts_of(observation):
            held_by_xml(text, f"{text!r} of observation {observation.name!r}")
        held_by_xml(observation.target, f"the name of target {observation.target!r}")
    for removed in record.removed:
        for name in (removed.group, *removed.members):
            held_by_xml(name, f"the name of {name!r}, which was left out")
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


def _add_administrative(
    parent: Element, record: CalibrationRecord, given: AdministrativeData, day: datetime.date, sources: Sequence[str]
) -> Element:
    """Fill in the administrative data; returns the element for the unique identifier, still empty."""
    add_software(parent, "dccSoftware")
    identifier = _add_core(add(parent, "coreData"), given, day)
    item = add(add(parent, "items"), "item")
    name = given.item.name or record.recording.nominal.name or "articulated-arm coordinate measuring machine"
    add_text(item, "name", name)
    if given.item.manufacturer is not None:
        add_text(add(item, "manufacturer"), "name", given.item.manufacturer)
    if given.item.model is not None:
        add(item, "model", given.item.model)
    serial = ("manufacturer", given.item.serial_number or NOT_STATED, "Serial number")
    add_identifications(item, [serial, ("customer", given.item.customer_number, "Customer's number")])
    laboratory = add(parent, "calibrationLaboratory")
    if given.laboratory.code is not None:
        add(laboratory, "calibrationLaboratoryCode", given.laboratory.code)
    add_contact(laboratory, "contact", given.laboratory)
    _add_persons(add(parent, "respPersons"), given)
    add_contact(parent, "customer", given.customer)
    _add_statements(add(parent, "statements"), record, given, sources)
    return identifier


def _add_core(core: Element, administrative_data: AdministrativeData, day: datetime.date) -> Element:
    given = administrative_data.certificate
    begin = given.begin or given.end or day
    end = given.end or max(day, begin)
    if given.received is not None and given.received > begin:
        raise InputError(
            f"certificate.received is {given.received}, after the calibration began on {begin}; "
            "correct it, or state begin."
        )
    if given.issued is not None and given.issued < end:
        raise InputError(
            f"certificate.issued is {given.issued}, before the calibration ended on {end}; correct it, or state end."
        )
    add(core, "countryCodeISO3166_1", administrative_data.country)
    add(core, "usedLangCodeISO639_1", "en")
    add(core, "mandatoryLangCodeISO639_1", "en")
    identifier = add(core, "uniqueIdentifier")
    if given.received is not None:
        add(core, "receiptDate", given.received.isoformat())
    add(core, "beginPerformanceDate", begin.isoformat())
    add(core, "endPerformanceDate", end.isoformat())
    add(core, "performanceLocation", given.place)
    if given.issued is not None:
        add(core, "issueDate", given.issued.isoformat())
    return identifier


def _add_persons(parent: Element, given: AdministrativeData) -> None:
    for person in given.person:
        element = add(parent, "respPerson")
        add_text(add(element, "person"), "name", person.name)
        if person.role is not None:
            add(element, "role", person.role)
        add(element, "mainSigner", "true" if person.main_signer else "false")
    if not given.person:
        add_english(add(add(parent, "respPerson"), "person"), "name", NOT_STATED)


def _add_statements(
    parent: Element, record: CalibrationRecord, given: AdministrativeData, sources: Sequence[str]
) -> None:
    if record.recording.true is not None:
        _add_statement(parent, "Simulation", "The readings are simulated, so this is no certificate of a real arm.")
    _add_statement(parent, "Scale", _scale(record))
    _add_statement(parent, "Uncertainty", uncertainty_statement(record), norm="JCGM 100:2008")
    if record.sampled_says:
        _add_statement(parent, "Monte Carlo", record.sampled_says, norm="JCGM 101:2008")
    for finding in findings_of(record):
        if finding.code == LEFT_OUT:
            members = f"Sockets and observations left out: {', '.join(finding.concerns)}."
            _add_statement(parent, "Data left out", f"{finding.sentence} {members}")
        else:
            _add_statement(parent, "Warning", finding.sentence)
    if sources:
        _add_statement(parent, "Files", ", ".join(sources))
    if given.conformity is not None:
        conformity = given.conformity
        statement = _add_statement(parent, "Conformity", conformity.decision_rule, norm=conformity.specification)
        add(statement, "conformity", conformity.verdict)
    if given.certificate.remarks is not None:
        statement = add(parent, "statement")
        add_english(statement, "name", "Remarks")
        add_text(statement, "declaration", given.certificate.remarks)


def _scale(record: CalibrationRecord) -> str:
    if not record.recording.capture.observations:
        return (
            "The scale of the arm comes from the reference lengths alone: its measurements are traceable as far as "
            "these lengths are, and have no other connection to the metre."
        )
    return (
        f"The scale of the arm comes from {', '.join(scale_sources(record))}: its measurements are traceable as far as "
        "the certified values of these artefacts, and the instruments that measured, are, and have no other connection "
        "to the metre."
    )


def _add_statement(parent: Element, name: str, text: str, *, norm: str | None = None) -> Element:
    statement = add(parent, "statement")
    add_english(statement, "name", name)
    if norm is not None:
        add(statement, "norm", norm)
    add_english(statement, "declaration", text)
    return statement
