"""The printed certificate, two pages as HTML or PDF, made of a Digital Calibration Certificate (DCC)."""

import base64
import datetime
import json
import os
import re
from pathlib import Path

from ..core.errors import InputError, require
from ..core.text import quoted
from .languages import language_of
from .pages import pages_of

_FOLDER = Path(__file__).parent
_TYPE_SIZES = (10.0, 9.2, 8.5, 7.8)  # points, the first with which two pages are enough


def certificate_html(dcc: str, *, language: str | os.PathLike = "en", logo: bytes | None = None) -> str:
    """Make the printed certificate of a Digital Calibration Certificate, as one HTML page that prints on two sheets.

    The DCC is a link in the page. `InputError` if the text is no DCC of this package, the language file lacks a text,
    or Jinja is not installed.

    Args:
        dcc: XML of the certificate (`dcc_xml`).
        language: "en", "de", or a TOML file with the texts of another language.
        logo: The laboratory's logo, the bytes of a PNG or SVG file.

    Example:
        >>> text = aj.certificate.dcc_xml(record, aj.files.AdministrativeData(), created="2026-01-31T12:00:00Z")
        >>> page = aj.certificate.certificate_html(text, language="de")
        >>> print("Kalibrierschein" in page)
        True
    """
    require("report", "a certificate as HTML")
    import jinja2

    printed = pages_of(dcc, language_of(language))
    template = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined).from_string(
        (_FOLDER / "certificate.html").read_text(encoding="utf-8")
    )
    before, middle, after = re.split(r"\{pages?\}", printed.page)
    return template.render(
        printed=printed,
        logo=None if logo is None else _data("image/svg+xml", _as_svg(logo)),
        dcc=_data("application/xml", dcc.encode()),
        footer=_css(f"{printed.title} {printed.number}"),
        count=f"{_css(before)} counter(page) {_css(middle)} counter(pages) {_css(after)}",
    )


def certificate_pdf(dcc: str, *, language: str | os.PathLike = "en", logo: bytes | None = None) -> bytes:
    """Make the printed certificate of a Digital Calibration Certificate as PDF/A-3, with the DCC attached as dcc.xml.

    The type is as small as two pages need, down to 7.8 points. The same input gives the same bytes. `InputError`
    as `certificate_html`, if Typst is not installed, or if no font has a character of a name.

    Args:
        dcc: XML of the certificate (`dcc_xml`).
        language: "en", "de", or a TOML file with the texts of another language.
        logo: The laboratory's logo, the bytes of a PNG or SVG file.

    Example:
        >>> text = aj.certificate.dcc_xml(record, aj.files.AdministrativeData(), created="2026-01-31T12:00:00Z")
        >>> pdf = aj.certificate.certificate_pdf(text)
        >>> print(pdf[:8], len(pdf) < 200_000)
        b'%PDF-1.7' True
    """
    require("certificate", "a certificate as PDF")
    import typst

    printed = pages_of(dcc, language_of(language))
    content = printed._asdict() | {"pages": [[section._asdict() for section in page] for page in printed.pages]}
    files = {"main": (_FOLDER / "certificate.typ").read_bytes(), "dcc.xml": dcc.encode()}
    if logo is not None:
        files["logo.svg"] = _as_svg(logo)
    day = datetime.datetime.combine(datetime.date.fromisoformat(printed.created), datetime.time(), datetime.UTC)
    pdf = b""
    try:
        for size in _TYPE_SIZES:
            files["certificate.json"] = json.dumps(content | {"size": size, "logo": logo is not None}).encode()
            pdf = typst.compile(files, format="pdf", pdf_standards=["a-3a"], timestamp=day)  # pyright: ignore
            if b"<xmpTPg:NPages>2<" in pdf:
                break
    except RuntimeError as error:  # of Typst
        raise InputError(f"the certificate cannot be set as PDF: {quoted(str(error))}; write it as HTML.") from error
    return pdf


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _as_svg(logo: bytes) -> bytes:
    """A logo as SVG, which holds a PNG as it is."""
    if not logo.startswith(b"\x89PNG"):
        return logo
    size = 'width="{}" height="{}"'.format(*(int.from_bytes(logo[i : i + 4]) for i in (16, 20)))
    image = f'<image {size} href="{_data("image/png", logo)}"/>'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{image}</svg>'.encode()


def _css(text: str) -> str:
    """A string of CSS that holds any text."""
    return '"' + "".join(x if x.isascii() and x.isalnum() else f"\\{ord(x):x} " for x in text) + '"'
