"""Rendered images: black and white where the target is, the same for the same seed, and wrong cameras."""

import numpy as np
import pytest

from aacmm_jax.camera.rendering import Optics, render
from aacmm_jax.data.targets import Checkerboard

from ..refusals import assert_refused
from .scenes import PINHOLE, SIZE, scene

BOARD = Checkerboard(8, 5, 22.0)


def test_squares_are_black_and_white_around_their_corners():
    image, corners = scene(BOARD, 2)
    grid = corners.reshape(4, 7, 2)
    middles = (grid[:-1, :-1] + grid[1:, 1:]) / 2
    levels = image[tuple(middles.round().astype(int).reshape(-1, 2).T[::-1])].reshape(3, 6)
    black = (np.add.outer(np.arange(3), np.arange(6)) % 2) == 0  # that on the lower right of the first corner
    assert levels[black].max() < 60 < 120 < levels[~black].min()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_image_and_a_scale_moves_corners():
    image, corners = scene(BOARD, 2)
    again, _ = scene(BOARD, 2)
    np.testing.assert_array_equal(image, again)
    larger = BOARD.scaled_by_bar(100.0, 101.0, 0.0)
    assert np.abs(scene(larger, 2)[1] - corners).max() > 0.5


def test_a_board_seen_from_behind_is_not_drawn():
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind[:3, 3] = 70.0, -40.0, 400.0
    image = render(BOARD, behind, "pinhole", PINHOLE, SIZE, optics=Optics(noise=0.0), seed=1)
    nothing = render((), np.zeros((0, 4, 4)), "pinhole", PINHOLE, SIZE, optics=Optics(noise=0.0), seed=1)
    np.testing.assert_array_equal(image, nothing)


def test_a_camera_without_images_is_one_sentence():
    assert_refused(lambda: render(BOARD, np.eye(4), "points", np.zeros(0), SIZE), "makes no images")
    assert_refused(lambda: render(BOARD, np.eye(4), "pinhole", PINHOLE[:3], SIZE), "has 3 intrinsics")
    huge = (10**6, 10**6)
    assert_refused(lambda: render(BOARD, np.eye(4), "pinhole", PINHOLE, huge), "1000000 x 1000000 px", "image_size")
