"""Commands that make captures: ``demo``, ``simulate``, ``import``."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import InputError
from ..core.text import number, quoted
from ..core.units import DEG
from ..core.x64 import LARGEST_INTEGER
from ..files.outputs import together
from .app import (
    KEPT,
    BaseLink,
    CaptureOutput,
    EncoderNoise,
    Json,
    LinearEncoderNoise,
    NominalArm,
    ReferenceLengths,
    SeatingNoise,
    TipLink,
    app,
    bad_option,
    examples,
    length_option,
    show_summary,
    sockets_option,
    with_spinner,
)

_U_ARTEFACT = 0.001  # mm
_DIGITS = 9


@app.command(epilog=examples("aacmm demo my-demo --seed 7"))
def demo(
    folder: Annotated[Path, typer.Argument(help="Folder for the files; made if it does not exist.")] = Path(
        "aacmm-demo"
    ),
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_INTEGER, metavar="N", help="Seed of the noise.")] = 0,
    as_json: Json = False,
) -> None:
    """Calibrate a simulated arm and compare it with the truth.

    The arm of Cheng et al. 2018, with realistic noise.
    """
    from . import calibration_display
    from .demo import run

    summary = with_spinner("Simulating and calibrating", lambda: run(folder, seed))
    show_summary(summary, as_json, calibration_display.demo)


@app.command(
    epilog=examples(
        "aacmm simulate cheng2018-simulation -o capture.h5 --poses 70 \\\n"
        "  --socket A=400,200,300 --socket B=600,200,300 --length A,B,0.002 \\\n"
        "  --encoder-arcsec 2 --seating-mm 0.005"
    )
)
def simulate(
    arm: NominalArm,
    output: CaptureOutput,
    socket: Annotated[
        list[str] | None, typer.Option(metavar="NAME=X,Y,Z", help="A socket and its position in mm; repeatable.")
    ] = None,
    poses: Annotated[
        list[str] | None,
        typer.Option(metavar="[NAME=]N", help="Poses in each socket, or in the named one; repeatable. Default 70."),
    ] = None,
    length: ReferenceLengths = None,
    encoder_arcsec: EncoderNoise = 0.0,
    resolution_arcsec: Annotated[
        float, typer.Option(min=0, metavar="ARCSEC", help="Resolution of a joint reading.")
    ] = 0.0,
    linear_encoder_mm: LinearEncoderNoise = None,
    linear_resolution_mm: Annotated[
        float, typer.Option(min=0, metavar="MM", help="Resolution of the readings of prismatic joints.")
    ] = 0.0,
    seating_mm: SeatingNoise = 0.0,
    temperature_c: Annotated[
        str | None,
        typer.Option(
            metavar="LOWEST[,HIGHEST]",
            help="Temperature of an arm with a thermometer, or limits to draw it between, C.",
        ),
    ] = None,
    true_arm: Annotated[
        str | None,
        typer.Option(metavar="ARM", help="The true arm, where it is not the nominal one: a TOML file or a name."),
    ] = None,
    deviate_length_mm: Annotated[
        float, typer.Option(min=0, metavar="MM", help="Draw the true arm: length parameters differ by up to this.")
    ] = 0.0,
    deviate_angle_deg: Annotated[
        float, typer.Option(min=0, metavar="DEG", help="Draw the true arm: angle parameters differ by up to this.")
    ] = 0.0,
    acceptance: Annotated[
        Literal["asme", "iso"] | None,
        typer.Option(
            help="Instead of sockets: the acceptance test that 'aacmm plan --acceptance' plans, by ASME B89.4.22 or "
            "ISO 10360-12; artefacts have u = 0.001 mm."
        ),
    ] = None,
    base: BaseLink = None,
    tip: TipLink = None,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_INTEGER, metavar="N", help="Seed of poses and noise.")] = 0,
    as_json: Json = False,
) -> None:
    """Make a capture with a simulated arm."""
    from ..data.noise import Noise
    from ..data.recording import Recording
    from ..data.simulation import simulate as run
    from ..files.arms import load_specification, usual_noise
    from ..files.captures import save_capture
    from ..kinematics.parameters import perturbed_arm
    from ..summaries.calibration import capture_summary
    from . import calibration_display

    with together(output):
        nominal = load_specification(arm, base=base, tip=tip)
        ends = (base, tip) if true_arm and true_arm.lower().endswith(".urdf") else (None, None)
        true = load_specification(true_arm, base=ends[0], tip=ends[1]) if true_arm else nominal
        if true.arm.joints != nominal.arm.joints:
            raise InputError(
                f"the true arm {true_arm} has {true.arm.joints} joints, but {arm} has {nominal.arm.joints}; "
                "choose a true arm with as many."
            )
        if deviate_length_mm or deviate_angle_deg:
            space = true.space()
            drawn = perturbed_arm(space, length=deviate_length_mm, angle=deviate_angle_deg * DEG, seed=seed)
            true = true._replace(arm=drawn, name=f"{true.name}, deviated")
        noise = Noise(encoder_arcsec=encoder_arcsec, seating=seating_mm, linear_encoder=linear_encoder_mm)
        if acceptance is not None:
            if socket or poses or length or resolution_arcsec or linear_resolution_mm or temperature_c:
                raise InputError(
                    "--acceptance brings its own sockets, poses and lengths, at 20 C; leave out --socket, --poses, "
                    "--length, --resolution-arcsec, --linear-resolution-mm and --temperature-c."
                )

            def taken() -> Recording:
                from ..acceptance.procedure import plan_procedure, simulate_procedure

                procedure, u = (
                    plan_procedure(nominal.arm, acceptance),
                    {"u_length": _U_ARTEFACT, "u_diameter": _U_ARTEFACT},
                )
                return simulate_procedure(procedure, nominal, true, noise=noise, **u, seed=seed)

            recording = with_spinner("Simulating", taken)
        else:
            points = sockets_option(socket)
            if not points:
                raise InputError("there is no socket; give --socket NAME=X,Y,Z, or --acceptance.")
            capture = with_spinner(
                "Simulating",
                lambda: run(
                    true.arm,
                    points,
                    poses=_poses_option(poses or ["70"], points),
                    lengths=[length_option(text) for text in length or ()],
                    noise=noise,
                    resolution_arcsec=resolution_arcsec,
                    linear_resolution=linear_resolution_mm,
                    temperature=None if temperature_c is None else _temperature_option(temperature_c),
                    seed=seed,
                ),
            )
            if temperature_c is not None:
                nominal = load_specification(arm, base=base, tip=tip, capture=capture)
            recording = Recording(capture, nominal, true, seed)
        recording = recording._replace(usual=usual_noise(arm, base=base, tip=tip))
        summary = capture_summary(recording)
        save_capture(output, recording, summary)
    show_summary(summary | {"written": str(output)}, as_json, calibration_display.capture)


@app.command(
    name="import", epilog=examples("aacmm import capture.toml -o capture.h5", "aacmm import capture.toml --check")
)
def import_(
    manifest: Annotated[
        Path,
        typer.Argument(
            metavar="MANIFEST.toml",
            help="Which files hold which poses and measured values, in which columns and units.",
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.h5", help="Capture to write (HDF5)." + KEPT)
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Compare the readings with the arm: order, signs, zeros and units of the columns; joints that stand "
            "still; commanded against measured readings where the tables have both. Exit code 1 where nothing fits.",
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Read recorded joint readings into a capture."""
    if output is None and not check:
        raise InputError("name the capture to write with -o FILE.h5, or look at the readings with --check.")
    from ..files.captures import save_capture
    from ..files.manifest import read_manifest
    from ..summaries.calibration import capture_summary
    from . import calibration_display

    with together(output):
        recording = read_manifest(manifest)
        summary = capture_summary(recording)
        if output is not None:
            save_capture(output, recording, summary)
    summary |= {} if output is None else {"written": str(output)}
    if not check:
        show_summary(summary, as_json, calibration_display.capture)
        return
    from .reading_checks import check_recording

    found = summary["check"] = check_recording(recording.nominal, recording, manifest)
    show_summary(summary, as_json, _checked)
    if not found["explained"]:
        raise typer.Exit(1)


