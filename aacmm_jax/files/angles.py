"""What a check of the readings found, as the lines that a manifest needs: its table ``[angles]``, and ``units``."""

import os

import numpy as np

from ..core.units import ANGLE_UNITS, LENGTH_UNITS, length_unit
from ..kinematics.reading_fit import Explanation
from .inputs import InputFile
from .manifest import columns_of_readings, manifest_model
from .outputs import as_path
from .toml import read_toml


def angles_toml(found: Explanation, unit: str | None, manifest: str | os.PathLike | None = None) -> str:
    """The lines that make a manifest read the columns as an explanation has them.

    Args:
        found: The explanation, of the readings as they were read.
        unit: Unit that they were read in; None: as the manifest says.
        manifest: The manifest that they were read with, whose columns, signs and offsets are taken into account.
    """
    joints = len(found.order)
    columns, signs, offsets = np.arange(1, joints + 1), np.ones(joints), np.zeros(joints)
    counts, listed = None, False
    if manifest is not None:
        stated = read_toml(InputFile(as_path(manifest)), manifest_model()).angles
        if stated is not None:
            unit, counts, listed = stated.unit, stated.counts_per_turn, stated.columns is not None
            signs, offsets = (np.broadcast_to(np.asarray(x, float), joints) for x in (stated.sign, stated.offset))
        columns = np.array(columns_of_readings(manifest))
    order = list(found.order)
    if found.angle != 1:
        unit = "deg" if found.angle < 1 else "rad"
    size = (
        2 * np.pi / np.broadcast_to(np.asarray(counts, float), joints)[order] if counts else ANGLE_UNITS[unit or "rad"]
    )
    new_signs = np.array(found.signs) * signs[order]
    new_offsets = offsets[order] - new_signs * np.array(found.offsets) / size
    lines = ["[angles]", f'unit = "{unit or "rad"}"']
    if counts is not None:
        each = np.broadcast_to(np.asarray(counts, float), joints)[order]
        lines.append(f"counts_per_turn = {_row(each) if np.ndim(counts) else _number(float(each[0]))}")
    if listed or order != sorted(order):
        lines.append(f"columns = {_row(columns[order])}")
    if np.any(new_signs < 0):
        lines.append(f"sign = {_row(new_signs)}")
    if np.any(new_offsets):
        lines.append(f"offset = {_row(np.round(new_offsets, 9))}")
    return "\n".join(lines) + "\n"


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
