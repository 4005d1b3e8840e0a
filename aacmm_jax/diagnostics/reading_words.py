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
    given, best, tip = check.given, check.best, ""
    improved = f"from {given.rms:.3g} to {best.rms:.3g} mm RMS ({best.rms_fitted:.3g} mm"
    words = explanation_words(best, positions)
    if not check.explained:
        sentence = (
            f"No permutation, sign or zero offset of the columns explains these readings: {given.rms:.3g} mm RMS as "
            f"they are, {best.rms:.3g} mm at best. Is it the right arm, do the rows belong to these sockets or "
            "positions, and was the tip where it is said to have been?"
        )
    elif check.fits:
        sentence = (
            f"The readings fit as they are: {given.rms:.3g} mm RMS by the nominal arm, {given.rms_fitted:.3g} mm with "
            "parameters as real arms have them."
        )
    else:
        sentence = (
            f"{words[0].upper()}{words[1:]}. Correcting it reduces the residuals (nominal arm) {improved} with "
            "parameters as real arms have them)."
        )
    # How much of the residual is due to the place of the tip, which a calibration finds.
    if check.explained and check.rms_with_tip is not None and _MUCH * check.rms_with_tip <= best.rms:
        place = (
            "what was seen is taken to be where the arm's probe is. A calibration finds its place"
            if check.free_tip
            else "what was seen is not where the arm's probe is. In its table of the manifest write target = "
            '"reflector", and a calibration finds its place'
        )
        tip = (
            f"Most of the {best.rms:.3g} mm is an offset of the tip: {place} in the last frame; with it the nominal "
            f"arm leaves {check.rms_with_tip:.3g} mm RMS."
        )
    return {
        "kind": "reading check",
        "arm": arm,
        "poses": check.poses,
        "unit": unit,
        "fits": check.fits,
        "explained": check.explained,
        "sentence": sentence,
        "tip": tip,
        "given": _row(given, positions),
        "found": _row(best, positions) if check.explained else None,
        "alternatives": [_row(other, positions) for other in check.others],
        "equivalent": check.equal,
        "known_positions": check.known_positions,
        "rms_with_tip_mm": check.rms_with_tip,
        "hypotheses": check.tried,
    }


def _row(explanation: Explanation, positions: str) -> dict[str, Any]:
    return {
        "says": explanation_words(explanation, positions),
        "columns": [column + 1 for column in explanation.order],
        "signs": list(explanation.signs),
        "zeros_deg": [offset / DEG for offset in explanation.offsets],
        "angle_factor": explanation.angle,
        "length_factor": explanation.length,
        "rms_mm": explanation.rms,
        "rms_fitted_mm": explanation.rms_fitted,
        "readings_outside_limits": explanation.outside,
        "mirror_image": explanation.mirrored,
    }


def explanation_words(explanation: Explanation, positions: str = "mm") -> str:
    """What an explanation changes, in one sentence without its end; empty where nothing. ``positions`` is the unit
    that positions were taken to be in."""
    words, (order, signs, offsets, angle, length) = [], explanation[:5]
    if angle != 1:
        units = ("degrees", "radians") if angle < 1 else ("radians", "degrees")
        words.append("the readings are in {}, and were taken for {}".format(*units))
    if length != 1:
        unit = length_unit(length * LENGTH_UNITS[positions])
        words.append(
            f"the positions are {length:.4g} times as large as they were taken to be"
            if unit is None
            else f"the positions are in {unit}, and were taken for {positions}"
        )
    moved = [joint for joint, column in enumerate(order) if column != joint]
    if order == tuple(reversed(range(len(order)))) and len(order) > 3:
        words.append("the columns are in reverse order")
    elif all(order[order[joint]] == joint for joint in moved):
        pairs = [(joint, order[joint]) for joint in moved if joint < order[joint]]
        words += [f"columns {first + 1} and {second + 1} are exchanged" for first, second in pairs]
    else:
        columns = listed([str(order[joint] + 1) for joint in moved])
        words.append(f"joints {listed([str(joint + 1) for joint in moved])} are in columns {columns}")
    wrong = [f"{column + 1}" for column, sign in sorted(zip(order, signs, strict=True)) if sign < 0]
    if wrong:
        words.append(f"column{'s' * (len(wrong) > 1)} {listed(wrong)} run{'s' * (len(wrong) == 1)} the other way")
    for joint, zero in enumerate(offsets, start=1):
        offset = math.remainder(zero, 2 * math.pi)
        if abs(offset) > _QUARTERS:
            value = abs(offset) if abs(abs(offset) - math.pi) < _QUARTERS else offset
            words.append(f"the zero of joint {joint} is {value / DEG:.4g} deg off")
    return "; ".join(words)


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
