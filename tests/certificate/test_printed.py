"""The printed certificate: HTML and PDF say the same, and what they say is in the DCC that the PDF holds."""

import contextlib
import io
import math
import re
import unicodedata
import zlib
from decimal import Decimal
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest

import aacmm_jax as aj
from aacmm_jax.certificate import languages, printed_certificate, sections, xml_elements
from tests.certificate import dcc_model
from tests.certificate.conftest import CREATED, KINDS
from tests.refusals import assert_refused

SVG = b'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 2 1"><rect width="2" height="1"/></svg>'


def _chunk(kind: bytes, data: bytes) -> bytes:
    return len(data).to_bytes(4) + kind + data + zlib.crc32(kind + data).to_bytes(4)


_HEADER = (1).to_bytes(4) * 2 + bytes((8, 2, 0, 0, 0))  # one pixel, RGB
PNG = b"\x89PNG\r\n\x1a\n" + b"".join(
    _chunk(*part) for part in ((b"IHDR", _HEADER), (b"IDAT", zlib.compress(bytes(4))), (b"IEND", b""))
)


class Texts(HTMLParser):
    """The texts of a page, without its style."""

    def __init__(self, page: str):
        super().__init__()
        self.texts: list[str] = []
        self.tags: set[str] = set()
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.hidden = tag in ("style", "title") or ("class", "screen") in attrs or (tag == "a" and self.hidden)

    def handle_data(self, data):
        if data.strip() and not self.hidden:
            self.texts.append(data.strip())


def page(dcc: str, language: str) -> str:
    return printed_certificate(dcc, language=language).html()


def squeezed(text: str) -> str:
    """Without blanks, and with ligatures taken apart."""
    return re.sub(r"\s", "", unicodedata.normalize("NFKC", text))


@pytest.fixture(scope="module")
def read():
    pypdf = pytest.importorskip("pypdf")
    return lambda pdf: pypdf.PdfReader(io.BytesIO(pdf))


ORDINARY = [kind for kind in KINDS if kind != "hostile names"]


@pytest.mark.slow
@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize("kind", ORDINARY)
def test_html_and_pdf_say_the_same_on_two_numbered_pages(certificates, read, kind, language):
    dcc = certificates[kind]
    found = read(printed_certificate(dcc, language=language, logo=SVG).pdf())
    pages = [page.extract_text() for page in found.pages]
    assert len(pages) == 2
    html = Texts(printed_certificate(dcc, language=language, logo=SVG).html()).texts
    assert len(html) > 100
    assert [text for text in html if squeezed(text) not in squeezed("".join(pages))] == []
    identifier = re.search("<dcc:uniqueIdentifier>(.*)</dcc:uniqueIdentifier>", dcc)
    assert identifier is not None
    not_stated = {"en": "(number: not stated)", "de": "(Nummer: keine Angabe)"}[language]
    number = "2026-1" if kind == "all stated" else not_stated
    page = {"en": "Page {} of 2", "de": "Seite {} von 2"}[language]
    for i, text in enumerate(pages, start=1):
        assert number in text
        assert (identifier[1] in text) == (kind == "all stated")  # without a number, it is a UUID
        assert page.format(i) in text


@pytest.mark.slow
def test_a_stated_number_that_looks_like_a_uuid_is_printed(record, full):
    number = "6ba7b810-9dad-51d1-80b4-00c04fd430c8"
    certificate = full.certificate.model_copy(update={"number": number})
    dcc = aj.certificate.dcc_xml(
        record, full.model_copy(update={"certificate": certificate, "conformity": None}), created=CREATED
    )
    assert number in Texts(page(dcc, "en")).texts


@pytest.mark.slow
def test_limits_without_a_statement_are_none(record, full, evaluation):
    about = full.model_copy(update={"conformity": None})
    dcc = aj.certificate.dcc_xml(record, about, created=CREATED, evaluation=evaluation)
    (_, conformity, *_), _ = printed_certificate(dcc).pages.pages
    assert [key for key, _ in conformity.facts] == ["Decision rule", "Limits of the evaluation", "Test procedure"]
    assert conformity.paragraphs == ["No statement of conformity is made."]


