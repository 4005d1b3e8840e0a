"""Corners of a target in an image, found by OpenCV and refined to a few hundredths of a pixel; or why there are none.

An image that would be misread is refused: one in which the target is mirrored, or does not look like the target that
was stated, or in which two alike are seen.
"""

import os
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter, uniform_filter

from ..core.arguments import checked_arguments
from ..core.errors import InputError, require
from ..core.text import pluralise, shorten
from ..data.targets import DICTIONARIES, AbstractTarget, Charuco, Checkerboard
from .consistency import is_mirrored, misfits, projected, projection
from .edges import blur_of, cell_thickness, refined_tags

Grey = UInt8[np.ndarray, "h w"]
_FEWEST = {"checkerboard": 6, "charuco": 6, "tags": 4, "points": 4}  # corners
_BORDER = 3.0  # px: corners nearer to the border of the image are left out
_FAR = 0.3  # of the side of a marker: one that is farther from where the target has it is another one
_MISFIT, _LEAST_MISFIT = 0.05, 1.0  # of corners, in distances between neighbouring ones; and px
_MOST_LEFT_OUT = 1 / 3  # of the markers
_BLURRED = 0.12  # the most blur, of the distance between neighbouring corners
_CELL_BLURS = 3.2  # the least size of the cells of a tag, in standard deviations of the blur
_SIDE = 0.4  # of the contrast of the board: a row of squares with more is there, one with less is not
_FAINT = 0.25  # of the contrast of the board: a corner whose squares differ by less is hidden
_DARK = 25.0  # grey levels between the darkest and the brightest parts
_MOST_BLUR, _BLURRED_IMAGE = 4.0, 2.5  # px: of a target that was found, and of an image in which none was
_MOVED = 1.6  # the blur in one direction, divided by that in the other
_SEARCHED = 1280  # px: the larger side of an image in which a checkerboard is searched
_ROOM = 0.9  # half the window, of the distance to the nearest marker
_MOST_MOVED = 1.5  # px: a corner that is farther from where markers have it is another edge
_WINDOWS = (2, 11)  # px: half the window in which a corner is refined


class Detection(NamedTuple):
    """The corners of a target that were found in an image."""

    ids: Int[np.ndarray, " k"]
    corners: Float[np.ndarray, "k 2"]  # px; the centre of the first pixel is 0, 0
    refused: str  # why the image is not used: one sentence, or nothing
    size: tuple[int, int]  # width and height of the image, px
    blur: float  # standard deviation of the blur of edges, px; not finite where none were found
    note: str = ""  # what else was seen


class _Refusal(Exception):
    """The image is not used; the message says why."""


@checked_arguments
def detect(
    image: str | os.PathLike | Grey, target: AbstractTarget, *, image_size: tuple[int, ...] | None = None
) -> Detection:
    """Find the corners of a target in an image.

    Corners that are hidden or outside the image are absent. A checkerboard has to be seen whole.

    Args:
        image: Image file, or grey levels ``(height, width)``.
        target: What to look for; its lengths are in mm.
        image_size: Width and height for which the camera's intrinsics hold, px; an image of another size is refused.

    Returns:
        The ids of the corners, their places in px, and, where the image is refused, the reason.

    Raises:
        InputError: The file is not an image, the target cannot be recognised in images, or OpenCV is not installed.
    """
    require("camera", "Detection of corners in images")
    if isinstance(target, Checkerboard) and (target.columns + target.rows) % 2 == 0:
        raise InputError(
            f"a checkerboard of {target.columns} x {target.rows} squares looks the same after half a turn; use one "
            "with an odd and an even number of squares, or a ChArUco board."
        )
    if not isinstance(target, Checkerboard) and not len(target.markers[0]):
        raise InputError("a table of points without a dictionary of tags is not recognised in images; give a table.")
    grey = read_image(image)
    size, nothing = (grey.shape[1], grey.shape[0]), (np.zeros(0, dtype=int), np.zeros((0, 2)))
    try:
        if image_size is not None and tuple(image_size) != size:
            raise _Refusal(
                f"it has {size[0]} x {size[1]} px, but the intrinsics of the camera are for {image_size[0]} x "
                f"{image_size[1]} px"
            )
        note = ""
        if isinstance(target, Checkerboard):
            ids, corners = _checkerboard_corners(grey, target)
        else:
            tags, tag_corners, note = _markers(grey, target)
            corners_of = _charuco_corners if isinstance(target, Charuco) else _tag_corners
            ids, corners = corners_of(grey, target, tags, tag_corners)
        inside = _inside(grey, corners, _BORDER)
        ids, corners = ids[inside], corners[inside]
        blur = _checked_blur(grey, target, ids, corners)
    except _Refusal as refusal:
        return Detection(*nothing, str(refusal), size, np.nan)
    return Detection(ids, corners, "", size, blur, note)


