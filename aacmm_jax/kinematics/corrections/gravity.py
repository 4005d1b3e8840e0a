"""Compliance: a joint, with the link before it, yields to the moment of gravity about its axis.

The moment of a mass m at c about the axis z through o is m g . (z x (c - o)): linear in the direction of gravity, so
that its three components are functions of the readings alone.
"""

import functools
import operator
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import cross
from ..chain import ForwardPass, frame_axes
from .kind import AbstractCorrection, Loads, Sought, Term

_STANDARD_GRAVITY = 9.80665  # m/s^2, by definition
_METRE = 1e-3  # m/mm
_BY_MASS = 1e-2  # rad/(kN m), usual: 1 mrad for 100 N m
_KILONEWTON = 1e-3  # kN/N: with rad/(kN m), compliances are about as large as errors of angles


class Gravity(AbstractCorrection):
    """The moment of gravity about a joint's axis.

    With known masses, one coefficient a joint, ``compliance_2``, rad/(kN m). Without, one for each link after it,
    ``compliance3_2``: compliance times the weight of link 3 as if it were in the origin of its frame, of the
    last link in the tip, rad/m; only such products can be found.
    """

    model: ClassVar[str] = "gravity"
    words: ClassVar[tuple[str, ...]] = ("compliance",)
    description: ClassVar[str] = "compliances under the moment of gravity"
    unit: ClassVar[str] = "rad/m"
    unit_alone: ClassVar[str] = "rad/(kN m)"
    usual_size: ClassVar[float] = 1e-3  # 1 mrad for links with levers of 1 m
    rows: ClassVar[int] = 3
    sought: ClassVar[tuple[Sought, ...]] = (
        Sought("gravity", "", "gravity about joint {i}", "a joint or link that bends under its load"),
    )
    shared: ClassVar[str | None] = ""
    usual_of_slide: ClassVar[float | None] = 0.05

    def all_terms(self, joints: int, loads: Loads | None) -> tuple[Term, ...]:
        numbers = range(1, joints + 1)
        if loads is not None:
            return tuple(Term(self, "compliance", 0, joint, loads) for joint in numbers)
        return tuple(Term(self, "compliance", link, joint) for joint in numbers for link in range(joint, joints + 1))

    def wrong(self, term: Term, joints: int) -> str:
        if term.number and not term.joint <= term.number <= joints:
            return f"is of a link from {term.joint} to {joints}, as compliance{term.joint}_{term.joint} is"
        return ""

    def usual(self, terms: Sequence[Term]) -> dict[str, float]:
        return {self.model: self.usual_size if all(term.number for term in terms) else _BY_MASS}

    def values(
        self, terms: Sequence[Term], q: Float[AnyArray, "n ... 1 N"], forward: ForwardPass
    ) -> Float[AnyArray, "rows ... 1 N"]:
        xp, joints = namespace(forward), np.array([term.joint - 1 for term in terms])
        weights, points = zip(*[_pull(term, forward) for term in terms], strict=True)
        weight = np.array(weights).reshape(-1, *(1,) * forward.tip.ndim)
        lever = xp.stack(points) - weight * forward.origin_before[joints]
        moments = xp.moveaxis(_METRE * cross(forward.z_before[joints], lever), -2, 1)
        count = moments.shape[0] * moments.shape[1]  # a -1 is undetermined where there are no poses
        return moments.reshape(count, *moments.shape[2:])[..., None, :]


def _pull(term: Term, forward: ForwardPass) -> tuple[float, Float[AnyArray, "... 3 N"]]:
    """The weight that pulls at a joint, and the sum of weights times where they are, mm: 1 of a single link, kN."""
    if term.number:
        return 1.0, forward.tip if term.number == len(forward.origin) else forward.origin[term.number - 1]
    assert term.loads is not None
    # A link's centre of mass is at its origin, and along its axes by the coordinates that are stated.
    links = range(term.joint - 1, len(forward.origin))
    weights = {j: _KILONEWTON * _STANDARD_GRAVITY * term.loads.mass[j] for j in links}
    axes, centre = frame_axes(forward), term.loads.centre
    pulls = [weights[j] * (forward.origin[j] + sum(centre[j][k] * axes[k][j] for k in range(3))) for j in links]
    return sum(weights.values()), functools.reduce(operator.add, pulls)
