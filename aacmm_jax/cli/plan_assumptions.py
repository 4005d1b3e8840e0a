"""What is assumed of an arm that was not calibrated: its noise, cones of approach and body, by options or class."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..core.errors import InputError
from ..core.text import number
from .options import bad_option

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class PlannedArm(NamedTuple):
    """What plans assume of an arm, by its file and the options."""

    options: Any  # `PlanOptions`
    cone: Any  # of `planning.plan`: a `Cone`, or socket name -> `Cone`
    stated: dict[str, Any]  # of the plan's summary: where the noise comes from, and notes


def assumed_noise(
    arm: str, links: Mapping[str, str | None], noise: tuple[float | None, float | None, float | None]
) -> Any:
    """The noise of an arm that has not been calibrated (`ArmNoise`): what options give (``noise``: arcsec, mm and, of
    prismatic joints, mm), else what its file states, else that of its class."""
    from ..data.noise import Noise
    from ..files.arms import load_noise

    assumed = load_noise(arm, **links)
    encoder, seating, linear = noise
    stated = Noise(
        encoder_arcsec=assumed.noise.encoder_arcsec if encoder is None else encoder,
        seating=assumed.noise.seating if seating is None else seating,
        linear_encoder=assumed.noise.linear_encoder if linear is None else linear,
    )
    return assumed._replace(noise=stated, source=assumed.source if encoder is None else "as given")


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
    from ..data.noise import CLASSES
    from ..files.cells import load_cell
    from ..planning.problem import PlanOptions

    assumed = assumed_noise(arm, links, noise)
    file, wanted, radius = cell
    loaded = load_cell(arm, file, **links, radius=radius) if wanted or file is not None or radius is not None else None
    sign, axis = (-1.0, tool_axis[1:]) if tool_axis.startswith("-") else (1.0, tool_axis)
    if axis not in _AXES:
        bad_option("--tool-axis", tool_axis, "x, y, z, -x, -y or -z")
    options = PlanOptions.usual(assumed)._replace(
        tool_axis=tuple(sign * x + 0.0 for x in _AXES[axis]), cell=None if loaded is None else loaded.cell
    )
    return PlannedArm(
        options if retract is None else options._replace(retract=retract),
        _cones(*cones, CLASSES[assumed.arm_class].cone, sockets),
        {"noise_source": assumed.source, "notes": [] if loaded is None else list(loaded.notes)},
    )


def _cones(angles: Sequence[str] | None, normals: Sequence[str] | None, default: float, sockets: Sequence[str]) -> Any:
    """One cone for all sockets, or one for each where some are named."""
    from ..kinematics.workspace import Cone

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
    by_name: dict[str | None, tuple[float, ...]] = {}
    for text in texts or ():
        name, equals, values = text.rpartition("=")
        key = name if equals else None
        try:
            numbers = tuple(number(part.strip()) for part in values.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != count:
            bad_option(option, text, "DEG or NAME=DEG" if count == 1 else "X,Y,Z or NAME=X,Y,Z")
        if key in by_name:
            raise InputError(f"{option} is given twice for {'all sockets' if key is None else repr(key)}; give one.")
        by_name[key] = numbers
    return by_name
