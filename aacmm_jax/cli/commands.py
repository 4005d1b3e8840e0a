"""The commands: what each takes, and which of the package's functions it calls. Units are in the options' names."""

import json
import math
import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import typer

from ..core.errors import IdentifiabilityWarning, InputError

_U_ARTEFACT = 0.001  # mm

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode="rich",
    help="Calibrate articulated-arm coordinate measuring machines and other serial arms.",
    epilog="Every command takes --help and, for a traceback when something fails, --debug. Start with: aacmm demo",
)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output, and nothing else there.")]
Only = Annotated[
    list[str] | None,
    typer.Option("--only", metavar="PATTERN", help="Use only the sockets that match (shell pattern); repeatable."),
]
Without = Annotated[
    list[str] | None, typer.Option("--without", metavar="PATTERN", help="Leave out the sockets that match; repeatable.")
]
CaptureFile = Annotated[Path, typer.Argument(metavar="CAPTURE.h5", help="Capture written by import or simulate.")]
CalibrationFile = Annotated[Path, typer.Argument(metavar="CALIBRATION.h5", help="Calibration written by calibrate.")]


def _version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        typer.echo(metadata.version("aacmm_jax"))
        raise typer.Exit()


@app.callback()
def prepare(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False,
) -> None:
    """Calibrate articulated-arm coordinate measuring machines and other serial arms."""
    # Compiled kernels are kept between runs; it more than halves the time of a short command.
    import jax

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(home / "aacmm_jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


@app.command(epilog="Example: aacmm demo my-demo --seed 7")
def demo(
    folder: Annotated[Path, typer.Argument(help="Folder for the files; made if absent.")] = Path("aacmm-demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    as_json: Json = False,
) -> None:
    """Simulate the paper's arm with realistic noise, calibrate it, and compare with the truth."""
    from . import display
    from .demo import run

    summary = _busy("Simulating and calibrating", lambda: run(folder, seed))
    _show(summary, as_json, display.demo)


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
    from ..data.simulation import deviated
    from ..data.simulation import simulate as run
    from ..files.arms import load_specification
    from ..files.captures import save_capture
    from ..kinematics.parameters import Parameters
    from ..summaries.calibration import capture_summary
    from . import display

    nominal = load_specification(arm)
    true = load_specification(true_arm) if true_arm else nominal
    if deviate_length_mm or deviate_angle_deg:
        space = Parameters.free_of(true.arm, held=true.held)
        drawn = deviated(space, length=deviate_length_mm, angle=math.radians(deviate_angle_deg), seed=seed)
        true = true._replace(arm=drawn, name=f"{true.name}, deviated")
    if acceptance is not None:
        if socket or poses or length or resolution_arcsec:
            raise InputError("--acceptance brings its own sockets, poses and lengths; leave the options that give them out.")
        noise = {"encoder_arcsec": encoder_arcsec, "seating": seating_mm, "u_length": _U_ARTEFACT, "u_diameter": _U_ARTEFACT}

        def taken() -> Recording:
            from ..acceptance.procedure import acceptance_procedure, record_procedure

            return record_procedure(acceptance_procedure(nominal.arm, acceptance), nominal, true, **noise, seed=seed)

        recording = _busy("Simulating", taken)
        save_capture(output, recording)
        _show(capture_summary(recording) | {"written": str(output)}, as_json, display.capture)
        return
    points = dict(_socket_option(text) for text in socket or ())
    if not points or len(points) < len(socket or ()):
        raise InputError(
            "a socket is named twice in --socket; give each its own name."
            if points
            else "give --socket NAME=X,Y,Z, or --acceptance."
        )
    capture = _busy(
        "Simulating",
        lambda: run(
            true.arm,
            points,
            poses=_poses_option(poses or ["70"], points),
            lengths=[_length_option(text) for text in length or ()],
            encoder_arcsec=encoder_arcsec,
            resolution_arcsec=resolution_arcsec,
            seating=seating_mm,
            seed=seed,
        ),
    )
    recording = Recording(capture, nominal, true, seed)
    save_capture(output, recording)
    _show(capture_summary(recording) | {"written": str(output)}, as_json, display.capture)


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
    _show(capture_summary(recording) | {"written": str(output)}, as_json, display.capture)


@app.command(epilog="Example: aacmm calibrate capture.h5 -o calibration.h5 --without 'test*' --method joint")
def calibrate(
    capture: CaptureFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration to write (HDF5).")],
    method: Annotated[
        Literal["two-stage", "joint"], typer.Option(help="Scale fix after stage 1, or one least squares of poses and lengths.")
    ] = "two-stage",
    hold: Annotated[
        str, typer.Option(help="Length held in stage 1: a name, 'longest', or 'none' to free all as the paper does.")
    ] = "longest",
    only: Only = None,
    without: Without = None,
    held: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Parameters that are not identified, with commas; replaces the arm's own list."),
    ] = None,
    free: Annotated[
        str | None, typer.Option(metavar="NAMES", help="Parameters to free besides, with commas (beta_2 for Hayati's angle).")
    ] = None,
    length_bound_mm: Annotated[float | None, typer.Option(min=0, help="Half-width of the bounds of lengths.")] = None,
    angle_bound_deg: Annotated[float | None, typer.Option(min=0, help="Half-width of the bounds of angles.")] = None,
    bound: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=WIDTH", help="Half-width of one parameter's bounds, mm or deg; repeatable."),
    ] = None,
    encoder_arcsec: Annotated[
        float | None, typer.Option(min=0, help="Known standard deviation of a reading: weighs poses. Default: estimated.")
    ] = None,
    seating_mm: Annotated[
        float | None, typer.Option(min=0, help="Known standard deviation, a coordinate, of the seat. Default: estimated.")
    ] = None,
    cross_validate: Annotated[
        bool | None,
        typer.Option(
            help="Leave out placements of the reference length one after the other. Default: yes, for a recorded capture of several."
        ),
    ] = None,
    monte_carlo: Annotated[
        bool, typer.Option("--monte-carlo", help="Check the uncertainties by Monte Carlo (JCGM 101); a minute or two.")
    ] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse parameters that such data could not determine even without noise.")
    ] = False,
    figure: Annotated[Path | None, typer.Option(help="Draw the residuals pose by pose as PNG.")] = None,
    max_steps: Annotated[int, typer.Option(min=1, help="Step limit of each solve.")] = 300,
    as_json: Json = False,
) -> None:
    """Identify the arm from repeatability, and fix its scale with the reference lengths."""
    from ..calibration.stages import calibrate as run
    from ..files.calibrations import record_of, save_calibration
    from ..files.captures import load_capture
    from ..files.storage import fingerprint
    from ..summaries.calibration import calibration_summary
    from ..summaries.warnings import plausible
    from . import display, options

    if output.exists() and output.samefile(capture):
        raise InputError(f"{output} is the capture itself; choose another output, so that held-out sockets are not lost.")
    recording = load_capture(capture)
    recording = recording._replace(
        capture=recording.capture.select(only or None, without or ()), sources=(fingerprint(capture), *recording.sources)
    )
    bounds = options.bounds(recording.nominal, held, free, length_bound_mm, angle_bound_deg, bound or [])
    recording = recording._replace(nominal=recording.nominal._replace(arm=bounds.space.base))
    solving = {
        "method": method,
        "hold": None if hold == "none" else hold,
        "noise": options.noise(encoder_arcsec, seating_mm),
    }
    capture_used = recording.capture
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IdentifiabilityWarning)  # the summary says it
        result = _busy(
            "Calibrating",
            lambda: run(bounds.space.base, capture_used, bounds, **solving, max_steps=max_steps, strict=strict),
        )
        record = record_of(result, recording)
        if cross_validate or (
            cross_validate is None and recording.true is None and _several(capture_used, len(bounds.space.names))
        ):
            from ..calibration.cross_validation import cross_validate as validated

            found = _busy("Cross-validating", lambda: validated(bounds.space.base, capture_used, bounds, **solving))
            record = record._replace(validation=found)
    if monte_carlo:
        from ..calibration.sampling import monte_carlo as sample

        sampled = _busy("Drawing trials", lambda: sample(result, capture_used))
        record = record._replace(sampled=sampled.table(), sampled_says=" ".join(sampled.sentences()))
    save_calibration(output, record)
    if figure is not None:
        from ..plot.calibration import calibration_figure

        calibration_figure(record, figure)
    _show(calibration_summary(record) | {"written": str(output)}, as_json, display.calibration)
    if not record.converged or not plausible(record.k):
        raise typer.Exit(1)


