"""The command line with a camera: hand-eye calibration with the arm as it is, what is printed of it, and exports."""

import json

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.rotations import rotation_matrix

MOUNT = (60.0, -10.0, 20.0, 0.1, 0.2, 0.3)  # mm, rad
FRAME = (np.pi, 0, 0, -700, -200, 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture of a UR10e with a camera on its flange, and of one with the board there."""
    folder = tmp_path_factory.mktemp("cameras")
    board = aj.camera.target_of("charuco", squares=[6, 5], size=30.0, marker=22.0)
    nominal = aj.files.load_specification("ur10e")
    for name, on_arm, frame, mount in (
        ("on-arm", True, FRAME, MOUNT),
        ("fixed", False, (np.pi, 0, 0, -700, -200, 900), (0, 0, 30, 0, 0, 0)),
    ):
        eye = aj.data.observations.SimulatedPixels(
            "eye", 12, "webcam", "board", board.points, (600.0, 610.0, 319.5, 239.5), (640, 480), on_arm=on_arm,
            frame=frame, mount=mount, distance=(250, 500), u=0.2,
        )  # fmt: skip
        capture = aj.simulate(nominal.arm, {}, observations=[eye], seed=1)
        aj.files.save_capture(folder / f"{name}.h5", aj.Recording(capture, nominal))
    return folder


@pytest.mark.slow
def test_hand_eye_calibration(aacmm, folder, tmp_path):
    shown = aacmm("calibrate", folder / "on-arm.h5", "-o", "c.h5", "--arm-fixed").stdout
    for part in ("with the arm as it is", "reprojection error 0.", "at the target", "mount of webcam", "exact"):
        assert part in " ".join(shown.split())
    assert "Parameters" not in shown
    (row,) = json.loads(aacmm("show", "c.h5", "--json").stdout)["cameras"]
    mount, place = row["mount"], row["place"]
    assert np.linalg.norm(np.subtract(mount["position_mm"], MOUNT[:3])) < 4 * mount["position_u_mm"]
    turned = np.array(mount["matrix_mm"])[:3, :3] @ rotation_matrix(np.array(MOUNT[3:])).T
    assert np.arccos((np.trace(turned) - 1) / 2) < 4 * mount["rotation_u_rad"]
    assert np.linalg.norm(np.subtract(place["position_mm"], FRAME[3:])) < 4 * place["position_u_mm"]
    assert row["reprojection_rms"] == pytest.approx(np.sqrt(2) * 0.2, rel=0.1)
    matrix = np.array([line.split() for line in aacmm("export", "c.h5", "--format", "matrix").stdout.splitlines()[1:]])
    np.testing.assert_allclose(matrix.astype(float), mount["matrix_mm"], rtol=1e-9, atol=1e-9)
    assert 'link="webcam"' in aacmm("export", "c.h5", "--format", "joint-origin").stdout
    assert "distortion_model: plumb_bob" in aacmm("export", "c.h5", "--format", "camera-info").stdout
    assert "--frame" in aacmm("export", "c.h5", "--format", "camera-info", "--frame", "mount", expect=2).stderr
    assert "--camera" in aacmm("export", "c.h5", "--camera", "webcam", expect=2).stderr


@pytest.mark.slow
def test_a_camera_that_stands_still(aacmm, folder):
    aacmm("calibrate", folder / "fixed.h5", "-o", "c.h5", "--arm-fixed")
    (row,) = json.loads(aacmm("show", "c.h5", "--json").stdout)["cameras"]
    assert (row["mount"]["of"], row["place"]["of"], row["camera_on_arm"]) == ("board", "webcam", False)
    assert np.linalg.norm(np.subtract(row["mount"]["position_mm"], (0, 0, 30))) < 4 * row["mount"]["position_u_mm"]
    assert aacmm("export", "c.h5", "--format", "matrix", "--frame", "place").stdout.startswith("# webcam in base, mm")


@pytest.mark.slow
def test_what_a_camera_cannot_separate_is_said(aacmm, folder):
    """Zeros of the first and last joint from place and mount, and the tip; not where the arm is held altogether."""
    for options, said in ((("--no-automatic",), True), (("--arm-fixed",), False)):
        shown = " ".join(aacmm("calibrate", folder / "on-arm.h5", "-o", "c.h5", *options).stdout.split())
        assert ("the place of board from theta_1 and d_1 or the mount of webcam from theta_6." in shown) is said
        assert ("No observation shows the tip." in shown) is said


@pytest.mark.slow
def test_nothing_but_the_arm_is_refused(aacmm, folder):
    said = aacmm("calibrate", folder / "on-arm.h5", "-o", "c.h5", "--arm-fixed", "--free", "beta_2", expect=2).stderr
    assert "--arm-fixed" in said


KIT = """
[[target]]
name = "board"
kind = "charuco"
squares = [6, 5]
size = 30.0
marker = 22.0
bar = { nominal = 100, measured = 99.5, u = 0.05 }
[[camera]]
name = "webcam"
image_size = [320, 240]
intrinsics = { fx = 300, fy = 305, cx = 160, cy = 120, k1 = -0.1 }
[[pixels]]
name = "looks"
camera = "webcam"
target = "board"
mount = [60, -10, 20, 0.1, 0.2, 0.3]
frame = [3.14159265, 0, 0, -700, -200, 0]
distance = [250, 400]
u = 0.001
poses = 3
"""
SIMULATE = ("simulate", "ur10e", "-o", "s.h5", "--kit", "kit.toml")


@pytest.mark.slow
def test_rendered_images_are_read_as_they_were_simulated(aacmm, tmp_path):
    """Readings with their noise, a board that was printed too small; the corners without bias."""
    pytest.importorskip("cv2")
    (tmp_path / "kit.toml").write_text(KIT)
    aacmm(*SIMULATE, "--images", "rendered", "--encoder-arcsec", "50", "--blur-px", "0.7")
    aacmm("import", "rendered/capture.toml", "-o", "i.h5")
    simulated, read = (aj.files.load_capture(tmp_path / f"{name}.h5").capture.observations[0] for name in "si")
    np.testing.assert_allclose(read.q, simulated.q, atol=1e-8)
    np.testing.assert_allclose(read.points[0, 5], np.asarray(simulated.points)[0, read.ids[0][5]])
    assert read.images == ("looks/1.jpg", "looks/2.jpg", "looks/3.jpg")
    assert read.seen.sum() > 50
    true = np.asarray(simulated.corners)[np.nonzero(read.seen)[0], np.array(read.ids)[read.seen]]
    apart = np.asarray(read.corners)[read.seen] - true
    assert np.abs(apart.mean(axis=0)).max() < 0.05
    assert np.abs(apart).max() < 0.6


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("kit", "options", "says"),
    [
        (KIT, ("--blur-px", "1"), "--images FOLDER"),
        (KIT.replace("intrinsics =", "# "), (), "'webcam' has no intrinsics"),
        (KIT.replace('"looks"', '".."'), (), "cannot be the name of a folder"),
        ('[[socket]]\nname = "cone"\npoint = [400, 200, 300]\nposes = 2\n', (), "no camera"),
    ],
    ids=["no images", "no intrinsics", "folder above", "no camera"],
)
def test_images_that_cannot_be_rendered_are_refused(aacmm, tmp_path, kit, options, says):
    (tmp_path / "kit.toml").write_text(kit)
    images = () if options else ("--images", "rendered")
    assert says in aacmm(*SIMULATE, *images, *options, expect=2).stderr
    assert not (tmp_path / "s.h5").exists()
