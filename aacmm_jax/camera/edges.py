"""Edges between black and white, to a few hundredths of a pixel: the corners of tags, and how blurred an image is.

The corner of a black square is rounded by blur, so that what looks for the corner itself finds it too far inside, by
0.2 to 0.7 px. Its two edges are not moved by blur; so the corner is where they meet.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

Image = Float[np.ndarray, "h w"]
Ends = Float[np.ndarray, "*edges 2"]  # px
_ALONG = np.linspace(0.08, 0.92, 19)  # where edges are sampled, of their length
_ACROSS = np.linspace(-1.0, 1.0, 25)
_ROUNDS = 3
_CURVED = 40.0  # px: a longer edge is fitted by a parabola, since distortion bends it
_STRAIGHT = 0.1  # weight of a curvature of 0, against that of a sample: of noise 0.1 px and a curvature of 0.3 px
_FAINT = 0.3  # of the contrast of an edge: a sample with less does not see the edge


def profiles(image: Image, start: Ends, end: Ends, width: Float[np.ndarray, "*edges"]) -> tuple[np.ndarray, np.ndarray]:
    """Grey levels across edges, from ``-width`` to ``width`` px, and the unit normals that they run along.

    With x to the right and y down, the normal points to the left of the way from start to end.
    """
    way = end - start
    normal = np.stack([way[..., 1], -way[..., 0]], axis=-1) / np.linalg.norm(way, axis=-1, keepdims=True)
    along = start[..., None, :] + _ALONG[:, None] * way[..., None, :]
    points = (
        along[..., None, :] + (_ACROSS[:, None] * width[..., None, None])[..., None, :, :] * normal[..., None, None, :]
    )
    return map_coordinates(image, [points[..., 1], points[..., 0]], order=1, mode="nearest"), normal


def blur_of(image: Image, start: Ends, end: Ends, width: Float[np.ndarray, "*edges"]) -> Float[np.ndarray, "*edges"]:
    """Standard deviation of the blur across edges, px: their contrast divided by their steepest slope.

    That of the pixels themselves, some 0.4 px, is included; a blur of more than half the width is underestimated.
    """
    across = np.median(profiles(image, start, end, width)[0], axis=-2)
    contrast = np.abs(across[..., -1] - across[..., 0])
    slope = np.abs(np.gradient(across, axis=-1)).max(axis=-1) / (width * (_ACROSS[1] - _ACROSS[0]))
    return contrast / np.maximum(np.sqrt(2 * np.pi) * slope, 1e-12)


def cell_thickness(corners: Float[np.ndarray, "t 4 2"], cells: int) -> Float[np.ndarray, "t 4"]:
    """How thick the border of tags appears along each of their edges, px."""
    way = np.roll(corners, -1, axis=1) - corners
    following = np.roll(way, -1, axis=1)
    area = np.abs(way[..., 0] * following[..., 1] - way[..., 1] * following[..., 0])
    return np.minimum(area, np.roll(area, 1, axis=1)) / np.linalg.norm(way, axis=-1) / cells


def refined_tags(image: Image, corners: Float[np.ndarray, "t 4 2"], cells: int) -> Float[np.ndarray, "t 4 2"]:
    """The corners of tags, clockwise, where the edges of their black squares meet; ``cells``: on a side, with border.

    An edge is where the integral of the grey levels across it puts a step of the same contrast.
    """
    for _ in range(_ROUNDS):
        start, end = corners, np.roll(corners, -1, axis=1)
        length = np.linalg.norm(end - start, axis=-1)
        # The border is one cell thick, and its neighbour may be white.
        width = np.clip(0.7 * cell_thickness(corners, cells), 1.2, 5.0)
        grey, normal = profiles(image, start, end, width)
        dark, light = grey[..., :2].mean(axis=-1), grey[..., -2:].mean(axis=-1)
        contrast = light - dark
        integral = np.trapezoid(grey, _ACROSS, axis=-1)
        faint = contrast < _FAINT * np.median(contrast, axis=-1, keepdims=True)
        offset = (light + dark - integral) / np.where(faint, np.inf, contrast) * width[..., None]
        curve = _fitted(offset, ~faint, length > _CURVED)
        # The tangents at the end of each edge and at the start of the next one.
        first = start + curve[..., :1] * normal, (end - start) + curve[..., 1:2] * normal
        last_offset, last_slope = curve.sum(axis=-1)[..., None], (curve[..., 1] + 2 * curve[..., 2])[..., None]
        last = end + last_offset * normal, (end - start) + last_slope * normal
        corners = _meeting(first, tuple(np.roll(part, 1, axis=1) for part in last), start)
    return corners


def _fitted(offset: Float[np.ndarray, "t 4 n"], seen: np.ndarray, curved: np.ndarray) -> Float[np.ndarray, "t 4 3"]:
    """Constant, slope and curvature of the offsets along each edge; samples far from the others are left out."""
    powers = np.stack([np.ones_like(_ALONG), _ALONG, _ALONG**2], axis=-1)
    weight, curve = seen.astype(float), np.zeros((*seen.shape[:2], 3))
    for degrees in (np.zeros_like(curved), curved, curved):
        matrix = np.einsum("tkn,ni,nj->tkij", weight, powers, powers) + np.diag([1e-9, 1e-9, _STRAIGHT])
        right = np.einsum("tkn,ni->tki", weight * offset, powers)
        matrix[~degrees, 2, :2] = matrix[~degrees, :2, 2] = right[~degrees, 2] = 0.0
        curve = np.linalg.solve(matrix, right[..., None])[..., 0]
        rest = np.abs(offset - curve @ powers.T)
        weight = seen * (rest <= 4 * np.median(rest, axis=-1, keepdims=True) + 0.1)
    return curve


def _meeting(first: tuple, second: tuple, otherwise: Float[np.ndarray, "t 4 2"]) -> Float[np.ndarray, "t 4 2"]:
    """Where lines through points along directions meet; ``otherwise`` where they are almost parallel."""
    (p, d), (q, e) = first, second
    determinant = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
    size = np.linalg.norm(d, axis=-1) * np.linalg.norm(e, axis=-1)
    fine = np.abs(determinant) > 0.1 * size
    way = ((q - p)[..., 0] * e[..., 1] - (q - p)[..., 1] * e[..., 0]) / np.where(fine, determinant, 1.0)
    return np.where(fine[..., None], p + way[..., None] * d, otherwise)
