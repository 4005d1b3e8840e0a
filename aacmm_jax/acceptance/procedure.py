"""Acceptance tests before they are taken: where sockets, spheres and bars stand, and which poses to take; and such a test simulated."""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import InputError
from ..core.units import ARCSEC
from ..data.capture import Capture, ReferenceLength
from ..data.recording import Recording
from ..data.sphere import ProbedSphere, SphereTest
from ..kinematics.arm import Arm, is_single, joint_limits
from ..kinematics.inverse_kinematics import project_to_targets
from ..kinematics.specification import ArmSpecification
from ..kinematics.workspace import Reach, arm_reach, configurations_at, lowest_point
from ..uncertainty.volume import sample_lengths
from .suite import BARS, POSITIONS, REPEATS, SPAT_POSES, UNI_LENGTHS, UNI_LONGEST, UNI_POSITIONS, ZONES, percent

Standard = Literal["asme", "iso"]
_TRIED, _STARTS, _LOOKED_AT = 16, 48, 6000
_LONGEST_SHARE = 0.68  # of the range, a little over the 66 % that ISO 10360-12 asks for
# Rings of touched points on the upper half of a sphere: elevation in degrees, how many.
_RINGS = {25: ((90, 1), (67.5, 4), (45, 8), (22.5, 4), (0, 8)), 9: ((90, 1), (45, 4), (0, 4)), 5: ((90, 1), (10, 4))}


# What an item with touches is for, as it is called and as a manifest calls it.
TOUCHED: dict[str, SphereTest] = {
    "effective diameter": "effective-diameter",
    "probing size and form": "probing",
    "articulated location": "articulation",
}


class Item(NamedTuple):
    """Poses to take on one thing: a socket, one end of a bar, or one group of touches on a sphere."""

    test: str
    name: str  # of the socket or the sphere
    group: int  # repeat or orientation, from 1
    points: Float[np.ndarray, "m 3"]  # where the probe's centre goes, mm
    q: Float[np.ndarray, "m n"]


class Artefact(NamedTuple):
    """A sphere that is touched; mm."""

    name: str
    test: SphereTest
    centre: Float[np.ndarray, " 3"]
    diameter: float
    stylus: float


class Procedure(NamedTuple):
    """An acceptance test, planned; mm and rad."""

    arm: Arm
    standard: Standard
    reach: Reach
    sockets: tuple[Item, ...]
    touches: tuple[Item, ...]
    lengths: tuple[tuple[str, str, float], ...]  # sockets at both ends, and how far apart they stand
    spheres: tuple[Artefact, ...]
    left_out: tuple[str, ...]  # what this arm cannot take, in sentences

    @property
    def poses(self) -> int:
        """How many poses it takes in all."""
        return sum(len(item.q) for item in (*self.sockets, *self.touches))


def plan_procedure(
    arm: Arm,
    standard: Standard,
    *,
    above: float = 0.0,
    margin: float = math.radians(5),
    diameter: float = 25.0,
    stylus: float = 6.0,
    bars: Sequence[float] | None = None,
    seed: int = 0,
) -> Procedure:
    """The poses of an acceptance test: of ASME B89.4.22 ("asme": effective diameter, single-point articulation, volumetric) or ISO 10360-12
    ("iso": probing, articulated location, length error), as `acceptance` describes them.

    Joints stay ``margin`` (rad) from their limits, and no joint and no tip comes below ``above`` (mm, base frame). ``diameter`` of the sphere and
    ``stylus`` of the probe's ball are in mm. ``bars``: the lengths at hand, mm: two for "asme", five for "iso" (default: fitting ones).
    Raises `InputError` where the arm cannot take such a test; a zone that it cannot reach is left out, and said.
    """
    if standard not in ("asme", "iso"):
        raise InputError(f"acceptance is '{standard}'; it must be asme or iso.")
    if not is_single(arm):
        raise InputError("acceptance_procedure takes one arm, not a batch; take one of it first.")
    if not (diameter > 0 and stylus >= 0 and math.isfinite(diameter + stylus)):
        raise InputError(f"a sphere of {diameter:g} mm and a stylus of {stylus:g} mm cannot be; give a positive diameter.")
    allowed = np.asarray(joint_limits(arm, None))
    if not (math.isfinite(margin) and 0 <= margin < np.min(allowed[:, 1] - allowed[:, 0]) / 2):
        raise InputError(
            f"a margin of {math.degrees(margin):g} deg leaves a joint no room within its limits; give a smaller one."
        )
    reach = arm_reach(arm)
    if reach.radius < 10 * diameter:
        raise InputError(
            f"an arm that reaches {reach.radius:.0f} mm is too small for a sphere of {diameter:g} mm; give a smaller one."
        )
    room = _Room(arm, reach, allowed + margin * np.array([1.0, -1.0]), above, np.random.default_rng(seed))
    make = _asme if standard == "asme" else _iso
    lengths, words = _bar_lengths(standard, reach, bars)
    *parts, left_out = make(room, diameter, stylus, lengths)
    return Procedure(arm, standard, reach, *(tuple(part) for part in parts), left_out=(*words, *left_out))


