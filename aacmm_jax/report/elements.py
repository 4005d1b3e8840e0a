"""The elements of a report, independent of how they are shown: sections of text, tables, charts and views."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from .charts import Plot

_MOST_STACKED = 30  # cells: more would be a list without end
_NARROW, _CHARACTER, _GAP = 370.0, 7.6, 8.0  # pixels: a telephone's page, a character, between columns
_LONGEST = 14  # characters: longer texts are wrapped
_ZERO = 1e-9  # mm: smaller numbers are rounding errors


class Cell(NamedTuple):
    """One cell of a table."""

    text: str
    value: float | None = None  # what the column is sorted by; None: the text
    mark: str = ""  # "good", "bad", "unsure", "outlier"


class ReportTable(NamedTuple):
    """A table with headings; columns whose cells have values are right-aligned."""

    caption: str
    columns: tuple[str, ...]
    rows: list[list[Cell]]
    folded: bool = False  # shown on demand only, and not printed

    @property
    def numeric(self) -> list[bool]:
        """Which columns contain numbers."""
        return [any(row[i].value is not None for row in self.rows) for i in range(len(self.columns))]

    @property
    def stacked(self) -> bool:
        """Whether a narrow screen shows each row as a list: a table of few cells that has no room on a telephone."""
        if len(self.rows) * len(self.columns) > _MOST_STACKED:
            return False
        texts = [[column, *(row[i].text for row in self.rows)] for i, column in enumerate(self.columns)]
        words = [max((len(word) for text in column for word in text.split()), default=0) for column in texts]
        whole = [max(map(len, column[1:]), default=0) if i else 0 for i, column in enumerate(texts)]
        characters = sum(max(word, min(text, _LONGEST)) for word, text in zip(words, whole, strict=True))
        return characters * _CHARACTER + _GAP * len(texts) > _NARROW


class Chart(NamedTuple):
    """One or several plots side by side, a description, and the table of their numbers."""

    id: str
    title: str
    description: str
    plots: tuple[Plot, ...]
    table: ReportTable | None = None
    printed: bool = False  # whether the table is printed on paper as well
    shade_limits: tuple[float, ...] = ()  # of a sequential scale, for its key
    shade_unit: str = ""


class ArmView(NamedTuple):
    """An interactive view of the arm in its poses: see `arm_view`."""

    id: str
    title: str
    description: str
    data: dict[str, Any]


class Section(NamedTuple):
    """A part of a report with a heading."""

    id: str
    title: str
    blocks: list["str | ReportTable | Chart | ArmView"]


class Report(NamedTuple):
    """A whole report, in reading order."""

    title: str
    subtitle: str
    verdict: str
    verdict_mark: str  # "good", "bad", "unsure", or "neutral" where nothing was decided
    warnings: list[str]
    facts: list[tuple[str, str]]
    sections: list[Section]
    administrative: Sequence[tuple[str, list[tuple[str, str]]]] = ()  # groups of titles and values


def text_cell(value: object, mark: str = "") -> Cell:
    """A cell of text."""
    return Cell(str(value), None, mark)


def number_cell(
    value: float | None, decimals: int = 4, *, signed: bool = False, mark: str = "", rounded: bool = False
) -> Cell:
    """A cell with a number; a dash for None and NaN. ``rounded``: to these decimals of its U, even to 0."""
    if value is None or not math.isfinite(value):
        return Cell("–" if value is None or math.isnan(value) else "not determined", None, mark)
    shown = round(value, decimals) if rounded else value
    return Cell(format_number(shown, decimals, signed=signed), float(value), mark)


def format_number(value: float, decimals: int = 4, *, signed: bool = False) -> str:
    """A number with a fixed number of decimals, or in powers of ten if these would not show it."""
    sign = "+" if signed else ""
    if abs(value) < _ZERO:
        value = 0.0
    if value != 0 and abs(value) < 0.5 * 10**-decimals:
        return f"{value:{sign}.1e}".replace("-", "−")
    return f"{value:{sign}.{decimals}f}".replace("-", "−")
