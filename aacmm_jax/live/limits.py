"""How far a capture is: U of a length so far and after ten more poses, and what limits it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.text import pluralise
from ..planning.designs import Candidates, covariance_of
from ..planning.problem import PRIOR, DesignProblem
from .candidates import TEN, Search

_ENDLESS = 1e6  # times the information of the poses so far: as many poses in these places as anybody likes
_CLOSE = 0.8  # part of U that is left with any number of poses, from which more poses hardly help
# A length that is known no better than this, mm, and than this part of what the prior alone says, is not determined.
_UNKNOWN, _OF_PRIOR = 3.0, 0.3
_MANY = 100  # poses, above which no number is predicted
_SHARE = 0.3  # part of the variance that is named


class Progress(NamedTuple):
    """U of a length now and after ten more poses, mm (None while the poses do not determine it), what limits it,
    whether a target is met, and the poses that are planned."""

    u: float | None
    u_after_ten: float | None
    limits: str
    met: bool
    ahead: list[int]


def progress(
    search: Search, known: Candidates, taken: Float[np.ndarray, "P P"], scale: float, ahead: Sequence[int],
    least: Int[np.ndarray, " s"], target: float | None, lacking: Bool[np.ndarray, " s"],
) -> Progress:  # fmt: skip
    """How far a capture is.

    Args:
        search: The candidates.
        known: They, with all that is known so far.
        taken: The part of it that the poses give.
        scale: Factor from standard uncertainties by the usual noise to U.
        ahead: The poses that were planned before.
        least: Poses that each place still needs.
        target: U that is asked for, mm.
        lacking: The places in which poses are planned.
    """
    u = scale * search.u(known.base)
    floor = scale * search.u(known.base + _ENDLESS * taken)
    least_known = scale * max(_UNKNOWN, _OF_PRIOR * search.u(known.base - taken))
    met, determined = search.scaled and target is not None and u <= target, u < least_known
    aim = target / scale if target is not None and determined and floor < target and not met else None
    planned = search.ahead(known, ahead, least, aim, lacking)
    after = scale * search.u(search.ten(known, planned))
    if not determined:
        limits = f"These poses do not determine lengths yet; {_least_known(search, known)}"
        return Progress(None, after if after < least_known else None, limits, False, planned)
    length = f"U of {search.problem.check_length:.0f} mm"
    if not search.scaled:
        limits = (
            f"{length} falls to {after:.2g} mm with {TEN} more poses if the scale of the nominal arm is exact; add a "
            "reference length, or an artefact that is certified."
        )
        return Progress(u, after, limits, False, planned)
    if met:
        return Progress(u, after, f"{length} is {u:.2g} mm: the target of {target:.2g} mm is met.", True, planned)
    if floor > (_CLOSE * u if target is None else target):
        remedy = _of_floor(search, known, taken, scale, floor)
        limits = f"More poses in these places leave {length} at {floor:.2g} mm: {remedy}"
    elif target is not None:
        # u^2 less what is left with any number of poses falls as one over their number.
        reached = scale * search.u(known.information(known.rows[planned]))
        factor = (reached**2 - floor**2) / (target**2 - floor**2)
        count = max(math.ceil(len(planned) * max(factor, 1.0)), 1)
        words = f"About {pluralise(count, 'more pose')}" if count <= _MANY else f"More than {_MANY} more poses"
        limits = f"{words} will reach {length} = {target:.2g} mm; {_least_known(search, known)}"
    else:
        limits = f"{length} falls to {after:.2g} mm with {TEN} more poses; {_least_known(search, known)}"
    return Progress(u, after, limits, False, planned)


def _of_floor(search: Search, known: Candidates, taken: np.ndarray, scale: float, floor: float) -> str:
    """What would lower U where more poses do not."""
    certified = known.base - taken
    exact = scale * search.u(known.base + _ENDLESS * (taken + np.where(np.abs(certified) > 10 * PRIOR, certified, 0.0)))
    if exact < _CLOSE * floor:
        return "add a longer or more accurate reference length."
    return "take poses in another place."


def _least_known(search: Search, known: Candidates) -> str:
    """The joint, or the probe, that most of the variance of the most uncertain length follows."""
    problem = search.problem
    covariance = covariance_of(known.base, known.parameters)
    variances = search.variances(covariance)
    along = covariance @ problem.lengths[int(np.argmax(variances))]
    shares = {}
    for group, rows in _groups(problem).items():
        shares[group] = float(along[rows] @ np.linalg.solve(covariance[np.ix_(rows, rows)], along[rows]))
    group, share = max(shares.items(), key=lambda pair: pair[1])
    names = ", ".join(problem.space.names[i] for i in _groups(problem)[group])
    if share < _SHARE * variances.max():
        return "no single joint limits it."
    return f"least is known of {group} ({names})."


def _groups(problem: DesignProblem) -> dict[str, list[int]]:
    """Numbers of the parameters of each joint, and of the probe."""
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(problem.space.names):
        groups.setdefault(_group(name), []).append(i)
    return groups


def _group(name: str) -> str:
    """The joint that a parameter is of, or the probe."""
    last = name.rsplit("_", 1)[-1]
    return f"joint {last}" if last.isdigit() else "the probe"


def gained(problem: DesignProblem, known: Candidates, candidate: int) -> str:
    """What a candidate adds, as a sentence: the parameter of which it adds most."""
    p, rows = known.parameters, known.rows[candidate]
    before = np.diagonal(covariance_of(known.base, p))
    after = np.diagonal(covariance_of(known.information(rows[None]), p))
    most = int(np.argmin(after / before))
    fall = 100 * (1 - np.sqrt(after[most] / before[most]))
    name = problem.space.names[most]
    return f"This pose tells most about {_group(name)}: the uncertainty of {name} falls by {fall:.0f} %."
