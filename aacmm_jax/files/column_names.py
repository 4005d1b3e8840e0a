"""What the header of a text table says: units, and which names are numbered."""

import difflib
import re
from collections.abc import Sequence

from ..core.units import ANGLE_UNITS, LENGTH_UNITS

AMBIGUOUS = "grad"  # deg in German, gon elsewhere
# Units as header lines state them ("X [mm]", "X (mm) raw", "x_mm", "x, mm", "q_deg_1"), as this package names them.
_SPELT_OUT = {
    "mm": "millimeter millimeters millimetre millimetres", "m": "meter meters metre metres",
    "um": "\u00b5m \u03bcm micron microns micrometer micrometers micrometre micrometres", "inch": "in inches",
    "deg": "\u00b0 degs degree degrees", "rad": "rads radian radians", "mrad": "milliradian milliradians",
    "gon": "gons gradian gradians", "arcsec": "as arcsecs arcsecond arcseconds",
    "counts": "count cts ticks inc increments pulses",
}  # fmt: skip
_UNITS = {name: name for name in (*ANGLE_UNITS, *LENGTH_UNITS, "counts", AMBIGUOUS)} | {
    word: unit for unit, words in _SPELT_OUT.items() for word in words.split()
}
# Those that cannot be converted, or are of other quantities.
_OTHERS = {*("cm", "dm", "nm", "ft", "feet", "mil", "arcmin", "urad", "mdeg", "rev", "turns", "s", "ms", "us", "h"),
           *("centimeter", "centimeters", "centimetre", "centimetres", "-", "%", "k", "\u00b0c", "degc", "n", "v", "a"),
           *("hz", "rad/s", "deg/s", "\u00b0/s")}  # fmt: skip
_IN_BRACKETS = re.compile(r"\s*(?:\[([^\]]*)\]|\(([^)\d]*)\))\s*$")
_BRACKETED = re.compile(r"[\[(]([^\])]*)[\])]")
# "_m" may mean anything, and so may each single letter, "in" and "as".
_WORDS = {unit for unit in (*_UNITS, *_OTHERS) if len(unit) > 1 or unit == "\u00b0"} - {"in", "as"}
_LONGEST_FIRST = "|".join(map(re.escape, sorted(_WORDS, key=len, reverse=True)))  # rad/s before rad
_WORD = re.compile(rf"(?:^|[_\s,.:/-]+)({_LONGEST_FIRST})(?=$|[_\s,.:/-])", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"(.*?)([0-9]+)([^0-9]*)", re.DOTALL)
_ALIKE = 0.6  # similarity from which a word in round brackets is a misspelt unit


def _inside(cell: str) -> str:
    """What is inside the brackets, if there are any."""
    found = _IN_BRACKETS.fullmatch(cell)
    return ((found[1] or found[2] or "") if found else cell).strip().casefold()


def _is_unit(cell: str) -> bool:
    return _inside(cell) in _UNITS or _inside(cell) in _OTHERS


def are_units(cells: list[str], alone: bool) -> bool:
    """Whether cells are a row of units: all of them, or most by whole words, or one misspelt unit for all.

    ``alone``: there are no names, so that one must be of lengths or angles, as the names of columns may be letters.
    """
    texts = [_inside(cell) for cell in cells if cell]
    if not texts:
        return False
    if all(map(_is_unit, texts)):
        return not alone or any(text in _UNITS for text in texts)
    return 2 * sum(text in _WORDS for text in texts) > len(texts) or (
        len(set(texts)) == 1 and len(texts[0]) > 3 and _nearly_unit(texts[0])
    )


def with_units(names: list[str], cells: list[str]) -> list[str]:
    """Names with the units of a row of their own in brackets; one that nobody knows is refused where it is picked."""
    return [f"{name} [{_inside(cell)}]" if cell else name for name, cell in zip(names, cells, strict=True)]


def _nearly_unit(text: str) -> bool:
    return bool(difflib.get_close_matches(text, _UNITS, n=1, cutoff=_ALIKE))


def unit_in(name: str) -> str | None:
    """The unit in a column's name; None where it states none.

    What stands in square brackets is a unit, also where nobody knows it; so is what is nearly one in round brackets.
    Brackets come before words.
    """
    name = name.casefold()
    bracketed = _IN_BRACKETS.search(name)
    unit = _inside(bracketed[0]) if bracketed else ""
    inside = [unit, *(text.strip() for text in _BRACKETED.findall(name))]
    square = bracketed is not None and bracketed[1] is not None and re.search(r"[^\W\d_]", unit)
    unknown = [unit] if square or (unit and _nearly_unit(unit)) else []
    found = next(iter([*filter(_is_unit, inside), *unknown, *_WORD.findall(name)[::-1]]), None)
    return None if found is None else _UNITS.get(found, found)


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
    found = _LAST_NUMBER.fullmatch(bare_name(name))
    return (f"{found[1]}#{found[3]}", int(found[2][:9])) if found else None


def along_axes(names: Sequence[str]) -> list[int] | None:
    """The places of names in the order w, x, y, z, where they differ in nothing but these; None where they do not."""
    plain = [plain_name(name) for name in names]
    if len(set(map(len, plain))) > 1:
        return None
    letters = [column for column in zip(*plain, strict=True) if len(set(column)) > 1]
    if len(letters) != 1 or not set(letters[0]) <= set("wxyz") or len(set(letters[0])) < len(names):
        return None
    return [letters[0].index(letter) for letter in sorted(letters[0])]
