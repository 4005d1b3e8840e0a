"""Whether the readings of a capture are those of an arm: order, signs, zeros and units, then couplings of joints."""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..data.capture import Capture
from ..data.noise import ArmNoise
from ..data.observations.measured import MeasuredPoints
from ..kinematics.arm import Arm
from ..kinematics.corrections import coefficient_of
from ..kinematics.robots import chains_of
from .camera_points import axes_of_cameras, with_points_of_cameras
from .hand_eye_search import hand_eye_hypotheses
from .reading_check import NEVER, ReadingCheck, checked_fit, possible_units, reading_fit
from .reading_fit import ReadingFit
from .reading_search import Hypothesis

_COUPLED = 3  # couplings of joints at most
_NO_ZERO = 2e-3  # rad: what two zeros that cancel each other may leave
_LESS = 0.8  # of the residual: what each of several couplings must leave at most


def check_capture(arm: Arm, capture: Capture, usual: ArmNoise | None = None) -> ReadingCheck:
    """`check_readings` of what was recorded in sockets, or as one station of an instrument or a camera saw it; where no
    order, signs and zeros explain it, couplings of joints are tried. ``usual``: the noise that is usual for the arm, by
    which more may be left unexplained. Of a robot, of the first chain whose readings do
    not fit, with the chain's own numbers of its joints."""
    if arm.chains:
        checks = [check_capture(*part, usual) for part in _by_chain(arm, capture)]
        return next((check for check in checks if not check.explained), checks[0])
    fit = reading_fit(arm, **_evidence_of(arm, capture), usual=usual and usual.noise)
    check = checked_fit(fit, _by_cameras(fit, capture))
    return check if check.explained else _with_couplings(check, fit)


def fits_as_recorded(arm: Arm, capture: Capture, usual: ArmNoise | None = None) -> bool:
    """Whether the readings fit an arm whose parameters differ from nominal ones as those of real arms do, so that no
    other order, signs and zeros have to be searched, which takes seconds. Raises `InputError` as `check_capture`
    does."""
    if arm.chains:
        return all(fits_as_recorded(*part, usual) for part in _by_chain(arm, capture))
    fit = reading_fit(arm, **_evidence_of(arm, capture), usual=usual and usual.noise)
    as_recorded = _plain(fit)
    residual, with_zeros = fit.explanation(as_recorded).rms_fitted, fit.with_free_zeros(as_recorded)[1]
    possible = float(np.abs(fit.evidence.q).max()) <= NEVER
    return possible and residual <= fit.explained and residual <= fit.as_good_as(with_zeros)


def _by_chain(robot: Arm, capture: Capture) -> list[tuple[Arm, Capture]]:
    """Each chain of a robot as an arm, with what it observed."""
    pairs = []
    for chain in chains_of(robot).values():
        sockets, others = {}, []
        for number, part in enumerate(capture.parts):
            rows = np.flatnonzero(np.asarray(part.q)[:, robot.joints] == chain.number)
            if len(rows):
                chosen = part.select(rows)
                chosen = chosen.changed(q=chain.of_robot(chosen.q))
                if number < len(capture.sizes):
                    sockets[part.name] = chosen.q
                else:
                    others.append(chosen)
        if sockets or others:
            pairs.append((chain.arm, Capture(sockets, observations=others)))
    return pairs


def _evidence_of(arm: Arm, capture: Capture) -> dict[str, Any]:
    """The arguments of `check_readings` for a capture."""
    if any(size > 1 for size in capture.sizes):
        return {"q": np.asarray(capture.q)[:, : arm.joints], "sockets": capture.owner}
    seen = _seen(capture)
    return {
        "q": np.concatenate([np.asarray(part.q)[:, : arm.joints] for part in seen]),
        "positions": np.concatenate([np.asarray(part.points) for part in seen]),
        "own_frame": True,
        "free_tip": bool(seen[0].target),
    }


def _seen(capture: Capture) -> list[MeasuredPoints]:
    """What one station measured of one target, as points."""
    parts = with_points_of_cameras(capture).observations
    measured = [observation for observation in parts if isinstance(observation, MeasuredPoints)]
    if not measured:
        raise InputError(
            "readings are checked against at least two poses in one socket, measured points, or images of a camera; "
            "the capture has none of these."
        )
    station, target = measured[0].station, measured[0].target
    return [part for part in measured if (part.station, part.target) == (station, target)]


def _by_cameras(fit: ReadingFit, capture: Capture) -> list[Hypothesis]:
    """Signs and zeros that the orientations of a camera or its target show."""
    if any(size > 1 for size in capture.sizes):
        return []
    axes = axes_of_cameras(capture, {part.name for part in _seen(capture)})
    q, points = fit.evidence.q, fit.evidence.points
    # Numbers too large for rad are degrees, which the search of all orders finds.
    if axes is None or points is None or np.abs(q).max() > NEVER:
        return []
    return hand_eye_hypotheses(fit.arm, q, points, axes, fit.size)


