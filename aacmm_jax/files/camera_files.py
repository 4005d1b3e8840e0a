"""Cameras and their mounts as other programs write and read them: ROS ``camera_info``, OpenCV's ``FileStorage``, URDF.

Both YAML formats, and JSON, hold a camera matrix, distortion coefficients and the size of the images; only their names
differ. The coefficients have OpenCV's order.
"""

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError, naming
from ..core.rotations import roll_pitch_yaw
from ..core.text import is_number, quoted
from .inputs import InputFile
from .yaml_text import yaml_content

_MATRIX = ("camera_matrix", "cameramatrix", "intrinsic_matrix", "mtx", "k")
_DISTORTION = ("distortion_coefficients", "dist_coeffs", "distcoeffs", "distortion", "dist", "d")
_SIZES = (("image_width", "image_height"), ("width", "height"))
_FISHEYE = ("equidistant", "fisheye")
_ROS_MODELS = {0: "plumb_bob", 4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}  # by number of coefficients
_MOST = 200_000  # characters


class StoredCamera(NamedTuple):
    """A camera as a file describes it."""

    model: str  # pinhole or fisheye
    values: Float[np.ndarray, " k"]  # fx, fy, cx, cy, px, and the distortion coefficients
    image_size: tuple[int, int] | None  # width, height, px


def read_camera(path: str | os.PathLike) -> StoredCamera:
    """A camera from a ROS ``camera_info`` (YAML) or from OpenCV's ``FileStorage`` (YAML, JSON). Raises `InputError`."""
    text = InputFile(path).text
    with naming(path):
        if len(text) > _MOST:
            raise InputError(f"the file has more than {_MOST:,} characters; give the file of one camera.")
        entries = {key.lower(): value for key, value in _content(text).items()}
        matrix = _numbers(entries, _MATRIX, "camera matrix")
        if matrix.size != 9:
            raise InputError(f"the camera matrix has {matrix.size} numbers; give 3 x 3.")
        matrix = matrix.reshape(3, 3)
        if (
            matrix[0, 1]
            or matrix[1, 0]
            or not np.array_equal(matrix[2], [0, 0, 1])
            or min(matrix[0, 0], matrix[1, 1]) <= 0
        ):
            raise InputError("the camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1] with positive fx and fy; correct it.")
        distortion = _numbers(entries, _DISTORTION, "distortion coefficients")
        words = str(entries.get("distortion_model", "")).lower()
        fisheye = words in _FISHEYE or str(entries.get("fisheye_model", "0")) in ("1", "true")
        values = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *_used(distortion, fisheye)])
        return StoredCamera("fisheye" if fisheye else "pinhole", values, _size(entries))


def _used(distortion: Float[np.ndarray, " k"], fisheye: bool) -> Float[np.ndarray, " k"]:
    """The coefficients without zeros at the end that the models of this package do not have."""
    count = len(distortion)
    possible = (4,) if fisheye else (0, 4, 5, 8)
    most = next((n for n in reversed(possible) if n <= count), 0)
    kept = count if count in possible else most
    if np.any(distortion[kept:]) or count not in (*possible, 12, 14):
        raise InputError(
            f"the camera has {count} distortion coefficients; give {', '.join(map(str, possible))} "
            f"({'fisheye' if fisheye else 'pinhole'})."
        )
    return distortion[:kept]


def _size(entries: Mapping[str, Any]) -> tuple[int, int] | None:
    for names in _SIZES:
        width, height = (entries.get(name) for name in names)
        if width is not None and height is not None:
            if not all(is_number(str(side)) and float(side) == int(float(side)) > 0 for side in (width, height)):
                raise InputError(f"the image size {width} x {height} is not two positive whole numbers; correct it.")
            return int(float(width)), int(float(height))
    return None


def _numbers(entries: Mapping[str, Any], names: Sequence[str], what: str) -> np.ndarray:
    """The numbers of the first entry with one of these names."""
    name = next((name for name in names if name in entries), None)
    if name is None:
        raise InputError(f"the file has no {what} (such as '{names[0]}'); give a camera_info or OpenCV file.")
    value = entries[name]
    value = value.get("data") if isinstance(value, Mapping) else value
    texts = [str(number) for number in _flat(value if isinstance(value, list) else [value])]
    wrong = next((text for text in texts if not is_number(text) or not math.isfinite(float(text))), None)
    if wrong is not None:
        raise InputError(f"'{name}' contains {quoted(wrong)}, which is not a number; correct it.")
    return np.array([float(text) for text in texts])


