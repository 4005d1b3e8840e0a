"""The rendered example: its readings, images and what they were made of belong together."""

import csv

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.reprojection import frame_of
from aacmm_jax.data.cameras.camera import camera_models

from ..conftest import EXAMPLES

FOLDER = EXAMPLES / "webcam"


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 9, 18])
def test_the_true_arm_and_camera_see_the_corners_that_are_detected(number):
    """Within the noise of the readings, 0.05 deg a joint, which is some px."""
    pytest.importorskip("cv2")
    [item] = aj.files.read_kit(FOLDER / "kit.toml")
    truth, board = item.simulated, aj.camera.Charuco(7, 5, 20.0, 15.0, "4x4_50", scale=0.998)
    nominal = aj.files.load_specification("so100")
    arm = aj.perturbed_arm(nominal.space(), length=1.0, angle=np.radians(1.0), seed=7).replace(probe=np.zeros(3))
    row = list(csv.reader((FOLDER / "webcam.csv").read_text().splitlines()))[number]
    mount = frame_of(np.concatenate([truth.mount[3:], truth.mount[:3]]))
    still = np.linalg.inv(np.asarray(arm.pose(np.radians(np.array(row[1:], float)))) @ mount) @ frame_of(truth.frame)
    points = still[:3, :3] @ board.points.T + still[:3, 3:]
    seen = np.asarray(camera_models()["pinhole"].project(points, truth.intrinsics[:, None]).values).T
    found = aj.camera.detect(FOLDER / "webcam" / row[0], board)
    assert len(found.ids) >= 20
    assert np.abs(found.corners - seen[found.ids]).max() < 5
    assert (FOLDER / "webcam.toml").read_text().count("4x4_50") == 1
