"""What is printed of a target: black rectangles on white paper, which printing and rendering share."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.errors import InputError, require
from ..data.targets import DICTIONARIES, AbstractTarget, Charuco, Checkerboard

MARGIN = 5.0  # a tag, divided by it, is the white margin around it, which detection needs
Rectangles = Float[np.ndarray, "n 4"]  # left, upper, right and lower edge, mm


class Patch(NamedTuple):
    """A flat part of a target, with nominal sizes, in a frame of its own: x to the right, y down."""

    frame: Float[np.ndarray, "3 3"]  # columns: its axes x and y, and its origin (mm), in the frame of the target
    black: Rectangles
    paper: Float[np.ndarray, " 4"]  # the white sheet


def marker_cells(dictionary: str, marker: int) -> Bool[np.ndarray, "cells cells"]:
    """Which cells of a marker are black, its border included."""
    require("camera", "Drawing a marker")
    import cv2

    codes = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary.upper()}"))
    return codes.generateImageMarker(marker, DICTIONARIES[dictionary][0] + 2) == 0


def patches_of(target: AbstractTarget) -> list[Patch]:
    """The flat parts of a target: a board has one, tags on an object have one each.

    Raises:
        InputError: For points that are not the corners of tags.
    """
    dictionary, squares = getattr(target, "dictionary", ""), _squares(target)
    on_board, patches = [squares], []
    for marker, points in zip(*target.markers, strict=True):
        side = float(np.linalg.norm(points[1] - points[0]))
        cells = _cell_rectangles(marker_cells(dictionary, int(marker)), side)
        if target.kind == "points":
            axes = np.stack([points[1] - points[0], points[3] - points[0]], axis=1) / side
            patches.append(Patch(np.column_stack([axes, points[0]]), cells, _sheet(cells, side / MARGIN)))
        else:
            on_board.append(cells + np.tile(points[0, :2], 2))
    black = np.concatenate(on_board)
    if len(black):
        size = getattr(target, "size")  # noqa: B009 - all boards have one
        patches.append(Patch(np.diag([1.0, 1.0, 0.0]), black, _sheet(black, size / (2 if len(squares) else MARGIN))))
    if not patches:
        raise InputError("a table of points without a dictionary of tags has nothing to draw; give a board or tags.")
    return patches


def _squares(target: AbstractTarget) -> Rectangles:
    """The black squares of a checkerboard."""
    if not isinstance(target, Checkerboard | Charuco):
        return np.zeros((0, 4))
    white_first = isinstance(target, Charuco) and target.starts_white
    row, column = np.divmod(np.arange(target.columns * target.rows), target.columns)
    first = np.stack([column, row], axis=1)[(row + column) % 2 == white_first] * target.size
    # The first inner corner is one square away from the board's upper left corner, wherever the origin is.
    first = first + target.nominal[1][0, :2] - target.size
    return np.concatenate([first, first + target.size], axis=1)


def _cell_rectangles(black: Bool[np.ndarray, "cells cells"], side: float) -> Rectangles:
    """Black cells as rectangles, one for each run of them in a row."""
    edges = np.diff(np.pad(black, ((0, 0), (1, 1))).astype(int), axis=1)
    row, first = np.nonzero(edges == 1)
    last = np.nonzero(edges == -1)[1]
    return np.stack([first, row, last, row + 1], axis=1) * (side / len(black))


def _sheet(black: Rectangles, margin: float) -> Float[np.ndarray, " 4"]:
    return np.concatenate([black[:, :2].min(axis=0) - margin, black[:, 2:].max(axis=0) + margin])
