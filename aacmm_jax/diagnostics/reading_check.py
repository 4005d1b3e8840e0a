"""Whether joint readings are those of an arm, and if not, which order, signs, zeros and units make them so.

The best hypotheses of `reading_search`, for the nominal arm, are refitted: first with free zeros of the joints, then
with those zeros alone that are needed. Every other parameter may leave its nominal value as an arm's real ones do, so
that residuals of a few millimetres, which a nominal arm has anyway, do not decide. `reading_check_summary` has
the result in words and numbers.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arguments import checked_arguments
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..core.text import listed
from ..core.units import DEG, INCH, LENGTH_UNITS, M, length_unit
from ..data.noise import Noise
from ..kinematics.arm import Arm, is_single, joint_limits
from ..kinematics.corrections import coefficient_of
from ..kinematics.jacobian import tip_position
from ..kinematics.workspace import total_link_length
from .joint_travel import standing_joints
from .reading_fit import Explanation, ReadingFit
from .reading_search import Evidence, Hypothesis, search

_REFITTED = 24  # hypotheses
_EQUAL = 1e-6, 2e-4  # of a residual, and mm: the same cost but for rounding
_LISTED = 200  # hypotheses of equal cost that are looked at
_TURN = 2 * np.pi * 1.02  # rad; readings of few joints go further
NEVER = 8 * np.pi  # rad; no reading is as large
_LENGTHS = (M, 1 / M, INCH, 1 / INCH)
_NEAREST, _FARTHEST = 0.05, 1.3  # of the arm's size: distances of known positions from the base
_APART = 50 * DEG  # zeros that differ by less are adjusted, not confused
_SAME = 5 * DEG  # alternatives whose zeros differ by less are one
_COMMON = 200  # readings at which two hypotheses are compared
_ALIKE = 1e-6  # of the arm's size


class ReadingCheck(NamedTuple):
    """What `check_readings` found.

    Example:
        >>> check = aj.diagnostics.check_readings(arm, capture.q[:20], positions=true.position(capture.q[:20]))
        >>> print(check.fits, check.explained, check.poses)
        True True 20
    """

    given: Explanation  # nothing changed
    best: Explanation  # the simplest of the best; ``given`` where the readings fit as they are
    others: tuple[Explanation, ...]  # as good on these data, but not everywhere
    equal: int  # further ones that have the tip in the same positions everywhere, whatever the readings
    explained: bool  # whether the best leaves residuals that an arm of this kind has
    poses: int
    known_positions: bool  # in the base frame
    tried: int  # hypotheses
    # Of the nominal arm as the best has it, with the tip where it fits in the last frame, mm; None: it is not free.
    rms_with_tip: float | None = None
    free_tip: bool = False  # whether the place of the tip was said to be unknown
    # Of joints that move with others, 1 or -1 by the name of the coefficient: what explains the readings of a capture
    # where nothing else does, together with ``best``.
    couplings: Mapping[str, float] = MappingProxyType({})

    @property
    def fits(self) -> bool:
        """Whether the readings fit as they are."""
        return self.explained and self.best == self.given


@checked_arguments
def check_readings(
    arm: Arm,
    q: Float[AnyArray, "poses joints"],
    *,
    sockets: Numbers | None = None,
    positions: Float[AnyArray, "poses 3"] | None = None,
    rotations: Float[AnyArray, "poses 3 3"] | None = None,
    own_frame: bool = False,
    free_tip: bool = False,
) -> ReadingCheck:
    """Find the order, signs, zeros and units with which recorded readings fit an arm best.

    Either the tip was held in sockets, whose positions are unknown; or it was at known positions. Where two
    explanations have the tip in the same positions for all readings (a wrist that is flipped, a joint whose axis goes
    through the tip), the simpler one is given; where they differ only beyond these data, all are listed.

    Args:
        arm: One arm, nominal.
        q: Readings ``(m, n)``, a column each for as many joints as the arm has, rad.
        sockets: Number or name of the socket of each pose ``(m,)``.
        positions: Instead: where the tip was ``(m, 3)``, mm.
        rotations: With positions in the base frame: orientation of the last frame ``(m, 3, 3)``.
        own_frame: Whether positions are in the frame of an instrument, at an unknown place, instead of the base frame.
        free_tip: Whether the place of the tip in the last frame is unknown, such as that of a reflector.

    Returns:
        The explanation, others that are as good, and whether anything explains the readings.

    Raises:
        InputError: Shapes do not fit, or there are too few poses to say anything.

    Example:
        >>> in_another_order = capture.q[:20, [1, 0, 2, 3, 4, 5]]
        >>> check = aj.diagnostics.check_readings(arm, in_another_order, positions=true.position(capture.q[:20]))
        >>> print(check.fits, check.best.order)
        False (1, 0, 2, 3, 4, 5)
    """
    return checked_fit(reading_fit(arm, q, sockets, positions, rotations, own_frame, free_tip))


def reading_fit(
    arm: Arm,
    q: Float[AnyArray, "poses joints"],
    sockets: Numbers | None = None,
    positions: Float[AnyArray, "poses 3"] | None = None,
    rotations: Float[AnyArray, "poses 3 3"] | None = None,
    own_frame: bool = False,
    free_tip: bool = False,
    usual: Noise | None = None,
) -> ReadingFit:
    """What hypotheses are compared by; the arguments are those of `check_readings`, and the noise that is usual for
    arms of this class."""
    arm = to_numpy(arm)
    if not is_single(arm):
        raise InputError("check_readings takes one arm, not a batch; give one arm of the batch.")
    q = np.asarray(q)
    if q.shape[1] != arm.joints or not len(q):
        raise InputError(f"q has shape {q.shape}; give one row per pose and {arm.joints} columns.")
    if (sockets is None) == (positions is None):
        raise InputError("give either the sockets of the poses or the positions of the tip.")
    if positions is not None:
        if own_frame and (len(q) < 4 or rotations is not None):
            raise InputError("in an instrument's own frame, give at least four positions, and no orientations.")
        turned = None if rotations is None else np.asarray(rotations)
        evidence = Evidence(q, np.zeros(len(q), dtype=int), np.asarray(positions), turned, own_frame)
    else:
        names, owner = np.unique(np.asarray(sockets), return_inverse=True)
        if owner.shape != (len(q),):
            raise InputError(f"sockets has shape {owner.shape}; give one number or name for each of {len(q)} poses.")
        if np.bincount(owner, minlength=len(names)).max() < 2:
            raise InputError("no socket has two poses, so nothing can be compared; record more poses in a socket.")
        order = np.argsort(owner, kind="stable")
        evidence = Evidence(q[order], owner[order])
    return ReadingFit(arm, evidence, max(total_link_length(arm), 1e-9), free_tip, usual)


def checked_fit(fit: ReadingFit, likely: Sequence[Hypothesis] = ()) -> ReadingCheck:
    """The hypotheses that the search finds, and others that are likely, refitted and compared."""
    arm, evidence, n = fit.arm, fit.evidence, fit.arm.joints
    given = fit.explanation(Hypothesis(tuple(range(n)), (1,) * n, (0.0,) * n))
    candidates, tried = [([fitted], zeros, rms) for fitted, zeros, rms in map(fit.with_fitted_zeros, likely)], 0
    for angle, length in possible_units(fit):
        rms, hypotheses, count = search(arm, evidence.scaled(angle, length).thinned(), fit.lever)
        tried += count
        groups: list[list[Hypothesis]] = []  # those of equal residual together
        before = -np.inf
        for residual, hypothesis in zip(rms, hypotheses, strict=True):
            if residual - before > _EQUAL[0] * residual + _EQUAL[1] * fit.size / M:
                if len(groups) == _REFITTED:
                    break
                groups.append([])
                before = residual
            groups[-1].append(hypothesis._replace(angle=angle, length=length))
        for members in groups:
            members.sort(key=lambda hypothesis: (fit.outside(hypothesis) > 0, hypothesis.changes))
            candidates.append((members, *fit.with_free_zeros(members[0])))
    possible = float(np.abs(evidence.q).max()) <= NEVER
    bound = fit.as_good_as(min([rms for *_, rms in candidates] + [given.rms_fitted] * possible))
    good = [(members, fit.needed_zeros(members[0], zeros, rms)) for members, zeros, rms in candidates if rms <= bound]
    explanations = [explanation for _, explanation in good] + [given] * (possible and given.rms_fitted <= bound)
    closest = min(explanations, key=lambda explanation: explanation.rms_fitted)
    explained, best, others, equal = closest.rms_fitted <= fit.explained, closest, (), 0
    if explained:
        simplest = (_with_common_zero(fit, explanation) for explanation in explanations)
        best = min(simplest, key=lambda x: (x.outside > 0, x.changes, x.rms_fitted))
        others, equal = _others(fit, best, good)
    best = best if best == given else fit.within_limits(best)
    with_tip = fit.with_tip_found(best) if evidence.own_frame else None
    return ReadingCheck(
        given, best, others, equal, explained, len(evidence.q), evidence.in_base, tried, with_tip, fit.free_tip
    )


def _with_common_zero(fit: ReadingFit, best: Explanation) -> Explanation:
    """The same with one zero for all joints, such as the middle of servos, where several have it, and that fits as well
    with no more readings outside the joint limits: a single mistake. The data do not show the zeros of all joints, such
    as that of the first one in an instrument's own frame."""
    moved = [offset for offset in best.offsets if offset]
    apart = [abs(math.remainder(offset - moved[0], 2 * math.pi)) for offset in moved]
    if len(moved) < 2 or max(apart) > _SAME or fit.arm.prismatic:
        return best
    common = fit.explanation(best.hypothesis._replace(offsets=(moved[0],) * fit.arm.joints))
    as_good = common.rms_fitted <= fit.as_good_as(best.rms_fitted) and common.outside <= best.outside
    return common if as_good else best


