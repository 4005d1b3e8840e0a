"""Limits (MPE) and the decision rule of ISO 14253-1: whether an error keeps a limit, given its uncertainty."""

import math
import re
from collections.abc import Mapping
from typing import Literal, NamedTuple, get_args

from ..core.errors import InputError, nearest
from ..core.text import number

Decision = Literal["fails", "undecided", "conforms"]
DECISIONS: tuple[Decision, ...] = get_args(Decision)  # the worst first
MOST, LEAST_DIVISOR = 1e6, 1e-3  # of a limit in mm, and of its divisor
_ROUNDING = 1e-9  # relative to the limit: decimal numbers that equal a limit on paper must equal it in binary
_LIMIT = re.compile(r"\s*(?P<fixed>[^+/LlKk]+?)\s*(?:\+\s*[Ll]\s*/\s*(?P<divisor>.+?))?\s*")


class Limit(NamedTuple):
    """A maximum permissible error (MPE) in mm: ``fixed``, or ``fixed + L / divisor`` for a length L in mm."""

    fixed: float
    divisor: float = math.inf

    def at(self, length: float = 0.0) -> float:
        """The limit for a length, mm."""
        return self.fixed + length / self.divisor

    def __str__(self) -> str:
        return f"{self.fixed:g}" + ("" if math.isinf(self.divisor) else f" + L/{self.divisor:g}")


def decide(error: float, limit: float, expanded: float = 0.0) -> Decision:
    """Decide whether an error keeps a limit.

    Source: ISO 14253-1, stated from secondary sources. The guard band is U itself, as in the editions up to 2013; that
    of 2017 allows 0.83 U by default, so that whatever conforms here conforms there too.

    Args:
        error: Test value, mm.
        limit: Maximum permissible error (MPE), mm.
        expanded: Expanded uncertainty U of the test value (coverage factor 2), mm.

    Returns:
        "conforms" if ``|error| <= limit - expanded``, "fails" if ``|error| >= limit + expanded``, else "undecided".

    Raises:
        InputError: An argument is not a number, or the limit or U is negative or infinite.
    """
    try:
        error, limit, expanded = float(error), float(limit), float(expanded)
    except (TypeError, ValueError) as wrong:
        raise InputError(
            f"error, limit and expanded uncertainty are {error!r}, {limit!r}, {expanded!r}; give numbers of mm."
        ) from wrong
    for what, value in (("limit", limit), ("expanded uncertainty", expanded)):
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"the {what} is {value:g} mm; it must be zero or positive.")
    if math.isnan(error):
        raise InputError("the error is not a number, so nothing can be decided; give the measured error.")
    slack = _ROUNDING * max(limit, expanded)
    if abs(error) <= limit - expanded + slack:
        return "conforms"
    return "fails" if abs(error) >= limit + expanded - slack else "undecided"


def worst(decisions: list[Decision]) -> Decision | None:
    """The worst of several decisions; None if there are none."""
    return next((decision for decision in DECISIONS if decision in decisions), None)


def read_limits(texts: list[str], known: Mapping[str, str]) -> dict[str, Limit]:
    """Limits by the name of a metric, from texts ``NAME=A`` or ``NAME=A+L/K`` in mm; ``known`` has the names."""
    found: dict[str, Limit] = {}
    names = {name.lower(): name for name in known}
    for text in texts:
        name, equals, value = text.partition("=")
        match = _LIMIT.fullmatch(value)
        if not equals or match is None:
            raise InputError(
                f"--mpe '{text}' is not of the form NAME=A or NAME=A+L/K, in mm; for example E_Uni=0.025+L/40000."
            )
        if name.strip().lower() not in names:
            raise InputError(f"--mpe '{text}' names the unknown metric '{name}'{nearest(name, known, len(known))}")
        name = names[name.strip().lower()]
        if name in found:
            raise InputError(f"--mpe gives {name} two limits; give it one.")
        try:
            limit = Limit(number(match["fixed"]), number(match["divisor"]) if match["divisor"] else math.inf)
        except ValueError as error:
            raise InputError(f"--mpe '{text}': '{value}' is not A or A+L/K with numbers in mm.") from error
        if not (0 <= limit.fixed <= MOST and limit.divisor >= LEAST_DIVISOR):
            raise InputError(
                f"--mpe '{text}': a limit must be zero or positive and finite, and K at least {LEAST_DIVISOR:g}."
            )
        found[name] = limit
    return found
