"""What a finished live capture writes: the capture, and its calibration with the report."""

import time
from collections.abc import Sequence
from pathlib import Path

from ..data.recording import Recording
from ..files.captures import save_capture
from .places import Setup, TakenPose, capture_of


def written(setup: Setup, poses: Sequence[TakenPose], path: Path, calibrate: bool) -> list[str]:
    """Write a capture, and if asked for its calibration and report beside it; the names of the files."""
    from ..files.calibrations import save_calibration
    from ..pipeline.capture_calibration import calibrate_capture
    from ..report import write_report

    capture, _ = capture_of(setup, poses)
    recording = Recording(capture, setup.specification, usual=setup.noise, measured=time.strftime("%Y-%m-%d"))
    save_capture(path, recording)
    if not calibrate:
        return [str(path)]
    scaled = capture.lengths or any(observation.fixes_scale for observation in capture.observations)
    calibration = path.with_name(f"{path.stem}-calibration.h5")
    save_calibration(calibration, calibrate_capture(recording, scale="measured" if scaled else "nominal"))
    report = calibration.with_suffix(".html")
    write_report(calibration, report)
    return [str(path), str(calibration), str(report)]