@pytest.mark.slow
def test_results_say_which_data_they_are_from(certificates):
    """Repeatability is of the poses of the calibration; a test, as its evaluation says."""
    dcc, other = certificates["all stated"], "also used for the calibration, because there are no other poses."
    for language, repeatability, unused, used in (
        ("en", "Repeatability in the sockets of the calibration", "in poses that were not used: ", "in poses of the "),
        ("de", "Wiederholbarkeit in den Kugelaufnahmen der Kalibrierung", "in nicht verwendeten Stellungen: ", "der K"),
    ):
        for text, words in ((dcc, unused), (dcc.replace("not used for the calibration.", other), used)):
            titles = [section.title for section in printed_certificate(text, language=language).pages.pages[1]]
            assert titles[0] == f"{repeatability} [mm]"
            (of_jjf,) = [title for title in titles if "JJF" in title]
            assert words in of_jjf


@pytest.mark.slow
def test_uncertainties_say_what_they_include(certificates):
    """Of the tip, the calibration alone; of a length, the noise as well."""
    for language, tip, length in (
        ("en", "contribution of the calibration", "with the noise of both readings"),
        ("de", "Beitrag der Kalibrierung", "mit dem Rauschen beider Ablesungen"),
    ):
        pages = printed_certificate(certificates["all stated"], language=language).pages.pages
        (rows,) = [section.table for section in pages[1] if "U (95" in section.title]
        assert {row[0].rpartition(": ")[2] for row in rows[::2]} == {tip}
        assert {row[0].rpartition(": ")[2] for row in rows[1::2]} == {length}


@pytest.mark.slow
def test_a_country_code_is_not_printed_without_a_city(record):
    city = aj.files.AdministrativeData(
        laboratory={"name": "L", "city": "O", "country": "FR"}, customer={"country": "DE"}
    )
    pages = printed_certificate(aj.certificate.dcc_xml(record, city, created=CREATED)).pages
    assert pages.laboratory == ["L", "O, FR"]
    assert "DE" not in dict(pages.pages[0][0].facts).get("Customer", "")


@pytest.mark.slow
def test_the_dcc_comes_out_of_the_pdf_as_it_went_in(certificates, read):
    """It is valid, and the PDF says that it is PDF/A-3, which may hold it."""
    dcc = certificates["all stated"]
    pdf = printed_certificate(dcc, logo=PNG).pdf()
    attached = read(pdf).attachments
    assert list(attached) == ["dcc.xml"]
    assert attached["dcc.xml"] == [dcc.encode()]
    assert dcc_model.faults(attached["dcc.xml"][0].decode()) == []
    assert b"<pdfaid:part>3</pdfaid:part>" in pdf
    assert printed_certificate(dcc, logo=PNG).pdf() == pdf


@pytest.mark.slow
@pytest.mark.parametrize("kind", ORDINARY)
def test_every_printed_uncertainty_is_one_of_the_dcc(certificates, kind):
    """Of angles, in degrees: to two digits of U."""
    page = printed_certificate(certificates[kind]).html()
    printed = re.findall(r"(−?[\d.]+) ± ([\d.]+)", page)
    assert len(printed) > 5
    stated = re.compile(
        r"<si:value>([^<]*)</si:value>\s*<si:unit>([^<]*)</si:unit>\s*<si:measurementUncertaintyUnivariate>\s*"
        r"<si:expandedMU>\s*<si:valueExpandedMU>([^<]*)<"
    )
    certified = set()
    for value, unit, u in stated.findall(certificates[kind]):
        if unit == r"\radian":
            degrees = Decimal(f"{math.degrees(float(u)):.1e}")
            u = f"{degrees:f}"
            value = f"{Decimal(math.degrees(float(value))).quantize(degrees):f}"
        certified.add((value, u))
    assert {(value.replace("−", "-"), u) for value, u in printed} <= certified


