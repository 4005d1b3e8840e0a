"""A recording: a capture, its arm, what else was recorded with it, and where it comes from."""

from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arguments import NOT_EMPTY, Name, Range, checked_fields
from ..core.errors import InputError
from ..kinematics.parameters import ArmSpecification
from .capture import Capture
from .noise import ArmNoise

SphereTest = Literal["effective-diameter", "probing", "articulation"]
NotNegativeMm = Annotated[float, Range(least=0, unit="mm")]


class ProbedSphere(NamedTuple):
    """A reference sphere as it was probed for an acceptance test; it takes no part in a calibration.

    Args:
        name: Name of the sphere.
        test: The test that it is for.
        groups: Joint readings ``(m, n)``, rad, or centres of the probe ``(m, 3)``, mm; one group for each sphere that
            is fitted: the repeats of ASME's effective diameter, the 25 points of ISO's probing test, or the
            orientations of its articulation test.
        diameter: Calibrated diameter, mm.
        u: Standard uncertainty (k = 1) of the diameter, mm.
        stylus: Diameter of the probe's ball, mm; 0 where the points are on the sphere itself.
        form: Calibrated form error of the sphere, mm.
        u_form: Standard uncertainty (k = 1) of the form error, mm.

    Example:
        >>> nine = np.array(aj.simulate(true, {"A": (400, 200, 300)}, poses=9, seed=1).sockets["A"])
        >>> sphere = aj.data.ProbedSphere("sphere", "effective-diameter", (nine,), diameter=25.0, u=0.0005)
        >>> print(len(sphere.groups), sphere.groups[0].shape)
        1 (9, 6)
    """

    name: Name
    test: SphereTest
    groups: tuple[Annotated[Float[np.ndarray, "_ columns"], NOT_EMPTY], ...]
    diameter: Annotated[float, Range(above=0, unit="mm")]
    u: NotNegativeMm = 0.0
    stylus: NotNegativeMm = 0.0
    form: NotNegativeMm = 0.0
    u_form: NotNegativeMm = 0.0


def checked_sphere(sphere: ProbedSphere, columns: int | None = None) -> ProbedSphere:
    """The same sphere with its groups as arrays, or `InputError` that names the sphere."""
    checked = checked_fields(sphere, f"sphere '{sphere.name}'")
    if not checked.groups:
        raise InputError(f"sphere '{sphere.name}' has no probed points; give at least one group.")
    width = checked.groups[0].shape[1]
    if columns not in (None, width):
        raise InputError(f"groups of sphere '{sphere.name}' have {width} columns; give {columns} columns.")
    return checked


class ReadImage(NamedTuple):
    """What was found in an image of a target, or listed for it in a table.

    Args:
        observation: Name of the observation.
        image: Name of the file, or number of the pose.
        corners: Number of corners.
        refused: Why the image is not used; empty where it is.
        preview: A small picture of it (JPEG, in base64); None or empty where there is none.
    """

    observation: str
    image: str
    corners: int
    refused: str = ""
    preview: str | None = None


class ReadingSet(NamedTuple):
    """The same poses with the other readings that their tables hold: those commanded, or those measured.

    Args:
        role: "commanded" or "measured".
        capture: The poses with these readings, rad.
        lines: Lines of the manifest that use them.
    """

    role: str
    capture: Capture
    lines: tuple[str, ...] = ()


class RecordedAs(NamedTuple):
    """How the readings of a recording are written: joint values are factors x readings + constants.

    Args:
        names: Column of each joint.
        unit: Of the readings, as the manifest states it.
        factors: With units, signs and coupled joints, rad per unit, or mm of a prismatic joint.
        constants: Of the offsets, rad or mm.

    Example:
        >>> deg = np.radians(1.0)
        >>> written = aj.data.RecordedAs(("a", "b"), "deg", np.diag([deg, -deg]), np.array([0.0, 90 * deg]))
        >>> print(written.joint_values(np.array([[10.0, 30.0]])) / deg, written.readings(np.array([[0.0, 0.0]])))
        [[10. 60.]] [[ 0. 90.]]
    """

    names: tuple[str, ...]
    unit: str
    factors: Float[np.ndarray, "n n"]
    constants: Float[np.ndarray, " n"]

    def joint_values(self, readings: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
        """Joint values, rad and mm, of readings as recorded."""
        return readings @ self.factors.T + self.constants

    def readings(self, q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
        """Readings as recorded of joint values, rad and mm."""
        return np.linalg.solve(self.factors, (q - self.constants).T).T


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
        as_found: The arm with the parameters that its controller had on arrival; None where they are not known. The
            nominal arm is not it, unless somebody says so.
        stated: What somebody stated of how it is to be read, which no search for mistakes overrules: "columns", "sign",
            "offset" and "unit" of the joint readings, "units" of measured points.
        read_as: Which of the recorded readings is that of each joint, from 1, negative where it counts the other way;
            None where the signs are not known or those recorded.
        recorded_as: How the readings are written in the tables it was read from; None where that is not known.
        images: What was found in each image of a target.
        notes: What was read of files that hold more than a table, such as the poses in which an arm stood still; files
            of captures do not keep them.
        other_readings: Where its tables hold commanded and measured readings: those that the capture does not have;
            files of captures do not keep them.

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
    as_found: ArmSpecification | None = None
    stated: tuple[str, ...] = ()
    read_as: tuple[int, ...] | None = None
    recorded_as: RecordedAs | None = None
    images: tuple[ReadImage, ...] = ()
    notes: tuple[str, ...] = ()
    other_readings: ReadingSet | None = None
