"""An arm with its name and its proposed identification."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from ..core.errors import InputError
from .arm import Arm, is_single
from .parameters import Bounds, Parameters


class ArmSpecification(NamedTuple):
    """An arm as a file states it, with the identification that the file proposes.

    Args:
        arm: The nominal arm.
        name: What people call it.
        held: Names of the fixed parameters; None for the default of `Parameters.free_of`.
        length: Half-width of the bounds of lengths, mm.
        angle: Half-width of the bounds of angles, rad.
        override: Half-widths of single parameters by name, mm or rad.
        free: Names that are free in addition, such as Hayati's ``beta_2``.
    """

    arm: Arm
    name: str = ""
    held: tuple[str, ...] | None = None
    length: float = 10.0
    angle: float = 0.0175
    override: Mapping[str, float] = MappingProxyType({})
    free: tuple[str, ...] = ()

    def space(self) -> Parameters:
        """The free parameters that the file proposes."""
        return Parameters.free_of(self.arm, held=self.held, free=self.free)

    def bounds(self) -> Bounds:
        """The bounds that the file proposes."""
        return Bounds.around(self.arm, self.space(), length=self.length, angle=self.angle, override=self.override)


def single(arm: Arm) -> Arm:
    """The same arm; raises `InputError` for a batch of arms, since a file holds one."""
    if not is_single(arm):
        raise InputError("a file holds one arm, but this is a batch; take one of it first.")
    return arm
