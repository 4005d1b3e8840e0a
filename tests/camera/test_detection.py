"""Corners in rendered images: where they are found, and which images are refused and why."""

import numpy as np
import pytest

from aacmm_jax.camera.consistency import misfits
from aacmm_jax.camera.detection import detect, overlay, read_image
from aacmm_jax.camera.rendering import render
from aacmm_jax.data.targets import Charuco, Checkerboard, PointTable, TagGrid

from ..refusals import assert_refused
from .scenes import PINHOLE, SIZE, TARGETS, scene

cv2 = pytest.importorskip("cv2")


def errors(detection, target, true):
    """How far corners are from where they are, px."""
    assert not detection.refused
    order = np.argsort(target.ids)
    return detection.corners - true[order[np.searchsorted(target.ids[order], detection.ids)]]


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 12), marks=pytest.mark.slow)], ids=["2", "10"])
@pytest.mark.parametrize("name", TARGETS)
def test_corners_are_found_without_bias_and_in_their_order(name, seeds):
    """Any turn about the line of sight."""
    target = TARGETS[name]
    found = np.concatenate([errors(detect(image, target), target, true) for image, true in
                            (scene(target, seed) for seed in seeds)])  # fmt: skip
    assert len(found) >= len(seeds) * (4 if name == "cube" else len(target.ids) - 2)
    assert np.all(np.abs(found.mean(axis=0)) < 0.05)
    assert np.abs(found).max() < 1.0
    assert np.sqrt(np.mean(found**2)) < 0.12


@pytest.mark.slow
@pytest.mark.parametrize("name", ["checkerboard", "charuco", "april"])
def test_a_fisheye_camera_bends_boards_without_making_them_others(name):
    target = TARGETS[name]
    image, true = scene(target, 3, model="fisheye", nearer=170.0)
    found = errors(detect(image, target), target, true)
    assert len(found) >= len(target.ids) - 4
    assert np.abs(found).max() < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_corners_that_a_wide_lens_bends_by_many_pixels_are_those_of_the_target(seed):
    """A corner that is taken for its neighbour is not."""
    target = TARGETS["charuco"]
    _, true = scene(target, seed, model="fisheye", nearer=270.0)
    near = np.all((true > -200) & (true < np.array(SIZE) + 200), axis=1)
    points, corners = target.points[near], true[near]
    assert misfits(points, corners, SIZE).max() < 0.5
    corners[[5, 6]] = corners[[6, 5]]
    assert misfits(points, corners, SIZE).max() > 5.0


def mirrored(target):
    return np.ascontiguousarray(scene(target)[0][:, ::-1])


def twice(target):
    transforms = np.stack([np.eye(4), np.eye(4)])
    transforms[:, :3, 3] = [-190.0, -40.0, 520.0], [20.0, -40.0, 520.0]
    return render((target, target), transforms, "pinhole", PINHOLE, SIZE)


