"""The command ``plan``."""

import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import InputError
from .app import Json, app, length_option, show_summary, socket_option, with_spinner


@app.command(epilog="Examples: aacmm plan my-arm.toml --sockets 4 --poses 30 -o plan.csv; "
             "aacmm plan my-arm.toml --acceptance iso -o acceptance.csv --manifest acceptance.toml; "
             "aacmm plan my-arm.toml --socket A=400,200,300 --socket B=700,500,500 --length A,B,0.002 --poses 25 -o plan.csv")  # fmt: skip
def plan(
    arm: Annotated[str, typer.Argument(metavar="ARM", help="Arm: a TOML file or a name that ships with the package.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Plan to write (CSV): a pose a row, angles in degrees.")],
    poses: Annotated[int, typer.Option(min=2, help="Poses in all sockets together.")] = 30,
    sockets: Annotated[
        int | None, typer.Option(min=1, help="Sockets to place, two by two as ends of the reference length. Default 4.")
    ] = None,
    socket: Annotated[
        list[str] | None, typer.Option(metavar="NAME=X,Y,Z", help="Instead: a socket that stands there, mm; repeatable.")
    ] = None,
    length: Annotated[
        list[str] | None,
        typer.Option(metavar="A,B[,U]", help="Reference length between two such sockets, u in mm; repeatable."),
    ] = None,
    length_mm: Annotated[
        str, typer.Option(metavar="L or L:M", help="The reference length to place; a range lets its length be chosen.")
    ] = "500",
    u_mm: Annotated[float, typer.Option(help="Standard uncertainty of the reference length.")] = 0.002,
    encoder_arcsec: Annotated[float, typer.Option(min=0, help="Standard deviation of a reading.")] = 2.0,
    seating_mm: Annotated[float, typer.Option(min=0, help="Standard deviation, a coordinate, of the seat.")] = 0.005,
    criterion: Annotated[
        Literal["length", "A", "D", "E"],
        typer.Option(help="Largest uncertainty of a length over the volume, or A, D, E of the parameters."),
    ] = "length",
    region: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AXIS=LOW:HIGH", help="Where sockets may stand: x, y, z or distance, mm; repeatable. Default z=0:."
        ),
    ] = None,
    margin_deg: Annotated[float, typer.Option(min=0, help="How far from their limits joints stay.")] = 5.0,
    above_mm: Annotated[
        float, typer.Option(help="Height, in the base frame, below which no joint and no tip comes: the table.")
    ] = 0.0,
    candidates: Annotated[int, typer.Option(min=100, help="Poses to choose from.")] = 3000,
    check_length_mm: Annotated[
        float | None, typer.Option(help="Lengths that predictions are of. Default 300, or half of a small arm's reach.")
    ] = None,
    acceptance: Annotated[
        Literal["asme", "iso"] | None,
        typer.Option(help="Instead: the poses of an acceptance test, ASME B89.4.22 or ISO 10360-12."),
    ] = None,
    sphere_mm: Annotated[float, typer.Option(help="Of an acceptance test: diameter of the sphere.")] = 25.0,
    stylus_mm: Annotated[float, typer.Option(min=0, help="Of an acceptance test: diameter of the probe's ball.")] = 6.0,
    bar_mm: Annotated[
        list[float] | None,
        typer.Option(help="Of an acceptance test: length of a bar at hand; twice for asme, five times for iso."),
    ] = None,
    manifest: Annotated[
        Path | None, typer.Option(help="Of an acceptance test: write the manifest (TOML) that its readings are imported with.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed.")] = 0,
    as_json: Json = False,
) -> None:
    """Choose poses, sockets and the place of the reference length before the arm is touched; or the poses of an acceptance test."""
    from ..data.noise import Noise
    from ..files.arms import load_specification
    from ..files.plans import save_plan
    from ..kinematics.parameters import Parameters
    from ..planning.design import plan as run
    from ..summaries.planning import plan_summary
    from . import acceptance_display, plan_display

    specification = load_specification(arm)
    if socket and sockets is not None:
        raise InputError("--sockets places sockets and --socket says where they stand; give one of the two.")
    if length and not socket:
        raise InputError("--length is between sockets that stand (--socket); to place a reference length, use --length-mm.")
    if region and socket:
        raise InputError("--region is for sockets that are placed; with --socket they stand where you say.")
    if acceptance is not None:
        if socket or sockets is not None or length or region:
            raise InputError(
                "--acceptance places its own sockets and bars; leave --socket, --sockets, --length and --region out."
            )
        _check_output(output, arm)
        room = {
            "above": above_mm,
            "margin": math.radians(margin_deg),
            "diameter": sphere_mm,
            "stylus": stylus_mm,
            "seed": seed,
            "bars": bar_mm or None,
        }
        show_summary(_procedure(specification, arm, acceptance, output, manifest, room), as_json, acceptance_display.procedure)
        return
    if manifest is not None:
        raise InputError("--manifest goes with --acceptance; a plan for a calibration is in its CSV whole.")
    axes = [_axis(text) for text in region or ()]
    if len(dict(axes)) < len(axes):
        raise InputError("an axis is named twice in --region; give each one range.")
    _check_output(output, arm)
    points = dict(socket_option(text) for text in socket or ())
    if len(points) < len(socket or ()):
        raise InputError("a socket is named twice in --socket; give each its own name.")
    with plan_display.progress() as tell:
        found = run(
            specification.arm,
            sockets=points or (4 if sockets is None else sockets),
            poses=poses,
            length=_range("--length-mm", length_mm),
            u=u_mm,
            lengths=[length_option(text) for text in length or ()],
            region=dict(axes) if axes else None,
            space=Parameters.free_of(specification.arm, held=specification.held),
            noise=Noise(encoder_arcsec=encoder_arcsec, seating=seating_mm),
            criterion=criterion,
            margin=math.radians(margin_deg),
            above=above_mm,
            candidates=candidates,
            check_length=check_length_mm,
            seed=seed,
            tell=tell,
        )
    save_plan(output, found)
    summary: dict[str, Any] = plan_summary(found, specification.name) | {"written": str(output)}
    show_summary(summary, as_json, plan_display.plan)


