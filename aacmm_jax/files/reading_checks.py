"""What a check of readings prints for a manifest: its table ``[angles]``, ``units``, and which readings fit better.

Tables may hold joint readings twice, as commanded and as measured. The roles are found by the names of the columns:
``q_cmd_1`` beside ``q_1``, ``target_q_0`` beside ``actual_q_0``. Only the header is read for that; both sets come
through the manifest, changed so that it picks the other columns, and both are calibrated.
"""

import fnmatch
import math
import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core.errors import IdentifiabilityWarning, InputError
from ..core.text import shorten
from ..core.units import ANGLE_UNITS, LENGTH_UNITS, length_unit
from ..data.recording import Recording
from ..diagnostics.reading_fit import Explanation
from .inputs import InputFile
from .manifest import PosesManifest, read_manifest, readings_of_manifest
from .manifest_angles import Angles
from .manifest_tables import Table
from .outputs import as_path
from .patterns import fill, matches
from .text_table import TextTable
from .toml import read_toml

_ROLES = {
    "commanded": "cmd cmds command commanded target tgt desired des setpoint set ref reference goal nominal soll sp",
    "measured": "actual act measured meas msr enc encoder fbk feedback state real ist",
}
_ROLE_OF = {word: role for role, words in _ROLES.items() for word in words.split()}
_UNITS = {"deg", "rad", "degrees", "arcsec", "mm", "m"}
_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+|[0-9]+")
_APART = 3.0  # standard errors by which two residuals differ


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
        model, readings = read_toml(InputFile(as_path(manifest)), PosesManifest), readings_of_manifest(manifest)
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
    model = read_toml(InputFile(as_path(manifest)), PosesManifest)
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


class ReadingSet(NamedTuple):
    """One of the sets of columns, and how a calibration from it fits."""

    role: str  # commanded or measured
    lines: tuple[str, ...]  # that make the manifest pick these columns, one for each table
    rms: float | None  # of all poses from their geometry, mm; None: it cannot be calibrated
    taken: bool  # whether the manifest picks these columns as it is


def reading_sets(header: Sequence[str], joints: int) -> dict[str, list[int]]:
    """Columns of commanded and of measured readings, counted from 0, where the header has both; else nothing.

    Names are compared without the words that say a role, their unit and their number: ``q_cmd_1 [deg]`` and
    ``q_1 [deg]`` are both ``q``. Each set has as many columns as joints, numbered from 0 or 1.
    """
    families: dict[tuple[str, ...], dict[str, list[tuple[int, int]]]] = {}
    for column, name in enumerate(header):
        words = [word.casefold() for word in _WORDS.findall(name)]
        numbers = [int(word[:9]) for word in words if word.isdecimal()]
        if len(numbers) == 1:
            role = next((_ROLE_OF[word] for word in words if word in _ROLE_OF), "")
            stem = tuple(word for word in words if not (word.isdecimal() or word in _ROLE_OF or word in _UNITS))
            families.setdefault(stem, {}).setdefault(role, []).append((numbers[0], column))
    whole = (list(range(joints)), list(range(1, joints + 1)))
    for roles in families.values():
        sets = {
            role: [column for _, column in sorted(numbered)]
            for role, numbered in roles.items()
            if sorted(number for number, _ in numbered) in whole
        }
        unnamed = sets.pop("", None)
        if unnamed is not None and len(sets) == 1:  # the columns without a word are the others
            sets[next(role for role in _ROLES if role not in sets)] = unnamed
        if len(sets) == len(_ROLES):
            return {role: sets[role] for role in _ROLES}
    return {}


