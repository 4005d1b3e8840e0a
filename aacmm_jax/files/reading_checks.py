"""What a check of readings prints for a manifest: its table ``[angles]``, and ``units``."""

import os
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import tomlkit

from ..core.units import ANGLE_UNITS, DEG, LENGTH_UNITS, length_unit
from ..diagnostics.reading_check import ReadingCheck
from ..diagnostics.reading_fit import Explanation
from ..diagnostics.rotation_check import check_rotations
from ..kinematics.arm import Arm
from ..kinematics.corrections import coefficient_of
from .inputs import InputFile
from .manifest import WrittenRotations, readings_of_manifest
from .manifest_tables import Angles
from .reading_sets import pick, tables_of

_DIGITS = 9  # of offsets
_OTHERS = 2  # conventions that do not fit and are shown


def angles_toml(
    explanation: Explanation,
    unit: str | None,
    manifest: str | os.PathLike | None = None,
    couplings: Mapping[str, float] = MappingProxyType({}),
) -> str:
    """The lines that make a manifest read the columns as an explanation of its readings has them.

    ``unit``, in which they were read; None: as the manifest or the header of its tables says. ``manifest``, with which
    they were read, whose columns, signs and offsets are taken into account.
    """
    order, joints = list(explanation.order), len(explanation.order)

    def reordered(stated: Any) -> list:
        """Columns in this order: those that were stated one by one, or their numbers."""
        columns = stated if isinstance(stated, list) and len(stated) == joints else numbers
        return [columns[i] for i in order]

    exchanged, numbers, comments = order != sorted(order), list(range(1, joints + 1)), []
    as_read = Angles(unit=unit or "rad")  # pyright: ignore[reportArgumentType]
    if manifest is not None:
        readings = readings_of_manifest(manifest)
        numbers, as_read = readings.columns, readings.angles or as_read
        for key, table in tables_of(tomlkit.parse(InputFile(manifest).text)):
            columns = table.get("columns")
            picked = columns.get("q") if isinstance(columns, dict) else columns
            # Columns that a table states for itself are not replaced by those of [angles].
            if exchanged and picked is not None:
                line = pick(table, reordered(picked))
                paths = table.get("files", [table.get("file")])
                file = next(iter(paths.values() if isinstance(paths, dict) else paths))
                comments.append(f"# In [[{key}]] ({file}), replace the picked columns with:\n# {line}\n")
    # LeRobot's calibration has a motor for each joint, and its numbers are not rad: elsewhere, what it stands for.
    written = as_read if exchanged or explanation.angle != 1 else as_read.written or as_read
    stated = written.model_dump(exclude_defaults=True, exclude={"sign", "offset", "columns"})
    entries: dict[str, Any] = {
        key: [value[i] for i in order] if isinstance(value, list) else value for key, value in stated.items()
    }
    if explanation.angle != 1:
        entries |= {"unit": "deg" if explanation.angle < 1 else "rad"}
        entries.pop("counts_per_turn", None)
    if exchanged or as_read.columns:
        entries["columns"] = reordered(as_read.columns) if exchanged else as_read.columns
    counts = as_read.counts_per_turn if explanation.angle == 1 else None
    size = ANGLE_UNITS[entries["unit"]] if counts is None else 2 * np.pi / np.broadcast_to(counts, joints)[order]
    # With the explanation's sign S and zero Z: S s (c - o) size + Z = S s (c - (o - Z / (S s size))) size.
    read, sign, offset = (
        np.broadcast_to(np.asarray(x, float), joints)[order] for x in (as_read.sign, written.sign, written.offset)
    )
    sign, offset = sign * explanation.signs, offset - read * explanation.signs * explanation.offsets / size
    offset = np.round(offset, _DIGITS) + 0.0
    if np.any(sign < 0):
        entries["sign"] = sign.astype(int).tolist()
    if np.any(offset):
        entries["offset"] = [round(x) if x == round(x) else x for x in offset.tolist()]
    if couplings:
        entries["coupled"] = {
            str(term.joint): round(factor) * term.number
            for name, factor in couplings.items()
            if (term := coefficient_of(name)) is not None
        }
    return tomlkit.dumps({"angles": entries}) + "".join(dict.fromkeys(comments))


def rotation_rows(
    manifest: str | os.PathLike, written: Sequence[WrittenRotations], check: ReadingCheck, arm: Arm
) -> list[dict[str, Any]]:
    """Of each table of orientations, the conventions that fit as well as the best, and the best of the others: how well
    each fits, and the lines of the manifest."""
    rows = []
    tables = [table for key, table in tables_of(tomlkit.parse(InputFile(manifest).text)) if key == "transforms"]
    hypothesis = check.best.hypothesis
    for part in written:
        q = hypothesis.readings(part.q[:, : arm.joints])
        rms, fits = check_rotations(arm, q, hypothesis.length * part.points, part.numbers, part.unit)
        stated = tables[part.table]
        good = sum(fit.fits for fit in fits)
        for fit in fits[: good + _OTHERS]:
            lines = [f'rotation = "{fit.convention}"']
            if fit.unit and not part.unit:
                units = tomlkit.inline_table()
                units.update({**stated.get("units", {}), "rotations": fit.unit})
                lines.append(f"units = {units.as_string()}")
            rows.append(
                {
                    "table": part.name,
                    "rotation": fit.convention,
                    "unit": fit.unit,
                    "rms_mm": rms,
                    "rms_deg": fit.rms / DEG,
                    "fits": fit.fits,
                    "equivalent": fit.equivalent,
                    "taken": stated.get("rotation") == fit.convention,
                    "lines": lines,
                }
            )
    return rows


def positions_unit(manifest: str | os.PathLike | None) -> str:
    """The unit in which a manifest takes the positions that an instrument measured, by default mm."""
    tables = () if manifest is None else tables_of(tomlkit.parse(InputFile(manifest).text))
    units = (str(table.get("units", {}).get("points")) for _, table in tables)
    return next((unit for unit in units if unit in LENGTH_UNITS), "mm")


def units_toml(explanation: Explanation, positions: str) -> str | None:
    """The line with which a manifest reads positions in the right unit, instead of this one; None: none is needed."""
    unit = length_unit(explanation.length * LENGTH_UNITS[positions])
    return None if explanation.length == 1 or unit is None else f'units = {{ points = "{unit}" }}\n'
