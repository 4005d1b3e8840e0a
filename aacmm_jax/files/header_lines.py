"""Which lines above the rows of a text table name its columns, and which state their units."""

import fnmatch
import os
import re
from collections.abc import Sequence

from ..core.errors import InputError
from ..core.text import is_number, quoted, shorten
from .column_names import are_units, plain_name, stem_and_number, with_units
from .text_lines import cells_of

_LIKE_A_NUMBER = re.compile(r"[\"']?\s*[-+\u2212\u2013(=$<>~]*\s*[.,]?\d")  # digits of any script
_NO_VALUE = frozenset(["na", "n/a", "#n/a", "null", "none", "nan", "-", ""])

Column = str | int
Line = tuple[int, list[str]]  # the number of a line in its file, and its cells


def has_number(cells: list[str]) -> bool:
    """Whether a cell begins like a number, perhaps after a sign or currency."""
    return any(map(_LIKE_A_NUMBER.match, cells))


def is_row(cells: list[str]) -> bool:
    """Whether a line before the first row is a row itself: it has a number, or nothing but words for missing ones."""
    return all(cell.casefold() in _NO_VALUE for cell in cells) or has_number(cells) or any(map(is_number, cells))


def header_cells(line: str, delimiter: str) -> list[str]:
    """The cells of a line of names; between blanks, a unit belongs to the name before it."""
    return stripped(cells_of(re.sub(r"[ \t]+(?=[\[(])", "", line) if delimiter == " " else line, delimiter))


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
        names = [_recognised(path, names, wanted)]
    chosen = names[0][1] if names else [""] * width if units else []
    return with_units(chosen, units[-1]) if units else chosen


def _recognised(path: str | os.PathLike, lines: Sequence[Line], wanted: Sequence[Column]) -> Line:
    """The one line that has all names that are wanted, or numbered ones."""
    texts = [column for column in wanted if isinstance(column, str)]
    found = [line for line in lines if texts and all(matching(line[1], text) for text in texts)]
    found = found if len(found) == 1 else [line for line in lines if are_numbered(line[1])]
    if len(found) != 1:
        (first, above), (last, below) = lines[0], lines[-1]
        raise InputError(
            f"{path} has a word for each column in lines {first} ({quoted(shorten(above, 3))}) and {last} "
            f"({quoted(shorten(below, 3))}); add skip = {last - 1} if line {last} names the columns, or leave it out."
        )
    return found[0]


def are_numbered(names: list[str]) -> bool:
    """Whether several names differ in their number only."""
    stems = [(stem.casefold(), i) for stem, i in filter(None, map(stem_and_number, names))]
    return max((len({i for other, i in stems if other == stem}) for stem, _ in stems), default=0) > 1


def matching(header: list[str], column: str) -> list[int]:
    """Indices, from 0, of the names that are this one, or match this pattern."""
    wanted, plain = plain_name(column), [plain_name(name) for name in header]
    # As it stands first: q[1] is also a pattern, of q1.
    for names, text in ((header, column), (plain, wanted)):
        same = [i for i, name in enumerate(names) if name == text]
        if same:
            return same
    exact = [i for i, name in enumerate(header) if fnmatch.fnmatchcase(name, column)]
    return exact or [i for i, name in enumerate(plain) if fnmatch.fnmatchcase(name, wanted)]


def stripped(cells: list[str]) -> list[str]:
    """Cells without blanks around them."""
    return [cell.strip(" \t") for cell in cells]


def trimmed(cells: list[str], least: int) -> list[str]:
    """Cells without the empty ones at their end."""
    while len(cells) > least and not cells[-1]:
        cells = cells[:-1]
    return cells
