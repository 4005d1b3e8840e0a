"""Corners that somebody has detected already: a text table with a row for each, or JSON with nested lists."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import InputError
from ..core.text import is_number, quoted
from ..data.targets import AbstractTarget
from .inputs import InputFile
from .manifest_files import Picked, as_list
from .text_lines import Column
from .text_table import TextTable

_NAMES: dict[str, Sequence[Sequence[Column]]] = {
    "image": (["image"], ["pose"], ["file"], ["filename"], ["frame"]),
    "id": (["id"], ["point_id"], ["corner_id"], ["corner"], ["point"]),
}
_AXES: dict[int, Sequence[Sequence[Column]]] = {
    2: (["u", "v"], ["u_px", "v_px"], ["x_px", "y_px"], ["x", "y"], ["px", "py"]),
    3: (["x", "y", "z"], ["x_mm", "y_mm", "z_mm"]),
}
_LISTS = {
    "corners": ("corners", "image_points", "imgpoints", "points_2d"),
    "ids": ("ids", "point_ids", "charuco_ids"),
    "points": ("object_points", "objpoints", "points_3d"),
    "images": ("images", "names", "files", "image", "name", "file"),
}
NO_CORNERS = (np.zeros(0, dtype=int), np.zeros((0, 2)))
_SAME = 1e-3  # of the size of the target, between an object point and the point of the target that it is


class Seen(NamedTuple):
    """What is known of one image."""

    label: str  # name of its file, or number of its pose
    ids: Int[np.ndarray, " k"]
    corners: Float[np.ndarray, "k d"]
    refused: str = ""  # why it is not used
    size: tuple[int, int] | None = None  # width, height, px
    preview: str | None = None  # small picture (JPEG, base64)


def corners_of_table(text: TextTable, dimensions: int, columns: Mapping[Any, Picked]) -> list[Seen]:
    """The corners of each image, in the order of a table with the columns image, id, u, v (or x, y, z).

    Args:
        text: the table.
        dimensions: of a corner: 2, or 3 of a camera that measures points.
        columns: where the names of the columns are others: image, id, corners.
    """
    file = text.path
    choices = _NAMES | {"corners": _AXES[dimensions]}
    picked: dict[str, Sequence[Column]] = {}
    for key, names in choices.items():
        stated = as_list(columns[key]) if key in columns else next((list(x) for x in names if text.has(x)), None)
        if stated is None:
            what = "corners = [...]" if key == "corners" else f'{key} = "..."'
            raise InputError(
                f"{file} has {text.shown()}, but no column {' or '.join(str(name[0]) for name in names)}; state it "
                f"with corner_columns = {{ {what} }}."
            )
        picked[key] = stated
    indices = text.pick(picked["corners"])
    if len(indices) != dimensions:
        raise InputError(f"{file}: {len(indices)} columns are picked for the corners; pick {dimensions}.")
    labels, ids = text.texts(picked["image"][0]), text.numbers(text.pick(picked["id"]))[:, 0]
    corners = text.numbers(indices)
    if np.any(ids != np.round(ids)):
        raise InputError(f"{file} has the point id {ids[ids != np.round(ids)][0]:g}; ids are whole numbers.")
    images = dict.fromkeys(labels.tolist())
    return [Seen(label, ids[labels == label].astype(int), corners[labels == label]) for label in images]


def corners_of_json(file: InputFile, target: AbstractTarget, dimensions: int) -> list[Seen]:
    """The corners of each image in JSON with a list for each image; arguments as of `corners_of_table`, and the target
    that was seen."""
    text = file.text
    try:
        content: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file} is not valid JSON ({error}); correct the file.") from error
    if isinstance(content, list) and content and all(isinstance(record, dict) for record in content):
        content = {key: [record.get(key) for record in content] for key in content[0]}  # a record for each image
    content = (
        {str(key).lower(): value for key, value in content.items()}
        if isinstance(content, dict)
        else {"corners": content}
    )
    lists = {key: next((content[name] for name in names if name in content), None) for key, names in _LISTS.items()}
    if not isinstance(lists["corners"], list) or not lists["corners"]:
        raise InputError(f"{file} has no list of corners; give 'image_points' with one list for each image.")
    count = len(lists["corners"])
    for key, values in lists.items():
        if values is not None and (not isinstance(values, list) or len(values) != count):
            raise InputError(f"{file}: '{key}' is not a list of {count} items, one for each image; correct it.")
    labels = [str(name) for name in lists["images"] or range(1, count + 1)]
    seen = []
    for i, label in enumerate(labels):
        corners = _nested(file, label, lists["corners"][i], dimensions)
        if lists["ids"] is not None:
            ids = _nested(file, label, lists["ids"][i], 1)[:, 0].astype(int)
        elif lists["points"] is not None:
            ids = _ids_of(file, label, target, _nested(file, label, lists["points"][i], 3))
        else:
            ids = target.ids
        if len(ids) != len(corners):
            raise InputError(
                f"{file} image {quoted(label)} has {len(corners)} corners, but {len(ids)} points; give the ids of the "
                "points that were seen."
            )
        seen.append(Seen(label, ids, corners))
    return seen


def _nested(file: InputFile, label: str, value: Any, width: int) -> Float[np.ndarray, "k w"]:
    """Numbers in lists of any depth, as OpenCV's (N, 1, 2), row by row."""
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{file} image {quoted(label)} has corners or points that are not {width} numbers each; correct it."
        ) from error
    if numbers.size % width or not np.all(np.isfinite(numbers)):
        raise InputError(
            f"{file} image {quoted(label)} has corners or points that are not {width} finite numbers each; correct it."
        )
    return numbers.reshape(-1, width)


