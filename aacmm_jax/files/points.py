"""The manifest of points instead of poses, for acceptance tests of arms that report coordinates."""

import os

import numpy as np

from ..acceptance.results import Measured
from ..core.errors import InputError, naming, nearest
from ..core.units import LENGTH_UNITS
from ..kinematics.workspace import Reach
from .inputs import InputFile, InputFiles
from .manifest import PointsManifest, read_recorded
from .manifest_observations import Source
from .manifest_tables import Wanted, as_list, checked_unit
from .outputs import as_path
from .table_columns import LINE, position_columns, proposed_columns
from .text_lines import TABLE_SHARE
from .text_table import TextTable
from .toml import read_toml


def read_points(path: str | os.PathLike) -> Measured:
    """Read a manifest of points and every file that it names; paths are relative to the manifest.

    ``[points]`` has ``unit`` (mm, m, um, inch; by default that of the header), optionally ``columns`` of x, y and z,
    the ``measuring_range`` that the maker states (a diameter, mm), and, for the zones of ASME B89.4.22, the arm's
    ``reach`` and ``shoulder`` (x, y, z) in mm. ``[[socket]]``, ``[[length]]`` and ``[[sphere]]`` are those of
    `read_manifest`, with files of x, y, z: columns of these names, or the only three.

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
    with naming(path):
        files = InputFiles(manifest, TABLE_SHARE)

        def points(text: TextTable, wanted: Wanted) -> np.ndarray:
            return _points(text, wanted, model)

        seated, lengths, spheres = read_recorded(model, Source(path.parent, files.open, "points", points))
        sockets = {name: socket.poses for name, socket in seated.items()}
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
        return Measured(
            sockets,
            tuple(lengths),
            spheres,
            reach,
            sources=files.sources(path.parent),
            measured=str(model.date or ""),
            measuring_range=model.points.measuring_range,
        )


def _points(text: TextTable, wanted: Wanted, model: PointsManifest) -> np.ndarray:
    """The points of a table, mm."""
    columns = wanted.columns
    if columns is None and model.points.columns is not None:
        columns = as_list(model.points.columns)
    named = position_columns(text) if columns is None else None
    if columns is not None:
        picked = text.pick(columns)
    elif named is not None:
        picked = named[0]
    else:
        picked = [i for i in range(text.width) if i not in wanted.taken]
        text.check_ascending(picked)
    if len(picked) != 3:
        line = LINE.format(", ".join(str(i + 1) for i in proposed_columns(text, 3, wanted.taken)) or "...")
        raise InputError(
            f"{text.path} has {text.shown()}, and it is not clear which of them are x, y and z; add {line} with these "
            "three."
        )
    header = text.unit(picked, key="points") if named is None else named[1]
    unit = checked_unit(text.path, "points", header, wanted.unit or model.points.unit, wanted.usual_unit, LENGTH_UNITS)
    if unit is None:
        raise InputError(f'{text.path} does not say the unit of its points; add unit = "mm" to [points].')
    return text.numbers(picked, measured=True, stated=columns is not None) * LENGTH_UNITS[unit]
