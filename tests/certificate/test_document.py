"""The Digital Calibration Certificate: valid by the published schema; numbers and texts read back exactly."""

import datetime
import math
import re
from pathlib import Path
from xml.etree import ElementTree

import equinox as eqx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import aacmm_jax as aj
from aacmm_jax.calibration.record import Removed
from aacmm_jax.certificate import (
    dcc_xml,
    document,
    measurement_results,
    parameter_results,
    parse_dcc,
    printed_certificate,
    sections,
    xml_elements,
)
from aacmm_jax.diagnostics.findings import findings_of, sentences
from aacmm_jax.files.administrative_data import (
    AdministrativeData,
    CalibratedItem,
    Certificate,
    Conformity,
    Laboratory,
    Person,
    Reference,
    check_conformity,
    read_administrative_data,
)
from aacmm_jax.kinematics import corrections as kinds
from aacmm_jax.kinematics.correction_kinds import Loads
from aacmm_jax.summaries.calibration import calibration_summary
from aacmm_jax.summaries.evaluation import evaluation_summary
from tests.certificate import dcc_model
from tests.certificate.conftest import CREATED, HOSTILE, KINDS
from tests.refusals import assert_refused
from tests.renamed_sockets import renamed_sockets

DCC, SI = "{https://ptb.de/dcc}", "{https://ptb.de/si}"
MM, RAD = r"\milli\metre", r"\radian"
COVERAGE = ("Factor", "Probability")
PARAMETERS = "Denavit-Hartenberg parameters"


def contents(text: str, path: str) -> list[str]:
    """Texts of ``dcc:content`` below every element of a path."""
    found = ElementTree.fromstring(text).iterfind(path.replace("dcc:", DCC))
    return [content.text or "" for element in found for content in element.iter(f"{DCC}content")]


# The rules that PTB publishes. The XML schema is not in any package: it is downloaded from ptb.de by the tests that
# `-m network` runs. Without a network, certificates are checked against `dcc_model`, written by hand from that schema,
# against PTB's Schematron rules, and by the properties tested further down.


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_content_model_holds(certificates, kind):
    assert dcc_model.faults(certificates[kind]) == []


WRONG = [
    ("<dcc:value>0007</dcc:value>", "<dcc:value> </dcc:value>"),
    ("<dcc:performanceLocation>laboratory", "<dcc:performanceLocation>moon"),
    ("dcc:receiptDate", "dcc:receivedDate"),
    ("<si:coverageProbability>0.95", "<si:coverageProbability>95"),
    ('schemaVersion="3.3.0"', 'schemaVersion="3.2.1"'),
    ("si:valueXMLList", "si:values"),
    ("<dcc:conformity>pass", "<dcc:conformity>yes"),
    ("<si:valueExpandedMU>", "<si:valueExpandedMU>-"),
    ("dcc:measurementMetaData", "dcc:metaDatas"),
]


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(("old", "new"), WRONG)
def test_the_content_model_notices_what_is_wrong(certificates, old, new):
    good = certificates["all stated"]
    assert old in good
    assert dcc_model.faults(good.replace(old, new)) != []


@pytest.fixture(scope="module")
def schema():
    from dcc_json_toolkit import DccSchema

    return DccSchema("3.3.0")


@pytest.mark.network
@pytest.mark.parametrize("kind", KINDS)
def test_the_published_schema_holds(schema, certificates, kind):
    assert schema.validate_dcc(certificates[kind]) == []


@pytest.mark.network
@pytest.mark.parametrize(("old", "new"), WRONG)
def test_the_published_schema_notices_what_is_wrong(schema, certificates, old, new):
    good = certificates["all stated"]
    assert old in good
    assert schema.validate_dcc(good.replace(old, new)) != []


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_published_schematron_rules_hold(certificates, kind):
    from dcclib import validation

    rules = Path(validation.__file__).parent / "schema" / "dcc.sch"
    found = validation.SchematronValidator.from_file(str(rules)).validate_str(certificates[kind])
    reports = [*found.failed_assertions, *found.successful_reports]
    wrong = [report.text for report in reports if report.role != "information"]
    # "Redundant unit specification" is reported of every list of several units, whether they are identical or not.
    tables = [text for text in wrong if text.startswith("Redundant unit specification")]
    wrong = [text for text in wrong if text not in tables]
    assert bool(tables) == ("si:unitXMLList" in certificates[kind])
    # Where no country is stated, ZZ is: one that ISO 3166-1 leaves free, so that nobody takes it for a country.
    stated = kind in ("all stated", "hostile names")
    assert len(wrong) == (0 if stated else 1), wrong
    assert stated or "'ZZ' is not a valid country code" in wrong[0]


# What holds without either


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_elements_are_in_the_order_of_the_schema(certificates, kind):
    root = ElementTree.fromstring(certificates[kind].encode())
    children = lambda element: [child.tag.removeprefix(DCC) for child in element]  # noqa: E731
    assert root.tag == f"{DCC}digitalCalibrationCertificate"
    assert root.get("schemaVersion") == "3.3.0"
    assert children(root) == ["administrativeData", "measurementResults"]
    administrative = "dccSoftware coreData items calibrationLaboratory respPersons customer statements"
    assert children(root[0]) == administrative.split()
    parts = "name description usedMethods usedSoftware measuringEquipments influenceConditions results"
    assert [children(result) for result in root[1]][:2] == [parts.split()] * 2
    core = root[0].find(f"{DCC}coreData")
    dates = "beginPerformanceDate endPerformanceDate performanceLocation"
    given = (
        f"receiptDate {dates} issueDate reportAmendedSubstituted" if kind in ("all stated", "hostile names") else dates
    )
    languages = "usedLangCodeISO639_1 mandatoryLangCodeISO639_1"
    assert core is not None
    assert children(core) == f"countryCodeISO3166_1 {languages} uniqueIdentifier {given}".split()
    found, left = (contents(certificates[kind], f"*/dcc:measurementResult[{n}]/dcc:results/*/dcc:name") for n in (1, 2))
    observations = kind == "observations"
    assert found == ["Repeatability", "Observations" if observations else "Reference lengths", PARAMETERS]
    later = ["Expanded uncertainty", "Covariance matrix", *([] if observations else ["Scale"])]
    held_out = ["Held-out poses"] if kind == "all stated" else []  # those of its evaluation
    assert left == [found[0], *held_out, *found[1:], *later]


