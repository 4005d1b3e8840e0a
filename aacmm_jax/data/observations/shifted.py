"""An observation with errors other than those it was recorded with: what repeated calibrations are made of."""

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.numpy_or_jax import AnyArray, namespace
from .observation import AbstractObservation, Rows, Tips, Unknowns


class ShiftedObservation(AbstractObservation):
    """An observation with other readings, a constant added to each residual, and certified values of its own.

    Args:
        observation: The observation, of the same number of poses.
        q: Its readings ``(m, n)``, rad.
        shift: What is added to its residuals ``(r, m)``, mm and rad.
        values: Certified values by the names of its certified parts.
    """

    observation: AbstractObservation
    q: Float[AnyArray, "m n"]
    shift: Float[AnyArray, "r m"]
    values: dict[str, Float[AnyArray, " k"]]

    def __init__(
        self,
        observation: AbstractObservation,
        q: Float[AnyArray, "*batch m n"],
        shift: Float[AnyArray, "*batch r m"],
        values: Mapping[str, Float[AnyArray, "*batch k"]],
    ):
        self.observation, self.q, self.shift, self.values = observation, q, shift, dict(values)

    @property
    def kind(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """That of the observation."""
        return self.observation.kind

    @property
    def rows(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Residuals of each pose."""
        return self.observation.rows

    @property
    def rotates(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether its residual depends on the rotation of the last frame."""
        return self.observation.rotates

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """That of the observation."""
        return self.observation.name

    @property
    def target(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """That of the observation."""
        return self.observation.target

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        return self.observation.unknowns

    @property
    def fixes_scale(self) -> bool:
        return self.observation.fixes_scale

    @property
    def certified(self) -> dict[str, tuple[Float[AnyArray, " k"], Float[AnyArray, " k"]]]:
        return {name: (self.values[name], u) for name, (_, u) in self.observation.certified.items()}

    @property
    def linear(self) -> bool:
        return self.observation.linear

    @property
    def alike(self) -> Hashable | None:
        inside = self.observation.alike
        return None if inside is None else (type(self.observation), inside)

    @classmethod
    def stacked(cls, observations: Sequence[AbstractObservation]) -> AbstractObservation:
        shifted: list[Any] = list(observations)
        inside, shift = [one.observation for one in shifted], [one.shift for one in shifted]
        changed = super().stacked(observations)
        object.__setattr__(changed, "observation", inside[0].stacked(inside))
        object.__setattr__(changed, "shift", namespace(shift).concatenate(shift, axis=1))
        return changed

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> dict[str, Float[AnyArray, " k"]]:
        return self.observation.start(tips, offset)

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        rows = self.observation.residual(tips, unknowns)
        return rows._replace(values=rows.values + self.shift)

    def check_determined(self, tips: Float[np.ndarray, "3 m"]) -> None:
        self.observation.check_determined(tips)