def _checked(summary: dict[str, Any]) -> None:
    from . import arm_display, calibration_display

    calibration_display.capture(summary)
    typer.echo()
    arm_display.check(summary["check"])


def _temperature_option(text: str) -> float | list[float]:
    try:
        found = [number(part.strip()) for part in text.split(",")]
    except ValueError:
        bad_option("--temperature-c", text, "one number or two, LOWEST,HIGHEST in C")
    return found[0] if len(found) == 1 else found


def _poses_option(texts: Sequence[str], sockets: Iterable[str]) -> dict[str, int]:
    from ..data.simulation import MOST_POSES

    counts = dict.fromkeys(sockets, 70)
    for text in texts:
        name, equals, count = text.rpartition("=")
        if not (count.isascii() and count.isdecimal()):
            bad_option("--poses", text, "N, or NAME=N for one socket")
        if len(count) > _DIGITS or int(count) > MOST_POSES:
            raise InputError(f"--poses {quoted(text)} is more than {MOST_POSES:,} in one socket; give fewer.")
        if not equals:
            counts = dict.fromkeys(counts, int(count))
        elif name not in counts:
            raise InputError(f"--poses {text} names the unknown socket '{name}'; known are {', '.join(counts)}.")
        else:
            counts[name] = int(count)
    return counts