def two_digits(found, value: float, expanded: float, digits: int = 2) -> None:
    """U has two significant digits (or so many), and the value as many decimals."""
    step = 10.0 ** (int(f"{expanded:.1e}".partition("e")[2]) + 1 - digits)
    assert found.expanded == pytest.approx(round(expanded / step) * step, rel=1e-12)
    assert found.value == pytest.approx(value, abs=0.5 * step * (1 + 1e-9))
    assert found.value / step == pytest.approx(round(found.value / step), abs=1e-6)


def test_numbers_read_back(record):
    """Values to two digits of their U, angles of parameters to four; exact and certified ones as they were given."""
    text = dcc_xml(record, AdministrativeData(), created=CREATED)
    values = parse_dcc(text)
    uncertainty = aj.uncertainty_of(record)
    factors = dict(zip(record.names, uncertainty.factor(), strict=True))
    coverage = {name: {x.text for x in ElementTree.fromstring(text).iter(f"{SI}coverage{name}")} for name in COVERAGE}
    assert coverage["Probability"] == {"0.95"}
    assert {f"{factor:.4g}" for factor in factors.values()} <= coverage["Factor"]
    arms = {"Nominal parameters": record.recording.nominal.arm, "Calibrated parameters": record.calibrated.arm}
    for stage, arm in arms.items():
        kinds = (("alpha", RAD), ("a", MM), ("d", MM), ("theta", RAD))
        numbers = {f"{kind}_{i + 1}": (float(getattr(arm, kind)[i]), unit) for kind, unit in kinds for i in range(6)}
        numbers |= {f"probe_{axis}": (float(x), MM) for axis, x in zip("xyz", np.asarray(arm.probe), strict=True)}
        for name, (number, unit) in numbers.items():
            found = values[stage, PARAMETERS, name]
            assert found.unit == unit
            if stage == "Calibrated parameters" and name not in record.held:
                i = record.names.index(name)
                expanded = factors[name] * math.sqrt(record.covariance[i, i])
                two_digits(found, number, expanded, digits=4 if unit == RAD else 2)
            else:
                assert found == (number, unit, None)
        metrics = aj.evaluate(arm, record.recording.capture)
        certified = np.array([float(length.u) for length in record.recording.capture.lengths])
        expanded = uncertainty.expanded_by_scatter(np.asarray(metrics.u), certified)
        for name, number in (("DE", "de"), ("Deltam", "deltam"), ("RMS", "rms")):
            found = values[stage, "Repeatability", name]
            assert found == (pytest.approx(float(getattr(metrics.repeatability, number)), abs=5.1e-6), MM, None)
        for i, (length, name) in enumerate(
            zip(record.recording.capture.lengths, ("1: A - B", "2: B - C"), strict=True)
        ):
            row = {key[3]: value for key, value in values.items() if key[:3] == (stage, "Reference lengths", name)}
            # The reference's own uncertainty, not multiplied by this calibration's coverage factor.
            assert row["calibrated value"] == (float(length.value), MM, None)
            two_digits(row["error"], float(metrics.measured[i] - length.value), expanded[i])
            digits = row["error"].expanded / 20  # at least half of the last digit
            assert row["measured value"].value == pytest.approx(float(metrics.measured[i]), abs=digits)
    stated = ElementTree.fromstring(text).iterfind(f".//{DCC}results//{SI}valueStandardMU")
    assert [element.text for element in stated] == ["0.01"] * 2  # that of the first; the second is exact
    k = values["Calibrated parameters", "Scale", "k"]
    two_digits(k, record.k, uncertainty.expanded_k())
    # Three metrics, three numbers for each of two lengths, and 27 parameters, twice; the scale; a length, and
    # three statistics of tips and of such lengths, in both regions; and how much of the joint space poses cover.
    assert len(values) == 2 * (3 + 6 + 27) + 1 + 2 * 2 * 4 + 1
    assert 0 < values["Calibrated parameters", "Expanded uncertainty", "covered"].value <= 1


@pytest.mark.slow
def test_the_covariance_matrix_is_a_table(record, certificates):
    """A row a parameter, with the units of the products; enough digits to be symmetric and positive definite."""
    root = ElementTree.fromstring(certificates["nothing stated"])
    tables = [item for item in root.iter(f"{DCC}list") if contents_of(item, "name") == ["Covariance"]]
    assert len(tables) == 1  # of the calibrated parameters only
    rows = {contents_of(row, "name")[0]: row for row in tables[0].iterfind(f"{DCC}quantity")}
    assert tuple(rows) == record.names
    matrix = np.array([row.findtext(f".//{SI}valueXMLList").split() for row in rows.values()], dtype=float)
    np.testing.assert_allclose(matrix, record.covariance, rtol=1e-7)
    assert np.linalg.eigvalsh(matrix / np.sqrt(np.outer(np.diag(matrix), np.diag(matrix))))[0] > 0
    units = [row.findtext(f".//{SI}unitXMLList").split() for row in rows.values()]
    i, j = record.names.index("a_2"), record.names.index("alpha_1")
    assert (units[i][i], units[i][j], units[j][j]) == (rf"{MM}\tothe{{2}}", MM + RAD, rf"{RAD}\tothe{{2}}")
    bounded = ElementTree.fromstring(certificates["on bounds"])
    left = [row for row in bounded.iter(f"{DCC}quantity") if row.find(f"{SI}realListXMLList") is not None]
    assert [contents_of(row, "name")[0] for row in left] == list(record.names[3:])


def contents_of(element, tag: str) -> list[str]:
    return [content.text or "" for content in element.iterfind(f"{DCC}{tag}/{DCC}content")]


# Acceptance tests and conformity


@pytest.mark.slow
def test_acceptance_results_have_their_conformity_beside_them(evaluation, certificates):
    values = parse_dcc(certificates["all stated"])
    for stage, name in (("nominal", "nominal parameters"), ("calibrated", "calibrated parameters")):
        for test in evaluation.acceptance()[stage]:
            for metric in test.metrics:
                for number, value in enumerate(metric.values, start=1):
                    title = f"{test.called}: {test.title}"
                    row = (f"Acceptance tests, {name}", title, metric.name, f"{number}: {value.where}")
                    two_digits(values[row], value.value, value.expanded)
    root = ElementTree.fromstring(certificates["all stated"])
    metas = [meta for meta in root.iter(f"{DCC}metaData")]
    said = {(contents_of(meta, "name")[0], meta.findtext(f"{DCC}conformity")) for meta in metas}
    assert ("Conformity of Deltam", "pass") in said
    assert {meta.findtext(f"{DCC}norm") for meta in metas} == {aj.acceptance.RULES["iso-2017"]}
    # D_Eff has no limit, so that nothing is said of its conformity.
    assert {name for name, _ in said} <= {"Conformity of Deltam", "Conformity of E_Uni"}
    lacking = [text for text in contents(certificates["all stated"], ".//dcc:result/dcc:description")]
    assert any(
        "The full procedure was not carried out." in text and "30 different positions" in text for text in lacking
    )
    assert not [key for key in parse_dcc(certificates["nothing stated"]) if key[0].startswith("Acceptance")]


