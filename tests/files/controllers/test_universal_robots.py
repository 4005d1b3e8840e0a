"""Kinematics of Universal Robots' arms: the maker's published numbers, and a real robot's table with far frames."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.rotations import roll_pitch_yaw_matrix

from ...refusals import assert_refused

# Of a real robot: UniversalRobots/Universal_Robots_ROS2_Driver, ur_calibration/doc/algorithm.rst (BSD-3-Clause).
REAL = {
    "theta": [-2.4147806894359e-07, 1.60233952386695, -1.68607190752171, 0.0837331147700119, -1.01260355871158e-07,
              3.91986209186124e-08],
    "a": [2.12234865571206e-05, 0.0193171326277006, -0.569251663611088, -4.61409023720934e-05, -6.39280053471802e-05,
          0],
    "d": [0.180539811714259, 439.140974079901, -446.027059806332, 7.0603368964236, 0.119811341150314,
          0.115670917257426],
    "alpha": [1.57014608044242, 0.0013941666682559, 0.00693818880325995, 1.56998468543761, -1.57038520649543, 0],
}  # fmt: skip
PARAMETERS = "".join(f"dh_{kind}: [ {'   '.join(map(repr, row))} ]  # m, rad\n" for kind, row in REAL.items())
Q = np.random.default_rng(0).uniform(-3, 3, (50, 6))


def direct() -> aj.Arm:
    """The table as it is."""
    return aj.Arm(theta=REAL["theta"], a=1000 * np.array(REAL["a"]), d=1000 * np.array(REAL["d"]), alpha=REAL["alpha"])


def file(folder, text: str, name: str = "robot.yaml"):
    path = folder / name
    path.write_text(text)
    return path


def as_toml(folder):
    rows = [{kind: REAL[kind][i] for kind in REAL} for i in range(6)]
    lines = [f"{{ {', '.join(f'{kind} = {float(value)!r}' for kind, value in row.items())} }}" for row in rows]
    return file(folder, f'length_unit = "m"\nangle_unit = "rad"\njoint = [\n{",".join(lines)}]\n', "robot.toml")


@pytest.mark.parametrize("how", ["yaml", "toml"])
def test_frames_hundreds_of_metres_away_come_back(tmp_path, how):
    arm = aj.load_arm(file(tmp_path, PARAMETERS) if how == "yaml" else as_toml(tmp_path))
    assert np.abs([arm.a, arm.d]).max() < 700
    np.testing.assert_allclose(arm.pose(Q), direct().pose(Q), rtol=0, atol=1e-9)


def test_an_identification_keeps_the_table(tmp_path):
    path = as_toml(tmp_path)
    path.write_text(path.read_text() + '[identification]\nheld = ["d_2"]\n')
    assert float(aj.load_arm(path).d[1]) == 439_140.974079901


@pytest.mark.slow
def test_such_a_table_is_calibrated_and_exported(tmp_path):
    nominal = aj.load_arm(file(tmp_path, PARAMETERS))
    space = aj.Parameters.independent(nominal)
    true = aj.perturbed_arm(space, length=0.5, angle=5e-4, seed=1)
    sockets = {"A": (600, 200, 300), "B": (700, -200, 300)}
    noise = {"encoder_arcsec": 1.0, "seating": 0.005}
    capture = aj.simulate(true, sockets, poses=40, lengths=[("A", "B", 0.002)], seed=2, **noise)
    result = aj.calibrate(nominal, capture, aj.Bounds.around(nominal, space))
    errors = np.linalg.norm(np.asarray(result.arm.position(Q)) - np.asarray(true.position(Q)), axis=1)
    assert bool(result.converged)
    assert np.sqrt(np.mean(errors**2)) < 0.02  # mm; 0.007 of the noise, and some 0.1 with frames 400 m away
    text = aj.files.ur_kinematics_yaml(result.arm)
    tool = np.array([float(x) for x in text.split("controller: ")[1].split()[:3]]) * 1000
    again = aj.load_arm(file(tmp_path, text, "kinematics.yaml"), probe=tool)
    np.testing.assert_allclose(again.pose(Q), result.arm.pose(Q), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_origins_of_a_published_table(tmp_path):
    """UR10e by the maker's nominal table (universal-robots.com, DH parameters): the origins by hand, m and rad."""
    right = np.pi / 2
    arm = aj.Arm(
        alpha=[right, 0, 0, right, -right, 0], a=[0, -612.7, -571.55, 0, 0, 0], d=[180.7, 0, 0, 174.15, 119.85, 116.55]
    )
    expected = {
        "shoulder": (0, 0, 0.1807, 0, 0, 0),
        "upper_arm": (0, 0, 0, right, 0, 0),
        "forearm": (-0.6127, 0, 0, 0, 0, 0),
        "wrist_1": (-0.57155, 0, 0.17415, 0, 0, 0),
        "wrist_2": (0, -0.11985, 0, right, 0, 0),
        "wrist_3": (0, 0.11655, 0, -right, 0, 0),
    }
    text = aj.files.ur_kinematics_yaml(arm)
    values = [float(line.split(":")[1]) for line in text.splitlines() if line.startswith("    ")]
    for found, numbers in zip(np.reshape(values, (6, 6)), expected.values(), strict=True):
        np.testing.assert_allclose(found[:3], numbers[:3], atol=1e-15)
        matrices = [roll_pitch_yaw_matrix(np.array(angles, dtype=float)) for angles in (found[3:], numbers[3:])]
        np.testing.assert_allclose(*matrices, atol=1e-15)
    read = aj.files.load_specification(file(tmp_path, text, "kinematics.yml"))
    np.testing.assert_allclose(read.arm.pose(Q), arm.pose(Q), rtol=0, atol=1e-9)
    assert {"beta_2", "beta_3"} <= set(read.free)


