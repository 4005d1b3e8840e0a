"""Limits (MPE) and decision rules by name: whether an error keeps a limit, given its uncertainty."""

import math
import re
from collections.abc import Collection, Mapping
from statistics import NormalDist
from typing import Annotated, Literal, NamedTuple, get_args

from ..core.arguments import Range, checked, checked_arguments
from ..core.errors import InputError, nearest
from ..core.text import number

Decision = Literal["fails", "undecided", "conforms"]
DECISIONS: tuple[Decision, ...] = get_args(Decision)  # the worst first
Rule = Literal["iso-2017", "iso-2013", "simple"]
# Decision rules by name. Guard bands of ISO 14253-1 are stated from secondary sources; the ratio of 4 to 1 is one of
# the "N:1 decision rules" that ASME B89.7.3.1-2001 defines in its section 2, which is public in extracts.
#
# >>> print(aj.acceptance.RULES["iso-2013"])
# ISO 14253-1:2013, guard band U
RULES: dict[Rule, str] = {
    "iso-2017": "ISO 14253-1:2017, conformity proven with a probability of 95 %",
    "iso-2013": "ISO 14253-1:2013, guard band U",
    "simple": "simple acceptance with a ratio of 4:1 (ASME B89.7.3.1)",
}
COVERAGE_FACTOR = 2.0  # of every U of a test value
GUARD_FACTOR = 1.65  # one-sided, 95 %, of a normal distribution: the guard band of 2017 is this times u
_PROBABILITY, _RATIO = 0.95, 4.0
MOST, LEAST_DIVISOR = 1e6, 1e-3  # of a limit in mm, and of its divisor
_Millimetres = Annotated[float, Range(least=0, unit="mm")]
_ROUNDING = 1e-9  # relative to the limit: decimal numbers that equal a limit on paper must equal it in binary
_LIMIT = re.compile(r"\s*(?P<fixed>[^+/LlKk]+?)\s*(?:\+\s*[Ll]\s*/\s*(?P<divisor>.+?))?\s*")


class Limit(NamedTuple):
    """A maximum permissible error (MPE) in mm: ``fixed``, or ``fixed + L / divisor`` for a length L in mm.

    Example:
        >>> mpe = aj.acceptance.Limit(0.015, divisor=40_000)
        >>> print(f"{mpe.at(500.0):.4f} mm")
        0.0275 mm
    """

    fixed: float
    divisor: float = math.inf

    def at(self, length: float = 0.0) -> float:
        """The limit for a length, mm."""
        return self.fixed + length / self.divisor

    def __str__(self) -> str:
        return f"{self.fixed:g}" + ("" if math.isinf(self.divisor) else f" + L/{self.divisor:g}")


@checked_arguments
def decide(error: float, limit: _Millimetres, expanded: _Millimetres = 0.0, rule: Rule = "iso-2017") -> Decision:
    """Decide whether an error keeps a limit.

    With u = U / 2, "iso-2017" (ISO 14253-1:2017) asks for a probability of 95 % that the error is within the limit, or
    beyond it: guard bands of 1.65 u, and more where u is so large that both limits count. "iso-2013" has guard bands
    of U. "simple" (ASME B89.7.3.1) compares the error alone, if the limit is at least four times U; otherwise it
    leaves it undecided. The texts of ISO 14253-1 were not available.

    Args:
        error: Test value, mm.
        limit: Maximum permissible error (MPE), mm.
        expanded: Expanded uncertainty U of the test value (coverage factor 2), mm.
        rule: A key of `RULES`.

    Returns:
        "conforms", "fails" or "undecided".

    Raises:
        InputError: An argument is not a number, the limit or U is negative or infinite, or the rule is unknown.

    Example:
        >>> print(aj.acceptance.decide(0.040, limit=0.050, expanded=0.010))
        conforms
        >>> print(aj.acceptance.decide(0.048, limit=0.050, expanded=0.010))
        undecided
    """
    error, slack = abs(error), _ROUNDING * max(limit, expanded)
    if rule == "simple":
        if limit + slack < _RATIO * expanded:
            return "undecided"
        return "conforms" if error <= limit + slack else "fails"
    guard = expanded if rule == "iso-2013" else GUARD_FACTOR * expanded / COVERAGE_FACTOR
    if error > limit - guard + slack:
        return "fails" if error >= limit + guard - slack else "undecided"
    if rule == "iso-2013" or expanded <= slack:
        return "conforms"
    # Where u is large, the opposite limit counts as well.
    normal = NormalDist(error, expanded / COVERAGE_FACTOR)
    return "conforms" if normal.cdf(limit) - normal.cdf(-limit) >= _PROBABILITY else "undecided"


def checked_rule(rule: str) -> Rule:
    """A decision rule, or `InputError` for another name."""
    return checked(rule, Rule, "rule")


def worst(decisions: list[Decision]) -> Decision | None:
    """The worst of several decisions; None if there are none."""
    return next((decision for decision in DECISIONS if decision in decisions), None)


def without_test(name: str, known: Collection[str]) -> str:
    """The end of a message on a metric that no test has: why it has none, or which names there are."""
    if name.strip().lower() == "e_bi":
        return "; lengths probed from opposite directions cannot be recorded, and E_Uni is what is tested."
    return nearest(name, known, len(known))


def checked_limit(limit: Limit, what: str) -> Limit:
    """The same limit, or `InputError` where it is impossible."""
    if not (0 <= limit.fixed <= MOST and limit.divisor >= LEAST_DIVISOR):
        raise InputError(
            f"{what} is {limit} mm; A must be zero or positive and finite, and K at least {LEAST_DIVISOR:g}."
        )
    return limit


def limit_of_text(text: str, given: str) -> Limit:
    """A limit, or an uncertainty, from a text ``A`` or ``A+L/K`` in mm; ``given`` is what messages begin with."""
    match = _LIMIT.fullmatch(text)
    try:
        if match is None:
            raise ValueError(text)
        limit = Limit(number(match["fixed"]), number(match["divisor"]) if match["divisor"] else math.inf)
    except ValueError as error:
        raise InputError(f"{given} is not A or A+L/K with numbers in mm; give one such as 0.002+L/500000.") from error
    return checked_limit(limit, given)


def read_limits(texts: list[str], known: Mapping[str, str]) -> dict[str, Limit]:
    """Limits by the name of a metric, from texts ``NAME=A`` or ``NAME=A+L/K`` in mm; ``known`` has the names."""
    limits: dict[str, Limit] = {}
    names = {name.lower(): name for name in known}
    for text in texts:
        given, equals, value = text.partition("=")
        name = names.get(given.strip().lower())
        if not equals:
            raise InputError(f"--mpe '{text}' is not NAME=A or NAME=A+L/K, in mm; for example E_Uni=0.025+L/40000.")
        if name is None:
            raise InputError(f"--mpe '{text}' names the unknown metric '{given}'{without_test(given, known)}")
        if name in limits:
            raise InputError(f"--mpe gives {name} two limits; give it one.")
        limits[name] = limit_of_text(value, f"--mpe {name}={value}")
    return limits