@pytest.mark.parametrize(
    ("value", "decision", "word"),
    [
        (0.01, "conforms", "pass"),
        (0.045, "undecided", "conditionalPass"),
        (0.055, "undecided", "conditionalFail"),
        (-0.2, "fails", "fail"),
    ],
)
def test_decisions_in_the_words_of_the_certificate(value, decision, word):
    from aacmm_jax.acceptance.results import MetricValue
    from aacmm_jax.certificate.document import _conformity

    assert _conformity(MetricValue("x", value, 0.01, None, 0.05, decision)) == word


@pytest.mark.slow
def test_a_conformity_rests_on_results(record, full, evaluation):
    def certificate(tested, verdict):
        stated = full.model_copy(update={"conformity": full.conformity.model_copy(update={"verdict": verdict})})
        return lambda: dcc_xml(record, stated, created=CREATED, evaluation=tested)

    assert_refused(certificate(None, "pass"), "conformity", "--evaluation", "remove [conformity]")
    assert_refused(certificate(evaluation._replace(limits={}), "conditionalPass"), "no limit was given")
    failing = evaluation._replace(limits={"Deltam": aj.acceptance.Limit(1e-4)})
    assert_refused(certificate(failing, "pass"), "a limit is not met")
    simulated = evaluation._replace(recording=evaluation.recording._replace(true=record.calibrated))
    assert_refused(certificate(simulated, "pass"), "simulated")
    text = dcc_xml(record, AdministrativeData(), created=CREATED, evaluation=simulated)
    assert "<dcc:conformity>" not in text
    other = evaluation._replace(calibrated=record.recording.nominal)
    assert_refused(certificate(other, "pass"), "another calibration")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("before", "limit", "english", "german"),
    [
        ("nominal", 0.5, "; with the nominal parameters, the arm fails ({})", "; mit den Nennparametern hält"),
        ("as_found", 0.5, "; with the parameters as found, the arm fails ({})", "; mit den Parametern bei Eingang"),
        ("nominal", 50.0, "", ""),
    ],
)
def test_conformity_is_of_the_calibrated_parameters(record, full, evaluation, before, limit, english, german):
    """And where the arm fails with those before, this is stated as well. Printed metrics have their words beside
    them."""
    as_found = record.recording.nominal if before == "as_found" else None
    record, evaluation = (x._replace(recording=x.recording._replace(as_found=as_found)) for x in (record, evaluation))
    evaluation = evaluation._replace(limits={"Deltam": aj.acceptance.Limit(limit)})
    worst = {stage: tests[0].metrics[0].value for stage, tests in evaluation.acceptance().items()}
    assert (worst[before] > limit) == bool(english)
    assert worst["calibrated"] < 0.1
    stated = Conformity(verdict="pass", specification="S")
    dcc = dcc_xml(record, full.model_copy(update={"conformity": stated}), created=CREATED, evaluation=evaluation)
    assert dcc_model.faults(dcc) == []
    (says,) = [x for x in contents(dcc, "*/dcc:statements") if x.startswith("The statement of conformity holds")]
    assert (
        says.endswith(english[2:].replace("with", "With").format("Deltam") + ".")
        if english
        else says.endswith("parameters loaded into it.")
    )
    deltam = {
        "en": "largest half range of a coordinate in a socket",
        "de": "größte halbe Spannweite einer Koordinate",
    }
    decimal = {"en": ".", "de": ","}
    procedure = {
        "en": ("Test procedure", "based on JJF 1408-2013, not carried out in full: 30 different positions are required "
               "(1 given)"),
        "de": ("Prüfverfahren", "in Anlehnung an JJF 1408-2013, nicht vollständig durchgeführt: Gefordert sind 30 "
               "verschiedene Orte (vorhanden: 1)"),
    }  # fmt: skip
    for language, begins, fails, loaded in (
        (
            "en",
            "conforms, with the c",
            english.format(deltam["en"]),
            "with the calibrated parameters of this certificate loaded into it",
        ),
        ("de", "konform, mit den k", german, "wenn die kalibrierten Parameter dieses Kalibrierscheins in ihm geladen"),
    ):
        # On the first page, behind the identification; verdict, specification, rule, limits, procedure.
        (identified, section, *_), _ = printed_certificate(dcc, language=language).pages.pages
        assert identified.title.startswith("Identifi")
        (key, text), *about = section.facts
        assert key in ("Statement of conformity", "Konformitätsaussage")
        assert about[0] == ({"en": "Specification", "de": "Spezifikation"}[language], "S")
        assert about[1][1].startswith("ISO 14253-1:2017")
        assert about[2][1].startswith(f"Deltam, {deltam[language]}: {limit:g}".replace(".", decimal[language]))
        assert about[3] == procedure[language]
        assert loaded in section.paragraphs[0]
        assert text.startswith(begins)
        assert fails in text
        assert (";" in text) == bool(fails)


@pytest.mark.parametrize(
    ("stated", "used", "printed"),
    [
        (None, "iso-2017", ""),
        ("ISO 14253-1:2017", "iso-2017", ""),
        ("ISO 14253-1", "iso-2013", ""),
        ("ISO 14253-1, guard band as agreed", "iso-2013", "; ISO 14253-1, guard band as agreed"),
        ("house rule 1", "simple", "; house rule 1"),
        ("simple acceptance", "simple", ""),
        ("simple acceptance", "iso-2017", None),
        ("ISO 14253-1:2013", "iso-2017", None),
        ("ASME B89.7.3.1", "iso-2013", None),
        ("ISO 14253-1:2017", "simple", None),
    ],
)
def test_a_stated_rule_is_that_of_the_evaluation(stated, used, printed):
    about = AdministrativeData(
        conformity=Conformity(verdict="pass", specification="maker's limits", decision_rule=stated)
    )
    if printed is None:
        parts = "conformity.decision_rule", f"'{stated}'", aj.acceptance.RULES[used], "--rule"
        assert_refused(lambda: check_conformity(about, simulated=False, decision="conforms", rules=[used]), *parts)
    else:
        check_conformity(about, simulated=False, decision="conforms", rules=[used, used])
        assert about.conformity.decided_by([used, used]) == aj.acceptance.RULES[used] + printed


