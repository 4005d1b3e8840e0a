"""The body of an arm as capsules that its frames carry, and how far capsules are from each other and from boxes.

A capsule is a segment with a radius, so that its distance from another is that of the segments less the radii. Its ends
may be in two frames: a link whose length changes with a joint keeps its ends. Distances are exact, for batches, and
under jit too; points are columns, ``(..., 3, N)`` for N configurations, as in `chain`.
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.arguments import Range, checked
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace, to_numpy
from .arm import Arm
from .chain import forward_pass, frame_axes, joint_motion

_SHORTEST = 1e-6  # mm: shorter links have no capsule
_NEAR = 2.0  # times the sum of the radii: capsules that less of the arm joins than this are neighbours
_RADIUS = Range(above=0, most=2000, unit="mm")
_PARALLEL = 1e-14  # squared sine of the angle between segments that count as parallel
_TINY = 1e-24  # mm^2: keeps derivatives of a square root finite


class Body(NamedTuple):
    """Capsules and the pairs of them that may not touch; lengths in mm.

    Frame 0 is the base, frame i the one after joint i.

    Example:
        >>> body = aj.kinematics.body_along_links(arm, 40.0)
        >>> print(body.names[:3], body.radius[:3])
        ('offset d_1', 'link a_2', 'offset d_3') [40. 40. 40.]
    """

    names: tuple[str, ...]
    start_frame: Int[np.ndarray, " k"]
    start: Float[np.ndarray, "k 3"]  # in its frame
    end_frame: Int[np.ndarray, " k"]
    end: Float[np.ndarray, "k 3"]
    radius: Float[np.ndarray, " k"]
    pairs: Int[np.ndarray, "m 2"]


class Frames(NamedTuple):
    """Axes (columns) and origins of the frames 0 to n, in the base frame."""

    axes: Float[AnyArray, "f 3 3 N"]
    origins: Float[AnyArray, "f 3 N"]


def frames_at(arm: Arm, q: Float[AnyArray, "N n"]) -> Frames:
    """The frames of an arm at N configurations."""
    forward = forward_pass(arm.geometry, joint_motion(arm.geometry, q))
    xp, (x, y, z) = namespace(forward), frame_axes(forward)
    base = xp.broadcast_to(xp.asarray(np.eye(3))[None, :, :, None], (1, 3, 3, z.shape[-1]))
    axes = xp.concatenate([base, xp.stack([x, y, z], axis=2)])
    return Frames(axes, xp.concatenate([xp.zeros_like(forward.origin[:1]), forward.origin]))


def capsule_ends(body: Body, frames: Frames) -> tuple[Float[AnyArray, "k 3 N"], Float[AnyArray, "k 3 N"]]:
    """Where the capsules' segments begin and end, in the base frame, mm."""

    def placed(frame: Int[np.ndarray, " k"], point: Float[np.ndarray, "k 3"]) -> AnyArray:
        axes, xp = frames.axes[frame], namespace(frames)
        columns = (axes[:, :, i] * xp.asarray(point[:, i])[:, None, None] for i in range(3))
        return frames.origins[frame] + sum(columns)

    return placed(body.start_frame, body.start), placed(body.end_frame, body.end)


def body_along_links(arm: Arm, radius: float | Sequence[float], tool_radius: float | None = None) -> Body:
    """Capsules about an arm's offsets d, lengths a and its probe, as the D-H table has them.

    That is the body of an arm whose links are where its table's frames are; of a robot with links beside its axes, its
    URDF's shapes are nearer to the truth (`files.load_cell`). The tool's capsule ends two radii before the tip, so that
    it clears a surface that the tip is in up to a tilt of 60 deg. Capsules that little of the arm joins touch at their
    joint, and are no pair.

    Args:
        arm: One arm.
        radius: Radius of every link, or one for each joint, mm.
        tool_radius: Radius of the probe, mm; by default a quarter of the last link's, 8 at most.

    Raises:
        InputError: A radius is not positive, or not one for each joint.

    Example:
        >>> body = aj.kinematics.body_along_links(arm, 40.0, tool_radius=5.0)
        >>> print(len(body.names), body.radius.max(), "mm")
        7 40.0 mm
    """
    arm = to_numpy(arm)
    shapes = Float[np.ndarray, ""] | Float[np.ndarray, "joints"]
    radii = np.asarray(checked(radius, Annotated[shapes, _RADIUS], "radius", {"joints": arm.joints}))
    radii = np.broadcast_to(radii, (arm.joints,))
    tool = float(min(radii[-1] / 4, 8.0) if tool_radius is None else tool_radius)
    checked(tool, Annotated[float, _RADIUS], "tool_radius")
    rows: list[tuple[str, int, np.ndarray, int, np.ndarray, float, float]] = []
    beta = np.zeros(arm.joints) if arm.beta is None else np.asarray(arm.beta)
    for i in range(arm.joints):
        a, d = float(arm.a[i]), float(arm.d[i])
        # The end of the offset, in the frame after the joint: a back along x, which beta turns about y.
        corner = np.array([-a * np.cos(beta[i]), 0.0, -a * np.sin(beta[i])])
        if abs(d) > _SHORTEST:
            rows.append((f"offset d_{i + 1}", i, np.zeros(3), i + 1, corner, radii[i], abs(d)))
        if abs(a) > _SHORTEST:
            rows.append((f"link a_{i + 1}", i + 1, corner, i + 1, np.zeros(3), radii[i], abs(a)))
    probe = np.asarray(arm.probe, dtype=float)
    size = float(np.linalg.norm(probe))
    if size > 2 * tool + _SHORTEST:
        end = probe * (1 - 2 * tool / size)
        rows.append(("probe", arm.joints, np.zeros(3), arm.joints, end, tool, size))
    if not rows:
        raise InputError("the arm has no link that is longer than 0, so it has no body; give its URDF.")
    names, *columns, lengths = zip(*rows, strict=True)
    start_frame, start, end_frame, end, widths = map(np.array, columns)
    until = np.concatenate([[0.0], np.cumsum(lengths)])  # how much of the arm is before each capsule
    pairs = [
        (i, j)
        for i in range(len(rows))
        for j in range(i + 1, len(rows))
        if until[j] - until[i + 1] > _NEAR * (widths[i] + widths[j])
    ]
    return Body(names, start_frame, start, end_frame, end, widths, np.array(pairs, dtype=int).reshape(-1, 2))


