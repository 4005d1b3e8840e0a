"""What a check of the readings found, as the lines that a manifest needs: its table ``[angles]``, and ``units``."""

import os
from typing import Any

import numpy as np

from ..core.units import ANGLE_UNITS, LENGTH_UNITS, length_unit
from ..diagnostics.reading_fit import Explanation
from .inputs import InputFile
from .manifest import manifest_model, readings_of_manifest
from .manifest_angles import Angles
from .manifest_tables import Table
from .outputs import as_path
from .toml import read_toml


def angles_toml(found: Explanation, unit: str | None, manifest: str | os.PathLike | None = None) -> str:
    """The lines that make a manifest read the columns as an explanation has them.

    Args:
        found: The explanation, of the readings as they were read.
        unit: Unit that they were read in; None: as the manifest or the header of its tables says.
        manifest: The manifest that they were read with, whose columns, signs and offsets are taken into account.
    """
    joints, order = len(found.order), list(found.order)
    numbers, stated, as_read, own = list(range(1, joints + 1)), None, None, []
    everywhere = order != sorted(order)
    if manifest is not None:
        model = read_toml(InputFile(as_path(manifest)), manifest_model())
        readings = readings_of_manifest(manifest)
        numbers, stated, as_read = readings.columns, model.angles, readings.angles
        tables = [(key, table) for key, part in model for table in _tables(part)]
        own = [(key, table) for key, table in tables if _own_columns(table) is not None]
        everywhere = everywhere and len(own) < len(tables)
    if as_read is None:
        as_read = Angles(unit=unit or "rad")  # pyright: ignore[reportArgumentType]
    signs, offsets = (np.broadcast_to(np.asarray(x, float), joints) for x in (as_read.sign, as_read.offset))
    counts = None if found.angle != 1 else as_read.counts_per_turn
    unit = as_read.unit if found.angle == 1 else "deg" if found.angle < 1 else "rad"
    each = np.broadcast_to(np.asarray(counts or 0.0, float), joints)[order]
    size = 2 * np.pi / each if counts is not None else ANGLE_UNITS[unit]
    new_signs = np.array(found.signs) * signs[order]
    new_offsets = offsets[order] - new_signs * np.array(found.offsets) / size
    lines = ["[angles]", f'unit = "{unit}"']
    if counts is not None:
        lines.append(f"counts_per_turn = {_row(each) if np.ndim(counts) else _number(float(each[0]))}")
    if as_read.linear_unit != "mm":
        lines.append(f'linear_unit = "{as_read.linear_unit}"')
    if as_read.counts_per_mm is not None:
        lines.append(f"counts_per_mm = {_values(as_read.counts_per_mm, order)}")
    if everywhere or (stated is not None and stated.columns is not None):
        lines.append(f"columns = {_picked(None if stated is None else stated.columns, numbers, order)}")
    if np.any(new_signs < 0):
        lines.append(f"sign = {_row(new_signs)}")
    if np.any(new_offsets):
        lines.append(f"offset = {_row(np.round(new_offsets, 9))}")
    if order != sorted(order):
        lines += dict.fromkeys(_columns_line(key, table, numbers, order) for key, table in own)
    return "\n".join(lines) + "\n"


def _tables(part: Any) -> list[Table]:
    return [table for table in part if isinstance(table, Table)] if isinstance(part, list) else []


def _own_columns(table: Table) -> Any:
    """The columns of the readings that a table states for itself, which those of [angles] do not replace."""
    return table.columns.get("q") if isinstance(table.columns, dict) else table.columns


def _columns_line(key: str, table: Table, numbers: list[int], order: list[int]) -> str:
    """The columns of a table in another order, as a comment that says where they belong."""
    picked = _picked(_own_columns(table), numbers, order)
    if isinstance(table.columns, dict):
        others = {name: _text(value) for name, value in table.columns.items() if name != "q"}
        picked = f"{{ {', '.join(f'{name} = {text}' for name, text in {'q': picked, **others}.items())} }}"
    return f"# and in [[{key}]] ({table.paths[0]}), instead of its columns:\n# columns = {picked}"


def _picked(stated: Any, numbers: list[int], order: list[int]) -> str:
    """Columns in another order: those that were stated one by one, or their numbers."""
    columns = stated if isinstance(stated, list) and len(stated) == len(order) else numbers
    return _text([columns[i] for i in order])


def _text(value: Any) -> str:
    """A number, a name, or a list of them, in TOML."""
    import tomlkit

    return tomlkit.item(value).as_string()


def _values(stated: Any, order: list[int]) -> str:
    return _number(float(stated)) if np.ndim(stated) == 0 else _row(np.asarray(stated, float)[order])


def positions_unit(manifest: str | os.PathLike | None) -> str:
    """The unit in which a manifest takes the positions that an instrument measured, by default mm."""
    if manifest is None:
        return "mm"
    model = read_toml(InputFile(as_path(manifest)), manifest_model())
    tables = [*getattr(model, "points", ()), *getattr(model, "transforms", ())]
    stated = next((table.units["points"] for table in tables if "points" in table.units), "mm")
    return stated if stated in LENGTH_UNITS else "mm"


def units_toml(found: Explanation, positions: str) -> str | None:
    """The line that makes the table of a manifest read positions in the unit that was found; None: none is needed.

    Args:
        found: The explanation, of the positions as they were read.
        positions: The unit in which they were read.
    """
    unit = length_unit(found.length * LENGTH_UNITS[positions])
    return None if found.length == 1 or unit is None else f'units = {{ points = "{unit}" }}\n'


def _row(values: np.ndarray) -> str:
    return f"[{', '.join(_number(float(value)) for value in values)}]"


def _number(value: float) -> str:
    return str(round(value)) if value == round(value) else repr(value)