@given(st.floats(-1e4, 1e4), st.floats(1e-9, 1e3))
def test_values_are_rounded_to_two_digits_of_their_uncertainty(value, u):
    parent = ElementTree.Element("x")
    parent.append(xml_elements.real(value, MM, u, 2.0))
    one = ElementTree.fromstring(xml_elements.xml_text(parent).replace("si:", ""))[0]
    digits = (one.findtext(".//valueExpandedMU") or "").replace(".", "").lstrip("0")
    assert len(digits.rstrip("0") or "0") <= 2
    assert float(one.findtext(".//valueExpandedMU") or "nan") == pytest.approx(2 * u, rel=0.051)
    assert abs(float(one.findtext("value") or "nan") - value) <= 0.0501 * 2 * u * 1.06 + 1e-12


@pytest.mark.slow
def test_observations_are_stated_with_what_is_certified_of_them(observed_record, certificates):
    """The values of the artefacts' own certificates: not the distances of the tip's centre."""
    text = certificates["observations"]
    ball = observed_record.recording.capture.observations[1]
    equipments = {
        element.findtext(f"{DCC}name/{DCC}content"): {
            quantity.findtext(f"{DCC}name/{DCC}content"): tuple(
                quantity.findtext(f".//{SI}{tag}") for tag in ("value", "unit", "valueStandardMU")
            )
            for quantity in element.iter(f"{DCC}measuringEquipmentQuantity")
        }
        for element in ElementTree.fromstring(text).findall(f".//{DCC}measuringEquipment")[:4]
    }
    assert equipments["ball"] == {"certified diameter": (repr(float(ball.diameter)), MM, "0.001")}
    assert list(equipments["block"]) == ["certified distance between the planes"]
    assert equipments["bar"]["certified coordinates of far, x"] == ("300.0", MM, "0.0005")
    assert [value[1:] for value in equipments["tracker"].values()] == [(MM, None), (RAD, None)]
    values = parse_dcc(text)
    found = observed_record.observed
    for i, name in enumerate(found.names):
        row = ("Calibrated parameters", "Observations", f"{i + 1}: {name}")
        assert values[*row, "RMS residual"][:2] == (pytest.approx(found.rms_after[i], abs=5.1e-6), MM)
        chi = values[*row, "RMS residual in standard deviations"].value
        assert chi == pytest.approx(found.reduced_chi[i], abs=5.1e-4)
        assert values["Nominal parameters", *row[1:], "RMS residual"].value > 0.3
    assert ("Calibrated parameters", "Observations", "3: tracker", "RMS residual in rad") in values
    assert ("Calibrated parameters", "Scale", "k") not in values
    said = " ".join(contents(text, "*/dcc:statements"))
    assert "comes from tracker (transforms), ball (sphere), block (parallel planes), bar (artefact)." in said
    assert "robust loss 'tukey'" in text


def test_the_target_of_a_camera_has_its_size_and_the_u_of_its_scale():
    corners = [[[100, 100], [200, 100], [100, 200], [200, 200]]]
    points = [[[0, 0, 0], [30, 0, 0], [0, 40, 0], [30, 40, 0]]]
    named = (0.3, "webcam", "board")
    seen = aj.data.observations.Pixels(
        "eye", [[0.1]], corners, points, [[0, 1, 2, 3]], *named, intrinsics=(600, 600, 320, 240), u_scale=1e-3
    )
    size = measurement_results._size(seen)
    assert (size.values.tolist(), size.unit, size.u) == ([50.0], "mm", 0.05)


@pytest.mark.slow
def test_uncertainties_of_tips_and_lengths_are_those_over_the_working_volume(record, certificates):
    values, volume = parse_dcc(certificates["nothing stated"]), aj.volumetric_uncertainty(aj.uncertainty_of(record))
    for name, key in (("Tip position", "tip"), ("Measured length", "length_reading")):
        stated = ("Calibrated parameters", "Expanded uncertainty", f"{name}, over all joint limits")
        assert values[*stated, "length"].value == volume.length
        for statistic, words in (("median", "median"), ("95", "95th percentile"), ("largest", "largest")):
            expected = volume.summary[f"expanded_{key}_{statistic}_mm"]
            assert values[*stated, words][:2] == (pytest.approx(expected, rel=0.05), MM)  # of two digits


@pytest.mark.slow
def test_held_out_poses_have_their_errors(record):
    rows = aj.residuals_of(record).select(range(5))
    values = parse_dcc(
        dcc_xml(record._replace(held_out=rows._replace(use=("held out",) * 5)), AdministrativeData(), created=CREATED)
    )
    stated = ("Calibrated parameters", "Held-out poses")
    assert values[*stated, "poses"].value == 5
    assert values[*stated, "RMS distance"].value == pytest.approx(np.sqrt(np.mean(rows.distance**2)), abs=5.1e-6)
    assert values[*stated, "largest distance"].value == pytest.approx(rows.distance.max(), abs=5.1e-6)


