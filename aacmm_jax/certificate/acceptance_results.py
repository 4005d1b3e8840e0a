"""Acceptance tests in a certificate: as found and as left, with limits and the conformity of each value beside it."""

from xml.etree.ElementTree import Element

from ..acceptance.decision import COVERAGE_FACTOR, RULES, Decision, worst
from ..acceptance.record import EvaluationRecord
from ..acceptance.results import METRICS, AcceptanceTest, Metric, MetricValue
from .xml_elements import MILLIMETRE, add, add_english, add_real, add_software, add_text

_STAGES = {"nominal": ("as found", "beforeAdjustment"), "calibrated": ("as left", "afterAdjustment")}
_DECIMALS = 5  # of values without an uncertainty, mm


def add_acceptance(parent: Element, record: EvaluationRecord) -> None:
    """Add the measurement results of the acceptance tests of an evaluation, if it has any."""
    for stage, tests in record.acceptance().items():
        if not tests:
            continue
        name, status = _STAGES[stage]
        result = add(parent, "measurementResult")
        add_english(result, "name", f"Acceptance tests, {name}")
        add_english(
            result,
            "description",
            "Of single readings in poses that the calibration has not used"
            + ("." if record.independent else ", as far as there are any: here there are none."),
        )
        methods = add(result, "usedMethods")
        for edition in dict.fromkeys(test.called for test in tests):
            method = add(methods, "usedMethod")
            add_english(method, "name", "Acceptance tests")
            add_english(method, "description", "Formulas and requirements as secondary sources state them.")
            add(method, "norm", edition)
        method = add(methods, "usedMethod", ref_type="basic_methodMeasurementUncertainty")
        add_english(method, "name", "Evaluation of the uncertainty of the tests")
        add_english(
            method, "description", "Contributions of the tester alone (ISO 14253-5), combined as independent ones."
        )
        add(method, "norm", "JCGM 100:2008")
        add_software(result, "usedSoftware")
        _add_artefacts(result, record)
        condition = add(add(result, "influenceConditions"), "influenceCondition")
        add_english(condition, "name", "Uncertainty of the test")
        add(condition, "status", status)
        add_english(add(condition, "data"), "text", _influences(record))
        results = add(result, "results")
        for test in tests:
            _add_test(results, test, judged=record.recording.true is None)


def overall(record: EvaluationRecord) -> Decision | None:
    """The worst decision of all tests of the calibrated arm; None without limits."""
    return worst([test.decision for test in record.acceptance()["calibrated"] if test.decision is not None])


def _influences(record: EvaluationRecord) -> str:
    given = record.influences
    parts = [f"Standard uncertainty of seat and fixture: {1000 * record.u_test:.3g} um"]
    if given.u_relative:
        parts.append(f"in proportion to the length: {given.u_relative:.3g}")
    for name, body in (("artefact", given.artefact), ("arm", given.arm)):
        if body is not None:
            parts.append(
                f"the {name} expands by {body.coefficient:.4g} / K (u = {body.u_coefficient:.2g} / K), at "
                f"{body.temperature:g} C (u = {body.u_temperature:g} C); lengths are corrected"
            )
    return "; ".join(parts) + ". The arm's own scatter is what is tested."


def _add_artefacts(result: Element, record: EvaluationRecord) -> None:
    """The lengths and spheres that were measured, with the uncertainties of their own certificates."""
    lengths = [record.recording.capture.lengths[i] for i in record.held_out_lengths()]
    found = {f"Length {x.start} - {x.end}": (float(x.value), float(x.u)) for x in lengths}
    found |= {f"Diameter of sphere {sphere.name}": (sphere.diameter, sphere.u) for sphere in record.recording.spheres}
    if not found:
        return
    equipment = add(add(result, "measuringEquipments"), "measuringEquipment")
    add_english(equipment, "name", "Artefacts of the tests")
    quantities = add(equipment, "measuringEquipmentQuantities")
    for name, (value, u) in found.items():
        quantity = add(quantities, "measuringEquipmentQuantity")
        add_text(quantity, "name", name)
        if u == 0:
            add_english(quantity, "description", "Taken as exact")
        add_real(quantity, value, MILLIMETRE, u or None)


def _add_test(results: Element, test: AcceptanceTest, judged: bool) -> None:
    """One test; ``judged``: with the conformity of values with limits, which no simulated arm has."""
    result = add(results, "result")
    add_english(result, "name", f"{test.called}: {test.title}")
    lacking = f"Not the full procedure. {' '.join(test.missing)}" if test.missing else "The full procedure."
    add_english(
        result,
        "description",
        f"{lacking} Expanded uncertainties have the coverage factor {COVERAGE_FACTOR:g}.",
    )
    data = add(result, "data")
    for metric in test.metrics:
        rows = add(data, "list")
        add_english(rows, "name", test.symbol(metric))
        add_english(rows, "description", METRICS[metric.name])
        for number, value in enumerate(metric.values, start=1):
            _add_value(rows, test, metric, f"{number}: {value.where}", value, judged)


def _add_value(
    rows: Element, test: AcceptanceTest, metric: Metric, name: str, found: MetricValue, judged: bool
) -> None:
    """A value; where it has a limit, its conformity stands beside it, with the rule and the limit."""
    quantity = add(rows, "quantity", ref_type="basic_measurementError")
    add_text(quantity, "name", name)
    u = found.expanded / COVERAGE_FACTOR
    add_real(quantity, found.value, MILLIMETRE, u or None, COVERAGE_FACTOR, _DECIMALS)
    if not judged or found.decision is None or found.limit is None:
        return
    meta = add(add(quantity, "measurementMetaData"), "metaData")
    add_english(meta, "name", f"Conformity of {test.symbol(metric)}")
    add(meta, "norm", RULES[test.rule])
    add_english(meta, "declaration", f"|value| against the maximum permissible error: {found.decision}.")
    add(meta, "conformity", _conformity(found, found.limit))
    limit = add(add(meta, "data"), "quantity")
    add_english(limit, "name", "Maximum permissible error")
    add_real(limit, found.limit, MILLIMETRE)


def _conformity(found: MetricValue, limit: float) -> str:
    """The DCC's word. What is undecided passes or fails conditionally, by its side of the limit (ILAC-G8:09/2019)."""
    if found.decision == "undecided":
        return "conditionalPass" if abs(found.value) <= limit else "conditionalFail"
    return "pass" if found.decision == "conforms" else "fail"