def _ids_of(
    file: InputFile, label: str, target: AbstractTarget, points: Float[np.ndarray, "k 3"]
) -> Int[np.ndarray, " k"]:
    """The ids of object points, which are those of the target."""
    nominal = np.asarray(target.points) / target.scale
    distances = np.linalg.norm(points[:, None] - nominal, axis=2)
    nearest = distances.argmin(axis=1)
    if np.any(distances.min(axis=1) > _SAME * np.ptp(nominal, axis=0).max()):
        raise InputError(
            f"{file} image {quoted(label)} has object points that the target does not have (in mm, in its frame); "
            "correct the target, or give ids."
        )
    return target.ids[nearest]


def matched(labels: Sequence[str], wanted: Sequence[str] | None, poses: int) -> list[int]:
    """For each pose the number of its image among the ``labels``; ``wanted`` are the names in the table of readings.

    Raises `InputError` where it is not clear which image belongs to which pose, or two poses share one.
    """
    if wanted is None:
        if all(map(is_number, labels)) and labels:
            first = 0 if "0" in labels else 1
            by_number = {int(float(label)) - first: i for i, label in enumerate(labels)}
            if len(by_number) == len(labels) and min(by_number) >= 0 and max(by_number) < poses:
                return [by_number.get(pose, -1) for pose in range(poses)]
        if len(labels) != poses:
            raise InputError(
                f"there are {len(labels)} images and {poses} poses; give one row of readings for each image, or a "
                "column 'image' with the names of the files."
            )
        return list(range(poses))
    keys: dict[str, list[int]] = {}
    for i, label in enumerate(labels):
        for key in {label, label.rpartition("/")[2], _stem(label)}:
            keys.setdefault(key, []).append(i)
    indices = []
    for row, name in enumerate(wanted, start=1):
        tail = name.replace("\\", "/").rpartition("/")[2]
        found = next((keys[key] for key in (name, tail, _stem(tail)) if key in keys), [])
        if len(found) != 1:
            many = f"{len(found)} images have this name" if found else "there is no such image"
            raise InputError(f"row {row} of the readings names the image {quoted(name)}, but {many}; correct it.")
        if found[0] in indices:
            raise InputError(
                f"rows {indices.index(found[0]) + 1} and {row} of the readings name the same image "
                f"{quoted(name)}; give one image for each pose."
            )
        indices.append(found[0])
    return indices


def _stem(name: str) -> str:
    return re.sub(r"\.\w+$", "", name.rpartition("/")[2])


def natural_order(names: Sequence[str]) -> list[str]:
    """Names in the order in which people count: img_2 before img_10."""
    return sorted(
        names, key=lambda name: [(int(x), "") if x.isdecimal() else (-1, x) for x in re.split(r"(\d+)", name)]
    )
