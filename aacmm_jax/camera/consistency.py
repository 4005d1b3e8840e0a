"""Whether corners in an image can be those of a target: a check that needs no intrinsics.

A flat target appears through a homography, which distortion bends smoothly: about the middle of the image, as one
number describes well enough (r / (1 - n r^2) of the distances r: Fitzgibbon 2001), and a little otherwise. A corner
that was taken for another one is off by a good part of a square, which no smooth bending explains.
"""

import numpy as np
from jaxtyping import Float

_WIDTH = 0.05  # of a line, over its length
_PER_TERM = 3  # corners for each term of the bending
_POWERS = [(1, 1), (2, 0), (0, 2), (2, 1), (1, 2), (3, 0), (0, 3)]  # of x and y
_BENT = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)  # n r^2 in the corners of the image


def projection(points: Float[np.ndarray, "k d"], values: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "3 e"]:
    """The matrix that takes points of a plane (d = 2) or in space (d = 3), with a 1 appended, to values in an image.

    Direct linear transformation, with points and values scaled to a unit size.
    """
    (x, to_x), (y, to_y) = _normalised(points), _normalised(values)
    ones = np.column_stack([x, np.ones(len(x))])
    none = np.zeros_like(ones)
    rows = np.concatenate(
        [np.hstack([ones, none, -y[:, :1] * ones]), np.hstack([none, ones, -y[:, 1:] * ones])], axis=0
    )
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, -1)
    matrix = np.linalg.inv(to_y) @ matrix @ to_x
    return matrix * np.sign((matrix @ np.append(points.mean(axis=0), 1.0))[2])


def projected(matrix: Float[np.ndarray, "3 e"], points: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k 2"]:
    """Points through such a matrix."""
    image = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    return image[:, :2] / image[:, 2:]


def is_mirrored(points: Float[np.ndarray, "k 2"], values: Float[np.ndarray, "k 2"]) -> bool:
    """Whether a board appears as in a mirror: a turn from x to y runs the other way."""
    return bool(np.linalg.det(projection(points, values)) < 0)


def on_one_line(points: Float[np.ndarray, "k d"]) -> bool:
    """Whether points are on a line, or nearly so."""
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(sizes) < 2 or sizes[1] < _WIDTH * sizes[0])


def misfits(
    points: Float[np.ndarray, "k 3"], values: Float[np.ndarray, "k 2"], size: tuple[int, ...]
) -> Float[np.ndarray, " k"]:
    """How far corners appear from where the others have them, px: zero where there are too few to tell.

    ``size``: width and height of the image, px, in the middle of which the axis of the camera is about.
    """
    centred = points - points.mean(axis=0)
    sizes, axes = np.linalg.svd(centred, full_matrices=False)[1:]
    flat = sizes[2] <= 1e-6 * sizes[0]
    if len(points) < (5 if flat else 7):
        return np.zeros(len(points))
    plane = centred @ axes[:2].T if flat else centred
    terms = _POWERS[: max(len(points) // _PER_TERM - 3, 0)] if flat else []
    x, y = (plane[:, :2] / sizes[0]).T
    bending = np.stack([np.ones_like(x), x, y, *(x**a * y**b for a, b in terms)], axis=1)
    middle, reach = (np.array(size) - 1) / 2, float(np.linalg.norm(size)) / 2
    least = np.full(len(points), np.inf)
    for bent in _BENT if terms else _BENT[:1]:
        straight = _unbent((values - middle) / reach, bent)
        predicted = middle + reach * _bent(projected(projection(plane, straight), plane), bent)
        rest = values - predicted
        if terms:
            rest = rest - bending @ np.linalg.lstsq(bending, rest, rcond=None)[0]
        distances = np.linalg.norm(rest, axis=1)
        least = min(least, distances, key=lambda each: float(np.sum(each**2)))
    return least


def _unbent(values: Float[np.ndarray, "k 2"], bent: float) -> Float[np.ndarray, "k 2"]:
    """Where a camera without distortion would see what appears at ``values``, in half diagonals of the image."""
    return values / (1 - bent * np.sum(values**2, axis=1, keepdims=True))


def _bent(values: Float[np.ndarray, "k 2"], bent: float) -> Float[np.ndarray, "k 2"]:
    """The inverse."""
    square = bent * np.sum(values**2, axis=1, keepdims=True)
    return 2 * values / (1 + np.sqrt(1 + 4 * square))


def _normalised(points: Float[np.ndarray, "k d"]) -> tuple[Float[np.ndarray, "k d"], Float[np.ndarray, "e e"]]:
    """Points about their centre with a mean size of 1, and the matrix that makes them so."""
    centre, dimension = points.mean(axis=0), points.shape[1]
    size = np.sqrt(np.mean((points - centre) ** 2)) + 1e-300
    matrix = np.diag([*(1 / size,) * dimension, 1.0])
    matrix[:dimension, dimension] = -centre / size
    return (points - centre) / size, matrix