def read_image(image: str | os.PathLike | Grey) -> Grey:
    """Grey levels of an image as the sensor took it; a turn that the file asks viewers for is not made."""
    if isinstance(image, np.ndarray):
        return image
    import cv2

    if not os.path.isfile(image):
        raise InputError(f"{image} does not exist; give the path of an image.")
    data = np.fromfile(image, dtype=np.uint8)
    try:
        grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    except cv2.error:  # such as an image of billions of pixels
        grey = None
    if grey is None:
        raise InputError(f"{image} is not an image that OpenCV reads; give a PNG or JPEG file.")
    return np.asarray(grey)


def _markers(grey: Grey, target: AbstractTarget) -> tuple[np.ndarray, np.ndarray, str]:
    """Ids and corners of the target's markers that agree with its layout, and what else was seen."""
    tags, corners = _decoded(grey, target)
    ours = np.isin(tags, target.markers[0])
    known = target.markers[0]
    if ours.sum() < 4:
        mirrored = np.isin(_decoded(np.ascontiguousarray(grey[:, ::-1]), target)[0], known).sum()
        if mirrored > ours.sum():
            raise _Refusal(
                f"{pluralise(int(mirrored), 'marker')} of the target can be read in a mirror only: the image or the "
                "print is mirrored"
            )
    strangers = shorten([str(tag) for tag in np.unique(tags[~ours])])
    if not ours.any():
        if strangers:
            raise _Refusal(f"another target is seen: it has the marker {strangers}, and this one {_range(known)}")
        raise _Refusal(f"no marker of the target was found{_why_nothing(grey)}")
    tags, corners = tags[ours], corners[ours]
    twice = [str(tag) for tag, count in zip(*np.unique(tags, return_counts=True), strict=True) if count > 1]
    if twice:
        raise _Refusal(f"the marker {shorten(twice)} is seen twice: there are two boards, or a reflection")
    tags, corners, left_out = _agreeing(target, tags, corners)
    notes = [f"the marker {strangers} is not on the target"] if strangers else []
    notes += [f"the marker {shorten(left_out)} is not where the target has it, and is not used"] if left_out else []
    return tags, corners, "; ".join(notes)


def _tag_corners(
    grey: Grey, target: AbstractTarget, tags: Int[np.ndarray, " t"], corners: Float[np.ndarray, "t 4 2"]
) -> tuple[np.ndarray, np.ndarray]:
    """The corners of tags whose cells are large enough to tell their edges apart."""
    image, cells = grey.astype(float), DICTIONARIES[getattr(target, "dictionary")][0] + 2  # noqa: B009
    corners = refined_tags(image, corners, cells)
    thickness = cell_thickness(corners, cells)
    blur = np.median(blur_of(image, corners, np.roll(corners, -1, axis=1), 0.7 * np.maximum(thickness, 2.0)), axis=1)
    large = thickness.min(axis=1) > _CELL_BLURS * blur
    if not large.any():
        raise _Refusal(
            f"the tags are too small or too blurred: their cells have {thickness.min(axis=1).max():.1f} px, and edges "
            f"are blurred by {blur.min():.1f} px (standard deviation)"
        )
    ids, corners = (4 * tags[large, None] + np.arange(4)).ravel(), corners[large]
    _check_fit(target, ids, corners.reshape(-1, 2), float(np.median(_sides(corners))))
    return ids, corners.reshape(-1, 2)


