"""What controllers take of an arm: read back as its text says, it is the same arm."""

import csv
import re

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files.controllers.offsets import remaining_error
from aacmm_jax.kinematics.arm import joint_limits
from aacmm_jax.kinematics.axes_to_dh import rotation

from ...refusals import assert_refused

Q = np.random.default_rng(0).uniform(-2, 2, (6, 7))
DIMENSIONS = {"mm": 1.0, "m": 1000.0, "rad": 1.0, "deg": np.pi / 180}
BASE = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def arm():
    panda = aj.load_arm("panda")
    beta = np.linspace(-0.01, 0.02, 7)
    return panda.replace(beta=beta, theta=panda.theta + 0.1, probe=(3, 4, 100), a_7=12.0, alpha_7=0.3)


def shift(x: float, y: float, z: float) -> np.ndarray:
    result = np.eye(4)
    result[:3, 3] = x, y, z
    return result


def frames_of(text: str, name: str) -> np.ndarray:
    """A transform that a comment states, in mm."""
    line = next((line for line in text.splitlines() if line.startswith(f"# {name}")), None)
    if line is None:
        return np.eye(4)
    number = r"(-?[\d.]+(?:e-?\d+)?)"
    x, y, z, unit = re.search(rf"x y z = {number} {number} {number} (\w+)", line).groups()
    result = shift(*(DIMENSIONS[unit] * float(value) for value in (x, y, z)))
    angles = re.search(rf"roll pitch yaw = {number} {number} {number} (\w+)", line)
    if angles:
        roll, pitch, yaw = (DIMENSIONS[angles[4]] * float(value) for value in angles.groups()[:3])
        result = result @ rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll)
    return result


@pytest.mark.parametrize("units", ["mm-deg", "m-rad"])
@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_table_is_the_arm(arm, convention, units):
    text = aj.files.dh_table(arm, convention=convention, units=units, base=BASE)
    rows = [
        {key.split("_")[0]: DIMENSIONS.get(key.partition("_")[2], 1) * float(value) for key, value in row.items()}
        for row in csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    ]
    assert [row["joint"] for row in rows] == [*range(1, 8)]
    assert f"theta_{units.split('-')[1]}" in text
    for q, expected in zip(Q, BASE @ np.asarray(arm.pose(Q)), strict=True):
        pose = frames_of(text, "first frame")
        for reading, row in zip(q, rows, strict=True):
            joint = rotation(2, reading + row["theta"]) @ shift(0, 0, row["d"])
            link = shift(row["a"], 0, 0) @ rotation(0, row["alpha"]) @ rotation(1, row["beta"])
            pose = pose @ (joint @ link if convention == "standard" else link @ joint)
        np.testing.assert_allclose(pose @ frames_of(text, "tip"), expected, rtol=0, atol=1e-9)