@pytest.mark.slow
def test_what_a_laboratory_states_is_printed(certificates):
    """Identification, conditions, tests with limit and decision; German with its decimal sign."""
    page = printed_certificate(certificates["all stated"], language="de").html()
    texts = Texts(page).texts
    rule = "ISO 14253-1:2017, Konformität mit einer Wahrscheinlichkeit von 95\u00a0% nachgewiesen"
    deltam, e_uni = "größte halbe Spannweite einer Koordinate", "Längenmessabweichung, einseitig"
    limits = f"Deltam, {deltam}: 5,0\u00a0mm; E_Uni, {e_uni}: 0,05\u00a0mm"
    decided = f"{rule}; passes where |E| + U is below 0.05 mm", limits
    dates = "01.02.2026", "02.02.2026 – 03.02.2026", "04.02.2026"
    stated = ("X'1", "0007", "c <7>", "worn & dry", "2025-9", "K 17", "house rule 1", *dates, *decided)
    for text in ("Längenlabor <b>&amp; Söhne</b>", *stated):
        assert text in texts, text
    assert not {"2026-02-01", "2026-02-02 – 2026-02-03", "2026-02-04"} & {*texts}
    english = Texts(printed_certificate(certificates["all stated"], language="en").html()).texts
    assert {"2026-02-01", "2026-02-02 – 2026-02-03", "2026-02-04"} <= {*english}
    assert "<dcc:issueDate>2026-02-04<" in certificates["all stated"]
    assert "20,25\u00a0°C\u00a0(u\u00a0=\u00a00,1\u00a0°C)" in texts
    assert {"b", "script"}.isdisjoint(Texts(page).tags)
    assert "Konformitätsaussage" in texts
    assert "unentschieden (innerhalb der Grenze), mit den kalibrierten Parametern" in "; ".join(texts)
    assert any("mit u = 0,001\u00a0mm,\u00a01e−06\u00a0L für Aufnahme und Halterung" in text for text in texts)
    assert any(text.endswith("Gefordert sind 30 verschiedene Orte (vorhanden: 1).") for text in texts)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ORDINARY)
def test_findings_are_printed_in_english_and_counted_in_other_languages(certificates, kind):
    root, dcc_names = ElementTree.fromstring(certificates[kind]), {"dcc": "https://ptb.de/dcc"}
    found = {
        str(content.text).partition(". ")[0]
        for statement in root.iterfind(".//dcc:statement", dcc_names)
        if statement.findtext("dcc:name/dcc:content", "", dcc_names) in ("Warning", "Data left out")
        for content in statement.iterfind("dcc:declaration/dcc:content", dcc_names)
    }
    english, german = (squeezed("".join(Texts(page(certificates[kind], code)).texts)) for code in ("en", "de"))
    beginnings = [squeezed(sentence)[:80] for sentence in found]
    assert sum(text in english for text in beginnings) == min(len(found), 4)
    assert not any(text in german for text in beginnings)
    assert ("HinweisederAuswertung" in german) == bool(found)


@pytest.mark.slow
def test_results_say_what_they_apply_to(certificates):
    """Convention, coverage of the joint space, held-out poses of the evaluation."""
    texts = Texts(page(certificates["all stated"], "en")).texts
    convention = "Standard Denavit-Hartenberg convention; transform of a joint: Rz(q + theta) Tz(d) Tx(a) Rx(alpha)."
    assert sum(text.startswith(convention) for text in texts) == 1
    assert sum("of the joint space is covered" in text for text in texts) == 1
    values = aj.certificate.parse_dcc(certificates["all stated"])
    held_out = {key[2]: value.value for key, value in values.items() if key[1] == "Held-out poses"}
    assert held_out["poses"] == 15
    assert 0.5 < held_out["RMS distance"] / held_out["RMS distance, predicted"] < 2
    assert not [key for key in aj.certificate.parse_dcc(certificates["nothing stated"]) if key[1] == "Held-out poses"]


@pytest.mark.parametrize(
    ("value", "u", "printed"),
    [
        (469.04351, 0.002071992, "469.0435 mm (u = 0.0021 mm)"),
        (469.0435, 0.002, "469.0435 mm (u = 0.002 mm)"),
        (20.25, 0.1, "20.25 mm (u = 0.1 mm)"),
        (500.0, 0.00299, "500.0 mm (u = 0.0030 mm)"),
        (500.002, None, "500.002 mm"),
    ],
)
def test_a_certified_value_is_rounded_to_two_digits_of_its_u(value, u, printed):
    parent = ElementTree.Element("x", {f"xmlns:{prefix}": uri for prefix, uri in xml_elements.PREFIXES.items()})
    parent.append(xml_elements.named("quantity", "value", xml_elements.real(value, xml_elements.MILLIMETRE, u)))
    quantity = ElementTree.fromstring(xml_elements.xml_text(parent))[0]
    assert sections.with_u(quantity, languages.language_of("en")) == printed.replace(" ", "\u00a0")


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("40.000000000000007", "40.0"),
        ("1.5707963267948966", "1.570796"),
        ("-6e-17", "0.0"),
        ("2e+20", "2e+20"),
        ("40.5", "40.5"),
    ],
)
def test_numbers_of_17_digits_are_printed_shorter(text, printed):
    assert sections.shortened(text) == printed


