"""Planned acceptance tests: how sockets, spheres and bars are set up, with which poses; and their simulation."""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.arguments import Range, checked_arguments
from ..core.errors import InputError
from ..data.capture import Capture, ReferenceLength
from ..data.noise import Noise
from ..data.recording import ProbedSphere, Recording, SphereTest
from ..kinematics.arm import Arm, is_single, one_chain
from ..kinematics.inverse_kinematics import project_to_targets
from ..kinematics.parameters import ArmSpecification
from ..kinematics.workspace import Reach, SearchRegion, arm_reach, configurations_at, lowest_point, search_region
from ..uncertainty.volume import sample_lengths
from .geometry import LEFT_OR_RIGHT, elbow_sides, touch_directions, unit_rows
from .metrics import BARS, LONGEST, SPAT_POSES, ZONES, bar_range
from .results import percent
from .standards import Standard

# The tests of touched spheres: as an item names them, and as a manifest does.
TOUCHED: dict[str, SphereTest] = {
    "effective diameter": "effective-diameter",
    "probing size and form": "probing",
    "articulated location": "articulation",
}
_POINTS_TRIED, _STARTS, _RANDOM_TIPS, _RANDOM_BARS = 16, 48, 6000, 300
_TILT = (0.6, 0.8)  # sine and cosine of the probe's angle from the vertical in an orientation
_OUTSIDE = 0.02  # cosine of probe and normal above which the probe does not come through the sphere
_JJF_POSES, _JJF_LENGTHS, _JJF_BAR = 70, 30, 300.0  # in a socket; positions of the bar; its length, mm
_LONGEST_PLANNED = 0.68  # the longest bar of ISO 10360-12, as a part of the measuring range
# Where the sphere of ISO 10360-12 is planned, once in each: fractions of half the range, the least poses that reach it,
# and how far apart both are, as a part of the reach.
_SPHERE_ZONES, _SPHERE_POSES, _SPHERES_APART = ((0.2, 0.5), (0.5, 0.8)), 10, 0.3


class ProcedureItem(NamedTuple):
    """Poses to take at one socket, at one end of a bar, or for one group of touches on a sphere."""

    test: str
    name: str  # of the socket or the sphere
    group: int  # repeat or orientation, from 1
    points: Float[np.ndarray, "m 3"]  # where the probe's centre goes, mm
    q: Float[np.ndarray, "m n"]


class PlannedSphere(NamedTuple):
    """A sphere to be touched; mm."""

    name: str
    test: SphereTest
    centre: Float[np.ndarray, " 3"]
    diameter: float
    stylus: float


