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


def angles_toml(explanation: Explanation, unit: str | None, manifest: str | os.PathLike | None = None) -> str:
    """The lines that make a manifest read the columns as an explanation has them.

    Args:
        explanation: The explanation, of the readings as they were read.
        unit: Unit that they were read in; None: as the manifest or the header of its tables says.
        manifest: The manifest that they were read with, whose columns, signs and offsets are taken into account.
    """
    order, joints = list(explanation.order), len(explanation.order)
    exchanged = order != sorted(order)
    numbers, stated, tables = list(range(1, joints + 1)), None, []
    as_read = Angles(unit=unit or "rad")  # pyright: ignore[reportArgumentType]
    if manifest is not None:
        model, readings = read_toml(InputFile(as_path(manifest)), manifest_model()), readings_of_manifest(manifest)
        numbers, stated, as_read = readings.columns, model.angles, readings.angles or as_read
        lists = [(key, part) for key, part in model if isinstance(part, list)]
        tables = [(key, table) for key, part in lists for table in part if isinstance(table, Table)]
    # Columns that a table states for itself are not replaced by those of [angles].
    of_tables = [(key, table) for key, table in tables if _reading_columns(table) is not None]
    counts = as_read.counts_per_turn if explanation.angle == 1 else None
    entries: dict[str, Any] = {"unit": as_read.unit, "counts_per_turn": _ordered(counts, order)}
    if explanation.angle != 1:
        entries["unit"] = "deg" if explanation.angle < 1 else "rad"
    if as_read.linear_unit != "mm":
        entries["linear_unit"] = as_read.linear_unit
    entries["counts_per_mm"] = _ordered(as_read.counts_per_mm, order)
    if (exchanged and (not tables or len(of_tables) < len(tables))) or (stated is not None and stated.columns):
        entries["columns"] = _picked(None if stated is None else stated.columns, numbers, order)
    sign, offset = (np.broadcast_to(np.asarray(x, float), joints)[order] for x in (as_read.sign, as_read.offset))
    size = ANGLE_UNITS[entries["unit"]] if counts is None else 2 * np.pi / np.broadcast_to(counts, joints)[order]
    sign = np.array(explanation.signs) * sign
    offset = offset - sign * np.array(explanation.offsets) / size
    entries["sign"] = _plain(sign) if np.any(sign < 0) else None
    entries["offset"] = _plain(np.round(offset, 9)) if np.any(offset) else None
    lines = ["[angles]", *(f"{key} = {_text(value)}" for key, value in entries.items() if value is not None)]
    if exchanged:
        lines += dict.fromkeys(_columns_line(key, table, numbers, order) for key, table in of_tables)
    return "\n".join(lines) + "\n"


def _reading_columns(table: Table) -> Any:
    """The columns of the readings that a table states, or None."""
    return table.columns.get("q") if isinstance(table.columns, dict) else table.columns


def _columns_line(key: str, table: Table, numbers: list[int], order: list[int]) -> str:
    """The columns of a table in another order, as a comment that says where they belong."""
    picked = _picked(_reading_columns(table), numbers, order)
    columns = _text(picked)
    if isinstance(table.columns, dict):
        columns = ", ".join(f"{name} = {_text(value)}" for name, value in (table.columns | {"q": picked}).items())
        columns = f"{{ {columns} }}"
    return f"# and in [[{key}]] ({table.paths[0]}), instead of its columns:\n# columns = {columns}"


def _picked(stated: Any, numbers: list[int], order: list[int]) -> list:
    """Columns in another order: those that were stated one by one, or their numbers."""
    columns = stated if isinstance(stated, list) and len(stated) == len(order) else numbers
    return [columns[i] for i in order]


def _ordered(stated: Any, order: list[int]) -> Any:
    """Numbers that are stated by joint, in another order."""
    return None if stated is None else _plain(np.asarray(stated, float)[order] if np.ndim(stated) else stated)


def _plain(values: Any) -> Any:
    """Numbers as people write them: whole ones without a point."""
    if np.ndim(values):
        return [_plain(value) for value in values]
    return round(values) if values == round(values) else float(values)


def _text(value: Any) -> str:
    """A number, a name, or a list of them, in TOML."""
    import tomlkit

    return tomlkit.item(value).as_string()


def positions_unit(manifest: str | os.PathLike | None) -> str:
    """The unit in which a manifest takes the positions that an instrument measured, by default mm."""
    if manifest is None:
        return "mm"
    model = read_toml(InputFile(as_path(manifest)), manifest_model())
    tables = [*getattr(model, "points", ()), *getattr(model, "transforms", ())]
    stated = next((table.units["points"] for table in tables if "points" in table.units), "mm")
    return stated if stated in LENGTH_UNITS else "mm"


def units_toml(explanation: Explanation, positions: str) -> str | None:
    """The line that makes the table of a manifest read positions in the right unit; None: none is needed.

    Args:
        explanation: The explanation, of the positions as they were read.
        positions: The unit in which they were read.
    """
    unit = length_unit(explanation.length * LENGTH_UNITS[positions])
    return None if explanation.length == 1 or unit is None else f'units = {{ points = "{unit}" }}\n'