@pytest.mark.slow
def test_held_out_poses_of_an_evaluation_are_those_that_it_shows(evaluation, certificates):
    held_out = evaluation_summary(evaluation)["held_out"]
    poses, by_arm = held_out["predicted"]["poses"], held_out["calibrated"]
    shown = {
        "poses": poses["poses"],
        "RMS distance": poses["rms_mm"],
        "largest distance from the mean position": by_arm["distance_largest_mm"],
        "RMS distance, predicted": poses["rms_predicted_mm"],
    }
    values = parse_dcc(certificates["all stated"])
    stated = {key[2]: value.value for key, value in values.items() if key[1] == "Held-out poses"}
    assert stated == pytest.approx(shown, abs=5.1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("value", [5e-324, -0.0, 1e-5, 0.1, 1 / 3, -123456789.125, 1e99])
def test_any_number_reads_back(record, value):
    text = dcc_xml(record, AdministrativeData(), created=CREATED)
    k = f"<si:value>{parse_dcc(text)['Calibrated parameters', 'Scale', 'k'].value!r}</si:value>"
    assert text.count(k) == 1
    parent = ElementTree.Element("x")
    parent.append(xml_elements.real(value, MM))
    again = ElementTree.fromstring(xml_elements.xml_text(parent).replace("si:", ""))[0]
    read = parse_dcc(text.replace(k, f"<si:value>{again.findtext('value')}</si:value>"))[
        "Calibrated parameters", "Scale", "k"
    ].value
    assert (read, math.copysign(1, read)) == (value, math.copysign(1, value))


@pytest.mark.slow
def test_parameters_without_an_uncertainty_of_their_own_say_why(record, certificates):
    text = certificates["on bounds"]
    values = parse_dcc(text)
    found, left = (
        {
            quantity.findtext(f"{DCC}name/{DCC}content"): quantity.findtext(f"{DCC}description/{DCC}content")
            for quantity in results.iter(f"{DCC}quantity")
        }
        for results in ElementTree.fromstring(text).iterfind(f"*/{DCC}measurementResult/{DCC}results")
    )
    words = {
        record.names[0]: "Determined only together with other",
        record.names[1]: "On its lower bound",
        record.names[2]: "On its upper bound",
        "theta_1": "fixed at its nominal value",
        "d_1": "fixed at its nominal value",
    }
    for name, word in words.items():
        assert word in left[name]
        assert values["Calibrated parameters", PARAMETERS, name].expanded is None
        assert found[name] is None
    assert all(
        "divided" not in text for text in left.values() if text
    )  # d_1 only says where the base is, the others are 0
    others = set(record.names) - set(words)
    assert others
    assert all(left[name] is None and values["Calibrated parameters", PARAMETERS, name].expanded for name in others)


@pytest.mark.slow
def test_priors_and_joint_corrections_are_stated(record):
    """What was assumed is part of the statement on uncertainty, coefficients have their own units."""
    capture = record.recording.capture
    nominal = aj.kinematics.with_corrections(record.recording.nominal.arm, "gear,harmonics=1")
    bounds = aj.Bounds.around(nominal, aj.Parameters(nominal, ("d_3", "theta_3", "gear_2", "cos1_3", "sin1_3")))
    prior = aj.Prior({"lengths": 0.5, "harmonics": 5e-5}, learn=["harmonics"])
    found = aj.calibrate(nominal, capture, bounds, prior=prior, undetermined="ignore")
    named = record.recording.nominal._replace(arm=nominal)
    text = dcc_xml(aj.calibration.record_of(found, aj.Recording(capture, named)), AdministrativeData(), created=CREATED)
    assert dcc_model.faults(text) == []
    stated = " ".join(contents(text, ".//dcc:usedMethod/dcc:description"))
    assert "prior knowledge of the parameters" in stated
    assert "lengths: given, 0.5 mm; " in stated
    assert "harmonics: learned" in stated
    assert "Denavit-Hartenberg model with the joint corrections below does not describe" in stated
    assert "Each joint correction adds its coefficient" in text


@pytest.mark.slow
def test_a_fixed_length_says_so(record):
    i = record.names.index("probe_z")
    parts = ("lower", "upper", "active_stage1", "active", "determined")
    fewer = {name: np.delete(getattr(record, name), i) for name in parts}
    square = {name: np.delete(np.delete(getattr(record, name), i, 0), i, 1) for name in ("covariance", "open")}
    names = tuple(name for name in record.names if name != "probe_z")
    text = dcc_xml(
        record._replace(names=names, held=(*record.held, "probe_z"), shared=None, components=None, **fewer, **square),
        AdministrativeData(),
        created=CREATED,
    )
    assert dcc_model.faults(text) == []
    assert "Not identified: fixed at its nominal value" in text
    assert parse_dcc(text)["Calibrated parameters", PARAMETERS, "probe_z"].expanded is None


@pytest.mark.slow
def test_what_is_stated_is_in_the_certificate(certificates, full):
    text = certificates["all stated"]
    root = ElementTree.fromstring(text.encode())
    path = lambda *tags: "/".join(f"{DCC}{tag}" for tag in ("administrativeData", *tags))  # noqa: E731
    expected = {
        ("coreData", "countryCodeISO3166_1"): "CH",
        ("coreData", "uniqueIdentifier"): "2026-1",
        ("coreData", "receiptDate"): "2026-02-01",
        ("coreData", "beginPerformanceDate"): "2026-02-02",
        ("coreData", "endPerformanceDate"): "2026-02-03",
        ("coreData", "issueDate"): "2026-02-04",
        ("coreData", "performanceLocation"): "laboratory",
        ("items", "item", "name", "content"): 'arm "7"',
        ("coreData", "reportAmendedSubstituted", "replacedUniqueIdentifier"): "2025-9",
        ("items", "item", "description", "content"): "worn & dry",
        ("items", "item", "manufacturer", "name", "content"): "maker",
        ("items", "item", "model"): "X'1",
        ("items", "item", "identifications", "identification", "value"): "0007",
        ("items", "item", "identifications", "identification[2]", "value"): "c <7>",
        ("calibrationLaboratory", "calibrationLaboratoryCode"): "D-K-00000-01-00",
        ("calibrationLaboratory", "contact", "name", "content"): "Längenlabor <b>&amp; Söhne</b>",
        ("calibrationLaboratory", "contact", "eMail"): "a@b.example",
        ("calibrationLaboratory", "contact", "location", "street"): "Maßstraße 1",
        ("calibrationLaboratory", "contact", "location", "postCode"): "01234",
        ("customer", "name", "content"): "]]> & Co.",
        ("customer", "location", "countryCode"): "FR",
        ("respPersons", "respPerson", "role"): "head",
        ("respPersons", "respPerson", "mainSigner"): "true",
        ("respPersons", "respPerson[2]", "person", "name", "content"): "Βύρων",
        ("statements", "statement", "conformity"): "conditionalPass",
    }
    assert {place: root.findtext(path(*place)) for place in expected} == expected
    assert "first line\nsecond line" in contents(text, "*/dcc:statements")
    assert "a.h5, <b>.toml" in contents(text, "*/dcc:statements")
    equipment = "*/dcc:measurementResult[1]/dcc:measuringEquipments/dcc:measuringEquipment"
    assert contents(text, f"{equipment}/dcc:name") == ["ball bar", "Reference lengths", "Lengths of the test"]
    assert parse_dcc(text)["Calibrated parameters", "Scale", "k"].expanded
    temperature = root.find(f"*/{DCC}measurementResult/{DCC}influenceConditions//{SI}real")
    assert temperature is not None
    assert [item.text for item in temperature.iter() if item.text and item.text.strip()] == [
        "20.25",
        r"\degreecelsius",
        "0.1",
    ]


@pytest.mark.slow
def test_nothing_is_made_up(record):
    text = dcc_xml(record, AdministrativeData(), created=CREATED)
    root = ElementTree.fromstring(text)
    core = [(child.tag.removeprefix(DCC), child.text) for child in root[0][1]]
    assert ("countryCodeISO3166_1", "ZZ") in core
    assert [text for name, text in core if name.endswith("Date")] == ["2026-03-05"] * 2
    for part in ("calibrationLaboratory", "customer", "respPersons"):
        assert set(contents(text, f"*/dcc:{part}")) == {"not stated"}
    # The schema wants an address, and the Schematron rules a condition: where there is none, they say so.
    for place in ("dcc:calibrationLaboratory/dcc:contact", "dcc:customer"):
        assert contents(text, f"*/{place}/dcc:location/dcc:further") == ["not stated"]
    assert contents(text, "*/dcc:measurementResult/dcc:influenceConditions/*/dcc:data") == ["not stated"] * 2
    assert contents(text, "*/dcc:items/dcc:item/dcc:name")[0] == "small & fine"
    status = [element.text for element in root.iter(f"{DCC}status")]
    assert status == ["afterAdjustment"]
    names = contents(text, "*/dcc:statements/dcc:statement/dcc:name")
    assert not {"Conformity", "Simulation", "Files", "Remarks"} & set(names)
    assert names[:2] == ["Scale", "Uncertainty"]


@pytest.mark.slow
def test_what_was_left_out_is_stated(record):
    removed = Removed("station", "T2", ("T2/day", "T2/night"), 45.6, (6, 60), 1e-9, 0.2, 0.1, "theta_3", 12.0)
    text = dcc_xml(record._replace(removed=(removed,)), AdministrativeData(), created=CREATED)
    assert dcc_model.faults(text) == []
    (said,) = [one for one in contents(text, "*/dcc:statements") if "T2" in one]
    assert said.startswith(
        "Left out: station T2, which contradicts the other data (F = 45.6 with 6 and 60 degrees of freedom"
    )
    assert said.endswith("Sockets, observations or poses left out: T2/day, T2/night.")
    assert sum("they contradict the rest: station T2;" in one for one in contents(text, ".//dcc:usedMethods")) == 2
    # What was done wrong with poses concerns sockets that remain.
    poses = removed._replace(
        kind="poses",
        group="A pose 1, A pose 7 (recorded under A, but B fits)",
        members=("A", "B", "A pose 1", "A pose 7"),
    )
    text = dcc_xml(record._replace(removed=(poses, removed)), AdministrativeData(), created=CREATED)
    assert any(one.endswith(" left out: A pose 1, A pose 7.") for one in contents(text, "*/dcc:statements"))
    notes = printed_certificate(text, language="de").pages.pages[1][-1].notes
    assert notes[0].startswith("Nicht verwendet, weil sie den übrigen Daten widersprechen: ")
    assert all(
        says in notes[0] for says in ("A (Stellungen 1, 7)", "T2/day, T2/night – aufgezeichnet unter A, passend zu B.")
    )
    (english, *_) = printed_certificate(text).pages.pages[1][-1].notes
    assert english.startswith("Left out: A pose 1, A pose 7 (recorded under A, but B fits), which contradict")
    hostile = record._replace(removed=(removed._replace(members=("A\x1b",)),))
    assert_refused(lambda: dcc_xml(hostile, AdministrativeData(), created=CREATED), r"A\x1b", "U+001B")


@pytest.mark.slow
def test_warnings_and_simulations_are_stated(record):
    recording = record.recording
    given = aj.Noise(encoder_arcsec=2.0 / 3, seating=0.005 / 3)
    simulated = record._replace(recording=recording._replace(true=recording.nominal), reduced_chi=3.0, noise=given)
    warnings = sentences(findings_of(simulated))
    assert any("times as large as the given noise predicts" in sentence for sentence in warnings)
    text = dcc_xml(simulated, AdministrativeData(), created=CREATED)
    assert dcc_model.faults(text) == []
    said = contents(text, "*/dcc:statements")
    assert set(warnings) <= set(said)
    assert "The readings are simulated, so this is not a certificate of a real arm." in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stated", "begin", "end"),
    [
        ({}, "2026-03-05", "2026-03-05"),
        ({"begin": "2026-03-01"}, "2026-03-01", "2026-03-05"),
        ({"begin": "2026-04-01"}, "2026-04-01", "2026-04-01"),
        ({"end": "2026-03-04"}, "2026-03-04", "2026-03-04"),
        ({"begin": "2026-03-01", "end": "2026-03-02"}, "2026-03-01", "2026-03-02"),
    ],
)
def test_the_day_of_the_calibration_stands_in_for_missing_dates(record, stated, begin, end):
    dates = {name: datetime.date.fromisoformat(text) for name, text in stated.items()}
    text = dcc_xml(record, AdministrativeData(certificate=Certificate(**dates)), created=CREATED)
    assert f"<dcc:beginPerformanceDate>{begin}<" in text
    assert f"<dcc:endPerformanceDate>{end}<" in text


