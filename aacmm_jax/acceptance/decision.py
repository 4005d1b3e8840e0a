"""Within a limit or not, given how well one knows: the decision rule of ISO 14253-1."""

import math
import re
from collections.abc import Mapping
from typing import Literal, NamedTuple

from ..core.errors import InputError, nearest

Decision = Literal["conforms", "undecided", "fails"]
_ROUNDING = 1e-9  # of the limit: decimal numbers that meet a limit on paper shall meet it here
_FORM = re.compile(r"\s*(?P<fixed>[^+/LlKk]+?)\s*(?:\+\s*[Ll]\s*/\s*(?P<divisor>.+?))?\s*")


class Limit(NamedTuple):
    """A maximum permissible error (MPE), mm: ``fixed``, or ``fixed + L / divisor`` for a length L in mm."""

    fixed: float
    divisor: float = math.inf

    def at(self, length: float = 0.0) -> float:
        """The limit for a length, mm."""
        return self.fixed + length / self.divisor

    def __str__(self) -> str:
        return f"{self.fixed:g}" + ("" if math.isinf(self.divisor) else f" + L/{self.divisor:g}")


def decide(error: float, limit: float, expanded: float = 0.0) -> Decision:
    """Whether an error keeps a limit, by ISO 14253-1 (the rule as stated in public sources; the standard's text was not read).

    "conforms" where ``|error| <= limit - expanded``, "fails" where ``|error| >= limit + expanded``, else "undecided". ``expanded`` is the
    expanded uncertainty U (coverage factor 2) of the test value; all in mm. The guard band is U itself, as in the editions
    up to 2013; that of 2017 allows 0.83 U by default, so that whatever conforms here conforms there too.
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
        raise InputError("the error is not a number, so nothing can be decided; measure it.")
    slack = _ROUNDING * max(limit, expanded)
    if abs(error) <= limit - expanded + slack:
        return "conforms"
    return "fails" if abs(error) >= limit + expanded - slack else "undecided"


def worst(decisions: list[Decision]) -> Decision | None:
    """What several decisions come to together: failing beats undecided, and that beats conforming; None of none."""
    return next((kind for kind in ("fails", "undecided", "conforms") if kind in decisions), None)


def read_limits(texts: list[str], known: Mapping[str, str]) -> dict[str, Limit]:
    """Limits as people write them, ``NAME=A`` or ``NAME=A+L/K`` in mm, by the name of a figure. ``known``: name -> what it is."""
    found: dict[str, Limit] = {}
    names = {name.lower(): name for name in known}
    for text in texts:
        name, equals, value = text.partition("=")
        match = _FORM.fullmatch(value)
        if not equals or match is None:
            raise InputError(f"--mpe '{text}' is not of the form NAME=A or NAME=A+L/K, in mm; for example E_Uni=0.025+L/40000.")
        if name.strip().lower() not in names:
            raise InputError(f"--mpe '{text}' names the unknown figure '{name}'{nearest(name, list(known))}")
        name = names[name.strip().lower()]
        if name in found:
            raise InputError(f"--mpe gives {name} two limits; give it one.")
        try:
            limit = Limit(float(match["fixed"]), float(match["divisor"]) if match["divisor"] else math.inf)
        except ValueError as error:
            raise InputError(f"--mpe '{text}': '{value}' is not A or A+L/K with numbers in mm.") from error
        if not (0 <= limit.fixed <= 1e6 and limit.divisor >= 1e-3):
            raise InputError(f"--mpe '{text}': a limit must be zero or positive and finite, and K at least 0.001.")
        found[name] = limit
    return found
