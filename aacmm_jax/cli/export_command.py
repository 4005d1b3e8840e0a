"""The command ``export``: a calibration for other programs and controllers."""

import json
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer

from .. import files, summaries
from ..core.errors import InputError
from ..core.text import printable, shorten
from ..files.inputs import InputFile, fingerprint
from ..files.outputs import check_kept, together, write_text
from . import options
from .app import app, examples, warn_of_unusable
from .arm_command import first_frame
from .options import option, output

_FORMATS = {".urdf": "urdf", ".json": "json", ".csv": "csv", ".yaml": "ur", ".yml": "ur", ".py": "python"}
_OF_ONE_ARM = ("toml", "urdf", "table", "ur", "python")


@app.command(
    epilog=examples(
        "aacmm export calibration.h5 --format toml -o arm.toml",
        "aacmm export calibration.h5 -o robot.urdf",
        "aacmm export calibration.h5 --format table --convention craig --units m-rad",
        "aacmm export calibration.h5 --format dcc --evaluation tests.h5 --about laboratory.toml -o certificate.xml",
    )
)
def export(
    calibration: Path = options.CALIBRATION_FILE,
    form: Literal["toml", "json", "csv", "dcc", "urdf", "table", "offsets", "ur", "python"] | None = option(
        None,
        "toml: the arm; json: the whole summary; csv: parameters; dcc: Digital Calibration Certificate (XML); urdf: "
        "the URDF of the nominal arm, with calibrated origins; table: D-H table (CSV); offsets: zero offsets of the "
        "joints alone, refitted; ur: kinematics.yaml of Universal Robots; python: a program that needs only NumPy. "
        "Default: by the name of the output (.urdf, .json, .csv, .yaml, .py), else toml.",
        "--format",
    ),
    which: Literal["calibrated", "nominal", "true"] | None = option(
        None,
        "Arm to write with --format toml, urdf, table, ur or python; a simulation has a true one. Default: calibrated.",
        "--arm",
    ),
    convention: Literal["standard", "craig"] | None = option(None, "Convention of --format table. Default: standard."),
    units: Literal["mm-deg", "m-rad"] | None = option(None, "Units of --format table. Default: mm-deg."),
    output: Path | None = output("FILE", "File to write. Default: standard output.", None),
    about: Path | None = options.ABOUT,
    evaluation: Path | None = option(
        "FILE.h5",
        "Add the acceptance tests of this evaluation (aacmm evaluate -o) of the calibration to --format dcc.",
    ),
) -> None:
    """Write a calibration for other programs or controllers."""
    written_as: str = form or _FORMATS.get("" if output is None else output.suffix.lower(), "toml")
    if (about is not None or evaluation is not None) and written_as != "dcc":
        raise InputError("--about and --evaluation are for certificates; give them with --format dcc.")
    if which is not None and written_as not in _OF_ONE_ARM:
        raise InputError(
            f"--arm is for --format {', '.join(_OF_ONE_ARM)}; leave it out, as {written_as} holds what it needs."
        )
    if (convention is not None or units is not None) and written_as != "table":
        raise InputError("--convention and --units are for tables; give them with --format table.")
    notes: list[str] = []
    with together(output):
        record = files.load_calibration(read := InputFile(calibration))
        nominal = record.recording.nominal
        arms = {"calibrated": record.calibrated, "nominal": nominal, "true": record.recording.true}
        specification = arms[which or "calibrated"]
        if specification is None:
            raise InputError(f"{calibration} is not of a simulation, so it has no true arm; choose another --arm.")
        warn_of_unusable(calibration, record)
        if written_as == "dcc":
            text = _certificate(read, record, about, evaluation)
        elif written_as == "table":
            text = files.dh_table(
                specification.arm,
                convention=convention or "standard",
                units=units or "mm-deg",
                base=first_frame(nominal),
            )
            notes = _left_out_of_table(record, specification.arm)
        elif written_as == "urdf":
            text, notes = _urdf(record, specification)
        else:
            text = _text(record, specification, written_as, which in (None, "calibrated"))
        if output is not None:
            if written_as == "urdf" and nominal.urdf and text != nominal.urdf.text:
                check_kept(output, nominal.urdf.text)
            write_text(output, text)
    typer.echo(text, nl=False) if output is None else typer.echo(f"Written: {output}")
    for note in notes:
        typer.echo(printable(note), err=output is None)


def _text(record: Any, specification: Any, form: str, calibrated: bool) -> str:
    """The text of a format that needs no words beside it."""
    nominal, capture = record.recording.nominal, record.recording.capture
    if form == "json":
        return json.dumps(summaries.calibration.calibration_summary(record), indent=2) + "\n"
    if form == "csv":
        return summaries.calibration.parameters_csv(record)
    if form == "ur":
        return files.ur_kinematics_yaml(specification.arm)
    if form == "offsets":
        readings = np.asarray(capture.readings)[:, : nominal.arm.joints]
        return files.zero_offsets_csv(files.zero_offsets(nominal.arm, record.calibrated.arm, readings))
    scale = "" if math.isnan(record.k) else f", k = {record.k:.8f}"
    source = f"calibrated from {len(capture.readings)} poses, {record.method}{scale}" if calibrated else ""
    if form == "toml":
        from ..files.arms import specification_toml

        return specification_toml(specification, source=source)
    title = ", ".join(part for part in (specification.name, source) if part)
    return files.python_program(specification.arm, title=title, base=first_frame(nominal))


def _left_out_of_table(record: Any, arm: Any) -> list[str]:
    """What Denavit-Hartenberg parameters alone leave out, where they do."""
    from ..kinematics.arm import without_corrections

    if arm.corrections is None or not np.any(arm.coefficients):
        return []
    q = np.asarray(record.recording.capture.readings)
    moved = np.linalg.norm(np.asarray(arm.position(q)) - np.asarray(without_corrections(arm).position(q)), axis=1)
    return [
        f"The {np.count_nonzero(arm.coefficients)} coefficients of joint corrections stand in comments: by the table "
        f"alone the tip is elsewhere by up to {moved.max():.3g} mm over the poses of the calibration."
    ]


def _urdf(record: Any, specification: Any) -> tuple[str, list[str]]:
    result = files.urdf_of(specification.arm, record.recording.nominal)
    if not result.changed and not result.notes:
        return result.text, ["No origin changed."]
    return result.text, [
        f"Joints with another origin: {shorten(result.changed, 12) or 'none'}.",
        *(note[0].upper() + note[1:] for note in result.notes),
        "The base, and where each frame is along its axis and about it, stay as they were as far as they can: data on "
        "the tip do not determine them.",
    ]


def _certificate(calibration: InputFile, record: Any, about: Path | None, evaluation: Path | None) -> str:
    """The text of a certificate, with the acceptance tests of an evaluation where one is named."""
    from ..acceptance.record import EvaluationRecord
    from ..certificate import dcc_xml
    from ..files.hdf5 import read_tables

    made = read_tables(calibration, ("calibration",)).attributes
    sources = [fingerprint(calibration), *record.recording.sources]
    tested = None
    if evaluation is not None:
        tested = files.load_evaluation(read := InputFile(evaluation))
        if not isinstance(tested, EvaluationRecord):
            raise InputError(f"{evaluation} is of points; name an evaluation of the calibrated arm on a capture.")
        sources += [fingerprint(read), *tested.recording.sources]
    return dcc_xml(
        record,
        files.AdministrativeData() if about is None else files.read_administrative_data(about),
        created=made["created"],
        sources=list(dict.fromkeys(sources)),
        evaluation=tested,
        command=made["command"],
    )
