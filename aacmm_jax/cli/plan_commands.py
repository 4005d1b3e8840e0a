"""The command ``plan``."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import typer

from .. import acceptance as acceptance_tests
from .. import files, kinematics, planning, summaries
from ..core.errors import InputError
from ..core.text import listed, number
from ..core.units import DEG
from ..files.inputs import ROBOT_FILES, fingerprint
from ..files.outputs import together, write_text
from ..planning.usual import FARTHEST, HEIGHTS, TILT_DEG
from . import options
from .app import command, progress_bar, show_summary, with_spinner
from .options import bad_option, flag, option, output, seed

_CONTEXT: Any = typer.Context.__base__  # what Typer passes: its own class is a subclass that nothing is of
_SOCKETS = 4
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_AXES |= {f"-{name}": (0.0 - x, 0.0 - y, 0.0 - z) for name, (x, y, z) in _AXES.items()}

# Options that each way of planning takes besides those of all: of a calibration with sockets, of one with a kit, and
# of an acceptance test.
_OF_CHAINS = {"chain", "rest"}
_OF_ALL = {"arm", "output", "manifest", "page", "base", "tip", "seed", "as_json", "angles", "margin_deg", "above_mm"}
_OF_CALIBRATIONS = {
    *("poses", "model", "held", "encoder_arcsec", "linear_encoder_mm", "seating_mm", "tool_axis", "retract_mm", "cell"),
    *("collisions", "link_radius_mm", "unconstrained", "criterion", "region", "candidates", "check_length_mm"),
    *("farthest", "both_sides", *_OF_CHAINS),
}
_OF_SOCKETS = {"sockets", "socket", "length", "length_mm", "u_mm", "cone_deg", "normal"}
_OF_ACCEPTANCE = {"acceptance", "sphere_mm", "stylus_mm", "bar_mm", "range_mm"}


@command(
    "aacmm plan my-arm.toml --sockets 4 --poses 30 -o plan.csv --manifest capture.toml --page plan.html",
    "aacmm plan my-arm.toml --acceptance iso -o acceptance.csv --manifest acceptance.toml",
    "aacmm plan my-arm.toml -o plan.csv --poses 25 \\\n"
    "  --socket A=400,200,300 --socket B=700,500,500 --length A,B,0.002",
    "aacmm plan my-arm.toml --kit kit.toml --poses 60 -o plan.csv --manifest capture.toml",
    "aacmm plan robot.urdf --tip tool0 -o plan.csv --poses 40 --cone-deg 55 --collisions --cell cell.toml",
    "aacmm plan panda -o plan.csv --poses 40 --cone-deg 55 --link-radius-mm 60 --angles rad --unconstrained",
)
def plan(
    context: _CONTEXT,  # pyright: ignore[reportInvalidTypeForm]
    arm: str = options.NOMINAL_ARM,
    output: Path = output(
        "File to write the plan to: one row per pose, in the order in which the poses are to be recorded.", "FILE.csv"
    ),
    poses: int = option("Total number of poses.", "N", default=30, min=2, max=10_000),
    sockets: int | None = option(
        "Number of sockets to plan; the sockets are placed in pairs, at the ends of the reference length. Default: "
        f"{_SOCKETS}.",
        "N",
        min=1,
        max=1000,
    ),
    socket: list[str] | None = option(
        "Use a socket at this position (mm) instead of planning its position; may be given several times.", "NAME=X,Y,Z"
    ),
    length: list[str] | None = options.REFERENCE_LENGTHS,
    length_mm: str = option(
        "Value (mm) of the reference length to plan for; if a range is given, the best value in the range is chosen.",
        "L[:M]",
        default="500",
    ),
    u_mm: float = option("Standard uncertainty of the reference length given with --length-mm.", default=0.002),
    model: str | None = option(
        "Model of non-geometric joint errors, as for calibrate --model. The poses are chosen to determine its "
        "coefficients too.",
        "MODEL",
    ),
    held: str | None = option(
        "Hold these parameters at their nominal values, as for calibrate --held (names separated by commas). Default: "
        "the list in the arm file.",
        "NAMES",
    ),
    encoder_arcsec: float | None = options.USUAL_ENCODER_NOISE,
    linear_encoder_mm: float | None = options.LINEAR_ENCODER_NOISE,
    seating_mm: float | None = options.USUAL_SEATING_NOISE,
    cone_deg: list[str] | None = option(
        "Largest angle between the tool and the normal of the socket, for all sockets or for the named socket; 180 "
        f"allows any direction. The option may be given several times. Default: {TILT_DEG:g}. With --kit, "
        "set half_angle_deg in the tables of the kit instead.",
        "[NAME=]DEG",
    ),
    normal: list[str] | None = option(
        "Outward normal of all sockets, or of the named socket; may be given several times. Default: 0,0,1.",
        "[NAME=]X,Y,Z",
    ),
    tool_axis: str | None = option(
        "Axis of the last frame along which the tool points into a socket: x, y, z, -x, -y or -z. Default: z for "
        "robots, the axis nearest to the probe vector for measuring arms.",
        "AXIS",
    ),
    retract_mm: float | None = option(
        "Add an approach point to each pose, at this distance from the socket along its normal; 0 adds none. Default: "
        "50 for robots, 0 for measuring arms.",
        min=0,
    ),
    cell: Path | None = option("Keep the arm clear of the boxes, walls and posts in this file.", "FILE.toml"),
    collisions: bool = flag(
        "--collisions",
        "Keep the arm's body (collision shapes of its URDF, otherwise capsules along its links) clear of the table "
        "and of itself. Implied by --cell and --link-radius-mm.",
    ),
    link_radius_mm: float | None = option("Use capsules of this radius along the links as the arm's body.", min=0),
    unconstrained: bool = flag(
        "--unconstrained",
        "Also predict the uncertainty of a plan without obstacles, approach points, and limits of the tool direction "
        "(--cone-deg) and of the heights of planned sockets (--region).",
    ),
    chain: list[str] | None = option(
        "Plan poses for this chain of a robot; may be given several times. Default: all chains.", "NAME"
    ),
    rest: str | None = option(
        "Readings of all joints of a robot (unit of --angles, mm for prismatic joints) that the joints of the other "
        "chains hold while a chain takes a pose. Default: 0, or the middle of limits that exclude 0.",
        "Q1,Q2,...",
    ),
    angles: Literal["deg", "rad"] = option("Unit of the joint readings in the plan and its manifest.", default="deg"),
    criterion: Literal["length", "A", "D", "E"] = option(
        "Criterion to minimise. length: the largest uncertainty of a length in the volume; A, D or E: the criterion "
        "of optimal design with this name, for the parameters.",
        default="length",
    ),
    region: list[str] | None = option(
        "Place sockets only where x, y, z or the distance from the base is in this range (mm); may be given several "
        f"times. Default: z from {HEIGHTS[0]:g} to {HEIGHTS[1]:g} mm above the table (--above-mm).",
        "AXIS=LOW:HIGH",
    ),
    margin_deg: float = option("Keep joints at least this far from their limits.", default=5.0, min=0),
    above_mm: float = option(
        "Height of the table in the base frame: all joints and the tip must stay above this height.", default=0.0
    ),
    candidates: int = option(
        "Number of candidate poses from which the plan is chosen.", "N", default=3000, min=100, max=1_000_000
    ),
    check_length_mm: float | None = option(
        "Predict the uncertainty of lengths of this size throughout the working volume. Default: 300, or half the "
        "total link length if that is shorter."
    ),
    farthest: float | None = option(
        f"Place nothing farther from the shoulder than this fraction of the reach. Default: {FARTHEST}.", "FRACTION"
    ),
    both_sides: bool = flag(
        "--both-sides",
        "Take every pose twice, with each joint moved to it from one side and then from the other, to find backlash "
        "(--kit with instruments or cameras that leave the tip free). Copy the columns direction_1, ... to the "
        "readings.",
    ),
    kit: Path | None = option(
        "Plan for the artefacts and instruments in this file, with their uncertainties, instead of sockets.",
        "FILE.toml",
    ),
    acceptance: Literal["jjf", "asme", "iso"] | None = option(
        "Plan the poses of an acceptance test to JJF 1408, ASME B89.4.22 or ISO 10360-12 instead of those of a "
        "calibration."
    ),
    sphere_mm: float = option("Diameter of the sphere of an acceptance test.", default=25.0),
    stylus_mm: float = option("Diameter of the probe's ball in an acceptance test.", default=6.0, min=0),
    bar_mm: list[float] | None = option(
        "Length of an available bar for an acceptance test; give the option once for jjf, twice for asme, five times "
        "for iso."
    ),
    range_mm: float | None = option(
        "Measuring range (a diameter) stated by the maker, for an acceptance test. Default: twice the reach.",
        min=0,
    ),
    manifest: Path | None = option(
        "Write a manifest to this file; aacmm import reads the recorded readings with it.", "FILE.toml"
    ),
    page: Path | None = option(
        "Write a page to take to the machine: a picture, the set-up, and the poses with a box to tick each (HTML).",
        "FILE.html",
    ),
    base: str | None = options.BASE_LINK,
    tip: list[str] | None = options.TIP_LINK,
    seed: int = seed("the random choices"),
    as_json: bool = options.JSON,
) -> None:
    """Plan the poses of a measurement.

    For a calibration, the command plans the poses and the positions of sockets and reference lengths. For an acceptance
    test, it plans the poses and the positions of the artefacts.
    """
    from ..files.arm_tables import with_model
    from ..files.kits import target_tables
    from ..files.plans import plan_csv, plan_manifest

    given = dict(locals())  # all options by name
    words, links = summaries.planning, {"base": base, "tip": tip}
    with together(output, manifest, page):  # refuses outputs that are inputs or cannot be written, before the work
        specification = files.load_specification(arm, base=base, tip=tip)
        if held is not None:
            fixed = options.names_option(held)
            others = tuple(name for name in specification.free if name not in fixed)
            specification = specification._replace(held=fixed, free=others)
        specification = specification if model is None else with_model(specification, model)
    _check_options(context, kit is not None, acceptance is not None)
    planned: Any
    if acceptance is not None:
        planned = with_spinner("Planning", lambda: acceptance_tests.plan_procedure(
            specification.arm, acceptance, above=above_mm, margin=margin_deg * DEG, diameter=sphere_mm,
            stylus=stylus_mm, seed=seed, bars=bar_mm or None, measuring_range=range_mm,
        ))  # fmt: skip
        summarise, view, stated = words.procedure_summary, words.procedure, {}
    else:
        planned, stated = _planned(specification, given, links)
        summarise, view = (words.plan_summary, words.plan) if kit is None else (words.kit_plan_summary, words.kit_plan)
    summary = summarise(planned, specification.name) | stated
    with together(output, manifest, page):
        write_text(output, plan_csv(planned, angles, both_sides))
        if manifest is not None:
            # A manifest names the links with the arm; an arm file (TOML) names those of its URDF itself.
            urdf = specification.urdf if arm.lower().endswith(ROBOT_FILES) else None
            targets = () if kit is None else target_tables(kit)
            write_text(manifest, plan_manifest(planned, arm_for(manifest, arm), urdf, angles, targets))
        if page is not None:
            from ..report import write_plan

            sources = [fingerprint(arm)] if os.path.isfile(arm) else [f"{arm} (ships with aacmm)"]
            sources += [] if kit is None else [fingerprint(kit)]
            shown = {"angles": angles, "both_sides": both_sides, "sources": sources}
            write_plan(page, planned, summary=summary, **shown)
    written = ", ".join(str(path) for path in (output, manifest, page) if path is not None)
    show_summary(summary | {"written": written}, as_json, view)


def _check_options(context: Any, kit: bool, acceptance: bool) -> None:
    """Refuse options that the way of planning would ignore."""
    taken = _OF_ALL | (_OF_ACCEPTANCE if acceptance else _OF_CALIBRATIONS | ({"kit"} if kit else _OF_SOCKETS))
    sources = {name: context.get_parameter_source(name) for name in context.params if name not in taken}
    ignored = [
        f"--{name.replace('_', '-')}" for name, source in sources.items() if source and source.name == "COMMANDLINE"
    ]
    if not ignored:
        return
    names = listed(ignored)
    if acceptance:
        raise InputError(
            f"--acceptance itself determines the poses, sockets and bars, so {names} would have no effect; leave out "
            f"{names}."
        )
    if kit:
        raise InputError(
            f"--kit itself determines the artefacts and their placement, so {names} would have no effect; leave out "
            f"{names}."
        )
    raise InputError(
        f"{names} {'applies' if len(ignored) == 1 else 'apply'} to acceptance tests only; give --acceptance too."
    )


def _planned(specification: Any, given: Mapping[str, Any], links: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The plan of a calibration as options say (``given``, by name), and what its summary states of its assumptions;
    what is not given follows from the class of the arm."""
    if given["socket"] and given["sockets"] is not None:
        raise InputError(
            "--sockets plans the positions of the sockets, but --socket states them; give only one of these options."
        )
    if given["length"] and not given["socket"]:
        raise InputError(
            "--length needs two sockets given with --socket; to plan the position of a reference length, use "
            "--length-mm."
        )
    if given["region"] and given["socket"]:
        raise InputError(
            "--region applies only if the positions of the sockets are planned; leave out either --region or --socket."
        )
    points, count = options.sockets_option(given["socket"]), given["sockets"] or _SOCKETS
    names = list(points) or [chr(ord("A") + i) for i in range(min(count, 26))]
    cell, radius = given["cell"], given["link_radius_mm"]
    with together(given["output"], given["manifest"]):
        things = None if given["kit"] is None else files.read_kit(given["kit"])
        noise = options.assumed_noise(
            given["arm"], links, given["encoder_arcsec"], given["seating_mm"], given["linear_encoder_mm"]
        )
        to_check = given["collisions"] or cell is not None or radius is not None
        loaded = files.load_cell(given["arm"], cell, **links, radius=radius) if to_check else None
        axis = given["tool_axis"] or (_probe_axis(specification.arm) if noise.arm_class == "measuring arm" else "z")
        if axis not in _AXES:
            bad_option("--tool-axis", axis, "x, y, z, -x, -y or -z")
        cones = _cones(given, names)
    usual = planning.PlanOptions.usual(noise)
    chosen = usual._replace(
        tool_axis=_AXES[axis],
        cell=None if loaded is None else loaded.cell,
        retract=usual.retract if given["retract_mm"] is None else given["retract_mm"],
        space=specification.space(),
        region=_region(given["region"]),
        farthest=FARTHEST if given["farthest"] is None else given["farthest"],
        margin=given["margin_deg"] * DEG,
        above=given["above_mm"],
        check_length=given["check_length_mm"],
        hold_undetermined=given["held"] is None,
        chains=tuple(given["chain"] or ()),
        rest=_rest(given["rest"], specification.arm, given["angles"]),
        **{name: given[name] for name in ("criterion", "unconstrained", "candidates", "seed")},
    )
    stated = {"noise_source": noise.source, "notes": [] if loaded is None else list(loaded.notes)}
    stated |= {"angles": given["angles"], "model": given["model"], "tool_axis": axis}
    with progress_bar(transient=True) as bar:
        tasks: dict[str, Any] = {}

        def progress(stage: str, fraction: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=1.0)
            bar.update(tasks[stage], completed=fraction)

        settings = {"poses": given["poses"], **chosen._replace(progress=None if bar is None else progress)._asdict()}
        if things is not None:
            return planning.plan_kit(specification.arm, things, **settings), stated
        placed = {"sockets": points or count, "length": _range(given["length_mm"]), "u": given["u_mm"]}
        placed |= {"lengths": [options.length_option(text) for text in given["length"] or ()], "cone": cones}
        return planning.plan(specification.arm, **placed, **settings), stated


