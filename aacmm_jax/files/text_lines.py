"""Lines and cells of a text table, and what the lines above its rows say: names of columns, units, and numbers."""

import codecs
import contextlib
import csv
import difflib
import fnmatch
import itertools
import os
import re
from collections.abc import Sequence

from ..core.errors import InputError
from ..core.text import is_number, quoted, shorten
from ..core.units import ANGLE_UNITS, LENGTH_UNITS
from .inputs import InputFile

# A table of numbers takes twelve times its size as Python objects: 128 MiB, a million poses, take 1.5 GiB. One of
# digits and ends of lines takes a hundred times its size, so that lines are limited, too.
TABLE_SHARE = 1 / 8
_MOST_LINES = 2_000_000
_LONGEST_LINE = 2**20  # characters; ten thousand columns have a tenth of it
_DELIMITERS = (";", "\t", ",")
_SAMPLED = 50  # lines from which the delimiter is found
_LATIN = b"\xb0\xb5"  # degree sign and mu in the 8-bit encodings of recorders, western and Cyrillic
_BLANKS = re.compile("[ \t]+")
_BLANKS_OR_QUOTES = re.compile('"[^"]*"|[^ \t]+')


def table_lines(path: str | os.PathLike) -> tuple[list[str], bool]:
    """The lines of a text file, and whether its last line is ended.

    UTF-8, UTF-16 with a byte order mark (spreadsheets' "Unicode text"), and the degree sign of 8-bit encodings. What is
    not text, or larger than a table is, is refused before it is decoded.
    """
    content = (path if isinstance(path, InputFile) else InputFile(path, TABLE_SHARE)).content
    sixteen = content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    latin = not set(content.translate(None, bytes(range(128)))) - set(_LATIN)
    if max(map(content.count, (b"\n", b"\r"))) > _MOST_LINES:
        raise InputError(f"{path} has more than the {_MOST_LINES:,} lines that a text table may have; split the table.")
    try:
        text = content.decode("utf-16" if sixteen else "latin-1" if latin else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise InputError(f"{path} cannot be read as text; save it as text in UTF-8.")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for line_number, line in enumerate(lines, start=1):
        if len(line) > _LONGEST_LINE:  # which would take minutes to divide into cells
            raise InputError(
                f"{path} line {line_number} is longer than 1 MiB, so it is not a row of a table; check the file."
            )
    return lines, not lines[-1]


def delimiter_of(lines: Sequence[str], decimal: str | None) -> str:
    """The delimiter of most of the last lines: semicolon, tab, comma (not with decimal commas), or a blank."""
    sample = [line for line in lines[: 4 * _SAMPLED] if line.strip(" \t") and not line.startswith("#")][:_SAMPLED]
    sample = sample[len(sample) // 2 :]  # lines before the table are first
    for delimiter in _DELIMITERS:
        if delimiter != decimal and 2 * sum(delimiter in line for line in sample) > len(sample):
            return delimiter
    between_quotes = sum('",' in line or ',"' in line for line in sample)  # "27,392","46,043"
    return "," if 2 * between_quotes > len(sample) else " "


def decimal_of(lines: Sequence[str], delimiter: str) -> str:
    """The decimal mark of the last lines: a comma where they have commas, but no points, between other delimiters."""
    sample = "".join(lines[-_SAMPLED:])
    return "," if delimiter != "," and "," in sample and "." not in sample else "."


def cells_of(line: str, delimiter: str, header: bool = False) -> list[str]:
    """The cells of a line; one in double quotes may hold the delimiter."""
    if delimiter == " ":
        # In a line of names, a unit belongs to the name before it.
        line = re.sub(r"[ \t]+(?=[\[(])", "", line) if header else line
        if '"' in line:
            return [cell.strip('"').strip(" \t") for cell in _BLANKS_OR_QUOTES.findall(line)]
        return _BLANKS.split(line.strip(" \t"))
    cells = line.split(delimiter)
    if '"' in line:
        # A quote that does not end: its cells are refused where they are picked.
        with contextlib.suppress(csv.Error):
            cells = next(csv.reader([line], delimiter=delimiter, strict=True, skipinitialspace=True))
    return [cell.strip(" \t") for cell in cells]


AMBIGUOUS = "grad"  # deg in German, gon elsewhere
# Units as header lines state them ("X [mm]", "X (mm) raw", "x_mm", "x, mm", "q_deg_1"), as this package names them.
_SPELT_OUT = {
    "mm": "millimeter millimeters millimetre millimetres", "m": "meter meters metre metres",
    "um": "\u00b5m \u03bcm micron microns micrometer micrometers micrometre micrometres", "inch": "in inches",
    "deg": "\u00b0 degs degree degrees", "rad": "rads radian radians", "mrad": "milliradian milliradians",
    "gon": "gons gradian gradians", "arcsec": "as arcsecs arcsecond arcseconds",
    "counts": "count cts ticks inc increments pulses",
}  # fmt: skip
SI = "SI"  # rad of revolute joints and m of prismatic ones
_UNITS = (
    {name: name for name in (*ANGLE_UNITS, *LENGTH_UNITS, "counts", AMBIGUOUS)}
    | {"si": SI}
    | {word: unit for unit, words in _SPELT_OUT.items() for word in words.split()}
)
# Those that cannot be converted, or are of other quantities.
_OTHERS = {*("cm", "dm", "nm", "ft", "feet", "mil", "arcmin", "urad", "mdeg", "rev", "turns", "s", "ms", "us", "h"),
           *("centimeter", "centimeters", "centimetre", "centimetres", "-", "%", "k", "\u00b0c", "degc", "n", "v", "a"),
           *("hz", "rad/s", "deg/s", "\u00b0/s")}  # fmt: skip
_IN_BRACKETS = re.compile(r"\s*(?:\[([^\]]*)\]|\(([^)\d]*)\))\s*$")
_BRACKETED = re.compile(r"[\[(]([^\])]*)[\])]")
# "_m" may mean anything, and so may each single letter, "in" and "as".
_WORDS = {unit for unit in (*_UNITS, *_OTHERS) if len(unit) > 1 or unit == "\u00b0"} - {"in", "as", "si"}
_LONGEST_FIRST = "|".join(map(re.escape, sorted(_WORDS, key=len, reverse=True)))  # rad/s before rad
_WORD = re.compile(rf"(?:^|[_\s,.:/-]+)({_LONGEST_FIRST})(?=$|[_\s,.:/-])", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"(.*?)([0-9]+)([^0-9]*)", re.DOTALL)
_ALIKE = 0.6  # similarity from which a word in round brackets is a misspelt unit
_LIKE_A_NUMBER = re.compile(r"[\"']?\s*[-+\u2212\u2013(=$<>~]*\s*[.,]?\d")  # digits of any script
_NO_VALUE = frozenset(["na", "n/a", "#n/a", "null", "none", "nan", "-", ""])

Column = str | int
Line = tuple[int, list[str]]  # the number of a line in its file, and its cells


def _inside(cell: str) -> str:
    """What is inside the brackets, if there are any."""
    match = _IN_BRACKETS.fullmatch(cell)
    return ((match[1] or match[2] or "") if match else cell).strip().casefold()


def _is_unit(cell: str) -> bool:
    return _inside(cell) in {*_UNITS, *_OTHERS}


def _nearly_unit(text: str) -> bool:
    return bool(difflib.get_close_matches(text, _UNITS, n=1, cutoff=_ALIKE))


def are_units(cells: list[str], alone: bool) -> bool:
    """Whether cells are a row of units: all of them, or most by whole words, or one misspelt unit for all; ``alone``,
    without names, one must be of lengths or angles, as the names of columns may be letters."""
    texts = [_inside(cell) for cell in cells if cell]
    if texts and all(map(_is_unit, texts)):
        return not alone or any(text in _UNITS for text in texts)
    misspelt = len(set(texts)) == 1 and len(texts[0]) > 3 and _nearly_unit(texts[0])
    return misspelt or 2 * sum(text in _WORDS for text in texts) > len(texts)


def unit_in(name: str) -> str | None:
    """The unit in a column's name; None where it states none.

    What stands in square brackets is a unit, even an unknown one; so is what is nearly one in round brackets.
    Brackets come before words.
    """
    name = name.casefold()
    bracketed = _IN_BRACKETS.search(name)
    unit = _inside(bracketed[0]) if bracketed else ""
    inside = [unit, *(text.strip() for text in _BRACKETED.findall(name))]
    square = bracketed is not None and bracketed[1] is not None and re.search(r"[^\W\d_]", unit)
    unknown = [unit] if square or (unit and _nearly_unit(unit)) else []
    stated = next(iter([*filter(_is_unit, inside), *unknown, *_WORD.findall(name)[::-1]]), None)
    return None if stated is None else _UNITS.get(stated, stated)


def plain_name(name: str) -> str:
    """A column's name, or a pattern, without case, quotes, unit in brackets and more than single blanks."""
    name = name.strip("\"'")
    bracketed = _IN_BRACKETS.search(name)
    if bracketed and (_is_unit(bracketed[0].strip()) or not bracketed[0].strip(" []()")):
        name = name[: bracketed.start()]  # and not the characters of a pattern
    return " ".join(name.casefold().split())


def bare_name(name: str) -> str:
    """A column's name without quotes and unit."""
    name = name.strip("\"' ")
    return name if unit_in(name) is None else _WORD.sub("", _IN_BRACKETS.sub("", name))


def stem_and_number(name: str) -> tuple[str, int] | None:
    """A numbered name without its last number and its unit, and that number; None where it is not numbered."""
    match = _LAST_NUMBER.fullmatch(bare_name(name))
    return (f"{match[1]}#{match[3]}", int(match[2][:9])) if match else None


def along_axes(names: Sequence[str]) -> list[int] | None:
    """The places of names in the order w, x, y, z, where they differ in nothing but these; None where they do not."""
    plain = [plain_name(name) for name in names]
    letters = [column for column in itertools.zip_longest(*plain) if len(set(column)) > 1]
    if len(letters) != 1 or not set(letters[0]) <= set("wxyz") or len(set(letters[0])) < len(names):
        return None
    return [letters[0].index(letter) for letter in sorted(letters[0])]


def has_number(cells: list[str]) -> bool:
    """Whether a cell begins like a number, perhaps after a sign or currency."""
    return any(map(_LIKE_A_NUMBER.match, cells))


def is_row(cells: list[str]) -> bool:
    """Whether a line before the first row is a row itself: it has a number, or nothing but words for missing ones."""
    return all(cell.casefold() in _NO_VALUE for cell in cells) or has_number(cells) or any(map(is_number, cells))


def names_of_columns(
    path: str | os.PathLike, width: int, words: Sequence[Line], comments: Sequence[Line], wanted: Sequence[Column]
) -> list[str]:
    """The names of the columns, perhaps with units from a line of their own; none where they are not named.

    Comments may name the columns where no line of ``words`` above the first row does. Where several lines may be the
    names, it is the one that has the columns that are ``wanted``, or numbered ones; else `InputError`.
    """
    lines = [(line, cells) for line, cells in words if len(cells) == width]
    units = [cells for _, cells in lines if are_units(cells, alone=len(lines) == 1)]
    if len(units) == len(lines) < 2 and (lines or not words or len(words[-1][1]) == 1):
        trimmed_comments = [(line, trimmed(cells, width)) for line, cells in comments if not has_number(cells)]
        above = [(line, cells) for line, cells in trimmed_comments if len(cells) == width]
        units += [cells for _, cells in above if are_units(cells, alone=not units and len(above) == 1)]
        lines = above + lines
    names = [(line, cells) for line, cells in lines if cells not in units]
    if not names and len(units) > 1:
        names, units = [(0, units[0])], units[1:]
    if len(names) > 1:
        texts = [column for column in wanted if isinstance(column, str)]
        fitting = [line for line in names if texts and all(matching(line[1], text) for text in texts)]
        (first, upper), (last, lower) = names[0], names[-1]
        names = fitting if len(fitting) == 1 else [line for line in names if are_numbered(line[1])]
        if len(names) != 1:
            raise InputError(
                f"{path} has two lines with words in all columns: line {first} ({quoted(shorten(upper, 3))}) and line "
                f"{last} ({quoted(shorten(lower, 3))}); add skip = {last - 1} if line {last} contains the names of the "
                f"columns, otherwise remove line {last}."
            )
    chosen = names[0][1] if names else [""] * width if units else []
    if not units:
        return chosen
    # An unknown unit is refused where its column is picked.
    return [f"{name} [{_inside(cell)}]" if cell else name for name, cell in zip(chosen, units[-1], strict=True)]


def are_numbered(names: list[str]) -> bool:
    """Whether several names differ in their number only."""
    stems = [(stem.casefold(), i) for stem, i in filter(None, map(stem_and_number, names))]
    return max((len({i for other, i in stems if other == stem}) for stem, _ in stems), default=0) > 1


def matching(header: list[str], column: str) -> list[int]:
    """Indices, from 0, of the names that are this one, or match this pattern."""
    plain = [plain_name(name) for name in header]
    # As it stands first: q[1] is also a pattern, of q1.
    for fits in (str.__eq__, fnmatch.fnmatchcase):
        for names, text in ((header, column), (plain, plain_name(column))):
            indices = [i for i, name in enumerate(names) if fits(name, text)]
            if indices:
                return indices
    return []


def trimmed(cells: list[str], least: int) -> list[str]:
    """Cells without the empty ones at their end."""
    while len(cells) > least and not cells[-1]:
        cells = cells[:-1]
    return cells
