"""Whether the readings of a capture are those of an arm: order, signs, zeros and units, then couplings of joints."""

import itertools
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..data.capture import Capture
from ..data.observations.measured import MeasuredPoints
from ..kinematics.arm import Arm
from .camera_points import with_points_of_cameras
from .reading_check import EXPLAINED, NEVER, ReadingCheck, checked_fit, reading_fit
from .reading_fit import ReadingFit
from .reading_search import Hypothesis

_COUPLED = 3  # couplings of joints at most
_LESS = 0.8  # of the residual: what each of several couplings must leave at most


def check_capture(arm: Arm, capture: Capture) -> ReadingCheck:
    """`check_readings` of what was recorded in sockets, or as one station of an instrument or a camera saw it; where no
    order, signs and zeros explain it, couplings of joints are tried."""
    check = checked_fit(reading_fit(arm, **_evidence_of(arm, capture)))
    return check if check.explained else check._replace(couplings=search_couplings(arm, capture))


def fits_as_recorded(arm: Arm, capture: Capture) -> bool:
    """Whether the readings fit an arm whose parameters differ from nominal ones as those of real arms do, so that no
    other order, signs and zeros have to be searched, which takes seconds. Raises `InputError` as `check_capture`
    does."""
    fit, n = reading_fit(arm, **_evidence_of(arm, capture)), arm.joints
    as_recorded = Hypothesis(tuple(range(n)), (1,) * n, (0.0,) * n)
    residual, with_zeros = fit.explanation(as_recorded).rms_fitted, fit.with_free_zeros(as_recorded)[1]
    possible = float(np.abs(fit.evidence.q).max()) <= NEVER
    return possible and residual <= EXPLAINED * fit.size and residual <= fit.as_good_as(with_zeros)


def _evidence_of(arm: Arm, capture: Capture) -> dict[str, Any]:
    """The arguments of `check_readings` for a capture."""
    if any(size > 1 for size in capture.sizes):
        return {"q": np.asarray(capture.q)[:, : arm.joints], "sockets": capture.owner}
    parts = with_points_of_cameras(capture).observations
    measured = [observation for observation in parts if isinstance(observation, MeasuredPoints)]
    if not measured:
        raise InputError(
            "readings are checked against at least two poses in one socket, measured points, or images of a camera; "
            "the capture has none of these."
        )
    station, target = measured[0].station, measured[0].target
    seen = [part for part in measured if (part.station, part.target) == (station, target)]
    return {
        "q": np.concatenate([np.asarray(part.q)[:, : arm.joints] for part in seen]),
        "positions": np.concatenate([np.asarray(part.points) for part in seen]),
        "own_frame": True,
        "free_tip": bool(target),
    }


def search_couplings(arm: Arm, capture: Capture) -> dict[str, float]:
    """Couplings of joints, 1 or -1 by the name of their coefficient, without which the readings of a capture do not fit
    the arm; empty where they fit without, or where no couplings explain them, or others as well.

    Parallel links, belts and controllers make a joint move with one before it: joint 3 by q_3 - q_2, for instance. As
    for `check_readings`, the arm's parameters and zeros may differ from nominal ones as those of real arms do. Up to
    three couplings are taken one after the other, each the one that explains most. Raises `InputError` as
    `check_capture` does.
    """
    fit, n = reading_fit(arm, **_evidence_of(arm, capture)), arm.joints
    as_recorded = Hypothesis(tuple(range(n)), (1,) * n, (0.0,) * n)
    enough, turning = EXPLAINED * fit.size, [i for i in range(n) if i + 1 not in arm.prismatic]
    residual, couplings = fit.with_free_zeros(as_recorded)[1], {}
    if residual <= enough:
        return {}
    for _ in range(_COUPLED):
        candidates = []
        for source, moved in itertools.combinations(turning, 2):
            for factor in (-1.0, 1.0):
                q = fit.evidence.q.copy()
                q[:, moved] += factor * q[:, source]
                coupled = ReadingFit(arm, fit.evidence._replace(q=q), fit.size, fit.free_tip)
                candidates.append((coupled.with_free_zeros(as_recorded)[1], source, moved, factor, coupled))
        candidates.sort(key=lambda candidate: candidate[0])
        least, source, moved, factor, fit = candidates[0]
        couplings[f"coupled{source + 1}_{moved + 1}"] = factor
        if least <= enough:
            return couplings if candidates[1][0] > fit.as_good_as(least) else {}
        if least > _LESS * residual:
            return {}
        residual = least
    return {}