def test_one_is_singular():
    german = languages.language_of("de")
    several = [german.counted("other observations", number) for number in ("1", "2")]
    assert several == ["1 Beobachtung", "2 Beobachtungen"]


@pytest.mark.slow
def test_the_type_of_a_full_page_is_smaller_in_print(certificates):
    printed = re.compile(r"\.results { font-size: ([\d.]+)pt")
    sizes = [float(*printed.findall(page(certificates[kind], "en"))) for kind in ("nothing stated", "all stated")]
    assert 6 < sizes[1] < sizes[0] <= 10


@pytest.mark.slow
def test_hostile_names_are_texts_in_both(certificates):
    """In the PDF, or it says that no font has them."""
    page = Texts(printed_certificate(certificates["hostile names"]).html())
    assert "script" not in page.tags
    assert any("<script>alert" in text for text in page.texts)
    with contextlib.suppress(aj.InputError):
        assert printed_certificate(certificates["hostile names"]).pdf().startswith(b"%PDF")


@pytest.mark.slow
def test_another_language_is_one_file(certificates, tmp_path):
    english = (Path(languages.__file__).parent / "en.toml").read_text()
    path = tmp_path / "fr.toml"
    french = english.replace('"en"', '"fr"').replace('"Calibration certificate"', '"Certificat d\'étalonnage"')
    path.write_text(french)
    assert "Certificat d&#39;étalonnage" in printed_certificate(certificates["joint"], language=path).html()
    wrong = {
        french.replace('probe = "Probe"\n', ""): ["[labels] lacks 'probe'"],
        french.replace("[counts]", 'other = "x"\n[counts]'): ["[sentences] has the unknown key 'other'"],
        french.replace("{number} more", "more"): ["needs the same names in braces"],
        french.replace('"fr"', '"French"'): ["language code"],
        french.replace("{year}-", ""): ["'{month}-{day}'", "{day}, {month} and {year}"],
    }
    for text, parts in wrong.items():
        path.write_text(text)
        assert_refused(lambda: printed_certificate(certificates["joint"], language=path).html(), path, *parts)
    assert_refused(lambda: printed_certificate(certificates["joint"], language="fr").html(), "'fr'", "de or en")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("<a/>", ["give a DCC"]),
        ('<a xmlns="https://ptb.de/dcc"/>', ["give a DCC"]),
        ('<d:digitalCalibrationCertificate xmlns:d="https://ptb.de/dcc"/>', ["has no administrativeData"]),
    ],
)
def test_what_is_no_certificate_is_not_printed(text, parts):
    assert_refused(lambda: printed_certificate(text).html(), *parts)


def test_a_logo_is_a_small_png_or_svg_file(tmp_path):
    about, logo = tmp_path / "about.toml", tmp_path / "logo.x"
    about.write_text('laboratory = { name = "L", logo = "logo.x" }')
    for content in (SVG, PNG):
        logo.write_bytes(content)
        assert aj.files.read_logo(about) == content
    bomb = PNG[:16] + (100_000).to_bytes(4) * 2 + PNG[24:]
    wrong = ((b"\xff\xd8\xff", "PNG or SVG"), (SVG + b" " * 1_000_000, "1 MB"), (bomb, "100000 x 100000 pixels"))
    for content, part in wrong:
        logo.write_bytes(content)
        assert_refused(lambda: aj.files.read_logo(about), logo, part)
    logo.unlink()
    assert_refused(lambda: aj.files.read_logo(about), logo, "does not exist")
    about.write_text("")
    assert aj.files.read_logo(about) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage", [b"<svg", b"<svg><g></svg>", SVG.replace(b"<rect", b'<image href="/etc/hostname"/><rect')]
)
def test_a_logo_that_cannot_be_drawn_or_names_a_file_is_one_sentence(certificates, damage):
    assert_refused(lambda: printed_certificate(certificates["joint"], logo=damage).pdf(), "cannot be set as PDF")
