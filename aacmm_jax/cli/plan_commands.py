"""The command ``plan``."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import InputError
from ..core.text import number
from ..core.units import DEG
from ..core.x64 import LARGEST_INTEGER
from ..files.outputs import together
from .app import (
    KEPT,
    BaseLink,
    Json,
    LinearEncoderNoise,
    NominalArm,
    ReferenceLengths,
    TipLink,
    app,
    examples,
    length_option,
    names_option,
    show_summary,
    sockets_option,
    with_spinner,
)
from .plan_options import (
    CONTEXT,
    CellFile,
    Collisions,
    ConeAngles,
    LinkRadius,
    Normals,
    PlanEncoderNoise,
    PlanSeatingNoise,
    RetractDistance,
    ToolAxis,
    check_options,
    planned_arm,
)


@app.command(
    epilog=examples(
        "aacmm plan my-arm.toml --sockets 4 --poses 30 -o plan.csv --manifest capture.toml",
        "aacmm plan my-arm.toml --acceptance iso -o acceptance.csv --manifest acceptance.toml",
        "aacmm plan my-arm.toml -o plan.csv --poses 25 \\\n"
        "  --socket A=400,200,300 --socket B=700,500,500 --length A,B,0.002",
        "aacmm plan my-arm.toml --kit kit.toml --poses 60 -o plan.csv --manifest capture.toml",
        "aacmm plan robot.urdf --tip tool0 -o plan.csv --poses 40 --cone-deg 55 --collisions --cell cell.toml",
        "aacmm plan panda -o plan.csv --poses 40 --cone-deg 55 --link-radius-mm 60 --angles rad --unconstrained",
    )
)
def plan(
    context: CONTEXT,  # pyright: ignore[reportInvalidTypeForm]
    arm: NominalArm,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE.csv",
            help="Plan to write: one row a pose, in the order to take them." + KEPT,
        ),
    ],
    poses: Annotated[
        int, typer.Option(min=2, max=10_000, metavar="N", help="Number of poses, all sockets together.")
    ] = 30,
    sockets: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1000,
            metavar="N",
            help="Number of sockets to position, in pairs at the ends of the reference length. Default 4.",
        ),
    ] = None,
    socket: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=X,Y,Z", help="Instead: a socket at a given position, mm; repeatable."),
    ] = None,
    length: ReferenceLengths = None,
    length_mm: Annotated[
        str, typer.Option(metavar="L[:M]", help="Reference length to position; of a range, the best length is chosen.")
    ] = "500",
    u_mm: Annotated[
        float, typer.Option(metavar="MM", help="Standard uncertainty of the reference length to position.")
    ] = 0.002,
    model: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL",
            help="What the joints do besides their readings, as for calibrate: the poses determine its coefficients "
            "too.",
        ),
    ] = None,
    held: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Parameters that are fixed, as for calibrate, separated by commas; replaces the list in the arm's "
            "file.",
        ),
    ] = None,
    encoder_arcsec: PlanEncoderNoise = None,
    linear_encoder_mm: LinearEncoderNoise = None,
    seating_mm: PlanSeatingNoise = None,
    cone_deg: ConeAngles = None,
    normal: Normals = None,
    tool_axis: ToolAxis = "z",
    retract_mm: RetractDistance = None,
    cell: CellFile = None,
    collisions: Collisions = False,
    link_radius_mm: LinkRadius = None,
    unconstrained: Annotated[
        bool, typer.Option("--unconstrained", help="Predict also without cones, obstacles and approach points.")
    ] = False,
    angles: Annotated[
        Literal["deg", "rad"], typer.Option(help="Unit of the joint readings in the plan and its manifest.")
    ] = "deg",
    criterion: Annotated[
        Literal["length", "A", "D", "E"],
        typer.Option(
            help="What is minimised: the largest uncertainty of a length in the volume, or A, D or E of the parameters."
        ),
    ] = "length",
    region: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AXIS=LOW:HIGH",
            help="Where sockets may be: range of x, y, z or distance from the base, mm; repeatable. Default z=0:.",
        ),
    ] = None,
    margin_deg: Annotated[
        float, typer.Option(min=0, metavar="DEG", help="Smallest distance of a joint from its limits.")
    ] = 5.0,
    above_mm: Annotated[
        float,
        typer.Option(metavar="MM", help="Height of the table in the base frame: every joint and tip stays above it."),
    ] = 0.0,
    candidates: Annotated[
        int, typer.Option(min=100, max=1_000_000, metavar="N", help="Number of poses to choose from.")
    ] = 3000,
    check_length_mm: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Length whose uncertainty is predicted all over the volume. Default 300, or half a small arm's reach.",
        ),
    ] = None,
    farthest: Annotated[
        float | None,
        typer.Option(
            metavar="PART",
            help="Largest distance of what is placed from the shoulder, part of the reach. Default 0.95.",
        ),
    ] = None,
    kit: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml",
            help="Instead of sockets: artefacts to place and instruments at hand, with their uncertainties.",
        ),
    ] = None,
    acceptance: Annotated[
        Literal["asme", "iso"] | None,
        typer.Option(help="Instead: the poses of an acceptance test, by ASME B89.4.22 or ISO 10360-12."),
    ] = None,
    sphere_mm: Annotated[
        float, typer.Option(metavar="MM", help="Of an acceptance test: diameter of the sphere.")
    ] = 25.0,
    stylus_mm: Annotated[
        float, typer.Option(min=0, metavar="MM", help="Of an acceptance test: diameter of the probe's ball.")
    ] = 6.0,
    bar_mm: Annotated[
        list[float] | None,
        typer.Option(
            metavar="MM",
            help="Of an acceptance test: length of a bar that is available; twice for asme, five times for iso.",
        ),
    ] = None,
    range_mm: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="MM",
            help="Of an acceptance test: measuring range that the maker states, a diameter. Default: twice the reach.",
        ),
    ] = None,
    manifest: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml", help="Manifest to write, for the import of the readings once they are recorded."
        ),
    ] = None,
    base: BaseLink = None,
    tip: TipLink = None,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_INTEGER, metavar="N", help="Seed of the random choices.")] = 0,
    as_json: Json = False,
) -> None:
    """Choose the poses to take, before measuring.

    For a calibration: poses, and positions of sockets and reference lengths. For an acceptance test: its poses.
    """
    from ..files.arms import load_specification
    from ..files.plans import kit_csv, kit_manifest, plan_csv, plan_manifest
    from ..planning.design import plan as run
    from ..summaries.planning import kit_plan_summary, plan_summary
    from . import acceptance_display, plan_display

    with together(output, manifest):  # refuses outputs that are inputs or cannot be written, before the work
        specification = load_specification(arm, base=base, tip=tip)
    if held is not None:
        fixed = names_option(held)
        specification = specification._replace(
            held=fixed, free=tuple(name for name in specification.free if name not in fixed)
        )
    if model is not None:
        from ..files.joint_models import with_model

        specification = with_model(specification, model)
    if socket and sockets is not None:
        raise InputError("--sockets has sockets positioned and --socket gives their positions; give one of the two.")
    if length and not socket:
        raise InputError(
            "--length is between sockets of --socket; to have a reference length positioned, use --length-mm."
        )
    check_options(context, kit is not None, acceptance is not None)
    if region and socket:
        raise InputError("--region is for sockets that are to be positioned; leave it out with --socket.")
    if acceptance is not None:
        options = {
            "above": above_mm,
            "margin": margin_deg * DEG,
            "diameter": sphere_mm,
            "stylus": stylus_mm,
            "seed": seed,
            "bars": bar_mm or None,
            "measuring_range": range_mm,
        }
        show_summary(
            _procedure(specification, arm, acceptance, output, manifest, options, angles),
            as_json,
            acceptance_display.procedure,
        )
        return
    axes = [_axis(text) for text in region or ()]
    if len(dict(axes)) < len(axes):
        raise InputError("an axis is named twice in --region; give each one range.")
    points = sockets_option(socket)
    shared: dict[str, Any] = {
        "poses": poses,
        "region": dict(axes) if axes else None,
        "farthest": 0.95 if farthest is None else farthest,
        "space": specification.space(),
        "criterion": criterion,
        "margin": margin_deg * DEG,
        "above": above_mm,
        "candidates": candidates,
        "check_length": check_length_mm,
        "unconstrained": unconstrained,
        "seed": seed,
    }
    names = list(points) or [chr(ord("A") + i) for i in range(4 if sockets is None else min(sockets, 26))]
    with together(output, manifest):
        assumed = planned_arm(
            arm, {"base": base, "tip": tip}, (encoder_arcsec, seating_mm, linear_encoder_mm), (cone_deg, normal),
            tool_axis, retract_mm, (cell, collisions, link_radius_mm), names,
        )  # fmt: skip
    shared |= assumed.options
    stated = {"noise_source": assumed.noise_source, "notes": list(assumed.notes), "angles": angles, "model": model}
    urdf = specification.urdf if _is_urdf(arm) else None
    if kit is not None:
        from ..files.kits import read_kit
        from ..planning.kit import plan_kit

        with together(output, manifest):
            things = read_kit(kit)
        with plan_display.progress() as report_progress:
            planned = plan_kit(specification.arm, things, **shared, progress=report_progress)
        text = kit_csv(planned, angles)
        written = _written(output, text, manifest, lambda name: kit_manifest(planned, name, urdf, angles), arm)
        summary = kit_plan_summary(planned, specification.name) | stated | {"written": written}
        show_summary(summary, as_json, plan_display.kit_plan)
        return
    with plan_display.progress() as report_progress:
        found = run(
            specification.arm,
            sockets=points or (4 if sockets is None else sockets),
            length=_range("--length-mm", length_mm),
            u=u_mm,
            lengths=[length_option(text) for text in length or ()],
            cone=assumed.cone,
            **shared,
            progress=report_progress,
        )
    text = plan_csv(found, angles)
    written = _written(output, text, manifest, lambda name: plan_manifest(found, name, urdf, angles), arm)
    summary: dict[str, Any] = plan_summary(found, specification.name) | stated | {"written": written}
    show_summary(summary, as_json, plan_display.plan)


def _procedure(
    specification: Any,
    arm: str,
    standard: Any,
    output: Path,
    manifest: Path | None,
    options: dict[str, Any],
    angles: Any,
) -> dict[str, Any]:
    """Plan an acceptance test and write it."""
    from ..acceptance.procedure import plan_procedure
    from ..files.plans import procedure_csv, procedure_manifest
    from ..summaries.planning import procedure_summary

    found = with_spinner("Planning", lambda: plan_procedure(specification.arm, standard, **options))
    urdf = specification.urdf if _is_urdf(arm) else None
    text = procedure_csv(found, angles)
    written = _written(output, text, manifest, lambda name: procedure_manifest(found, name, urdf, angles), arm)
    return procedure_summary(found, specification.name) | {"written": written}


def _is_urdf(arm: str) -> bool:
    """Whether a manifest names the links with the arm; an arm file (TOML) names those of its URDF itself."""
    return arm.lower().endswith(".urdf")


def _written(output: Path, poses: str, manifest: Path | None, manifest_text: Callable[[str], str], arm: str) -> str:
    """Write the poses and, where it is asked for, the manifest, which names the arm; returns what was written."""
    from ..files.outputs import write_text

    with together(output, manifest):
        write_text(output, poses)
        if manifest is None:
            return str(output)
        write_text(manifest, manifest_text(_arm_for(manifest, arm)))
        return f"{output}, {manifest}"


def _arm_for(manifest: Path, arm: str) -> str:
    """An arm as a manifest names it: a shipped name, or the path of a file, relative to the manifest if it can be."""
    if not os.path.isfile(arm):
        return arm
    try:
        return Path(os.path.relpath(arm, manifest.parent)).as_posix()
    except ValueError:  # on another drive
        return Path(arm).absolute().as_posix()


def _range(option: str, text: str) -> tuple[float, float]:
    low, colon, high = text.partition(":")
    try:
        return number(low.strip()), number((high if colon else low).strip())
    except ValueError as error:
        raise InputError(f"{option} '{text}' is not of the form L or L:M, in mm.") from error


def _axis(text: str) -> tuple[str, tuple[float, float]]:
    axis, _, values = text.partition("=")
    low, colon, high = values.partition(":")
    try:
        if not colon:
            raise ValueError
        return axis, (number(low.strip() or "-inf"), number(high.strip() or "inf"))
    except ValueError as error:
        raise InputError(f"--region '{text}' is not of the form AXIS=LOW:HIGH, in mm; for example z=0:800.") from error
