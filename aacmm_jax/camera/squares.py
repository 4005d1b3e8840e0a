"""Where black and white squares meet: the inner corners of checkerboards and ChArUco boards."""

import numpy as np
from jaxtyping import Float, Int

from ..data.targets import Charuco, Checkerboard
from .consistency import is_mirrored, projected, projection
from .evidence import BORDER, DARK, FEWEST, Grey, Refusal, fitting, inside, levels_at, why_nothing

_SIDE = 0.4  # of the contrast of the board: a row of squares with more is there, one with less is not
_FAINT = 0.25  # of the contrast of the board: a corner whose squares differ by less is hidden
_SEARCHED = 1280  # px: the larger side of an image in which a checkerboard is searched
_HALF_WINDOW = 0.9  # of the distance to the nearest marker
_MOST_MOVED = 1.5  # px: a corner that is farther from where markers have it is another edge
_WINDOWS = (2, 11)  # px: half the window in which a corner is refined


def checkerboard_corners(grey: Grey, board: Checkerboard) -> tuple[np.ndarray, np.ndarray]:
    """The inner corners of a checkerboard, in the order of their ids."""
    inner = (board.columns - 1, board.rows - 1)
    corners = _pattern(grey, inner)
    if corners is None:
        raise Refusal(
            f"no checkerboard of {board.columns} x {board.rows} squares was found, the whole of which must be in view"
            + why_nothing(grey)
        )
    points = board.nominal[1][:, :2]
    corners = corners if not is_mirrored(points, corners) else corners.reshape(*inner[::-1], 2)[::-1].reshape(-1, 2)
    matrix = projection(points, corners)
    # How black and white the squares of each row and column are, from one outside the board on each side to the other.
    column, row = np.meshgrid(np.arange(-2, board.columns), np.arange(-2, board.rows))
    places = projected(matrix, board.size * (np.stack([column, row], axis=-1).reshape(-1, 2) + 0.5))
    signed = np.where((row + column) % 2 == 0, -1.0, 1.0) * levels_at(grey, places).reshape(row.shape)  # black: -1
    contrast = signed[2:-2, 2:-2].mean() + signed[2:-2, 2:-2][::-1, ::-1].mean()
    lines = [np.array([_alternating(line) for line in part]) for part in (signed[:, 1:-1], signed.T[:, 1:-1])]
    if abs(contrast) < DARK / 2:
        raise Refusal(f"a grid was found that is not black and white{why_nothing(grey)}")
    if any(abs(line[end]) > _SIDE * abs(contrast) for line in lines for end in (0, -1)):
        raise Refusal(f"the checkerboard is larger than the stated one of {board.columns} x {board.rows} squares")
    if any(line[end] / contrast < _SIDE for line in lines for end in (1, -2)):
        raise Refusal("the outer squares of the checkerboard are hidden, or it is smaller than stated")
    if contrast < 0:  # the other way up
        corners = corners[::-1]
    spacing = float(np.median(np.linalg.norm(np.diff(corners.reshape(*inner[::-1], 2), axis=1), axis=-1)))
    corners = _refined(grey, corners, np.full(len(corners), 0.35 * spacing))
    kept = fitting(board, board.ids, corners, spacing, grey.shape[::-1])
    far = np.array([board.columns, board.rows]) - 0.5
    outline = projected(matrix, board.size * np.array([[-1.5, -1.5], [far[0], -1.5], far, [-1.5, far[1]]]))
    if _pattern(_without(grey, outline), inner) is not None:
        raise Refusal("two checkerboards are seen: cover one of them")
    return board.ids[kept], corners[kept]


def _alternating(line: Float[np.ndarray, " n"]) -> float:
    """Twice the mean of levels of squares that have a sign by turns, apart from what all of them share."""
    return float(line[::2].mean() + line[1::2].mean())


