"""Kits as TOML: what is at hand for a calibration that is to be planned."""

import math
import os
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field, FiniteFloat, NonNegativeInt, PositiveFloat, PositiveInt, create_model

from ..core.errors import InputError, naming
from ..core.units import DEG
from ..data.capture_data import ReferenceLength
from ..data.observations.declared import FREE
from ..data.observations.simulated import AbstractSimulated, simulated_kinds
from ..data.observations.simulated_pixels import SimulatedPixels
from ..data.targets import AbstractTarget
from ..planning.kit_placement import KitItem
from .inputs import InputFile
from .manifest_cameras import CameraTable, TargetTable
from .manifest_pixels import Cameras
from .manifest_rows import Source
from .manifest_tables import Length
from .toml import Point, Strict, read_toml

_POSES = 20  # where none is stated
_Numbers = list[FiniteFloat] | list[list[FiniteFloat]]
_CONTENT = {"count": PositiveInt, "text": str, "truth": bool, "number": FiniteFloat}
_CONTENT["points"] = Annotated[dict[str, Point], Field(min_length=1)]


def _model(kind: type[AbstractSimulated]) -> type[Strict]:
    fields: dict[str, Any] = {
        "name": (str, ...),
        "places": (NonNegativeInt, 0),
        "turned": (Literal["any", "vertical", "not"], "any"),
        "half_angle_deg": (Annotated[float, Field(gt=0, le=180)], 180.0),
        "normal": (Point, [0.0, 0.0, 1.0]),
    }
    for entry in kind.entries:
        if entry.name == "errors":  # unknown to whoever has the artefact
            continue
        array = entry.content == "number" and float not in (entry.annotation, *get_args(entry.annotation))
        stated = _Numbers if array else _CONTENT[entry.content]
        fields[entry.name] = (stated, ...) if entry.required else (stated | None, None)
    fields["poses"] = (PositiveInt, _POSES)
    return create_model(f"{kind.__name__}Table", __base__=Strict, **fields)


_Frame = Annotated[list[FiniteFloat], Field(min_length=6, max_length=6)]


class KitPixels(Strict):
    """A camera that sees a target, each with a table of its own, as in a manifest."""

    name: str
    camera: str
    target: str
    on_arm: Literal["camera", "target"] = "camera"
    mount: _Frame  # of what is on the arm: position, mm, and rotation vector, rad, in the last frame
    frame: _Frame  # of what stands still: rotation vector, rad, and origin, mm, in the base frame
    distance: Annotated[list[PositiveFloat], Field(min_length=2, max_length=2)]  # least and largest, mm
    tilt_deg: Annotated[float, Field(gt=0, lt=90)] = 50.0  # largest, of the target's normal and the line of sight
    u: PositiveFloat = 0.3  # px: standard deviation of a coordinate of a corner
    poses: PositiveInt = _POSES


_KINDS = {table: kind for table, kind in simulated_kinds().items() if kind is not SimulatedPixels}
_FIELDS: dict[str, Any] = {
    table: (list[_model(kind)], Field(default_factory=list))  # pyright: ignore[reportInvalidTypeForm]
    for table, kind in _KINDS.items()
}


class _Beside(Strict):
    length: list[Length] = Field(default_factory=list)
    camera: list[CameraTable] = Field(default_factory=list)
    target: list[TargetTable] = Field(default_factory=list)
    pixels: list[KitPixels] = Field(default_factory=list)


_Kit = create_model("_Kit", __base__=_Beside, **_FIELDS)


