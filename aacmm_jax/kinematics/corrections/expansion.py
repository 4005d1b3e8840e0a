"""Thermal expansion: all lengths of the arm grow by 1 + c (T - 20 C), c the coefficient of its material.

Typical are 11.5e-6 / K for steel, 23e-6 for aluminium and about 1e-6 for carbon fibre along its fibres. The reference
temperature is that of ISO 1.
"""

from collections.abc import Sequence
from typing import ClassVar

from jaxtyping import Float

from ...core.numpy_or_jax import AnyArray
from ..chain import ForwardPass
from .kind import AbstractCorrection, Loads, Sought, Term

REFERENCE_TEMPERATURE = 20.0  # C, by ISO 1


class Expansion(AbstractCorrection):
    """The difference of the thermometer from 20 C; 0 for readings without one.

    One coefficient for the whole arm: a, d and the probe, and the travel of carriages, whose scales expand with them.
    """

    model: ClassVar[str] = "expansion"
    words: ClassVar[tuple[str, ...]] = ("expansion",)
    description: ClassVar[str] = "thermal expansion of all lengths"
    unit: ClassVar[str] = "1/K"
    usual_size: ClassVar[float] = 2e-5  # steel has 1.15e-5, aluminium 2.3e-5
    of_arm: ClassVar[bool] = True
    sought: ClassVar[tuple[Sought, ...]] = (Sought("thermal expansion", "", "temperature", "an arm that expands"),)

    def all_terms(self, joints: int, loads: Loads | None) -> tuple[Term, ...]:
        return (Term(self, "expansion", 0, 0),)

    def wrong(self, term: Term, joints: int) -> str:
        return "is of the whole arm and has no number" if term.number or term.joint else ""

    def values(
        self, terms: Sequence[Term], q: Float[AnyArray, "n ... 1 N"], forward: ForwardPass
    ) -> Float[AnyArray, "rows ... 1 N"]:
        measured = q.shape[0] > len(forward.x)
        return q[-1:] - REFERENCE_TEMPERATURE if measured else 0.0 * q[:1]
