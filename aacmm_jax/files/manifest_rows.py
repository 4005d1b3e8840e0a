"""What the text tables of a manifest hold besides readings and points: the entries of observations, row by row.

Nothing here depends on a kind: `Declared.entries` says what each needs.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core.errors import InputError, nearest
from ..core.rotation_conventions import NUMBERS_OF_ROTATION, is_of_angles, numbers_of, rotation_matrices
from ..core.text import quoted, shorten
from ..core.units import ANGLE_UNITS, LENGTH_UNITS
from ..data.observations.declared import Declared, Entry
from .inputs import InputFile, fingerprint
from .manifest_files import PRESETS, Preset, as_list
from .manifest_readings import Wanted, checked_unit
from .one_table import OneTable
from .patterns import check_name, fields_of, fill, matches
from .table_sources.sources import InputFolder, input_table, is_recording
from .text_lines import TABLE_SHARE, Column
from .text_table import TextTable

# The units in which a manifest or table may state an entry, by the entry's own; of all others, lengths.
_UNITS = {"rad": ANGLE_UNITS, "1": ANGLE_UNITS, "px": {"px": 1.0}}


class Source:
    """The files of a manifest, to whose folder their paths are relative, in the order in which they are opened.

    ``quantity`` is what a pose is: q (readings), or points; ``rows``, set before tables are read, makes the poses of a
    table, rad and mm.
    """

    rows: Callable[[TextTable, Wanted], np.ndarray]

    def __init__(self, manifest: InputFile, quantity: str):
        self.folder, self.quantity, self._files = Path(manifest).parent, quantity, [manifest]
        # Where a dictionary, rotations are left as the numbers of their table, whose unit it has for each table.
        self.rotation_units: dict[str, str | None] | None = None
        self.whole: OneTable | None = None  # in place of files
        self.notes: dict[str, None] = {}  # what was read of files that are more than a table

    def open(self, path: str) -> InputFile:
        """Read another file."""
        self._files.append(InputFile(self.folder / path, TABLE_SHARE))
        return self._files[-1]

    def put_in_place(self, path: str) -> None:
        """Take the rows of one table in place of files."""
        self.whole = OneTable(TextTable(self.open(path), decimal=None))

    def check_used(self) -> None:
        """Raise `InputError` where rows of the one table are of a file that the manifest does not name."""
        if self.whole is not None:
            self.whole.check_used()

    def fields(self, pattern: str, exclude: Sequence[str]) -> list[dict[str, str]]:
        """The values of the fields in braces for each file, or rows of the one table, that the pattern matches."""
        return (self.whole and self.whole.matches(pattern, exclude)) or matches(self.folder, pattern, exclude)

    def table(self, path: str, **options: Any) -> TextTable:
        """Read another file, or folder, as a `TextTable` with these options."""
        if self.whole is not None and path in self.whole:
            return self.whole.rows(path)
        opened = input_table(self.folder / path, TABLE_SHARE)
        self._files += opened.files if isinstance(opened, InputFolder) else [opened]
        table = TextTable(opened, **options)
        if table.note:
            self.notes[f"{path}: {table.note}"] = None
        return table

    def fingerprints(self) -> tuple[str, ...]:
        """The `fingerprint` of each file."""
        return tuple(dict.fromkeys(fingerprint(file, self.folder) for file in self._files))


class Part(NamedTuple):
    """The poses of a table of a manifest that belong to one session and group, which may be empty."""

    session: str
    group: str
    rows: dict[str, Any]  # of entries; the poses are `Source.quantity`
    files: np.ndarray  # of each pose, the number of its file


def name_of(table: Any, values: Mapping[str, str]) -> str:
    """The name of a table: as stated, or its first file's."""
    name = Path(fill(table.paths[0], values)).stem if table.name is None else fill(table.name, values)
    check_name(name)
    return name


def parts(source: Source, kind: type[Declared], table: Any, values: Mapping[str, str], where: str) -> Iterator[Part]:
    """The parts of one table of a manifest, one for each session and group; ``where`` names it in messages, and
    ``values`` are those of its fields in braces."""
    reader = _Reader(source, kind, table, where)
    session = _filled(getattr(table, "session", None) or "", values, f"{where}: session")
    check_name(session)
    labelled = table.files.items() if isinstance(table.files, dict) else [("", file) for file in table.paths]
    files_read = [fill(file, values) for _, file in labelled]
    try:
        tables = [reader.read(label, file, session) for (label, _), file in zip(labelled, files_read, strict=True)]
    except InputError as error:  # a line to add is one of this table
        if where in str(error):
            raise
        raise InputError(f"{where}: {error}") from error
    for file, rows in zip(files_read, tables, strict=True):
        different = sorted(tables[0].keys() ^ rows.keys())
        if different:
            raise InputError(
                f"{where}: {files_read[0]} and {file} differ, because only one of the two has '{different[0]}'; add "
                f"'{different[0]}' to all files of the table, or make a separate table for each file."
            )
    by_pose = {key: np.concatenate([rows[key] for rows in tables]) for key in tables[0]}
    groups, sessions = by_pose.pop("group"), by_pose.pop("session")
    files = np.repeat(np.arange(len(tables)), [len(rows["group"]) for rows in tables])
    stated = reader.stated(values)
    both = sorted(by_pose.keys() & stated.keys())
    if both:
        raise InputError(f"{where}: {both[0]} is given both as a key and in columns; give it only once.")
    for name, entry in reader.entries.items():
        if entry.required and name not in by_pose.keys() | stated.keys():
            todo = f"pick its columns with columns = {{ {name} = ... }}" if entry.of_poses else "state it"
            raise InputError(f"{where} has no '{name}' ({entry.says}); {todo}.")
    for session, group in dict.fromkeys(zip(sessions.tolist(), groups.tolist(), strict=True)):
        chosen = (groups == group) & (sessions == session)
        yield Part(session, group, {key: value[chosen] for key, value in by_pose.items()} | stated, files[chosen])


