"""Rows of a run against the stored ones: equal words, and numbers within the row's tolerance."""

import re
from typing import NamedTuple

from paper import Row, Tolerance

# A number that is no part of a name (d_3), with the thousands' commas and the exponent that Python prints.
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d{1,3}(?:,\d{3})+|(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")
_COMPARED = ("toolkit", "method", "recomputed", "verdict", "printed")  # computed ones first: those are shown


class Check(NamedTuple):
    """One row compared: the two numbers, or words, that differ most in terms of the tolerance."""

    what: str
    stored: str
    now: str
    tolerance: str
    passed: bool


def compared(stored: list[dict[str, str]], now: list[Row]) -> list[Check]:
    """Every row of either run."""
    known, found = {row["what"]: row for row in stored}, {row.what: row for row in now}
    checks = []
    for what in dict.fromkeys([*known, *found]):
        if what not in found or what not in known:
            lines = ("missing" if what not in rows else "present" for rows in (known, found))
            checks.append(Check(what, *lines, "", False))
            continue
        tolerance = found[what].tolerance
        deviations = [
            deviation
            for column in _COMPARED
            for deviation in _deviations(known[what][column], getattr(found[what], column), tolerance)
        ]
        worst, one, other = max(deviations, key=lambda deviation: deviation[0], default=(0.0, "-", "-"))
        checks.append(Check(what, one, other, str(tolerance).partition(":")[0], worst <= 1))
    return checks


def _deviations(stored: str, now: str, tolerance: Tolerance) -> list[tuple[float, str, str]]:
    """For every number of a text its deviation in units of what is tolerated, and both; other words: infinite."""
    if _NUMBER.sub("#", stored) != _NUMBER.sub("#", now):
        return [(float("inf"), _from_difference(stored, now), _from_difference(now, stored))]
    deviations = []
    for one, other in zip(_NUMBER.finditer(stored), _NUMBER.finditer(now), strict=True):
        values = [float(match[0].replace(",", "")) for match in (one, other)]
        follows = stored[one.end() : one.end() + 6]
        allowed = max(_unit(one[0], follows), tolerance.absolute, tolerance.relative * abs(values[0]))
        difference = abs(values[0] - values[1])
        deviations.append((difference / allowed if allowed else float("inf") if difference else 0.0, one[0], other[0]))
    return deviations


def _unit(text: str, follows: str) -> float:
    """One unit of the last digit shown, and its rounding; of whole numbers none, unless they are rounded ratios."""
    digits, _, exponent = text.partition("e")
    decimals = len(digits.partition(".")[2])
    if not decimals and not exponent and not follows.startswith((" %", " times", " arcse")):
        return 0.0
    return 1.001 * 10.0 ** (int(exponent or 0) - decimals)


def _from_difference(text: str, other: str) -> str:
    """A text from its first difference on, shortened."""
    first = next((i for i, (a, b) in enumerate(zip(text, other, strict=False)) if a != b), min(len(text), len(other)))
    return text[max(first - 8, 0) : first + 20] or "-"


def table(checks: list[Check]) -> str:
    """The checks for a terminal."""
    lines = [("row", "stored", "now", "tolerance", "verdict")]
    lines += [(*check[:4], "passed" if check.passed else "FAILED") for check in checks]
    widths = [min(max(len(line[i]) for line in lines), most) for i, most in enumerate((60, 28, 28, 23, 7))]
    return "\n".join(
        "  ".join(cell[:width].ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )
