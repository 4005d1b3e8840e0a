"""Observations in a manifest, read from text tables.

Sockets and spheres are read by the same reader, and so are the points of a manifest of points. Nothing here depends on
a kind: `AbstractObservation.entries` says what each needs.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core.errors import InputError, nearest
from ..core.text import quoted, shorten
from ..core.units import ANGLE_UNITS, LENGTH_UNITS
from ..data.observations.declared import Entry
from ..data.observations.observation import AbstractObservation
from .inputs import InputFile
from .manifest_tables import NUMBERS_OF_ROTATION, PRESETS, Preset, Wanted, as_list, checked_unit
from .patterns import check_name, fields_of, fill
from .text_lines import Column
from .text_table import TextTable


class Source(NamedTuple):
    """How the files of a manifest are read."""

    folder: Path
    open: Callable[[Path], InputFile]
    quantity: str  # what a pose is: q (readings), or points
    rows: Callable[[TextTable, Wanted], np.ndarray]


class Part(NamedTuple):
    """The poses of a table of a manifest that belong to one session and group, which may be empty."""

    session: str
    group: str
    rows: dict[str, Any]  # of entries; the poses are `Source.quantity`
    files: np.ndarray  # of each pose, the number of its file


def observations(
    source: Source, kind: type[AbstractObservation], table: Any, values: Mapping[str, str]
) -> Iterator[tuple[str, AbstractObservation]]:
    """The observations of one table of a manifest, each with its session, which may be empty; ``values`` are those of
    its fields in braces."""
    name = name_of(table, values)
    for part in parts(source, kind, table, values, f"[[{kind.table}]] '{name}'"):
        yield part.session, kind.rebuilt(f"{name}/{part.group}" if table.group is not None else name, part.rows)


def name_of(table: Any, values: Mapping[str, str]) -> str:
    """The name of a table: as stated, or its first file's."""
    name = Path(fill(table.paths[0], values)).stem if table.name is None else fill(table.name, values)
    check_name(name)
    return name


def parts(
    source: Source, kind: type[AbstractObservation], table: Any, values: Mapping[str, str], where: str
) -> Iterator[Part]:
    """The parts of one table of a manifest, one for each session and group; ``where`` names it in messages."""
    reader = _Reader(source, kind, table, where)
    session = _filled(getattr(table, "session", None) or "", values, f"{where}: session")
    check_name(session)
    labels, files_read = zip(*((label, fill(file, values)) for label, file in _files(table)), strict=True)
    try:
        tables = [reader.read(label, file, session) for label, file in zip(labels, files_read, strict=True)]
    except InputError as error:  # a line to add is one of this table
        if where in str(error):
            raise
        raise InputError(f"{where}: {error}") from error
    groups = np.concatenate([group for group, _, _ in tables])
    sessions = np.concatenate([session for _, session, _ in tables])
    files = np.repeat(np.arange(len(tables)), [len(group) for group, _, _ in tables])
    for file, (*_, rows) in zip(files_read, tables, strict=True):
        different = sorted(tables[0][2].keys() ^ rows.keys())
        if different:
            raise InputError(
                f"{where}: only one of {files_read[0]} and {file} has '{different[0]}'; give it in all files of a "
                "table, or make a table for each."
            )
    by_pose = {key: np.concatenate([rows[key] for *_, rows in tables]) for key in tables[0][2]}
    stated = reader.stated(values)
    both = sorted(by_pose.keys() & stated.keys())
    if both:
        raise InputError(f"{where}: {both[0]} is given and also in columns; give it once.")
    for session, group in dict.fromkeys(zip(sessions.tolist(), groups.tolist(), strict=True)):
        chosen = (groups == group) & (sessions == session)
        rows = {key: value[chosen] for key, value in by_pose.items()}
        reader.check_complete({*rows, *stated})
        yield Part(session, group, rows | stated, files[chosen])


def _filled(text: str, values: Mapping[str, str], what: str) -> str:
    """A text whose fields in braces are filled in."""
    unknown = fields_of(text) - values.keys()
    if unknown:
        raise InputError(f"{what} uses the unknown field {shorten(sorted(unknown))}.")
    return fill(text, values)


