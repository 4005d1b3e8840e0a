"""The standards that the acceptance tests follow: their names, and the editions that the secondary sources describe."""

from collections.abc import Iterable
from typing import Literal

from ..core.errors import InputError

JJF_1408, ASME_B89_4_22, ISO_10360_12 = "JJF 1408", "ASME B89.4.22", "ISO 10360-12"
EDITIONS = {JJF_1408: "JJF 1408-2013", ASME_B89_4_22: "ASME B89.4.22-2004", ISO_10360_12: "ISO 10360-12:2016"}
Planned = Literal["asme", "iso"]  # standards whose procedure can be planned, as arguments name them
PLANNED: dict[Planned, str] = {"asme": ASME_B89_4_22, "iso": ISO_10360_12}
Standard = Literal["jjf", "asme", "iso"]
STANDARDS: dict[Standard, str] = {"jjf": JJF_1408, "asme": ASME_B89_4_22, "iso": ISO_10360_12}  # as options name them
# The standard that a sphere was touched for, by its test.
OF_SPHERES = {"effective-diameter": "asme", "probing": "iso", "articulation": "iso"}


def checked_standards(names: Iterable[str]) -> tuple[Standard, ...]:
    """Standards in the order of `STANDARDS`, or `InputError` for a name that is none of them."""
    given = tuple(names)
    for name in given:
        if name not in STANDARDS:
            raise InputError(f"acceptance is {name!r}; it must be one of {', '.join(STANDARDS)}.")
    return tuple(name for name in STANDARDS if name in given)
