"""What a check of readings prints for a manifest: its table ``[angles]``, ``units``, and which readings fit better.

Tables may hold joint readings twice, as commanded and as measured. The roles are found by the names of the columns:
``q_cmd_1`` beside ``q_1``, ``target_q_0`` beside ``actual_q_0``. Only the header is read for that; both sets come
through the manifest, changed so that it picks the other columns, and both are calibrated.
"""

import math
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import tomlkit

from ..core.errors import IdentifiabilityWarning, InputError
from ..core.text import shorten
from ..core.units import ANGLE_UNITS, LENGTH_UNITS, length_unit
from ..data.recording import Recording
from ..diagnostics.reading_fit import Explanation
from .inputs import InputFile
from .manifest import read_manifest, readings_of_manifest
from .manifest_tables import Angles

_ROLES = {
    "commanded": "cmd cmds command commanded target tgt desired des setpoint set ref reference goal nominal soll sp",
    "measured": "actual act measured meas msr enc encoder fbk feedback state real ist",
}
_ROLE_OF = {word: role for role, words in _ROLES.items() for word in words.split()}
_UNITS = {"deg", "rad", "degrees", "arcsec", "mm", "m"}
_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+|[0-9]+")
_APART = 3.0  # standard errors by which two residuals differ


def angles_toml(explanation: Explanation, unit: str | None, manifest: str | os.PathLike | None = None) -> str:
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
        for key, table in _tables(tomlkit.parse(InputFile(manifest).text)):
            columns = table.get("columns")
            picked = columns.get("q") if isinstance(columns, dict) else columns
            # Columns that a table states for itself are not replaced by those of [angles].
            if exchanged and picked is not None:
                line = _pick(table, reordered(picked))
                paths = table.get("files", [table.get("file")])
                file = next(iter(paths.values() if isinstance(paths, dict) else paths))
                comments.append(f"# In [[{key}]] ({file}), replace the picked columns with:\n# {line}\n")
    stated = as_read.model_dump(exclude_defaults=True, exclude={"sign", "offset", "columns"})
    entries: dict[str, Any] = {
        key: [value[i] for i in order] if isinstance(value, list) else value for key, value in stated.items()
    }
    if explanation.angle != 1:
        entries |= {"unit": "deg" if explanation.angle < 1 else "rad"}
        entries.pop("counts_per_turn", None)
    if exchanged or as_read.columns:
        entries["columns"] = reordered(as_read.columns)
    counts = entries.get("counts_per_turn")
    size = ANGLE_UNITS[entries["unit"]] if counts is None else 2 * np.pi / np.asarray(counts)
    # With the explanation's sign S and zero Z: S s (c - o) size + Z = S s (c - (o - Z / (S s size))) size.
    sign, offset = (np.broadcast_to(np.asarray(x, float), joints)[order] for x in (as_read.sign, as_read.offset))
    sign = sign * explanation.signs
    offset = np.round(offset - sign * explanation.offsets / size, 9) + 0.0
    if np.any(sign < 0):
        entries["sign"] = sign.astype(int).tolist()
    if np.any(offset):
        entries["offset"] = [round(x) if x == round(x) else x for x in offset.tolist()]
    return tomlkit.dumps({"angles": entries}) + "".join(dict.fromkeys(comments))


