"""Where a calibration says that a camera is in the links of a URDF, against an independent reader of URDF: corners are
projected by the exported robot and frames, and are where the camera saw them."""

import json
import re

import numpy as np
import pytest
import yourdfpy
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.files.arms import read_arm
from aacmm_jax.summaries.calibration import calibration_summary

from ..files.test_urdf import FILE, JOINTS

LENS = np.array([600.0, 610.0, 319.5, 239.5])
FREE = ("theta_2", "theta_3", "alpha_4", "a_3", "d_5")
TURNED = '<joint name="to_world" type="fixed"><origin xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"/>'
NUMBER = r"[-−]?\d[\d.]*(?:e-?\d+)?"


pytestmark = pytest.mark.slow  # in the suite, tests/summaries/test_camera_rows.py


@pytest.fixture(scope="module", params=["tip link", "moving link", "tool"])
def calibrated(request, tmp_path_factory):
    """A calibration of an arm from a URDF whose base is turned: up to a link that a fixed joint bears, up to one that
    moves, or with a tool beyond the tip link."""
    folder = tmp_path_factory.mktemp("urdf")
    (folder / "robot.urdf").write_text(FILE.read_text().replace('<joint name="to_world" type="fixed">', TURNED))
    links = {"base": "world", "tip": "flange" if request.param == "moving link" else "tool0"}
    tool = {"probe": (10.0, 20.0, 100.0)} if request.param == "tool" else {}
    nominal = read_arm(folder / "robot.urdf", **links, **tool)[0]
    names = aj.Parameters.free_of(nominal.arm, held=()).names
    nominal = nominal._replace(held=tuple(name for name in names if name not in FREE), free=())
    true = aj.perturbed_arm(nominal.space(), length=1.0, angle=0.005, seed=1)
    board = aj.camera.target_of("checkerboard", squares=[6, 5], size=30.0)
    eye = aj.data.observations.SimulatedPixels(
        "eye", 8, "webcam", "board", board.points, LENS, (640, 480), frame=(np.pi, 0, 0, 500, -100, 0),
        mount=(30, -10, 20, 0.1, 0.2, 0.3), distance=(200, 400), u=0.001,
    )  # fmt: skip
    capture = aj.simulate(true, {}, observations=[eye], seed=1)
    noise = aj.Noise(encoder_arcsec=1.0, seating=0.001)
    record = aj.calibrate_capture(aj.Recording(capture, nominal), automatic=False, cross_validate=False, noise=noise)
    aj.files.save_calibration(folder / "c.h5", record, calibration_summary(record))
    assert set(record.names) == set(FREE)
    return folder, links, capture.observations[0]


def frames(aacmm, folder, *options):
    """The frame of a format, as 4 x 4 matrix in m, and what it is of and in."""
    written = {
        form: aacmm("export", folder / "c.h5", "--format", form, *options).stdout
        for form in ("static-transform", "matrix", "opencv", "joint-origin")
    }
    x = dict(re.findall(r"--([\w-]+) (\S+)", written["static-transform"]))
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_quat([float(x[key]) for key in ("qx", "qy", "qz", "qw")]).as_matrix()
    frame[:3, 3] = [float(x[key]) for key in "xyz"]
    rows = [line.split() for line in written["matrix"].splitlines() if not line.startswith("#")]
    in_mm = frame * np.array([1, 1, 1, 1000])[None, :] ** np.array([1, 1, 1, 0])[:, None]
    np.testing.assert_allclose(np.array(rows, float), in_mm, atol=1e-8)
    of_opencv = re.search(r"transform:.*?data: \[(.*?)\]", written["opencv"], re.DOTALL)
    np.testing.assert_allclose(np.array(of_opencv[1].split(","), float).reshape(4, 4), in_mm, atol=1e-8)
    return frame, written["joint-origin"], (x["child-frame-id"], x["frame-id"])


@pytest.mark.slow
def test_the_exported_robot_and_camera_see_the_corners(aacmm, calibrated, tmp_path):
    folder, links, seen = calibrated
    _, joint, named = frames(aacmm, folder)
    assert named == ("webcam", links["tip"])
    place, _, named = frames(aacmm, folder, "--frame", "place")
    assert named == ("board", "world")
    aacmm("export", folder / "c.h5", "-o", "robot.urdf", "--overwrite")
    text = (tmp_path / "robot.urdf").read_text()
    (tmp_path / "with_camera.urdf").write_text(text.replace("</robot>", f'<link name="webcam"/>{joint}</robot>'))
    robot = yourdfpy.URDF.load(str(tmp_path / "with_camera.urdf"), load_meshes=False, build_scene_graph=True)
    for pose, row in enumerate(np.asarray(seen.q)):
        robot.update_cfg(dict(zip(JOINTS, row, strict=True)))
        board_in_camera = np.linalg.inv(robot.get_transform("webcam", "world")) @ place
        points = board_in_camera[:3, :3] @ np.asarray(seen.points)[pose].T / 1000 + board_in_camera[:3, 3:]
        corners = LENS[:2, None] * points[:2] / points[2] + LENS[2:, None]
        np.testing.assert_allclose(corners.T, np.asarray(seen.corners)[pose], atol=0.02)


@pytest.mark.slow
def test_what_is_printed_is_what_is_exported(aacmm, calibrated):
    folder, links, _ = calibrated
    [row] = json.loads(aacmm("show", folder / "c.h5", "--json").stdout)["cameras"]
    shown = aacmm("show", folder / "c.h5").stdout
    for of, kind, link in (("webcam", "mount", links["tip"]), ("board", "place", "world")):
        frame, joint, _ = frames(aacmm, folder, "--frame", kind)
        part = row[kind]
        assert (part["of"], part["in"]) == (of, link)
        xyz, rpy = (np.array(re.search(f'{key}="(.*?)"', joint)[1].split(), float) for key in ("xyz", "rpy"))
        np.testing.assert_allclose(xyz, frame[:3, 3], atol=1e-9)
        np.testing.assert_allclose(Rotation.from_euler("xyz", rpy).as_matrix(), frame[:3, :3], atol=1e-9)
        np.testing.assert_allclose(part["position_mm"], 1000 * xyz, atol=1e-6)
        line = next(line for line in shown.splitlines() if re.match(rf"{of} +{link} ", line))
        numbers = [float(x.replace("−", "-")) for x in re.findall(NUMBER, line.split(link, 1)[1])]
        np.testing.assert_allclose(numbers[:3], 1000 * xyz, atol=0.06)
        np.testing.assert_allclose(numbers[4:7], np.degrees(rpy), atol=0.06)
