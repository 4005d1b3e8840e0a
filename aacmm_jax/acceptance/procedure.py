"""Planned acceptance tests: how sockets, spheres and bars are set up, with which poses; and their simulation."""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arguments import Range, checked_arguments
from ..core.errors import InputError
from ..data.capture import Capture, ReferenceLength
from ..data.noise import Noise
from ..data.recording import Recording
from ..data.sphere import ProbedSphere, SphereTest
from ..kinematics.arm import Arm, is_single
from ..kinematics.inverse_kinematics import project_to_targets
from ..kinematics.parameters import ArmSpecification
from ..kinematics.workspace import Reach, arm_reach, search_region
from . import asme_b89_4_22, iso_10360_12
from .procedure_items import PlannedSphere, ProcedureItem, ProcedureRegion
from .standards import Planned

# The tests of touched spheres: as an item names them, and as a manifest does.
TOUCHED: dict[str, SphereTest] = {
    "effective diameter": "effective-diameter",
    "probing size and form": "probing",
    "articulated location": "articulation",
}
_STANDARDS = {"asme": asme_b89_4_22, "iso": iso_10360_12}


class Procedure(NamedTuple):
    """A planned acceptance test; mm and rad.

    Example:
        >>> procedure = aj.acceptance.plan_procedure(arm, "asme")
        >>> print(procedure.poses, len(procedure.lengths), procedure.left_out)
        97 20 ()
    """

    arm: Arm
    standard: Planned
    reach: Reach
    measuring_range: float  # diameter of the measuring volume, mm
    range_stated: bool  # whether it is the maker's; otherwise it is twice the reach
    sockets: tuple[ProcedureItem, ...]  # poses in sockets and at the ends of bars
    touches: tuple[ProcedureItem, ...]  # poses that touch spheres
    lengths: tuple[tuple[str, str, float], ...]  # sockets at both ends of each bar, and their distance
    spheres: tuple[PlannedSphere, ...]
    left_out: tuple[str, ...]  # sentences on what the arm cannot take, and on unsuitable bars

    @property
    def poses(self) -> int:
        """Number of poses."""
        return sum(len(item.q) for item in (*self.sockets, *self.touches))


@checked_arguments
def plan_procedure(
    arm: Arm,
    standard: Planned,
    *,
    above: float = 0.0,
    margin: float = math.radians(5),
    diameter: Annotated[float, Range(above=0, unit="mm")] = 25.0,
    stylus: Annotated[float, Range(least=0, unit="mm")] = 6.0,
    bars: Sequence[Annotated[float, Range(above=0, unit="mm")]] | None = None,
    measuring_range: float | None = None,
    seed: int = 0,
) -> Procedure:
    """Plan the poses of an acceptance test.

    Source: ASME B89.4.22-2004 (effective diameter, single-point articulation, volumetric) or ISO 10360-12:2016
    (probing, articulated location, length error), stated from secondary sources.

    Args:
        arm: The arm, not a batch.
        standard: "asme" or "iso".
        above: Height in the base frame below which no joint and no tip comes (the table), mm.
        margin: Distance of the joints from their limits, rad.
        diameter: Diameter of the sphere, mm.
        stylus: Diameter of the probe's ball, mm.
        bars: Lengths of the available bars, mm: two for "asme", five for "iso"; suitable ones by default.
        measuring_range: Diameter of the measuring volume as the maker states it, mm; by default twice the reach.
        seed: Seed of the search.

    Returns:
        The procedure; a zone that the arm cannot reach is left out and named in ``left_out``.

    Raises:
        InputError: The arm cannot take such a test, or an argument is out of range.

    Example:
        >>> procedure = aj.acceptance.plan_procedure(arm, "asme", measuring_range=2000.0)
        >>> print(procedure.poses, "poses,", len(procedure.lengths), "bars")
        97 poses, 20 bars
    """
    if not is_single(arm):
        raise InputError("plan_procedure takes one arm, not a batch; give one of its arms.")
    search = search_region(arm, None, margin, above, seed)
    reach = arm_reach(arm)
    if reach.radius < 10 * diameter:
        raise InputError(
            f"a reach of {reach.radius:.0f} mm is too small for a sphere of {diameter:g} mm; take a smaller sphere."
        )
    rules = _STANDARDS[standard]
    size = 2 * reach.radius if measuring_range is None else float(measuring_range)
    if not reach.radius / 2 <= size <= 4 * reach.radius:
        raise InputError(
            f"a measuring range of {size:g} mm does not suit a reach of {reach.radius:.0f} mm; give a diameter in mm."
        )
    default = rules.default_bars(size)
    lengths = default if bars is None else sorted(map(float, bars))
    if len(lengths) != len(default):
        raise InputError(f"{len(lengths)} bars are given, but {standard} takes {len(default)}; give as many.")
    unsuitable = [] if bars is None else rules.unsuitable_bars(size, lengths)
    items = rules.procedure_items(ProcedureRegion(search, reach._replace(radius=size / 2)), diameter, stylus, lengths)
    items = items._replace(left_out=[*unsuitable, *items.left_out])
    return Procedure(arm, standard, reach, size, measuring_range is not None, *map(tuple, items))


