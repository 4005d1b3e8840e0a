"""Arms with prismatic joints in files: which joints they are, and the units of their readings."""

from types import SimpleNamespace

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data.observations.held import Socket
from aacmm_jax.data.recording import Recording
from aacmm_jax.files import plans
from aacmm_jax.files.captures import load_capture, save_capture
from aacmm_jax.files.manifest import read_manifest
from aacmm_jax.files.table_columns import corrected_csv, read_poses
from aacmm_jax.files.text_table import TextTable
from aacmm_jax.kinematics.parameters import ArmSpecification, perturbed_arm
from aacmm_jax.planning.kit import KitPlan
from aacmm_jax.summaries.calibration import arm_summary, capture_summary

from ..prismatic_arms import GANTRY, LINEAR_AXIS, SCARA
from ..refusals import assert_refused

Q = np.random.default_rng(0).uniform(*np.array(SCARA.limits).T, (5, 4))


def same_arm(one: aj.Arm, other: aj.Arm) -> None:
    assert (one.prismatic, one.limits) == (other.prismatic, other.limits)
    for kind in ("alpha", "a", "d", "theta", "probe"):
        np.testing.assert_array_equal(getattr(one, kind), getattr(other, kind))


@pytest.mark.parametrize("arm", [SCARA, GANTRY])
def test_an_arm_file_gives_back_the_arm(tmp_path, arm):
    aj.files.save_arm(arm, tmp_path / "arm.toml")
    same_arm(aj.load_arm(tmp_path / "arm.toml"), arm)


def test_an_arm_file_in_m_and_degrees(tmp_path):
    """Limits of a prismatic joint are lengths."""
    text = """
length_unit = "m"
angle_unit = "deg"
prismatic = [1]
joint = [
    { alpha = 90, a = 0, d = 0.1, limits = [0, 1.5] },
    { alpha = 0, a = 0.4, d = 0, limits = [-90, 90] },
]
"""
    (tmp_path / "arm.toml").write_text(text)
    arm = aj.load_arm(tmp_path / "arm.toml")
    assert arm.prismatic == (1,)
    np.testing.assert_allclose(arm.limits, [(0, 1500), (-np.pi / 2, np.pi / 2)])
    np.testing.assert_allclose(arm.position([500.0, 0.0]), (400, 0, 600), atol=1e-12)
    for old, new, said in (
        (", limits = [0, 1.5]", "", "limits are given for some joints only"),
        ("prismatic = [1]", "prismatic = [3]", "prismatic names joint 3, but the arm has 2 joints"),
        ("prismatic = [1]", "prismatic = [1, 1]", "prismatic"),
    ):
        (tmp_path / "wrong.toml").write_text(text.replace(old, new))
        assert_refused(lambda: aj.load_arm(tmp_path / "wrong.toml"), said)
    (tmp_path / "wrong.toml").write_text(text.replace(", limits = [0, 1.5]", "").replace(", limits = [-90, 90]", ""))
    assert_refused(lambda: aj.load_arm(tmp_path / "wrong.toml"), "joint 1 is prismatic, but has no limits")


def test_a_capture_file_gives_back_arms_and_readings(tmp_path):
    nominal = ArmSpecification(SCARA, "scara")
    capture = aj.Capture({"A": Q[:3], "B": Q[3:]})
    save_capture(tmp_path / "capture.h5", Recording(capture, nominal, nominal))
    found = load_capture(tmp_path / "capture.h5")
    same_arm(found.nominal.arm, SCARA)
    assert found.true is not None
    same_arm(found.true.arm, SCARA)
    np.testing.assert_array_equal(found.capture.q, capture.q)
    rows = capture_summary(found)["ranges"]
    assert rows[2] == {"joint": 3, "lowest_mm": Q[:, 2].min(), "highest_mm": Q[:, 2].max()}
    assert "lowest_rad" in rows[0]
    assert arm_summary(nominal)["joints"][2]["limits_mm"] == [50.0, 350.0]


@pytest.mark.slow
def test_a_calibration_file_keeps_the_noise_of_linear_encoders(tmp_path):
    from aacmm_jax.calibration.record import record_of
    from aacmm_jax.files.calibrations import load_calibration, save_calibration

    space = aj.Parameters.independent(LINEAR_AXIS)
    true = perturbed_arm(space, length=0.2, angle=0.001)
    noise = aj.Noise(encoder_arcsec=2.0, linear_encoder=0.004, seating=0.005)
    points = {"A": (500, 200, 300), "B": (-300, 500, 800)}
    capture = aj.simulate(true, points, poses=25, lengths=[("A", "B", 0.002)], noise=noise)
    result = aj.calibrate(space.base, capture, aj.Bounds.around(space.base, space), noise=noise)
    record = record_of(result, Recording(capture, ArmSpecification(space.base, "arm")))
    save_calibration(tmp_path / "calibration.h5", record)
    found = load_calibration(tmp_path / "calibration.h5")
    same_arm(found.calibrated.arm, record.calibrated.arm)
    assert float(found.noise.linear_encoder) == 0.004
    assert found.method == "joint"


