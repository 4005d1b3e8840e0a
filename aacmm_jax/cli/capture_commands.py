"""Commands that make captures: ``demo``, ``simulate``, ``import``."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import InputError
from .app import Json, app, bad_option, length_option, show_summary, socket_option, with_spinner

_U_ARTEFACT = 0.001  # mm


@app.command(epilog="Example: aacmm demo my-demo --seed 7")
def demo(
    folder: Annotated[Path, typer.Argument(help="Folder for the files; made if absent.")] = Path("aacmm-demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    as_json: Json = False,
) -> None:
    """Simulate the paper's arm with realistic noise, calibrate it, and compare with the truth."""
    from . import display
    from .demo import run

    summary = with_spinner("Simulating and calibrating", lambda: run(folder, seed))
    show_summary(summary, as_json, display.demo)


@app.command(epilog="Example: aacmm simulate cheng2018-simulation -o capture.h5 --socket A=400,200,300 --socket B=600,200,300 "
             "--poses 70 --length A,B,0.002 --encoder-arcsec 2 --seating-mm 0.005")  # fmt: skip
def simulate(
    arm: Annotated[str, typer.Argument(metavar="ARM", help="Nominal arm: a TOML file or a name that ships with the package.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Capture to write (HDF5).")],
    socket: Annotated[
        list[str] | None, typer.Option(metavar="NAME=X,Y,Z", help="A socket and its position in mm; repeatable.")
    ] = None,
    poses: Annotated[
        list[str] | None, typer.Option(metavar="N or NAME=N", help="Poses a socket; repeatable. Default 70.")
    ] = None,
    length: Annotated[
        list[str] | None, typer.Option(metavar="A,B[,U]", help="Reference length between two sockets, u in mm; repeatable.")
    ] = None,
    encoder_arcsec: Annotated[float, typer.Option(min=0, help="Standard deviation of a reading.")] = 0.0,
    resolution_arcsec: Annotated[float, typer.Option(min=0, help="Resolution of a reading.")] = 0.0,
    seating_mm: Annotated[float, typer.Option(min=0, help="Standard deviation, a coordinate, of the seat.")] = 0.0,
    true_arm: Annotated[str | None, typer.Option(help="Arm that makes the poses, where it is not the nominal one.")] = None,
    deviate_length_mm: Annotated[float, typer.Option(min=0, help="Draw the true arm: lengths off by up to this.")] = 0.0,
    deviate_angle_deg: Annotated[float, typer.Option(min=0, help="Draw the true arm: angles off by up to this.")] = 0.0,
    acceptance: Annotated[
        Literal["asme", "iso"] | None,
        typer.Option(
            help="Instead of sockets: the acceptance test that 'aacmm plan --acceptance' plans; artefacts with u = 1 um."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of poses and noise.")] = 0,
    as_json: Json = False,
) -> None:
    """Make a capture with a simulated arm."""
    from ..data.recording import Recording
    from ..data.simulation import simulate as run
    from ..files.arms import load_specification
    from ..files.captures import save_capture
    from ..kinematics.parameters import perturbed_arm
    from ..summaries.calibration import capture_summary
    from . import display

    nominal = load_specification(arm)
    true = load_specification(true_arm) if true_arm else nominal
    if deviate_length_mm or deviate_angle_deg:
        space = true.space()
        drawn = perturbed_arm(space, length=deviate_length_mm, angle=math.radians(deviate_angle_deg), seed=seed)
        true = true._replace(arm=drawn, name=f"{true.name}, deviated")
    if acceptance is not None:
        if socket or poses or length or resolution_arcsec:
            raise InputError("--acceptance brings its own sockets, poses and lengths; leave the options that give them out.")
        noise = {"encoder_arcsec": encoder_arcsec, "seating": seating_mm, "u_length": _U_ARTEFACT, "u_diameter": _U_ARTEFACT}

        def taken() -> Recording:
            from ..acceptance.procedure import plan_procedure, simulate_procedure

            return simulate_procedure(plan_procedure(nominal.arm, acceptance), nominal, true, **noise, seed=seed)

        recording = with_spinner("Simulating", taken)
        save_capture(output, recording)
        show_summary(capture_summary(recording) | {"written": str(output)}, as_json, display.capture)
        return
    points = dict(socket_option(text) for text in socket or ())
    if not points or len(points) < len(socket or ()):
        raise InputError(
            "a socket is named twice in --socket; give each its own name."
            if points
            else "give --socket NAME=X,Y,Z, or --acceptance."
        )
    capture = with_spinner(
        "Simulating",
        lambda: run(
            true.arm,
            points,
            poses=_poses_option(poses or ["70"], points),
            lengths=[length_option(text) for text in length or ()],
            encoder_arcsec=encoder_arcsec,
            resolution_arcsec=resolution_arcsec,
            seating=seating_mm,
            seed=seed,
        ),
    )
    recording = Recording(capture, nominal, true, seed)
    save_capture(output, recording)
    show_summary(capture_summary(recording) | {"written": str(output)}, as_json, display.capture)


@app.command(name="import", epilog="Example: aacmm import capture.toml -o capture.h5")
def import_(
    manifest: Annotated[
        Path, typer.Argument(metavar="MANIFEST.toml", help="Which files hold which socket, in which unit; and the lengths.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Capture to write (HDF5).")],
    as_json: Json = False,
) -> None:
    """Read recorded joint angles into a capture."""
    from ..files.captures import save_capture
    from ..files.manifest import read_manifest
    from ..summaries.calibration import capture_summary
    from . import display

    recording = read_manifest(manifest)
    save_capture(output, recording)
    show_summary(capture_summary(recording) | {"written": str(output)}, as_json, display.capture)


def _poses_option(texts: Sequence[str], sockets: dict[str, Any]) -> dict[str, int]:
    counts = dict.fromkeys(sockets, 70)
    for text in texts:
        name, equals, number = text.rpartition("=")
        if not number.isdecimal():
            bad_option("--poses", text, "N, or NAME=N for one socket")
        if not equals:
            counts = dict.fromkeys(counts, int(number))
        elif name not in counts:
            raise InputError(f"--poses {text} names the unknown socket '{name}'; known are {', '.join(counts)}.")
        else:
            counts[name] = int(number)
    return counts
