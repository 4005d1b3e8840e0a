"""Shortest distances of line segments from each other and from boxes, exact; for batches, under jit too.

Points are columns, ``(..., 3, N)`` for N configurations, as in `chain`. A capsule is a segment with a radius, so its
distance from another one, or from a box, is that of the segments less the radii.
"""

from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, namespace

_PARALLEL = 1e-14  # squared sine of the angle between segments that count as parallel
_TINY = 1e-24  # mm^2: keeps derivatives of a square root finite


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