CHECKERS, CHARUCO, TAGS = (TARGETS[name] for name in ("checkerboard", "charuco", "aruco"))
REFUSED = {
    "mirrored charuco": (CHARUCO, lambda: mirrored(CHARUCO), "17 markers of the target can be read in a mirror only"),
    "mirrored tags": (TAGS, lambda: mirrored(TAGS), "the print is mirrored"),
    "two checkerboards": (CHECKERS, lambda: twice(CHECKERS), "two checkerboards are seen"),
    "two boards": (CHARUCO, lambda: twice(CHARUCO), "two boards or a reflection: markers 0, 1, 2, 3, 4 and"),
    "other charuco": (CHARUCO, lambda: scene(Charuco(6, 5, 25.0, 18.0))[0], "it is another target"),
    "charuco for tags": (TAGS, lambda: scene(CHARUCO)[0], "it is another target"),
    "tags across": (TAGS, lambda: scene(TagGrid(3, 4, 36.0, 9.0, "4x4_50"))[0], "it is another target"),
    "other gap": (TAGS, lambda: scene(TagGrid(4, 3, 36.0, 6.0, "4x4_50"))[0], "the sizes stated are not in the right"),
    "other ids": (
        TAGS, lambda: scene(TagGrid(4, 3, 36.0, 9.0, "4x4_50", first=20))[0], "has markers 20, 21, 22, 23, 24 and 7"
    ),
    "smaller checkerboard": (CHECKERS, lambda: scene(Checkerboard(7, 4, 22.0))[0], "no checkerboard of 8 x 5 squares"),
    "defocus": (CHECKERS, lambda: scene(CHECKERS, blur=4.0)[0], "it is out of focus: edges are blurred by 3."),
    "defocused markers": (CHARUCO, lambda: scene(CHARUCO, blur=4.0)[0], "no marker of the target was found: it is"),
    "motion": (CHECKERS, lambda: scene(CHECKERS, 2, motion=4.0)[0], "moved: edges are blurred by"),
    "dark": (CHARUCO, lambda: scene(CHARUCO, black=5.0, white=12.0)[0], "it is too dark"),
    "bright": (CHARUCO, lambda: scene(CHARUCO, black=250.0, white=255.0, shading=0.0)[0], "it is overexposed"),
    "nothing": (CHARUCO, lambda: np.full(SIZE[::-1], 100, dtype=np.uint8), "it has no contrast"),
    "cut": (CHECKERS, lambda: np.ascontiguousarray(scene(CHECKERS)[0][:, :330]), "squares"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", REFUSED)
def test_an_image_that_would_be_misread_is_refused(case):
    target, image, reason = REFUSED[case]
    detection = detect(image(), target)
    assert reason in detection.refused
    assert len(detection.ids) == len(detection.corners) == 0


@pytest.mark.slow
@pytest.mark.parametrize("columns", [9, 10])
@pytest.mark.parametrize("seed", range(2))
def test_a_larger_checkerboard_is_never_taken_for_the_stated_one(columns, seed):
    assert detect(scene(Checkerboard(columns, 15 - columns, 22.0), seed)[0], CHECKERS).refused


@pytest.mark.slow
def test_hidden_corners_are_absent_and_the_others_are_right():
    image, true = scene(CHARUCO, 1)
    x, y = true[8].astype(int)
    image[y - 25 : y + 25, x - 25 : x + 25] = 90
    detection = detect(image, CHARUCO)
    assert 8 not in detection.ids
    assert len(detection.ids) >= 16
    assert np.abs(errors(detection, CHARUCO, true)).max() < 0.5


@pytest.mark.slow
def test_a_marker_of_another_target_is_said_and_not_used():
    image, true = scene(TAGS, 1)
    image[380:480, :100] = 255
    code = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 40, 48)
    image[410:458, 26:74] = code
    detection = detect(image, TAGS)
    assert detection.note == "not on the target: marker 40"
    assert np.abs(errors(detection, TAGS, true)).max() < 0.6


@pytest.mark.slow
def test_a_file_is_read_as_the_sensor_took_it_and_another_size_is_refused(tmp_path):
    image, _ = scene(CHARUCO)
    path = tmp_path / "image.png"
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    np.testing.assert_array_equal(read_image(path), image)
    assert detect(path, CHARUCO, image_size=SIZE).size == SIZE
    refused = detect(path, CHARUCO, image_size=(1280, 720)).refused
    assert refused == "it has 640 x 480 px, but the intrinsics of the camera are for 1280 x 720 px"


@pytest.mark.slow
def test_a_picture_shows_corners_and_reasons():
    image, _ = scene(CHARUCO)
    pictures = [
        cv2.imdecode(np.frombuffer(overlay(each, detect(each, CHARUCO), longest=320), np.uint8), cv2.IMREAD_COLOR)
        for each in (image, mirrored(CHARUCO))
    ]
    assert all(picture.shape == (240, 320, 3) for picture in pictures)
    assert all((np.ptp(picture.astype(int), axis=2) > 60).sum() > 50 for picture in pictures)  # colours


def test_what_cannot_be_recognised_is_one_sentence(tmp_path):
    image = np.zeros(SIZE[::-1], dtype=np.uint8)
    (tmp_path / "text.png").write_text("no image")
    assert_refused(lambda: detect(image, Checkerboard(9, 7, 20.0)), "9 x 7 squares looks the same after half a turn")
    assert_refused(lambda: detect(image, PointTable(range(4), np.eye(4, 3))), "without a dictionary of tags")
    assert_refused(lambda: detect(np.zeros((9, 9, 3), dtype=np.uint8), CHARUCO), "shape (9, 9, 3) and type uint8")
    assert_refused(lambda: detect(tmp_path / "none.png", CHARUCO), "does not exist")
    assert_refused(lambda: detect(tmp_path / "text.png", CHARUCO), "is not an image")
