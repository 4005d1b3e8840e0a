"""One self-contained HTML page: text, charts, the view of the arm, style and scripts."""

import base64
import hashlib
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ..acceptance.judgement import Rule
from ..acceptance.procedure import Procedure
from ..acceptance.record import SIMULATED
from ..calibration.record import CalibrationRecord
from ..core.errors import require
from ..data.capture import Capture
from ..files.administrative_data import NOT_STATED, AdministrativeData, check_conformity
from ..files.hdf5 import provenance, read_summary, read_tables
from ..files.inputs import InputFile, fingerprint
from ..files.outputs import together, write_text
from ..files.plans import Angles
from ..pipeline.verification import Verification
from ..planning.design import Plan
from ..planning.kit import KitPlan
from ..plot.charts import Chart
from ..plot.svg import drawn, key, points, shade_keys
from ..summaries import planning
from ..summaries.tables import Cell, Table
from ..summaries.verification import verification_summary
from .elements import ArmView, Report

KINDS = ("calibration", "evaluation", "study", "model comparison", "comparison")
_FOLDER = Path(__file__).parent
_MOST_STACKED = 30  # cells: more would be a list without end
_NARROW, _CHARACTER, _GAP = 370.0, 7.6, 8.0  # pixels: a telephone's page, a character, between columns
_LONGEST = 14  # characters: longer texts are wrapped

# Group of rows: part, key, title, and whether it is shown where it is not stated.
_ROWS: dict[str, tuple[tuple[str, str, str, bool], ...]] = {
    "Laboratory": (("laboratory", "name", "Name", True), ("laboratory", "code", "Accreditation", False)),
    "Customer": (("customer", "name", "Name", True),),
    "Item": (
        ("item", "name", "Arm", False),
        ("item", "manufacturer", "Manufacturer", True),
        ("item", "model", "Model", True),
        ("item", "serial_number", "Serial number", True),
        ("item", "customer_number", "Customer's number", False),
    ),
    "Calibration": (
        ("certificate", "number", "Certificate number", True),
        ("certificate", "received", "Received on", False),
        ("certificate", "begin", "Begun on", True),
        ("certificate", "end", "Ended on", True),
        ("certificate", "issued", "Issued on", False),
        ("certificate", "place", "Place", False),
        ("certificate", "remarks", "Remarks", False),
    ),
}
_PLANS: dict[type, tuple[Any, Any]] = {
    Plan: (planning.plan_summary, planning.plan),
    KitPlan: (planning.kit_plan_summary, planning.kit_plan),
    Procedure: (planning.procedure_summary, planning.procedure),
}
_ADDRESS = ("street", "postal_code", "city", "country", "email", "phone")


def write_report(
    source: str | os.PathLike, target: str | os.PathLike, administrative_data: AdministrativeData | None = None
) -> dict[str, Any]:
    """Write the report of a calibration, an evaluation, a study, or compared models or calibrations as one HTML file.

    Returns title, verdict, warnings and size of the report. `InputError` if the source cannot be read or the target not
    written, the administrative data state a conformity that the source contradicts, or Jinja is not installed.

    Args:
        source: The HDF5 file of the calibration, the evaluation, the study, or the compared models or calibrations.
        target: The HTML file to write, whole or not at all.
        administrative_data: Laboratory, customer, item, persons, dates and artefacts, shown in a section of their own.

    Example:
        >>> aj.files.save_calibration("calibration.h5", record)
        >>> written = aj.report.write_report("calibration.h5", "report.html")
        >>> print(written["title"])
        Calibration of Cheng 2018, simulated arm
    """
    require("report", "a report")
    source, target = Path(source), Path(target)
    with together(target):
        kind = read_summary(source, KINDS)[0]["kind"]
        read = source if kind == "study" else InputFile(source)  # a study is read in parts
        attributes = read_tables(read, (kind,), without=("trials",)).attributes
        report = _report_of(kind, read, attributes)
        report = report._replace(subtitle=f"{report.subtitle}; {_identity(attributes, administrative_data)}")
        if report.simulated:
            warnings = list(dict.fromkeys([SIMULATED, *report.warnings]))
            mark = "unsure" if report.decision == "conforms" else report.verdict_mark  # no real arm conforms
            report = report._replace(warnings=warnings, verdict_mark=mark)
        if administrative_data is not None:
            needed = "" if kind == "evaluation" else "write the report of an evaluation with limits"
            check_conformity(
                administrative_data,
                simulated=report.simulated,
                decision=report.decision,
                rules=report.rules,
                needed=needed,
            )
            report = report._replace(administrative=_administrative(administrative_data, report.rules))
        return _written(report, _origin(read, attributes), target) | {"of": str(source)}


