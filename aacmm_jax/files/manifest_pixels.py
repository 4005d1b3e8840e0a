"""[[pixels]] of a manifest: images of a target, or tables of corners, with the readings of their poses."""

import glob
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError, naming, nearest
from ..core.text import quoted, shorten
from ..data.cameras.camera import AbstractCamera, cameras
from ..data.observations.declared import declared
from ..data.observations.observation import AbstractObservation
from ..data.observations.pixels import Pixels, pixels_of
from ..data.recording import ReadImage
from ..data.targets import AbstractTarget, PointTable, target_of
from .camera_files import read_camera
from .corner_tables import Seen, matched, natural_order, read_corners
from .manifest_cameras import CameraTable, PixelsTable, TargetTable
from .manifest_rows import Source, parts
from .manifest_tables import Preset, as_list
from .patterns import fill
from .text_table import TextTable

U_PX = 0.3  # standard deviation of a corner coordinate where none is stated
_FEWEST = 4  # corners of an image that determine the pose of a board
_MOST_IMAGES = 5000
Progress = Callable[[Sequence[Any], str], Iterable[Any]]  # shows how many of the items are done


class StatedCamera(NamedTuple):
    """A camera of a manifest."""

    model: AbstractCamera
    intrinsics: Float[np.ndarray, " k"] | None  # None: to be found from the images
    u: Float[np.ndarray, " k"] | None  # 0 exact, inf free
    image_size: tuple[int, int] | None


class _Poses:
    """What the table of readings holds, as a kind of observation declares it."""

    entries = (
        Entry("joint reading", "rad", ("pose", "joint"), name="q"),
        Entry("name of the image", "", ("pose",), default="", name="image", annotation=str),
    )
    usual = Preset({"image": [["image"], ["file"], ["filename"], ["frame"]]})


class Cameras:
    """The cameras and targets that a manifest states, by name."""

    def __init__(self, source: Source, stated: Sequence[CameraTable], targets: Sequence[TargetTable]):
        self._source = source
        self.cameras, self.targets = ({table.name: table for table in tables} for tables in (stated, targets))
        for what, tables, by_name in (("camera", stated, self.cameras), ("target", targets, self.targets)):
            if len(by_name) < len(tables):
                names = [table.name for table in tables]
                twice = next(name for name in names if names.count(name) > 1)
                raise InputError(f"{what} '{twice}' is defined twice; give it one [[{what}]].")

    def target(self, name: str) -> AbstractTarget:
        """A target. Raises `InputError` where it is unknown or not as its kind needs it."""
        if name not in self.targets:
            raise InputError(f"the target '{name}' has no [[target]]{nearest(name, self.targets)}")
        table = self.targets[name]
        with naming(f"[[target]] '{name}'"):
            keys = table.keys()
            if table.file is not None:
                keys |= _points_of(self._source, table)
            return target_of(**keys)

    def camera(self, name: str) -> StatedCamera:
        """A camera; one without a table is a pinhole whose intrinsics are unknown."""
        table = self.cameras.get(name, CameraTable(name=name))
        if self.cameras and name not in self.cameras:
            raise InputError(f"the camera '{name}' has no [[camera]]{nearest(name, self.cameras)}")
        with naming(f"[[camera]] '{name}'"):
            return _stated_camera(self._source, table)


def _points_of(source: Source, table: TargetTable) -> dict[str, Any]:
    """Ids and coordinates, mm, of a table of points."""
    text = TextTable(source.open(str(table.file)), decimal=None)
    ids = text.numbers(text.pick(as_list(table.columns.get("id", "id"))))[:, 0]
    picked = text.pick(as_list(table.columns.get("points", ["x", "y", "z"])))
    if len(picked) != 3:
        raise InputError(f"{text.path}: {len(picked)} columns are picked for x, y and z; pick 3.")
    unit = checked_unit(text.path, "points", text.unit(picked, key="points"), table.units.get("points"), "mm", LENGTH_UNITS)
    return {"ids": ids, "points": text.numbers(picked) * LENGTH_UNITS[unit or "mm"]}


