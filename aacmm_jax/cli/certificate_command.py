"""``certificate``: the printed certificate of a calibration, and the Digital Calibration Certificate behind it."""

from pathlib import Path
from typing import Any

import typer

from .. import files
from ..core.errors import InputError
from ..files.inputs import InputFile, fingerprint
from ..files.outputs import together, write_atomically
from . import options
from .app import command, warn_of_unusable, with_spinner
from .options import flag, option, output


@command(
    "aacmm certificate calibration.h5 --about laboratory.toml -o certificate.pdf",
    "aacmm certificate calibration.h5 --about laboratory.toml --evaluation tests.h5 --language de -o certificate.html",
)
def certificate(
    calibration: Path = options.CALIBRATION_FILE,
    output: Path = output(
        "File to write the certificate to: .pdf, with the Digital Calibration Certificate attached, or .html.",
        "FILE.pdf",
    ),
    about: Path | None = options.ABOUT,
    evaluation: Path | None = options.EVALUATION,
    language: str = option(
        "Language: en, de, or a TOML file with the texts of another language.", "en|de|FILE.toml", default="en"
    ),
    force: bool = flag("--force", "Certify a calibration that is not usable all the same."),
) -> None:
    """Write the certificate of a calibration on two pages.

    It is a PDF or HTML, and contains identification, conditions, traceability, results with U and k, acceptance tests
    and their decision rule, and a place for the signature. export --format dcc writes the Digital Calibration
    Certificate alone.
    """
    from ..certificate.printed import printed_certificate
    from ..certificate.unstated import unstated

    suffix = output.suffix.lower()
    if suffix not in (".pdf", ".html"):
        raise InputError(f"{output} is neither a .pdf nor a .html file; choose one of these for the certificate.")
    with together(output):
        record = files.load_calibration(read := InputFile(calibration))
        warn_of_unusable(calibration, record, force)
        dcc, logo = dcc_of(read, record, about, evaluation), None if about is None else files.read_logo(about)
        printed = printed_certificate(dcc, language=language, logo=logo)
        content = with_spinner("Writing the certificate", printed.pdf if suffix == ".pdf" else printed.html)
        with write_atomically(output) as temporary:
            temporary.write_bytes(content if isinstance(content, bytes) else content.encode())
    typer.echo(f"Written: {output}")
    for sentence in unstated(dcc, administrative_data(about)):
        typer.echo(sentence)


def administrative_data(about: Path | None) -> "files.AdministrativeData":
    """The administrative data of a file; none is stated without one."""
    return files.AdministrativeData() if about is None else files.read_administrative_data(about)


def dcc_of(calibration: InputFile, record: Any, about: Path | None, evaluation: Path | None) -> str:
    """The text of a certificate, with the acceptance tests of an evaluation where one is named."""
    from ..acceptance.record import EvaluationRecord
    from ..certificate.document import dcc_xml
    from ..files.hdf5 import read_tables

    made = read_tables(calibration, ("calibration",)).attributes
    sources = [fingerprint(calibration), *record.recording.sources]
    tested = None
    if evaluation is not None:
        tested = files.load_evaluation(read := InputFile(evaluation))
        if not isinstance(tested, EvaluationRecord):
            raise InputError(
                f"{evaluation} is an evaluation of recorded points; name an evaluation of this calibration on a "
                "capture."
            )
        sources += [fingerprint(read), *tested.recording.sources]
    return dcc_xml(
        record,
        administrative_data(about),
        created=made["created"],
        sources=list(dict.fromkeys(sources)),
        evaluation=tested,
        command=made["command"],
    )
