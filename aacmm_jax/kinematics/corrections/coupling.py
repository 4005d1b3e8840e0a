"""Coupled joints: a motor or a belt that turns one joint moves another a little, too."""

import re
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray
from ..chain import ForwardPass
from .kind import AbstractCorrection, Loads, Term


class Coupling(AbstractCorrection):
    """The reading of another joint: ``coupled=2-3`` lets the reading of joint 2 move joint 3; by default the next."""

    model: ClassVar[str] = "coupled"
    words: ClassVar[tuple[str, ...]] = ("coupled",)
    description: ClassVar[str] = "parts of other joints' readings"
    rows: ClassVar[int] = 1
    usual_of_slide: ClassVar[float | None] = 0.05

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple[Term, ...]:
        if not option:
            return tuple(Term(self, "coupled", joint - 1, joint) for joint in range(2, joints + 1))
        pairs = [re.fullmatch(r"([1-9]\d*)-([1-9]\d*)", pair) for pair in option.split("+")]
        if not all(pairs):
            raise InputError(f"coupled={option} names no joints; coupled=2-3 lets the reading of joint 2 move joint 3.")
        return tuple(Term(self, "coupled", int(pair[1]), int(pair[2])) for pair in pairs if pair)

    def option_of(self, terms: Sequence[Term]) -> str:
        return "+".join(dict.fromkeys(f"{term.number}-{term.joint}" for term in terms))

    def wrong(self, term: Term, joints: int) -> str:
        if not 1 <= term.number <= joints:
            return f"is of the reading of another joint from 1 to {joints}, as coupled2_3 is"
        return "is of its own reading, which gear is" if term.number == term.joint else ""

    def unit_of(self, term: Term) -> str:
        return "1"

    def usual(self, terms: Sequence[Term]) -> dict[str, float]:
        return {self.model: 2e-4}

    def values(
        self, terms: Sequence[Term], q: Float[AnyArray, "n ... 1 N"], forward: ForwardPass
    ) -> Float[AnyArray, "rows ... 1 N"]:
        return q[np.array([term.number - 1 for term in terms])]
