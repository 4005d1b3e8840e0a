"""The manifest of points instead of poses, for acceptance tests of arms that report coordinates."""

import os
from pathlib import Path

import numpy as np

from ..acceptance.results import Measured
from ..core.errors import InputError, nearest
from ..core.units import LENGTH_UNITS
from ..kinematics.workspace import Reach
from .inputs import InputFile, fingerprint
from .manifest import PointsManifest, recorded
from .outputs import as_path
from .text_table import read_numbers
from .toml import read_toml


def read_points(path: str | os.PathLike) -> Measured:
    """Read a manifest of points and every file that it names; paths are relative to the manifest.

    ``[points]`` has ``unit`` (mm, m, um, inch), optionally ``columns``, the ``measuring_range`` that the maker states
    (a diameter, mm), and, for the zones of ASME B89.4.22, the arm's ``reach`` and ``shoulder`` (x, y, z) in mm.
    ``[[socket]]``, ``[[length]]`` and ``[[sphere]]`` are those of `read_manifest`, with files of x, y, z.

    Args:
        path: the manifest (TOML).

    Returns:
        The measured points, mm.

    Raises:
        InputError: names the file, the place in it and what to do.

    Example:
        >>> from pathlib import Path
        >>> np.savetxt("near.csv", true.position(capture.sockets["A"]), delimiter=",")
        >>> _ = Path("points.toml").write_text('''[points]
        ... unit = "mm"
        ... [[socket]]
        ... name = "near"
        ... file = "near.csv"
        ... ''')
        >>> print(aj.files.read_points("points.toml").sockets["near"].shape)
        (40, 3)
    """
    path = as_path(path)
    model = read_toml(manifest := InputFile(path), PointsManifest)
    try:
        files = [manifest]

        def points(file: Path, _: float | None) -> np.ndarray:
            files.append(read := InputFile(file))
            table = read_numbers(read, model.points.columns)
            if table.shape[1] != 3:
                raise InputError(
                    f"{file} has {table.shape[1]} columns; give x, y and z, or pick three with columns = [...] in "
                    "[points]."
                )
            return table * LENGTH_UNITS[model.points.unit]

        sockets, lengths, spheres, _ = recorded(path.parent, model, points)
        for length in lengths:
            for end in (length.start, length.end):
                if end not in sockets:
                    raise InputError(
                        f"length '{length.start}' to '{length.end}' names the unknown socket '{end}'"
                        f"{nearest(end, sockets)}"
                    )
        if not sockets and not spheres:
            raise InputError("there is neither a [[socket]] nor a [[sphere]], so nothing can be tested; add one.")
        reach = None if model.points.reach is None else Reach(np.array(model.points.shoulder), model.points.reach)
        sources = tuple(fingerprint(file, path.parent) for file in files)
        return Measured(
            sockets,
            tuple(lengths),
            spheres,
            reach,
            sources=sources,
            measured=str(model.date or ""),
            measuring_range=model.points.measuring_range,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