def _bar_lengths(standard: Standard, reach: Reach, bars: Sequence[float] | None) -> tuple[list[float], list[str]]:
    """Lengths of the bars, and sentences on those that do not fit the standard."""
    if bars is None:
        if standard == "asme":
            return [round(float(np.mean(bar)) * reach.radius) for bar in BARS], []
        return [round(_LONGEST_SHARE * 2 * reach.radius * number / UNI_LENGTHS) for number in range(1, UNI_LENGTHS + 1)], []
    wanted = len(BARS) if standard == "asme" else UNI_LENGTHS
    lengths = sorted(float(bar) for bar in bars)
    if len(lengths) != wanted or not all(math.isfinite(bar) and bar > 0 for bar in lengths):
        raise InputError(
            f"{len(lengths)} bars are given, but the {standard} test takes {wanted} positive lengths; give as many."
        )
    words = []
    for bar, length in zip(BARS, lengths, strict=True) if standard == "asme" else ():
        if not bar[0] <= length / reach.radius <= bar[1]:
            words.append(
                f"A bar of {length:g} mm is not {percent(bar)} of the reach ({bar[0] * reach.radius:.0f} to {bar[1] * reach.radius:.0f} mm)."
            )
    if standard == "iso" and lengths[-1] < UNI_LONGEST * 2 * reach.radius:
        words.append(
            f"The longest bar, {lengths[-1]:g} mm, is under 66 % of the range ({UNI_LONGEST * 2 * reach.radius:.0f} mm)."
        )
    return lengths, words


class _OutOfReach(InputError):
    """A zone where no socket can stand."""


class _Room(NamedTuple):
    """Where an arm can be."""

    arm: Arm
    reach: Reach
    limits: Float[np.ndarray, "n 2"]
    above: float
    random: np.random.Generator

    def draw(self, count: int) -> Float[np.ndarray, "c n"]:
        """Poses at random within the limits."""
        return self.random.uniform(self.limits[:, 0], self.limits[:, 1], (count, self.arm.joints))

    def place(self, zone: tuple[float, float]) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "c n"]]:
        """A point in a zone of the reach that is reached in many poses, and these."""
        tips = np.asarray(self.arm.position(self.draw(_LOOKED_AT)))
        share = np.linalg.norm(tips - self.reach.shoulder, axis=1) / self.reach.radius
        inside = tips[(share > zone[0]) & (share <= zone[1]) & (tips[:, 2] >= self.above)]
        # Near the middle of the zone first: a socket at its edge would be in the next one as soon as it is set up.
        off = np.abs(np.linalg.norm(inside - self.reach.shoulder, axis=1) / self.reach.radius - np.mean(zone))
        inside = inside[np.argsort(off)[: 4 * _TRIED]]
        points = inside[self.random.permutation(len(inside))[:_TRIED]]
        if len(points):
            q, owner = configurations_at(self, points, _STARTS)
            counts = np.bincount(owner, minlength=len(points))
            if counts.max() >= SPAT_POSES:
                best = int(counts.argmax())
                return points[best], q[owner == best]
        raise _OutOfReach(
            f"No point at {percent(zone)} of the reach can be taken in {SPAT_POSES} poses within the joint limits and above the table."
        )


