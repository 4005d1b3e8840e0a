"""Corners of a target in an image, found by OpenCV and refined to a few hundredths of a pixel; or why there are none.

An image that would be misread is refused: one in which the target is mirrored, or does not look like the target that
was stated, or in which two alike are seen.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.arguments import checked_arguments
from ..core.errors import InputError, require
from ..core.pictures import picture_size
from ..core.text import pluralise
from ..data.targets import DICTIONARIES, AbstractTarget, Charuco, Checkerboard
from .consistency import on_one_line
from .edges import blur_of
from .evidence import BORDER, FEWEST, Grey, Refusal, inside, why_nothing
from .markers import tag_corners, target_markers
from .squares import charuco_corners, checkerboard_corners

_MOST_PIXELS = 120_000_000  # of an image
_BLURRED = 0.12  # the most blur, of the distance between neighbouring corners
_WIDEST, _MOST_BLUR = 7.0, 3.0  # px: the width across edges in which blur is measured, and the most of it
_PREVIEW = 320  # px: the larger side of a picture for a report
_MOVED = 1.6  # the blur in one direction, divided by that in the other


class Detection(NamedTuple):
    """The corners of a target that were found in an image.

    Example:
        >>> aj.camera.detect(np.full((480, 640), 90, dtype=np.uint8), aj.camera.Charuco(7, 5, 30.0, 22.0)).refused
        'no marker of the target was found: it has no contrast'
    """

    ids: Int[np.ndarray, " k"]
    corners: Float[np.ndarray, "k 2"]  # px; the centre of the first pixel is 0, 0
    refused: str  # why the image is not used: one sentence, or nothing
    size: tuple[int, int]  # width and height of the image, px
    blur: float  # standard deviation of the blur of edges, px; not finite where none were found
    note: str = ""  # what else was seen


@checked_arguments
def detect(
    image: str | os.PathLike | np.ndarray, target: AbstractTarget, *, image_size: tuple[int, ...] | None = None
) -> Detection:
    """Find the corners of a target in an image.

    Corners that are hidden or outside the image are absent. A checkerboard has to be seen whole, and a mirrored image
    of one cannot be told, since it is its own mirror image; markers tell both.

    Args:
        image: Image file, or grey levels ``(height, width)``.
        target: What to look for; its lengths are in mm.
        image_size: Width and height for which the camera's intrinsics hold, px; an image of another size is refused.

    Returns:
        The ids of the corners, their places in px, and, where the image is refused, the reason.

    Raises:
        InputError: The file is not an image, the target cannot be recognised in images, or OpenCV is not installed.

    Example:
        >>> board, facing = aj.camera.Charuco(7, 5, 30.0, 22.0), np.eye(4)
        >>> facing[:3, 3] = -105.0, -75.0, 400.0  # mm
        >>> image = aj.camera.render(board, facing, "pinhole", [600.0, 600.0, 319.5, 239.5], (640, 480))
        >>> found = aj.camera.detect(image, board)
        >>> print(len(found.ids), found.corners[0].round())
        24 [207. 172.]
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
            raise Refusal(
                f"it has {size[0]} x {size[1]} px, but the intrinsics of the camera are for {image_size[0]} x "
                f"{image_size[1]} px"
            )
        note = ""
        if isinstance(target, Checkerboard):
            ids, corners = checkerboard_corners(grey, target)
        else:
            tags, quadrilaterals, note = target_markers(grey, target)
            if isinstance(target, Charuco):
                ids, corners = charuco_corners(grey, target, tags, quadrilaterals)
            else:
                ids, corners = tag_corners(grey, target, tags, quadrilaterals)
        kept = inside(grey, corners, BORDER)
        ids, corners = ids[kept], corners[kept]
        blur = _checked_blur(grey, target, ids, corners)
    except Refusal as refusal:
        return Detection(*nothing, str(refusal), size, np.nan)
    return Detection(ids, corners, "", size, blur, note)


