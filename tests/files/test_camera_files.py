"""Cameras and mounts in the formats of ROS and OpenCV: read, written, and refused."""

import json

import numpy as np
import pytest

from aacmm_jax.files.camera_files import (
    StoredCamera,
    camera_info_yaml,
    joint_origin,
    matrix_text,
    read_camera,
    static_transform,
    transform_storage,
)
from tests.refusals import assert_refused

PINHOLE = [600.5, 601.25, 319.5, 239.5]
MATRIX = [600.5, 0, 319.5, 0, 601.25, 239.5, 0, 0, 1]
OPENCV = """%YAML:1.0
---
calibration_time: "Mon 01 Jan"
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 600.5, 0., 319.5, 0.,
       601.25, 239.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -1.0e-01, 2.0e-02, 0., 0., 0. ]
"""
MESSAGE = """header:
  stamp:
    sec: 0
  frame_id: webcam
height: 480
width: 640
distortion_model: equidistant
d:
- 0.1
- 0.2
- 0.0
- -0.1
k: [600.5, 0, 319.5, 0, 601.25, 239.5, 0, 0, 1]
binning_x: 0
"""
FLOW = """{image_width: 640, image_height: 480, camera_name: webcam,
  camera_matrix: {rows: 3, cols: 3, data: [600.5, 0, 319.5, 0, 601.25, 239.5, 0, 0, 1]},
  distortion_model: plumb_bob, distortion_coefficients: {rows: 1, cols: 5, data: [-1.0e-1, 0.02, 0, 0, 0]}}
"""


@pytest.mark.parametrize(
    ("model", "distortion"),
    [("pinhole", []), ("pinhole", [-0.1, 0.2, 1e-3, 2e-4]), ("pinhole", [-0.1, 0.2, 1e-3, 2e-4, 0.05]),
     ("pinhole", [-0.1, 0.2, 1e-3, 2e-4, 0.05, 0.1, 0.2, 0.3]), ("fisheye", [0.1, 0.2, 0.3, -0.4])],
)  # fmt: skip
def test_camera_info_comes_back(tmp_path, model, distortion):
    camera = StoredCamera(model, np.array(PINHOLE + distortion), (640, 480))
    (tmp_path / "camera.yaml").write_text(camera_info_yaml("a webcam", camera))
    read = read_camera(tmp_path / "camera.yaml")
    count = len(camera.values)
    assert (read.model, read.image_size) == (model, (640, 480))
    np.testing.assert_array_equal(read.values[:count], camera.values)
    assert not np.any(read.values[count:])


@pytest.mark.parametrize(
    ("name", "text", "model", "distortion"),
    [
        ("camera.yml", OPENCV, "pinhole", [-0.1, 0.02, 0, 0, 0]),
        ("flow.yaml", "---\n" + FLOW, "pinhole", [-0.1, 0.02, 0, 0, 0]),
        ("flow.yaml", FLOW, "pinhole", [-0.1, 0.02, 0, 0, 0]),
        ("message.yaml", MESSAGE, "fisheye", [0.1, 0.2, 0.0, -0.1]),
        ("camera.json", json.dumps({"image_width": 640, "image_height": 480, "dist": [[0.1, 0, 0, 0]],
                                    "mtx": np.reshape(MATRIX, (3, 3)).tolist()}), "pinhole", [0.1, 0, 0, 0]),
        ("camera.json", json.dumps({"width": 640, "height": 480, "distortion_coefficients": {"data": [0] * 14},
                                    "camera_matrix": {"rows": 3, "data": MATRIX}}), "pinhole", [0] * 8),
    ],
)  # fmt: skip
def test_other_formats_are_read(tmp_path, name, text, model, distortion):
    (tmp_path / name).write_text(text)
    read = read_camera(tmp_path / name)
    assert (read.model, read.image_size) == (model, (640, 480))
    np.testing.assert_array_equal(read.values, [*PINHOLE, *distortion])


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("camera_matrix", "projection", "no camera matrix"),
        ("600.5, 0.,", "600.5, 1.,", "not [fx 0 cx"),
        ("600.5,", "six,", "'six'"),
        ("[ -1.0e-01, 2.0e-02, 0., 0., 0. ]", "[ 1., 2., 3. ]", "3 distortion coefficients"),
        ("image_width: 640", "image_width: 640.5", "image size"),
    ],
)
def test_a_camera_that_makes_no_sense_is_refused(tmp_path, old, new, says):
    assert old in OPENCV
    (tmp_path / "camera.yml").write_text(OPENCV.replace(old, new))
    assert_refused(lambda: read_camera(tmp_path / "camera.yml"), "camera.yml", says)


def test_a_frame_is_the_same_in_every_format():
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, (10, -20, 30)
    assert 'xyz="0.01 -0.02 0.03"' in joint_origin("tool0", "cam", matrix)
    assert 'rpy="0.0 0.0 1.57079632679"' in joint_origin("tool0", "cam", matrix)
    assert "--x 0.01 --y -0.02 --z 0.03 --qx 0.0 --qy 0.0 --qz 0.707106781187" in static_transform("a", "b", matrix)
    rows = matrix_text("a", "b c", matrix).splitlines()
    assert rows[0] == "# b_c in a, mm"
    np.testing.assert_allclose([list(map(float, row.split())) for row in rows[1:]], matrix)


def test_opencv_reads_a_frame(tmp_path):
    cv2 = pytest.importorskip("cv2")
    matrix = np.vstack([np.random.default_rng(0).normal(size=(3, 4)), [0, 0, 0, 1]])
    (tmp_path / "frame.yml").write_text(transform_storage("tool0", "cam", matrix))
    storage = cv2.FileStorage(str(tmp_path / "frame.yml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(storage.getNode("transform").mat(), matrix, rtol=1e-11)