@pytest.mark.slow
def test_a_manifest_states_the_unit_of_slides(tmp_path):
    """In m, or counts; signs and offsets hold for them too. Degrees of the other joints are refused as radians."""
    aj.files.save_arm(SCARA, tmp_path / "arm.toml")
    deg = Q * [180 / np.pi, 180 / np.pi, 1e-3, 180 / np.pi]
    np.savetxt(tmp_path / "A.csv", deg, delimiter=",")
    text = 'arm = "arm.toml"\n[angles]\nunit = "deg"\nlinear_unit = "m"\n[[socket]]\nfile = "A.csv"\n'
    (tmp_path / "m.toml").write_text(text)
    np.testing.assert_allclose(read_manifest(tmp_path / "m.toml").capture.q, Q, rtol=1e-12)
    counts = text.replace('linear_unit = "m"', 'linear_unit = "counts"\ncounts_per_mm = 0.001\nsign = [1, 1, -1, 1]')
    (tmp_path / "counts.toml").write_text(counts)
    found = read_manifest(tmp_path / "counts.toml").capture.q
    np.testing.assert_allclose(found, Q * [1, 1, -1, 1], rtol=1e-12)
    (tmp_path / "rad.toml").write_text(text.replace('unit = "deg"', 'unit = "rad"'))
    assert_refused(lambda: read_manifest(tmp_path / "rad.toml"), "probably in degrees")


def test_plans_are_tables_with_the_unit_of_each_joint():
    plan = KitPlan._make([()] * len(KitPlan._fields))
    seated = {"kit": [SimpleNamespace(offset=None, aim=None)], "observations": [Socket("A", Q)]}
    text = plans.plan_csv(plan._replace(arm=SCARA, retract=0.0, **seated))
    header, first = (line.split(",") for line in text.splitlines()[:2])
    assert header[:6] == ["pose", "observation", "point", "x_mm", "y_mm", "z_mm"]
    assert header[6:10] == ["q_1_deg", "q_2_deg", "q_3_mm", "q_4_deg"]
    expected = Q[0] * [180 / np.pi, 180 / np.pi, 1, 180 / np.pi]
    np.testing.assert_allclose(np.array(first[6:10], dtype=float), expected, atol=1e-3)


def test_commanded_readings_and_their_correction(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("q_1_deg,q_2_deg,q_3_mm,q_4_deg\n10,20,100,30\n-10,20,200,-30\n")
    commanded = read_poses(path, SCARA)
    rows = np.array([[10, 20, 100, 30], [-10, 20, 200, -30]])
    np.testing.assert_allclose(commanded.q, rows * [np.pi / 180, np.pi / 180, 1, np.pi / 180])
    text = corrected_csv(commanded, np.asarray(commanded.q), np.array([True, True]))
    (tmp_path / "again.csv").write_text(text)
    np.testing.assert_allclose(TextTable(tmp_path / "again.csv").numbers(range(rows.shape[1])), rows, rtol=1e-12)
    path.write_text("q_1_deg,q_2_deg,q_3_um,q_4_deg\n10,20,1e5,30\n")
    assert_refused(lambda: read_poses(path, SCARA), "has readings of prismatic joints in um")


def test_for_controllers():
    """Zero offsets in mm of slides, found exactly where nothing else differs; tables and programs say which slide."""
    calibrated = LINEAR_AXIS.replace(d_1=0.3, theta_2=LINEAR_AXIS.theta[1] + 0.001, theta_4=-0.002)
    readings = np.random.default_rng(1).uniform(*np.array(LINEAR_AXIS.limits).T, (30, 7))
    found = aj.files.zero_offsets(LINEAR_AXIS, calibrated, readings)
    np.testing.assert_allclose(found.offsets[:4], [0.3, 0.001, 0, -0.002], atol=1e-8)
    assert found.units == ("mm", *["rad"] * 6)
    assert aj.files.zero_offsets_csv(found).splitlines()[3] == "joint,offset_deg,offset_rad,offset_mm"
    assert "prismatic joints (3) are added to d" in aj.files.dh_table(SCARA)
    program: dict = {}
    exec(aj.files.python_program(SCARA, title="scara"), program)
    np.testing.assert_allclose(np.array([program["pose"](q) for q in Q]), SCARA.pose(Q), atol=1e-12)
