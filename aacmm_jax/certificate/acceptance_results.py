"""Acceptance tests in a certificate: nominal and calibrated, with limits and the conformity of each value beside it."""

from collections.abc import Iterator
from xml.etree.ElementTree import Element

from ..acceptance.judgement import COVERAGE_FACTOR, RULES, Decision, worst
from ..acceptance.record import EvaluationRecord
from ..acceptance.results import METRICS, AcceptanceTest, Metric, MetricValue
from .xml_elements import MILLIMETRE, element, english, equipment_quantity, method, named, real, software, text

_STAGES = {
    "nominal": ("nominal parameters", "beforeAdjustment"),
    "calibrated": ("calibrated parameters", "afterAdjustment"),
}
_DECIMALS = 5  # of values without an uncertainty, mm


def acceptance_results(record: EvaluationRecord) -> Iterator[Element]:
    """The measurement results of the acceptance tests of an evaluation, if it has any."""
    which = "." if record.independent else ", as far as there are any: here there are none."
    for stage, tests in record.acceptance().items():
        if not tests:
            continue
        name, status = _STAGES[stage]
        formulas = "Formulas and requirements as secondary sources state them."
        contributions = "Contributions of the tester alone (ISO 14253-5), combined as independent ones."
        data = element("data", english("text", _influences(record)))
        condition = named("influenceCondition", "Uncertainty of the test", element("status", status), data)
        editions = dict.fromkeys(test.called for test in tests)
        evaluation = "Evaluation of the uncertainty of the tests"
        yield named(
            "measurementResult",
            f"Acceptance tests, {name}",
            element(
                "usedMethods",
                (method("Acceptance tests", formulas, edition) for edition in editions),
                method(evaluation, contributions, "JCGM 100:2008", of_uncertainty=True),
            ),
            software("usedSoftware"),
            _artefacts(record),
            element("influenceConditions", condition),
            element("results", (_test(test, judged=record.recording.true is None) for test in tests)),
            says=f"Of single readings in poses that the calibration has not used{which}",
        )


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


def _artefacts(record: EvaluationRecord) -> Element | None:
    """The lengths and spheres that were measured, with the uncertainties of their own certificates."""
    lengths = [record.recording.capture.lengths[i] for i in record.held_out_lengths()]
    values = {f"Length {x.start} - {x.end}": (float(x.value), float(x.u)) for x in lengths}
    values |= {f"Diameter of sphere {sphere.name}": (sphere.diameter, sphere.u) for sphere in record.recording.spheres}
    if not values:
        return None
    quantities = (equipment_quantity(name, value, MILLIMETRE, u) for name, (value, u) in values.items())
    quantities = element("measuringEquipmentQuantities", quantities)
    return element("measuringEquipments", named("measuringEquipment", "Artefacts of the tests", quantities))


def _test(test: AcceptanceTest, judged: bool) -> Element:
    """One test; ``judged``: with the conformity of values with limits, which no simulated arm has."""
    lacking = f"Not the full procedure. {' '.join(test.missing)}" if test.missing else "The full procedure."
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
            english("declaration", f"|value| against the maximum permissible error: {value.decision}."),
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