def possible_units(fit: ReadingFit) -> Iterator[tuple[float, float]]:
    """Factors of readings and of positions that are possible: 1, and others where the numbers look like them."""
    evidence, size = fit.evidence, fit.size
    largest = float(np.abs(evidence.q).max())
    angles = [1.0] if largest <= NEVER else []
    angles += [DEG] if largest > _TURN else [1 / DEG] if 0 < largest < _TURN * DEG else []
    lengths = [1.0]
    if evidence.points is not None:
        points = evidence.points
        distances = np.linalg.norm(points - (points.mean(axis=0) if evidence.own_frame else 0.0), axis=1)
        farthest, span = float(distances.max()), size + abs(float(np.asarray(fit.arm.d)[0]))
        if not _NEAREST * span <= farthest <= _FARTHEST * span:
            possible = [x for x in _LENGTHS if _NEAREST * span <= x * farthest <= _FARTHEST * span]
            lengths = [1.0] * (farthest < _FARTHEST * span or not possible) + possible  # small ones are possible, too
    yield from itertools.product(angles, lengths)


def _others(
    fit: ReadingFit, best: Explanation, good: Sequence[tuple[list[Hypothesis], Explanation]]
) -> tuple[tuple[Explanation, ...], int]:
    """Explanations that are as good, but differ from the best beyond these data; and the number of those that do not.

    Hypotheses of equal cost are compared as they were tried, with zeros at multiples of 45 degrees.
    """
    bound, others, equal, best_seen = fit.as_good_as(best.rms_fitted), [], 0, False
    for members, explanation in good:
        of_best = not best_seen and (best.hypothesis in members or best == explanation)
        best_seen = best_seen or of_best
        base = members[0] if of_best and best.hypothesis not in members else best.hypothesis
        for member in members[:_LISTED] if of_best else [explanation.hypothesis]:
            same, mirrored = _compared(fit, member, base)
            if same or any(_compared(fit, member, other)[0] for other, _ in others):
                equal += same and member[:3] != base[:3]
                continue
            other = fit.needed_zeros(member, *fit.with_free_zeros(member)) if of_best else explanation
            if other.rms_fitted <= bound and (best.outside > 0 or not other.outside) and _distinct(other, best):
                others.append((member, other._replace(mirrored=mirrored)))
    # Of a joint that stands still, unless there is a single pose, nothing that an alternative says could be tested.
    still = [joint.joint - 1 for joint in standing_joints(fit.arm, best.angle * fit.evidence.q)]
    still = still if len(still) < fit.arm.joints else []
    kept: list[Explanation] = []
    for _, other in others:
        differs = any(a[i] != b[i] for a, b in zip(other[:3], best[:3], strict=True) for i in still)
        if not (other.angle == best.angle and differs) and all(_distinct(other, before, _SAME) for before in kept):
            kept.append(other)
    return tuple(sorted(kept, key=lambda other: (other.changes, other.rms_fitted))), equal


