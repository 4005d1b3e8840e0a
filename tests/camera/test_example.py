"""The rendered example: its readings, images and truth belong together."""

import csv
import json

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.rotations import rotation_matrix
from aacmm_jax.data.cameras.camera import camera_models

from ..conftest import EXAMPLES

FOLDER = EXAMPLES / "webcam"


def frame(rotation, origin):
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation_matrix(np.array(rotation)), origin
    return transform


@pytest.mark.parametrize("number", [1, 9, 18])
def test_the_true_arm_and_camera_see_the_corners_that_are_detected(number):
    """Within the noise of the readings, 0.05 deg a joint, which is some px."""
    pytest.importorskip("cv2")
    truth = json.loads((FOLDER / "truth.json").read_text())
    board = aj.camera.Charuco(7, 5, 20.0, 15.0, "4x4_50", scale=truth["scale"])
    arm = aj.load_arm("so100").replace(**{k: np.array(v) for k, v in truth["parameters"].items()})
    row = list(csv.reader((FOLDER / "joints.csv").read_text().splitlines()))[number]
    camera = np.asarray(arm.pose(np.radians(np.array(row[1:], float)))) @ frame(truth["mount"][3:], truth["mount"][:3])
    still = np.linalg.inv(camera) @ frame(truth["board"][:3], truth["board"][3:])
    intrinsics = np.array(truth["intrinsics"])
    points = still[:3, :3] @ board.points.T + still[:3, 3:]
    seen = np.asarray(camera_models()["pinhole"].project(points, intrinsics[:, None]).values).T
    found = aj.camera.detect(FOLDER / "images" / row[0], board)
    assert len(found.ids) >= 20
    assert np.abs(found.corners - seen[found.ids]).max() < 5
    assert (FOLDER / "webcam.toml").read_text().count("4x4_50") == 1