def _pattern(grey: Grey, inner: tuple[int, int]) -> Float[np.ndarray, "k 2"] | None:
    """The inner corners of a checkerboard in some order along its rows; large images are searched at a smaller size."""
    import cv2

    scale = max(max(grey.shape) / _SEARCHED, 1.0)
    size = (round(grey.shape[1] / scale), round(grey.shape[0] / scale))
    smaller = grey if scale == 1 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    found, corners = cv2.findChessboardCornersSB(smaller, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    return (corners.reshape(-1, 2).astype(float) + 0.5) * (np.array(grey.shape[::-1]) / size) - 0.5


def _without(grey: Grey, outline: Float[np.ndarray, "n 2"]) -> Grey:
    """The image with a polygon painted in its mean grey."""
    import cv2

    painted = grey.copy()
    return cv2.fillPoly(painted, [np.rint(outline).astype(np.int32)], float(grey.mean()))


def charuco_corners(
    grey: Grey, board: Charuco, tags: Int[np.ndarray, " t"], corners: Float[np.ndarray, "t 4 2"]
) -> tuple[np.ndarray, np.ndarray]:
    """The inner corners of the board beside the markers that were found."""
    places = dict(zip(tags.tolist(), zip(board.markers[1][tags][:, :, :2], corners, strict=True), strict=True))
    centres = board.markers[1][:, :, :2].mean(axis=1)
    ids, near = [], []
    for corner, point in enumerate(board.nominal[1][:, :2]):
        beside = np.flatnonzero(np.linalg.norm(centres - point, axis=1) < 0.8 * board.size)
        markers = [places[tag] for tag in beside.tolist() if tag in places]
        if markers:
            plane, image = (np.concatenate(parts) for parts in zip(*markers, strict=True))
            ids.append(corner)
            near.append(projected(projection(plane, image), point[None])[0])
    if not ids:
        raise Refusal("no corner of the board was found beside its markers")
    kept = inside(grey, np.array(near), BORDER + _WINDOWS[0])
    ids, start = np.array(ids)[kept], np.array(near)[kept]
    points = board.nominal[1][ids, :2]
    everything = [np.concatenate(parts) for parts in zip(*places.values(), strict=True)]
    matrix = projection(*everything)

    def moved(x: float, y: float) -> np.ndarray:
        """How far places on the board, beside the corners, are from these in the image."""
        return projected(matrix, points + np.array([x, y])) - projected(matrix, points)

    free = (board.size - board.marker) / 2  # of markers, around a corner
    distance = np.minimum(np.linalg.norm(moved(free, 0), axis=1), np.linalg.norm(moved(0, free), axis=1))
    corners = _refined(grey, start, _HALF_WINDOW * distance)
    # Two black and two white squares, as the board has them; elsewhere the corner is hidden.
    beside = {
        (x, y): levels_at(grey, corners + moved(0.7 * x * free, 0.7 * y * free)) for x in (-1, 1) for y in (-1, 1)
    }
    row, column = np.divmod(ids, board.columns - 1)
    black_first = ((row + column) % 2 == 0) != board.starts_white
    falling, rising = np.stack([beside[-1, -1], beside[1, 1]]), np.stack([beside[1, -1], beside[-1, 1]])
    black, white = np.where(black_first, falling, rising), np.where(black_first, rising, falling)
    contrast = white.min(axis=0) - black.max(axis=0)
    kept = contrast > _FAINT * np.median(white - black)
    kept &= np.linalg.norm(corners - start, axis=1) < np.maximum(0.5 * distance, _MOST_MOVED)
    if kept.sum() >= FEWEST["charuco"]:
        spacing = board.size / free * float(np.median(distance))
        kept[kept] = fitting(board, ids[kept], corners[kept], spacing, grey.shape[::-1])
    return ids[kept], corners[kept]


def _refined(
    grey: Grey, corners: Float[np.ndarray, "k 2"], windows: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k 2"]:
    """Where four squares meet, from the grey levels in a window of this half width around each, px."""
    import cv2

    halves, refined = np.clip(np.rint(windows), *_WINDOWS).astype(int), np.array(corners)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)
    for half in np.unique(halves).tolist():
        start = np.ascontiguousarray(corners[halves == half], dtype=np.float32).reshape(-1, 1, 2)
        refined[halves == half] = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), criteria).reshape(-1, 2)
    return refined
