"""Targets: the corners of OpenCV's boards, keys of a manifest, the measured bar, and wrong ones."""

import numpy as np
import pytest

from aacmm_jax.core.errors import InputError
from aacmm_jax.data.targets import DICTIONARIES, Charuco, Checkerboard, PointTable, TagGrid, keys_of_target, target_of

SQUARE = np.array([[0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0]], dtype=float)
BOARDS = [
    Checkerboard(8, 5, 30.0),
    Charuco(7, 5, 30.0, 22.0),
    Charuco(6, 4, 30.0, 22.0, "5x5_50", legacy=True),
    TagGrid(4, 3, 40.0, 10.0, "36h11", first=7),
]


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
def test_a_board_has_one_point_for_each_id_and_is_what_its_keys_make(board):
    assert len(np.unique(board.ids)) == len(board.ids) == len(board.points)
    assert board.is_planar
    assert np.ptp(board.points[:, 2]) == 0
    assert target_of(**keys_of_target(board)) == board


@pytest.mark.parametrize(("columns", "rows"), [(7, 5), (6, 4), (5, 6), (4, 7)])
@pytest.mark.parametrize("legacy", [False, True])
def test_a_charuco_board_is_that_of_opencv(columns, rows, legacy):
    cv2 = pytest.importorskip("cv2")
    board = Charuco(columns, rows, 30.0, 22.0, "6x6_250", legacy)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
    theirs = cv2.aruco.CharucoBoard((columns, rows), 30.0, 22.0, dictionary)
    theirs.setLegacyPattern(legacy)
    np.testing.assert_allclose(board.points, theirs.getChessboardCorners(), rtol=1e-6)
    np.testing.assert_array_equal(board.markers[0], np.ravel(theirs.getIds()))
    np.testing.assert_allclose(board.markers[1], theirs.getObjPoints(), rtol=1e-6)


def test_a_grid_and_the_dictionaries_are_those_of_opencv():
    cv2 = pytest.importorskip("cv2")
    for name, (cells, count) in DICTIONARIES.items():
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))
        assert (dictionary.markerSize, len(dictionary.bytesList)) == (cells, count)
    theirs = cv2.aruco.GridBoard((4, 3), 40.0, 10.0, dictionary)
    grid = TagGrid(4, 3, 40.0, 10.0)
    np.testing.assert_allclose(grid.points, np.reshape(theirs.getObjPoints(), (-1, 3)), rtol=1e-6)


def test_a_measured_bar_scales_all_points_and_states_their_relative_uncertainty():
    board = target_of("checkerboard", squares=[8, 5], size=30.0, bar={"nominal": 150, "measured": 149.7, "u": 0.06})
    np.testing.assert_allclose(board.points, 0.998 * Checkerboard(8, 5, 30.0).points)
    assert board.u_scale == pytest.approx(4e-4)


def test_tags_on_a_cube_are_a_table_of_points():
    other = SQUARE[:, [2, 0, 1]] + [0, 0, 45.0]
    cube = PointTable([4, 5, 6, 7, 15, 14, 13, 12], np.concatenate([SQUARE, other[::-1]]), "4x4_50")
    assert not cube.is_planar
    np.testing.assert_array_equal(cube.markers[0], [1, 3])
    np.testing.assert_array_equal(cube.markers[1], [SQUARE, other])


WRONG = [
    (lambda: Checkerboard(8, 5, 0.03), "0.03 mm; sizes are in mm, so 0.03 m are 30"),
    (lambda: Checkerboard(8, 2, 30.0), "rows of the target 'checkerboard' is 2; it must be at least 3"),
    (lambda: Charuco(7, 5, 30.0, 31.0), "does not fit into a square of 30 mm"),
    (lambda: Charuco(7, 5, 30.0, 22.0, "4x4_51"), "did you mean '4x4_50'"),
    (lambda: TagGrid(10, 10, 30.0, 5.0, "16h5"), "has the markers 0 to 29; choose a larger dictionary"),
    (lambda: PointTable([0, 1, 2, 2], SQUARE), "3 different ids; give at least 4 points"),
    (lambda: PointTable([0, 1, 2, 3.5], SQUARE), "whole numbers from 0"),
    (lambda: PointTable([0, 1, 2, 5], SQUARE, "4x4_50"), "lacks a corner of tag 0"),
    (lambda: Checkerboard(8, 5, 30.0).scaled_by_bar(150.0, 0.15, 0.1), "not that far from its scale"),
    (lambda: target_of("charuco", squares=[7, 5], size=30.0), "marker of the target 'charuco' is missing"),
    (lambda: target_of("tags", tags=4, size=30.0, gap=5.0), r"tags of the target 'tags' is 4; give \[columns, rows\]"),
    (lambda: target_of("tags", squares=[4, 5]), "has no key 'squares'"),
    (lambda: target_of("checkerboard", squares=[8, 5], size=30.0, bar={"nominal": 1}), "nominal, measured and u"),
    (lambda: target_of("board"), "did you mean 'checkerboard'"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "sentence"), WRONG, ids=[sentence for _, sentence in WRONG])
def test_a_wrong_target_is_one_sentence(make, sentence):
    with pytest.raises(InputError, match=sentence):
        make()
