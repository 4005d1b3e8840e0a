"""Joint readings compared with an arm: what is wrong with their order, signs, zeros and units, in words and numbers."""

import math
from typing import Any

from ..core.text import listed
from ..core.units import DEG, LENGTH_UNITS, length_unit
from .reading_check import ReadingCheck
from .reading_fit import Explanation

_LISTED = 5
_MUCH = 2.0  # a place of the tip that reduces the residuals by less is not spoken of
_QUARTERS = 1e-9  # rad


def reading_check_summary(
    check: ReadingCheck, arm: str, *, unit: str | None = None, positions: str = "mm"
) -> dict[str, Any]:
    """Plain values for JSON and display.

    Args:
        check: What the comparison found.
        arm: Name of the arm.
        unit: Unit of the readings that was stated, or taken; None where the file says it for itself.
        positions: Unit that positions were taken to be in.
    """
    best = check.best
    return {
        "kind": "reading check",
        "arm": arm,
        "poses": check.poses,
        "unit": unit,
        "fits": check.fits,
        "explained": check.explained,
        "sentence": _sentence(check, positions),
        "tip": _tip(check),
        "given": _row(check.given, positions),
        "found": _row(best, positions) if check.explained else None,
        "alternatives": [_row(one, positions) for one in check.others],
        "equivalent": check.equal,
        "known_positions": check.known_positions,
        "rms_with_tip_mm": check.rms_with_tip,
        "hypotheses": check.tried,
    }


def _row(one: Explanation, positions: str) -> dict[str, Any]:
    return {
        "says": explanation_words(one, positions),
        "columns": [column + 1 for column in one.order],
        "signs": list(one.signs),
        "zeros_deg": [offset / DEG for offset in one.offsets],
        "angle_factor": one.angle,
        "length_factor": one.length,
        "rms_mm": one.rms,
        "rms_fitted_mm": one.rms_fitted,
        "readings_outside_limits": one.outside,
        "mirror_image": one.mirrored,
    }


def _sentence(check: ReadingCheck, positions: str) -> str:
    given, best = check.given, check.best
    if not check.explained:
        return (
            f"No permutation, sign or zero offset of the columns explains these readings: {given.rms:.3g} mm RMS as "
            f"they are, {best.rms:.3g} mm at best. Is it the right arm, do the rows belong to these sockets or "
            "positions, and was the tip where it is said to have been?"
        )
    if check.fits:
        return (
            f"The readings fit as they are: {given.rms:.3g} mm RMS by the nominal arm, {given.rms_fitted:.3g} mm with "
            "parameters as real arms have them."
        )
    words = explanation_words(best, positions)
    return (
        f"{words[0].upper()}{words[1:]}. Correcting it reduces the residuals (nominal arm) from {given.rms:.3g} to "
        f"{best.rms:.3g} mm RMS ({best.rms_fitted:.3g} mm with parameters as real arms have them)."
    )


def _tip(check: ReadingCheck) -> str:
    """How much of the residual is due to the place of the tip, which a calibration finds; empty where it is little."""
    rms = check.best.rms
    if not check.explained or check.rms_with_tip is None or _MUCH * check.rms_with_tip > rms:
        return ""
    known = (
        "what was seen is taken to be where the arm's probe is. A calibration finds its place"
        if check.free_tip
        else "what was seen is not where the arm's probe is. In its table of the manifest write target = "
        '"reflector", and a calibration finds its place'
    )
    return (
        f"Most of the {rms:.3g} mm is an offset of the tip: {known} in the last frame; with it the nominal arm leaves "
        f"{check.rms_with_tip:.3g} mm RMS."
    )


def explanation_words(one: Explanation, positions: str = "mm") -> str:
    """What an explanation changes, in one sentence without its end; empty where nothing.

    Args:
        one: The explanation.
        positions: Unit that positions were taken to be in.
    """
    words = []
    if one.angle != 1:
        words.append(
            "the readings are in degrees, and were taken for radians"
            if one.angle < 1
            else "the readings are in radians, and were taken for degrees"
        )
    if one.length != 1:
        unit = length_unit(one.length * LENGTH_UNITS[positions])
        factor = f"{one.length:.4g} times as large as they were taken to be"
        words.append(
            f"the positions are {factor}"
            if unit is None
            else f"the positions are in {unit}, and were taken for {positions}"
        )
    words += _order(one.order)
    wrong = [f"{column + 1}" for column, sign in sorted(zip(one.order, one.signs, strict=True)) if sign < 0]
    if wrong:
        words.append(f"column{'s' * (len(wrong) > 1)} {listed(wrong)} run{'s' * (len(wrong) == 1)} the other way")
    offsets = [math.remainder(offset, 2 * math.pi) for offset in one.offsets]
    for joint, offset in enumerate(offsets, start=1):
        if abs(offset) > _QUARTERS:
            value = abs(offset) if abs(abs(offset) - math.pi) < _QUARTERS else offset
            words.append(f"the zero of joint {joint} is {value / DEG:.4g} deg off")
    return "; ".join(words)


def _order(order: tuple[int, ...]) -> list[str]:
    """Columns that are exchanged, as people say it."""
    n = len(order)
    if order == tuple(range(n)):
        return []
    moved = [joint for joint in range(n) if order[joint] != joint]
    if all(order[order[joint]] == joint for joint in moved):
        if order == tuple(reversed(range(n))) and n > 3:
            return ["the columns are in reverse order"]
        pairs = [(joint, order[joint]) for joint in moved if joint < order[joint]]
        return [f"columns {one + 1} and {other + 1} are exchanged" for one, other in pairs]
    joints, columns = (listed([str(i + 1) for i in part]) for part in (moved, [order[joint] for joint in moved]))
    return [f"joints {joints} are in columns {columns}"]


def alternatives_sentence(rows: list[dict[str, Any]], known_positions: bool) -> str:
    """What these data cannot tell from what was found, and what would; empty where there is nothing."""
    if not rows:
        return ""
    texts = [
        (f"that {row['says']}" if row["says"] else "that nothing is wrong") + " (a mirror image)" * row["mirror_image"]
        for row in rows[:_LISTED]
    ]
    more = f"; or {len(rows) - _LISTED} further ones" if len(rows) > _LISTED else ""
    needed = "More poses at known positions" if known_positions else "A pose at a known position"
    return f"These data fit nearly as well if one assumes {'; or '.join(texts)}{more}. {needed} would tell them apart."
