"""What acceptance tests are judged by: limits (MPE), decision rules, standards, and what a test adds to uncertainty."""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from statistics import NormalDist
from typing import Annotated, Literal, NamedTuple, get_args

from ..core.arguments import Range, checked_arguments, checked_fields
from ..core.errors import InputError, nearest
from ..core.text import number
from ..uncertainty.coverage import COVERAGE_FACTOR

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

    With u = U / `COVERAGE_FACTOR`, "iso-2017" (ISO 14253-1:2017) asks for a probability of 95 % that the error is
    within the limit, or beyond it: guard bands of 1.65 u, and more where u is so large that both limits count.
    "iso-2013" has guard bands of U. "simple" (ASME B89.7.3.1) compares the error alone, if the limit is at least four
    times U; otherwise it leaves it undecided. The texts of ISO 14253-1 were not available.

    Args:
        error: Test value, mm.
        limit: Maximum permissible error (MPE), mm.
        expanded: Expanded uncertainty U of the test value, u times `COVERAGE_FACTOR`, mm.
        rule: A key of `RULES`.

    Example:
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


def deciding_uncertainty(error: float, limit: float, rule: Rule) -> float:
    """The largest expanded uncertainty with which `decide` accepts or rejects an error, mm; 0 at the limit itself."""
    if rule == "simple":
        return limit / _RATIO
    return abs(limit - abs(error)) * (1.0 if rule == "iso-2013" else COVERAGE_FACTOR / GUARD_FACTOR)


def worst(decisions: list[Decision]) -> Decision | None:
    """The worst of several decisions; None if there are none."""
    return next((decision for decision in DECISIONS if decision in decisions), None)


def without_test(name: str, metrics: Collection[str]) -> str:
    """The end of a message on a metric that no test has: why it has none, or which names there are."""
    if name.strip().lower() == "e_bi":
        return "; lengths probed from opposite directions cannot be recorded, so E_Uni is tested instead."
    return nearest(name, metrics, len(metrics))


