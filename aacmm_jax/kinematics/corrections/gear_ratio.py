"""Gear ratio: a joint that turns, or a carriage that moves, by a little more or less than it reads."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray
from ..chain import ForwardPass
from .kind import AbstractCorrection, Loads, Sought, Term


class GearRatio(AbstractCorrection):
    """The reading itself; of a prismatic joint, the pitch of its screw or the scale of its encoder."""

    model: ClassVar[str] = "gear"
    words: ClassVar[tuple[str, ...]] = ("gear",)
    description: ClassVar[str] = "relative errors of gear ratios"
    rows: ClassVar[int] = 1
    of_own_reading: ClassVar[bool] = True
    sought: ClassVar[tuple[Sought, ...]] = (
        Sought("gear ratio", "", "q_{i} (gear ratio)", "a wrong gear ratio", of_slides=True, relative=True),
    )
    shared: ClassVar[str | None] = ""

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple[Term, ...]:
        if option:
            raise InputError(f"gear takes no option such as '{option}'; write gear alone.")
        return tuple(Term(self, "gear", 0, joint) for joint in range(1, joints + 1))

    def option_of(self, terms: Sequence[Term]) -> str:
        return ""

    def wrong(self, term: Term, joints: int) -> str:
        return "has a number, and takes none" if term.number else ""

    def unit_of(self, term: Term) -> str:
        return "1"

    def usual(self, terms: Sequence[Term]) -> dict[str, float]:
        return {self.model: 2e-4}

    def values(
        self, terms: Sequence[Term], q: Float[AnyArray, "n ... 1 N"], forward: ForwardPass
    ) -> Float[AnyArray, "rows ... 1 N"]:
        return q[np.array([term.joint - 1 for term in terms])]