@pytest.mark.slow
def test_the_same_calibration_has_the_same_certificate(record):
    one, again = (dcc_xml(record, AdministrativeData(), created=CREATED) for _ in range(2))
    assert one == again
    other = dcc_xml(record, AdministrativeData(item=CalibratedItem(name="other")), created=CREATED)

    def identifier(text: str) -> str | None:
        return ElementTree.fromstring(text).findtext(f"*/{DCC}coreData/{DCC}uniqueIdentifier")

    assert identifier(one) != identifier(other)


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names_stay_text(record, name):
    record = renamed_sockets(record, name, "B", "C")
    record = record._replace(recording=record.recording._replace(nominal=record.recording.nominal._replace(name=name)))
    text = dcc_xml(record, AdministrativeData(), created=CREATED, command=name)
    assert ("Calibrated parameters", "Reference lengths", f"1: {name} - B", "error") in parse_dcc(text)
    assert contents(text, "*/dcc:items/dcc:item/dcc:name")[0] == name
    assert name in contents(text, "*/dcc:measurementResult/dcc:usedSoftware")
    assert all(element.tag.startswith((DCC, SI)) for element in ElementTree.fromstring(text).iter())


def is_held_by_xml(text: str) -> bool:
    """XML 1.0, section 2.2: all but C0 controls (except tab, line feed, return), surrogates, U+FFFE and U+FFFF."""
    return not any(
        (ord(c) < 32 and c not in "\t\n\r") or 0xD800 <= ord(c) <= 0xDFFF or c in "\ufffe\uffff" for c in text
    )


