"""``arm``: an arm looked at before its first calibration, a template of an arm file, readings compared with an arm."""

import os
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core.errors import InputError
from ..core.text import number
from ..files.outputs import together
from .app import BaseLink, Json, TipLink, app, bad_option, examples, show_summary, with_spinner
from .plan_options import PlanEncoderNoise, PlanSeatingNoise, assumed_noise


@app.command(
    epilog=examples(
        "aacmm arm robot.urdf --tip tool0 --figure arm.png",
        "aacmm arm --new my-arm.toml --joints 6",
        "aacmm arm my-arm.toml --check poses.csv --unit deg",
        "aacmm arm panda --check capture.toml",
    )
)
def arm(
    file: Annotated[
        str | None,
        typer.Argument(
            metavar="ARM",
            help="A TOML file, a URDF, a kinematics.yaml, or the name of an arm that ships with aacmm.",
        ),
    ] = None,
    new: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml", help="Write a template of an arm file, with every key explained. Overwrites nothing."
        ),
    ] = None,
    joints: Annotated[
        int | None, typer.Option(min=1, max=20, metavar="N", help="Of the template: number of joints. Default 6.")
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option(
            metavar="POSES",
            help="Compare readings with the arm: a manifest (TOML), a capture (HDF5), or a table (CSV) with columns "
            "q_1, q_2, ... and, where the tip was, x, y, z (mm, or as the header says) with or without qw, qx, qy, qz "
            "or rx, ry, rz; without positions its poses are of one socket, or of those that a column socket names.",
        ),
    ] = None,
    unit: Annotated[
        Literal["deg", "rad"] | None,
        typer.Option(help="Of readings in a table; without it, and a header that says it, taken by their size."),
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png", help="Picture of the arm at zero readings, and of its reach (.png, .svg, .pdf)."
        ),
    ] = None,
    encoder_arcsec: PlanEncoderNoise = None,
    seating_mm: PlanSeatingNoise = None,
    model: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL", help="What its joints do besides their readings, as for calibrate: gravity,harmonics=1."
        ),
    ] = None,
    base: BaseLink = None,
    tip: TipLink = None,
    probe: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Of a URDF or kinematics.yaml: a tool's tip in the last link, mm."),
    ] = None,
    as_json: Json = False,
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
        specification = load_specification(file, base=base, tip=tip, probe=_probe(probe))
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
        from ..files.joint_models import with_model

        specification = with_model(specification, model)
    with together(figure):
        usual = assumed_noise(file, {"base": base, "tip": tip}, (encoder_arcsec, seating_mm, None))
    _survey(specification, figure, usual, model, as_json)


def _template(path: Path, joints: int, as_json: bool) -> None:
    from ..files.arm_tables import arm_template
    from ..files.outputs import write_text

    with together(path):
        if os.path.lexists(path):
            raise InputError(f"{path} exists; give another name, or remove it.")
        write_text(path, arm_template(joints))
    summary = {"kind": "arm template", "joints": joints, "written": str(path)}
    show_summary(
        summary, as_json, lambda shown: typer.echo(f"Written: {shown['written']}. Look at it: aacmm arm {path}")
    )


def _survey(
    specification: Any,
    figure: Path | None,
    usual: Any,
    model: str | None,
    as_json: bool,
) -> None:
    from ..summaries.arm_survey import arm_survey
    from . import arm_display

    base = None
    if specification.urdf is not None:
        from ..files.urdf import urdf_chain

        base = urdf_chain(specification.urdf).base
    with together(figure):
        summary = with_spinner("Looking at the arm", lambda: arm_survey(
            specification, usual, base=base, model=model
        ))  # fmt: skip
        if base is not None:
            summary["urdf"]["first_frame_in_base_mm"] = base.tolist()
        if figure is not None:
            from ..plot.arm import save_arm_figure

            save_arm_figure(specification.arm, figure, title=specification.name, base=base)
            summary["written"] = str(figure)
    show_summary(summary, as_json, arm_display.survey)


def _probe(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    try:
        x, y, z = (number(part.strip()) for part in text.split(","))
    except ValueError:
        bad_option("--probe", text, "X,Y,Z in mm")
    return x, y, z
