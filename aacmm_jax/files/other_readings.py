"""Tables that hold joint readings twice, as commanded and as measured: both are calibrated, and the better is named.

The roles are found by the names of the columns: ``q_cmd_1`` beside ``q_1``, ``target_q_0`` beside ``actual_q_0``. Only
the header is read here. The readings come through the manifest, changed so that it picks the other columns.
"""

import fnmatch
import math
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core.errors import IdentifiabilityWarning, InputError
from ..core.text import shorten
from ..data.recording import Recording
from .inputs import InputFile
from .manifest import read_manifest
from .outputs import as_path
from .patterns import fill, matches
from .text_table import TextTable

_ROLES = {
    "commanded": "cmd cmds command commanded target tgt desired des setpoint set ref reference goal nominal soll sp",
    "measured": "actual act measured meas msr enc encoder fbk feedback state real ist",
}
_ROLE_OF = {word: role for role, words in _ROLES.items() for word in words.split()}
_OTHER = {"commanded": "measured", "measured": "commanded"}
_UNITS = {"deg", "rad", "degrees", "arcsec", "mm", "m"}
_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+|[0-9]+")
_APART = 3.0  # standard errors by which two residuals differ


class ReadingSet(NamedTuple):
    """One of the sets of columns, and how a calibration from it fits."""

    role: str  # commanded or measured
    lines: tuple[str, ...]  # that make the manifest pick these columns, one for each table
    rms: float | None  # of all poses from their geometry, mm; None: it cannot be calibrated
    taken: bool  # whether the manifest picks these columns as it is


def reading_sets(header: Sequence[str], joints: int) -> dict[str, list[int]]:
    """Columns of commanded and of measured readings, counted from 0, where the header has both; else nothing.

    Names are compared without the words that say a role, their unit and their number: ``q_cmd_1 [deg]`` and
    ``q_1 [deg]`` are both ``q``.

    Args:
        header: Names of the columns.
        joints: Number of joints; each set has as many columns, numbered from 0 or 1.
    """
    families: dict[tuple[str, ...], dict[str, list[tuple[int, int]]]] = {}
    for column, name in enumerate(header):
        words = [word.casefold() for word in _WORDS.findall(name)]
        numbers = [int(word[:9]) for word in words if word.isdecimal()]
        if len(numbers) != 1:
            continue
        role = next((_ROLE_OF[word] for word in words if word in _ROLE_OF), "")
        base = tuple(word for word in words if not (word.isdecimal() or word in _ROLE_OF or word in _UNITS))
        families.setdefault(base, {}).setdefault(role, []).append((numbers[0], column))
    for roles in families.values():
        found = {}
        for role, numbered in roles.items():
            numbered.sort()
            if [number for number, _ in numbered] in (list(range(joints)), list(range(1, joints + 1))):
                found[role] = [column for _, column in numbered]
        if "" in found and len(found) == 2:  # the columns without a word are the others
            named = next(role for role in found if role)
            found = {named: found[named], _OTHER[named]: found[""]}
        if set(found) >= set(_OTHER):
            return {role: found[role] for role in _OTHER}
    return {}


def compare_reading_sets(manifest: str | os.PathLike, recording: Recording) -> tuple[ReadingSet, ...]:
    """Both sets of readings of a manifest's tables, calibrated; nothing where its tables have one.

    Args:
        manifest: The manifest (TOML).
        recording: What it says as it is.
    """
    import tomlkit

    joints, folder, text = recording.nominal.arm.joints, as_path(manifest).parent, InputFile(manifest).text
    found = []
    for role in _OTHER:
        document = tomlkit.parse(text)
        lines = []
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
            read = read_manifest(changed)
        except InputError:
            continue
        same = np.array_equal(np.asarray(read.capture.readings), np.asarray(recording.capture.readings))
        lines = tuple(dict.fromkeys(lines))
        found.append(ReadingSet(role, lines, _rms(read, recording), same))
    return tuple(found)


def reading_sets_sentence(found: Sequence[ReadingSet], poses: int) -> str:
    """Which of the sets fits better, with both figures, and what to write; empty where there is one.

    Args:
        found: Both sets.
        poses: Number of poses.
    """
    fitted = [one for one in found if one.rms is not None]
    if len(fitted) < 2:
        return ""
    best, other = sorted(fitted, key=lambda one: one.rms or 0.0)
    figures = f"the {best.role} ones leave {best.rms:.3g} mm RMS after a calibration, the {other.role} ones "
    figures += f"{other.rms:.3g} mm"
    # Each residual has a relative standard error of about 1 / sqrt(2 m) of m coordinates.
    if math.log((other.rms or 0.0) / max(best.rms or 0.0, 1e-12)) < _APART * math.sqrt(2 / (2 * 3 * poses)):
        return f"The tables have commanded and measured readings, which fit alike: {figures}."
    if best.taken:
        return f"The tables have commanded and measured readings, and the manifest takes the better: {figures}."
    return (
        f"The tables have commanded and measured readings: {figures}, so take the {best.role} ones: "
        f"{shorten(best.lines, 3)}."
    )


def _tables(document: Any) -> Iterator[tuple[str, Any]]:
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
    for key, value in stated.items() if isinstance(stated, dict) else ():
        if key != "q":
            picked[key] = value
    entry["columns"] = picked
    return f"columns = {picked.as_string()} in [[{table}]]"


def _rms(recording: Recording, given: Recording) -> float | None:
    """Distance of the tips from their geometry after a calibration of the same parameters, mm."""
    from ..pipeline.single import calibrate, identify

    capture, bounds = recording.capture, given.nominal.bounds()
    arm, scaled = bounds.space.base, capture.lengths or any(one.fixes_scale for one in capture.observations)
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
