"""``arm``: an arm looked at before its first calibration, a template of an arm file, readings compared with an arm."""

import os
from pathlib import Path
from typing import Any, Literal

from ..core.errors import InputError
from ..files.outputs import together
from ..summaries.tables import Styled, formatted, listed, number, warnings_of, written_of
from . import calibration_views, options
from .app import app, examples, show_summary, with_spinner
from .calibration_views import View
from .options import argument, numbers_option, option
from .plan_assumptions import assumed_noise


@app.command(
    epilog=examples(
        "aacmm arm robot.urdf --tip tool0 --figure arm.png",
        "aacmm arm --new my-arm.toml --joints 6",
        "aacmm arm my-arm.toml --check poses.csv --unit deg",
        "aacmm arm panda --check capture.toml",
    )
)
def arm(
    file: str | None = argument(
        "ARM", "A TOML file, a URDF, a kinematics.yaml, or the name of an arm that ships with aacmm.", None
    ),
    new: Path | None = option(
        "FILE.toml", "Write a template of an arm file, with every key explained. Overwrites nothing."
    ),
    joints: int | None = option("N", "Number of joints of the template. Default: 6.", min=1, max=20),
    check: Path | None = option(
        "POSES",
        "Compare readings with the arm: a manifest (TOML), a capture (HDF5), or a table (CSV) with columns q_1, q_2, "
        "... and, where the tip was, x, y, z (mm, or as the header says) with or without qw, qx, qy, qz or rx, ry, rz; "
        "without positions its poses are of one socket, or of those that a column socket names.",
    ),
    unit: Literal["deg", "rad"] | None = option(
        None, "Unit of the readings in a table. Default: as its header says, else by their size."
    ),
    figure: Path | None = option("FILE.png", "Draw the arm at zero readings, and its reach (.png, .svg, .pdf)."),
    encoder_arcsec: float | None = options.USUAL_ENCODER_NOISE,
    seating_mm: float | None = options.USUAL_SEATING_NOISE,
    model: str | None = option("MODEL", "Model of the joints, as for calibrate: gravity,harmonics=1."),
    base: str | None = options.BASE_LINK,
    tip: str | None = options.TIP_LINK,
    probe: str | None = option("X,Y,Z", "Tip of a tool in the last link of a URDF or kinematics.yaml, mm."),
    as_json: bool = options.JSON,
) -> None:
    """Look at an arm before its first calibration.

    Prints its axes at zero readings, its reach, which parameters are redundant and with what, what sockets, reference
    lengths and a tracker determine of it, and how many poses a first capture needs.

    --check finds which order, signs, zeros and units of the columns make recorded readings fit the arm, and prints the
    table [angles] that a manifest then needs. Positions of a table are in the base frame (of a URDF: in its base link),
    those of a manifest's tracker in a frame that is found. Exit code 1 where nothing makes them fit.
    """
    if new is not None:
        if file is not None or check is not None or figure is not None:
            raise InputError("--new writes a template and reads no arm; leave out the arm, --check and --figure.")
        _template(new, 6 if joints is None else joints, as_json)
        return
    if file is None:
        raise InputError("name an arm: a file or a shipped arm; or write a template with --new my-arm.toml.")
    if joints is not None:
        raise InputError("--joints is for a template; give it with --new.")
    from ..files.arms import load_specification

    if figure is not None:
        from ..plot.figures import check_format

        check_format(figure)
    with together(figure):
        tool = None if probe is None else numbers_option("--probe", probe, "X,Y,Z in mm", 3)
        specification = load_specification(file, base=base, tip=tip, probe=tool)
    if check is not None:
        if figure is not None or encoder_arcsec is not None or seating_mm is not None:
            raise InputError("--check compares readings alone; leave out --figure, --encoder-arcsec and --seating-mm.")
        if model is not None:
            raise InputError("--check compares readings alone; leave out --model.")
        from .reading_checks import check_arm

        check_arm(specification, check, unit, as_json)
        return
    if unit is not None:
        raise InputError("--unit is for the table of --check; leave it out.")
    if model is not None:
        from ..files.joint_options import with_model

        specification = with_model(specification, model)
    with together(figure):
        usual = assumed_noise(file, {"base": base, "tip": tip}, (encoder_arcsec, seating_mm, None))
    summary = _surveyed(specification, figure, usual, model)
    show_summary(summary, as_json, survey)


def _template(path: Path, joints: int, as_json: bool) -> None:
    from ..files.arm_tables import arm_template
    from ..files.outputs import write_text

    with together(path):
        if os.path.lexists(path):
            raise InputError(f"{path} exists; give another name, or remove it.")
        write_text(path, arm_template(joints))
    summary = {"kind": "arm template", "joints": joints, "written": str(path)}
    show_summary(summary, as_json, lambda shown: [f"Written: {shown['written']}. Look at it: aacmm arm {path}"])


