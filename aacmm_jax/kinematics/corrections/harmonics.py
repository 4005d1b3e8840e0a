"""Harmonics of an encoder: its error as a Fourier series of its own reading.

An encoder that is eccentric by e at the radius R errs by e / R times a sine of its reading (10 um at 50 mm: 41 arcsec);
one that is oval or tilted errs by the second harmonic, and N evenly spaced read heads leave multiples of N only.
"""

import re
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray, namespace
from ..chain import ForwardPass
from .kind import AbstractCorrection, Loads, Sought, Term

HIGHEST = 99


def orders_of(option: str) -> tuple[int, ...] | None:
    """The orders that an option such as ``1-3+8`` names, each once; None where it names none from 1 to the highest."""
    orders: set[int] = set()
    for part in option.split("+"):
        ends = re.fullmatch(r"([1-9]\d?)(?:-([1-9]\d?))?", part)
        if ends is None or int(ends[2] or ends[1]) < int(ends[1]):
            return None
        orders |= set(range(int(ends[1]), int(ends[2] or ends[1]) + 1))
    return tuple(sorted(orders))


class Harmonics(AbstractCorrection):
    """cos hq and sin hq of every joint; of orders 1 and 2 by default, or of an option's: ``harmonics=1-3+8``."""

    model: ClassVar[str] = "harmonics"
    words: ClassVar[tuple[str, ...]] = ("cos", "sin")
    description: ClassVar[str] = "harmonics of encoders"
    unit: ClassVar[str] = "rad"
    usual_size: ClassVar[float] = 5e-5  # 10 arcsec
    of_own_reading: ClassVar[bool] = True
    sought: ClassVar[tuple[Sought, ...]] = (
        Sought("first harmonic", "1", "cos q_{i}", "an eccentric encoder or a bending link"),
        Sought("second harmonic", "2", "cos 2 q_{i}", "a tilted or oval encoder"),
    )
    shared: ClassVar[str | None] = "1-3"
    usual_of_slide: ClassVar[float | None] = 0.05

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple[Term, ...]:
        orders = orders_of(option or "1+2")
        if orders is None:
            raise InputError(
                f"harmonics={option} has no orders from 1 to {HIGHEST}; write harmonics=1, harmonics=1+2 or "
                "harmonics=1-31."
            )
        return tuple(
            Term(self, word, order, joint) for joint in range(1, joints + 1) for order in orders for word in self.words
        )

    def option_of(self, terms: Sequence[Term]) -> str:
        orders = sorted({term.number for term in terms})
        first = [order for order in orders if order - 1 not in orders]
        last = [order for order in orders if order + 1 not in orders]
        runs = [(low,) if low == high else (low, high) for low, high in zip(first, last, strict=True)]
        return "" if orders == [1, 2] else "+".join("-".join(map(str, run)) for run in runs)

    def wrong(self, term: Term, joints: int) -> str:
        return "" if 1 <= term.number <= HIGHEST else f"has no order from 1 to {HIGHEST}"

    def usual(self, terms: Sequence[Term]) -> dict[str, float]:
        octaves = [(2**k, min(2 ** (k + 1) - 1, HIGHEST)) for k in range(HIGHEST.bit_length())]
        return {f"{self.model}={low}" + (f"-{high}" if high > low else ""): self.usual_size for low, high in octaves}

    def values(
        self, terms: Sequence[Term], q: Float[AnyArray, "n ... 1 N"], forward: ForwardPass
    ) -> Float[AnyArray, "rows ... 1 N"]:
        xp, joints = namespace(q), sorted({term.joint for term in terms})
        readings = q[np.array(joints) - 1]
        cos, sin = xp.cos(readings)[None], xp.sin(readings)[None]
        highest = max(term.number for term in terms)
        while len(cos) < highest:
            # Orders k + 1 to 2k from 1 to k by addition of angles: three times as fast as the cosine of every multiple,
            # and as exact.
            c, s, more = cos[-1:], sin[-1:], min(len(cos), highest - len(cos))
            next_cos, next_sin = c * cos[:more] - s * sin[:more], s * cos[:more] + c * sin[:more]
            cos, sin = xp.concatenate([cos, next_cos]), xp.concatenate([sin, next_sin])
        both = xp.concatenate([cos, sin])
        order = np.array([term.number - 1 + highest * (term.word == "sin") for term in terms])
        return both[order, np.array([joints.index(term.joint) for term in terms])]
