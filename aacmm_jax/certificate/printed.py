"""The printed certificate, two pages as HTML or PDF, made of a Digital Calibration Certificate (DCC)."""

import base64
import datetime
import json
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from ..core.errors import InputError, require
from ..core.text import quoted
from .languages import language_of
from .pages import Pages, pages_of
from .sections import Section

_FOLDER = Path(__file__).parent
_TYPE_SIZES = (10.0, 9.2, 8.5, 7.8, 7.0)  # points, the first with which two pages are enough
# Of a sheet of the HTML page in a wide font: the largest type and its height in points, ems above the first part, and
# characters of a line in 10 points.
_LARGEST, _HEIGHT, _ABOVE, _CHARACTERS = 8.8, 760, 8, 80


class PrintedCertificate(NamedTuple):
    """The printed certificate of a Digital Calibration Certificate (DCC), to be written as HTML or as PDF.

    Example:
        >>> text = aj.certificate.dcc_xml(record, aj.files.AdministrativeData(), created="2026-01-31T12:00:00Z")
        >>> printed = aj.certificate.printed_certificate(text, language="de")
        >>> print("Kalibrierschein" in printed.html(), printed.pdf()[:8], len(printed.pdf()) < 200_000)
        True b'%PDF-1.7' True
    """

    pages: Pages
    dcc: str
    logo: bytes | None = None  # SVG

    def html(self) -> str:
        """One HTML page that prints on two sheets; the DCC is a link in it. `InputError` if Jinja is not installed."""
        require("report", "a certificate as HTML")
        import jinja2

        template = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined).from_string(
            (_FOLDER / "certificate.html").read_text(encoding="utf-8")
        )
        before, middle, after = re.split(r"\{pages?\}", self.pages.page)
        return template.render(
            printed=self.pages,
            logo=None if self.logo is None else _data("image/svg+xml", self.logo),
            dcc=_data("application/xml", self.dcc.encode()),
            footer=_css(f"{self.pages.title} {self.pages.number}"),
            count=f"{_css(before)} counter(page) {_css(middle)} counter(pages) {_css(after)}",
            sizes=[*map(_print_size, self.pages.pages)],
        )

    def pdf(self) -> bytes:
        """PDF/A-3 with the DCC attached as dcc.xml. The same input gives the same bytes.

        The type is as small as two pages need, down to 7 points. `InputError` if Typst is not installed, a logo
        cannot be drawn, or no font has a character of a name.
        """
        require("certificate", "a certificate as PDF")
        import typst

        pages = [[section._asdict() for section in page] for page in self.pages.pages]
        content = self.pages._asdict() | {"pages": pages, "logo": self.logo is not None}
        files = {"main": (_FOLDER / "certificate.typ").read_bytes(), "dcc.xml": self.dcc.encode()}
        files |= {} if self.logo is None else {"logo.svg": self.logo}
        day = datetime.datetime.fromisoformat(f"{self.pages.created}T00:00:00+00:00")
        pdf = b""
        try:
            for size in _TYPE_SIZES:
                files["certificate.json"] = json.dumps(content | {"size": size}).encode()
                pdf = typst.compile(files, format="pdf", pdf_standards=["a-3a"], timestamp=day)  # pyright: ignore
                if b"<xmpTPg:NPages>2<" in pdf:
                    break
        except RuntimeError as error:  # of Typst
            raise InputError(
                f"the certificate cannot be set as PDF: {quoted(str(error))}; write it as HTML."
            ) from error
        return pdf


def printed_certificate(
    dcc: str, *, language: str | os.PathLike = "en", logo: bytes | None = None
) -> PrintedCertificate:
    """The printed certificate of a Digital Calibration Certificate, to be written as HTML or as PDF.

    `InputError` if the text is no DCC of this package, or the language file lacks a text.

    Args:
        dcc: XML of the certificate (`dcc_xml`).
        language: "en", "de", or a TOML file with the texts of another language.
        logo: The laboratory's logo, the bytes of a PNG or SVG file.

    Example:
        >>> text = aj.certificate.dcc_xml(record, aj.files.AdministrativeData(), created="2026-01-31T12:00:00Z")
        >>> print(aj.certificate.printed_certificate(text).pages.title)
        Calibration certificate
    """
    return PrintedCertificate(pages_of(dcc, language_of(language)), dcc, None if logo is None else _as_svg(logo))


def _print_size(page: Sequence[Section]) -> float:
    """The size of type, in points, in which a page is one sheet when HTML is printed, also in a wide font."""
    widest = max((_width(section) for section in page if section.table), default=1)
    return min(_LARGEST, _HEIGHT / (_ABOVE + sum(map(_height, page))), 10 * (_CHARACTERS + 12) / widest)


def _height(section: Section) -> float:
    """About the height of a part of a page, in ems, as certificate.html spaces it."""

    def lines(texts: Iterable[str]) -> int:
        return sum(-(-len(text) // _CHARACTERS) for text in texts)

    rows = lines("  ".join(row) for row in (section.headings, *section.table)) if section.table else 0
    facts = lines(" " * 30 + value for _, value in section.facts)
    paragraphs = [*section.paragraphs, *section.notes]
    texts = 1.2 * lines(paragraphs) + 0.25 * len(paragraphs)
    return 2.1 + 1.4 * facts + 1.25 * rows + texts + 5.5 * bool(section.signatures)


def _width(section: Section) -> int:
    """Of a table, in characters, with space for 10 of every text, which can be in several lines."""
    columns = zip(*section.table, strict=True)
    return sum(2 + (10 if i < section.texts else max(map(len, cells))) for i, cells in enumerate(columns))


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
