"""What an image shows at places: grey levels, corners that fit the target, or why nothing was found."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter, uniform_filter

from ..data.targets import AbstractTarget
from .consistency import misfits

Grey = UInt8[np.ndarray, "h w"]
FEWEST = {"checkerboard": 6, "charuco": 6, "tags": 4, "points": 4}  # corners

DARK = 25.0  # grey levels between the darkest and the brightest parts
BORDER = 3.0  # px: corners nearer to the border of the image are left out
_MISFIT, _LEAST_MISFIT = 0.05, 0.5  # of corners, in distances between neighbouring ones; and px
_MOST_MEDIANS = 5.0  # the most that a corner is off, divided by the median of all
_MOST_APART = 0.2  # the most corners that may be off
_BLURRED_IMAGE = 2.5  # px, of an image in which nothing was found


class Refusal(Exception):
    """The image is not used; the message says why."""


def why_nothing(grey: Grey) -> str:
    """What may be wrong with an image in which nothing was found."""
    low, high = np.percentile(grey[::4, ::4], [1, 99])
    if high < 2 * DARK:
        return ": it is too dark"
    if low > 255 - 2 * DARK:
        return ": it is overexposed"
    if high - low < DARK:
        return ": it has no contrast"
    levels = grey.astype(float)
    span, blurs = maximum_filter(levels, 15) - minimum_filter(levels, 15), []
    for slope in map(np.abs, np.gradient(gaussian_filter(levels, 0.7))):
        steepest = slope >= np.quantile(slope, 0.998)
        blurs.append(float(np.median(span[steepest] / np.maximum(slope[steepest], 1e-9)) / np.sqrt(2 * np.pi)))
    return f": it is blurred by {max(blurs):.1f} px (standard deviation)" if max(blurs) > _BLURRED_IMAGE else ""


def levels_at(grey: Grey, places: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
    """Grey levels at places, of nine pixels each."""
    smooth = uniform_filter(grey.astype(float), 3)
    return map_coordinates(smooth, places.T[::-1], order=1, mode="nearest")


def inside(grey: Grey, places: Float[np.ndarray, "k 2"], border: float) -> np.ndarray:
    """Whether places are in the image, and not near its border."""
    return np.all((places > border) & (places < np.array(grey.shape[::-1]) - 1 - border), axis=1)


def fitting(
    target: AbstractTarget,
    ids: Int[np.ndarray, " k"],
    corners: Float[np.ndarray, "k 2"],
    spacing: float,
    size: tuple[int, ...],
) -> Bool[np.ndarray, " k"]:
    """Which corners are where the target has them; those beside what hides the target in part are not.

    Refuses the image where many are not, though their order is right.
    """
    points, kept = target.points_of(ids), np.arange(len(ids))
    while len(kept):
        misfit = misfits(points[kept], corners[kept], size)
        worst = misfit.max()
        if worst <= max(_MOST_MEDIANS * float(np.median(misfit)), _LEAST_MISFIT):
            break
        kept = np.delete(kept, np.argmax(misfit))
    if len(kept) < (1 - _MOST_APART) * len(ids) or (len(kept) and worst > max(_MISFIT * spacing, 2 * _LEAST_MISFIT)):
        raise Refusal(
            f"corners are {misfits(points, corners, size).max():.1f} px from where the target has them: the sizes "
            "stated are not in the right ratio, it is hidden in part, or a board is not flat"
        )
    return np.isin(np.arange(len(ids)), kept)