def _stated_camera(source: Source, table: CameraTable) -> StatedCamera:
    """A camera as its table, or the file that it names, describes it."""
    models, size = camera_models(), None if table.image_size is None else tuple(table.image_size)
    name = table.model or "pinhole"
    if name not in models:
        raise InputError(f"model = '{name}' is not a camera model{nearest(name, models)}")
    values: Any = None
    if table.file is not None:
        stored = read_camera(source.open(table.file))
        if table.model not in (None, stored.model):
            raise InputError(f"model is '{table.model}', but {table.file} describes a '{stored.model}'; correct one of the two.")
        if size and stored.image_size and size != stored.image_size:
            raise InputError(
                f"image_size is {_by(size)}, but {table.file} is for images of {_by(stored.image_size)} px; correct one "
                "of the two."
            )
        name, values, size = stored.model, stored.values, size or stored.image_size
    model = models[name]
    names = model.names(*_count_of(table, values))
    if table.intrinsics is not None:
        unknown = next((key for key in table.intrinsics if key not in names), None)
        if unknown is not None:
            raise InputError(f"intrinsics has no '{unknown}'{nearest(unknown, names)}")
        missing = [key for key in ("fx", "fy", "cx", "cy") if key in names and key not in table.intrinsics]
        if missing:
            raise InputError(f"intrinsics has no {shorten(missing)}; give at least fx, fy, cx and cy, in px.")
        values = np.array([table.intrinsics.get(key, 0.0) for key in names])
    u = np.full(len(names), 0.0 if table.u == "exact" else np.inf)
    if isinstance(table.u, dict):
        unknown = next((key for key in table.u if key not in names), None)
        if unknown is not None:
            raise InputError(f"u has no '{unknown}'{nearest(unknown, names)}")
        u = np.array([table.u.get(key, 0.0) for key in names])
    return StatedCamera(name, names, values, u, size)


def _count_of(table: CameraTable, values: Any) -> int:
    """The number of distortion coefficients of a pinhole."""


def _by(size: Sequence[int]) -> str:
    return f"{size[0]} x {size[1]}"


def observations_of(
    cameras: Cameras, source: Source, entry: PixelsTable, values: Mapping[str, str], progress: Progress
) -> tuple[list[tuple[str, Pixels]], list[ReadImage]]:
    """The observations of a table, one for each session, and what was found in each image."""
    name = fill(entry.name or entry.camera, values)
    where = f"[[pixels]] '{name}'"
    with naming(where):
        target, camera = cameras.target(fill(entry.target, values)), cameras.camera(fill(entry.camera, values))
    taken = list(parts(source, _Poses, entry, values, where))  # pyright: ignore[reportArgumentType]
    with naming(where):
        seen = _seen(source, entry, values, target, camera, progress)
        read, observed = [], []
        for part in taken:
            wanted = part.rows["image"].tolist() if "image" in part.rows else None
            if wanted is None and len(taken) > 1:
                raise InputError("readings of several sessions need a column 'image' with the names of the files.")
            indices = matched([image.label for image in seen], wanted, len(part.rows["q"]), where)
            _check_once(part.rows["q"], [seen[i].label for i in indices], indices)
            named = "/".join(filter(None, (part.session, name)))
            poses, images = [], []
            for q, index in zip(part.rows["q"], indices, strict=True):
                image = seen[index] if index >= 0 else Seen("", *NOTHING, "no corners are listed for this pose")
                read.append(ReadImage(named, image.label, len(image.ids), image.refused))
                if not image.refused:
                    poses.append(q)
                    images.append(image)
            if not poses:
                reasons = shorten(list(dict.fromkeys(image.refused for image in seen)), 3)
                raise InputError(f"no image can be used: {reasons}")
            observed.append((part.session, _pixels(name, entry, camera, target, np.array(poses), images)))
        return observed, [*read, *_left_over(seen, read, taken)]
