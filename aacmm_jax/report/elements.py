"""The elements of a report, independent of how they are shown: sections of text, tables, charts and views."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from ..plot.charts import Chart
from ..summaries.tables import Table


class ArmView(NamedTuple):
    """An interactive view of the arm in its poses: see `arm_view`."""

    id: str
    title: str
    description: str
    data: dict[str, Any]


Block = str | Table | Chart | ArmView


class Section(NamedTuple):
    """A part of a report with a heading."""

    id: str
    title: str
    blocks: Sequence[Block]


class Report(NamedTuple):
    """A whole report, in reading order."""

    title: str
    subtitle: str
    verdict: str
    verdict_mark: str  # "good", "bad", "unsure", or "neutral" where nothing was decided
    warnings: list[str]
    facts: list[tuple[str, str]]
    sections: list[Section]
    simulated: bool = False
    decision: str | None = None  # of its acceptance tests, all together
    administrative: Sequence[tuple[str, list[tuple[str, str]]]] = ()  # groups of titles and values
