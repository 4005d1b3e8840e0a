"""Text from outside: what is a number, and what may be printed; and lists and numbers in sentences."""

import csv
import io
import re
import unicodedata
from collections.abc import Iterable, Sequence

# Python's ``float`` also accepts what people do not write as a number: 1_0, digits of other scripts, blanks around it.
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|[+-]?(?:nan|inf|infinity)", re.IGNORECASE)
_BEGINS_FORMULA = ("=", "+", "-", "@", "\t")  # in the cell of a spreadsheet
_LONGEST = 60  # characters of a text that a message quotes
_LONGEST_NAME, _LONGEST_SENTENCE = 400, 1000
_LARGE_F = 1000
MODEL_CHOSEN = "Model of the joints"  # begins the sentence of the choice of a model
_LONG_NAME = re.compile(rf"\S{{{_LONGEST_NAME + 1},}}")
# Marks that are not seen, or change the direction of what follows, so that a text reads otherwise than it is.
_MARKS = frozenset("\ufeff\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


def number(text: str) -> float:
    """The number that a text is in plain decimal digits; ``ValueError`` for any other text."""
    if _NUMBER.fullmatch(text) is None:
        raise ValueError(f"{text!r} is not a number")
    return float(text)


def is_number(text: str) -> bool:
    """Whether `number` takes the text."""
    return _NUMBER.fullmatch(text) is not None


def is_control(character: str) -> bool:
    """Whether a character acts on a terminal instead of being shown: ESC, NUL, marks of direction; not a line's end."""
    return character not in "\n\r\t" and (unicodedata.category(character) in ("Cc", "Zl", "Zp") or character in _MARKS)


def printable(text: str) -> str:
    """The text with escapes such as ``\\x1b`` instead of characters that act on a terminal."""
    if text.isprintable():
        return text
    return "".join(
        character.encode("unicode_escape").decode() if is_control(character) or character == "\r" else character
        for character in text
    )


def quoted(text: str) -> str:
    """The text in quotes as a message shows it: printable, and cut where it is long."""
    return f"'{printable(text if len(text) <= _LONGEST else text[:_LONGEST] + '...')}'"


def in_short(sentence: str) -> str:
    """A sentence that holds names from outside, at a length that people read; what is cut out is in the middle.

    Names without blanks are cut first, so that what the sentence says of them remains.
    """
    sentence = _LONG_NAME.sub(lambda name: _middle_out(name[0], _LONGEST_NAME), sentence)
    return _middle_out(sentence, _LONGEST_SENTENCE)


def _middle_out(text: str, most: int) -> str:
    half = (most - 3) // 2
    return text if len(text) <= most else f"{text[:half]}...{text[-half:]}"


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Rows as CSV; a text that a spreadsheet would calculate (``=1+1.h5``) has an apostrophe before it.

    Spreadsheets take ``= + - @`` and a tab as the beginning of a formula, whoever chose the name of the file or socket
    in that cell. `TextTable` reads such a cell without the apostrophe.
    """
    stream = io.StringIO()

    def written(cell: object) -> object:
        text = printable(cell) if isinstance(cell, str) else ""  # a carriage return would end the row
        formula = text.startswith(_BEGINS_FORMULA) and not is_number(text)
        return f"'{text}" if formula else text or cell

    csv.writer(stream, lineterminator="\n").writerows(map(written, row) for row in rows)
    return stream.getvalue()


def shorten(items: Sequence[str], most: int = 5) -> str:
    """The first items of a list, and how many more there are."""
    return ", ".join(items[:most]) + (f" and {len(items) - most} more" if len(items) > most else "")


def listed(items: Iterable[str]) -> str:
    """Different items in words: "a, b and c"."""
    *first, last = dict.fromkeys(items)
    return f"{', '.join(first)} and {last}" if first else last


def common_labels(groups: Sequence[Sequence[str]]) -> list[str]:
    """What the names of each group have in common before the last "/", such as a placement; the first of the names
    where they have nothing in common, or another group has the same."""
    labels = []
    for names in groups:
        folders = {name.rpartition("/")[0] for name in names}
        alike = len(names) > 1 and len(folders) == 1 and "" not in folders
        labels.append(folders.pop() if alike else "")
    return [
        label if label and labels.count(label) == 1 else shorten(names, 3)
        for label, names in zip(labels, groups, strict=True)
    ]


def pluralise(number: int, noun: str) -> str:
    """A number of things: ``1 socket``, ``2 sockets``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def f_text(ratio: float) -> str:
    """An F statistic in sentences and tables; beyond every critical value, only that it is."""
    return f"= {ratio:.3g}" if ratio < _LARGE_F else f"> {_LARGE_F}"