def _flat(items: Sequence[Any]) -> list[Any]:
    return [x for item in items for x in (_flat(item) if isinstance(item, list) else [item])]


def _content(text: str) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):  # not JSON, which looks like a table of YAML in braces
        return yaml_content(text)
    if not isinstance(content, dict):
        raise InputError("the file has no names of values; give a camera_info or OpenCV file.")
    return content


def camera_info_yaml(name: str, camera: StoredCamera) -> str:
    """A ROS ``camera_info`` of a camera, as ``camera_calibration_parsers`` reads it. Raises `InputError` where the size
    of the images is unknown."""
    fx, fy, cx, cy, *distortion = map(float, camera.values)
    if camera.image_size is None:
        raise InputError(f"the image size of camera '{name}' is unknown; state image_size in [[camera]].")
    coefficients = distortion or [0.0] * 5
    model = "equidistant" if camera.model == "fisheye" else _ROS_MODELS[len(distortion)]
    if model == "plumb_bob":
        coefficients = [*coefficients, 0.0][:5]
    matrices = {
        "camera_matrix": (3, 3, [fx, 0, cx, 0, fy, cy, 0, 0, 1]),
        "distortion_coefficients": (1, len(coefficients), coefficients),
        "rectification_matrix": (3, 3, np.eye(3).ravel()),
        "projection_matrix": (3, 4, [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]),
    }
    lines = [
        f"image_width: {camera.image_size[0]}",
        f"image_height: {camera.image_size[1]}",
        f"camera_name: {_word(name)}",
    ]
    for key, (rows, columns, data) in matrices.items():
        if key == "distortion_coefficients":
            lines.append(f"distortion_model: {model}")
        lines += [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{_listed(data)}]"]
    return "\n".join(lines) + "\n"


def transform_storage(parent: str, child: str, transform: Float[np.ndarray, "4 4"]) -> str:
    """A transform as OpenCV's ``FileStorage`` (YAML): 4 x 4 matrix, and rotation and translation (mm) alone."""
    lines = ["%YAML:1.0", "---", f"parent: {_word(parent)}", f"child: {_word(child)}"]
    parts = {"transform": transform, "rotation": transform[:3, :3], "translation_mm": transform[:3, 3:]}
    for key, matrix in parts.items():
        rows, columns = matrix.shape
        lines += [f"{key}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"]
        lines.append(f"   data: [ {_listed(matrix.ravel())} ]")
    return "\n".join(lines) + "\n"


def joint_origin(parent: str, child: str, transform: Float[np.ndarray, "4 4"]) -> str:
    """A fixed joint of a URDF between two links: m and rad."""
    xyz, rpy = transform[:3, 3] / 1000, roll_pitch_yaw(transform[:3, :3])
    return (
        f'<joint name="{_word(parent)}_to_{_word(child)}" type="fixed">\n  <parent link="{_word(parent)}"/>\n'
        f'  <child link="{_word(child)}"/>\n  <origin xyz="{_listed(xyz, " ")}" rpy="{_listed(rpy, " ")}"/>\n</joint>\n'
    )


def static_transform(parent: str, child: str, transform: Float[np.ndarray, "4 4"]) -> str:
    """The command that publishes a transform in ROS 2: m, quaternion."""
    from scipy.spatial.transform import Rotation

    values = [*(transform[:3, 3] / 1000), *Rotation.from_matrix(transform[:3, :3]).as_quat()]
    options = " ".join(
        f"--{name} {_listed([value])}"
        for name, value in zip(("x", "y", "z", "qx", "qy", "qz", "qw"), values, strict=True)
    )
    frames = f"--frame-id {_word(parent)} --child-frame-id {_word(child)}"
    return f"ros2 run tf2_ros static_transform_publisher {options} {frames}\n"


def matrix_text(parent: str, child: str, transform: Float[np.ndarray, "4 4"]) -> str:
    """A transform as four lines of four numbers, mm, below a comment."""
    return f"# {_word(child)} in {_word(parent)}, mm\n" + "".join(f"{_listed(row, ' ')}\n" for row in transform)


def _word(name: str) -> str:
    """A name without blanks and characters that mean something in these files."""
    return re.sub(r"[^\w.-]+", "_", name)


def _listed(values: Sequence[float] | np.ndarray, separator: str = ", ") -> str:
    return separator.join(repr(float(f"{value:.12g}") + 0.0) for value in values)
