"""Options of the command ``plan`` that say what the arm can do: noise, cones of approach, obstacles."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from ..core.errors import InputError
from ..core.text import number
from .app import bad_option

CONTEXT: Any = typer.Context.__base__  # what Typer passes: its own class is a subclass that nothing is of
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}

PlanEncoderNoise = Annotated[
    float | None,
    typer.Option(
        "--encoder-arcsec",
        min=0,
        metavar="ARCSEC",
        help="Standard deviation of a joint reading. Default: the arm file's [noise], or that of its class.",
    ),
]

PlanSeatingNoise = Annotated[
    float | None,
    typer.Option(
        "--seating-mm",
        min=0,
        metavar="MM",
        help="Standard deviation of the tip in its socket, for each coordinate. Default: likewise.",
    ),
]

ConeAngles = Annotated[
    list[str] | None,
    typer.Option(
        "--cone-deg",
        metavar="[NAME=]DEG",
        help="How far the tool may tilt from the normal of a socket (of all, or one by name); 180 for any direction. "
        "Default: 60 for robots, any for measuring arms. With --kit: half_angle_deg in its tables.",
    ),
]

Normals = Annotated[
    list[str] | None,
    typer.Option(
        "--normal", metavar="[NAME=]X,Y,Z", help="Direction out of a socket (of all, or one by name). Default 0,0,1."
    ),
]

ToolAxis = Annotated[
    str,
    typer.Option(
        "--tool-axis",
        metavar="AXIS",
        help="Axis of the last frame that points from the tool into a socket: x, y, z, -x, -y or -z.",
    ),
]

RetractDistance = Annotated[
    float | None,
    typer.Option(
        "--retract-mm",
        min=0,
        metavar="MM",
        help="Distance of the approach point of each pose along the socket's normal; 0 for none. Default: 50 for "
        "robots, 0 for measuring arms.",
    ),
]

CellFile = Annotated[
    Path | None,
    typer.Option("--cell", metavar="FILE.toml", help="Boxes, walls and posts that the arm may not touch."),
]

Collisions = Annotated[
    bool,
    typer.Option(
        "--collisions",
        help="Keep the arm's body (collision shapes of its URDF, else capsules along its links) clear of itself and of "
        "the table. Implied by --cell and --link-radius-mm.",
    ),
]

LinkRadius = Annotated[
    float | None,
    typer.Option(
        "--link-radius-mm", min=0, metavar="MM", help="Radius of capsules along the links, as the arm's body."
    ),
]


# Options that each way of planning takes besides those of all: of a calibration with sockets, of one with a kit, and
# of an acceptance test.
_OF_ALL = {"arm", "output", "manifest", "base", "tip", "seed", "as_json", "angles", "margin_deg", "above_mm"}
_OF_CALIBRATIONS = {
    *("poses", "model", "held", "encoder_arcsec", "linear_encoder_mm", "seating_mm", "tool_axis", "retract_mm", "cell"),
    *("collisions", "link_radius_mm", "unconstrained", "criterion", "region", "candidates", "check_length_mm"),
    "farthest",
}
_OF_SOCKETS = {"sockets", "socket", "length", "length_mm", "u_mm", "cone_deg", "normal"}
_OF_ACCEPTANCE = {"acceptance", "sphere_mm", "stylus_mm", "bar_mm", "range_mm"}


def check_options(context: Any, kit: bool, acceptance: bool) -> None:
    """Refuse options that the way of planning would ignore."""
    taken = _OF_ACCEPTANCE if acceptance else _OF_CALIBRATIONS | ({"kit"} if kit else _OF_SOCKETS)
    sources = {name: context.get_parameter_source(name) for name in context.params if name not in _OF_ALL | taken}
    ignored = [
        f"--{name.replace('_', '-')}" for name, source in sources.items() if source and source.name == "COMMANDLINE"
    ]
    if not ignored:
        return
    listed = " and ".join([", ".join(ignored[:-1]), ignored[-1]] if len(ignored) > 1 else ignored)
    if acceptance:
        raise InputError(f"--acceptance has its own poses, sockets and bars and ignores {listed}; leave out {listed}.")
    if kit:
        raise InputError(f"--kit names what is used and where it is, and ignores {listed}; leave out {listed}.")
    raise InputError(f"{listed} {'is' if len(ignored) == 1 else 'are'} for acceptance tests; give --acceptance too.")


class PlannedArm(NamedTuple):
    """What plans assume of an arm, by its file and the options."""

    options: dict[str, Any]  # of `planning.plan` and `planning.plan_kit`
    cone: Any  # of `planning.plan`: a `Cone`, or socket name -> `Cone`
    noise_source: str
    notes: tuple[str, ...]


def assumed_noise(
    arm: str, links: Mapping[str, str | None], noise: tuple[float | None, float | None, float | None]
) -> Any:
    """The noise of an arm that has not been calibrated (`ArmNoise`): what options give (``noise``: arcsec, mm and, of
    prismatic joints, mm), else what its file states, else that of its class."""
    from ..data.noise import Noise
    from ..files.arms import load_noise

    assumed = load_noise(arm, **links)
    encoder, seating, linear = noise
    found = Noise(
        encoder_arcsec=assumed.noise.encoder_arcsec if encoder is None else encoder,
        seating=assumed.noise.seating if seating is None else seating,
        linear_encoder=assumed.noise.linear_encoder if linear is None else linear,
    )
    return assumed._replace(noise=found, source=assumed.source if encoder is None else "as given")


def planned_arm(
    arm: str,
    links: Mapping[str, str | None],
    noise: tuple[float | None, float | None, float | None],
    cones: tuple[Sequence[str] | None, Sequence[str] | None],
    tool_axis: str,
    retract: float | None,
    cell: tuple[Path | None, bool, float | None],
    sockets: Sequence[str],
) -> PlannedArm:
    """The options as `planning.plan` takes them; what is not given follows from the class of the arm.

    ``links``: base and tip of a URDF. ``noise``: arcsec, mm and, of prismatic joints, mm. ``cones``: texts of
    --cone-deg and --normal. ``cell``: its file, whether collisions are checked, and the radius of the links.
    ``sockets``: names that may be named.
    """
    from ..data.arm_classes import CLASSES
    from ..files.cells import load_cell

    assumed = assumed_noise(arm, links, noise)
    default = CLASSES[assumed.arm_class]
    file, wanted, radius = cell
    loaded = load_cell(arm, file, **links, radius=radius) if wanted or file is not None or radius is not None else None
    return PlannedArm(
        {
            "noise": assumed.noise,
            "tool_axis": _tool_axis(tool_axis),
            "cell": None if loaded is None else loaded.cell,
            "retract": default.retract if retract is None else retract,
        },
        _cones(*cones, default.cone, sockets),
        assumed.source,
        () if loaded is None else loaded.notes,
    )


def _tool_axis(text: str) -> tuple[float, ...]:
    sign, axis = (-1.0, text[1:]) if text.startswith("-") else (1.0, text)
    if axis not in _AXES:
        bad_option("--tool-axis", text, "x, y, z, -x, -y or -z")
    return tuple(sign * x + 0.0 for x in _AXES[axis])


def _cones(angles: Sequence[str] | None, normals: Sequence[str] | None, default: float, sockets: Sequence[str]) -> Any:
    """One cone for all sockets, or one for each where some are named."""
    from ..kinematics.cones import Cone

    half_angles = {name: math.radians(value[0]) for name, value in _by_socket("--cone-deg", angles, 1).items()}
    directions = {name: (x, y, z) for name, (x, y, z) in _by_socket("--normal", normals, 3).items()}
    named = {name for name in (*half_angles, *directions) if name is not None}
    common = Cone(half_angles.get(None, default), directions.get(None, (0.0, 0.0, 1.0)))
    if not named:
        return common
    return {
        name: Cone(half_angles.get(name, common.half_angle), directions.get(name, common.normal))
        for name in dict.fromkeys([*sockets, *sorted(named)])
    }


def _by_socket(option: str, texts: Sequence[str] | None, count: int) -> dict[str | None, tuple[float, ...]]:
    """Numbers by the name of a socket, None for all: ``NAME=1,2,3`` or ``1,2,3``."""
    found: dict[str | None, tuple[float, ...]] = {}
    for text in texts or ():
        name, equals, values = text.rpartition("=")
        key = name if equals else None
        try:
            numbers = tuple(number(part.strip()) for part in values.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != count:
            bad_option(option, text, "DEG or NAME=DEG" if count == 1 else "X,Y,Z or NAME=X,Y,Z")
        if key in found:
            raise InputError(f"{option} is given twice for {'all sockets' if key is None else repr(key)}; give one.")
        found[key] = numbers
    return found
