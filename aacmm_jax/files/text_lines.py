"""Lines and cells of a text table, from the bytes that recorders and spreadsheets write."""

import codecs
import csv
import os
import re
from collections.abc import Sequence

from ..core.errors import InputError
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
        raise InputError(f"{path} has more than the {_MOST_LINES:,} lines that a text table may have; divide it.")
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


def delimiter_of(lines: Sequence[str], decimal: str) -> str:
    """The delimiter of most of the last lines: semicolon, tab, comma (not with decimal commas), or a blank."""
    sample = [line for line in lines[: 4 * _SAMPLED] if line.strip(" \t") and not line.startswith("#")][:_SAMPLED]
    sample = sample[len(sample) // 2 :]  # lines before the table are first
    for delimiter in _DELIMITERS:
        if delimiter != decimal and 2 * sum(delimiter in line for line in sample) > len(sample):
            return delimiter
    between_quotes = sum('",' in line or ',"' in line for line in sample)  # "27,392","46,043"
    return "," if 2 * between_quotes > len(sample) else " "


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of a line, not stripped; one in double quotes may hold the delimiter."""
    if delimiter == " ":
        if '"' in line:
            return [cell.strip('"') for cell in _BLANKS_OR_QUOTES.findall(line)]
        return _BLANKS.split(line.strip(" \t"))
    if '"' in line:
        try:
            return next(csv.reader([line], delimiter=delimiter, strict=True, skipinitialspace=True))
        except csv.Error:
            pass  # a quote that does not end: its cells are refused where they are picked
    return line.split(delimiter)
