"""Joint readings compared with an arm: what is wrong with their order, signs, zeros and units, in words and numbers."""

import math
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.text import pluralise
from ..core.units import DEG, LENGTH_UNITS, length_unit
from ..data.capture import Capture
from ..data.observations.measured_points import AbstractMeasured
from ..diagnostics.fixed_parameters import fixed_parameters
from ..diagnostics.joint_travel import lost_by_standing, standing_joints
from ..diagnostics.reading_check import ReadingCheck, check_readings
from ..diagnostics.reading_fit import Explanation
from ..kinematics.arm import Arm
from ..kinematics.parameters import ArmSpecification

_LISTED = 5
_SIGMA = 0.05  # mm; of tips where nothing better is known
_MUCH = 2.0  # a place of the tip that reduces the residuals by less is not spoken of
_QUARTERS = 1e-9  # rad


def check_capture(arm: Arm, capture: Capture) -> ReadingCheck:
    """`diagnostics.check_readings` of what was recorded in sockets, or as one station of an instrument saw it.

    Args:
        arm: One arm, nominal.
        capture: Sockets, or measured points or transforms.

    Raises:
        InputError: There is neither a socket of two poses nor a measured point.
    """
    if any(size > 1 for size in capture.sizes):
        return check_readings(arm, np.asarray(capture.q)[:, : arm.joints], sockets=capture.owner)
    measured = [one for one in capture.observations if isinstance(one, AbstractMeasured)]
    if not measured:
        raise InputError(
            "readings are checked against poses in a socket, at least two, or measured points; the capture has neither."
        )
    first = measured[0]
    alike = [one for one in measured if (one.station, one.target) == (first.station, first.target)]
    return check_readings(
        arm,
        np.concatenate([np.asarray(one.q)[:, : arm.joints] for one in alike]),
        positions=np.concatenate([np.asarray(one.points) for one in alike]),
        own_frame=True,
        free_tip=bool(first.target),
    )


def reading_check_summary(
    found: ReadingCheck, arm: str, *, unit: str | None = None, positions: str = "mm"
) -> dict[str, Any]:
    """Plain values for JSON and display.

    Args:
        found: What the comparison found.
        arm: Name of the arm.
        unit: Unit of the readings that was stated, or taken; None where the file says it for itself.
        positions: Unit that positions were taken to be in.
    """
    best = found.best
    return {
        "kind": "reading check",
        "arm": arm,
        "poses": found.poses,
        "unit": unit,
        "fits": found.fits,
        "explained": found.explained,
        "sentence": _sentence(found, positions),
        "tip": _tip(found),
        "given": _row(found.given, positions),
        "found": _row(best, positions) if found.explained else None,
        "alternatives": [_row(one, positions) for one in found.others],
        "equivalent": found.equal,
        "known_positions": found.known_positions,
        "rms_with_tip_mm": found.rms_with_tip,
        "hypotheses": found.tried,
    }


def standing_rows(
    arm: Arm, capture: Capture, nominal: ArmSpecification | None = None, sigma: float = _SIGMA
) -> list[dict[str, Any]]:
    """Joints that (nearly) stand still over all poses, with what they leave open, in one sentence each.

    Args:
        arm: One arm, nominal.
        capture: Poses of it.
        nominal: The arm with the free parameters that a calibration of the capture would take; None: there is none.
        sigma: Standard deviation of a tip coordinate, mm.
    """
    rows, found = [], standing_joints(arm, np.asarray(capture.readings))
    open_by = lost_by_standing(arm, capture, [one.joint for one in found]) if found else []
    last = max((i for i, lost in enumerate(open_by) if lost), default=None)
    for i, (one, lost) in enumerate(zip(found, open_by, strict=True)):
        unit, size = ("mm", one.range) if one.joint in arm.prismatic else ("deg", one.range / DEG)
        says = f"Joint {one.joint} stands still ({size:.2g} {unit} over {pluralise(one.poses, 'pose')})"
        if lost:
            says += f": {_listed(list(lost))} cannot be identified"
            says += f"; {_what_to_do([one.joint for one in found], capture, nominal, sigma)}." if i == last else "."
        else:
            says += ", which leaves nothing open that such poses could determine."
        rows.append({"joint": one.joint, f"range_{unit}": size, "poses": one.poses, "lost": list(lost), "says": says})
    return rows


def _what_to_do(joints: list[int], capture: Capture, nominal: ArmSpecification | None, sigma: float) -> str:
    move = "move it" if len(joints) == 1 else "move them"
    if nominal is None:
        return move
    bounds = nominal.bounds()
    fixed = fixed_parameters(bounds, capture, joints, sigma)
    if not set(fixed) & set(bounds.space.names):
        return f"{move}, or calibrate as it is: the parameters that are free by default leave nothing open"
    return f"{move}, or calibrate with --held {','.join(fixed)} (then nothing is said of these)"


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


def _sentence(found: ReadingCheck, positions: str) -> str:
    given, best = found.given, found.best
    if not found.explained:
        return (
            f"No order, signs and zeros of the columns make these readings fit this arm: {given.rms:.3g} mm RMS as "
            f"they are, {best.rms:.3g} mm at best. Is it the right arm, do the rows belong to these sockets or "
            "positions, and was the tip where it is said to have been?"
        )
    if found.fits:
        return (
            f"The readings fit as they are: {given.rms:.3g} mm RMS by the nominal arm, {given.rms_fitted:.3g} mm with "
            "parameters as real arms have them."
        )
    words = explanation_words(best, positions)
    return (
        f"{words[0].upper()}{words[1:]}. So corrected, the residuals by the nominal arm fall from {given.rms:.3g} to "
        f"{best.rms:.3g} mm RMS ({best.rms_fitted:.3g} mm with parameters as real arms have them)."
    )


def _tip(found: ReadingCheck) -> str:
    """How much of the residual is due to the place of the tip, which a calibration finds; empty where it is little."""
    rms = found.best.rms
    if not found.explained or found.rms_with_tip is None or _MUCH * found.rms_with_tip > rms:
        return ""
    known = (
        "what was seen is taken to be where the arm's probe is. A calibration finds its place"
        if found.free_tip
        else "what was seen is not where the arm's probe is. In its table of the manifest write target = "
        '"reflector", and a calibration finds its place'
    )
    return (
        f"Most of the {rms:.3g} mm is an offset of the tip: {known} in the last frame; with it the nominal arm leaves "
        f"{found.rms_with_tip:.3g} mm RMS."
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
        words.append(f"column{'s' * (len(wrong) > 1)} {_listed(wrong)} run{'s' * (len(wrong) == 1)} the other way")
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
    joints, columns = (_listed([str(i + 1) for i in part]) for part in (moved, [order[joint] for joint in moved]))
    return [f"joints {joints} are in columns {columns}"]


def _listed(items: list[str]) -> str:
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


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
