"""Commands for who wants to know whether the maker's calibration is good: ``verify``, and ``sockets`` to print."""

import os
from pathlib import Path
from typing import Any

import typer

from .. import files, plot, summaries
from ..core.errors import InputError
from ..core.text import common_labels
from ..files.hdf5 import read_summary
from ..files.inputs import fingerprint
from ..files.outputs import together, write_atomically
from ..summaries.tables import View
from . import options
from .app import command, read_recording, show_summary, with_spinner
from .options import argument, option, output


@command(
    "aacmm verify poses.toml --delivered kinematics.yaml",
    "aacmm verify poses.toml --delivered panda --max-rms-mm 1 -o verified.html",
    "aacmm verify capture.h5 --delivered robot-as-delivered.urdf --tip tool0",
    "aacmm verify poses.toml --delivered panda --calibration calibration.h5 -o verified.html",
)
def verify(
    capture: Path = argument(
        "Manifest or capture of a handful of poses: in two sockets, of a board, or seen by a tracker. Its arm is the "
        "nominal one.",
        "CAPTURE.h5|MANIFEST.toml",
    ),
    delivered: str | None = option(
        "Arm with the parameters that the maker or controller states: a kinematics.yaml or calibration.conf (Universal "
        "Robots), a URDF, an MJCF, or a TOML file with D-H parameters and zero offsets. Default: as_found of the "
        "manifest.",
        "ARM",
    ),
    base: str | None = options.BASE_LINK,
    tip: list[str] | None = options.TIP_LINK,
    max_rms_mm: float | None = option(
        "RMS error of the tip that your task allows: half of what a single pose may err. Say whether the delivered "
        "parameters meet it, and exit with code 1 unless they do, or the calibrated arm of --calibration.",
        min=0,
    ),
    calibration: Path | None = option(
        "Calibration of this arm: test the calibrated arm, too, on the held-out poses of its cross-validation.",
        "CALIBRATION.h5",
    ),
    output: Path | None = output(
        "Page for printing: verdict, picture, numbers, and what was not tested.", "PAGE.html", default=None
    ),
    as_json: bool = options.JSON,
) -> None:
    """Test the maker's parameters on a few poses.

    The command prints the error of the tip as delivered, with U; whether the delivered parameters are better or worse
    than the nominal ones, or as good, or that these poses do not decide it; how many poses do; and what a recalibration
    would gain. If the delivered parameters are the nominal ones, it prints whether they are good or a calibration would
    gain 30 % and more.
    The position of the tool tip, the frames of instruments and the positions of sockets are unknown and are fitted.

    The verdict is a two-sided test at the 5 % level, and "no difference that matters" (errors over the working volume
    that differ by less than 30 % of the larger) two one-sided tests. If the data do not match
    the arm (as aacmm calibrate tests it), there is no verdict. The exit code is 1 then, and if the delivered parameters
    are worse, or not good; with --max-rms-mm, unless they meet it.
    """
    from ..pipeline.verification import verify as run

    with together(output):
        recording = read_recording(capture)
        arm = None if delivered is None else files.load_specification(delivered, base=base, tip=tip)
    named = None if arm is None or os.path.isfile(str(delivered)) else arm
    if named is not None and named.arm.joints == recording.nominal.arm.joints:
        _refuse_another_robot(recording.nominal, named)
    record = None if calibration is None else _cross_validated(calibration, recording.nominal.name)
    checked = with_spinner("Verifying", lambda: run(recording, arm))
    given, measured = arm or recording.as_found, recording.capture
    summary = summaries.verification.verification_summary(
        checked,
        recording.nominal.name,
        delivered or ("" if given is None else given.name),
        scaled=bool(measured.lengths or measured.observations),
        max_rms=max_rms_mm,
        calibrated=None if calibration is None else _calibrated(calibration, record),
        lengths=common_labels([(length.start, length.end) for length in measured.lengths]),
    )
    if named is not None and named.name != recording.nominal.name:
        summary["warnings"].append(
            f"The delivered arm '{named.name}' is not the arm '{summary['arm']}' of the recording; use the same robot."
        )
    if output is not None:
        from ..report import write_verification

        files_read = [path for path in (capture, delivered, calibration) if path and os.path.isfile(path)]
        sources = dict.fromkeys([*map(fingerprint, files_read), *recording.sources])
        write_verification(output, checked, measured, summary, sources=list(sources), calibration=record)
        summary["written"] = str(output)
    show_summary(summary, as_json, summaries.verification.verification)
    if not summary["achieved"]:
        raise typer.Exit(1)


