"""What the header of a text table says: units, and which names are numbered."""

import difflib
import re

from ..core.units import ANGLE_UNITS, LENGTH_UNITS

# Units as header lines state them, after a name ("X [mm]", "X (mm)", "x_mm", "x, mm"), as this package names them.
_UNITS = {name: name for name in (*ANGLE_UNITS, *LENGTH_UNITS, "counts")} | {
    "\u00b5m": "um", "\u03bcm": "um", "in": "inch", "inches": "inch", "\u00b0": "deg", "degree": "deg",
    "degrees": "deg", "radian": "rad", "radians": "rad", "grad": "gon", "as": "arcsec", "count": "counts",
    "cts": "counts", "ticks": "counts", "inc": "counts", "increments": "counts", "pulses": "counts",
}  # fmt: skip
# Those that cannot be converted, or are of other quantities.
_OTHERS = {*("cm", "dm", "nm", "ft", "mil", "arcmin", "urad", "rev", "turns", "s", "ms", "us", "h", "-", "%", "k"),
           *("\u00b0c", "degc", "n", "nm", "v", "a", "hz", "rad/s", "deg/s", "\u00b0/s")}  # fmt: skip
_IN_BRACKETS = re.compile(r"\s*(?:\[([^\]]*)\]|\(([^)\d]*)\))\s*$")
# "_m" may mean anything, and so may a single letter after a blank.
_AFTER_NAME = re.compile(r"(?:_|[ ,/]\s*)(mm|um|inch|deg|rad|arcsec|gon|mrad|counts|\u00b0)$", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"(.*?)([0-9]+)([^0-9]*)", re.DOTALL)
_ALIKE = 0.6  # similarity from which a word in round brackets is a misspelt unit


def _inside(cell: str) -> str:
    """What is inside the brackets, if there are any."""
    found = _IN_BRACKETS.fullmatch(cell)
    return ((found[1] or found[2] or "") if found else cell).strip().casefold()


def _is_unit(cell: str) -> bool:
    return _inside(cell) in _UNITS or _inside(cell) in _OTHERS


def with_units(names: list[str], cells: list[str]) -> list[str] | None:
    """Names with the units of a row of their own in brackets; None where the cells are not units.

    Without names, one must be of lengths or angles, as the names of columns may be letters.
    """
    known = _is_unit if any(names) else lambda cell: _inside(cell) in _UNITS
    if not any(map(known, cells)) or not all(_is_unit(cell) or not cell for cell in cells):
        return None
    return [f"{name} [{_inside(cell)}]" if cell else name for name, cell in zip(names, cells, strict=True)]


def unit_in(name: str) -> str | None:
    """The unit in a column's name; None where it states none.

    What stands in square brackets is a unit, also where nobody knows it; so is what is nearly one in round brackets.
    """
    name = name.casefold()
    bracketed, after = _IN_BRACKETS.search(name), _AFTER_NAME.search(name)
    unit = _inside(bracketed[0]) if bracketed else after[1] if after else ""
    if unit in _UNITS or unit in _OTHERS:
        return _UNITS.get(unit, unit)
    square = bracketed is not None and bracketed[1] is not None and re.search(r"[^\W\d_]", unit)
    return unit if square or (unit and difflib.get_close_matches(unit, _UNITS, n=1, cutoff=_ALIKE)) else None


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
    return name if unit_in(name) is None else _AFTER_NAME.sub("", _IN_BRACKETS.sub("", name))


def stem_and_number(name: str) -> tuple[str, int] | None:
    """A numbered name without its last number and its unit, and that number; None where it is not numbered."""
    found = _LAST_NUMBER.fullmatch(bare_name(name))
    return (f"{found[1]}#{found[3]}", int(found[2][:9])) if found else None
