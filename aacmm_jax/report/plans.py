"""The page of a plan, to be taken to the machine: where things are put, a picture, and the poses in their order."""

import csv
import io
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..acceptance.procedure import Procedure
from ..core.text import pluralise
from ..data.capture import Capture, ReferenceLength
from ..data.observations.observation import offset_of
from ..planning.design import Plan
from ..planning.kit import KitPlan
from ..summaries.tables import Cell, Line, Styled, Table, View, number
from ..uncertainty.coverage import COVERAGE_FACTOR, K_IN_WORDS
from .elements import ArmView, Block, Report, Section, view_of_arm

_POSES = (
    "Record the poses in this order, and tick each one. A pose need not be reached exactly: what is recorded is what "
    "the joints read."
)


def plan_report(planned: Plan | KitPlan | Procedure, summary: dict[str, Any], view: View, poses: str) -> Report:
    """The report of a plan, except for its origin: ``view`` is what the terminal shows of its summary, and ``poses``
    the plan's table (CSV)."""
    first, *blocks = _blocks(view)
    test = isinstance(planned, Procedure)
    verdict = summary["standard"] if test else str(first)
    return Report(
        title=f"Plan of {'an acceptance test' if test else 'a calibration'}, {summary['arm'] or 'an arm'}",
        subtitle=f"{pluralise(summary['poses'], 'pose')} to record",
        verdict=verdict,
        verdict_mark="neutral",
        warnings=summary.get("warnings", []),
        numbers=_numbers(summary),
        picture=_picture(planned),
        facts=[],
        sections=[
            Section("set-up", "Set-up and expected uncertainty", [first, *blocks] if test else blocks),
            Section("poses", "Poses to record", [_POSES, _table(poses)]),
        ],
        simulated=False,
    )


def _numbers(summary: dict[str, Any]) -> list[tuple[str, str, str]]:
    """How many poses, what they give, and what as many random ones would."""
    numbers = [("Poses", str(summary["poses"]), "")]
    if summary["kind"] == "acceptance plan":
        bars = sum(bar["positions"] for bar in summary["bars"])
        points = {item["name"] for item in summary["items"] if item["test"] == "single point"}
        others = ("Spheres", len(summary["spheres"])) if summary["spheres"] else ("Sockets", len(points))
        return [*numbers, ("Positions of bars", str(bars), ""), (others[0], str(others[1]), "")]
    length = f"U of a {summary['check_length_mm']:g} mm length"
    for key, note in (("predicted", f"by this plan; {K_IN_WORDS}"), ("random", "by as many random poses")):
        values = [COVERAGE_FACTOR * summary[key][f"{which}_mm"] for which in ("median", "largest")]
        known = np.all(np.isfinite(values))
        value = f"{values[0]:.2g} mm" if known else "not determined"
        numbers.append((length, value, f"{note}, at worst {values[1]:.2g} mm" if known else note))
    return numbers


def _picture(planned: Plan | KitPlan | Procedure) -> ArmView:
    if isinstance(planned, KitPlan):
        things = zip(planned.kit, planned.observations, strict=True)
        offsets = {offset_of(seen.target): put.offset for put, seen in things if seen.target and put.offset is not None}
        return view_of_arm(planned.arm, Capture({}, (), planned.observations), geometry=offsets)
    if isinstance(planned, Plan):
        q = {name: planned.q[planned.owner == i] for i, name in enumerate(planned.sockets)}
        return view_of_arm(planned.arm, Capture(q, planned.lengths))
    items = (*planned.sockets, *planned.touches)
    names = [item.name for item in items]
    q = {name: np.concatenate([item.q for item in items if item.name == name]) for name in dict.fromkeys(names)}
    lengths = [ReferenceLength(start, end, value, 0.0) for start, end, value in planned.lengths]
    return view_of_arm(planned.arm, Capture(q, lengths))


def _table(poses: str) -> Table:
    """The poses with a box to tick, without the direction of the probe, which the joints determine, and without files
    that are called as the sockets are."""
    headings, *rows = csv.reader(io.StringIO(poses))
    shown = [i for i, heading in enumerate(headings) if not heading.startswith("probe_direction")]
    if {"name", "file"} <= {*headings}:
        name, file = headings.index("name"), headings.index("file")
        shown = [i for i in shown if i != file or any(row[file] != f"{row[name]}.csv" for row in rows)]
    moves = headings.index("move") if "move" in headings else None
    # An approach is not recorded.
    boxes = ["" if moves is not None and row[moves] in ("approach", "retract") else "☐" for row in rows]
    cells = [[box, *(_cell(row[i]) for i in shown)] for box, row in zip(boxes, rows, strict=True)]
    return Table("Poses", ["done", *(_heading(headings[i]) for i in shown)], cells)


def _heading(name: str) -> str:
    """``q_1_deg`` as people read it: "q1 [deg]"."""
    start, _, unit = name.rpartition("_")
    return f"{start.replace('_', '')} [{unit}]" if unit in ("mm", "deg", "rad") else name.replace("_", " ")


def _cell(text: str) -> str | Cell:
    decimals = len(text.partition(".")[2])
    try:
        return number(float(text), min(decimals, 4)) if decimals else text
    except ValueError:
        return text


def _blocks(view: View) -> Iterable[Block]:
    """Lines and tables of the terminal as blocks of a page: the line before a table without a title is its title."""
    before = ""
    for part in view:
        if isinstance(part, Table):
            yield part if part.title else part._replace(title=before)
            before = ""
        else:
            if before:
                yield before
            before = _words(part).strip()
    if before:
        yield before


def _words(line: Line) -> str:
    if isinstance(line, str):
        return line
    return line.text if isinstance(line, Styled) else "".join(map(_words, line))
