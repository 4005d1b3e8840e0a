"""What a report is made of: sections of text, tables and charts, without any idea of how they are shown."""

import html
import math
from typing import Any, NamedTuple

_NOTHING = 1e-9  # mm: rounding


class Cell(NamedTuple):
    """One entry of a table: what is shown, what it is sorted by (None: the text), and a mark ("good", "bad", "unsure", "outlier")."""

    text: str
    value: float | None = None
    mark: str = ""


class Table(NamedTuple):
    """A table with headings; rows of cells. Columns whose cells have values are set flush right."""

    caption: str
    columns: tuple[str, ...]
    rows: list[list[Cell]]

    @property
    def numeric(self) -> list[bool]:
        """Which columns hold numbers."""
        return [any(row[i].value is not None for row in self.rows) for i in range(len(self.columns))]


class Chart(NamedTuple):
    """A figure for Plotly (traces and layout as plain dictionaries), what it shows in words, and the numbers behind it."""

    id: str
    title: str
    words: str
    figure: dict[str, Any]
    table: Table | None = None
    height: int = 380
    printed: bool = False  # whether the numbers behind it belong on paper too


class Arms(NamedTuple):
    """The arm in its poses, to be turned: see `scene`."""

    id: str
    title: str
    words: str
    data: dict[str, Any]


class Section(NamedTuple):
    """A part of a report with a heading."""

    id: str
    title: str
    blocks: list["str | Table | Chart | Arms"]


class Report(NamedTuple):
    """A whole report, in the order in which it is read."""

    title: str
    subtitle: str
    verdict: str
    verdict_mark: str  # "good", "bad", "unsure"
    warnings: list[str]
    facts: list[tuple[str, str]]
    sections: list[Section]


def text(value: object, mark: str = "") -> Cell:
    """A cell of words."""
    return Cell(str(value), None, mark)


def number(value: float | None, decimals: int = 4, *, signed: bool = False, mark: str = "") -> Cell:
    """A cell with a number; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return Cell("–" if value is None or math.isnan(value) else "not determined", None, mark)
    return Cell(shown(value, decimals, signed=signed), float(value), mark)


def shown(value: float, decimals: int = 4, *, signed: bool = False) -> str:
    """A number with so many decimals; in powers of ten where these would hide it."""
    sign = "+" if signed else ""
    if abs(value) < _NOTHING:
        value = 0.0
    if value != 0 and abs(value) < 0.5 * 10**-decimals:
        return f"{value:{sign}.1e}".replace("-", "−")
    return f"{value:{sign}.{decimals}f}".replace("-", "−")


def decimals_of(u: float | None, otherwise: int = 4) -> int:
    """Decimals that show two digits of an uncertainty."""
    if u is None or not math.isfinite(u) or u <= 0:
        return otherwise
    return min(max(1 - math.floor(math.log10(u)), 0), 9)


def plain(value: object) -> str:
    """Text for Plotly, which takes some tags for formatting: names are shown as they are."""
    return html.escape(str(value), quote=False)
