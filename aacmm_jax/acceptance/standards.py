"""The standards that the acceptance tests follow: names, editions, symbols of their metrics, and decision rules."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal

from ..core.errors import InputError

if TYPE_CHECKING:
    from .judgement import Rule

JJF_1408, ASME_B89_4_22, ISO_10360_12 = "JJF 1408", "ASME B89.4.22", "ISO 10360-12"
EDITIONS = {JJF_1408: "JJF 1408-2013", ASME_B89_4_22: "ASME B89.4.22-2004", ISO_10360_12: "ISO 10360-12:2016"}
Standard = Literal["jjf", "asme", "iso"]
STANDARDS: dict[Standard, str] = {"jjf": JJF_1408, "asme": ASME_B89_4_22, "iso": ISO_10360_12}  # as options name them
# The standard that a sphere was touched for, by its test.
OF_SPHERES = {"effective-diameter": "asme", "probing": "iso", "articulation": "iso"}
# Symbols of ISO 10360-12:2016 by metric, as a maker's public explanation of its data sheets prints them (Kreon, at
# digitalscan3d.com/iso-10360-12-standard-for-measuring-arms and oberon3d.com, of 2020); not compared with the text.
#
# >>> print(aj.acceptance.SYMBOLS["E_Uni"])
# E_Uni:0:Tact.AArm
SYMBOLS = {
    "P_Size": "P_Size.Sph.1x25::Tact.AArm",
    "P_Form": "P_Form.Sph.1x25::Tact.AArm",
    "L_Dia": "L_Dia.5x5:Art:Tact.AArm",
    "E_Uni": "E_Uni:0:Tact.AArm",
}
# Decision rules where none is asked for. ISO 10360 names ISO 14253-1 as its default (public forewords of ISO 10360-8);
# for JJF 1408 it is our choice. That ASME B89.4.22 is judged by simple acceptance is background knowledge.
DEFAULT_RULES: dict[str, "Rule"] = {JJF_1408: "iso-2017", ASME_B89_4_22: "simple", ISO_10360_12: "iso-2017"}


def checked_standards(names: Iterable[str]) -> tuple[Standard, ...]:
    """Standards in the order of `STANDARDS`, or `InputError` for a name that is none of them."""
    given = tuple(names)
    for name in given:
        if name not in STANDARDS:
            raise InputError(f"acceptance is {name!r}; it must be one of {', '.join(STANDARDS)}.")
    return tuple(name for name in STANDARDS if name in given)