def read_kit(path: str | os.PathLike, *, lengths: bool = False) -> list[KitItem]:
    """Read a kit: what is at hand for a calibration, with its uncertainties, for `planning.plan_kit`.

    Tables are ``[[artefact]]``, ``[[touched_sphere]]``, ``[[touched_cylinder]]``, ``[[planes]]`` (one, or two at a
    ``distance``), ``[[points]]``, ``[[transforms]]``, ``[[distances]]``, ``[[socket]]`` and, to simulate,
    ``[[contact_sphere]]`` and ``[[contact_plane]]``; their keys are the
    arguments of the simulated observation, in mm and rad, and ``places`` (how many placements a plan is to choose; 0
    leaves the thing where it is stated), ``turned`` ("any", "vertical" for turns about the vertical alone, or "not"),
    and the cone from which the tool comes to it: ``half_angle_deg`` about ``normal``, which points out of its seats, in
    an artefact's own frame and for everything else in the base frame (by default (0, 0, 1), and all directions).

    ``[[pixels]]`` is a camera that sees a target, which have the tables ``[[camera]]`` and ``[[target]]`` of a manifest
    and stand where it says.

    ``[[length]]``, as in a manifest, is a certified length between two sockets; `kit_lengths` reads it.

    Args:
        path: The TOML file.
        lengths: Whether ``[[length]]`` may be there, which plans and simulations of kits do not use.

    Example:
        >>> from pathlib import Path
        >>> cone = '{ name = "cone", point = [400, 200, 300], poses = 5, places = 3 }'
        >>> _ = Path("kit.toml").write_text(f"socket = [{cone}]")
        >>> print([(item.simulated.name, item.places) for item in aj.files.read_kit("kit.toml")])
        [('cone', 3)]
    """
    content = read_toml(path, _Kit)
    if content.length and not lengths:
        raise InputError(
            f"{path} has [[length]], which only a live capture uses; state an artefact with two points instead, or "
            "leave it out."
        )
    items: list[KitItem] = []
    for table, kind in _KINDS.items():
        for entry in getattr(content, table):
            stated = {name: value for name, value in entry if value is not None}
            places, turned = stated.pop("places"), stated.pop("turned")
            half_angle, normal = math.radians(stated.pop("half_angle_deg")), stated.pop("normal")
            with naming(f"{path}: [[{table}]] '{stated['name']}'"):
                if not any(normal):
                    raise InputError("the normal is (0, 0, 0); give a direction.")
                # Tried once, so that what cannot be recorded is refused here.
                simulated = kind(**stated)
                tips = simulated.tips(np.random.default_rng(0))
                if not np.all(np.isfinite(tips)):
                    raise InputError(
                        "the numbers contradict each other (for example, both ends are at the same point); correct the "
                        "numbers."
                    )
                transforms = np.tile(np.eye(4), (len(tips), 1, 1))
                transforms[:, :3, 3] = tips
                simulated.recorded(np.zeros((len(tips), 1)), transforms, np.random.default_rng(0))
            items.append(KitItem(simulated, places, turned, half_angle, tuple(normal)))
    cameras = _cameras(path, content)
    for entry in content.pixels:
        with naming(f"{path}: [[pixels]] '{entry.name}'"):
            items.append(KitItem(_pixels(entry, cameras), places=0))
    if not items:
        tables = ", ".join(f"[[{table}]]" for table in (*_KINDS, "pixels"))
        raise InputError(f"{path} contains no artefact and no instrument; add at least one of the tables {tables}.")
    return items


def _pixels(entry: KitPixels, cameras: Cameras) -> SimulatedPixels:
    """A camera and its target, where they stand."""
    camera, target = cameras.camera(entry.camera), cameras.target(entry.target)
    if camera.intrinsics is None or camera.image_size is None:
        raise InputError(
            f"the [[camera]] '{entry.camera}' has no intrinsics or no image_size, by which a plan knows what it sees; "
            "state them, even if they are rough."
        )
    values = np.asarray(camera.intrinsics, dtype=float)
    u = np.full(len(values), FREE) if camera.u is None else np.broadcast_to(camera.u, values.shape)
    return SimulatedPixels(
        entry.name, entry.poses, entry.camera, entry.target, target.points, values, camera.image_size,
        on_arm=entry.on_arm == "camera", model=camera.model, u_intrinsics=u, mount=entry.mount, frame=entry.frame,
        distance=entry.distance, tilt=entry.tilt_deg * DEG, u=entry.u, u_scale=target.u_scale,
    )  # fmt: skip


def target_tables(path: str | os.PathLike) -> list[dict[str, Any]]:
    """The ``[[target]]`` of a kit, as they are stated."""
    return [table.model_dump(exclude_unset=True) for table in read_toml(path, _Kit).target]


def kit_lengths(path: str | os.PathLike) -> list[ReferenceLength]:
    """The certified lengths between sockets of a kit; `InputError` where an end is no socket of it."""
    content = read_toml(path, _Kit)
    sockets = [socket.name for socket in getattr(content, "socket", ()) if not socket.target]
    lengths = []
    for entry in content.length:
        with naming(f"{path}: [[length]] {entry.start} - {entry.end}"):
            for end in (entry.start, entry.end):
                if end not in sockets:
                    raise InputError(f"the kit has no [[socket]] '{end}' (without a target); name two that it has.")
            lengths.append(entry.between(entry.start, entry.end))
    return lengths


def kit_targets(path: str | os.PathLike) -> dict[str, AbstractTarget]:
    """The targets of a kit, by name."""
    content = read_toml(path, _Kit)
    cameras = _cameras(path, content)
    return {table.name: cameras.target(table.name) for table in content.target}


def _cameras(path: str | os.PathLike, content: Any) -> Cameras:
    """The cameras and targets of a kit, whose files are relative to it."""
    return Cameras(Source(InputFile(path), "q"), content.camera, content.target)