def _cross_validated(path: Path, arm: str) -> Any:
    """A calibration of the arm with this name, which has a cross-validation."""
    record = files.load_calibration(path)
    if record.validation is None:
        raise InputError(f"{path} has no cross-validation; calibrate this recording with --cross-validate.")
    if record.recording.nominal.name != arm:
        raise InputError(
            f"{path} is of '{record.recording.nominal.name}', and not of '{arm}', the arm of the recording; give a "
            "calibration of this recording."
        )
    return record


def _calibrated(path: Path, record: Any) -> Any:
    """What is said of a calibration beside the verdict."""
    from ..kinematics.arm import correction_names

    summary = read_summary(path, ("calibration",))[1] or summaries.calibration.calibration_summary(record)
    verdict, tested, caution = summary["verdict"], summary.get("lengths_tested"), ""
    if verdict["mark"] in ("unsure", "bad"):
        caution = f"{path}: {verdict['says'].partition('. ')[0].rstrip('.')}."
        if tested:
            caution += f" Lengths over {tested['longest_mm']:.4g} mm are untested."
    corrections = bool(correction_names(record.calibrated.arm))
    return summaries.verification.Calibrated(record.validation, str(path), corrections, caution)


def _refuse_another_robot(nominal: Any, arm: Any) -> None:
    """Refuse an arm given by its name whose parameters differ by more than a calibration changes, but for its probe;
    a file with the parameters of one robot may describe nearly parallel axes by quite other numbers."""
    for names, values in zip((("a", "d"), ("alpha",)), (nominal.length, nominal.angle), strict=True):
        for name in names:
            if float(abs(getattr(arm.arm, name) - getattr(nominal.arm, name)).max()) > values:
                raise InputError(
                    f"--delivered '{arm.name}' is another robot than '{nominal.name}', the arm of the recording: they "
                    f"differ in {name}; name the delivered parameters of the same robot."
                )


@command(
    "aacmm sockets -o sockets.stl --drawing sockets.pdf", "aacmm sockets -o sockets.stl --distance-mm 150 --ball-mm 10"
)
def sockets(
    output: Path = output("Plate with two conical sockets to print (binary STL, mm).", "PLATE.stl"),
    drawing: Path | None = option("Also draw it with its dimensions, true to scale (PDF, A4).", "DRAWING.pdf"),
    distance_mm: float = option("Distance between the sockets.", default=100.0, min=0),
    ball_mm: float = option("Diameter of the ball at the tip of the arm.", default=12.7, min=0),
    as_json: bool = options.JSON,
) -> None:
    """Make a plate with two sockets for a 3-D printer.

    A ball at the end of the arm rests in a cone and touches it in a circle. Printers err by tenths of a millimetre, so
    measure the distance of the sockets with callipers over two balls. The command prints the lines that a manifest
    needs.
    """
    plate = plot.SocketPlate(distance_mm, ball_mm)
    with together(output, drawing):
        with write_atomically(output) as temporary:
            temporary.write_bytes(plot.socket_plate_stl(plate))
        if drawing is not None:
            with write_atomically(drawing) as temporary:
                temporary.write_bytes(plot.socket_plate_pdf(plate))
    summary: dict[str, Any] = {
        "written": [str(path) for path in (output, drawing) if path is not None],
        "size_mm": plate.size,
        "over_balls_mm": distance_mm + ball_mm,
        "ball_above_plate_mm": plate.ball_height,
        "manifest": [
            *("[[socket]]", 'name = "{socket}"', 'file = "{socket}.csv"', "", "[[length]]"),
            *(
                'from = "A"',
                'to = "B"',
                f"value = {distance_mm:g}  # mm: what you measured over the balls, less {ball_mm:g}",
            ),
            "u = 0.05",
        ],
    }
    show_summary(summary, as_json, _plate)


def _plate(summary: dict[str, Any]) -> View:
    yield f"{', '.join(summary['written'])}: a plate of {' x '.join(f'{x:g}' for x in summary['size_mm'])} mm."
    yield (
        f"Print it solid, screw or clamp it to the table, and measure over two balls in the sockets, which should be "
        f"{summary['over_balls_mm']:g} mm. The lines for the manifest:"
    )
    yield ""
    yield from summary["manifest"]