def search_couplings(arm: Arm, capture: Capture) -> dict[str, float]:
    """Couplings of joints, 1 or -1 by the name of their coefficient, without which the readings of a capture do not fit
    the arm; empty where they fit without, or where no couplings explain them, or others as well.

    Parallel links, belts and controllers make a joint move with one before it: joint 3 by q_3 - q_2, for instance. As
    for `check_readings`, the arm's parameters and zeros may differ from nominal ones as those of real arms do. Up to
    three couplings are taken one after the other, each the one that explains most. Raises `InputError` as
    `check_capture` does. Chains of a robot are taken to have none.
    """
    return {} if arm.chains else _couplings(reading_fit(arm, **_evidence_of(arm, capture)))


def _couplings(fit: ReadingFit) -> dict[str, float]:
    enough, couplings = fit.explained, {}
    residual = fit.with_free_zeros(_plain(fit))[1]
    if residual <= enough:
        return {}
    for _ in range(_COUPLED):
        candidates = []
        for name, source, moved, factor in _possible(fit):
            coupled = _coupled(fit, fit.evidence.q, source, moved, factor)
            candidates.append((coupled.with_free_zeros(_plain(fit))[1], name, factor, coupled))
        candidates.sort(key=lambda candidate: candidate[0])
        least, name, factor, fit = candidates[0]
        couplings[name] = factor
        if least <= enough:
            return couplings if candidates[1][0] > fit.as_good_as(least) else {}
        if least > _LESS * residual:
            return {}
        residual = least
    return {}


def _plain(fit: ReadingFit) -> Hypothesis:
    n = fit.arm.joints
    return Hypothesis(tuple(range(n)), (1,) * n, (0.0,) * n)


def _possible(fit: ReadingFit) -> Iterator[tuple[str, int, int, float]]:
    """Couplings of two joints: name, the joint that moves the other one, and that one, from 0, and the factor."""
    turning = [i for i in range(fit.arm.joints) if i + 1 not in fit.arm.prismatic]
    for (source, moved), factor in itertools.product(itertools.combinations(turning, 2), (-1.0, 1.0)):
        yield f"coupled{source + 1}_{moved + 1}", source, moved, factor


def _coupled(fit: ReadingFit, q: np.ndarray, source: int, moved: int, factor: float, length: float = 1.0) -> ReadingFit:
    """With other readings, to one of which another one is added, and with points of another unit."""
    q = q.copy()
    q[:, moved] += factor * q[:, source]
    return ReadingFit(fit.arm, fit.evidence.scaled(1.0, length)._replace(q=q), fit.size, fit.free_tip)


def _with_couplings(check: ReadingCheck, fit: ReadingFit) -> ReadingCheck:
    """The check with couplings that explain the readings, and with the zeros and the other mistake that go with them:
    a sign, two neighbouring columns that are exchanged, or a unit, for couplings of neighbouring joints."""
    hypothesis, couplings = _plain(fit), _couplings(fit)
    if not couplings:
        found = []
        neighbours = [one for one in _possible(fit) if one[2] == one[1] + 1]
        for mistake, (name, source, moved, factor) in itertools.product(_mistakes(fit), neighbours):
            coupled = _coupled(fit, mistake.readings(fit.evidence.q), source, moved, factor, mistake.length)
            found.append((coupled.with_free_zeros(_plain(fit))[1], mistake, {name: factor}))
        least = min(residual for residual, *_ in found)
        good = [one for one in found if one[0] <= fit.as_good_as(least)]
        few = min(mistake.changes for _, mistake, _ in good)
        best = [one for one in good if one[1].changes == few]
        if least > fit.explained or len(best) > 1:
            return check
        _, hypothesis, couplings = best[0]
    q, pairs = hypothesis.readings(fit.evidence.q), []
    for name, factor in couplings.items():
        term = coefficient_of(name)
        assert term is not None
        pairs.append((term.number - 1, term.joint - 1, factor))
        q[:, term.joint - 1] += factor * q[:, term.number - 1]
    coupled = ReadingFit(fit.arm, fit.evidence.scaled(1.0, hypothesis.length)._replace(q=q), fit.size, fit.free_tip)
    explanation = coupled.needed_zeros(_plain(fit), *coupled.with_free_zeros(_plain(fit)))
    offsets = list(explanation.offsets)
    for source, moved, factor in reversed(pairs):  # the zeros of the readings, to which the couplings then apply
        offsets[moved] -= factor * offsets[source]
    offsets = [offset if abs(offset) > _NO_ZERO else 0.0 for offset in offsets]
    best = explanation._replace(**hypothesis._replace(offsets=tuple(offsets))._asdict())
    return check._replace(best=best, couplings=couplings)


def _mistakes(fit: ReadingFit) -> Iterator[Hypothesis]:
    """None, one sign, or one exchange of neighbouring columns, in each unit that is possible."""
    plain, n = _plain(fit), fit.arm.joints
    for angle, length in possible_units(fit):
        within = plain._replace(angle=angle, length=length)
        yield within
        yield from (within._replace(signs=tuple(-1 if i == joint else 1 for i in range(n))) for joint in range(n))
        for joint in range(n - 1):
            order = list(range(n))
            order[joint], order[joint + 1] = joint + 1, joint
            yield within._replace(order=tuple(order))