def _check_fit(
    target: AbstractTarget, ids: Int[np.ndarray, " k"], corners: Float[np.ndarray, "k 2"], spacing: float
) -> None:
    """Refuse corners that are not where the target has them, though their order is right."""
    misfit = misfits(_points_of(target, ids), corners).max()
    if misfit > max(_MISFIT * spacing, _LEAST_MISFIT):
        raise _Refusal(
            f"the corners are {misfit:.1f} px from where the target has them: the sizes stated are not in the right "
            "ratio, it is hidden in part, or a board is not flat"
        )


def _decoded(grey: Grey, target: AbstractTarget) -> tuple[Int[np.ndarray, " t"], Float[np.ndarray, "t 4 2"]]:
    """All markers of the target's dictionary, in the order of their ids."""
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.errorCorrectionRate = 0.0  # a marker that is read with an error may be another one
    name = getattr(target, "dictionary")  # noqa: B009
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))
    corners, tags, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(grey)
    if tags is None:
        return np.zeros(0, dtype=int), np.zeros((0, 4, 2))
    order = np.argsort(np.ravel(tags), kind="stable")
    return np.ravel(tags)[order].astype(int), np.array(corners, dtype=float).reshape(-1, 4, 2)[order]


def _agreeing(
    target: AbstractTarget, tags: Int[np.ndarray, " t"], corners: Float[np.ndarray, "t 4 2"]
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Markers that are where the target has them, and the names of those that are not: some background looks like one.

    The one that is farthest from where the others have it is left out, until all agree.
    """
    points = target.markers[1][np.searchsorted(target.markers[0], tags)]
    kept = np.arange(len(tags))
    while True:
        limit = max(_FAR * float(np.median(_sides(corners[kept]))), 2 * _LEAST_MISFIT)
        misfit = misfits(points[kept].reshape(-1, 3), corners[kept].reshape(-1, 2)).reshape(-1, 4).max(axis=1)
        if misfit.max() <= limit:
            return tags[kept], corners[kept], [str(tag) for tag in np.delete(tags, kept)]
        if len(kept) - 1 < (1 - _MOST_LEFT_OUT) * len(tags):
            raise _Refusal(
                "the markers are not where the target has them: it is another target, or its layout is stated wrongly"
            )
        kept = np.delete(kept, np.argmax(misfit))


def _charuco_corners(
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
        raise _Refusal("no corner of the board was found beside its markers")
    inside = _inside(grey, np.array(near), _BORDER + _WINDOWS[0])
    ids, start = np.array(ids)[inside], np.array(near)[inside]
    points = board.nominal[1][ids, :2]
    everything = [np.concatenate(parts) for parts in zip(*places.values(), strict=True)]
    matrix = projection(*everything)

    def moved(x: float, y: float) -> np.ndarray:
        """How far places on the board, beside the corners, are from these in the image."""
        return projected(matrix, points + np.array([x, y])) - projected(matrix, points)

    free = (board.size - board.marker) / 2  # of markers, around a corner
    room = np.minimum(np.linalg.norm(moved(free, 0), axis=1), np.linalg.norm(moved(0, free), axis=1))
    corners = _refined(grey, start, _ROOM * room)
    # Two black and two white squares, as the board has them; elsewhere the corner is hidden.
    beside = {(x, y): _levels(grey, corners + moved(0.7 * x * free, 0.7 * y * free)) for x in (-1, 1) for y in (-1, 1)}
    row, column = np.divmod(ids, board.columns - 1)
    black_first = ((row + column) % 2 == 0) != board.starts_white
    falling, rising = np.stack([beside[-1, -1], beside[1, 1]]), np.stack([beside[1, -1], beside[-1, 1]])
    black, white = np.where(black_first, falling, rising), np.where(black_first, rising, falling)
    contrast = white.min(axis=0) - black.max(axis=0)
    kept = contrast > _FAINT * np.median(white - black)
    kept &= np.linalg.norm(corners - start, axis=1) < np.maximum(0.5 * room, _MOST_MOVED)
    if kept.sum() >= _FEWEST["charuco"]:
        _check_fit(board, ids[kept], corners[kept], board.size / free * float(np.median(room)))
    return ids[kept], corners[kept]


def _checkerboard_corners(grey: Grey, board: Checkerboard) -> tuple[np.ndarray, np.ndarray]:
    """The inner corners of a checkerboard, in the order of their ids."""
    inner = (board.columns - 1, board.rows - 1)
    corners = _pattern(grey, inner)
    if corners is None:
        raise _Refusal(
            f"no checkerboard of {board.columns} x {board.rows} squares was found, the whole of which must be in view"
            + _why_nothing(grey)
        )
    points = board.nominal[1][:, :2]
    corners = corners if not is_mirrored(points, corners) else corners.reshape(*inner[::-1], 2)[::-1].reshape(-1, 2)
    matrix = projection(points, corners)
    # How black and white the squares of each row and column are, from one outside the board on each side to the other.
    column, row = np.meshgrid(np.arange(-2, board.columns), np.arange(-2, board.rows))
    places = projected(matrix, board.size * (np.stack([column, row], axis=-1).reshape(-1, 2) + 0.5))
    signed = np.where((row + column) % 2 == 0, -1.0, 1.0) * _levels(grey, places).reshape(row.shape)  # black: -1
    contrast = signed[2:-2, 2:-2].mean() + signed[2:-2, 2:-2][::-1, ::-1].mean()
    lines = [np.array([_alternating(line) for line in part]) for part in (signed[:, 1:-1], signed.T[:, 1:-1])]
    if abs(contrast) < _DARK / 2:
        raise _Refusal(f"a grid was found that is not black and white{_why_nothing(grey)}")
    if any(abs(line[end]) > _SIDE * abs(contrast) for line in lines for end in (0, -1)):
        raise _Refusal(f"the checkerboard is larger than the stated one of {board.columns} x {board.rows} squares")
    if any(line[end] / contrast < _SIDE for line in lines for end in (1, -2)):
        raise _Refusal("the outer squares of the checkerboard are hidden, or it is smaller than stated")
    if contrast < 0:  # the other way up
        corners = corners[::-1]
    spacing = float(np.median(np.linalg.norm(np.diff(corners.reshape(*inner[::-1], 2), axis=1), axis=-1)))
    corners = _refined(grey, corners, np.full(len(corners), 0.35 * spacing))
    _check_fit(board, board.ids, corners, spacing)
    far = np.array([board.columns, board.rows]) - 0.5
    outline = projected(matrix, board.size * np.array([[-1.5, -1.5], [far[0], -1.5], far, [-1.5, far[1]]]))
    if _pattern(_without(grey, outline), inner) is not None:
        raise _Refusal("two checkerboards are seen: cover one of them")
    return board.ids, corners


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


def _levels(grey: Grey, places: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
    """Grey levels at places, of nine pixels each."""
    smooth = uniform_filter(grey.astype(float), 3)
    return map_coordinates(smooth, places.T[::-1], order=1, mode="nearest")


def _inside(grey: Grey, places: Float[np.ndarray, "k 2"], border: float) -> np.ndarray:
    """Whether places are in the image, and not near its border."""
    return np.all((places > border) & (places < np.array(grey.shape[::-1]) - 1 - border), axis=1)


def _sides(corners: Float[np.ndarray, "t 4 2"]) -> Float[np.ndarray, "t 4"]:
    """Lengths of the sides of markers, px."""
    return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)


def _checked_blur(
    grey: Grey, target: AbstractTarget, ids: Int[np.ndarray, " k"], corners: Float[np.ndarray, "k 2"]
) -> float:
    """The blur of edges, px; refuses few corners, corners on a line, and an image that is out of focus or moved."""
    if len(ids) < _FEWEST[target.kind]:
        fewest = f"at least {_FEWEST[target.kind]} are needed"
        raise _Refusal(f"{pluralise(len(ids), 'corner')} found, and {fewest}{_why_nothing(grey)}")
    points = _points_of(target, ids)
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if sizes[1] < 0.05 * sizes[0]:
        raise _Refusal(f"the {len(ids)} corners found are on one line")
    where, found = {corner: k for k, corner in enumerate(ids.tolist())}, []
    if isinstance(target, Checkerboard | Charuco):
        across = target.columns - 1
        pairs = [[(i, i + 1) for i in where if (i + 1) % across], [(i, i + across) for i in where]]
        free = 0.4 if isinstance(target, Checkerboard) else 0.4 * (1 - target.marker / target.size)
    else:
        pairs = [[(i, i + 1) for i in where if i % 2 == 0], [(i, i - i % 4 + (i + 1) % 4) for i in where if i % 2]]
        free = 0.7 / (DICTIONARIES[getattr(target, "dictionary")][0] + 2)  # noqa: B009
    limits = []
    for of_direction in pairs:
        both = np.array([(where[i], where[j]) for i, j in of_direction if j in where], dtype=int).reshape(-1, 2)
        if len(both):
            start, end = corners[both[:, 0]], corners[both[:, 1]]
            length = np.linalg.norm(end - start, axis=1)
            width = np.maximum(free * length, 1.2)
            found.append(float(np.median(blur_of(grey.astype(float), start, end, width))))
            limits.append(min(_BLURRED * float(np.median(length)), 0.7 * float(np.median(width)), _MOST_BLUR))
    if not found:
        return np.nan
    if any(blur > limit for blur, limit in zip(found, limits, strict=True)):
        moved = max(found) > _MOVED * min(found)
        cause = "the camera or the target moved" if moved else "it is out of focus"
        raise _Refusal(f"{cause}: edges are blurred by {max(found):.1f} px (standard deviation)")
    return max(found)


def _points_of(target: AbstractTarget, ids: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k 3"]:
    """Nominal coordinates of corners, mm."""
    order = np.argsort(target.ids)
    return target.nominal[1][order[np.searchsorted(target.ids[order], ids)]]


def _why_nothing(grey: Grey) -> str:
    """What may be wrong with an image in which nothing was found."""
    low, high = np.percentile(grey[::4, ::4], [1, 99])
    if high < 2 * _DARK:
        return ": it is too dark"
    if low > 255 - 2 * _DARK:
        return ": it is overexposed"
    if high - low < _DARK:
        return ": it has no contrast"
    levels = grey.astype(float)
    span, blurs = maximum_filter(levels, 15) - minimum_filter(levels, 15), []
    for slope in map(np.abs, np.gradient(gaussian_filter(levels, 0.7))):
        steepest = slope >= np.quantile(slope, 0.998)
        blurs.append(float(np.median(span[steepest] / np.maximum(slope[steepest], 1e-9)) / np.sqrt(2 * np.pi)))
    return f": it is blurred by {max(blurs):.1f} px (standard deviation)" if max(blurs) > _BLURRED_IMAGE else ""


def _range(tags: Int[np.ndarray, " t"]) -> str:
    """Ids in words."""
    return f"{tags.min()} to {tags.max()}" if len(tags) > 1 else str(tags[0])
