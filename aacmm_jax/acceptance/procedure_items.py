"""Parts of a planned acceptance procedure: sockets, bars and spheres, and the configurations that reach them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import InputError
from ..data.sphere import SphereTest
from ..kinematics.workspace import Reach, SearchRegion, configurations_at, lowest_point
from ..uncertainty.volume import sample_lengths
from .geometry import touch_directions
from .results import percent

_POINTS_TRIED, _STARTS, _RANDOM_TIPS, _RANDOM_BARS = 16, 48, 6000, 300
_TILT = (0.6, 0.8)  # sine and cosine of the probe's angle from the vertical in an orientation
_OUTSIDE = 0.02  # cosine of probe and normal above which the probe does not come through the sphere


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


class PlannedItems(NamedTuple):
    """What a standard's procedure consists of."""

    sockets: list[ProcedureItem]
    touches: list[ProcedureItem]
    lengths: list[tuple[str, str, float]]
    spheres: list[PlannedSphere]
    left_out: list[str]


class ProcedureRegion(NamedTuple):
    """Where the arm can be during a procedure."""

    search: SearchRegion
    reach: Reach


class OutOfReach(InputError):
    """No socket can be placed in a zone of the reach."""


def socket_in_zone(
    region: ProcedureRegion,
    zone: tuple[float, float],
    poses: int,
    others: Sequence[Float[np.ndarray, " 3"]] = (),
    apart: float = 0.0,
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "c n"]]:
    """The point in a zone of the reach with the most configurations, at least ``poses``, and these configurations; no
    nearer to ``others`` than ``apart`` (mm)."""
    search, reach = region
    tips = np.asarray(search.arm.position(search.draw(_RANDOM_TIPS)))
    fraction = np.linalg.norm(tips - reach.shoulder, axis=1) / reach.radius
    inside = (fraction > zone[0]) & (fraction <= zone[1]) & (tips[:, 2] >= search.above)
    for other in others:
        inside &= np.linalg.norm(tips - other, axis=1) >= apart
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
    raise OutOfReach(
        f"No point at {percent(zone)} of the reach was found with {poses} poses within the joint limits and above the "
        "table."
    )


def far_apart(rows: Float[np.ndarray, "c k"], count: int) -> Int[np.ndarray, " m"]:
    """Indices of rows far from one another: each is the farthest from those chosen before it."""
    chosen = [int(np.argmax(np.linalg.norm(rows - rows.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(rows - rows[chosen[0]], axis=1)
    while len(chosen) < min(count, len(rows)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(rows - rows[chosen[-1]], axis=1))
    return np.array(chosen)


def bar_items(
    region: ProcedureRegion, name: str, length: float, positions: int, repeats: int, test: str
) -> tuple[list[ProcedureItem], list[tuple[str, str, float]]]:
    """Both ends of a bar in positions and directions far apart, each in ``repeats`` configurations; and the lengths."""
    search, reach = region
    seed = int(search.random.integers(2**31))
    start, end = sample_lengths(search.arm, _RANDOM_BARS, length=length, limits=search.limits, seed=seed)
    good = np.minimum(lowest_point(search.arm, start), lowest_point(search.arm, end)) >= search.above
    start, end = start[good], end[good]
    if len(start) < positions:
        raise InputError(
            f"a bar of {length:.0f} mm needs {positions} positions above the table, but {len(start)} were found; "
            "give a lower --above-mm or a smaller --margin-deg."
        )
    tips = [np.asarray(search.arm.position(q)) for q in (start, end)]
    between = (tips[1] - tips[0]) / length
    # A direction and its opposite are the same for a bar, so the products of its components are compared.
    directions = np.einsum("ci,cj->cij", between, between).reshape(-1, 9)
    chosen = far_apart(np.hstack([(tips[0] + tips[1]) / (2 * reach.radius), directions]), positions)
    ends = np.concatenate([tip[chosen] for tip in tips])
    others, owner = configurations_at(search, ends, _STARTS if repeats > 1 else 0)
    items, pairs = [], []
    for number in range(positions):
        labels = [f"{name}/{number + 1:02d}/{side}" for side in "ab"]
        for index, (label, q) in enumerate(zip(labels, (start, end), strict=True)):
            this = index * positions + number
            poses = np.concatenate([q[chosen[number]][None], others[owner == this]])
            enough = len(poses) >= repeats
            poses = poses[far_apart(poses, repeats)] if enough else np.resize(poses, (repeats, poses.shape[1]))
            items.append(ProcedureItem(test, label, 1, np.tile(ends[this], (len(poses), 1)), poses))
        pairs.append((*labels, float(length)))
    return items, pairs


def touch_item(
    region: ProcedureRegion, sphere: PlannedSphere, test: str, count: int, group: int, azimuth: float | None = None
) -> ProcedureItem:
    """Configurations that touch a sphere from outside; with an azimuth (rad), with about one direction of the probe."""
    arm = region.search.arm
    normals = touch_directions(count)
    points = sphere.centre + (sphere.diameter + sphere.stylus) / 2 * normals
    q, owner = configurations_at(region.search, points, 3 * _STARTS)
    probe = np.asarray(arm.pose(q))[:, :3, :3] @ np.asarray(arm.probe)
    size = np.linalg.norm(probe, axis=1, keepdims=True)
    probe = np.divide(probe, size, out=np.zeros_like(probe), where=size > 0)
    outside = -np.einsum("ci,ci->c", probe, normals[owner])  # 1: along the normal; negative: through the sphere
    score = outside
    if azimuth is not None:
        score = probe @ -np.array([_TILT[0] * np.cos(azimuth), _TILT[0] * np.sin(azimuth), _TILT[1]])
    score = np.where((outside > _OUTSIDE) | (size[:, 0] == 0), score, -np.inf)
    rows = []
    for i in range(count):
        possible = np.flatnonzero((owner == i) & np.isfinite(score))
        if not len(possible):
            centre = ", ".join(f"{x:.0f}" for x in sphere.centre)
            raise InputError(f"the sphere at ({centre}) mm cannot be touched on all sides; give another seed.")
        rows.append(possible[np.argmax(score[possible])])
    return ProcedureItem(test, sphere.name, group, points, q[rows])
