"""The causes among which `culprits` has selected, in words: how large each of them is, and what explains as much."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..core.units import ARCSEC, DEG
from .findings import Case, rounded
from .hypotheses import fixed_text
from .missing_terms import FoundTerm
from .possible_causes import Cause
from .residual_tests import ScoreTest, studentised

_ONE_JOINT = 0.9  # part of the excess of a pose that a single reading must explain to be named


class Culprit(NamedTuple):
    """A cause that explains residuals."""

    kind: str  # "term", "fixed", "pose", "certified", "noisy joint", "scatter" or "stated u"
    name: str  # what it concerns
    probability: float  # Bonferroni's: of all causes of its family
    explains: float  # of the excess of the squared residuals
    term: FoundTerm | None = None
    says: str = ""  # by how much
    size: float = 0.0  # ratio of variances, of what is noisier
    number: int = -1  # of the pose
    others: tuple[str, ...] = ()  # causes of the same kind that explain as much


class Result(NamedTuple):
    """A cause against the present model."""

    cause: Cause
    criterion: float  # twice the gain of the log likelihood, less the penalties
    probability: float  # of all causes of its family
    share: float  # of the sum of squares
    test: ScoreTest | None = None
    factor: float = 0.0  # of a variance


def in_words(case: Case, culprit: Culprit, result: Result, alike: Sequence[Result], coefficient: np.ndarray) -> Culprit:
    """A cause with its size, and with the causes that explain as much; ``coefficient`` is that of its columns."""
    cause = result.cause
    if cause.kind == "pose":
        return culprit._replace(says=_pose_text(case, cause.row), number=cause.row)
    if cause.of_noise is not None:
        return culprit._replace(size=1 + result.factor)
    if cause.kind == "certified":
        names = tuple(dict.fromkeys(r.cause.name for r in alike if r.cause.kind == cause.kind))
        return culprit._replace(others=tuple(name for name in names if name != cause.name))
    if cause.term is None or result.test is None:
        return culprit
    term = cause.term
    if cause.kind == "fixed":
        return culprit._replace(says=fixed_text(term, float(coefficient[0])))
    values = (term.values @ coefficient).reshape(len(term.values), -1)
    size = abs(coefficient[0]) if term.relative else np.linalg.norm(np.ptp(values, axis=0)) / 2
    amplitude = float(size) * (1.0 if term.joint is None else 1e-3)
    # The same step at a neighbouring pose is no other cause.
    others = [r.cause.term for r in alike if r.cause.term is not None]
    others = [o for o in others if (o.kind, o.concerns) != (term.kind, term.concerns) or o.kind == "coupling"]
    distinct = {(o.kind, o.concerns, o.correction): o for o in reversed(others)}
    probability = result.probability
    found = FoundTerm(term.kind, term.joint, result.test, probability, amplitude, tuple(distinct.values()), term)
    return culprit._replace(term=found)


def _pose_text(case: Case, number: int) -> str:
    """How far a pose is off, and what a single reading would have to be off by to explain that."""
    joints = case.record.calibrated.arm.joints
    left = case.left
    for part, rows, private in zip(case.chunks[0], left.slices, left.private, strict=False):
        (place,) = np.nonzero(part.poses == number)
        if not len(place):
            continue
        i = int(place[0])
        pose = studentised(part, left, rows, private)
        r, block = left.values[rows].reshape(part.residual.shape)[i], pose.root[i] @ pose.root[i].T
        # The residual that the pose would have if it were left out.
        away = float(np.linalg.norm(part.in_mm[i] @ np.linalg.pinv(block) @ r))
        z = part.extra[i, :, :joints]
        seen = np.maximum(np.einsum("rj,rs,sj->j", z, block, z), 1e-300)
        gains = (r @ z) ** 2 / seen
        worst = int(np.argmax(gains))
        text = f"{rounded(away)} mm off"
        explaining = gains > _ONE_JOINT * float(np.sum(pose.values[i] ** 2))
        if explaining.sum() == 1 and away > 0:
            slides = worst + 1 in case.record.calibrated.arm.prismatic
            error = abs(float((r @ z)[worst] / seen[worst])) * (1.0 if slides else 1e-3)
            size = f"{rounded(error)} mm" if slides else _angle(error)
            text += f", as if the reading of joint {worst + 1} were wrong by {size}"
        return text
    return ""


def _angle(error: float) -> str:
    return f"{rounded(error / DEG)} deg" if error > 0.1 * DEG else f"{rounded(error / ARCSEC)} arcsec"
