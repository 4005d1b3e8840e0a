"""One HTML page that holds everything: text, charts, the arm to be turned, style and program; nothing is fetched."""

import base64
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..acceptance.record import SIMULATED
from ..core.errors import InputError
from ..files.administrative_data import check_conformity
from ..files.hdf5 import read_tables
from ..files.whole_file import fingerprint, write_text
from .administrative_data import administrative_section
from .parts import Arms, Chart, Report, Table

_FOLDER = Path(__file__).parent
KINDS = ("calibration", "evaluation", "study")


def write_report(source: str | os.PathLike, target: str | os.PathLike, about: Any = None) -> dict[str, Any]:
    """Write the report of a calibration, an evaluation or a study (HDF5) as one HTML file, whole or not at all.

    ``about`` (an `about.About`) adds laboratory, customer, item, persons, dates and artefacts.

    Returns what was written, and what it warns of. Raises `InputError` where the file cannot be read, or the report not written.
    """
    source, target = Path(source), Path(target)
    if target.exists() and source.exists() and target.samefile(source):
        raise InputError(f"{target} is the file that the report is of; choose another output.")
    page, report = report_of(source, about)
    write_text(target, page)
    return {
        "kind": "report",
        "of": str(source),
        "title": report.title,
        "verdict": report.verdict,
        "warnings": report.warnings,
        "bytes": len(page.encode()),
        "written": str(target),
    }


def report_of(source: Path, about: Any = None) -> tuple[str, Report]:
    """The page of a file, and the report that it shows."""
    stored = read_tables(source, KINDS, without=("trials",))
    report, simulated, decision = _MAKERS[stored.attributes["kind"]](source, stored.attributes)
    if simulated:
        report = report._replace(
            warnings=list(dict.fromkeys([SIMULATED, *report.warnings])), verdict_mark=_unsure(report.verdict_mark)
        )
    if about is not None:
        tested = stored.attributes["kind"] == "evaluation"
        check_conformity(about, simulated=simulated, decision=decision, tested=tested)
        report = report._replace(sections=[administrative_section(about, tested), *report.sections])
    return page_of(report, made_by(source, stored.attributes)), report


def _unsure(mark: str) -> str:
    return "bad" if mark == "bad" else "unsure"


def _of_calibration(source: Path, attributes: dict[str, Any]) -> tuple[Report, bool, str | None]:
    from ..files.calibrations import load_calibration
    from .calibration import calibration_report

    record = load_calibration(source)
    return calibration_report(record)[0], record.recording.true is not None, None


def _of_evaluation(source: Path, attributes: dict[str, Any]) -> tuple[Report, bool, str | None]:
    from .evaluation import evaluation_report, overall, points_report

    if attributes.get("of") == "points":
        from ..files.evaluations import load_points

        report, summary = points_report(load_points(source))
        return report, False, overall(summary)
    from ..files.evaluations import load_evaluation

    record = load_evaluation(source)
    report, summary = evaluation_report(record)
    return report, record.recording.true is not None, overall(summary)


def _of_study(source: Path, attributes: dict[str, Any]) -> tuple[Report, bool, str | None]:
    from ..study.results import Results
    from .study import study_report

    return study_report(Results.of(source))[0], False, None


_MAKERS: dict[str, Callable[[Path, dict[str, Any]], tuple[Report, bool, str | None]]] = {
    "calibration": _of_calibration,
    "evaluation": _of_evaluation,
    "study": _of_study,
}


def made_by(source: Path, attributes: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """How the file came about, and how to make it again."""
    return [
        ("File", [fingerprint(source)]),
        ("Measured on", [str(attributes.get("measured") or "not stated")]),
        ("Made on", [str(attributes["created"])]),
        ("Command", [str(attributes["command"])]),
        ("aacmm_jax", [str(attributes["package_version"])]),
        ("With", [attributes.get("versions") or "not recorded"]),
        ("Seed", ["none" if attributes.get("seed") is None else str(attributes["seed"])]),
        ("From", [str(line) for line in attributes.get("sources") or ["not recorded"]]),
    ]


def page_of(report: Report, origin: list[tuple[str, list[str]]]) -> str:
    """The HTML of a report. Everything that people wrote is shown as text: Jinja escapes it, and only this page's own programs run."""
    import jinja2
    from plotly.offline import get_plotlyjs

    template = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    ).from_string((_FOLDER / "page.html").read_text(encoding="utf-8"))
    programs = [get_plotlyjs(), (_FOLDER / "page.js").read_text(encoding="utf-8")]
    blocks = [block for section in report.sections for block in section.blocks]
    return template.render(
        report=report,
        origin=origin,
        is_chart=lambda block: isinstance(block, Chart),
        is_table=lambda block: isinstance(block, Table),
        is_arms=lambda block: isinstance(block, Arms),
        charts={block.id: block.figure for block in blocks if isinstance(block, Chart)},
        scenes={block.id: block.data for block in blocks if isinstance(block, Arms)},
        style=(_FOLDER / "page.css").read_text(encoding="utf-8"),
        programs=programs,
        mark=hashlib.sha256(repr(origin).encode()).hexdigest()[:12],
        hashes=[_hash(program) for program in programs],
    )


def _hash(program: str) -> str:
    """By which the page's content security policy knows a program of its own."""
    return "sha256-" + base64.b64encode(hashlib.sha256(program.encode()).digest()).decode()
