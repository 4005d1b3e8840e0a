"""[[pixels]] of a manifest: images of a target, or tables of corners, with the readings of their poses."""

import base64
import glob
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from ..camera.consistency import is_mirrored, misfits, on_one_line
from ..core.errors import InputError, naming, nearest
from ..core.text import quoted, shorten
from ..core.units import LENGTH_UNITS
from ..data.cameras.camera import AbstractCamera, camera_models
from ..data.observations.corner_tables import Camera, CornerTable, pixels_of
from ..data.observations.declared import Declared, declared
from ..data.observations.pixels import Pixels
from ..data.recording import ReadImage
from ..data.targets import AbstractTarget, target_of
from .camera_files import read_camera
from .corner_files import NO_CORNERS, Seen, corners_of_json, corners_of_table, matched, natural_order
from .manifest_cameras import CameraTable, PixelsTable, TargetTable
from .manifest_files import as_list
from .manifest_readings import checked_unit
from .manifest_rows import Source, parts
from .outputs import write_atomically
from .patterns import fill

_MISREAD = 0.05  # of the distance between corners, from where the target has them
_FEWEST = 4  # corners of an image that determine the pose of a board
Progress = Callable[[Sequence[Any], str], Iterable[Any]]  # shows how many of the items are done


def without_progress(items: Sequence[Any], what: str) -> Iterable[Any]:
    """The items as they are."""
    return items


class Detecting(NamedTuple):
    """What is done while images are read."""

    progress: Progress = without_progress
    overlays: Path | None = None  # folder of a picture for each image, with the corners that were found in it
    found: dict[Any, list[Seen]] | None = None  # in images that were read before, by where they are and what is in them


class _Poses(Declared):
    """What the table of readings holds."""

    q: Float[np.ndarray, "m n"] = declared("joint reading", "rad", "pose", "joint")
    image: str = declared("name of the image", "", "pose", default="")
    usual: ClassVar[Mapping[str, Any]] = {"image": [["image"], ["file"], ["filename"], ["frame"]]}


class Cameras:
    """The cameras and targets that a manifest states, by name."""

    def __init__(self, source: Source, stated: Sequence[CameraTable], targets: Sequence[TargetTable]):
        self._source = source
        self.cameras = {table.name: table for table in stated}
        self.targets = {table.name: table for table in targets}
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
            points = {} if table.file is None else _points_of(self._source, table)
            return target_of(**table.keys, **points)

    def camera(self, name: str) -> Camera:
        """A camera; one without a table is a pinhole whose intrinsics are unknown."""
        table = self.cameras.get(name, CameraTable(name=name))
        if self.cameras and name not in self.cameras:
            raise InputError(f"the camera '{name}' has no [[camera]]{nearest(name, self.cameras)}")
        with naming(f"[[camera]] '{name}'"):
            return _stated_camera(self._source, table)


def _points_of(source: Source, table: TargetTable) -> dict[str, Any]:
    """Ids and coordinates, mm, of a table of points."""
    text = source.table(str(table.file), decimal=None, tables=as_list(table.table or []))
    ids = text.numbers(text.pick(as_list(table.columns.get("id", "id"))))[:, 0]
    picked = text.pick(as_list(table.columns.get("points", ["x", "y", "z"])))
    if len(picked) != 3:
        raise InputError(f"{text.path}: {len(picked)} columns are picked for x, y and z; pick 3.")
    unit = checked_unit(
        text.path, "points", text.unit(picked, key="points"), table.units.get("points"), "mm", LENGTH_UNITS
    )
    return {"ids": ids, "points": text.numbers(picked) * LENGTH_UNITS[unit or "mm"]}


def _stated_camera(source: Source, table: CameraTable) -> Camera:
    """A camera as its table, or the file that it names, describes it."""
    models, size = camera_models(), None if table.image_size is None else (table.image_size[0], table.image_size[1])
    name, values = table.model or "pinhole", None
    if table.file is not None:
        stored = read_camera(source.open(table.file))
        if table.model not in (None, stored.model):
            raise InputError(
                f"model is '{table.model}', but {table.file} describes a '{stored.model}'; correct one of the two."
            )
        if size and stored.image_size and size != stored.image_size:
            raise InputError(
                f"image_size is {by(size)}, but {table.file} is for images of {by(stored.image_size)} px; correct one "
                "of the two."
            )
        name, values, size = stored.model, stored.values, size or stored.image_size
    if name not in models:
        raise InputError(f"model = '{name}' is not a camera model{nearest(name, models)}")
    if table.intrinsics is not None:
        values = _by_name(table.intrinsics, models[name], table.coefficients)
    u: Any = 0.0 if table.u == "exact" else None
    if isinstance(table.u, dict) and values is not None:
        names = models[name].names[: len(values)]
        _check_names("u", table.u, names)
        u = [table.u.get(key, 0.0) for key in names]
    return Camera(table.name, name, values, u, size, table.coefficients)


