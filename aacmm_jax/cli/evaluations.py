"""What the commands on results do: evaluations, and certificates with them."""

from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.text import shorten
from ..files.hdf5 import read_summary, read_tables
from ..files.inputs import InputFile, fingerprint
from ..files.outputs import together
from .app import with_spinner


def evaluated(
    calibration: Path,
    capture: Path,
    output: Path | None,
    choice: tuple,
    measuring_range: float | None,
    of_test: dict[str, Any],
) -> dict[str, Any]:
    """Evaluate a calibration on a capture; the summary."""
    from ..acceptance.record import evaluation_of
    from ..files.calibrations import load_calibration
    from ..files.captures import load_capture
    from ..files.evaluations import save_evaluation
    from ..files.inputs import InputFile, fingerprint
    from ..summaries.evaluation import evaluation_summary

    with together(output):
        read = InputFile(calibration), InputFile(capture)
        record, recording = load_calibration(read[0]), load_capture(read[1])
        recording = recording._replace(
            capture=recording.capture.select(choice[0] or None, choice[1] or ()),
            sources=(*map(fingerprint, read), *recording.sources),
            measuring_range=measuring_range or recording.measuring_range,
        )
        found = evaluation_of(record, recording, **of_test, calibration_warnings=_warnings_of(read[0], record))
        summary = with_spinner("Evaluating", lambda: evaluation_summary(found))
        if not summary["acceptance"]:
            _refuse_options_of_tests(of_test, measuring_range)
        if output is not None:
            save_evaluation(output, found, summary)
            summary["written"] = str(output)
    return summary


def _refuse_options_of_tests(of_test: dict[str, Any], measuring_range: float | None) -> None:
    """Raise `InputError` where options are given that only acceptance tests have, and none was made."""
    influences = of_test["influences"]
    options = {
        "--rule": of_test["rule"] is not None,
        "--test-u-mm": of_test["u_test"] > 0 or influences.u_relative > 0,
        "--expansion": influences.artefact is not None or influences.arm is not None,
        "--range-mm": measuring_range is not None,
    }
    given = [option for option, there in options.items() if there]
    if given:
        raise InputError(
            f"{shorten(given)} is for acceptance tests, of which this capture allows none or none is asked for; name "
            "them with --acceptance, or leave the option out."
        )


def _warnings_of(file: InputFile, record: Any) -> list[str]:
    """What the calibration warned of, from the summary in its file."""
    summary = read_summary(file, ("calibration",))[1]
    if summary is None:
        from ..diagnostics.findings import findings_of, sentences

        return sentences(findings_of(record))
    return summary["warnings"]


def evaluated_points(
    manifest: Path,
    output: Path | None,
    standards: list[str] | None,
    measuring_range: float | None,
    of_test: dict[str, Any],
) -> dict[str, Any]:
    """Run the acceptance tests of a manifest of points; the summary."""
    from ..acceptance.record import PointsRecord
    from ..acceptance.standards import STANDARDS, checked_standards
    from ..files.evaluations import save_points
    from ..files.points import read_points
    from ..summaries.evaluation import points_summary

    if manifest.suffix != ".toml":
        raise InputError(
            f"{manifest} alone cannot be evaluated; name a capture as well, or a manifest of points (TOML)."
        )
    with together(output):
        chosen = checked_standards(STANDARDS if standards is None else standards)
        measured = read_points(manifest)
        measured = measured._replace(measuring_range=measuring_range or measured.measuring_range)
        record = PointsRecord(measured, standards=chosen, **of_test)
        summary = points_summary(record)
        if output is not None:
            save_points(output, record, summary)
            summary["written"] = str(output)
    return summary


def certificate(calibration: InputFile, record: Any, about: Path | None, evaluation: Path | None) -> str:
    """The text of a certificate, with the acceptance tests of an evaluation where one is named."""
    from ..certificate import dcc_xml
    from ..files.administrative_data import AdministrativeData as Stated
    from ..files.administrative_data import read_administrative_data

    made = read_tables(calibration, ("calibration",)).attributes
    sources = [fingerprint(calibration), *record.recording.sources]
    tested = None
    if evaluation is not None:
        from ..files.evaluations import load_evaluation

        tested = load_evaluation(read := InputFile(evaluation))
        sources += [fingerprint(read), *tested.recording.sources]
    return dcc_xml(
        record,
        Stated() if about is None else read_administrative_data(about),
        created=made["created"],
        sources=list(dict.fromkeys(sources)),
        evaluation=tested,
        command=made["command"],
    )