def compare_reading_sets(manifest: str | os.PathLike, recording: Recording) -> tuple[ReadingSet, ...]:
    """Both sets of readings of a manifest's tables, calibrated; nothing where its tables have one.

    ``recording`` is what the manifest says as it is.
    """
    import tomlkit

    joints, folder, text = recording.nominal.arm.joints, as_path(manifest).parent, InputFile(manifest).text
    sets = []
    for role in _ROLES:
        document, lines = tomlkit.parse(text), []
        for table, entry in _tables(document):
            header = _header(folder, entry)
            columns = reading_sets(header, joints).get(role)
            if columns is not None:
                lines.append(_pick(table, entry, header, columns))
        if not lines:
            return ()
        changed = InputFile(manifest)
        changed.content = tomlkit.dumps(document).encode()
        try:
            picked = read_manifest(changed)
        except InputError:
            continue
        same = np.array_equal(np.asarray(picked.capture.readings), np.asarray(recording.capture.readings))
        sets.append(ReadingSet(role, tuple(dict.fromkeys(lines)), _rms(picked, recording), same))
    return tuple(sets)


def reading_sets_sentence(sets: Sequence[ReadingSet], poses: int) -> str:
    """Which of the sets fits better, with both figures, and what to write; empty where there is one."""
    fitted = sorted((item.rms, item) for item in sets if item.rms is not None)
    if len(fitted) < 2:
        return ""
    (best_rms, best), (other_rms, other) = fitted
    figures = (
        f"the {best.role} ones leave {best_rms:.3g} mm RMS after a calibration, the {other.role} ones "
        f"{other_rms:.3g} mm"
    )
    # Each residual has a relative standard error of about 1 / sqrt(2 m) of m coordinates.
    if math.log(other_rms / max(best_rms, 1e-12)) < _APART * math.sqrt(2 / (2 * 3 * poses)):
        return f"The tables have commanded and measured readings, which fit alike: {figures}."
    if best.taken:
        return f"The tables have commanded and measured readings, and the manifest takes the better: {figures}."
    return (
        f"The tables have commanded and measured readings: {figures}, so take the {best.role} ones: "
        f"{shorten(best.lines, 3)}."
    )


def _tables(document: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, entries in document.items():
        if isinstance(entries, list):
            yield from ((key, entry) for entry in entries if isinstance(entry, dict) and {"file", "files"} & set(entry))


def _header(folder: Path, entry: Any) -> list[str]:
    """The names of the columns in the first file of a table; none where it cannot be read."""
    files = entry.get("files", [entry.get("file")])
    name = entry.get("readings") or (list(files.values()) if isinstance(files, dict) else files)[0]
    try:
        values = matches(folder, name, entry.get("exclude", ())) if "{" in name else [{}]
        options = {key: entry[key] for key in ("delimiter", "decimal", "skip") if key in entry}
        return list(TextTable(folder / fill(name, values[0]), **options).header)
    except InputError:
        return []


def _pick(table: str, entry: Any, header: Sequence[str], columns: Sequence[int]) -> str:
    """Have a table pick these columns for its readings; the line that does it, and where."""
    import tomlkit

    names = [header[column] for column in columns]
    pattern = f"{re.split('[0-9]', names[0])[0]}[0-9]*"
    alone = [name for name in header if fnmatch.fnmatchcase(name, pattern)] == names
    stated = entry.get("columns")
    picked = tomlkit.inline_table()
    picked["q"] = pattern if alone else names
    picked.update({key: value for key, value in stated.items() if key != "q"} if isinstance(stated, dict) else {})
    entry["columns"] = picked
    return f"columns = {picked.as_string()} in [[{table}]]"


def _rms(recording: Recording, given: Recording) -> float | None:
    """Distance of the tips from their geometry after a calibration of the same parameters, mm."""
    from ..pipeline.single import calibrate, identify

    capture, bounds = recording.capture, given.nominal.bounds()
    arm, scaled = bounds.space.base, capture.lengths or any(item.fixes_scale for item in capture.observations)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", IdentifiabilityWarning)
            if scaled:
                result = calibrate(arm, capture, bounds, shared_errors=False, undetermined="ignore")
            else:
                result = identify(arm, capture, bounds)
    except InputError:
        return None
    return result.observed.rms
