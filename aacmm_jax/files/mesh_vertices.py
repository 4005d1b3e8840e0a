"""The vertices of mesh files, STL and OBJ, without their faces: enough for a shape that contains the mesh."""

import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from .inputs import InputFile

_HEADER, _TRIANGLE = 84, 50  # bytes of a binary STL: before the triangles, and of each


def mesh_path(file: str, folder: Path) -> Path | None:
    """The file that a URDF in a folder names, or None where it is not at hand.

    ``package://NAME/...`` is looked for beside the folder and its parents, as packages are laid out.
    """
    if file.startswith("package://"):
        package, _, rest = file.removeprefix("package://").partition("/")
        whole = folder.absolute()
        tried = [place for parent in (whole, *whole.parents) for place in (parent / package / rest,)]
        tried += [parent / rest for parent in (whole, *whole.parents) if parent.name == package]
    else:
        # In a URL, a slash stands before the letter of a drive: file:///C:/arm.stl.
        tried = [folder / re.sub(r"^/(?=[A-Za-z]:)", "", file.removeprefix("file://"))]
    return next((path for path in tried if path.is_file()), None)


def mesh_vertices(path: str | os.PathLike) -> Float[np.ndarray, "m 3"]:
    """The vertices of an STL (binary or text) or OBJ file, in the file's own unit.

    Raises:
        InputError: It is of another format, or holds no vertices.
    """
    content, suffix = InputFile(path).content, os.path.splitext(os.fspath(path))[1].lower()
    try:
        if suffix == ".obj":
            found = _numbers_after(content, b"v")
        elif suffix == ".stl":
            found = _of_stl(content)
        else:
            raise InputError(f"{path} is neither STL nor OBJ, whose vertices alone are read.")
    except ValueError as error:
        raise InputError(f"{path} has a vertex that is no three numbers; export the mesh again.") from error
    if not len(found) or not np.all(np.isfinite(found)):
        raise InputError(f"{path} has no vertices, or some that are not finite; export the mesh again.")
    return np.unique(found, axis=0)


def _of_stl(content: bytes) -> Float[np.ndarray, "m 3"]:
    count = int.from_bytes(content[_HEADER - 4 : _HEADER], "little")
    if len(content) == _HEADER + count * _TRIANGLE:  # also of binary files whose header begins with "solid"
        triangles = np.frombuffer(content, dtype=np.uint8, offset=_HEADER).reshape(count, _TRIANGLE)
        return triangles[:, 12:48].copy().view("<f4").reshape(-1, 3).astype(float)
    return _numbers_after(content, b"vertex")


def _numbers_after(content: bytes, word: bytes) -> Float[np.ndarray, "m 3"]:
    rows = (line.split() for line in content.splitlines())
    return np.array([[float(x) for x in row[1:4]] for row in rows if row and row[0] == word]).reshape(-1, 3)
