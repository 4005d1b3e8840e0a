"""Gear ratio: a joint that turns, or a carriage that moves, by a little more or less than it reads."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray
from ..chain import ForwardPass
from .kind import AbstractCorrection, Loads, Term


class GearRatio(AbstractCorrection):
    """The reading itself; of a prismatic joint, the pitch of its screw or the scale of its encoder."""

    model: ClassVar[str] = "gear"
    words: ClassVar[tuple[str, ...]] = ("gear",)
    description: ClassVar[str] = "relative error of a gear ratio"
    rows: ClassVar[int] = 1

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple[Term, ...]:
        if option:
            raise InputError(f"gear takes no option such as '{option}'; write gear alone.")
        return tuple(Term(self, "gear", 0, joint) for joint in range(1, joints + 1))

    def wrong(self, term: Term, joints: int) -> str:
        return "has a number, and takes none" if term.number else ""

    def unit_of(self, term: Term) -> str:
        return "1"

    def values(
        self, terms: Sequence[Term], q: Float[AnyArray, "n ... 1 N"], forward: ForwardPass
    ) -> Float[AnyArray, "rows ... 1 N"]:
        return q[np.array([term.joint - 1 for term in terms])]
