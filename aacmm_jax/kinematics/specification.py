"""An arm with its name and its proposed identification."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from ..core.errors import InputError
from .arm import Arm, is_single
from .parameters import Bounds, Parameters


class ArmSpecification(NamedTuple):
    """An arm as a file states it: the arm, its name, and how its maker would have it identified (mm, rad)."""

    arm: Arm
    name: str = ""
    held: tuple[str, ...] | None = None  # None: the default of `Parameters.free_of`
    length: float = 10.0  # half-width of the bounds of lengths
    angle: float = 0.0175  # and of angles
    override: Mapping[str, float] = MappingProxyType({})  # half-widths by parameter name

    def bounds(self) -> Bounds:
        """The box that the file proposes."""
        space = Parameters.free_of(self.arm, held=self.held)
        return Bounds.around(self.arm, space, length=self.length, angle=self.angle, override=self.override)


def single(arm: Arm) -> Arm:
    """The same arm, or `InputError` for a batch of arms: a file holds one."""
    if not is_single(arm):
        raise InputError("a file holds one arm, but this is a batch; take one of it first.")
    return arm