def read_image(image: str | os.PathLike | np.ndarray) -> Grey:
    """Grey levels of an image as the sensor took it; a turn that the file asks viewers for is not made."""
    if isinstance(image, np.ndarray):
        if image.ndim != 2 or image.dtype != np.uint8:
            raise InputError(
                f"the image is an array of shape {image.shape} and type {image.dtype}; give grey levels (height, "
                "width) of type uint8."
            )
        return image
    require("camera", "Detection of corners in images")
    import cv2

    content = getattr(image, "content", None)  # of a file that was read already
    if content is None:
        if not os.path.isfile(image):
            raise InputError(f"{image} does not exist; give the path of an image.")
        content = Path(image).read_bytes()
    data, (width, height) = np.frombuffer(content, dtype=np.uint8), picture_size(content) or (0, 0)
    readable = len(data) > 0 and width * height <= _MOST_PIXELS
    try:
        grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if readable else None
    except cv2.error:  # such as an image of billions of pixels
        grey = None
    if grey is None:
        raise InputError(
            f"{image} is not an image that OpenCV reads, is damaged, or has more than {_MOST_PIXELS // 10**6} million "
            "px; give a PNG or JPEG file."
        )
    return np.asarray(grey)


@checked_arguments
def overlay(image: str | os.PathLike | np.ndarray, detection: Detection, *, longest: int = 800) -> bytes:
    """A picture of an image with the corners that were found in it, and their ids or why it is refused.

    Args:
        image: Image file, or grey levels ``(height, width)``.
        detection: What was found in it, in px.
        longest: The larger side of the picture, px.

    Returns:
        The picture (JPEG).

    Raises:
        InputError: The file is not an image, or OpenCV is not installed.

    Example:
        >>> board, dark = aj.camera.Charuco(7, 5, 30.0, 22.0), np.zeros((480, 640), dtype=np.uint8)
        >>> picture = aj.camera.overlay(dark, aj.camera.detect(dark, board))
        >>> picture[6:10]
        b'JFIF'
    """
    require("camera", "A picture of detected corners")
    import cv2

    small, scale = _reduced(read_image(image), longest)
    picture = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    places = (detection.corners + 0.5) * scale - 0.5
    for number, (x, y) in enumerate(places):
        green = 255 * number // max(len(places) - 1, 1)  # from the first corner, red, to the last one, green
        cv2.circle(picture, (round(float(x)), round(float(y))), 4, (0, green, 255 - green), 1, cv2.LINE_AA)
    if detection.refused:
        for colour, thickness in (((0, 0, 0), 3), ((80, 80, 255), 1)):
            cv2.putText(picture, detection.refused[:90], (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, thickness)
    return jpeg(picture, 80)


def preview(image: str | os.PathLike | np.ndarray) -> bytes:
    """A small picture of an image, grey levels (JPEG), for a report."""
    return jpeg(_reduced(read_image(image), _PREVIEW)[0], 60)


def _reduced(grey: Grey, longest: int) -> tuple[np.ndarray, float]:
    """An image whose larger side has at most so many px, and its scale."""
    import cv2

    scale = min(longest / max(grey.shape), 1.0)
    size = [max(round(side * scale), 1) for side in grey.shape[::-1]]
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA)), scale


def jpeg(picture: np.ndarray, quality: int) -> bytes:
    """A picture as the content of a JPEG file; quality from 0 to 100."""
    import cv2

    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def _checked_blur(
    grey: Grey, target: AbstractTarget, ids: Int[np.ndarray, " k"], corners: Float[np.ndarray, "k 2"]
) -> float:
    """The blur of edges, px; refuses few corners, corners on a line, and an image that is out of focus or moved."""
    if len(ids) < FEWEST[target.kind]:
        fewest = f"at least {FEWEST[target.kind]} are needed"
        raise Refusal(f"{pluralise(len(ids), 'corner')} found, and {fewest}{why_nothing(grey)}")
    if on_one_line(target.points_of(ids)):
        raise Refusal(f"the {len(ids)} corners found are on one line")
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
            width = np.clip(free * length, 1.2, _WIDEST)
            found.append(float(np.median(blur_of(grey.astype(float), start, end, width))))
            limits.append(min(_BLURRED * float(np.median(length)), 0.7 * float(np.median(width)), _MOST_BLUR))
    if not found:
        return np.nan
    if any(blur > limit for blur, limit in zip(found, limits, strict=True)):
        moved = max(found) > _MOVED * min(found)
        cause = "the camera or the target moved" if moved else "it is out of focus"
        raise Refusal(f"{cause}: edges are blurred by {max(found):.1f} px (standard deviation)")
    return max(found)