@given(st.text(st.characters()) | st.text(st.sampled_from("\x00\x1f\x7f\x85\u2028\ufffe\uffff\ud800\t\n\r <>&]\"'a")))
def test_any_text_survives_or_is_refused(text):
    def there_and_back() -> str | None:
        from aacmm_jax.files.administrative_data import held_by_xml

        parent = ElementTree.Element("x")
        parent.append(xml_elements.text("name", held_by_xml(text, "a name")))
        without_prefix = re.sub("(</?)dcc:", r"\1", xml_elements.xml_text(parent))
        return ElementTree.fromstring(without_prefix.encode()).findtext("name/content")

    if is_held_by_xml(text):
        assert there_and_back() == text
    else:
        assert_refused(there_and_back, "a name", "U+")


# Refusals


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("changes", "keywords", "parts"),
    [
        (
            {"converged": False, "reason": "Not converged: too few steps; allow more."},
            {},
            ["too few steps", "calibrate again"],
        ),
        ({"k": 25.4}, {}, ["25.4", "correct the values of the reference lengths"]),
        ({"method": "repeatability"}, {}, ["traceable", "--scale nominal", "another observation"]),
        ({}, {"created": "yesterday"}, ["yesterday", "ISO 8601"]),
        ({}, {"sources": ["a\x07.h5"]}, [r"'a\x07.h5' in the certificate", "U+0007", "remove the character"]),
        ({}, {"command": "aacmm \x00"}, [r"'\x00'", "U+0000"]),
    ],
)
def test_what_cannot_be_certified_is_refused(record, changes, keywords, parts):
    assert_refused(
        lambda: dcc_xml(record._replace(**changes), AdministrativeData(), **{"created": CREATED} | keywords), *parts
    )


def printed(dcc: str, language: str = "en") -> dict[str, sections.Section]:
    """The parts of the first page, by their titles."""
    return {section.title: section for section in printed_certificate(dcc, language=language).pages.pages[0]}


@pytest.mark.slow
def test_references_have_the_lengths_that_they_stand_for(record, evaluation):
    """Of calibration and evaluation, in the DCC and printed, those of the test apart; what no reference has remains by
    itself."""
    plate, bar = Reference(name="plate", serial_number="7", lengths=["A - B"]), Reference(name="bar", lengths=["D*"])
    about = AdministrativeData(reference=[plate, bar, Reference(name="sphere")])
    text = dcc_xml(record, about, created=CREATED, evaluation=evaluation)
    assert dcc_model.faults(text) == []
    rows, of_test = (
        [(row[0], row[-1].replace("\u00a0", " ")) for row in printed(text)[title].table]
        for title in ("Traceability", "Used for the test only")
    )
    values = [part.recording.capture.lengths for part in (record, evaluation)]
    a_b, b_c, d_e = (f"{float(length.value):.7g}" for lengths in values for length in lengths)
    assert rows == [
        ("plate", f"A - B: {a_b} mm (u = 0.01 mm)"),
        ("sphere", "–"),
        ("Reference lengths", f"B - C: {b_c} mm"),
    ]
    assert of_test == [("bar", f"D - E: {d_e} mm (u = 0.001 mm)")]
    both = AdministrativeData(reference=[Reference(name="plate", lengths=["A - B", "D - E"])])
    text_of_both = dcc_xml(record, both, created=CREATED, evaluation=evaluation)
    assert "test only: " in printed(text_of_both)["Traceability"].table[0][-1]
    assert "Used for the test only" not in printed(text_of_both)
    none = AdministrativeData(reference=[Reference(name="bar")])
    (row,) = printed(dcc_xml(record, none, created=CREATED, evaluation=evaluation))["Used for the test only"].table
    assert [x.replace("\u00a0", " ") for x in row] == ["Lengths of the test", f"D - E: {d_e} mm (u = 0.001 mm)"]
    assert printed(text)["Traceability"].headings[1:3] == ["Serial number", "Certified values, u (k = 1)"]
    everything = AdministrativeData(reference=[Reference(name="plate", lengths=["A - B", "B - C"])])
    assert "Reference lengths" not in contents(
        dcc_xml(record, everything, created=CREATED), ".//dcc:measuringEquipment"
    )
    assert_refused(
        lambda: dcc_xml(record, about, created=CREATED),
        *("'bar'", "'D*'", "is not one of the calibration or the evaluation", "A - B, B - C", "--evaluation"),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mark", "says", "title", "banner", "german"),
    [
        ("good", "Calibrated: U is 0.01 mm.", "", "", ""),
        ("unsure", "To be used with care: play.", "To be used with care", "", "Nur mit Vorbehalt"),
        ("bad", "Not usable: bent.", "Not usable", "Not usable: the arm must not be used", "Nicht verwendbar"),
    ],
)
def test_a_calibration_to_be_used_with_care_says_so(record, monkeypatch, mark, says, title, banner, german):
    monkeypatch.setattr(document, "calibration_summary", lambda _: {"verdict": {"mark": mark, "says": says}})
    text = dcc_xml(record, AdministrativeData(), created=CREATED)
    assert dcc_model.faults(text) == []
    stated = contents(text, ".//dcc:statement")
    pages, paragraphs = printed_certificate(text).pages, printed(text)["Measurement uncertainty"].paragraphs
    assert ([title, says] == stated[(i := stated.index(title)) : i + 2]) if title else says not in stated
    assert paragraphs[1:] == ([says] if title else [])
    assert pages.banner.startswith(banner)
    assert bool(pages.banner) == bool(banner)
    translated = printed(text, "de")["Messunsicherheit"].paragraphs[1:]
    assert [words.startswith(german) for words in translated] == ([True] if title else [])


@pytest.mark.slow
def test_the_verdict_is_that_of_the_calibration(record, monkeypatch):
    """As the terminal says it: residuals larger than those of an arm."""
    observed = eqx.tree_at(lambda metrics: metrics.rms_after, record.observed, record.observed.rms_after * 300)
    coarse = record._replace(observed=observed)
    verdict = calibration_summary(coarse)["verdict"]
    assert verdict["mark"] in ("unsure", "bad")
    assert verdict["says"] in contents(dcc_xml(coarse, AdministrativeData(), created=CREATED), ".//dcc:statement")


