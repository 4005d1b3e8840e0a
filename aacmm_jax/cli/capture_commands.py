"""Commands that make captures: ``demo``, ``simulate``, ``import``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import typer

from .. import data, files, pipeline, summaries
from ..core.errors import InputError
from ..core.text import quoted
from ..core.units import DEG
from ..files.inputs import ROBOT_FILES, InputFile
from ..files.outputs import together
from . import options, views
from .app import command, progress_bar, read_with_progress, show_summary, tracked, with_spinner
from .arm_command import checked_recording, reading_check
from .options import argument, bad_option, flag, length_option, numbers_option, option, output, seed, sockets_option

_DIGITS = 9


@command("aacmm demo my-demo --seed 7")
def demo(
    folder: Path = typer.Argument(Path("aacmm-demo"), help="Folder for the files; created if it does not exist."),
    seed: int = seed("the noise"),
    as_json: bool = options.JSON,
) -> None:
    """Calibrate a simulated arm whose true errors are known.

    The simulated arm is that of Cheng et al. 2018, with realistic noise.
    """
    from .demo import run

    summary = with_spinner("Simulating and calibrating", lambda: run(folder, seed))
    show_summary(summary, as_json, views.demo)


@command(
    "aacmm simulate cheng2018-simulation -o capture.h5 --poses 70 \\\n"
    "  --socket A=400,200,300 --socket B=600,200,300 --length A,B,0.002 \\\n"
    "  --encoder-arcsec 2 --seating-mm 0.005",
    "aacmm simulate ur10e -o capture.h5 --kit camera-kit.toml --encoder-arcsec 20 --images rendered",
)
def simulate(
    arm: str = options.NOMINAL_ARM,
    output: Path = output("Capture to write (HDF5).", "FILE.h5"),
    socket: list[str] | None = option(
        "Simulate a socket at this position (mm); may be given several times.", "NAME=X,Y,Z"
    ),
    kit: Path | None = option(
        "Also simulate the artefacts and instruments of this kit (as for aacmm plan --kit), where it states them.",
        "KIT.toml",
    ),
    images: Path | None = option(
        "Also render the images that the cameras of the kit take, and write them to this folder with the joint "
        "readings and a manifest for aacmm import.",
        "FOLDER",
    ),
    blur_px: float | None = option("Blur of these images (standard deviation). Default: 0.8.", "PX", min=0),
    grey_noise: float | None = option(
        "Noise of these images (standard deviation, of 255 grey levels). Default: 2.", "LEVELS", min=0
    ),
    poses: list[str] | None = option(
        "Number of poses in each socket, or in the named socket; may be given several times. Default: 70.",
        "[NAME=]N",
    ),
    length: list[str] | None = options.REFERENCE_LENGTHS,
    encoder_arcsec: float = options.ENCODER_NOISE,
    resolution_arcsec: float = option("Round joint readings to multiples of this value.", default=0.0, min=0),
    linear_encoder_mm: float | None = options.LINEAR_ENCODER_NOISE,
    linear_resolution_mm: float = option(
        "Round readings of prismatic joints to multiples of this value.", default=0.0, min=0
    ),
    seating_mm: float = options.SEATING_NOISE,
    temperature_c: str | None = option(
        "Temperature (C), for an arm with a temperature sensor; if two values are given, random temperatures between "
        "them are simulated. Default: 20.",
        "LOWEST[,HIGHEST]",
    ),
    true_arm: str | None = option(
        "Simulate with this true arm: a TOML file, a URDF, or the name of an arm that ships with aacmm. Default: the "
        "nominal arm.",
        "ARM",
    ),
    deviate_length_mm: float = option(
        "Simulate with a random true arm whose lengths differ from the nominal lengths by at most this value.",
        default=0.0,
        min=0,
    ),
    deviate_angle_deg: float = option(
        "Simulate with a random true arm whose angles differ from the nominal angles by at most this value.",
        default=0.0,
        min=0,
    ),
    acceptance: Literal["jjf", "asme", "iso"] | None = option(
        "Simulate the acceptance test to JJF 1408, ASME B89.4.22 or ISO 10360-12 that 'aacmm plan --acceptance' plans, "
        "instead of poses in sockets; the artefacts have u = 0.001 mm."
    ),
    base: str | None = options.BASE_LINK,
    tip: list[str] | None = options.TIP_LINK,
    seed: int = seed("poses and noise"),
    as_json: bool = options.JSON,
) -> None:
    """Make a capture with a simulated arm."""
    from ..pipeline.capture_simulation import simulate_capture

    optics = {name: x for name, x in (("blur", blur_px), ("noise", grey_noise)) if x is not None}
    if images is None and optics:
        raise InputError("--blur-px and --grey-noise apply to images only; give --images FOLDER too.")
    with together(output):
        nominal, true = files.load_specification(arm, base=base, tip=tip), None
        if true_arm:
            true_base, true_tip = (base, tip) if true_arm.lower().endswith(ROBOT_FILES) else (None, None)
            true = files.load_specification(true_arm, base=true_base, tip=true_tip)
        points, form = sockets_option(socket), "T or LOWEST,HIGHEST, in C"
        warmth = None if temperature_c is None else numbers_option("--temperature-c", temperature_c, form)
        chosen = pipeline.SimulationOptions(
            true=true,
            deviate_length=deviate_length_mm,
            deviate_angle=deviate_angle_deg * DEG,
            lengths=[length_option(text) for text in length or ()],
            noise=data.Noise(encoder_arcsec=encoder_arcsec, seating=seating_mm, linear_encoder=linear_encoder_mm),
            resolution_arcsec=(resolution_arcsec, linear_resolution_mm),
            temperature=None if warmth is None else warmth[0] if len(warmth) == 1 else list(warmth),
            acceptance=acceptance,
            observations=[] if kit is None else _simulated(kit, images is not None),
            seed=seed,
        )
        chosen = chosen._replace(poses=_poses_option(poses, points, chosen.poses)) if poses else chosen
        recording = with_spinner("Simulating", lambda: simulate_capture(nominal, points, **chosen._asdict()))
        if temperature_c is not None:
            nominal = files.load_specification(arm, base=base, tip=tip, capture=recording.capture)
        recording = recording._replace(nominal=nominal, usual=files.usual_noise(arm, base=base, tip=tip))
        if images is not None:
            recording = _with_images(images, recording, kit, arm, optics)
        summary = summaries.calibration.capture_summary(recording)
        files.save_capture(output, recording, summary)
    written = str(output) if images is None else f"{output}, {images}"
    show_summary(summary | {"written": written}, as_json, views.capture)


def _simulated(kit: Path, true_views: bool) -> list[Any]:
    """What a kit simulates; its cameras with the true views, by which images are rendered."""
    items = [item.simulated for item in files.read_kit(kit)]
    return [item.changed(true_views=true_views) if item.table == "pixels" else item for item in items]


def _with_images(folder: Path, recording: Any, kit: Path | None, arm: str, optics: dict[str, float]) -> Any:
    """Render images into a folder; the recording without what only a simulation knows."""
    from ..camera.rendering import Optics
    from ..files.rendered_images import MANIFEST, save_images
    from .plan_commands import arm_for

    if kit is None:
        raise InputError("--images needs a kit with a camera; give --kit FILE.")
    urdf = recording.nominal.urdf if arm.lower().endswith(ROBOT_FILES) else None
    entries = {"arm": arm_for(folder / MANIFEST, arm)} | ({} if urdf is None else urdf.links)
    with progress_bar(transient=True) as bar:
        return save_images(folder, recording, kit, entries, Optics(**optics), progress=tracked(bar))


def _poses_option(texts: Sequence[str], sockets: dict[str, Any], usual: Any) -> dict[str, Any]:
    """Poses by socket, from ``N`` and ``NAME=N``; ``usual`` where none are given. Without sockets, none."""
    counts: dict[str, Any] = dict.fromkeys(sockets, usual)
    for text in texts if sockets else ():
        name, equals, count = text.rpartition("=")
        if not (count.isascii() and count.isdecimal() and len(count) < _DIGITS):
            bad_option("--poses", quoted(text)[1:-1], "N, or NAME=N for one socket")
        if not equals:
            counts = dict.fromkeys(counts, int(count))
        elif name not in counts:
            raise InputError(f"--poses {text} names the unknown socket '{name}'; the sockets are {', '.join(counts)}.")
        else:
            counts[name] = int(count)
    return counts


@command("aacmm import capture.toml -o capture.h5", "aacmm import capture.toml --check", name="import")
def import_(
    manifest: Path = argument(
        "Manifest (TOML) that names the files with the poses and measured values, and states their columns and units.",
        "MANIFEST.toml",
    ),
    output: Path | None = output("Capture to write (HDF5).", "FILE.h5", None),
    check: bool = flag(
        "--check",
        "Check the readings against the arm: find the order, signs, zero offsets and units of the columns, and the "
        "joints that do not move, joints that turn with another joint, and the convention of measured rotations, which "
        "need not be stated then. If the tables contain both commanded and measured readings, or positions and "
        "deviations from them, compare them. Exit with code 1 if no order, signs, zero offsets and units make the "
        "readings fit the arm.",
    ),
    overlays: Path | None = option(
        "Write a picture of each image to this folder, with the corners that were found in it.", "FOLDER"
    ),
    as_json: bool = options.JSON,
) -> None:
    """Read recorded joint readings into a capture."""
    if output is None and not check:
        raise InputError(
            "no output file is given; give -o FILE.h5 to write a capture, or --check to check the readings only."
        )
    with together(output):
        written = []
        if check and output is None and "[[transforms]]" in InputFile(manifest).text:
            from ..files.manifest import written_rotations

            recording, written = written_rotations(manifest)
        else:
            recording = read_with_progress(manifest, overlays)
        summary = summaries.calibration.capture_summary(recording)
        if output is not None:
            files.save_capture(output, recording, summary)
            summary["written"] = str(output)
    if not check:
        show_summary(summary, as_json, views.capture)
        return
    summary["check"] = checked = checked_recording(recording.nominal, recording, manifest, written)
    if checked["angles"] and not (checked["found"] or checked["given"])["readings_outside_limits"]:
        from ..diagnostics.findings import sentences
        from ..diagnostics.recorded import outside_limits

        explained = sentences(outside_limits(recording))
        summary["warnings"] = [text for text in summary["warnings"] if text not in explained]
    show_summary(summary, as_json, lambda s: (*views.capture(s), "", *reading_check(s["check"])))
    if not summary["check"]["explained"]:
        raise typer.Exit(1)