# UR10e by the maker's nominal table (universal-robots.com, DH parameters), as a robot's urcontrol.conf has it, and what
# the table of the real robot differs from it by, as a robot's calibration.conf has it.
DH = {
    "a": [0, -0.6127, -0.57155, 0, 0, 0],
    "d": [0.1807, 0, 0, 0.17415, 0.11985, 0.11655],
    "alpha": [1.570796327, 0, 0, 1.570796327, -1.570796327, 0],
}
NOMINAL = "[DH]\n" + "".join(f"{kind} = {row}  # m\n" for kind, row in DH.items()) + "[Tool]\na = [1, 2]\n"
DELTA = "[mounting]\n" + "".join(
    f"delta_{kind} = [{', '.join(repr(x) for x in np.subtract(row, DH.get(kind, 0)).tolist())}]\n"
    for kind, row in REAL.items()
)
STATUS = "joint_checksum = [ 0x6e0f7bf, 0xa32a713f]\ncalibration_status = 2 # 0 == notInitialized / 2 == Linearised\n"


def test_a_robots_own_files(tmp_path):
    file(tmp_path, NOMINAL, "urcontrol.conf.UR10")
    arm = aj.load_arm(file(tmp_path, DELTA + STATUS, "calibration.conf"))
    assert np.abs([arm.a, arm.d]).max() < 700
    np.testing.assert_allclose(arm.pose(Q), direct().pose(Q), rtol=0, atol=1e-9)
    nominal = aj.load_arm(file(tmp_path, NOMINAL, "urcontrol.conf"))
    np.testing.assert_allclose(nominal.d, 1000 * np.array(DH["d"]), atol=1e-6)
    np.testing.assert_allclose(nominal.a, 1000 * np.array(DH["a"]), atol=1e-6)


@pytest.mark.parametrize(
    ("nominal", "text", "parts"),
    [
        ("", DELTA, ["0 files urcontrol.conf beside it", "put the robot's own there"]),
        (NOMINAL, DELTA.replace("delta_a", "delta_x"), ["'delta_a' is missing"]),
        (NOMINAL, DELTA + STATUS.replace("2 #", "1 #"), ["calibration_status is '1', not 2"]),
        (NOMINAL.replace("alpha", "beta"), DELTA, ["'alpha' is missing"]),
        (NOMINAL.replace("-0.6127", "x"), DELTA, ["'a' is", "six finite numbers"]),
        (NOMINAL, "[mounting]\n", ["'a' is missing"]),
        (NOMINAL.replace("-0.6127", "-0.425"), DELTA, ["differ", "give that of the robot's model"]),
    ],
)
def test_refusals_of_a_robots_own_files(tmp_path, nominal, text, parts):
    if nominal:
        file(tmp_path, nominal, "urcontrol.conf")
    path = file(tmp_path, text, "calibration.conf")
    assert_refused(lambda: aj.load_arm(path), path, *parts)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("kinematics:\n  shoulder:\n    x: 0\n", ["'kinematics.shoulder.y' is missing"]),
        (PARAMETERS.replace("dh_a:", "dh_b:"), ["'dh_a' is missing"]),
        (PARAMETERS.replace("439.140974079901", "four"), ["'dh_d' is", "six finite numbers"]),
        (PARAMETERS.replace("439.140974079901", ""), ["'dh_d' is", "give six finite numbers"]),
        (PARAMETERS.replace("439.140974079901", "1e300"), ["'dh_d' is", "below 100000"]),
        (PARAMETERS + PARAMETERS, ["'dh_theta' occurs twice"]),
        ("kinematics: [1, 2\nx y\n", ["line 3: the file is not valid YAML"]),
        ("", ["has no 'key: value'"]),
    ],
)
def test_refusals(tmp_path, text, parts):
    path = file(tmp_path, text)
    assert_refused(lambda: aj.load_arm(path), path, *parts)


def test_other_refusals(tmp_path):
    text = aj.files.ur_kinematics_yaml(direct())
    tilted = text.replace("roll: 0.0", "roll: 0.1", 1)
    assert_refused(lambda: aj.load_arm(file(tmp_path, tilted)), "axis of the first joint is not the z axis")
    huge = text.replace("x: 0.0", "x: 1e300", 1)
    assert_refused(lambda: aj.load_arm(file(tmp_path, huge)), "'1e300'", "below 100000")
    wrong = text.replace("roll: 0.0", "roll: none", 1)
    assert_refused(
        lambda: aj.load_arm(file(tmp_path, wrong)), "'kinematics.shoulder.roll' is 'none'", "give a finite number"
    )
    assert_refused(lambda: aj.files.ur_kinematics_yaml(aj.load_arm("panda")), "six joints", "has 7")
