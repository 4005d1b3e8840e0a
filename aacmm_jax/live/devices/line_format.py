"""Lines of text that devices send: how they become readings, described in a TOML or in the text of the device.

``columns`` names what stands in a line, in order: ``q_1`` ... (joints), ``x``, ``y``, ``z`` (a point), ``distance``,
``temperature_C``, ``load_kg``, ``button``, ``skip``, ``time_s`` (of the device's clock), ``number`` (that counts the
lines), or ``-``. ``pattern`` is a regular expression with groups of these names instead. By default a line has one
number a joint.
"""

import binascii
import math
import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ...core.errors import InputError, naming, require
from ...core.text import is_number
from ...core.units import LENGTH_UNITS
from ...files.manifest_tables import Angles
from ...files.toml import Strict, read_toml, validated
from ...kinematics.arm import Arm
from ..samples import BUTTONS, Sample

LONGEST = 4096  # bytes of a line
_LARGEST = 1e9
_TURNS = 50 * math.tau  # rad: no joint has turned as far
_OF_POINTS = ("x", "y", "z")
_OTHERS = ("temperature_C", "load_kg", *BUTTONS)
_KNOWN = re.compile(r"q_\d{1,2}|torque_\d{1,2}|[xyz]|distance|temperature_C|load_kg|button|skip|time_s|number|-")
_PATTERN_TIME = 0.1  # s after which a line is given up that a pattern does not decide
_SEPARATOR = re.compile(r"[;,\s]+")
_UNIT = re.compile(r"_(deg|rad|mm|counts)$")
_MOST_GAP = 1_000_000  # lines that are missing at once, by their numbers