def _by_name(stated: Mapping[str, float], model: AbstractCamera, coefficients: int | None) -> Float[np.ndarray, " k"]:
    """Intrinsics in the order of the model: those that are not stated are 0."""
    _check_names("intrinsics", stated, model.names)
    missing = [key for key in ("fx", "fy", "cx", "cy") if key in model.names and key not in stated]
    if missing:
        raise InputError(f"intrinsics has no {shorten(missing)}; give at least fx, fy, cx and cy, in px.")
    last = max(model.names.index(key) for key in stated) + 1
    least = last if coefficients is None else 4 + coefficients
    count = next((count for count in model.counts if count >= max(last, least)), model.counts[-1])
    return np.array([stated.get(key, 0.0) for key in model.names[:count]])


def _check_names(what: str, given: Iterable[str], names: Sequence[str]) -> None:
    unknown = next((key for key in given if key not in names), None)
    if unknown is not None:
        raise InputError(f"{what} has no '{unknown}'{nearest(unknown, names)}")


def by(size: Sequence[float]) -> str:
    """A size in words."""
    return f"{size[0]:g} x {size[1]:g}"


def observations_of(
    cameras: Cameras, source: Source, entry: PixelsTable, values: Mapping[str, str], detecting: Detecting
) -> tuple[list[tuple[str, Pixels]], list[ReadImage]]:
    """The observations of a table, one for each session and group, and what was found in each image."""
    name = fill(entry.name or entry.camera, values)
    where = f"[[pixels]] '{name}'"
    with naming(where):
        target, camera = cameras.target(fill(entry.target, values)), cameras.camera(fill(entry.camera, values))
    taken = list(parts(source, _Poses, entry, values, where))
    with naming(where):
        seen = [_checked(image, camera, target) for image in _seen(source, entry, values, target, camera, detecting)]
        read: list[ReadImage] = []
        observed: list[tuple[str, Pixels]] = []
        for part in taken:
            wanted = part.rows["image"].tolist() if "image" in part.rows else None
            if wanted is None and len(taken) > 1:
                raise InputError(
                    "readings of several sessions or groups need a column 'image' with the names of the images."
                )
            q = part.rows["q"]
            images = [
                Seen("", *NO_CORNERS, "no corners are listed for this pose") if i < 0 else seen[i]
                for i in matched([image.label for image in seen], wanted, len(q))
            ]
            of_group = name if entry.group is None else f"{name}/{part.group}"
            named = "/".join(filter(None, (part.session, of_group)))
            read += [_read(named, image, image.refused) for image in images]
            used = [i for i, image in enumerate(images) if not image.refused]
            _check_once(q, images, used)
            if not used:
                labels: dict[str, list[str]] = {}
                for image in images:
                    labels.setdefault(image.refused, []).append(quoted(image.label))
                reasons = [f"{shorten(of_reason, 1)}: {reason}" for reason, of_reason in labels.items()]
                raise InputError(f"no image can be used ({shorten(reasons, 3)}); take other images, or correct these.")
            chosen = [images[i] for i in used]
            observed.append((part.session, _pixels(of_group, entry, camera, target, q[used], chosen)))
    named_images = {image.image for image in read}
    others = [image for image in seen if image.label not in named_images]
    return observed, [*read, *(_read(name, image, "no row of the readings names it") for image in others)]


def _read(observation: str, image: Seen, refused: str) -> ReadImage:
    return ReadImage(observation, image.label, len(image.ids), refused, image.preview)


def _seen(
    source: Source, entry: PixelsTable, values: Mapping[str, str], target: AbstractTarget, camera: Camera,
    detecting: Detecting,
) -> list[Seen]:  # fmt: skip
    """The corners of each image: detected, or read from a table."""
    if entry.corners is not None:
        file, dimension = fill(entry.corners, values), camera_models()[camera.model].dimension
        if file.lower().endswith(".json"):
            return corners_of_json(source.open(file), target, dimension)
        named = as_list(entry.corner_table or (entry.table if file in entry.paths else None) or [])
        text = source.table(file, decimal=None, tables=named, corners=dimension)
        return corners_of_table(text, dimension, entry.corner_columns)
    pattern = fill(str(entry.images), values)
    size = None if camera.image_size is None else tuple(int(number) for number in camera.image_size)
    found, key = {} if detecting.found is None else detecting.found, (pattern, fill(entry.target, values), size)
    if key not in found:
        found[key] = _detected(source, pattern, target, size, detecting)
    return found[key]