def _tables(document: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """The tables of a manifest that name files, each with its kind."""
    for key, tables in document.items():
        if isinstance(tables, list):
            yield from ((key, table) for table in tables if isinstance(table, dict) and {"file", "files"} & set(table))


def _pick(table: Any, readings: Sequence[Any]) -> str:
    """Have a table pick these columns for its readings; the line that does it."""
    stated, picked = table.get("columns"), tomlkit.inline_table()
    picked.update({**(stated if isinstance(stated, dict) else {}), "q": list(readings)})
    table["columns"] = picked
    return f"columns = {picked.as_string()}"


def positions_unit(manifest: str | os.PathLike | None) -> str:
    """The unit in which a manifest takes the positions that an instrument measured, by default mm."""
    tables = () if manifest is None else _tables(tomlkit.parse(InputFile(manifest).text))
    units = (str(table.get("units", {}).get("points")) for _, table in tables)
    return next((unit for unit in units if unit in LENGTH_UNITS), "mm")


def units_toml(explanation: Explanation, positions: str) -> str | None:
    """The line with which a manifest reads positions in the right unit, instead of this one; None: none is needed."""
    unit = length_unit(explanation.length * LENGTH_UNITS[positions])
    return None if explanation.length == 1 or unit is None else f'units = {{ points = "{unit}" }}\n'


def reading_sets(header: Sequence[str], joints: int) -> dict[str, list[int]]:
    """Columns of commanded and of measured readings, counted from 0, where the header has both; else nothing.

    Names are compared without the words that say a role, their unit and their number: ``q_cmd_1 [deg]`` and
    ``q_1 [deg]`` are both ``q``. Each set has as many columns as joints, numbered from 0 or 1.
    """
    families: dict[tuple[str, ...], dict[str, dict[int, int]]] = {}
    for column, name in enumerate(header):
        words = [word.casefold() for word in _WORDS.findall(name)]
        numbers = [int(word[:9]) for word in words if word.isdecimal()]
        if len(numbers) == 1:
            role = next((_ROLE_OF[word] for word in words if word in _ROLE_OF), "")
            stem = tuple(word for word in words if not (word.isdecimal() or word in _ROLE_OF or word in _UNITS))
            families.setdefault(stem, {}).setdefault(role, {})[numbers[0]] = column
    whole = (list(range(joints)), list(range(1, joints + 1)))
    for roles in families.values():
        sets = {role: [at[i] for i in sorted(at)] for role, at in roles.items() if sorted(at) in whole}
        if "" in sets and len(sets) == 2:  # the columns without a word are the others
            sets[next(role for role in _ROLES if role not in sets)] = sets.pop("")
        if set(_ROLES) <= set(sets):
            return {role: sets[role] for role in _ROLES}
    return {}


def compare_reading_sets(manifest: str | os.PathLike, recording: Recording) -> list[dict[str, Any]]:
    """Both sets of readings of a manifest's tables, calibrated; nothing where its first table has one.

    Each has the ``role``, the ``lines`` that make the manifest pick it, one for each kind of table, the RMS of all
    poses from their geometry (``rms_mm``), and whether it is ``taken`` by the manifest, which says ``recording``.
    """
    from ..pipeline.single import calibrate, identify

    header, rows = readings_of_manifest(manifest).header, []
    for role, columns in reading_sets(header, recording.nominal.arm.joints).items():
        changed = InputFile(manifest)
        document = tomlkit.parse(changed.text)
        names = [header[column] for column in columns]
        lines = [f"{_pick(table, names)} in [[{key}]]" for key, table in _tables(document)]
        changed.content = tomlkit.dumps(document).encode()
        try:
            capture, bounds = read_manifest(changed).capture, recording.nominal.bounds()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", IdentifiabilityWarning)
                if capture.lengths or any(item.fixes_scale for item in capture.observations):
                    options = {"shared_errors": False, "undetermined": "ignore"}
                    rms = calibrate(bounds.space.base, capture, bounds, **options).observed.rms
                else:
                    rms = identify(bounds.space.base, capture, bounds).observed.rms
        except InputError:
            continue
        taken = np.array_equal(np.asarray(capture.readings), np.asarray(recording.capture.readings))
        rows.append({"role": role, "lines": list(dict.fromkeys(lines)), "rms_mm": rms, "taken": taken})
    return rows


def reading_sets_sentence(rows: Sequence[dict[str, Any]], poses: int) -> str:
    """Which of the sets fits better, with both figures, and what to write; empty where there is one."""
    if len(rows) < 2:
        return ""
    best, other = sorted(rows, key=lambda row: row["rms_mm"])
    figures = (
        f"a calibration with the {best['role']} readings leaves residuals of {best['rms_mm']:.3g} mm RMS, and a "
        f"calibration with the {other['role']} readings leaves {other['rms_mm']:.3g} mm RMS"
    )
    # Each residual has a relative standard error of about 1 / sqrt(2 m) of m coordinates.
    if math.log(other["rms_mm"] / max(best["rms_mm"], 1e-12)) < _APART * math.sqrt(2 / (2 * 3 * poses)):
        verdict = f", and both fit equally well: {figures}"
    elif best["taken"]:
        verdict = f", and the manifest uses the readings that fit better: {figures}"
    else:
        verdict = f": {figures}. To use the {best['role']} readings, write {shorten(best['lines'], 3)}"
    return f"The tables contain both commanded and measured readings{verdict}."