def write_plan(
    target: str | os.PathLike,
    planned: Plan | KitPlan | Procedure,
    arm: str = "",
    *,
    summary: dict[str, Any] | None = None,
    angles: Angles = "deg",
    both_sides: bool = False,
    sources: Sequence[str] = (),
) -> dict[str, Any]:
    """Write the page of a plan, to be taken to the machine, as one HTML file: a picture, what to put where, what it
    achieves, and the poses in their order, with a box to tick.

    Returns title, verdict, warnings and size of the page. `InputError` if the target cannot be written, or Jinja is not
    installed.

    Args:
        target: The HTML file to write, whole or not at all.
        planned: The plan of a calibration (`planning.plan`, `planning.plan_kit`) or of an acceptance test
            (`acceptance.plan_procedure`).
        arm: What the arm is called.
        summary: What ``aacmm plan --json`` prints of the plan; by default without the source of the noise.
        angles: Unit of the joint readings, "deg" or "rad".
        both_sides: Whether every pose is taken twice, as in `files.save_plan`.
        sources: Names and digests of the files that the plan was made from.

    Example:
        >>> sockets = {"A": (400, 200, 300), "B": (700, 500, 500)}
        >>> plan = aj.planning.plan(arm, sockets=sockets, lengths=[("A", "B", 0.002)], poses=12, candidates=200)
        >>> written = aj.report.write_plan("plan.html", plan, "my arm")
        >>> print(written["title"])
        Plan of a calibration, my arm
    """
    require("report", "a page")
    from ..files.plans import plan_csv
    from .plans import plan_report

    summarise, view = _PLANS[type(planned)]
    shown = summarise(planned, arm) if summary is None else summary
    with together(target):
        report = plan_report(planned, shown, view(shown), plan_csv(planned, angles, both_sides))
        attributes = provenance("plan") | {"sources": list(sources) or ["none"]}
        return _written(report, _origin(None, attributes), Path(target))


def write_verification(
    target: str | os.PathLike,
    checked: Verification,
    capture: Capture,
    summary: dict[str, Any] | None = None,
    *,
    sources: Sequence[str] = (),
    calibration: CalibrationRecord | None = None,
) -> dict[str, Any]:
    """Write what `aacmm_jax.verify` found as one HTML file that prints on one page: the verdict, the distance of every
    pose, the errors, what a calibration would gain, and what was not tested.

    Returns title, verdict, warnings and size of the page. `InputError` if the target cannot be written, or Jinja is not
    installed.

    Args:
        target: The HTML file to write, whole or not at all.
        checked: What was found.
        capture: The poses.
        summary: What ``aacmm verify --json`` prints; by default without the names of the arm and the parameters.
        sources: Names and digests of the files.
        calibration: Its held-out poses are drawn, too, if it was identified from this capture.

    Example:
        >>> checked = aj.verify(aj.Recording(two_bars, nominal), nominal._replace(arm=true))
        >>> written = aj.report.write_verification("verified.html", checked, two_bars)
        >>> print(written["title"])
        Verification of delivered parameters, an arm
    """
    require("report", "a page")
    from .verification import verification_report

    shown = verification_summary(checked, "an arm", "stated parameters") if summary is None else summary
    with together(target):
        attributes = provenance("verification") | {"sources": list(sources) or ["none"]}
        report = verification_report(checked, capture, shown, calibration)
        return _written(report, _origin(None, attributes), Path(target))


def _identity(attributes: dict[str, Any], given: AdministrativeData | None) -> str:
    """When it was measured, or else calculated, and which item and certificate it is of: on the first printed page."""
    measured, numbers = str(attributes.get("measured") or ""), []
    if given is not None:
        titled = ("serial number", given.item.serial_number), ("certificate", given.certificate.number)
        numbers = [f"{title} {value}" for title, value in titled if value]
    date = f"measured on {measured}" if measured else f"calculated on {str(attributes['created'])[:10]}"
    return "; ".join([date, *numbers])


def _written(report: Report, origin: list[tuple[str, list[str]]], target: Path) -> dict[str, Any]:
    page = _render(report, origin)
    write_text(target, page)
    return {
        "kind": "report",
        "title": report.title,
        "verdict": report.verdict,
        "warnings": report.warnings,
        "bytes": len(page.encode()),
        "written": str(target),
    }