def _probe_axis(arm: Any) -> str:
    """The axis of the last frame that is nearest to the probe vector; z where that is 0."""
    x, y, z = (float(value) for value in arm.probe)
    value, axis = max(((z, "z"), (x, "x"), (y, "y")), key=lambda pair: abs(pair[0]))
    return f"-{axis}" if value < 0 else axis


def _cones(given: Mapping[str, Any], sockets: list[str]) -> Any:
    """One cone for all sockets, or one for each where some are named."""
    tilts = options.numbers_by_name("--cone-deg", given["cone_deg"], "DEG or NAME=DEG", 1, named=False)
    normals = options.numbers_by_name("--normal", given["normal"], "X,Y,Z or NAME=X,Y,Z", 3, named=False)

    def cone(name: str) -> Any:
        tilt, (x, y, z) = tilts.get(name, tilts.get("")), normals.get(name, normals.get("", (0.0, 0.0, 1.0)))
        return kinematics.Cone(math.radians(TILT_DEG if tilt is None else tilt[0]), (x, y, z))

    named = sorted(filter(None, (*tilts, *normals)))
    return {name: cone(name) for name in dict.fromkeys([*sockets, *named])} if named else cone("")


def arm_for(manifest: Path, arm: str) -> str:
    """An arm as a manifest names it: a shipped name, or the path of a file, relative to the manifest if it can be."""
    if not os.path.isfile(arm):
        return arm
    try:
        return Path(os.path.relpath(arm, manifest.parent)).as_posix()
    except ValueError:  # on another drive
        return Path(arm).absolute().as_posix()


