"""Parts of a printed page, and what is read for them from a Digital Calibration Certificate (DCC)."""

import math
from collections.abc import Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

from ..core.errors import InputError
from .languages import Language
from .xml_elements import CELSIUS, MILLIMETRE, ONE, PREFIXES, RADIAN, decimals_of, rounded

MOST_ROWS = 6  # of a table: the certificate has two pages
_LEAST = 1e-9  # mm or rad, below which a value without uncertainty is rounding
VALUE, UNCERTAINTY = "si:real/si:value", "si:real/si:measurementUncertaintyUnivariate/"
_UNITS = {MILLIMETRE: "mm", RADIAN: "rad", CELSIUS: "°C", ONE: ""}


class Section(NamedTuple):
    """A part of a page: a title, and below it what is not empty, in this order."""

    title: str
    facts: Sequence[tuple[str, str]] = ()  # labels and values
    paragraphs: Sequence[str] = ()
    headings: Sequence[str] = ()  # of the table
    table: Sequence[Sequence[str]] = ()
    texts: int = 1  # columns of the table, from the first, that are texts; the others are numbers
    notes: Sequence[str] = ()
    signatures: Sequence[tuple[str, str]] = ()  # names and roles


def first(parent: Element, path: str) -> Element:
    """The first element of a path, or `InputError`."""
    found = parent.find(path, PREFIXES)
    if found is None:
        raise InputError(f"the certificate has no {path.rpartition(':')[2]}; give a DCC that aacmm wrote.")
    return found


def content(parent: Element | None, path: str) -> str:
    """The text of a ``dcc:name`` or the like, "" where there is none."""
    return "" if parent is None else parent.findtext(f"{path}/dcc:content", "", PREFIXES) or ""


def named_in(parent: Element | None, path: str) -> dict[str, Element]:
    """Elements of a path by their names."""
    return {} if parent is None else {content(x, "dcc:name"): x for x in parent.iterfind(path, PREFIXES)}


def identification(item: Element, name: str) -> str:
    """A number of a thing, "" where it has none of this name."""
    for number in item.iterfind("dcc:identifications/dcc:identification", PREFIXES):
        if content(number, "dcc:name") == name:
            return number.findtext("dcc:value", "", PREFIXES)
    return ""


def value_of(quantity: Element) -> str:
    """The value of a ``si:real``."""
    return shortened(quantity.findtext(VALUE, "", PREFIXES))


def shortened(text: str) -> str:
    """A number as the DCC has it, but of those that were given to 17 digits at most 7, and none below 1e-9."""
    if len(text.partition(".")[2]) <= 8 and "e" not in text.lower():
        return text
    short = f"{float(text):.7g}" if abs(float(text)) >= _LEAST else "0.0"
    return short if {*".e"} & {*short} else f"{short}.0"


def in_degrees(quantity: Element) -> tuple[str, str]:
    """Value and expanded uncertainty ("" where there is none); angles in degrees, with two digits of U or else seven
    of the value."""
    value, expanded = value_of(quantity), expanded_of(quantity)[0]
    if quantity.findtext("si:real/si:unit", "", PREFIXES) != RADIAN:
        return value, expanded
    degrees = math.degrees(float(quantity.findtext(VALUE, "", PREFIXES)))
    if not expanded:
        return shortened(f"{degrees:.17e}"), ""
    u = math.degrees(float(expanded))
    return tuple(rounded(x, decimals_of(u)) for x in (degrees, u))  # pyright: ignore[reportReturnType]


def expanded_of(quantity: Element) -> tuple[str, str]:
    """Expanded uncertainty and coverage factor, "" where there is none."""
    parts = (f"{UNCERTAINTY}si:expandedMU/si:{key}" for key in ("valueExpandedMU", "coverageFactor"))
    return tuple(quantity.findtext(path, "", PREFIXES) for path in parts)  # pyright: ignore[reportReturnType]


def number_of(quantity: Element | None, words: Language) -> str:
    """A value as a language writes it, "" where there is none."""
    return "" if quantity is None else words.number(value_of(quantity))


def without_u(quantity: Element | None, words: Language) -> str:
    """A value that has no uncertainty, with three digits, "" where there is none."""
    value = None if quantity is None else float(value_of(quantity))
    return "" if value is None else words.number(rounded(value, decimals_of(value) + 1))


def with_u(quantity: Element, words: Language) -> str:
    """A value with its unit and standard uncertainty, as they were given; u in more than two digits is rounded to two,
    and the value to them."""
    unit = quantity.findtext("si:real/si:unit", "", PREFIXES)
    unit = _UNITS.get(unit, unit)
    name = content(quantity, "dcc:name")
    if name.startswith("standard uncertainty"):  # of what an instrument measured
        number, unit = f"{float(value_of(quantity)):.2g}", "px" if name.endswith("in pixels") else unit
        return f"u = {words.number(number)} {unit}".replace(" ", "\u00a0")
    u = quantity.findtext(f"{UNCERTAINTY}si:standardMU/si:valueStandardMU", "", PREFIXES)
    value = value_of(quantity)
    if u and float(f"{float(u):.1e}") != float(u):
        decimals = decimals_of(float(u))
        u = rounded(float(u), decimals)
        value = rounded(float(value), decimals) if len(value.partition(".")[2]) > decimals else value
    with_u = f" (u = {words.number(u)} {unit})".replace(" )", ")") if u else ""
    return f"{words.number(value)} {unit}{with_u}".strip().replace(" ", "\u00a0")


def more(count: int, words: Language) -> list[str]:
    """That so many more are in the DCC, where there are any."""
    return [words.counted("more_sentence", str(count))] if count > 0 else []
