"""What a finished live capture writes: the capture, and its calibration with the report."""

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..data.recording import RecordedAs, Recording
from ..files.captures import save_capture
from ..kinematics.arm import Arm
from .guidance import Guidance
from .places import Setup, TakenPose, capture_of

_LONGEST = 10.0  # s, for guidance to see the last pose


def fitting(look: Callable[[], tuple[Sequence[TakenPose], Guidance | None]], stop: threading.Event) -> list[TakenPose]:
    """The poses that guidance does not leave out: ``look`` gives all of them, and what guidance has found. Where it has
    not seen the last one yet, it is waited for, some seconds at most, or until ``stop`` is set."""
    until = time.monotonic() + _LONGEST
    while True:
        poses, guidance = look()
        if guidance is None or not poses or poses[-1].excluded or poses[-1].number in guidance.poses:
            break
        if stop.wait(0.02) or time.monotonic() > until:
            break
    wrong = set() if guidance is None else {number for number, one in guidance.poses.items() if one.outlier}
    return [pose for pose in poses if pose.number not in wrong]


def written(
    setup: Setup,
    poses: Sequence[TakenPose],
    path: Path,
    calibrate: bool,
    true: Arm | None = None,
    sources: tuple[str, ...] = (),
    *,
    read_as: tuple[int, ...] | None = None,
    recorded_as: RecordedAs | None = None,
) -> tuple[list[str], list[str]]:
    """Write a capture, and if asked for its calibration and report beside it; the names of the files, and what the
    calibration says: its verdict, and its warnings. ``true``: the arm of a simulation; ``sources``,
    ``read_as`` and ``recorded_as``: those of `Recording`."""
    from ..calibration.record import uncertainty_of
    from ..files.calibrations import save_calibration
    from ..pipeline.capture_calibration import calibrate_capture
    from ..report import write_report
    from ..summaries.calibration import calibration_summary
    from ..uncertainty.volume import volumetric_uncertainty

    capture, _ = capture_of(setup, poses)
    simulated = None if true is None else setup.specification._replace(arm=true)
    day = time.strftime("%Y-%m-%d")
    told: dict[str, Any] = {"read_as": read_as, "recorded_as": recorded_as, "sources": sources}
    told |= {"usual": setup.noise, "measured": day}
    recording = Recording(capture, setup.specification, simulated, **told)
    save_capture(path, recording)
    if not calibrate:
        return [str(path)], []
    scaled = capture.lengths or any(observation.fixes_scale for observation in capture.observations)
    calibration = path.with_name(f"{path.stem}-calibration.h5")
    record = calibrate_capture(recording, scale="measured" if scaled else "nominal")
    save_calibration(calibration, record)
    report = calibration.with_suffix(".html")
    write_report(calibration, report)
    summary = calibration_summary(record, volumetric_uncertainty(uncertainty_of(record)))
    return [str(path), str(calibration), str(report)], [summary["verdict"]["says"], *summary["warnings"]]