@app.command(epilog="Example: aacmm show calibration.h5")
def show(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="Capture, calibration, evaluation or study (HDF5), or an arm: TOML file or shipped name."
        ),
    ],
    cell: Annotated[int | None, typer.Option(min=1, help="Of a study: one cell in full.")] = None,
    figures: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Of a study: draw its figures as PNG.")] = None,
    as_json: Json = False,
) -> None:
    """Print what a file holds."""
    from ..files import storage
    from ..files.arms import load_specification
    from ..files.calibrations import load_calibration
    from ..files.captures import load_capture
    from ..summaries.calibration import arm_summary, calibration_summary, capture_summary
    from . import display

    if file.suffix in ("", ".toml") and not (file.is_file() and file.suffix == ""):
        _show(arm_summary(load_specification(str(file))), as_json, display.arm)
        return
    stored = storage.read_tables(file, ("capture", "calibration", "evaluation", "study"), without=("trials",))
    if stored.attributes["kind"] == "study":
        from .study_commands import show_study

        show_study(file, cell, figures, as_json)
        return
    if cell is not None or figures is not None:
        raise InputError(f"{file} holds a {stored.attributes['kind']}; --cell and --figures are for studies.")
    if stored.attributes["kind"] == "evaluation":
        from .result_commands import show_evaluation

        show_evaluation(file, stored.attributes.get("of") == "points", as_json)
    elif stored.attributes["kind"] == "capture":
        _show(capture_summary(load_capture(file)), as_json, display.capture)
    else:
        _show(calibration_summary(load_calibration(file)), as_json, display.calibration)


