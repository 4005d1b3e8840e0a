"""What a test adds to the uncertainty of its values: seat, fixture, and the thermal expansion of artefact and arm."""

import math
import re
from collections.abc import Sequence
from typing import Annotated, NamedTuple

from ..core.arguments import Range, checked_fields
from ..core.errors import InputError
from ..core.text import number

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
        """Standard uncertainty of `relative`.

        Source: JCGM 100:2008, 5.1 and, for the product of both uncertainties, which counts near 20 C, H.1.7.
        """
        away = self.temperature - REFERENCE_TEMPERATURE
        return math.hypot(
            away * self.u_coefficient, self.coefficient * self.u_temperature, self.u_coefficient * self.u_temperature
        )


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
        return length * (_relative(self.arm) - _relative(self.artefact))


def _relative(body: Expansion | None) -> float:
    return 0.0 if body is None else body.relative


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
                f"--expansion '{text}' is not artefact=C,u,T,u or arm=C,u,T,u with C in 1e-6/K and T in C; for example "
                "artefact=11.5,1,20.8,0.2."
            )
        if 0 < abs(values[0]) < _SMALLEST_GIVEN:
            raise InputError(f"--expansion '{text}' gives the coefficient in 1/K; give it in 1e-6/K, 11.5 for steel.")
        if match["body"] in expansions:
            raise InputError(f"--expansion gives the {match['body']} two expansions; give it one.")
        body = Expansion(1e-6 * values[0], 1e-6 * values[1], *values[2:])
        expansions[match["body"]] = checked_fields(body, f"the {match['body']}")
    return expansions


def checked_influences(influences: Influences) -> Influences:
    """The same influences, or `InputError` where one is impossible."""
    for name in ("artefact", "arm"):
        if (body := getattr(influences, name)) is not None:
            checked_fields(body, f"the {name}")
    return checked_fields(influences)