def _report_of(kind: str, source: str | os.PathLike, attributes: dict[str, Any]) -> Report:
    if kind == "calibration":
        from ..files.calibrations import load_calibration
        from .calibration import calibration_report

        return calibration_report(load_calibration(source))
    if kind == "evaluation":
        from ..files.evaluations import load_evaluation
        from .evaluation import evaluation_report, points_report

        of_points = attributes.get("of") == "points"
        return (points_report if of_points else evaluation_report)(load_evaluation(source))
    if kind == "study":
        from ..study.store import Results
        from .studies import study_report

        return study_report(Results.of(source))
    if kind == "comparison":
        from ..files.comparisons import load_comparison
        from .drift import comparison_report

        return comparison_report(load_comparison(source))
    from ..files.evaluations import load_compared_models
    from .studies import models_report

    return models_report(load_compared_models(source))


def _origin(source: str | os.PathLike | None, attributes: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """How the file was made, and how to reproduce it."""
    seed = attributes.get("seed")
    measured = str(attributes.get("measured") or "not stated")
    return [
        *([] if source is None else [("File", [fingerprint(source)]), ("Measured on", [measured])]),
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
    # The engine that draws the arm is a module of the live page.
    script = read("../plot/view.js").replace("export class", "class") + read("page_script.js")
    blocks = [report.picture, *(block for section in report.sections for block in section.blocks)]
    return template.render(
        report=report,
        origin=origin,
        is_chart=lambda block: isinstance(block, Chart),
        is_table=lambda block: isinstance(block, Table),
        is_arm_view=lambda block: isinstance(block, ArmView),
        plots=lambda chart: [drawn(plot, f"chart-{chart.id}") for plot in chart.plots],
        stacked_table=_stacked,
        numbers=lambda cells, headings: [any(row[i].value is not None for row in cells) for i in range(len(headings))],
        keys=lambda chart: key(chart.plots),
        # On paper instead of pages of digests: what the list of all sources, as it is on the screen, hashes to.
        digest=lambda values: f"{len(values)} files; SHA-256 of this list, a line each: {_digest(values)}",
        points={
            block.id: [points(plot) for plot in block.plots]
            for block in blocks
            if isinstance(block, Chart) and block.plots
        },
        scenes={block.id: block.data for block in blocks if isinstance(block, ArmView)},
        shade_keys=shade_keys,
        style=read("page_style.css"),
        script=script,
        mark=hashlib.sha256(repr(origin).encode()).hexdigest()[:12],
        # The source expression by which the page's content security policy allows its own script.
        allowed="sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )


def _digest(lines: list[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _stacked(table: Table, cells: list[list[Cell]]) -> bool:
    """Whether a narrow screen shows each row as a list: a table of few cells that has no room on a telephone."""
    if len(cells) * len(table.headings) > _MOST_STACKED:
        return False
    texts = [[heading, *(row[i].text for row in cells)] for i, heading in enumerate(table.headings)]
    words = [max((len(word) for text in column for word in text.split()), default=0) for column in texts]
    whole = [max(map(len, column[1:]), default=0) if i else 0 for i, column in enumerate(texts)]
    characters = sum(max(word, min(text, _LONGEST)) for word, text in zip(words, whole, strict=True))
    return characters * _CHARACTER + _GAP * len(texts) > _NARROW


def _administrative(given: AdministrativeData, rules: Sequence[Rule]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Groups of titles and values of the administrative data."""

    def stated(part: str, key: str) -> str:
        value = getattr(getattr(given, part), key)
        return "" if value is None or value == "other" else str(value)

    groups: list[tuple[str, list[tuple[str, str]]]] = []
    for group, rows in _ROWS.items():
        values = [(title, stated(part, key), always) for part, key, title, always in rows]
        shown = [(title, value or NOT_STATED) for title, value, always in values if always or value]
        if group in ("Laboratory", "Customer"):
            address = _joined(stated(group.lower(), key) for key in _ADDRESS)
            shown += [("Address", address)] if address else []
        groups.append((group, shown))
    temperature, u = given.certificate.temperature_celsius, given.certificate.temperature_u_celsius
    celsius = NOT_STATED if temperature is None else f"{temperature:g} °C" + ("" if u is None else f", u = {u:g} °C")
    groups[-1][1].append(("Temperature", celsius))
    artefacts = [
        _joined((part.name, part.manufacturer, part.model, part.serial_number,
                 part.certificate_number and f"certificate {part.certificate_number}"))
        for part in given.reference
    ]  # fmt: skip
    persons = [
        _joined((person.name, person.role, "signs the certificate" if person.main_signer else None))
        for person in given.person
    ]
    for title, lines in (("Reference artefacts", artefacts), ("Responsible", persons)):
        groups.append((title, [("", line) for line in lines or [NOT_STATED]]))
    if given.conformity is not None:
        conformity = given.conformity
        words = f"{conformity.verdict}: {conformity.specification}; {conformity.decided_by(rules)}"
        groups.append(("Statement of conformity", [("", words)]))
    return groups


def _joined(parts: Iterable[str | None]) -> str:
    return ", ".join(filter(None, parts))
