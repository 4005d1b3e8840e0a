"""The command ``export``: a calibration for other programs and controllers."""

import json
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer

from ..core.errors import InputError
from ..core.text import printable, shorten
from ..files.inputs import InputFile, fingerprint
from ..files.outputs import check_kept, together, write_text
from . import options
from .app import app, examples, warn_of_unusable
from .options import option, output
from .result_commands import ABOUT

_FORMATS = {".urdf": "urdf", ".json": "json", ".csv": "csv", ".yaml": "ur", ".yml": "ur", ".py": "python"}
_OF_ONE_ARM = ("toml", "urdf", "table", "ur", "python")
Exported = tuple[str, tuple[str, ...]]  # a text, and what is to be said with it


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
    about: Path | None = ABOUT,
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
    from ..files.calibrations import load_calibration

    with together(output):
        record = load_calibration(read := InputFile(calibration))
        arms = {"calibrated": record.calibrated, "nominal": record.recording.nominal, "true": record.recording.true}
        specification = arms[which or "calibrated"]
        if specification is None:
            raise InputError(f"{calibration} is not of a simulation, so it has no true arm; choose another --arm.")
        warn_of_unusable(calibration, record)
        notes: tuple[str, ...] = ()
        if written_as == "dcc":
            text = _certificate(read, record, about, evaluation)
        elif written_as == "table":
            text, notes = _table(record, specification, convention or "standard", units or "mm-deg")
        elif written_as == "urdf":
            text, notes = _urdf(record, specification)
        else:
            text = _text(record, specification, written_as, which)
        if output is not None:
            if written_as == "urdf" and (original := record.recording.nominal.urdf) and text != original.text:
                check_kept(output, original.text)
            write_text(output, text)
    typer.echo(text, nl=False) if output is None else typer.echo(f"Written: {output}")
    for note in notes:
        typer.echo(printable(note), err=output is None)


def _text(record: Any, specification: Any, form: str, which: str | None) -> str:
    """The text of a format that needs no words beside it."""
    from ..files import controllers
    from ..files.arms import specification_toml
    from ..files.ur_kinematics import ur_kinematics_yaml
    from ..summaries.calibration import calibration_summary, parameters_csv

    if form == "json":
        return json.dumps(calibration_summary(record), indent=2) + "\n"
    if form == "csv":
        return parameters_csv(record)
    if form == "ur":
        return ur_kinematics_yaml(specification.arm)
    nominal, capture = record.recording.nominal, record.recording.capture
    if form == "offsets":
        readings = np.asarray(capture.readings)[:, : nominal.arm.joints]
        return controllers.zero_offsets_csv(controllers.zero_offsets(nominal.arm, record.calibrated.arm, readings))
    scale = "" if math.isnan(record.k) else f", k = {record.k:.8f}"
    of_nominal = which not in (None, "calibrated")
    source = "" if of_nominal else f"calibrated from {len(capture.readings)} poses, {record.method}{scale}"
    if form == "toml":
        return specification_toml(specification, source=source)
    title = ", ".join(part for part in (specification.name, source) if part)
    return controllers.python_program(specification.arm, title=title, base=_base(nominal))


def _base(nominal: Any) -> Any:
    """The first frame in the base link of a URDF; None for other arms."""
    if nominal.urdf is None:
        return None
    from ..files.urdf import urdf_chain

    return urdf_chain(nominal.urdf).base


def _table(record: Any, specification: Any, convention: Any, units: Any) -> Exported:
    """A D-H table, and what Denavit-Hartenberg parameters alone leave out, where they do."""
    from ..files.controllers import dh_table
    from ..kinematics.arm import without_corrections

    arm = specification.arm
    text = dh_table(arm, convention=convention, units=units, base=_base(record.recording.nominal))
    if arm.corrections is None or not np.any(arm.coefficients):
        return text, ()
    q = np.asarray(record.recording.capture.readings)
    moved = np.linalg.norm(np.asarray(arm.position(q)) - np.asarray(without_corrections(arm).position(q)), axis=1)
    return text, (
        f"The {np.count_nonzero(arm.coefficients)} coefficients of joint corrections stand in comments: by the table "
        f"alone the tip is elsewhere by up to {moved.max():.3g} mm over the poses of the calibration.",
    )


def _urdf(record: Any, specification: Any) -> Exported:
    from ..files.urdf import urdf_of

    result = urdf_of(specification.arm, record.recording.nominal)
    if not result.changed and not result.notes:
        return result.text, ("No origin changed.",)
    return result.text, (
        f"Joints with another origin: {shorten(result.changed, 12) or 'none'}.",
        *(note[0].upper() + note[1:] for note in result.notes),
        "The base, and where each frame is along its axis and about it, stay as they were as far as they can: data on "
        "the tip do not determine them.",
    )


def _certificate(calibration: InputFile, record: Any, about: Path | None, evaluation: Path | None) -> str:
    """The text of a certificate, with the acceptance tests of an evaluation where one is named."""
    from ..acceptance.record import EvaluationRecord
    from ..certificate import dcc_xml
    from ..files.administrative_data import AdministrativeData, read_administrative_data
    from ..files.evaluations import load_evaluation
    from ..files.hdf5 import read_tables

    made = read_tables(calibration, ("calibration",)).attributes
    sources = [fingerprint(calibration), *record.recording.sources]
    tested = None
    if evaluation is not None:
        tested = load_evaluation(read := InputFile(evaluation))
        if not isinstance(tested, EvaluationRecord):
            raise InputError(f"{evaluation} is of points; name an evaluation of the calibrated arm on a capture.")
        sources += [fingerprint(read), *tested.recording.sources]
    return dcc_xml(
        record,
        AdministrativeData() if about is None else read_administrative_data(about),
        created=made["created"],
        sources=list(dict.fromkeys(sources)),
        evaluation=tested,
        command=made["command"],
    )