def _detected(
    source: Source, pattern: str, target: AbstractTarget, size: tuple[int, ...] | None, detecting: Detecting
) -> list[Seen]:
    """The corners that images show."""
    from ..camera.detection import detect, overlay, preview, read_image

    paths = [Path(path) for path in glob.glob(str(Path(glob.escape(str(source.folder))) / pattern), recursive=True)]
    beside = [path.relative_to(source.folder) if path.is_relative_to(source.folder) else path for path in paths]
    names = natural_order([name.as_posix() for name, path in zip(beside, paths, strict=True) if path.is_file()])
    if not names:
        raise InputError(f"no image matches '{pattern}' in {source.folder}; check the path.")
    seen = []
    for name in detecting.progress(names, "Detecting corners"):
        try:
            image = read_image(source.open(name))
        except InputError as error:  # one of many
            seen.append(Seen(name, *NO_CORNERS, str(error).rpartition(f"{name} ")[2].partition(";")[0]))
            continue
        found = detect(image, target, image_size=size)
        if detecting.overlays is not None:
            detecting.overlays.mkdir(parents=True, exist_ok=True)
            # Images of several folders may have the same name.
            with write_atomically(detecting.overlays / f"{name.replace('/', '_')}.jpg") as path:
                path.write_bytes(overlay(image, found))
        small = base64.b64encode(preview(image)).decode()
        seen.append(Seen(name, found.ids, found.corners, found.refused, found.size, small))
    return seen


def _checked(image: Seen, camera: Camera, target: AbstractTarget) -> Seen:
    """The same image, refused where it has too few corners. Raises `InputError` for what no image may have."""
    label = f"image {quoted(image.label)}"
    unknown = sorted(set(image.ids.tolist()) - set(target.ids.tolist()))
    if unknown:
        raise InputError(
            f"{label} has the point id {unknown[0]}, which the target does not have (it has {target.ids.min()} to "
            f"{target.ids.max()}); correct the target, or the ids."
        )
    ids, counts = np.unique(image.ids, return_counts=True)
    if len(ids) < len(image.ids):
        raise InputError(
            f"{label} has the point id {ids[counts.argmax()]} twice; give one row for each corner, and one image for "
            "each pose."
        )
    return image._replace(refused=image.refused or _why_useless(image, camera, target))


def _why_useless(image: Seen, camera: Camera, target: AbstractTarget) -> str:
    """Why the corners of an image show no view of a target; empty where they do."""
    if len(image.ids) < _FEWEST:
        return f"only {len(image.ids)} corners were found; at least {_FEWEST} are needed"
    points = target.points_of(image.ids)
    if on_one_line(points):
        return f"its {len(points)} corners are on one line"
    if _is_misread(image, camera, points):
        return (
            "its corners are not where the target has them: it is another target, its rows and columns are exchanged, "
            "or the ids are in another order"
        )
    if target.kind != "points" and image.corners.shape[1] == 2 and is_mirrored(points[:, :2], image.corners):
        return "the board is seen from behind: the image is mirrored, or the ids are counted in another order"
    return ""


def _is_misread(image: Seen, camera: Camera, points: Float[np.ndarray, "k 3"]) -> bool:
    """Whether corners that somebody detected cannot be those of these points; those detected here were checked."""
    if image.size is not None or image.corners.shape[1] != 2:
        return False
    corners = image.corners
    size = corners.max(axis=0) + 1 if camera.image_size is None else np.asarray(camera.image_size)
    apart = np.linalg.norm(corners[:, None] - corners, axis=2) + np.diag(np.full(len(corners), np.inf))
    misfit = np.median(misfits(points, corners, tuple(size.tolist())))
    return bool(misfit > _MISREAD * np.median(apart.min(axis=1)))


def _check_once(q: Float[np.ndarray, "m n"], images: Sequence[Seen], used: Sequence[int]) -> None:
    """Raise `InputError` where two images have the same readings: the arm's errors are the same in both."""
    first: dict[bytes, int] = {}
    for i in used:
        other = first.setdefault(q[i].tobytes(), i)
        if other != i:
            raise InputError(
                f"the images {quoted(images[other].label)} and {quoted(images[i].label)} have the same joint readings "
                f"(rows {other + 1} and {i + 1}); give one image for each pose."
            )


def _pixels(
    name: str, entry: PixelsTable, camera: Camera, target: AbstractTarget, q: Float[np.ndarray, "m n"],
    images: Sequence[Seen],
) -> Pixels:  # fmt: skip
    """The observation of these poses."""
    if camera.image_size is None:
        camera = camera._replace(image_size=next((image.size for image in images if image.size), None))
    counts = [len(image.ids) for image in images]
    ids, corners = (np.concatenate([getattr(image, key) for image in images]) for key in ("ids", "corners"))
    table = CornerTable(
        np.repeat(np.arange(len(images)), counts), ids, corners, entry.u, [image.label for image in images]
    )
    return pixels_of(name, q, table, target, camera, board=entry.target, on_arm=entry.on_arm == "camera")
