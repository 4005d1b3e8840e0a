"""Gear ratios and couplings: joints that move in proportion to readings, their own or another's."""

import re
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray
from ..chain import ForwardPass
from .kind import AbstractCorrection, Loads, Sought, Term


class GearRatio(AbstractCorrection):
    """The reading itself: a joint that turns, or a carriage that moves, by a little more or less than it reads."""

    model: ClassVar[str] = "gear"
    words: ClassVar[tuple[str, ...]] = ("gear",)
    description: ClassVar[str] = "relative errors of gear ratios"
    unit: ClassVar[str] = "1"
    usual_size: ClassVar[float] = 2e-4
    of_own_reading: ClassVar[bool] = True
    sought: ClassVar[tuple[Sought, ...]] = (
        Sought("gear ratio", "", "q_{i} (gear ratio)", "a wrong gear ratio", of_slides=True, relative=True),
    )
    shared: ClassVar[str | None] = ""

    def values(
        self, terms: Sequence[Term], q: Float[AnyArray, "n ... 1 N"], forward: ForwardPass
    ) -> Float[AnyArray, "rows ... 1 N"]:
        return q[np.array([term.joint - 1 for term in terms])]


class Coupling(AbstractCorrection):
    """The reading of another joint: a motor or a belt that turns one joint moves another a little, too.

    ``coupled=2-3`` lets the reading of joint 2 move joint 3; by default each joint moves the next.
    """

    model: ClassVar[str] = "coupled"
    words: ClassVar[tuple[str, ...]] = ("coupled",)
    description: ClassVar[str] = "parts of other joints' readings"
    unit: ClassVar[str] = "1"
    usual_size: ClassVar[float] = 2e-4
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

    def values(
        self, terms: Sequence[Term], q: Float[AnyArray, "n ... 1 N"], forward: ForwardPass
    ) -> Float[AnyArray, "rows ... 1 N"]:
        return q[np.array([term.number - 1 for term in terms])]