def _procedure(
    specification: Any, arm: str, standard: Any, output: Path, manifest: Path | None, room: dict[str, Any]
) -> dict[str, Any]:
    """Plan an acceptance test and write it."""
    from ..acceptance.procedure import plan_procedure
    from ..files.plans import procedure_csv, procedure_manifest
    from ..files.whole_file import write_text
    from ..summaries.procedure import procedure_summary

    if manifest is not None:
        _check_output(manifest, arm)
        if manifest.resolve() == output.resolve():
            raise InputError(f"{output} is given for the plan and for the manifest; choose another for one of them.")
    found = with_spinner("Planning", lambda: plan_procedure(specification.arm, standard, **room))
    write_text(output, procedure_csv(found))
    written = str(output)
    if manifest is not None:
        write_text(manifest, procedure_manifest(found, _arm_beside(manifest, arm)))
        written += f", {manifest}"
    return procedure_summary(found, specification.name) | {"written": written}


def _arm_beside(manifest: Path, arm: str) -> str:
    """An arm as a manifest names it: a shipped name as it is, a file from the manifest's folder."""
    file = Path(arm)
    return Path(os.path.relpath(file, manifest.parent)).as_posix() if file.is_file() else arm


def _check_output(output: Path, arm: str) -> None:
    """Raise `InputError` for an output that could not be written, before half a minute of work."""
    if output.exists() and Path(arm).exists() and output.samefile(arm):
        raise InputError(f"{output} is the arm itself; choose another output.")
    folder = output.parent
    if output.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InputError(
            f"{output} cannot be written: it is a folder, or its folder is missing or protected; name another file."
        )


def _range(option: str, text: str) -> tuple[float, float]:
    low, colon, high = text.partition(":")
    try:
        return float(low), float(high if colon else low)
    except ValueError as error:
        raise InputError(f"{option} '{text}' is not of the form L or L:M, in mm.") from error


def _axis(text: str) -> tuple[str, tuple[float, float]]:
    axis, _, values = text.partition("=")
    low, colon, high = values.partition(":")
    try:
        if not colon:
            raise ValueError
        return axis, (float(low or -math.inf), float(high or math.inf))
    except ValueError as error:
        raise InputError(f"--region '{text}' is not of the form AXIS=LOW:HIGH, in mm; for example z=0:800.") from error