def segment_distance(
    start: Float[AnyArray, "... 3 N"],
    end: Float[AnyArray, "... 3 N"],
    other_start: Float[AnyArray, "... 3 N"],
    other_end: Float[AnyArray, "... 3 N"],
) -> Float[AnyArray, "... N"]:
    """Distance between two segments, mm; a segment may be a point.

    The point of one segment that is nearest to the line of the other, the point of the other that is nearest to that,
    and once more the first: with each kept on its segment, the third step is the minimum (Ericson 2005, 5.1.9).
    """
    xp = namespace(start, end, other_start, other_end)
    along, other_along, between = end - start, other_end - other_start, start - other_start
    aa, bb, ab = _dot(along, along), _dot(other_along, other_along), _dot(along, other_along)
    a_between, b_between = _dot(along, between), _dot(other_along, between)
    determinant = aa * bb - ab**2
    parallel = determinant <= _PARALLEL * aa * bb
    first = (ab * b_between - bb * a_between) / xp.where(parallel, 1.0, determinant)
    first = xp.where(parallel, 0.0, xp.clip(first, 0.0, 1.0))
    second = xp.clip((ab * first + b_between) / xp.where(bb > 0, bb, 1.0), 0.0, 1.0)
    first = xp.clip((ab * second - a_between) / xp.where(aa > 0, aa, 1.0), 0.0, 1.0)
    gap = between + first[..., None, :] * along - second[..., None, :] * other_along
    return _length(gap)


def distance_from_box(
    start: Float[AnyArray, "... 3 N"], end: Float[AnyArray, "... 3 N"], half: Float[AnyArray, "... 3 1"]
) -> Float[AnyArray, "... N"]:
    """Distance of a segment from a solid box about the origin with half edges ``half`` along the axes, mm.

    The squared distance along the segment is convex, and its derivative is linear between the places where the segment
    crosses the planes of the six faces: the zero of the derivative is found between two of these.
    """
    xp = namespace(start, end, half)
    along = end - start

    def beyond(places: AnyArray) -> AnyArray:
        """From the box to the points at these places, one more axis in front."""
        points = start[None] + places[..., None, :] * along[None]
        return points - xp.clip(points, -half[None], half[None])

    still = xp.abs(along) < 1e-9
    safe = xp.where(still, 1.0, along)
    crossings = [xp.where(still, 0.0, xp.clip((face - start) / safe, 0.0, 1.0)) for face in (-half, half)]
    both = xp.concatenate(crossings, axis=-2)
    ends = xp.concatenate([xp.zeros_like(both[..., :1, :]), both, xp.ones_like(both[..., :1, :])], axis=-2)
    places = xp.moveaxis(xp.sort(ends, axis=-2), -2, 0)
    slopes = xp.sum(beyond(places) * along[None], axis=-2)
    # The last place where the distance still becomes smaller, and the one after it.
    last = xp.clip(xp.sum(slopes <= 0, axis=0) - 1, 0, len(places) - 2)[None]
    low, high = (xp.take_along_axis(places, last + i, axis=0)[0] for i in (0, 1))
    slope_low, slope_high = (xp.take_along_axis(slopes, last + i, axis=0)[0] for i in (0, 1))
    rise = slope_high - slope_low
    part = xp.clip(-slope_low / xp.where(rise > 0, rise, 1.0), 0.0, 1.0)
    # Without a rise the derivative is 0 all along, inside the box, or the segment is a point.
    place = low + xp.where(rise > 0, part, 0.0) * (high - low)
    return _length(beyond(place[None])[0])


def _dot(one: AnyArray, other: AnyArray) -> AnyArray:
    return (one * other).sum(axis=-2)


def _length(vector: AnyArray) -> AnyArray:
    xp = namespace(vector)
    square = _dot(vector, vector)
    return xp.where(square > _TINY, xp.sqrt(xp.maximum(square, _TINY)), 0.0)
