"""Whether corners in an image can be those of a target: a check that needs no intrinsics.

A flat target appears through a homography, which distortion bends smoothly. A corner that was taken for another one is
off by a good part of a square, which no smooth bending explains.
"""

import numpy as np
from jaxtyping import Float

_WIDTH = 0.05  # of a line, over its length
_PER_TERM = 3  # corners for each term of the bending
_POWERS = [(1, 1), (2, 0), (0, 2), (2, 1), (1, 2), (3, 0), (0, 3)]  # of x and y


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


def misfits(points: Float[np.ndarray, "k 3"], values: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
    """How far corners appear from where the others have them, px: zero where there are too few to tell."""
    centred = points - points.mean(axis=0)
    sizes, axes = np.linalg.svd(centred, full_matrices=False)[1:]
    flat = sizes[2] <= 1e-6 * sizes[0]
    if len(points) < (5 if flat else 7):
        return np.zeros(len(points))
    plane = centred @ axes[:2].T if flat else centred
    rest = values - projected(projection(plane, values), plane)
    terms = _POWERS[: max(len(points) // _PER_TERM - 3, 0)] if flat else []
    if terms:
        x, y = (centred @ axes[:2].T / sizes[0]).T
        bending = np.stack([np.ones_like(x), x, y, *(x**a * y**b for a, b in terms)], axis=1)
        rest = rest - bending @ np.linalg.lstsq(bending, rest, rcond=None)[0]
    return np.linalg.norm(rest, axis=1)


def _normalised(points: Float[np.ndarray, "k d"]) -> tuple[Float[np.ndarray, "k d"], Float[np.ndarray, "e e"]]:
    """Points about their centre with a mean size of 1, and the matrix that makes them so."""
    centre, dimension = points.mean(axis=0), points.shape[1]
    size = np.sqrt(np.mean((points - centre) ** 2)) + 1e-300
    matrix = np.diag([*(1 / size,) * dimension, 1.0])
    matrix[:dimension, dimension] = -centre / size
    return (points - centre) / size, matrix
