"""The Digital Calibration Certificate (DCC) of a calibration: XML after PTB's schema, version 3.3.0."""

import datetime
from collections.abc import Iterator, Mapping, Sequence
from xml.etree.ElementTree import Element

from ..acceptance.judgement import RULES, Rule, worst
from ..acceptance.record import EvaluationRecord, same_arm
from ..acceptance.results import METRICS, AcceptanceTest, Metric, MetricValue
from ..calibration.record import REPEATABILITY, CalibrationRecord
from ..core.errors import InputError
from ..data.capture import names_in
from ..diagnostics.contradictions import LEFT_OUT
from ..diagnostics.findings import findings_of
from ..files.administrative_data import NOT_STATED, AdministrativeData, check_conformity
from ..summaries.calibration import calibration_summary
from ..summaries.observations import scale_sources
from ..uncertainty.coverage import COVERAGE_FACTOR
from . import xml_elements as xml
from .measurement_results import results_of, uncertainty_statement
from .xml_elements import (
    LEFT_OUT_NAMES,
    MILLIMETRE,
    element,
    english,
    equipment_quantity,
    named,
    optional,
    real,
    text,
)

VERSION = "3.3.0"
Tests = Mapping[str, Sequence[AcceptanceTest]]  # acceptance tests by the parameters: nominal, as_found, calibrated
_DECIMALS = 5  # of values of tests without an uncertainty, mm


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

    The same input gives the same text: without a stated number, the unique identifier is a UUID of the content. Returns
    the text of an XML file in UTF-8. `InputError` if the calibration did not converge, its scale is impossible or the
    nominal arm's, a name has characters that XML does not allow, the dates are out of order, the evaluation is of
    another arm, or a conformity is stated that no result supports.

    Args:
        record: The calibration.
        administrative_data: Laboratory, customer, item, persons, dates and artefacts.
        created: When the calibration was computed, ISO 8601, as calibration files say.
        sources: Names of the files that the calibration was made of.
        command: The command that computed it.
        evaluation: An evaluation of the same calibration, whose acceptance tests are added. A statement of conformity
            rests on them, and is refused without them.

    Example:
        >>> data = aj.files.AdministrativeData(laboratory={"name": "Metrology Laboratory"})
        >>> text = aj.certificate.dcc_xml(record, data, created="2026-01-31T12:00:00Z")
        >>> print(text[:38], "Metrology Laboratory" in text)
        <?xml version="1.0" encoding="UTF-8"?> True
    """
    if not record.converged:
        reason = record.reason.partition(";")[0].rstrip(".")
        raise InputError(
            f"a certificate cannot be issued: the calibration failed ({reason}); calibrate again until the calibration "
            "converges."
        )
    if record.method == REPEATABILITY:
        raise InputError(
            "a certificate cannot be issued: the scale is not traceable (--scale nominal); calibrate with a reference "
            "length, or with another observation that fixes the scale."
        )
    if not record.plausible_scale:
        raise InputError(
            f"a certificate cannot be issued: k = {record.k:.6g} is not a plausible scale of an arm; correct the "
            "values of the reference lengths and calibrate again."
        )
    tests = _checked_tests(record, administrative_data, evaluation)
    try:
        day = datetime.datetime.fromisoformat(record.recording.measured or created).date()
    except ValueError as error:
        raise InputError(
            f"created is '{created}'; give a date and time as in ISO 8601, such as 2026-01-31T12:00:00."
        ) from error
    root = element(
        "digitalCalibrationCertificate",
        _administrative(record, administrative_data, day, sources, tests),
        element(
            "measurementResults",
            results_of(record, administrative_data, command, evaluation),
            None if evaluation is None else _acceptance_results(evaluation, tests),
        ),
    )
    for name, value in (("xmlns:dcc", xml.DCC), ("xmlns:si", xml.SI), ("xmlns:xsi", xml.XSI)):
        root.set(name, value)
    root.set("xsi:schemaLocation", f"{xml.DCC} {xml.DCC}/v{VERSION}/dcc.xsd")
    root.set("schemaVersion", VERSION)
    number = administrative_data.certificate.number or xml.identifier_of(xml.xml_text(root))
    next(root.iter("dcc:uniqueIdentifier")).text = number
    return xml.xml_text(root)


def _checked_tests(
    record: CalibrationRecord, administrative_data: AdministrativeData, evaluation: EvaluationRecord | None
) -> Tests:
    """The acceptance tests of the evaluation by the parameters; refuse what they contradict."""
    simulated = record.recording.true is not None
    if evaluation is None:
        check_conformity(
            administrative_data, simulated=simulated, needed="give an evaluation with limits (--evaluation)"
        )
        return {}
    if not same_arm(record.calibrated.arm, evaluation.calibrated.arm):
        raise InputError("the evaluation belongs to another calibration; run aacmm evaluate with this calibration.")
    simulated |= evaluation.recording.true is not None
    tests = evaluation.acceptance()
    decision = worst([test.decision for test in tests["calibrated"] if test.decision is not None])
    check_conformity(administrative_data, simulated=simulated, decision=decision, rules=_rules(tests))
    return tests


def _rules(tests: Tests) -> list[Rule]:
    """The rules by which the calibrated arm was decided."""
    return [test.rule for test in tests["calibrated"] if test.decision is not None]


def _decided_arms(tests: Tests) -> str:
    """With which parameters conformity is stated, and whether the arm fails with those before."""
    stage, before = ("as_found", "parameters as found") if "as_found" in tests else ("nominal", "nominal parameters")
    metrics = [metric.name for test in tests[stage] for metric in test.metrics if metric.decision == "fails"]
    fails = f" With the {before}, the arm fails ({', '.join(metrics)})." if metrics else ""
    return f"The statement of conformity holds for the arm with the calibrated parameters loaded into it.{fails}"


def _administrative(
    record: CalibrationRecord,
    given: AdministrativeData,
    day: datetime.date,
    sources: Sequence[str],
    tests: Tests,
) -> Element:
    """The administrative data, with the unique identifier still empty."""
    name = given.item.name or record.recording.nominal.name or "articulated-arm coordinate measuring machine"
    serial = ("manufacturer", given.item.serial_number or NOT_STATED, "Serial number")
    customers = ("customer", given.item.customer_number, "Customer's number")
    persons = [
        element(
            "respPerson",
            element("person", text("name", person.name)),
            optional("role", person.role),
            element("mainSigner", "true" if person.main_signer else "false"),
        )
        for person in given.person
    ]
    return element(
        "administrativeData",
        xml.software("dccSoftware"),
        _core(given, day),
        element("items", xml.item("item", name, given.item, serial, customers)),
        element(
            "calibrationLaboratory",
            optional("calibrationLaboratoryCode", given.laboratory.code),
            xml.contact("contact", given.laboratory),
        ),
        element("respPersons", persons or element("respPerson", named("person", NOT_STATED))),
        xml.contact("customer", given.customer),
        element("statements", _statements(record, given, sources, tests)),
    )


def _core(administrative_data: AdministrativeData, day: datetime.date) -> Element:
    given = administrative_data.certificate
    begin = given.begin or given.end or day
    end = given.end or max(day, begin)
    if given.received is not None and given.received > begin:
        raise InputError(
            f"certificate.received ({given.received}) is later than the beginning of the calibration ({begin}); "
            "correct certificate.received, or state certificate.begin."
        )
    if given.issued is not None and given.issued < end:
        raise InputError(
            f"certificate.issued ({given.issued}) is earlier than the end of the calibration ({end}); correct "
            "certificate.issued, or state certificate.end."
        )
    return element(
        "coreData",
        element("countryCodeISO3166_1", administrative_data.country),
        element("usedLangCodeISO639_1", "en"),
        element("mandatoryLangCodeISO639_1", "en"),
        element("uniqueIdentifier"),
        optional("receiptDate", given.received and given.received.isoformat()),
        element("beginPerformanceDate", begin.isoformat()),
        element("endPerformanceDate", end.isoformat()),
        element("performanceLocation", given.place),
        optional("issueDate", given.issued and given.issued.isoformat()),
        given.replaces
        and element(
            "reportAmendedSubstituted",
            element("typeOfChange", "substituted"),
            element("replacedUniqueIdentifier", given.replaces),
        ),
    )


def _statements(
    record: CalibrationRecord, given: AdministrativeData, sources: Sequence[str], tests: Tests
) -> Iterator[Element]:
    if record.recording.true is not None:
        yield _statement("Simulation", "The readings are simulated, so this is not a certificate of a real arm.")
    scale, traceable = "the reference lengths alone", "the reference lengths"
    if record.recording.capture.observations:
        scale = ", ".join(scale_sources(record))
        traceable = "the certified values of these artefacts and the measuring instruments"
    says = f"The scale of the arm comes from {scale}. Measurements of the arm are traceable to the metre"
    yield _statement("Scale", f"{says} only to the extent that {traceable} are traceable.")
    verdict = calibration_summary(record)["verdict"]
    if verdict["mark"] in ("unsure", "bad"):
        yield _statement("Not usable" if verdict["mark"] == "bad" else "To be used with care", verdict["says"])
    yield _statement("Uncertainty", uncertainty_statement(record), norm="JCGM 100:2008")
    if record.sampled_says:
        yield _statement("Monte Carlo", record.sampled_says, norm="JCGM 101:2008")
    for finding in findings_of(record):
        if finding.code == LEFT_OUT:
            # Of poses, what was probably done wrong concerns sockets that are not left out.
            kept = names_in(record.recording.capture)
            names = ", ".join(name for name in finding.concerns if name not in kept)
            yield _statement("Data left out", f"{finding.sentence}{LEFT_OUT_NAMES}{names}.")
        else:
            yield _statement("Warning", finding.sentence)
    if sources:
        yield _statement("Files", ", ".join(sources))
    if given.conformity is not None:
        stated = given.conformity
        verdict = element("conformity", stated.verdict)
        yield _statement("Conformity", stated.decided_by(_rules(tests)), verdict, norm=stated.specification)
        yield _statement("Parameters of the conformity", _decided_arms(tests))
    if given.certificate.remarks is not None:
        yield named("statement", "Remarks", text("declaration", given.certificate.remarks))


def _statement(name: str, words: str, verdict: Element | None = None, *, norm: str | None = None) -> Element:
    return named("statement", name, optional("norm", norm), english("declaration", words), verdict)


def _acceptance_results(record: EvaluationRecord, by_stage: Tests) -> Iterator[Element]:
    """The measurement results of the acceptance tests of an evaluation, if it has any."""
    which = (
        "not used for the calibration."
        if record.independent
        else "also used for the calibration, because there are no other poses."
    )
    # With the uncertainties of their own certificates.
    lengths = [record.recording.capture.lengths[i] for i in record.held_out_lengths()]
    values = {f"Length {x.start} - {x.end}": (float(x.value), float(x.u)) for x in lengths}
    values |= {f"Diameter of sphere {sphere.name}": (sphere.diameter, sphere.u) for sphere in record.recording.spheres}
    quantities = [equipment_quantity(name, value, MILLIMETRE, u) for name, (value, u) in values.items()]
    artefacts = named(
        "measuringEquipment", "Artefacts of the tests", element("measuringEquipmentQuantities", quantities)
    )
    artefacts = element("measuringEquipments", artefacts) if values else None
    for stage, tests in by_stage.items():
        if not tests:
            continue
        formulas = "Formulas and requirements are taken from secondary sources."
        contributions = (
            "The uncertainty includes only the contributions of the tester (ISO 14253-5), combined as independent "
            "contributions."
        )
        data = element("data", english("text", _influences(record)), _stated_u(record))
        condition = named("influenceCondition", "Uncertainty of the test", xml.adjustment_status(stage), data)
        editions = dict.fromkeys(test.called for test in tests)
        evaluation = "Evaluation of the uncertainty of the tests"
        yield named(
            "measurementResult",
            f"Acceptance tests, {'parameters as found' if stage == 'as_found' else f'{stage} parameters'}",
            element(
                "usedMethods",
                (xml.method("Acceptance tests", formulas, edition) for edition in editions),
                xml.method(evaluation, contributions, "JCGM 100:2008", of_uncertainty=True),
            ),
            xml.software("usedSoftware"),
            artefacts,
            element("influenceConditions", condition),
            element("results", (_test(test, judged=record.recording.true is None) for test in tests)),
            says=f"Computed from single readings in poses that were {which}",
        )


def _influences(record: EvaluationRecord) -> str:
    given = record.influences
    parts = []
    for name, body in (("artefact", given.artefact), ("arm", given.arm)):
        if body is not None:
            parts.append(
                f"The {name} expands by {body.coefficient:.4g} / K (u = {body.u_coefficient:.2g} / K), at "
                f"{body.temperature:g} C (u = {body.u_temperature:g} C); lengths are corrected for this expansion."
            )
    return " ".join([*parts, "The arm's own scatter is not included, because it is what is tested."])


def _stated_u(record: EvaluationRecord) -> Iterator[Element]:
    """Standard uncertainties of the test besides those of its artefacts."""
    yield named("quantity", "Standard uncertainty of seat and fixture", real(record.u_test, MILLIMETRE))
    if record.influences.u_relative:
        yield named("quantity", "Standard uncertainty per length", real(record.influences.u_relative, xml.ONE))


def _test(test: AcceptanceTest, judged: bool) -> Element:
    full, missing = "The full procedure was", " ".join(test.missing)
    lacking = f"{full} not carried out. {missing}" if missing else f"{full} carried out."
    lists = (
        named(
            "list",
            test.symbol(metric),
            (
                _value(test, metric, f"{number}: {value.where}", value, judged)
                for number, value in enumerate(metric.values, start=1)
            ),
            says=METRICS[metric.name],
        )
        for metric in test.metrics
    )
    says = f"{lacking} Expanded uncertainties have the coverage factor {COVERAGE_FACTOR:g}."
    return named("result", f"{test.called}: {test.title}", element("data", lists), says=says)


def _value(test: AcceptanceTest, metric: Metric, name: str, value: MetricValue, judged: bool) -> Element:
    """A value; where it has a limit, its conformity stands beside it, with the rule and the limit."""
    u, meta = value.expanded / COVERAGE_FACTOR, None
    if judged and value.decision is not None and value.limit is not None:
        limit = named("quantity", "Maximum permissible error", real(value.limit, MILLIMETRE))
        meta = named(
            "metaData",
            f"Conformity of {test.symbol(metric)}",
            element("norm", RULES[test.rule]),
            english(
                "declaration", f"Decision, from comparing |value| with the maximum permissible error: {value.decision}."
            ),
            element("conformity", _conformity(value)),
            element("data", limit),
        )
    measured = real(value.value, MILLIMETRE, u or None, COVERAGE_FACTOR, _DECIMALS)
    meta = None if meta is None else element("measurementMetaData", meta)
    return element("quantity", text("name", name), measured, meta, ref_type="basic_measurementError")


def _conformity(value: MetricValue) -> str:
    """The DCC's word. What is undecided passes or fails conditionally, by its side of the limit (ILAC-G8:09/2019)."""
    if value.decision == "undecided":
        return "conditionalPass" if abs(value.value) <= (value.limit or 0.0) else "conditionalFail"
    return "pass" if value.decision == "conforms" else "fail"