@pytest.mark.slow
def test_the_uncertainty_says_whether_it_includes_errors_beyond_the_model(record):
    """Where residuals show shared errors, the covariance contains them."""
    assert record.shared is not None
    for shared, included in ((record.shared, "included as far as the residuals show them"), (None, "not included")):
        says = measurement_results.uncertainty_statement(record._replace(shared=shared))
        assert says.endswith(f"Errors that the Denavit-Hartenberg model does not describe are {included}.")


@pytest.mark.slow
def test_names_that_xml_cannot_hold_are_refused(record):
    assert_refused(
        lambda: dcc_xml(renamed_sockets(record, "A\x1b", "B", "C"), AdministrativeData(), created=CREATED),
        r"'A\x1b' in the certificate",
        "U+001B",
    )
    nominal = record.recording.nominal._replace(name="\ud800")
    broken = record._replace(recording=record.recording._replace(nominal=nominal))
    assert_refused(lambda: dcc_xml(broken, AdministrativeData(), created=CREATED), r"'\ud800' in", "U+D800")


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("stated", "part"),
    [({"received": "2026-03-06"}, "certificate.received"), ({"issued": "2026-03-04"}, "certificate.issued")],
)
def test_dates_that_contradict_the_calibration_are_refused(record, stated, part):
    dates = {name: datetime.date.fromisoformat(text) for name, text in stated.items()}
    assert_refused(
        lambda: dcc_xml(record, AdministrativeData(certificate=Certificate(**dates)), created=CREATED),
        part,
        "2026-03-05",
    )


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ('[item]\nname = "a\\u0007b"', ["item.name", "U+0007"]),
        ('[[person]]\nname = "Ada"\n[[person]]\nname = "\\u0000"', ["person 2.name", "U+0000"]),
        ('[item]\nname = " "', ["item.name", "empty"]),
        ('[itm]\nname = "a"', ["itm", "did you mean 'item'"]),
        ('[laboratory]\nnmae = "a"', ["laboratory.nmae", "did you mean 'name'"]),
        ('[laboratory]\ncountry = "Germany"', ["laboratory.country", "'Germany'", "two capital letters"]),
        ('[laboratory]\ncountry = "DE\\n"', ["laboratory.country"]),
        ('[[person]]\nrole = "head"', ["person 1.name", "missing"]),
        ('[person]\nname = "Ada"', ["[[person]]"]),
        ('[certificate]\nplace = "moon"', ["certificate.place", "laboratory", "'moon'"]),
        ('[certificate]\nbegin = "soon"', ["certificate.begin", "'soon'"]),
        ("[certificate]\nbegin = 2026-02-02\nend = 2026-02-01", ["begin (2026-02-02)", "is after end"]),
        ("[certificate]\nreceived = 2026-02-02\nissued = 2026-02-01", ["received (2026-02-02)", "is after issued"]),
        ("[certificate]\ntemperature_u_celsius = 0.1", ["temperature_celsius", "give both"]),
        ("[certificate]\ntemperature_celsius = 20.0\ntemperature_u_celsius = inf", ["temperature_u_celsius", "finite"]),
        ("[certificate]\ntemperature_celsius = 20.0\ntemperature_u_celsius = -1.0", ["temperature_u_celsius"]),
        ('[conformity]\nverdict = "pass"', ["conformity", "missing"]),
        ("[item", ["not valid TOML"]),
    ],
)
def test_what_is_said_about_a_certificate_is_checked(tmp_path, content, parts):
    path = tmp_path / "about.toml"
    path.write_text(content)
    assert_refused(lambda: read_administrative_data(path), path, *parts)


def test_everything_about_a_certificate_is_optional(tmp_path, full):
    path = tmp_path / "about.toml"
    path.write_text("")
    assert read_administrative_data(path) == AdministrativeData()
    assert AdministrativeData().country == "ZZ"
    assert AdministrativeData(laboratory=Laboratory(country="DE")).country == "DE"
    assert full.country == "CH"
    assert full.person[0] == Person(name="Ada", role="head", main_signer=True)
    assert full.reference[0].certificate_number == "K 17"
    assert isinstance(full.conformity, Conformity)
    assert Reference(name=" bar\n").name == "bar"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["not valid XML"]),
        ("<a", ["not valid XML"]),
        ("<a>\x00</a>", ["not valid XML"]),
        ("\ud800", ["not valid XML"]),
        ("<a/>", ["'a'", "give a DCC"]),
        ('<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/hostname">]><a>&x;</a>', ["document type", "remove it"]),
        ('<!DOCTYPE a SYSTEM "http://localhost/a.dtd"><a/>', ["document type"]),
    ],
)
def test_what_is_no_certificate_is_refused(text, parts):
    assert_refused(lambda: parse_dcc(text), *parts)


@pytest.mark.slow
def test_a_certificate_whose_number_was_edited_is_refused(record):
    text = dcc_xml(record, AdministrativeData(), created=CREATED)
    k = f"<si:value>{parse_dcc(text)['Calibrated parameters', 'Scale', 'k'].value!r}</si:value>"
    numbers = (f"<si:value>{number}</si:value>" for number in ("1_0", "\u0663", "NaN", "INF", "1e300", "9" * 5001))
    for edited in (k.replace(".", ","), "", *numbers):
        assert_refused(
            lambda edited=edited: parse_dcc(text.replace(k, edited)),
            "'Calibrated parameters / Scale / k'",
            "not a number",
        )


@pytest.mark.parametrize("kind", kinds.KINDS.values(), ids=lambda kind: kind.model)
def test_every_unit_of_a_correction_has_its_name_in_d_si(kind):
    loads = Loads((1.0,) * 3, ((0.0, 0.0, 0.0),) * 3)
    units = {term.unit for with_masses in (None, loads) for term in kind.terms(3, "", with_masses)}
    for unit in units | {unit.replace("rad", "mm") for unit in units}:
        assert parameter_results.in_d_si(unit).startswith("\\")


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("1", r"\one"),
        ("mm", r"\milli\metre"),
        ("1/K", r"\kelvin\tothe{-1}"),
        ("rad/(kN m)", r"\radian\kilo\newton\tothe{-1}\metre\tothe{-1}"),
    ],
)
def test_units_in_d_si(unit, expected):
    assert parameter_results.in_d_si(unit) == expected
