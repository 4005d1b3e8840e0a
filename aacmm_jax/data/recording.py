"""A recording: a capture, its nominal arm, the true arm of a simulation, and its origin."""

from typing import NamedTuple

from ..kinematics.parameters import ArmSpecification
from .arm_classes import ArmNoise
from .capture import Capture
from .sphere import ProbedSphere


class Recording(NamedTuple):
    """A capture with the nominal arm that recorded it and, for a simulation, the true one.

    Args:
        capture: The poses, rad, and reference lengths, mm.
        nominal: The nominal arm, its name and its proposed identification.
        true: The arm that generated a simulated capture.
        seed: Seed of a simulated capture.
        spheres: Spheres probed for acceptance tests.
        sources: Files that it was read from, as name and SHA-256, the latest first.
        measured: Day of the recording, ISO 8601; empty where not stated.
        acceptance: Standards whose acceptance procedure the poses were taken for: "jjf", "asme", "iso".
        measuring_range: Diameter of the measuring volume as the arm's maker states it, mm; None where not stated.
        usual: Noise that the arm's file states, with which an estimated one is compared; None where it states none.

    Example:
        >>> recorded = aj.Recording(capture, nominal, measured="2026-01-31")
        >>> print(recorded.nominal.name, recorded.capture.sizes)
        Cheng 2018, simulated arm (40, 10)
    """

    capture: Capture
    nominal: ArmSpecification
    true: ArmSpecification | None = None
    seed: int | None = None
    spheres: tuple[ProbedSphere, ...] = ()
    sources: tuple[str, ...] = ()
    measured: str = ""
    acceptance: tuple[str, ...] = ()
    measuring_range: float | None = None
    usual: ArmNoise | None = None