def _distinct(first: Explanation, other: Explanation, apart: float = _APART) -> bool:
    """Whether two explanations differ by more than zeros that are poorly determined."""
    if first[:2] != other[:2] or first[3:5] != other[3:5]:
        return True
    pairs = zip(first.offsets, other.offsets, strict=True)
    return any(abs(math.remainder(x - y, 2 * math.pi)) > apart for x, y in pairs)


def _compared(fit: ReadingFit, first: Hypothesis, other: Hypothesis) -> tuple[bool, bool]:
    """Whether two hypotheses have the tip in the same positions for all readings, but for the place of the base where
    that is unknown; and whether in mirror images of them."""
    limits = np.asarray(joint_limits(fit.arm, None))
    q = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (_COMMON, fit.arm.joints))
    geometry = to_numpy(fit.arm.geometry)
    a, b = (np.asarray(tip_position(geometry, x._replace(angle=1.0).readings(q))) for x in (first, other))
    if fit.evidence.in_base:
        return bool(np.abs(a - b).max() < _ALIKE * fit.size), False
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    turns = (u @ np.diag([1.0, 1.0, sign * np.linalg.det(u @ v)]) @ v for sign in (1.0, -1.0))
    same, mirrored = (bool(np.abs(a @ turn - b).max() < _ALIKE * fit.size) for turn in turns)
    return same, mirrored