def _filled(text: str, values: Mapping[str, str], what: str) -> str:
    """A text whose fields in braces are filled in."""
    unknown = fields_of(text) - values.keys()
    if unknown:
        raise InputError(
            f"{what} uses the field {shorten(sorted(unknown))}, which the file names do not have; use only fields of "
            "the file names."
        )
    return fill(text, values)


class _Reader:
    """The entries of one table, from its files and from the manifest."""

    def __init__(self, source: Source, kind: type[Declared], table: Any, where: str):
        self._source, self._table, self._where = source, table, where
        usual = "ros" if is_recording(source.folder / table.paths[0]) else None
        preset = PRESETS.get(table.preset or usual or "", Preset({}))
        self._preset = preset._replace(columns={**getattr(kind, "usual", {}), **preset.columns})
        # In a manifest of points, a point stands where a pose has its readings.
        self.entries = {source.quantity if entry.name == "q" else entry.name: entry for entry in kind.entries}
        columns = table.columns if isinstance(table.columns, dict) else {source.quantity: table.columns}
        self._columns = {key: as_list(picked) for key, picked in columns.items()}
        if getattr(table, "session", None) is not None and "session" in columns:
            raise InputError(f"{where}: session is given both as a key and in columns; give it only once.")
        # Columns that are added to, or subtracted from, those of an entry.
        both = [(getattr(table, "plus", {}), 1.0), (getattr(table, "minus", {}), -1.0)]
        self._added = [(key, picked, sign) for keys, sign in both for key, picked in keys.items()]
        for key, *_ in self._added:
            if key not in self.entries or self.entries[key].content != "number" or self.entries[key].unit == "1":
                raise InputError(f"{where}: plus and minus do not apply to '{key}'; give entries such as points.")
        may_have_sessions = source.quantity == "q" and hasattr(table, "session")
        for key in (*columns, *table.units):
            if key not in self.entries and not (key == "session" and key in columns and may_have_sessions):
                raise InputError(f"{where} has no '{key}'{nearest(key, self.entries)}")
        labels = [e.name for e in kind.entries if e.dimensions == ("pose",) and e.content == "text"]
        self._label = labels[0] if labels else None
        if isinstance(table.files, dict) and self._label is None:
            raise InputError(
                f"{where} has files with names, but its kind of observation has no named points or sides; give files "
                "as a list."
            )
        self._own_file = getattr(table, "readings", None)
        if self._own_file is not None and len(table.paths) > 1:
            raise InputError(
                f"{where} has its readings in a separate file, so it needs exactly one file of measured values; give "
                "one file."
            )

    def read(self, label: str, file: str, session: str) -> dict[str, Any]:
        """Of each pose of a file what its columns hold, its group and its session."""
        table, source = self._table, self._source
        text = self._open(file, table.table, table.skip)
        chosen = dict(self._columns)
        for key, choices in self._preset.columns.items():
            # A preset may name more than a kind needs, or than a table has.
            if key not in self.entries or key in chosen or getattr(table, key, None) is not None:
                continue
            there = next((wanted for wanted in choices if text.has(wanted)), None)
            if there is not None:
                chosen[key] = list(there)
        if label:
            chosen.pop(self._label or "", None)
        group = np.full(text.length, "") if table.group is None else text.texts(table.group)
        if table.group is not None and "" in group:
            raise InputError(
                f"{self._where}: {file} row {group.tolist().index('') + 1} has an empty cell in column "
                f"{quoted(str(table.group))}, which names the group of the row; fill the cell, or delete the row."
            )
        of_session, main = chosen.pop("session", None), chosen.pop(source.quantity, None)
        added = [(key, as_list(columns), sign) for key, columns, sign in self._added]
        others = [
            *chosen.values(),
            *(columns for _, columns, _ in added),
            of_session or [],
            [] if table.group is None else [table.group],
        ]
        readings = text if self._own_file is None else self._open(self._own_file, table.readings_table, 0)
        wanted = Wanted(
            main,
            table.units.get(source.quantity),
            self._preset.units.get(source.quantity),
            [i for columns in others for i in text.pick(columns)] if readings is text else [],
            {"load": table.load_kg, "thermometer": table.temperature_C},
            table.chain,
            getattr(table, "link", None),
        )
        rows_of = {source.quantity: (rows := source.rows(readings, wanted))}
        rows_of |= {key: self._column(text, self.entries[key], columns) for key, columns in chosen.items()}
        for key, columns, sign in added:
            if key not in chosen:
                raise InputError(f"{self._where}: plus and minus need columns of {key}; pick them with columns.")
            rows_of[key] = rows_of[key] + sign * self._column(text, self.entries[key], columns)
        if label and self._label is not None:
            rows_of[self._label] = np.full(len(rows), label)
        rows_of["session"] = np.full(len(rows), session) if of_session is None else text.texts(of_session[0])
        rows_of["group"] = group
        for key, values in rows_of.items():
            if len(values) != len(rows):
                raise InputError(
                    f"{self._where}: {file} has {len(values)} rows of '{key}', but there are {len(rows)} readings; "
                    "give one row of values and one row of readings per pose."
                )
        return rows_of

    def _open(self, file: str, tables: str | list[str] | None, skip: int) -> TextTable:
        table = self._table
        wanted = [*(column for columns in self._columns.values() for column in columns), table.group or 1]
        return self._source.table(
            file,
            tables=as_list(tables or []),
            delimiter=table.delimiter,
            decimal=table.decimal or self._preset.decimal,
            skip=skip,
            wanted=wanted if self._own_file is None else (),
        )

    def _column(self, text: TextTable, entry: Entry, wanted: Sequence[Column]) -> np.ndarray:
        if not entry.of_poses:
            raise InputError(
                f"{self._where}: {entry.name} has one value for all poses, so it cannot be a column; remove it from "
                f"columns and write {entry.name} = ... in the table."
            )
        if entry.content == "text":
            if len(wanted) != 1:
                raise InputError(f"{self._where}: {entry.name} needs one column; pick one column.")
            return text.texts(wanted[0])
        picked = text.pick(wanted)
        numbers = text.numbers(picked)
        header = text.unit(picked, self._table.units.get(entry.name) or self._preset.units.get(entry.name), entry.name)
        if entry.unit == "1":
            return self._rotations(entry, numbers, header)
        shape = entry.row_shape
        count = math.prod(shape)
        of_all_axes = entry.name == "u" and len(shape) == 1
        self._check_count(entry.name, numbers.shape[1], (1, 3) if of_all_axes else (count,))
        numbers = numbers * self._unit(entry, header)
        if entry.name == "u":
            numbers = numbers / (self._table.coverage_factor or self._preset.coverage_factor)
        return np.broadcast_to(numbers, (len(numbers), count)).reshape(-1, *shape)

    def _check_count(self, name: str, given: int, counts: Sequence[int]) -> None:
        if given not in counts:
            wanted = " or ".join(map(str, counts))
            raise InputError(
                f"{self._where}: {name} needs {wanted} columns, but {given} are picked; pick {wanted} columns."
            )

    def _unit(self, entry: Entry, header: str | None = None) -> float:
        """What a number of the table or manifest is multiplied by; ``header``: the unit that the table states."""
        units = _UNITS.get(entry.unit, LENGTH_UNITS)
        name, usual = entry.name, self._preset.units.get(entry.name)
        unit = checked_unit(self._where, name, header, self._table.units.get(name), usual, units)
        if unit is None and entry.unit == "1":
            raise InputError(f"{self._where} has angles without a unit; give units = {{ {name} = 'deg' }}.")
        return 1.0 if unit is None else units[unit] ** (2 if entry.unit == "mm^2" else 1)

    def _rotations(self, entry: Entry, numbers: np.ndarray, header: str | None) -> np.ndarray:
        if self._source.rotation_units is not None:
            self._source.rotation_units[self._where] = self._table.units.get(entry.name) or header
            return numbers
        convention = self._table.rotation or self._preset.rotation
        if convention is None:
            raise InputError(
                f"{self._where} does not state the convention of its rotations; give rotation = "
                f"{', '.join(NUMBERS_OF_ROTATION)}, or three axes such as XYZ or xyz; aacmm import --check finds it."
            )
        self._check_count(entry.name, numbers.shape[1], (numbers_of(convention),))
        if numbers.shape[1] == 4 and not np.allclose(np.linalg.norm(numbers, axis=1), 1, atol=1e-3):
            raise InputError(
                f"{self._where} has quaternions whose length is not 1; check that the right four columns are picked."
            )
        return rotation_matrices(
            numbers * self._unit(entry, header) if is_of_angles(convention) else numbers, convention
        )

    def stated(self, values: Mapping[str, str]) -> dict[str, Any]:
        """What the manifest itself states, in mm and rad."""
        stated: dict[str, Any] = {}
        for entry in self.entries.values():
            value = getattr(self._table, entry.name, None)
            if value is None:
                continue
            if isinstance(value, dict):
                stated[entry.dimensions[0]] = np.array(list(value))
                stated[entry.name] = np.array(list(value.values()), dtype=float) * self._unit(entry)
            elif entry.content == "text":
                stated[entry.name] = _filled(value, values, f"{self._where}: {entry.name}")
            else:
                stated[entry.name] = value if entry.content == "truth" else value * self._unit(entry)
        return stated
