"""Boards as PDF: true to scale, on the paper asked for, with the markers of OpenCV."""

import re

import numpy as np
import pytest

from aacmm_jax.camera.drawing import marker_cells, patches_of
from aacmm_jax.camera.printing import PAPERS, bar_length, board_pdf
from aacmm_jax.data.targets import Charuco, Checkerboard, PointTable, TagGrid

from ..refusals import assert_refused

BOARD = Checkerboard(8, 5, 30.0)


def rectangles(pdf):
    """Left, upper, width and height of all that is black, mm from the upper left corner; and the size of the sheet."""
    text = pdf.decode("ascii")
    width, height = map(float, re.search(r"/MediaBox \[0 0 (\S+) (\S+)\]", text).groups())
    numbers = np.array([line.split()[:4] for line in text.splitlines() if line.endswith(" re")], dtype=float)
    numbers[:, 1] = height - numbers[:, 1] - numbers[:, 3]
    return numbers * 25.4 / 72, np.array([width, height]) * 25.4 / 72


def test_squares_and_the_bar_are_true_to_scale():
    black, sheet = rectangles(board_pdf(BOARD))
    np.testing.assert_allclose(sheet, (297, 210), atol=0.01)  # across
    squares, bar = black[:-1], black[-1]
    assert len(squares) == 20
    np.testing.assert_allclose(squares[:, 2:], 30.0, atol=1e-3)
    np.testing.assert_allclose(squares[1, :2] - squares[0, :2], (60, 0), atol=1e-3)
    assert bar[2] == pytest.approx(bar_length(BOARD), abs=1e-3)
    assert bar[1] > squares[:, 1].max() + 30


def test_what_is_printed_has_the_objects_that_its_table_says():
    pdf = board_pdf(BOARD)
    start = int(re.search(rb"startxref\n(\d+)", pdf)[1])
    assert pdf[start:].startswith(b"xref")
    for number, place in enumerate(re.findall(rb"^(\d{10}) 00000 n", pdf[start:], flags=re.MULTILINE), start=1):
        assert pdf[int(place) :].startswith(b"%d 0 obj" % number)


@pytest.mark.parametrize("board", [Charuco(5, 7, 30.0, 22.0), Charuco(6, 4, 30.0, 22.0, legacy=True)])
def test_the_print_of_a_charuco_board_is_that_of_opencv(board):
    cv2 = pytest.importorskip("cv2")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    theirs = cv2.aruco.CharucoBoard((board.columns, board.rows), board.size, board.marker, dictionary)
    theirs.setLegacyPattern(board.legacy)
    scale = 3
    image = theirs.generateImage((int(board.columns * board.size * scale), int(board.rows * board.size * scale)))
    (patch,) = patches_of(board)
    x, y = np.meshgrid(np.arange(0.75, board.columns * board.size, 1.5), np.arange(0.75, board.rows * board.size, 1.5))
    ours = np.zeros(x.shape, dtype=bool)
    margin = np.full(x.shape, np.inf)
    for left, upper, right, lower in patch.black:
        ours |= (x > left) & (x < right) & (y > upper) & (y < lower)
        for edge, across in ((left, x), (right, x), (upper, y), (lower, y)):
            margin = np.minimum(margin, np.abs(across - edge))
    clear = margin > 0.5  # mm: elsewhere their pixels are at an edge
    assert clear.mean() > 0.3
    theirs_black = image[(y * scale).astype(int), (x * scale).astype(int)] < 128
    np.testing.assert_array_equal(ours[clear], theirs_black[clear])


def test_tags_have_the_cells_of_their_dictionary():
    pytest.importorskip("cv2")
    cells = marker_cells("apriltag_36h11", 3)
    assert cells.shape == (8, 8)
    assert cells[0].all()
    grid = TagGrid(2, 1, 40.0, 10.0)
    black, _ = rectangles(board_pdf(grid))
    area = sum(1 - marker_cells("apriltag_36h11", tag)[::1].mean() for tag in (0, 1))
    assert (black[:-1, 2] * black[:-1, 3]).sum() == pytest.approx((2 - area) * 1600, rel=1e-4)


def test_paper_that_is_too_small_or_unknown_is_one_sentence():
    large = Checkerboard(12, 9, 30.0)
    assert_refused(lambda: board_pdf(large), "the board needs 400 x 327 mm with its margins", "choose a2")
    assert_refused(lambda: board_pdf(BOARD, "b4"), "the paper 'b4' is unknown", *PAPERS)
    assert_refused(lambda: board_pdf(PointTable(range(4), np.eye(4, 3))), "not a board that can be printed")
    black, sheet = rectangles(board_pdf(large, "500x400"))
    assert tuple(sheet.round(2)) == (500, 400)
    assert np.all(black[:, :2] > 5)
