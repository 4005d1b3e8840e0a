"""Tables that hold joint readings twice, as commanded and as measured.

The roles are found by the names of the columns: ``q_cmd_1`` beside ``q_1``, ``target_q_0`` beside ``actual_q_0``. Only
the header is read for that; the other set comes through the manifest, changed so that it picks the other columns.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import tomlkit

from ..core.errors import InputError
from ..data.recording import ReadingSet, Recording
from .inputs import InputFile

_ROLES = {
    "commanded": "cmd cmds command commanded target tgt desired des setpoint set ref reference goal nominal soll sp",
    "measured": "actual act measured meas msr enc encoder fbk feedback state real ist",
}
_ROLE_OF = {word: role for role, words in _ROLES.items() for word in words.split()}
_UNITS = {"deg", "rad", "degrees", "arcsec", "mm", "m"}
_DEVIATIONS = {
    *("dif", "diff", "difference", "deviation", "dev", "delta", "error", "err", "correction", "corr", "offset", "off")
}
_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+|[0-9]+")


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


def other_readings(
    manifest: InputFile, recording: Recording, header: Sequence[str], read: Callable[[InputFile], Recording]
) -> ReadingSet | None:
    """Of a manifest whose tables hold both sets and that picks one of them, the other one; else None. ``header`` is
    that of its first table, and ``read`` reads a manifest."""
    taken, others = False, []
    for role, columns in reading_sets(header, recording.nominal.arm.joints).items():
        changed = InputFile(manifest)
        document = tomlkit.parse(changed.text)
        names = [header[column] for column in columns]
        lines = [f"{pick(table, names)} in [[{key}]]" for key, table in tables_of(document)]
        changed.content = tomlkit.dumps(document).encode()
        try:
            capture = read(changed).capture
        except InputError:  # these columns are no readings of the arm
            continue
        if np.array_equal(np.asarray(capture.readings), np.asarray(recording.capture.readings)):
            taken = True
        else:
            others.append(ReadingSet(role, capture, tuple(dict.fromkeys(lines))))
    return others[0] if taken and len(others) == 1 else None


def deviations(header: Sequence[str]) -> list[list[str]]:
    """Columns x, y and z of deviations, by name: those that a position may be lacking."""
    families: dict[str, dict[str, str]] = {}
    for name in header:
        words = [word.casefold() for word in _WORDS.findall(name)]
        axes = [word for word in words if word.removeprefix("d") in ("x", "y", "z")]
        if len(axes) == 1 and (_DEVIATIONS & set(words) or axes[0][0] == "d"):
            stem = " ".join("*" if word in axes else word for word in words)
            families.setdefault(stem, {})[axes[0][-1]] = name
    return [[axes[axis] for axis in "xyz"] for axes in families.values() if len(axes) == 3]


def with_deviations(
    manifest: InputFile, header: Sequence[str], read: Callable[[InputFile], Recording]
) -> list[ReadingSet]:
    """Of a manifest with measured points whose table has columns of deviations: the captures with these added to the
    points and subtracted from them. ``header`` is that of its first table, and ``read`` reads a manifest."""
    sets = []
    for names in deviations(header):
        for key in ("plus", "minus"):
            changed = InputFile(manifest)
            document = tomlkit.parse(changed.text)
            tables = [table for kind, table in tables_of(document) if kind in ("points", "transforms")]
            if not tables or any({"plus", "minus"} & set(table) for table in tables):
                continue
            picked = tomlkit.inline_table()
            picked.update({"points": names})
            for table in tables:
                table[key] = picked
            changed.content = tomlkit.dumps(document).encode()
            try:
                capture = read(changed).capture
            except InputError:  # these columns are no numbers
                continue
            sets.append(ReadingSet(f"points {key} {', '.join(names)}", capture, (f"{key} = {picked.as_string()}",)))
    return sets


def tables_of(document: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """The tables of a manifest that name files, each with its kind."""
    for key, tables in document.items():
        if isinstance(tables, list):
            yield from ((key, table) for table in tables if isinstance(table, dict) and {"file", "files"} & set(table))


def pick(table: Any, readings: Sequence[Any]) -> str:
    """Have a table pick these columns for its readings; the line that does it."""
    stated, picked = table.get("columns"), tomlkit.inline_table()
    picked.update({**(stated if isinstance(stated, dict) else {}), "q": list(readings)})
    table["columns"] = picked
    return f"columns = {picked.as_string()}"