def _files(table: Any) -> list[tuple[str, str]]:
    """The files of a table, each with the label of its poses."""
    if isinstance(table.files, dict):
        return list(table.files.items())
    return [("", file) for file in table.paths]


class _Reader:
    """The entries of one table, from its files and from the manifest."""

    def __init__(self, source: Source, kind: type[AbstractObservation], table: Any, where: str):
        self._source, self._kind, self._table, self._where = source, kind, table, where
        self._preset = PRESETS[table.preset] if table.preset is not None else Preset({})
        # In a manifest of points, a point stands where a pose has its readings.
        self._entries = {source.quantity if entry.name == "q" else entry.name: entry for entry in kind.entries}
        columns = table.columns if isinstance(table.columns, dict) else {source.quantity: table.columns}
        self._columns = {key: as_list(picked) for key, picked in columns.items()}
        if getattr(table, "session", None) is not None and "session" in columns:
            raise InputError(f"{where}: session is given and also in columns; give it once.")
        may_have_sessions = source.quantity == "q" and hasattr(table, "session")
        for key in (*columns, *table.units):
            if key not in self._entries and not (key == "session" and key in columns and may_have_sessions):
                raise InputError(f"{where} has no '{key}'{nearest(key, self._entries)}")
        labels = [e for e in kind.entries if e.dimensions == ("pose",) and e.content == "text"]
        self._label = labels[0].name if labels else None
        if isinstance(table.files, dict) and self._label is None:
            raise InputError(f"{where} has files by name, but its poses have none; give files as a list.")
        self._own_file = getattr(table, "readings", None)
        if self._own_file is not None and len(table.paths) > 1:
            raise InputError(f"{where} has readings in a file of their own, so it needs one file of values.")

    def read(self, label: str, file: str, session: str) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
        """The group and the session of each pose of a file, and what its columns hold."""
        table, source = self._table, self._source
        text = self._open(file, table.skip)
        chosen = dict(self._columns)
        for key, choices in self._preset.columns.items():
            # A preset may name more than a kind needs, or than a table has.
            if key not in self._entries or key in chosen or getattr(table, key, None) is not None:
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
                f"{quoted(str(table.group))}, which names its group; fill it, or leave out the row."
            )
        of_session, main = chosen.pop("session", None), chosen.pop(source.quantity, None)
        others = [*chosen.values(), of_session or [], [] if table.group is None else [table.group]]
        readings = text if self._own_file is None else self._open(self._own_file, 0)
        wanted = Wanted(
            main,
            table.units.get(source.quantity),
            self._preset.units.get(source.quantity),
            [i for columns in others for i in text.pick(columns)] if readings is text else [],
            table.temperature_C,
        )
        rows_of = {source.quantity: (rows := source.rows(readings, wanted))}
        for key, columns in chosen.items():
            rows_of[key] = self._column(text, self._entries[key], columns)
        if label and self._label is not None:
            rows_of[self._label] = np.full(len(rows), label)
        sessions = np.full(len(rows), session) if of_session is None else text.texts(of_session[0])
        for key, values in (rows_of | {"session": sessions, "group": group}).items():
            if len(values) != len(rows):
                raise InputError(
                    f"{self._where}: {file} has {len(values)} rows of '{key}', but there are {len(rows)} readings; "
                    "give a row of each for every pose."
                )
        return group, sessions, rows_of

    def _open(self, file: str, skip: int) -> TextTable:
        table, source = self._table, self._source
        wanted = [*(column for columns in self._columns.values() for column in columns), table.group or 1]
        return TextTable(
            source.open(source.folder / file),
            delimiter=table.delimiter,
            decimal=table.decimal,
            skip=skip,
            wanted=wanted if self._own_file is None else (),
        )

    def _column(self, text: TextTable, entry: Entry, wanted: Sequence[Column]) -> np.ndarray:
        if entry.dimensions[:1] != ("pose",):
            raise InputError(f"{self._where}: {entry.name} is one for all poses; state it outside columns.")
        if entry.content == "text":
            if len(wanted) != 1:
                raise InputError(f"{self._where}: {entry.name} is in one column; pick one.")
            return text.texts(wanted[0])
        picked = text.pick(wanted)
        numbers = text.numbers(picked)
        header = text.unit(picked, self._table.units.get(entry.name) or self._preset.units.get(entry.name), entry.name)
        if entry.unit == "1":
            return self._rotations(entry, numbers, header)
        counts = {("pose",): (1,), ("pose", "axis"): (3,), ("pose", "axis", "axis_2"): (9,)}[entry.dimensions]
        if entry.name == "u" and entry.dimensions == ("pose", "axis"):
            counts = (1, 3)
        self._check_count(entry.name, numbers.shape[1], counts)
        numbers = numbers * self._unit(entry, header)
        if entry.name == "u":
            numbers = numbers / (self._table.coverage_factor or self._preset.coverage_factor)
        if len(entry.dimensions) == 3:
            return numbers.reshape(-1, 3, 3)
        return numbers[:, 0] if entry.dimensions == ("pose",) else np.broadcast_to(numbers, (len(numbers), 3))

    def _check_count(self, name: str, given: int, counts: Sequence[int]) -> None:
        if given not in counts:
            wanted = " or ".join(map(str, counts))
            raise InputError(f"{self._where}: {name} is in {wanted} columns, but {given} are picked; pick {wanted}.")

    def _unit(self, entry: Entry, header: str | None = None) -> float:
        """What a number of the table or manifest is multiplied by; ``header``: the unit that the table states."""
        units = ANGLE_UNITS if entry.unit in ("rad", "1") else LENGTH_UNITS
        name, usual = entry.name, self._preset.units.get(entry.name)
        unit = checked_unit(self._where, name, header, self._table.units.get(name), usual, units)
        if unit is None and entry.unit == "1":
            raise InputError(f"{self._where} has angles without a unit; give units = {{ {name} = 'deg' }}.")
        if unit is None:
            return 1.0
        return units[unit] ** (2 if entry.unit == "mm^2" else 1)

    def _rotations(self, entry: Entry, numbers: np.ndarray, header: str | None) -> np.ndarray:
        from scipy.spatial.transform import Rotation

        convention = self._table.rotation or self._preset.rotation
        if convention is None:
            raise InputError(
                f"{self._where} does not say how its rotations are written; give rotation = "
                f"{', '.join(NUMBERS_OF_ROTATION)}, or three axes such as XYZ or xyz."
            )
        self._check_count(entry.name, numbers.shape[1], (NUMBERS_OF_ROTATION.get(convention, 3),))
        if convention == "matrix":
            return numbers.reshape(-1, 3, 3)
        if convention.startswith("quaternion"):
            if not np.allclose(np.linalg.norm(numbers, axis=1), 1, atol=1e-3):
                raise InputError(f"{self._where} has quaternions that are not of length 1; pick their four columns.")
            return Rotation.from_quat(numbers, scalar_first=convention.endswith("wxyz")).as_matrix()
        numbers = numbers * self._unit(entry, header)
        rotations = (
            Rotation.from_rotvec(numbers) if convention == "vector" else Rotation.from_euler(convention, numbers)
        )
        return rotations.as_matrix()

    def stated(self, values: Mapping[str, str]) -> dict[str, Any]:
        """What the manifest itself states, in mm and rad."""
        stated: dict[str, Any] = {}
        for entry in self._kind.entries:
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

    def check_complete(self, given: set[str]) -> None:
        """Raise `InputError` where something that the kind needs is nowhere."""
        for name, entry in self._entries.items():
            if entry.required and name not in given:
                place = (
                    f"pick its columns with columns = {{ {name} = ... }}"
                    if entry.dimensions[:1] == ("pose",)
                    else "state it"
                )
                raise InputError(f"{self._where} has no '{name}' ({entry.says}); {place}.")