class Procedure(NamedTuple):
    """A planned acceptance test; mm and rad.

    Example:
        >>> procedure = aj.acceptance.plan_procedure(arm, "asme")
        >>> print(procedure.poses, len(procedure.lengths), procedure.left_out)
        97 20 ()
    """

    arm: Arm
    standard: Standard
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
    standard: Standard,
    *,
    above: float = 0.0,
    margin: float = math.radians(5),
    diameter: Annotated[float, Range(above=0, unit="mm")] = 25.0,
    stylus: Annotated[float, Range(least=0, unit="mm")] = 6.0,
    bars: Sequence[Annotated[float, Range(above=0, unit="mm")]] | None = None,
    measuring_range: float | None = None,
    seed: int = 0,
) -> Procedure:
    """Plan the poses of an acceptance test; a zone that the arm cannot reach is left out and named in ``left_out``.

    Source: JJF 1408-2013 as used by Cheng et al. 2018, section 4 (single point, length), ASME B89.4.22-2004 (effective
    diameter, single-point articulation, volumetric) or ISO 10360-12:2016 (probing, articulated location, length error),
    stated from secondary sources. `InputError` where the arm cannot take such a test.

    Args:
        arm: The arm, not a batch.
        standard: "jjf", "asme" or "iso".
        above: Height in the base frame below which no joint and no tip comes (the table), mm.
        margin: Distance of the joints from their limits, rad.
        diameter: Diameter of the sphere, mm.
        stylus: Diameter of the probe's ball, mm.
        bars: Lengths of the available bars, mm: one for "jjf", two for "asme", five for "iso"; by default suitable
            ones.
        measuring_range: Diameter of the measuring volume as the maker states it, mm; by default twice the reach.
        seed: Seed of the search.

    Example:
        >>> procedure = aj.acceptance.plan_procedure(arm, "asme", measuring_range=2000.0)
        >>> print(procedure.poses, "poses,", len(procedure.lengths), "bars")
        97 poses, 20 bars
    """
    if not is_single(arm):
        raise InputError("plan_procedure takes one arm, not a batch; give one arm of the batch.")
    arm = one_chain(arm, "an acceptance test")
    search, reach = search_region(arm, None, margin, above, seed), arm_reach(arm)
    if reach.radius < 10 * diameter:
        raise InputError(
            f"a reach of {reach.radius:.0f} mm is too small for a sphere of {diameter:g} mm; use a smaller sphere."
        )
    size = 2 * reach.radius if measuring_range is None else float(measuring_range)
    if not reach.radius / 2 <= size <= 4 * reach.radius:
        raise InputError(
            f"a measuring range of {size:g} mm does not suit a reach of {reach.radius:.0f} mm; give the diameter of "
            "the measuring range in mm."
        )
    if standard == "jjf":
        default = [round(min(_JJF_BAR, size / 4))]
    elif standard == "asme":
        default = [round(float(np.mean(bar)) * size / 2) for bar in BARS]
    else:
        default = [round(_LONGEST_PLANNED * size * number / 5) for number in range(1, 6)]
    lengths = default if bars is None else sorted(map(float, bars))
    if len(lengths) != len(default):
        raise InputError(
            f"{len(lengths)} bars are given, but {standard} needs {len(default)}; give {len(default)} bars."
        )
    planner = _Planner(search, reach._replace(radius=size / 2), diameter, stylus)
    left_out = [] if bars is None else _unsuitable_bars(standard, size, lengths)
    if standard == "jjf":
        planner.plan_jjf(lengths[0])
    elif standard == "asme":
        left_out += planner.plan_asme(lengths)
    else:
        planner.plan_iso(lengths)
    return Procedure(
        arm,
        standard,
        reach,
        measuring_range=size,
        range_stated=measuring_range is not None,
        sockets=tuple(planner.sockets),
        touches=tuple(planner.touches),
        lengths=tuple(planner.lengths),
        spheres=tuple(planner.spheres),
        left_out=tuple(left_out),
    )


def _unsuitable_bars(standard: Standard, size: float, lengths: Sequence[float]) -> list[str]:
    if standard == "iso":
        least = LONGEST * size
        sentence = f"The longest bar, {lengths[-1]:g} mm, is shorter than 66 % of the measuring range ({least:.0f} mm)."
        return [sentence] if lengths[-1] < least else []
    if standard == "jjf":  # the paper states no range of lengths
        return []
    return [
        f"A bar of {length:g} mm is outside the required range of {bar_range(bar, size / 2)}."
        for bar, length in zip(BARS, lengths, strict=True)
        if not bar[0] <= length / (size / 2) <= bar[1]
    ]


class _OutOfReach(InputError):
    """No socket can be placed in a zone of the reach."""


