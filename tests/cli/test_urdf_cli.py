"""From a URDF to a calibrated URDF by the command line alone."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj

FILE = Path(__file__).parents[1] / "files" / "six_axis.urdf"
SOCKETS = ("--socket", "A=300,100,700", "--socket", "B=400,-100,600", "--length", "A,B,0.002")
Q = np.random.default_rng(0).uniform(-2, 2, (10, 6))


@pytest.fixture
def robot(tmp_path) -> Path:
    return Path(shutil.copy(FILE, tmp_path / "robot.urdf"))


@pytest.mark.slow
def test_urdf_to_calibrated_urdf(aacmm, tmp_path, robot):
    noise = ("--encoder-arcsec", "2", "--seating-mm", "0.005", "--deviate-length-mm", "1", "--deviate-angle-deg", "0.1")
    aacmm("simulate", "robot.urdf", "--tip", "tool0", *SOCKETS, "--poses", "15", *noise, "-o", "capture.h5")
    robot.unlink()  # the capture holds it
    aacmm("calibrate", "capture.h5", "-o", "calibration.h5")
    said = aacmm("export", "calibration.h5", "-o", "calibrated.urdf").stdout
    assert "Joints whose origin changed: joint_2, joint_3, joint_4, joint_5, joint_6, flange-tool0." in said
    record = aj.files.load_calibration(tmp_path / "calibration.h5")
    exported = aj.load_arm(tmp_path / "calibrated.urdf", tip="tool0")
    np.testing.assert_allclose(exported.pose(Q), record.calibrated.arm.pose(Q), rtol=0, atol=1e-9)
    assert "No origin changed." in aacmm("export", "calibration.h5", "--arm", "nominal", "-o", "same.urdf").stdout
    assert (tmp_path / "same.urdf").read_bytes() == FILE.read_bytes()
    # Other formats, by the name of the output or stated.
    aacmm("export", "calibration.h5", "-o", "arm.py")
    program: dict = {}
    exec((tmp_path / "arm.py").read_text(), program)
    np.testing.assert_allclose(program["position"](Q[0]), record.calibrated.arm.position(Q[0]), rtol=0, atol=1e-9)
    aacmm("export", "calibration.h5", "-o", "kinematics.yaml")
    assert aj.load_arm(tmp_path / "kinematics.yaml").joints == 6
    offsets = aacmm("export", "calibration.h5", "--format", "offsets").stdout.splitlines()
    assert sum(line.startswith("#") for line in offsets) == 4
    assert len(offsets) == 4 + 1 + 6
    table = aacmm("export", "calibration.h5", "--format", "table", "--convention", "craig", "--units", "m-rad").stdout
    assert "joint,theta_rad,d_m,a_m,alpha_rad,beta_rad" in table
    said = aacmm("export", "calibration.h5", "--format", "csv", "--units", "m-rad", expect=2).stderr
    assert "--format table" in said
    assert "leave it out" in aacmm("export", "calibration.h5", "--format", "csv", "--arm", "true", expect=2).stderr


def test_show_and_links(aacmm, robot):
    shown = json.loads(aacmm("show", "robot.urdf", "--base", "base_link", "--tip", "tool0", "--json").stdout)
    assert (shown["urdf"]["base"], shown["urdf"]["tip"]) == ("base_link", "tool0")
    np.testing.assert_array_equal(shown["urdf"]["first_frame_in_base_mm"], np.eye(4))
    said = aacmm("show", "robot.urdf", "--tip", "tool0").stdout
    assert "From a URDF, links world to tool0; positions are in the frame of world." in said
    said = " ".join(aacmm("show", "robot.urdf", "--base", "shoulder", "--tip", "tool0").stdout.split())
    assert "in a frame at (50, 0, 100) mm in shoulder, with its z axis along (0, -1, 0)" in said
    assert "choose the tip (tip= or --tip)" in aacmm("show", "robot.urdf", expect=2).stderr
    assert "is not a URDF" in aacmm("show", "panda", "--tip", "tool0", expect=2).stderr
    robot.rename(robot.with_suffix(".h5"))
    assert "--base and --tip name links of a URDF" in aacmm("show", "robot.h5", "--tip", "x", expect=2).stderr


@pytest.mark.slow
def test_a_plan_names_the_links(aacmm, tmp_path, robot):
    """Also where the identification frees a beta that the arm has not had."""
    aacmm("plan", "robot.urdf", "--tip", "tool0", *SOCKETS[:4], "--length", "A,B,0.002", "--poses", "20",
          "--candidates", "100", "-o", "plan.csv", "--manifest", "plan.toml")  # fmt: skip
    text = (tmp_path / "plan.toml").read_text()
    assert 'arm = "robot.urdf"\nbase = "world"\ntip = "tool0"\n' in text
