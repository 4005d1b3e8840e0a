"""Why data do not belong to an arm: mistakes in the recording that are tried one by one on the nominal arm."""

import itertools
from collections.abc import Iterator

import numpy as np

from ..data.capture import Capture
from ..kinematics.arm import Arm

_BETTER = 4.0  # the factor by which a correction must reduce the scatter of the tips to be named


def likely_cause(arm: Arm, capture: Capture) -> str:
    """The mistake whose correction makes the tips of each socket coincide far better, as a sentence; or nothing."""
    q = np.asarray(capture.q)
    given = _scatter(arm, capture, q)
    scatter, cause = min((_scatter(arm, capture, corrected), cause) for cause, corrected in _corrections(q))
    return f"Likely cause: {cause}." if scatter < given / _BETTER else ""


def _scatter(arm: Arm, capture: Capture, q: np.ndarray) -> float:
    """RMS distance of the tips from the centroid of their socket, mm."""
    tips = np.split(np.asarray(arm.position(q)), np.cumsum(capture.sizes)[:-1])
    return float(np.sqrt(np.mean(np.concatenate([np.sum((tip - tip.mean(axis=0)) ** 2, axis=1) for tip in tips]))))


def _corrections(q: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    joints = range(q.shape[1])
    for several in (1, 2):
        for chosen in itertools.combinations(joints, several):
            signs = np.where(np.isin(joints, chosen), -1.0, 1.0)
            named = " and ".join(str(joint + 1) for joint in chosen)
            yield f"joint{'s' if several > 1 else ''} {named} read with the wrong sign", q * signs
    yield "all joints read with the wrong sign", -q
    for one, other in itertools.combinations(joints, 2):
        order = list(joints)
        order[one], order[other] = other, one
        yield f"the columns of joints {one + 1} and {other + 1} are exchanged", q[:, order]
    yield "the columns are in reverse order", q[:, ::-1]
    yield "readings in gon are taken for degrees", 0.9 * q
