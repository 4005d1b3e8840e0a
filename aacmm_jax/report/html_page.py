"""One self-contained HTML page: text, charts, the view of the arm, style and scripts."""

import base64
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..acceptance.record import SIMULATED
from ..core.extras import require
from ..files.administrative_data import AdministrativeData, check_conformity
from ..files.atomic_write import write_text
from ..files.hdf5 import read_summary, read_tables
from ..files.inputs import InputFile, fingerprint
from ..files.outputs import together
from .administrative_data import administrative_groups
from .chart_svg import drawn, key, points, shade_key
from .elements import ArmView, Chart, Report, ReportTable

KINDS = ("calibration", "evaluation", "study", "model comparison")
_FOLDER = Path(__file__).parent


def write_report(
    source: str | os.PathLike, target: str | os.PathLike, administrative_data: AdministrativeData | None = None
) -> dict[str, Any]:
    """Write the report of a calibration, an evaluation, a study or compared models as one HTML file.

    Args:
        source: The HDF5 file of the calibration, the evaluation, the study or the compared models.
        target: The HTML file to write, whole or not at all.
        administrative_data: Laboratory, customer, item, persons, dates and artefacts, shown in a section of their own.

    Returns:
        Title, verdict, warnings and size of the report.

    Raises:
        InputError: If the source cannot be read or the target not written, the administrative data state a conformity
            that the source contradicts, or Jinja is not installed.

    Example:
        >>> aj.files.save_calibration("calibration.h5", record)
        >>> written = aj.report.write_report("calibration.h5", "report.html")
        >>> print(written["title"])
        Calibration of Cheng 2018, simulated arm
    """
    require("report", "a report")
    with together(target):
        return _written(Path(source), Path(target), administrative_data)


def _written(source: Path, target: Path, administrative_data: AdministrativeData | None) -> dict[str, Any]:
    kind = read_summary(source, KINDS)[0]["kind"]
    read = source if kind == "study" else InputFile(source)  # a study is read in parts
    stored = read_tables(read, (kind,), without=("trials",))
    report, simulated, decision = _REPORTS[kind](read, stored.attributes)
    if simulated:
        warnings = list(dict.fromkeys([SIMULATED, *report.warnings]))
        mark = "unsure" if decision == "conforms" else report.verdict_mark  # no real arm conforms
        report = report._replace(warnings=warnings, verdict_mark=mark)
    if administrative_data is not None:
        tested = kind == "evaluation"
        check_conformity(administrative_data, simulated=simulated, decision=decision, tested=tested)
        report = report._replace(administrative=administrative_groups(administrative_data, tested))
    page = _render(report, _origin(read, stored.attributes))
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


def _calibration(source: str | os.PathLike, attributes: dict[str, Any]) -> tuple[Report, bool, str | None]:
    from ..files.calibrations import load_calibration
    from .calibration import calibration_report

    record = load_calibration(source)
    return calibration_report(record)[0], record.recording.true is not None, None


def _evaluation(source: str | os.PathLike, attributes: dict[str, Any]) -> tuple[Report, bool, str | None]:
    from ..summaries.verdicts import overall_decision
    from .evaluation import evaluation_report, points_report

    if attributes.get("of") == "points":
        from ..files.evaluations import load_points

        report, summary = points_report(load_points(source))
        return report, False, overall_decision(summary)
    from ..files.evaluations import load_evaluation

    record = load_evaluation(source)
    report, summary = evaluation_report(record)
    return report, record.recording.true is not None, overall_decision(summary)


def _models(source: str | os.PathLike, attributes: dict[str, Any]) -> tuple[Report, bool, str | None]:
    from ..files.compared_models import load_compared_models
    from .models import models_report

    return models_report(load_compared_models(source)), False, None


def _study(source: str | os.PathLike, attributes: dict[str, Any]) -> tuple[Report, bool, str | None]:
    from ..study.results import Results
    from .study import study_report

    return study_report(Results.of(source))[0], False, None


# By the kind of file: the report, whether it is of a simulation, and the overall decision of its acceptance tests.
_REPORTS: dict[str, Callable[[str | os.PathLike, dict[str, Any]], tuple[Report, bool, str | None]]] = {
    "calibration": _calibration,
    "evaluation": _evaluation,
    "study": _study,
    "model comparison": _models,
}


def _origin(source: str | os.PathLike, attributes: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """How the file was made, and how to reproduce it."""
    seed = attributes.get("seed")
    return [
        ("File", [fingerprint(source)]),
        ("Measured on", [str(attributes.get("measured") or "not stated")]),
        ("Created on", [str(attributes["created"])]),
        ("Command", [str(attributes["command"])]),
        ("aacmm_jax", [str(attributes["package_version"])]),
        ("Versions", [attributes.get("versions") or "not recorded"]),
        *([] if seed is None else [("Seed", [str(seed)])]),
        ("Sources", [str(line) for line in attributes.get("sources") or ["not recorded"]]),
    ]


def _render(report: Report, origin: list[tuple[str, list[str]]]) -> str:
    """The HTML of a report. Jinja escapes texts given by people, and only the page's own scripts run."""
    import jinja2

    def read(name: str) -> str:
        return (_FOLDER / name).read_text(encoding="utf-8")

    template = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    ).from_string(read("page_template.html"))
    script = read("page_script.js")
    blocks = [block for section in report.sections for block in section.blocks]
    return template.render(
        report=report,
        origin=origin,
        is_chart=lambda block: isinstance(block, Chart),
        is_table=lambda block: isinstance(block, ReportTable),
        is_arm_view=lambda block: isinstance(block, ArmView),
        plots=lambda chart: [drawn(plot, f"chart-{chart.id}") for plot in chart.plots],
        keys=_key,
        points={block.id: [points(plot) for plot in block.plots] for block in blocks if isinstance(block, Chart)},
        scenes={block.id: block.data for block in blocks if isinstance(block, ArmView)},
        style=read("page_style.css"),
        script=script,
        mark=hashlib.sha256(repr(origin).encode()).hexdigest()[:12],
        allowed=_script_hash(script),
    )


def _key(chart: Chart) -> list[tuple[str, str]]:
    if not chart.shade_limits:
        return key(chart.plots)
    return [*shade_key(chart.shade_limits, chart.shade_unit), *key(chart.plots, least=1)]


def _script_hash(script: str) -> str:
    """The source expression by which the page's content security policy allows one of its own scripts."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