@checked_arguments
def simulate_procedure(
    procedure: Procedure,
    nominal: ArmSpecification,
    true: ArmSpecification,
    *,
    noise: Noise | None = None,
    u_length: Annotated[float, Range(least=0, unit="mm")] = 0.0,
    u_diameter: Annotated[float, Range(least=0, unit="mm")] = 0.0,
    seed: int = 0,
) -> Recording:
    """Simulate a planned acceptance test as a true arm would record it.

    Args:
        procedure: The planned test.
        nominal: The arm that the recording states.
        true: The arm that takes the poses; they are projected to the artefacts by this arm.
        noise: Errors of the readings, and of the tip in its socket; by default none.
        u_length: Standard uncertainty stated for the bars, and standard deviation of their true error, mm.
        u_diameter: The same of the sphere's diameter, mm.
        seed: Seed of the noise.

    Returns:
        The recording, with the true arm.

    Raises:
        InputError: An uncertainty is negative, or the true arm does not reach an artefact.

    Example:
        >>> procedure = aj.acceptance.plan_procedure(arm, "asme", measuring_range=2000.0)
        >>> built = nominal._replace(arm=true)
        >>> recorded = aj.acceptance.simulate_procedure(procedure, nominal, built, noise=aj.Noise(encoder_arcsec=2.0))
        >>> print(len(recorded.capture.q), len(recorded.spheres))
        70 1
    """
    noise = Noise() if noise is None else noise
    scatter = np.asarray(noise.of_readings(true.arm.geometry.kinds))
    random = np.random.default_rng(seed)

    def readings(item: ProcedureItem, seating: float) -> Float[np.ndarray, "m n"]:
        targets = item.points + seating * random.normal(size=item.points.shape)
        q, arrived = project_to_targets(true.arm, item.q, targets)
        if not np.all(arrived):
            raise InputError(
                f"{item.test} '{item.name}': the true arm does not reach it; let it differ less from the nominal one."
            )
        return q + scatter * random.normal(size=q.shape)

    sockets = {item.name: readings(item, float(noise.seating)) for item in procedure.sockets}
    bars: dict[float, float] = {}  # every position of a bar has the same error
    for *_, value in procedure.lengths:
        bars.setdefault(value, value + u_length * random.normal())
    lengths = [ReferenceLength(start, end, bars[value], u_length) for start, end, value in procedure.lengths]
    spheres, diameters = [], {}
    for sphere in procedure.spheres:
        items = (item for item in procedure.touches if (item.name, TOUCHED[item.test]) == (sphere.name, sphere.test))
        groups = tuple(readings(item, 0.0) for item in items)
        size = diameters.setdefault(sphere.name, sphere.diameter + u_diameter * random.normal())
        spheres.append(ProbedSphere(sphere.name, sphere.test, groups, size, u_diameter, sphere.stylus))
    return Recording(
        Capture(sockets, lengths),
        nominal,
        true,
        seed,
        tuple(spheres),
        acceptance=(procedure.standard,),
        measuring_range=procedure.measuring_range,
    )