class _Planner:
    """What a procedure consists of, put together item by item, where the arm can be."""

    def __init__(self, search: SearchRegion, reach: Reach, diameter: float, stylus: float) -> None:
        self.search, self.reach, self.diameter, self.stylus = search, reach, diameter, stylus
        self.sockets: list[ProcedureItem] = []
        self.touches: list[ProcedureItem] = []
        self.lengths: list[tuple[str, str, float]] = []
        self.spheres: list[PlannedSphere] = []

    def plan_jjf(self, bar: float) -> None:
        """A socket in the middle of the reach in 70 poses, and a bar in 30 positions."""
        point, _ = self._socket_in_zone(ZONES[1], SPAT_POSES)
        q, _ = configurations_at(self.search, point[None], 6 * _JJF_POSES)
        q = q[_far_apart(q, _JJF_POSES)]
        self.sockets.append(ProcedureItem("single point", "socket/middle", 1, np.tile(point, (len(q), 1)), q))
        self._bar("bar1", bar, _JJF_LENGTHS, 1, "length")

    def plan_asme(self, bars: Sequence[float]) -> list[str]:
        """A socket in every zone that can be reached, three repeats on a sphere, and two bars in ten positions each;
        sentences on the zones that are left out."""
        middle, left_out = None, []
        for name, zone in zip(("near", "middle", "far"), ZONES, strict=True):
            try:
                point, q = self._socket_in_zone(zone, SPAT_POSES)
            except _OutOfReach as error:
                left_out.append(f"{error} This zone is left out of the test.")
                continue
            middle = point if name == "middle" else middle
            q = q[_both_sides(elbow_sides(self.search.arm, q, self.reach), q)]
            points = np.tile(point, (len(q), 1))
            self.sockets.append(ProcedureItem("single-point articulation", f"spat/{name}", 1, points, q))
        if middle is None:
            raise InputError(
                f"{left_out[0]} Without the middle zone, no test is possible; give a lower --above-mm or a smaller "
                "--margin-deg."
            )
        sphere = self._sphere("sphere", "effective-diameter", middle)
        for number in range(1, 4):
            self._touch(sphere, "effective diameter", 9, number)
        for number, length in enumerate(bars, start=1):
            self._bar(f"bar{number}", length, 20 // len(bars), 1, "volumetric")
        return left_out

    def plan_iso(self, bars: Sequence[float]) -> None:
        """In two places 25 points on a sphere, five in each of five orientations; bars in seven positions, three
        times."""
        for place, zone in enumerate(_SPHERE_ZONES, start=1):
            others = [sphere.centre for sphere in self.spheres]
            centre, _ = self._socket_in_zone(zone, _SPHERE_POSES, others)
            sphere = self._sphere(f"sphere{place}", "probing", centre)
            self._touch(sphere, "probing size and form", 25, 1)
            articulated = self._sphere(f"sphere{place}", "articulation", centre)
            for number in range(1, 6):
                self._touch(articulated, "articulated location", 5, number, 2 * math.pi * number / 5)
        for number, length in enumerate(bars, start=1):
            self._bar(f"bar{number}", length, 7, 3, "length error")

    def _sphere(self, name: str, test: SphereTest, centre: Float[np.ndarray, " 3"]) -> PlannedSphere:
        self.spheres.append(PlannedSphere(name, test, centre, self.diameter, self.stylus))
        return self.spheres[-1]

    def _socket_in_zone(
        self, zone: tuple[float, float], poses: int, others: Sequence[Float[np.ndarray, " 3"]] = ()
    ) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "c n"]]:
        """The point in a zone of the reach with the most configurations, at least ``poses``, and these configurations;
        not near ``others``."""
        search, reach = self.search, self.reach
        tips = np.asarray(search.arm.position(search.draw(_RANDOM_TIPS)))
        fraction = np.linalg.norm(tips - reach.shoulder, axis=1) / reach.radius
        inside = (fraction > zone[0]) & (fraction <= zone[1]) & (tips[:, 2] >= search.above)
        for other in others:
            inside &= np.linalg.norm(tips - other, axis=1) >= _SPHERES_APART * reach.radius
        # Points near the middle of the zone first: a socket at its edge may be set up in the next zone.
        order = np.argsort(np.abs(fraction[inside] - np.mean(zone)))
        tips = tips[inside][order[: 4 * _POINTS_TRIED]]
        points = tips[search.random.permutation(len(tips))[:_POINTS_TRIED]]
        if len(points):
            q, owner = configurations_at(search, points, _STARTS)
            counts = np.bincount(owner, minlength=len(points))
            if counts.max() >= poses:
                best = int(counts.argmax())
                return points[best], q[owner == best]
        raise _OutOfReach(
            f"No point at {percent(zone)} of the reach was found at which {poses} poses are possible within the joint "
            "limits and above the table."
        )

    def _bar(self, name: str, length: float, positions: int, repeats: int, test: str) -> None:
        """Both ends of a bar in positions and directions far apart, each in ``repeats`` configurations."""
        search = self.search
        seed = int(search.random.integers(2**31))
        start, end = sample_lengths(search.arm, _RANDOM_BARS, length=length, limits=search.limits, seed=seed)
        good = np.minimum(lowest_point(search.arm, start), lowest_point(search.arm, end)) >= search.above
        start, end = start[good], end[good]
        if len(start) < positions:
            raise InputError(
                f"a bar of {length:.0f} mm needs {positions} positions above the table, but only {len(start)} were "
                "found; give a lower --above-mm or a smaller --margin-deg."
            )
        tips = [np.asarray(search.arm.position(q)) for q in (start, end)]
        between = (tips[1] - tips[0]) / length
        # A direction and its opposite are the same for a bar, so the products of its components are compared.
        directions = np.einsum("ci,cj->cij", between, between).reshape(-1, 9)
        chosen = _far_apart(np.hstack([(tips[0] + tips[1]) / (2 * self.reach.radius), directions]), positions)
        ends = np.concatenate([tip[chosen] for tip in tips])
        others, owner = configurations_at(search, ends, _STARTS if repeats > 1 else 0)
        for number in range(positions):
            labels = f"{name}/{number + 1:02d}/a", f"{name}/{number + 1:02d}/b"
            for index, (label, q) in enumerate(zip(labels, (start, end), strict=True)):
                at = index * positions + number
                poses = np.concatenate([q[chosen[number]][None], others[owner == at]])
                enough = len(poses) >= repeats
                poses = poses[_far_apart(poses, repeats)] if enough else np.resize(poses, (repeats, poses.shape[1]))
                self.sockets.append(ProcedureItem(test, label, 1, np.tile(ends[at], (len(poses), 1)), poses))
            self.lengths.append((*labels, float(length)))

    def _touch(self, sphere: PlannedSphere, test: str, count: int, group: int, azimuth: float | None = None) -> None:
        """Configurations that touch a sphere from outside; with an azimuth (rad), with about one direction of the
        probe."""
        arm, normals = self.search.arm, touch_directions(count)
        points = sphere.centre + (sphere.diameter + sphere.stylus) / 2 * normals
        q, owner = configurations_at(self.search, points, 3 * _STARTS)
        probe = unit_rows(np.asarray(arm.pose(q))[:, :3, :3] @ np.asarray(arm.probe))
        outside = -np.einsum("ci,ci->c", probe, normals[owner])  # 1: along the normal; negative: through the sphere
        score = outside
        if azimuth is not None:
            score = probe @ -np.array([_TILT[0] * np.cos(azimuth), _TILT[0] * np.sin(azimuth), _TILT[1]])
        score = np.where((outside > _OUTSIDE) | ~np.any(probe, axis=1), score, -np.inf)
        rows = []
        for i in range(count):
            possible = np.flatnonzero((owner == i) & np.isfinite(score))
            if not len(possible):
                centre = ", ".join(f"{x:.0f}" for x in sphere.centre)
                raise InputError(f"the sphere at ({centre}) mm cannot be touched on all sides; give another seed.")
            rows.append(possible[np.argmax(score[possible])])
        self.touches.append(ProcedureItem(test, sphere.name, group, points, q[rows]))