def _several(capture: Any, parameters: int) -> bool:
    """Whether the reference length stood in several placements, so that each can be left out."""
    if len(capture.lengths) < 2:
        return False
    from ..calibration.cross_validation import can_cross_validate

    return can_cross_validate(capture, parameters)


def _busy(what: str, work: Callable[[], Any]) -> Any:
    """Do work behind a spinner on standard error, where that is a terminal."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        return work()
    with console.status(f"{what} ..."):
        return work()


def _show(summary: dict[str, Any], as_json: bool, printed: Callable[[dict[str, Any]], None]) -> None:
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
    else:
        printed(summary)


def _socket_option(text: str) -> tuple[str, tuple[float, ...]]:
    name, _, point = text.partition("=")
    try:
        x, y, z = (float(part) for part in point.split(","))
    except ValueError:
        _bad("--socket", text, "NAME=X,Y,Z in mm, for example A=400,200,300")
    return name, (x, y, z)


def _poses_option(texts: Sequence[str], sockets: dict[str, Any]) -> dict[str, int]:
    counts = dict.fromkeys(sockets, 70)
    for text in texts:
        name, equals, number = text.rpartition("=")
        if not number.isdecimal():
            _bad("--poses", text, "N, or NAME=N for one socket")
        if not equals:
            counts = dict.fromkeys(counts, int(number))
        elif name not in counts:
            raise InputError(f"--poses {text} names the unknown socket '{name}'; known are {', '.join(counts)}.")
        else:
            counts[name] = int(number)
    return counts


def _length_option(text: str) -> tuple:
    parts = text.split(",")
    try:
        return (*parts[:2], *(float(u) for u in parts[2:])) if len(parts) in (2, 3) else _bad("--length", text, "A,B or A,B,U")
    except ValueError:
        _bad("--length", text, "A,B or A,B,U with u in mm")


def _bad(option: str, text: str, form: str) -> NoReturn:
    raise InputError(f"{option} '{text}' is not of the form {form}.")