def checked_limit(limit: Limit, what: str) -> Limit:
    """The same limit, or `InputError` where it is impossible."""
    if not (0 <= limit.fixed <= MOST and limit.divisor >= LEAST_DIVISOR):
        raise InputError(
            f"{what} is {limit} mm; in A+L/K, A must be finite and not negative, and K must be at least "
            f"{LEAST_DIVISOR:g}."
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
        raise InputError(
            f"{given} is not of the form A or A+L/K with numbers in mm; give, for example, 0.002+L/500000."
        ) from error
    return checked_limit(limit, given)


def read_limits(texts: list[str], metrics: Mapping[str, str]) -> dict[str, Limit]:
    """Limits by the name of a metric, from texts ``NAME=A`` or ``NAME=A+L/K`` in mm; ``metrics`` has the names."""
    limits: dict[str, Limit] = {}
    names = {name.lower(): name for name in metrics}
    for text in texts:
        given, equals, value = text.partition("=")
        name = names.get(given.strip().lower())
        if not equals:
            raise InputError(
                f"--mpe '{text}' is not of the form NAME=A or NAME=A+L/K in mm; give, for example, E_Uni=0.025+L/40000."
            )
        if name is None:
            raise InputError(f"--mpe '{text}' names the unknown metric '{given}'{without_test(given, metrics)}")
        if name in limits:
            raise InputError(f"--mpe gives two limits for {name}; give one limit.")
        limits[name] = limit_of_text(value, f"--mpe {name}={value}")
    return limits


REFERENCE_TEMPERATURE = 20.0  # C (ISO 1)
_SMALLEST_GIVEN = 1e-3  # 1e-6/K: less than any body expands by
_EXPANSION = re.compile(r"\s*(?P<body>artefact|arm)\s*=(?P<numbers>[^=]*)")


class Expansion(NamedTuple):
    """Thermal expansion of a body in a test: coefficient in 1/K, temperature in C, and their standard uncertainties.

    Example:
        >>> steel = aj.acceptance.Expansion(11.5e-6, u_coefficient=1e-6, temperature=20.8, u_temperature=0.2)
        >>> print(f"{steel.relative * 1e6:.1f} um/m, u = {steel.u * 1e6:.1f} um/m")
        9.2 um/m, u = 2.4 um/m
    """

    coefficient: Annotated[float, Range(least=-1e-3, most=1e-3, unit="per K")]  # what no body is beyond
    u_coefficient: Annotated[float, Range(least=0, most=1e-3, unit="per K")] = 0.0
    temperature: Annotated[float, Range(least=-100, most=200, unit="C")] = REFERENCE_TEMPERATURE
    u_temperature: Annotated[float, Range(least=0, most=200, unit="C")] = 0.0

    @property
    def relative(self) -> float:
        """Growth of a length since 20 C, relative to it."""
        return self.coefficient * (self.temperature - REFERENCE_TEMPERATURE)

    @property
    def u(self) -> float:
        """Standard uncertainty of `relative`: JCGM 100:2008, 5.1."""
        away = self.temperature - REFERENCE_TEMPERATURE
        of_both = self.u_coefficient * self.u_temperature  # counts near 20 C: H.1.7
        return math.hypot(away * self.u_coefficient, self.coefficient * self.u_temperature, of_both)


class Influences(NamedTuple):
    """The tester's contributions to the uncertainty of test values, besides the certificates of the artefacts.

    Example:
        >>> tester = aj.acceptance.Influences(u=0.002, u_relative=2e-6)
        >>> measured = aj.acceptance.Measured({"cone": true.position(capture.sockets["A"])})
        >>> tests = aj.acceptance.run(measured, limits={"SPAT": 0.1}, influences=tester)
        >>> print(tests[0].metrics[0].worst.expanded)
        0.004
    """

    u: float = 0.0  # standard uncertainty of every value: seat and fixture, mm
    u_relative: Annotated[float, Range(least=0, most=1)] = 0.0  # standard uncertainty in proportion to a length
    artefact: Expansion | None = None  # None: at 20 C, or corrected for
    arm: Expansion | None = None  # None: the arm compensates its own expansion, or is tested as it is

    def u_of(self, length: float = 0.0) -> float:
        """Standard uncertainty of a value that measures a length, mm."""
        bodies = [body.u for body in (self.artefact, self.arm) if body is not None]
        return math.hypot(self.u, length * self.u_relative, *(length * u for u in bodies))

    def correction(self, length: float) -> float:
        """What is added to the error of a measured length, mm.

        A warm artefact is longer, and a warm arm, whose model is that of 20 C, measures too short.
        """
        arm, artefact = (0.0 if body is None else body.relative for body in (self.arm, self.artefact))
        return length * (arm - artefact)


def read_expansions(texts: Sequence[str]) -> dict[str, Expansion]:
    """Expansions of ``artefact`` and ``arm``, from texts ``artefact=C,u,T,u``: coefficient in 1e-6/K, T in C."""
    expansions: dict[str, Expansion] = {}
    for text in texts:
        match = _EXPANSION.fullmatch(text)
        try:
            values = [] if match is None else [number(part.strip()) for part in match["numbers"].split(",")]
        except ValueError:
            values = []
        if match is None or len(values) != 4:
            raise InputError(
                f"--expansion '{text}' is not of the form artefact=C,u,T,u or arm=C,u,T,u (coefficient C in 1e-6/K, "
                "temperature T in degrees Celsius, each with its u); give, for example, artefact=11.5,1,20.8,0.2."
            )
        if 0 < abs(values[0]) < _SMALLEST_GIVEN:
            raise InputError(
                f"--expansion '{text}' gives the coefficient in 1/K; give the coefficient in 1e-6/K (steel: 11.5)."
            )
        if match["body"] in expansions:
            raise InputError(f"--expansion gives two expansions for the {match['body']}; give one expansion.")
        body = Expansion(1e-6 * values[0], 1e-6 * values[1], *values[2:])
        expansions[match["body"]] = checked_fields(body, f"the {match['body']}")
    return expansions


def checked_influences(influences: Influences) -> Influences:
    """The same influences, or `InputError` where one is impossible."""
    for name in ("artefact", "arm"):
        if (body := getattr(influences, name)) is not None:
            checked_fields(body, f"the {name}")
    return checked_fields(influences)