def test_program_needs_numpy_only(arm):
    text = aj.files.python_program(arm, title='it\'s "an" arm\n', base=BASE)
    assert re.findall(r"^ *(?:import|from) (\w+)", text, re.MULTILINE) == ["numpy"]
    program: dict = {}
    exec(compile(text, "program", "exec"), program)
    for q, expected in zip(Q, BASE @ np.asarray(arm.pose(Q)), strict=True):
        np.testing.assert_allclose(program["pose"](q), expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(program["position"](q), expected[:3, 3], rtol=0, atol=1e-9)


def test_zero_offsets_of_an_arm_that_has_no_other_error(arm):
    offsets = np.array([0.01, -0.02, 0.03, 0.0, 0.005, -0.01, 0.02])
    calibrated = arm.replace(theta=arm.theta + offsets, probe=arm.probe + np.array([0.5, 0, 30]))
    found = aj.files.zero_offsets(arm, calibrated, Q)
    np.testing.assert_allclose(found.offsets[:6], offsets[:6], atol=1e-9)  # the last is a rotation of the tool, too
    assert found.largest < 1e-6 < 1 < found.rms_nominal


def test_zero_offsets_leave_the_error_that_they_cannot_take(arm):
    """Least squares: no other offsets do better, and what remains is stated."""
    calibrated = arm.replace(a_4=float(arm.a[3]) + 2, theta_2=float(arm.theta[1]) + 0.01)
    found = aj.files.zero_offsets(arm, calibrated, Q)

    def rms(offsets: np.ndarray) -> float:
        left = arm.replace(probe=found.probe).position(Q + offsets) - calibrated.position(Q)
        return float(np.sqrt(np.mean(np.sum(np.asarray(left) ** 2, axis=1))))

    np.testing.assert_allclose(rms(found.offsets), found.rms)
    for step in 1e-4 * np.eye(7):
        assert min(rms(found.offsets + step), rms(found.offsets - step)) > found.rms
    assert 0.1 < found.rms < found.rms_nominal
    text = aj.files.zero_offsets_csv(found)
    assert f"{found.rms:.4f} mm RMS, at most {found.largest:.4f} mm" in text
    rows = [line.split(",") for line in text.splitlines() if line[0].isdigit()]
    np.testing.assert_allclose([float(row[2]) for row in rows], found.offsets)
    np.testing.assert_allclose([float(row[1]) for row in rows], np.degrees(found.offsets))


def test_zero_offsets_of_a_few_poses_are_judged_over_all_joint_limits(arm):
    """Poses in one corner give offsets that are worse elsewhere, which is said; fitted over all, none are, and joints
    whose zeros the calibration does not determine get none."""
    calibrated = arm.replace(
        a_4=float(arm.a[3]) + 2, alpha_2=float(arm.alpha[1]) + 0.01, theta_2=float(arm.theta[1]) + 0.005
    )
    corner = 0.05 * Q
    narrow = aj.files.zero_offsets(arm, calibrated, corner)
    found = aj.files.zero_offsets(arm, calibrated, corner, free=("theta_2", "theta_3"), within_limits=True)
    anywhere = np.random.default_rng(7).uniform(*np.asarray(joint_limits(arm, None)).T, (1000, 7))

    def rms(offsets: np.ndarray) -> float:
        apart = np.asarray(arm.position(anywhere + offsets)) - np.asarray(calibrated.position(anywhere))
        return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))

    assert rms(found.offsets) < rms(np.zeros(7)) < rms(narrow.offsets)
    assert found.within_limits is not None
    np.testing.assert_allclose(found.within_limits[:2], [rms(np.zeros(7)), rms(found.offsets)], rtol=0.05)
    assert found.held == (1, 4, 5, 6, 7)
    assert not np.any(found.offsets[[0, 3, 4, 5, 6]])
    worse = found._replace(within_limits=(1.0, 2.0, 3.0))
    notes = " ".join(remaining_error(worse))
    assert "over all joint limits, the arm is not better with these offsets" in notes
    assert "so they get no offset: 1, 4, 5, 6, 7" in notes
    assert "not better" not in " ".join(remaining_error(found))
    text = aj.files.zero_offsets_csv(found._replace(read_as=(1, -2, 3, 4, 5, 6, 7)))
    assert "# Recorded with the opposite sign, so subtract there instead: joint 2." in text


def test_tables_list_the_coefficients_of_corrections_with_their_units(paper_arm):
    plain = aj.files.dh_table(paper_arm)
    arm = aj.kinematics.with_corrections(paper_arm, "gear,gravity,harmonics=1")
    assert aj.files.dh_table(arm).startswith(plain)
    text = aj.files.dh_table(arm.replace(gear_2=1e-3, cos1_3=5e-5, compliance3_2=-2e-4))
    assert text.startswith(plain)
    lines = text.splitlines()
    for line in ("# gear_2 = 0.001 1", "# cos1_3 = 5e-05 rad", "# compliance3_2 = -0.0002 rad/m"):
        assert line in lines
    assert not any("gear_3" in line for line in lines)


def test_refusals(arm, paper_arm):
    assert_refused(
        lambda: aj.files.dh_table(arm, convention="dh"), "convention is 'dh'", "choose one of standard, craig"
    )
    assert_refused(lambda: aj.files.dh_table(arm, units="inch"), "units is 'inch'", "choose one of mm-deg, m-rad")
    assert_refused(lambda: aj.files.zero_offsets(arm, paper_arm, Q), "7 and 6 joints")
