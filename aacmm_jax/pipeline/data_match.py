"""Whether recorded data match the arm that they are said to be of, as a calibration tests it."""

from typing import Any

from ..core.errors import InputError
from ..data.recording import Recording
from ..diagnostics.contradictions import POSE, POSES, removal
from ..diagnostics.findings import findings_of, sentences
from ..diagnostics.recorded import findings_of_capture, of_recording
from ..diagnostics.usability import does_not_fit, why_unusable
from .capture_calibration import calibrate_capture

# Steps of the calibration: data that match an arm take far fewer.
_OPTIONS: dict[str, Any] = {"model": "dh", "shared_errors": False, "cross_validate": False, "max_steps": 100}


def data_mismatch(recording: Recording) -> tuple[str, tuple[str, ...]]:
    """Why the data do not match the nominal arm, in a few words, empty where they do; and the warnings to read.

    Decided by a calibration of D-H parameters with the defaults of `calibrate_capture`; where the poses are too few for
    one, by what ``aacmm import`` says of a capture."""
    capture = recording.capture
    scaled = bool(capture.lengths) or any(observation.fixes_scale for observation in capture.observations)
    try:
        record = calibrate_capture(recording, scale="measured" if scaled else "nominal", **_OPTIONS)
    except InputError:
        findings = findings_of_capture(recording)
        causes = any(finding.code == "likely-cause" for finding in findings)
        return ("the data do not match the arm" if causes else ""), tuple(sentences(findings))
    left_out = sentences(removal(removed) for removed in record.removed)
    corrected = [says for says in record.decisions if says.startswith("The readings")]
    said = tuple(dict.fromkeys([*corrected, *left_out, *sentences(of_recording(recording))]))
    if reason := why_unusable(record):
        unusable = [finding for finding in findings_of(record) if finding.severity == "unusable"]
        return reason, (*sentences(unusable), *said)
    if corrected or does_not_fit(record):
        return "the data do not match the arm", said
    mixed_up = any(removed.kind in (POSE, POSES) for removed in record.removed)
    return ("some poses contradict all others" if mixed_up else ""), said