def _crc16(data: bytes) -> int:
    """CRC-16 of Modbus: polynomial 0x8005 reflected, beginning with 0xFFFF."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


def _xor(data: bytes) -> int:
    value = 0
    for byte in data:
        value ^= byte
    return value


CHECKSUMS: dict[str, tuple[Callable[[bytes], int], int]] = {  # and how many hexadecimal digits
    "xor": (_xor, 2),
    "sum": (lambda data: sum(data) & 0xFF, 2),
    "crc16": (_crc16, 4),
    "crc16-ccitt": (lambda data: binascii.crc_hqx(data, 0xFFFF), 4),
}


class LineTable(Strict):
    """The keys of a line format."""

    columns: list[str] | None = None
    pattern: Annotated[str, Field(max_length=1000)] | None = None
    separator: str | None = None  # None: commas, semicolons and blanks
    begins: str = ""  # lines that do not begin so say something else and are passed over
    checksum: Literal["none", "xor", "sum", "crc16", "crc16-ccitt"] = "none"
    checksum_after: str = "*"  # what stands between the text and its checksum
    angles: Angles = Field(default_factory=lambda: Angles(unit="deg"))
    length_unit: Literal["mm", "m", "um", "inch"] = "mm"  # of points and distances


class LineFormat:
    """Turns lines into samples, for an arm, or, with ``joints=0``, for an instrument that sees it.

    Raises `InputError` where the format contradicts itself or the arm.
    """

    def __init__(self, where: str, table: LineTable, arm: Arm):
        self._table, self._arm, self._where = table, arm, where
        if table.columns is not None and table.pattern is not None:
            raise InputError(f"{where} has columns and a pattern; give one of them.")
        self._pattern, names = None, table.columns
        if table.pattern is not None:
            require("live", "a pattern", "regex")
            import regex  # of the standard library's patterns, some take for ever

            try:
                self._pattern = regex.compile(table.pattern)
            except (regex.error, OverflowError, RecursionError) as error:
                raise InputError(f"{where} has a pattern that is no regular expression: {error}.") from error
            names = sorted(self._pattern.groupindex, key=self._pattern.groupindex.__getitem__)
        self._stated = names is not None
        self._set(names if names is not None else [f"q_{i + 1}" for i in range(arm.joints)])
        self._last: int | None = None

    @property
    def has_checksum(self) -> bool:
        """Whether a line that is cut is found."""
        return self._table.checksum != "none"

    def _set(self, names: list[str]) -> None:
        for name in names:
            if not _KNOWN.fullmatch(name):
                raise InputError(
                    f"{self._where} has the column '{name}'; use q_1, q_2, ..., x, y, z, distance, temperature_C, "
                    "load_kg, button, skip, time_s, number, or - for what is not used."
                )
        twice = [name for name in names if name != "-" and names.count(name) > 1]
        if twice:
            raise InputError(f"{self._where} has the column '{twice[0]}' twice; name it once.")
        joints = [f"q_{i + 1}" for i in range(self._arm.joints)]
        read = [name for name in names if name.startswith("q_")]
        if read and sorted(read) != sorted(joints):
            raise InputError(
                f"{self._where} has {len(read)} joints ({', '.join(read)}), but the arm has {len(joints)}; name the "
                f"columns q_1 to q_{len(joints)}."
            )
        points = [name for name in names if name in _OF_POINTS]
        if points and len(points) != 3:
            raise InputError(f"{self._where} has the column {points[0]}; a point needs x, y and z.")
        self._names, self.joints = names, len(read)
        self._joints = [names.index(name) for name in joints] if read else []
        self._points = [names.index(name) for name in _OF_POINTS] if points else []
        self._others = {name: i for i, name in enumerate(names) if name in _OTHERS or name.startswith("torque_")}

    def connected(self) -> None:
        """Forget the number of the last line: the device begins to count anew where it was switched off."""
        self._last = None

    def sample(self, line: bytes, time: float) -> tuple[Sample | None, str, int]:
        """The sample of a line; why there is none, where the line is bad; and how many lines are missing before it."""
        if len(line) > LONGEST:
            return None, f"longer than {LONGEST} characters", 0
        try:
            text = line.decode("ascii").strip()
        except UnicodeDecodeError:
            return None, "not text", 0
        if not text or not text.startswith(self._table.begins):
            return None, "", 0
        text = text[len(self._table.begins) :]
        if self.has_checksum:
            text, mark, given = text.rpartition(self._table.checksum_after)
            compute, digits = CHECKSUMS[self._table.checksum]
            if not mark or f"{compute(text.encode()):0{digits}X}" != given.strip().upper():
                return None, "wrong checksum", 0
        return self._read(text, time)

    def _read(self, text: str, time: float) -> tuple[Sample | None, str, int]:
        if self._pattern is not None:
            try:
                match = self._pattern.fullmatch(text, timeout=_PATTERN_TIME)
            except TimeoutError:
                return None, "takes the pattern too long", 0
            if match is None:
                return None, "does not match the pattern", 0
            cells = [match[name] or "" for name in self._names]
        else:
            separator = self._table.separator
            cells = [c for c in _SEPARATOR.split(text) if c] if separator is None else text.split(separator)
            if not self._stated and cells and not any(is_number(cell.strip()) for cell in cells):
                return None, self._header(cells), 0
        if len(cells) != len(self._names):
            return None, "wrong number of values", 0
        values = []
        for name, cell in zip(self._names, cells, strict=True):
            cell = cell.strip()
            if name == "-":
                values.append(0.0)
                continue
            if not is_number(cell) or not abs(float(cell)) <= _LARGEST:
                return None, "not a number", 0
            values.append(float(cell))
        return self._made(values, time)

    @property
    def read_as(self) -> tuple[int, ...] | None:
        """`Recording.read_as` of its lines."""
        return self._table.angles.read_as(self._arm.joints)

    def _header(self, cells: list[str]) -> str:
        """Take the names of a table's header, where these are columns that are known."""
        names = [_UNIT.sub("", cell.strip("\"'")) for cell in cells]
        try:
            self._set([name if _KNOWN.fullmatch(name) else "-" for name in names])
        except InputError:
            return "a header that is not clear"
        units = {unit[1] for cell in cells if cell.startswith("q_") and (unit := _UNIT.search(cell))} - {"mm"}
        if len(units) == 1:
            stated = self._table.angles.model_dump(exclude_unset=True) | {"unit": units.pop()}
            self._table = self._table.model_copy(update={"angles": Angles.model_validate(stated)})
        self._stated = True
        return ""

    def _made(self, values: list[float], time: float) -> tuple[Sample | None, str, int]:
        row = np.array(values)
        missing = 0
        if "number" in self._names:
            number = int(row[self._names.index("number")])
            if number == self._last:
                return None, "sent twice", 0
            if self._last is not None and self._last < number <= self._last + _MOST_GAP:
                missing = number - self._last - 1
            self._last = number
        q = None
        if self._joints:
            q = self._table.angles.converted(row[None, self._joints], self._arm)[0]
            if np.any(np.abs(q[[i not in self._arm.prismatic for i in range(1, len(q) + 1)]]) > _TURNS):
                return None, "beyond 50 turns", missing
        unit, measured = LENGTH_UNITS[self._table.length_unit], {}
        if self._points:
            measured["points"] = row[self._points] * unit
        if "distance" in self._names:
            measured["values"] = np.array(row[self._names.index("distance")] * unit)
        columns = {name: float(row[i]) for name, i in self._others.items()}
        if "time_s" in self._names:
            time = float(row[self._names.index("time_s")])
        return Sample(time, q, columns, measured), "", missing


def format_of_lines(device: str, options: Mapping[str, str], arm: Arm) -> LineFormat:
    """The format that the options of a device state: ``format=FILE.toml``, or its keys."""
    where = f"the line format of {device}"
    if "format" in options:
        if len(options) > 1:
            other = next(name for name in options if name != "format")
            raise InputError(f"device {device} has format and {other}; state {other} in the format's file.")
        with naming(options["format"]):
            return LineFormat(options["format"], read_toml(options["format"], LineTable), arm)
    stated: dict[str, Any] = dict(options)
    angles = {
        key: _number_or_text(stated.pop(key)) for key in options if key in Angles.model_fields and key != "columns"
    }
    if "columns" in options:
        stated["columns"] = [name.strip() for name in options["columns"].split(",")]
    if angles:
        stated["angles"] = {"unit": "deg"} | angles
    return LineFormat(where, validated(LineTable, stated, where), arm)


def _number_or_text(text: str) -> Any:
    """A value of an option: numbers between commas are a list."""
    cells = text.split(",")
    if not all(is_number(cell) for cell in cells):
        return text
    numbers = [int(cell) if re.fullmatch(r"[+-]?\d+", cell) else float(cell) for cell in cells]
    return numbers if len(numbers) > 1 else numbers[0]
