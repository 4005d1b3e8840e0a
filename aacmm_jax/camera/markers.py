"""Markers in an image: those of the target, with the corners of tags refined."""

import numpy as np
from jaxtyping import Float, Int

from ..core.text import pluralise, shorten
from ..data.targets import DICTIONARIES, AbstractTarget
from .consistency import misfits
from .edges import blur_of, cell_thickness, refined_tags
from .evidence import Grey, Refusal, fitting, why_nothing

_FAR = 0.3  # of the side of a marker: one that is farther from where the target has it is another one
_LEAST_FAR = 3.0  # px
_MOST_LEFT_OUT = 1 / 3  # of the markers
_CELL_BLURS = 3.2  # the least size of the cells of a tag, in standard deviations of the blur


def target_markers(grey: Grey, target: AbstractTarget) -> tuple[np.ndarray, np.ndarray, str]:
    """Ids and corners of the target's markers that agree with its layout, and what else was seen."""
    tags, corners = _decoded(grey, target)
    ours = np.isin(tags, target.markers[0])
    known = target.markers[0]
    if ours.sum() < 4:
        mirrored = np.isin(_decoded(np.ascontiguousarray(grey[:, ::-1]), target)[0], known).sum()
        if mirrored > ours.sum():
            raise Refusal(
                f"{pluralise(int(mirrored), 'marker')} of the target can be read in a mirror only: the image or the "
                "print is mirrored"
            )
    strangers = _named(np.unique(tags[~ours]).tolist())
    if not ours.any():
        if strangers:
            raise Refusal(f"another target is seen: it has {strangers}, and this one {_range(known)}")
        raise Refusal(f"no marker of the target was found{why_nothing(grey)}")
    tags, corners = tags[ours], corners[ours]
    twice = [int(tag) for tag, count in zip(*np.unique(tags, return_counts=True), strict=True) if count > 1]
    if twice:
        raise Refusal(f"two boards or a reflection: {_named(twice)} seen twice")
    tags, corners, left_out = _agreeing(target, tags, corners, grey.shape[::-1])
    notes = [f"not on the target: {strangers}"] if strangers else []
    notes += [f"not used, since not where the target has it: {_named(left_out)}"] if left_out else []
    return tags, corners, "; ".join(notes)


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
    target: AbstractTarget, tags: Int[np.ndarray, " t"], corners: Float[np.ndarray, "t 4 2"], size: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Markers that are where the target has them, and the ids of those that are not: some background looks like one.

    The one that is farthest from where the others have it is left out, until all agree.
    """
    points = target.markers[1][np.searchsorted(target.markers[0], tags)]
    kept = np.arange(len(tags))
    while True:
        limit = max(_FAR * float(np.median(_sides(corners[kept]))), _LEAST_FAR)
        misfit = misfits(points[kept].reshape(-1, 3), corners[kept].reshape(-1, 2), size).reshape(-1, 4).max(axis=1)
        if misfit.max() <= limit:
            return tags[kept], corners[kept], np.delete(tags, kept).tolist()
        if len(kept) - 1 < (1 - _MOST_LEFT_OUT) * len(tags):
            raise Refusal(
                "the markers are not where the target has them: it is another target, or its layout is stated wrongly"
            )
        kept = np.delete(kept, np.argmax(misfit))


def tag_corners(
    grey: Grey, target: AbstractTarget, tags: Int[np.ndarray, " t"], corners: Float[np.ndarray, "t 4 2"]
) -> tuple[np.ndarray, np.ndarray]:
    """The corners of tags whose cells are large enough to tell their edges apart."""
    image, cells = grey.astype(float), DICTIONARIES[getattr(target, "dictionary")][0] + 2  # noqa: B009
    corners = refined_tags(image, corners, cells)
    thickness = cell_thickness(corners, cells)
    blur = np.median(blur_of(image, corners, np.roll(corners, -1, axis=1), 0.7 * np.maximum(thickness, 2.0)), axis=1)
    large = thickness.min(axis=1) > _CELL_BLURS * blur
    if not large.any():
        raise Refusal(
            f"the tags are too small or too blurred: their cells have {thickness.min(axis=1).max():.1f} px, and edges "
            f"are blurred by {blur.min():.1f} px (standard deviation)"
        )
    ids, corners = (4 * tags[large, None] + np.arange(4)).ravel(), corners[large]
    corners, spacing = corners.reshape(-1, 2), float(np.median(_sides(corners)))
    kept = fitting(target, ids, corners, spacing, grey.shape[::-1])
    return ids[kept], corners[kept]


def _sides(corners: Float[np.ndarray, "t 4 2"]) -> Float[np.ndarray, "t 4"]:
    """Lengths of the sides of markers, px."""
    return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)


def _named(tags: list[int]) -> str:
    """Markers in words; nothing where there are none."""
    word = "marker" if len(tags) == 1 else "markers"
    return f"{word} {shorten([str(tag) for tag in tags])}" if tags else ""


def _range(tags: Int[np.ndarray, " t"]) -> str:
    """Ids in words."""
    return f"{tags.min()} to {tags.max()}" if len(tags) > 1 else str(tags[0])