def _spread(rows: Float[np.ndarray, "c k"], count: int) -> Int[np.ndarray, " m"]:
    """Indices of rows that lie far apart: each the farthest from those chosen before it."""
    chosen = [int(np.argmax(np.linalg.norm(rows - rows.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(rows - rows[chosen[0]], axis=1)
    while len(chosen) < min(count, len(rows)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(rows - rows[chosen[-1]], axis=1))
    return np.array(chosen)


def _asme(room: _Room, diameter: float, stylus: float, bars: list[float]) -> tuple[list, ...]:
    items, left_out = [], []
    for zone, name in zip(ZONES, ("near", "middle", "far"), strict=True):
        try:
            point, q = room.place(zone)
        except _OutOfReach as error:
            left_out.append(f"{error} The test goes without that zone.")
            continue
        q = q[_spread(q, SPAT_POSES)]
        items.append(Item("single-point articulation", f"spat/{name}", 1, np.tile(point, (len(q), 1)), q))
    middle = next((item.points[0] for item in items if item.name == "spat/middle"), None)
    if middle is None:
        raise InputError(f"{left_out[0]} So there is nowhere to test; lower the table or the margin.")
    sphere = Artefact("sphere", "effective-diameter", middle, diameter, stylus)
    touches = [_touched(room, sphere, "effective diameter", 9, number) for number in (1, 2, 3)]
    lengths = []
    for number, length in enumerate(bars, start=1):
        ends, pairs = _bars(room, f"bar{number}", length, POSITIONS // 2, 1, "volumetric")
        items += ends
        lengths += pairs
    return items, touches, lengths, [sphere], left_out


def _iso(room: _Room, diameter: float, stylus: float, bars: list[float]) -> tuple[list, ...]:
    point, _ = room.place(ZONES[1])
    probing = Artefact("sphere", "probing", point, diameter, stylus)
    location = probing._replace(test="articulation")
    touches = [_touched(room, probing, "probing size and form", 25, 1)]
    touches += [_touched(room, location, "articulated location", 5, number, orientation=number) for number in range(1, 6)]
    items, lengths = [], []
    for number, length in enumerate(bars, start=1):
        ends, pairs = _bars(room, f"bar{number}", length, UNI_POSITIONS, REPEATS, "length error")
        items += ends
        lengths += pairs
    return items, touches, lengths, [probing, location], []


def _bars(room: _Room, name: str, length: float, positions: int, repeats: int, test: str) -> tuple[list, list]:
    """Both ends of a bar in positions that differ much in place and direction, each end in as many poses as there are repeats."""
    start, end = sample_lengths(room.arm, 300, length=length, limits=room.limits, seed=int(room.random.integers(2**31)))
    good = np.minimum(lowest_point(room.arm, start), lowest_point(room.arm, end)) >= room.above
    start, end = start[good], end[good]
    if len(start) < positions:
        raise InputError(
            f"a bar of {length:.0f} mm finds {len(start)} places above the table, but {positions} are needed; give --above-mm or "
            "--margin-deg more room."
        )
    tips = [np.asarray(room.arm.position(q)) for q in (start, end)]
    between = (tips[1] - tips[0]) / length
    # A direction and its opposite are one to a bar: what is compared are the products of its components.
    directions = np.einsum("ci,cj->cij", between, between).reshape(-1, 9)
    chosen = _spread(np.hstack([(tips[0] + tips[1]) / (2 * room.reach.radius), directions]), positions)
    items, pairs = [], []
    for number, row in enumerate(chosen, start=1):
        labels = [f"{name}/{number:02d}/{side}" for side in "ab"]
        for label, q, tip in zip(labels, (start, end), tips, strict=True):
            poses = q[row : row + 1]
            if repeats > 1:
                others, _ = configurations_at(room, tip[row : row + 1], _STARTS)
                poses = np.concatenate([poses, others])
                poses = poses[_spread(poses, repeats)] if len(poses) >= repeats else np.resize(poses, (repeats, poses.shape[1]))
            items.append(Item(test, label, 1, np.tile(tip[row], (len(poses), 1)), poses))
        pairs.append((*labels, float(length)))
    return items, pairs


def _pattern(count: int) -> Float[np.ndarray, "m 3"]:
    """Directions of touched points over the upper half of a sphere, ring by ring, every second ring turned."""
    rows = []
    for ring, (elevation, number) in enumerate(_RINGS[count]):
        turn = 2 * np.pi * (np.arange(number) + 0.5 * (ring % 2)) / number
        level = np.full(number, np.sin(np.radians(elevation)))
        rows.append(np.column_stack([*(np.cos(np.radians(elevation)) * part(turn) for part in (np.cos, np.sin)), level]))
    return np.concatenate(rows)


def _touched(room: _Room, sphere: Artefact, test: str, count: int, number: int, orientation: int | None = None) -> Item:
    """Poses that touch a sphere from outside; for an orientation all with the probe in about one direction of its own."""
    normals = _pattern(count)
    points = sphere.centre + (sphere.diameter + sphere.stylus) / 2 * normals
    q, owner = configurations_at(room, points, 3 * _STARTS)
    towards = np.asarray(room.arm.pose(q))[:, :3, :3] @ np.asarray(room.arm.probe)
    size = np.linalg.norm(towards, axis=1, keepdims=True)
    towards = np.divide(towards, size, out=np.zeros_like(towards), where=size > 0)
    outside = -np.einsum("ci,ci->c", towards, normals[owner])  # 1: along the normal; below 0: from inside
    if orientation is None:
        wish = outside
    else:
        turn = 2 * np.pi * orientation / 5
        wish = towards @ -np.array([0.6 * np.cos(turn), 0.6 * np.sin(turn), 0.8])
    # A probe that comes along the surface still touches with its ball; from below it, it would come through the sphere.
    wish = np.where((outside > 0.02) | (size[:, 0] == 0), wish, -np.inf)
    rows = []
    for i in range(count):
        here = np.flatnonzero((owner == i) & np.isfinite(wish))
        if not len(here):
            raise InputError(
                f"the sphere at ({', '.join(f'{x:.0f}' for x in sphere.centre)}) mm cannot be touched all round; give another seed."
            )
        rows.append(here[np.argmax(wish[here])])
    return Item(test, sphere.name, number, points, q[rows])


def simulate_procedure(
    procedure: Procedure,
    nominal: ArmSpecification,
    true: ArmSpecification,
    *,
    encoder_arcsec: float = 0.0,
    seating: float = 0.0,
    u_length: float = 0.0,
    u_diameter: float = 0.0,
    seed: int = 0,
) -> Recording:
    """A planned acceptance test as a true arm would record it: its poses moved onto the artefacts, and the noise of readings and seat.

    ``u_length`` and ``u_diameter`` are stated for the artefacts, whose true sizes lie off by normal errors of that standard deviation. mm.
    """
    for what, value in (("encoder_arcsec", encoder_arcsec), ("seating", seating), ("u", u_length), ("u", u_diameter)):
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"{what} is {value:g}; noise must be zero or positive.")
    random = np.random.default_rng(seed)

    def read(item: Item, seat: float) -> np.ndarray:
        targets = item.points + seat * random.normal(size=item.points.shape)
        q, arrived = project_to_targets(true.arm, item.q, targets)
        if not np.all(arrived):
            raise InputError(
                f"{item.test} '{item.name}': the true arm does not reach it; let it differ less from the nominal one."
            )
        return q + encoder_arcsec * ARCSEC * random.normal(size=q.shape)

    sockets = {item.name: read(item, seating) for item in procedure.sockets}
    drawn: dict[float, float] = {}
    for *_, value in procedure.lengths:  # one bar, one error
        drawn.setdefault(value, value + u_length * random.normal())
    lengths = [ReferenceLength(start, end, drawn[value], u_length) for start, end, value in procedure.lengths]
    spheres, sizes = [], {}
    for sphere in procedure.spheres:
        groups = tuple(read(item, 0.0) for item in procedure.touches if TOUCHED[item.test] == sphere.test)
        size = sizes.setdefault(sphere.name, sphere.diameter + u_diameter * random.normal())
        spheres.append(ProbedSphere(sphere.name, sphere.test, groups, size, u_diameter, sphere.stylus))
    return Recording(Capture(sockets, lengths), nominal, true, seed, tuple(spheres))


TITLES = {"asme": "ASME B89.4.22", "iso": "ISO 10360-12"}
