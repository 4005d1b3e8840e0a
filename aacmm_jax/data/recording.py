"""What files hold besides numbers: an arm with its name and its proposed identification, a capture with its arms."""

from typing import NamedTuple

from ..kinematics.specification import ArmSpecification
from .capture import Capture
from .sphere import ProbedSphere


class Recording(NamedTuple):
    """A capture with the nominal arm that recorded it and, for a simulation, the true one."""

    capture: Capture
    nominal: ArmSpecification
    true: ArmSpecification | None = None
    seed: int | None = None
    spheres: tuple[ProbedSphere, ...] = ()
    sources: tuple[str, ...] = ()  # files that it was read from: name and SHA-256, the latest first
    measured: str = ""  # day on which it was recorded, ISO 8601; empty where that is not stated