def _surveyed(specification: Any, figure: Path | None, usual: Any, model: str | None) -> dict[str, Any]:
    from ..summaries.arm_survey import arm_survey

    base = None
    if specification.urdf is not None:
        from ..files.urdf import urdf_chain

        base = urdf_chain(specification.urdf).base
    with together(figure):
        summary = with_spinner("Looking at the arm", lambda: arm_survey(specification, usual, base=base, model=model))
        if base is not None:
            summary["urdf"]["first_frame_in_base_mm"] = base.tolist()
        if figure is not None:
            from ..plot.arm import save_arm_figure

            save_arm_figure(specification.arm, figure, title=specification.name, base=base)
            summary["written"] = str(figure)
    return summary


def survey(summary: dict[str, Any]) -> View:
    """An arm before its first calibration."""
    yield from calibration_views.arm(summary)
    yield from warnings_of(summary)
    rows = [
        (
            "tip" if row["joint"] is None else row["joint"],
            *(number(x, 3) for x in row["origin_mm"]),
            *(number(x, 4, rounded=True) for x in row["axis"]),
        )
        for row in summary["frames"]
    ]
    headings = ("joint", "through x [mm]", "y [mm]", "z [mm]", "direction x", "y", "z")
    yield listed("Axes at zero readings", rows, headings)
    reach = summary["reach_mm"]
    yield (
        f"\nReach: {reach['nearest']:.0f} to {reach['farthest']:.0f} mm from the shoulder, on the first axis at "
        f"({', '.join(f'{x:.0f}' for x in reach['shoulder'])}) mm (self-collision is not considered). "
        f"The links together measure {reach['links']:.0f} mm."
    )
    if summary["determined"]:
        yield from _determined(summary)
    for arm_class in summary["needed"]:
        yield from _needed(arm_class)
    if summary["needed"]:
        yield f"\n{summary['advice']}"
    yield from written_of(summary)


def _determined(summary: dict[str, Any]) -> View:
    """What data can and cannot determine of the arm."""
    yield ["\n", Styled("Redundant"), f", whatever is recorded ({summary['parameters']} parameters in all):"]
    yield from (f"  {text}" for text in summary["redundant"])
    if summary["weak"]:
        yield [Styled("Hardly determined"), ", even by poses all over the workspace:"]
        yield from (f"  {text}" for text in summary["weak"])
    why = [text for row in summary["determined"][1:2] for text in row["corrections"]]
    if summary["corrections_left_out"] or why:
        yield [Styled("Joint corrections"), ":"]
        yield from (f"  {text}" for text in (*summary["corrections_left_out"], *why))
    for i in summary["parallel"]:
        yield f"  Axes {i} and {i + 1} are nearly parallel: beta_{i} takes the place of d_{i}."
    columns = {"data": "data", "parameters": "determined", "well": "well_determined", "scale": "scale"}
    yield listed("What data determine at their best", summary["determined"], columns)
    yield f"To be freed, of sockets with a length: {len(summary['free'])}: {', '.join(summary['free'])}."
    yield ["\n", Styled("Where a joint stays still in all poses")]

    def lost(row: dict[str, Any]) -> str:
        if row["lost"] is None:
            return "(the tip can hardly stay in a socket then)"
        return ", ".join(row["lost"]) or "-"

    yield listed("", summary["still"], {"joint": "joint", "no longer determined well": lost})


def _needed(arm_class: dict[str, Any]) -> View:
    """What a first capture with so many poses reaches."""
    title = "U of a length that a calibration from random poses adds"
    yield ["\n", Styled(title), f" [mm, k = 2]: {arm_class['class']}"]
    rows = [
        (
            row["data"],
            *(None if u is None else 2 * u for u in row["u_mm"].values()),
            row["enough_poses"] or None,
        )
        for row in arm_class["rows"]
    ]
    counts = (f"{count} poses" for count in arm_class["rows"][0]["u_mm"])
    yield listed("", rows, ("data", *counts, "enough"))
    yield (
        f"Medians over the volume, of encoders of {arm_class['encoder_arcsec']:.3g} arcsec and a seat of "
        f"{arm_class['seating_mm']:.3g} mm ({arm_class['noise_source']}), reference lengths of "
        f"u = {arm_class['u_length_mm']:g} mm, and a tracker of u = {arm_class['u_tracker_mm']:g} mm in each "
        "coordinate. Two sockets and a reference length are as good as a ball bar in one place."
    )
    yield (
        "Enough: poses from which on this is less than the noise of the readings themselves, "
        f"{formatted(2 * arm_class['u_reading_mm'])} mm."
    )