_WORDED = 5  # alternatives
_MUCH = 2.0  # a place of the tip that reduces the residuals by less is not spoken of
_QUARTERS = 1e-9  # rad


def reading_check_summary(
    check: ReadingCheck, arm: str, *, unit: str | None = None, positions: str = "mm"
) -> dict[str, Any]:
    """Plain values for JSON and display; ``unit`` is that of the readings, stated or taken, None where the file says it
    for itself, and ``positions`` that which positions were taken to be in."""
    given, best, tip = check.given, check.best, ""
    improved = f"from {given.rms:.3g} to {best.rms:.3g} mm RMS ({best.rms_fitted:.3g} mm"
    words = explanation_words(best, positions)
    if check.couplings:
        sentence = f"The readings fit an arm with coupled joints: {coupling_words(check.couplings)}. " + (
            f"In addition, {words}. State both in the manifest."
            if words
            else "'aacmm calibrate' finds these couplings, unless a model is stated."
        )
    elif not check.explained:
        sentence = (
            f"No permutation, sign or zero offset of the columns explains these readings: {given.rms:.3g} mm RMS as "
            f"they are, {best.rms:.3g} mm at best. Is this the right arm, do the rows belong to these sockets or "
            "positions, and was the tip really at these places?"
        )
    elif check.fits:
        sentence = (
            f"The readings fit as they are: {given.rms:.3g} mm RMS with the nominal arm, {given.rms_fitted:.3g} mm "
            "with the most probable parameters of a real arm."
        )
    else:
        sentence = (
            f"{words[0].upper()}{words[1:]}. Correcting this reduces the residuals (nominal arm) {improved} with "
            "the most probable parameters of a real arm)."
        )
    # How much of the residual is due to the place of the tip, which a calibration finds.
    if check.explained and check.rms_with_tip is not None and _MUCH * check.rms_with_tip <= best.rms:
        place = (
            "this check assumes that the target is at the arm's probe. A calibration identifies the position of "
            "the target"
            if check.free_tip
            else (
                "the target is not at the arm's probe. In the table of the observation in the manifest, write "
                'target = "reflector"; a calibration then identifies the position of the target'
            )
        )
        tip = (
            f"Most of the {best.rms:.3g} mm is due to an offset of the tip: {place} in the last frame. With this "
            f"position fitted, the residuals of the nominal arm are {check.rms_with_tip:.3g} mm RMS."
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


def coupling_words(couplings: Mapping[str, float]) -> str:
    """What full couplings do, in words."""
    texts = []
    for name, factor in couplings.items():
        term = coefficient_of(name)
        assert term is not None
        texts.append(
            f"joint {term.joint} moves by its reading {'plus' if factor > 0 else 'minus'} that of joint {term.number} "
            f"({name} = {factor:g})"
        )
    return listed(texts)


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
        words.append("the readings are in {}, but were read as {}".format(*units))
    if length != 1:
        unit = length_unit(length * LENGTH_UNITS[positions])
        words.append(
            f"the positions are {length:.4g} times as large as assumed"
            if unit is None
            else f"the positions are in {unit}, but were read as {positions}"
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
        words.append(
            f"column{'s' * (len(wrong) > 1)} {listed(wrong)} {'has' if len(wrong) == 1 else 'have'} the opposite sign"
        )
    zeros = [math.remainder(zero, 2 * math.pi) for zero in offsets]
    values = [abs(zero) if abs(abs(zero) - math.pi) < _QUARTERS else zero for zero in zeros]
    if len(values) > 1 and min(map(abs, values)) > _QUARTERS and max(values) - min(values) < _QUARTERS:
        return "; ".join([*words, f"the zeros of all joints are {values[0] / DEG:.4g} deg off"])
    for joint, value in enumerate(values, start=1):
        if abs(value) > _QUARTERS:
            words.append(f"the zero of joint {joint} is {value / DEG:.4g} deg off")
    return "; ".join(words)


def alternatives_sentence(rows: list[dict[str, Any]], known_positions: bool) -> str:
    """What these data cannot tell from what was found, and what would; empty where there is nothing."""
    if not rows:
        return ""
    texts = [
        (f"that {row['says']}" if row["says"] else "that nothing is wrong") + " (a mirror image)" * row["mirror_image"]
        for row in rows[:_WORDED]
    ]
    more = f"; or one of {len(rows) - _WORDED} further explanations" if len(rows) > _WORDED else ""
    needed = "More poses at known positions" if known_positions else "A pose at a known position"
    return (
        f"These data fit nearly as well if one assumes {'; or '.join(texts)}{more}. {needed} would tell these "
        "explanations apart."
    )