def _rest(text: str | None, arm: Any, angles: str) -> list[float] | None:
    """Readings of all joints at rest, rad or mm."""
    if text is None:
        return None
    try:
        values = [number(part.strip()) for part in text.split(",")]
    except ValueError:
        bad_option("--rest", text, "one reading per joint, separated by commas")
    from ..kinematics.arm import by_joint

    units = by_joint(arm, DEG if angles == "deg" else 1.0, 1.0)
    return values if len(values) != len(units) else [x * unit for x, unit in zip(values, units, strict=True)]


def _range(text: str) -> tuple[float, float]:
    low, colon, high = text.partition(":")
    try:
        return number(low.strip()), number((high if colon else low).strip())
    except ValueError:
        bad_option("--length-mm", text, "L or L:M, in mm")


def _region(texts: list[str] | None) -> dict[str, tuple[float, float]] | None:
    """Ranges of coordinates, from ``AXIS=LOW:HIGH``."""
    region: dict[str, tuple[float, float]] = {}
    for text in texts or ():
        axis, _, values = text.partition("=")
        low, colon, high = values.partition(":")
        if axis in region:
            raise InputError("--region names an axis twice; give one range per axis.")
        try:
            if not colon:
                raise ValueError
            region[axis] = number(low.strip() or "-inf"), number(high.strip() or "inf")
        except ValueError:
            bad_option("--region", text, "AXIS=LOW:HIGH, in mm; for example z=0:800")
    return region or None