def _far_apart(rows: Float[np.ndarray, "c k"], count: int) -> Int[np.ndarray, " m"]:
    """Indices of rows far from one another: each is the farthest from those chosen before it."""
    chosen = [int(np.argmax(np.linalg.norm(rows - rows.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(rows - rows[chosen[0]], axis=1)
    while len(chosen) < min(count, len(rows)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(rows - rows[chosen[-1]], axis=1))
    return np.array(chosen)


def _both_sides(sides: Float[np.ndarray, " c"], q: Float[np.ndarray, "c n"]) -> Int[np.ndarray, " m"]:
    """Indices of poses far apart, half of them with the elbow on each side as far as there are such."""
    far = np.abs(sides) >= LEFT_OR_RIGHT
    halves = [np.flatnonzero(far & (sides > 0)), np.flatnonzero(far & (sides < 0))]
    chosen = [half[_far_apart(q[half], SPAT_POSES // 2)] for half in halves if len(half)]
    first = np.concatenate([*chosen, np.zeros(0, dtype=int)]).astype(int)
    others = np.setdiff1d(np.arange(len(q)), first)
    missing = SPAT_POSES - len(first)
    return first if missing <= 0 else np.concatenate([first, others[_far_apart(q[others], missing)]])


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
    """Simulate a planned acceptance test as a true arm would record it; `InputError` where it does not reach a target.

    Args:
        procedure: The planned test.
        nominal: The arm that the recording states.
        true: The arm that takes the poses; they are projected to the artefacts by this arm.
        noise: Errors of the readings, and of the tip in its socket; by default none.
        u_length: Standard uncertainty stated for the bars, and standard deviation of their true error, mm.
        u_diameter: The same of the sphere's diameter, mm.
        seed: Seed of the noise.

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
                f"the true arm does not reach '{item.name}' of the test '{item.test}'; use a true arm that differs "
                "less from the nominal arm."
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
