"""``aacmm correct``: tables of commanded poses, with corrected readings in the same columns and unit."""

import csv
import json
import math
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.cli.commanded import in_first_frame
from aacmm_jax.kinematics.inverse_kinematics import corrected_readings
from aacmm_jax.summaries.correction import correction_summary

from ..conftest import command_line

Q = np.array([0, 0.3, 0.4, 0, 1.2, 0]) + np.random.default_rng(0).uniform(-1, 1, (6, 6))  # rad
DEG = np.pi / 180
ROBOT = Path(__file__).parents[2] / "examples" / "simulated_robot" / "tracker.toml"
URDF = Path(__file__).parents[1] / "files" / "six_axis.urdf"


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """A calibration of the paper's simulated arm, and its two arms."""
    folder = tmp_path_factory.mktemp("correct")
    sockets = ("--socket", "A=400,200,300", "--socket", "B=600,200,300", "--length", "A,B,0.002")
    wrong = ("--deviate-length-mm", 1, "--deviate-angle-deg", 0.1, "--poses", 20)
    command_line(folder, "simulate", "cheng2018-simulation", *sockets, *wrong, "-o", "capture.h5")
    command_line(folder, "calibrate", "capture.h5", "-o", "calibration.h5")
    record = aj.files.load_calibration(folder / "calibration.h5")
    return folder, record.recording.nominal.arm, record.calibrated.arm


def table(path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def run(arms, *arguments, expect=0):
    return command_line(arms[0], "correct", "calibration.h5", *arguments, "--overwrite", expect=expect)


def write(path, header: list[str], rows) -> None:
    lines = [",".join(header)] if header else []
    path.write_text("\n".join([*lines, *(",".join(map(str, row)) for row in rows)]) + "\n")


def test_a_program_is_calibrated_once(arms):
    command_line(arms[0], "export", "calibration.h5", "-o", "arm.py", "--overwrite")
    (title,) = [line for line in (arms[0] / "arm.py").read_text().splitlines() if line.startswith("TITLE")]
    assert title.count("calibrated") == 1
    assert "calibrated from 40 poses" in title


@pytest.mark.parametrize("unit", ["deg", "counts"])
def test_readings_as_recorded_become_readings_as_recorded(arms, unit):
    """The same joint values as without signs and offsets; names of columns are those of the recording."""
    folder, *_ = arms
    names, size = [f"motor {i}.pos" for i in range(6)], np.array([1, -1, 1, 1, -1, 1]) * (1.001 * DEG)
    written = aj.data.RecordedAs(tuple(names), unit, np.diag(size), np.linspace(-1, 1, 6))
    record = aj.files.load_calibration(folder / "calibration.h5")
    recording = record.recording._replace(recorded_as=written)
    aj.files.save_calibration(folder / "written.h5", record._replace(recording=recording))
    write(folder / "in.csv", [f"q_{i}_rad" for i in range(1, 7)], Q)
    run(arms, "in.csv", "-o", "out.csv")
    rows = np.hstack([written.readings(Q), np.full((6, 1), 12.5)])
    write(folder / "raw.csv", [*names, "gripper.pos"], rows)
    command_line(folder, "correct", "written.h5", "raw.csv", "-o", "c.csv", "--as-recorded", "--overwrite")
    corrected, expected = table(folder / "c.csv"), table(folder / "out.csv")
    assert list(corrected[0]) == [*names, "gripper.pos"]
    raw = np.array([[float(row[name]) for name in names] for row in corrected])
    np.testing.assert_allclose(
        written.joint_values(raw), [[float(x) for x in row.values()] for row in expected], atol=1e-9
    )
    write(folder / "points.csv", ["x", "y", "z"], [[400, 200, 300]])
    near = ("--near", "0,0,0,0,0,0", "--as-recorded", "-o", "p.csv")
    says = command_line(folder, "correct", "written.h5", "points.csv", *near, expect=2).stderr
    assert "applies to joint readings" in " ".join(says.split())
    for options, text in ((["--unit", "deg"], "leave out --unit"), ([], "calibrate from one manifest")):
        says = run(arms, "raw.csv", "-o", "e.csv", "--as-recorded", *options, expect=2).stderr
        assert text in " ".join(says.split())


def test_readings_in_the_columns_and_unit_of_the_table(arms):
    folder, nominal, calibrated = arms
    header = ["name", *(f"q_{i}_deg" for i in range(1, 7)), "speed", "temperature_C"]
    write(folder / "in.csv", header, [[f"p{i}", *(q / DEG), 7, 23] for i, q in enumerate(Q)])
    found = json.loads(run(arms, "in.csv", "-o", "out.csv", "--json").stdout)
    assert any("column temperature_C has no effect" in text for text in found["warnings"])
    rows = table(folder / "out.csv")
    assert list(rows[0]) == header
    assert [row["name"] for row in rows] == [f"p{i}" for i in range(6)]
    q = DEG * np.array([[float(row[f"q_{i}_deg"]) for i in range(1, 7)] for row in rows])
    difference = np.asarray(calibrated.pose(q)) - np.asarray(nominal.pose(Q))
    assert np.abs(difference[:, :3, 3]).max() < 1e-3
    assert np.abs(difference[:, :3, :3]).max() < 1e-9
    before = np.linalg.norm(np.asarray(calibrated.position(Q)) - np.asarray(nominal.position(Q)), axis=1).max()
    assert found["largest_distance_before_mm"] == pytest.approx(before)
    assert before > 0.1
    assert (found["rows"], found["not_reached"], found["unit"]) == (6, [], "deg")
    change = np.abs(q - Q) / DEG
    largest = found["largest_change"]
    assert largest["change_deg"] == pytest.approx(change.max())
    assert (largest["row"] - 1, largest["joint"] - 1) == np.unravel_index(change.argmax(), change.shape)


@pytest.mark.slow
def test_a_table_without_header_and_a_tool_of_both_arms(arms):
    folder, nominal, calibrated = arms
    write(folder / "plain.csv", [], Q)
    run(arms, "plain.csv", "-o", "out.csv", "--unit", "rad", "--probe", "5,0,300")
    rows = table(folder / "out.csv")
    q = np.array([[float(row[f"q_{i}_rad"]) for i in range(1, 7)] for row in rows])
    tool = [np.asarray(arm.replace(probe=(5, 0, 300)).position(x)) for arm, x in ((nominal, Q), (calibrated, q))]
    np.testing.assert_allclose(tool[0], tool[1], rtol=0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("orientation", ["quaternion", "rotation vector"])
def test_positions_with_orientations(arms, orientation):
    folder, _, calibrated = arms
    poses = np.asarray(calibrated.pose(Q[:1] + 0.02 * np.arange(3)[:, None]))
    rotation = Rotation.from_matrix(poses[:, :3, :3])
    if orientation == "quaternion":
        names, numbers = ["qx", "qy", "qz", "qw"], rotation.as_quat()
    else:
        names, numbers = ["rx_deg", "ry_deg", "rz_deg"], rotation.as_rotvec() / DEG
    write(folder / "poses.csv", ["x_m", "y_m", "z_m", *names], np.hstack([poses[:, :3, 3] / 1000, numbers]))
    near = ",".join(str(x) for x in Q[0] / DEG)
    run(arms, "poses.csv", "-o", "out.csv", "--unit", "deg", f"--near={near}")
    q = DEG * np.array([[float(row[f"q_{i}_deg"]) for i in range(1, 7)] for row in table(folder / "out.csv")])
    np.testing.assert_allclose(calibrated.pose(q), poses, rtol=0, atol=1e-7)
    np.testing.assert_allclose(q, Q[:1] + 0.02 * np.arange(3)[:, None], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("given", ["readings", "poses", "points"])
def test_poses_for_a_controller_that_takes_nothing_else(arms, given):
    """The controller finds readings with the nominal arm; with them, the calibrated arm is where it was wanted."""
    folder, nominal, calibrated = arms
    q = Q[:1] + 0.02 * np.arange(3)[:, None]
    wanted = np.array(nominal.pose(q))
    wanted[:, :3, :3] = wanted[:1, :3, :3] if given == "points" else wanted[:, :3, :3]
    near = f"--near={','.join(str(x) for x in Q[0] / DEG)}"
    if given == "readings":
        write(folder / "poses.csv", [f"q_{i}_deg" for i in range(1, 7)], q / DEG)
        written, near, names = ("x_mm", "y_mm", "z_mm"), "--json", [f"{axis}_deg" for axis in ("rx", "ry", "rz")]
    else:
        written, names = ("x_m", "y_m", "z_m"), ["qw", "qx", "qy", "qz"] if given == "poses" else []
        turns = Rotation.from_matrix(wanted[:, :3, :3]).as_quat(scalar_first=True)[:, : len(names)]
        write(folder / "poses.csv", ["name", *written, *names], [
            [f"p{i}", *row] for i, row in enumerate(np.hstack([wanted[:, :3, 3] / 1000, turns]))
        ])  # fmt: skip
    run(arms, "poses.csv", "-o", "out.csv", "--unit", "deg", near, "--write", "poses")
    rows = table(folder / "out.csv")
    assert (list(rows[0]) == ["name", *written, *names]) == (given != "readings")
    commanded = wanted.copy()
    commanded[:, :3, 3] = [[float(row[name]) for name in written] for row in rows]
    commanded[:, :3, 3] *= 1 if given == "readings" else 1000
    numbers = np.array([[float(row[name]) for name in names] for row in rows])
    if names:
        turns = (
            Rotation.from_quat(numbers, scalar_first=True) if given == "poses" else Rotation.from_rotvec(numbers * DEG)
        )
        commanded[:, :3, :3] = turns.as_matrix()
    reached = np.asarray(calibrated.pose(aj.kinematics.readings_at_poses(nominal, q, commanded).q))
    assert np.linalg.norm(commanded[:, :3, 3] - wanted[:, :3, 3], axis=1).min() > 0.1
    np.testing.assert_allclose(reached[:, :3, 3], wanted[:, :3, 3], rtol=0, atol=1e-5)
    angle = 1e-8 if names else 0.02
    np.testing.assert_allclose(reached[:, :3, :3], wanted[:, :3, :3], rtol=0, atol=angle)


@pytest.mark.slow
def test_what_is_not_reached_is_named_by_row_and_left_empty(arms):
    folder, _, calibrated = arms
    poses = np.asarray(calibrated.pose(Q[:3])).copy()
    poses[1, :3, 3] *= 10
    header = ["x", "y", "z", "rx", "ry", "rz", *(f"q_{i}_rad" for i in range(1, 7))]
    vectors = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    write(folder / "far.csv", header, np.hstack([poses[:, :3, 3], vectors, Q[:3]]))
    said = run(arms, "far.csv", "-o", "out.csv", expect=1).stdout
    assert "2 of 3 poses are reached" in said
    assert "Poses that are not reached" in said
    rows = table(folder / "out.csv")
    assert [row["q_1_rad"] == "" for row in rows] == [False, True, False]
    found = json.loads(run(arms, "far.csv", "-o", "out.csv", "--json", expect=1).stdout)
    assert [row["row"] for row in found["not_reached"]] == [2]
    assert found["not_reached"][0]["distance_mm"] > 100


@pytest.mark.slow
def test_columns_of_other_names_and_positions_in_metres(arms):
    folder, nominal, _ = arms
    names = ["base", "shoulder", "elbow", "roll", "pitch", "yaw"]
    write(folder / "named.csv", ["speed", *names], [[7, *q] for q in Q])
    assert "--columns" in run(arms, "named.csv", "-o", "no.csv", "--unit", "rad", expect=2).stderr
    by_name = ("--columns", "base,shoulder,elbow,roll,pitch,yaw")
    for options in (by_name, ("--columns", "2,3,4,5,6,7")):
        run(arms, "named.csv", "-o", "out.csv", "--unit", "rad", *options)
        assert list(table(folder / "out.csv")[0]) == ["speed", *names]
    write(folder / "all.csv", names, Q)  # their order may be another than that of the joints
    assert "--columns 1, 2, 3, 4, 5, 6" in run(arms, "all.csv", "-o", "no.csv", "--unit", "rad", expect=2).stderr
    run(arms, "all.csv", "-o", "all-out.csv", "--unit", "rad", "--columns", "1,2,3,4,5,6")
    corrected = [[row[name] for name in names] for row in table(folder / "out.csv")]
    assert [[row[name] for name in names] for row in table(folder / "all-out.csv")] == corrected
    poses = np.asarray(nominal.pose(Q[:2]))
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    header = ["x", "y", "z", "qw", "qx", "qy", "qz", *names]
    write(folder / "m.csv", header, np.hstack([poses[:, :3, 3] / 1000, quaternions, Q[:2]]))
    run(arms, "m.csv", "-o", "m-out.csv", "--unit", "rad", "--length-unit", "m", *by_name)
    found = [[float(row[name]) for name in names] for row in table(folder / "m-out.csv")]
    np.testing.assert_allclose(found, np.array(corrected[:2], dtype=float), atol=1e-6)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """A folder with a calibration of the simulated robot by its tracker, and its record."""
    folder = tmp_path_factory.mktemp("robot")
    command_line(folder, "calibrate", ROBOT, "-o", "robot.h5", "--model", "dh", "--no-automatic")
    return folder, aj.files.load_calibration(folder / "robot.h5")


@pytest.mark.slow
def test_positions_in_the_frame_of_the_tracker_are_reached(robot):
    """By the robot as built, whose tracker and target are known; joint readings alone leave the tracker's frame."""
    folder, record = robot
    made = runpy.run_path(str(ROBOT.with_name("make.py")))
    true, station = made["_robot"](made["TARGET"]), np.array(made["STATION"])
    turn = Rotation.from_rotvec(station[:3])
    q = DEG * np.array([10, 30, 70, 10, 60, 0]) + 0.1 * np.arange(6)[:, None]
    wanted = turn.inv().apply(np.asarray(true.position(q)) - station[3:]) + np.array([2.0, -1, 1])
    header = [*(f"joint_{i}" for i in range(1, 7)), "x_t", "y_t", "z_t", "x_dif"]
    write(folder / "targets.csv", header, np.hstack([q / DEG, wanted, np.zeros((6, 1))]))
    command = ("correct", "robot.h5", "targets.csv", "-o", "out.csv", "--overwrite", "--unit", "deg")
    in_frame = ("--in-frame", "tracker", "--positions", "x_t,y_t,z_t", "--probe", "ball", "--json")
    found = json.loads(command_line(folder, *command, *in_frame).stdout)
    assert "columns x_t, y_t, z_t) in the frame of tracker" in found["targets"]
    assert found["largest_distance_before_mm"] == pytest.approx(math.sqrt(6), abs=0.3)
    corrected = DEG * np.array([[float(row[name]) for name in header[:6]] for row in table(folder / "out.csv")])
    seen = turn.inv().apply(np.asarray(true.position(corrected)) - station[3:])
    assert np.linalg.norm(seen - wanted, axis=1).max() < 0.15
    turned = np.asarray(record.calibrated.arm.pose(corrected))[:, :3, :3]
    np.testing.assert_allclose(turned, record.recording.nominal.arm.pose(q)[:, :3, :3], rtol=0, atol=1e-8)
    # The controller computes readings with the nominal arm from poses in its own base frame.
    commanded = json.loads(command_line(folder, *command, *in_frame, "--write", "poses").stdout)
    assert "in the base frame" in " ".join(commanded["warnings"])
    poses = np.array([[float(row[name]) for name in header[6:9]] for row in table(folder / "out.csv")])
    assert np.linalg.norm(poses - np.asarray(true.position(q)), axis=1).max() < 10
    readings = json.loads(command_line(folder, *command, "--json").stdout)
    assert "give --in-frame tracker" in readings["targets"]
    for wrong, said in ((in_frame[:2], "--positions"), (("--in-frame", "x", *in_frame[2:]), "(tracker)")):
        assert said in " ".join(command_line(folder, *command, *wrong, expect=2).stderr.split())


@pytest.mark.slow
def test_the_frame_of_an_instrument_takes_its_points_to_the_base(robot):
    """As the documentation of --json says: R x + origin."""
    folder, record = robot
    (observation,) = record.recording.capture.observations
    parts = {row["part"]: np.array(row["values"]) for row in json.loads(
        command_line(folder, "show", "robot.h5", "--json").stdout
    )["geometry"]}  # fmt: skip
    frame, arm = parts["frame of tracker"], record.calibrated.arm.replace(probe=parts["offset of ball"])
    placed = Rotation.from_rotvec(frame[:3]).apply(observation.points) + frame[3:]
    assert np.linalg.norm(placed - arm.position(observation.q), axis=1).max() < 0.2


def test_positions_are_reached_from_the_readings_beside_them(arms):
    folder, _, calibrated = arms
    points = np.asarray(calibrated.position(Q[:2])) + 5.0
    header = [*(f"q_{i}_rad" for i in range(1, 7)), "x", "y", "z"]
    write(folder / "both.csv", header, np.hstack([Q[:2], points]))
    found = json.loads(run(arms, "both.csv", "-o", "out.csv", "--json").stdout)
    q = np.array([[float(row[name]) for name in header[:6]] for row in table(folder / "out.csv")])
    np.testing.assert_allclose(calibrated.position(q), points, rtol=0, atol=1e-6)
    assert found["largest_distance_before_mm"] == pytest.approx(5 * math.sqrt(3))


@pytest.mark.slow
def test_positions_are_of_the_tip_or_of_a_target_by_its_name(robot):
    """The offset of the target was found by the calibration, and is not the tip of the arm."""
    tmp_path, record = robot
    (target,) = (np.asarray(at) for name, at in record.observed.geometry.items() if name == "offset of ball")
    nominal, calibrated = record.recording.nominal.arm, record.calibrated.arm
    q = DEG * np.array([10, 30, 70, 10, 60, 0]) + 0.02 * np.arange(3)[:, None]
    points = np.asarray(nominal.position(q)) + np.asarray(target) / 2
    write(tmp_path / "points.csv", ["x", "y", "z"], points)
    near = f"--near={','.join(str(x) for x in q[0] / DEG)}"
    for options, tip in (((), (0, 0, 0)), (("--probe", "ball"), target)):
        command = ("correct", "robot.h5", "points.csv", "-o", "out.csv", "--unit", "deg", near, *options, "--json")
        summary = json.loads(command_line(tmp_path, *command, "--overwrite").stdout)
        rows = table(tmp_path / "out.csv")
        q = DEG * np.array([[float(row[f"q_{i}_deg"]) for i in range(1, 7)] for row in rows])
        np.testing.assert_allclose(calibrated.replace(probe=tip).position(q), points, rtol=0, atol=1e-3)
        assert summary["probe_mm"][1] == pytest.approx(list(tip))
        assert any("give --probe ball" in text for text in summary["warnings"]) == (not options)
    said = command_line(tmp_path, *command[:-2], "bal", "--overwrite", expect=2).stderr
    assert "a target of the calibration (ball)" in " ".join(said.split())


def test_rows_at_a_singular_wrist_are_named():
    """Axes 4 and 6 of a UR10e align where joint 5 is at 0"""
    nominal = aj.load_arm("ur10e")
    q = np.tile([0.2, -1.0, 1.2, 0.4, 0.0, 0.3], (3, 1))
    q[:, 4] = 1.2, 0.0, 0.02
    found = corrected_readings(nominal, nominal.replace(d_6=nominal.d[5] + 0.01), q)
    summary = correction_summary(nominal, nominal, q, found, unit="rad", of_readings=True)
    assert summary["singular"] == [2]
    assert summary["warnings"][0].startswith("In 1 row (row 2) the nominal arm is at a singularity")


def test_rows_outside_the_recorded_poses_are_named():
    """Beyond 5 deg of their range, whole revolutions aside; what is not reached is named already."""
    nominal = aj.load_arm("ur10e")
    recorded = np.array([[0.2, -1.6, 1.0, 0.2, 0.7, -0.3], [0.4, -0.6, 1.4, 0.6, 1.3, 0.3]])
    q = np.tile(recorded.mean(axis=0), (4, 1))
    q[1, 2] += 0.2 + 20 * DEG
    q[2, 2] += 0.2 + 4 * DEG
    q[3, 0] -= 2 * np.pi
    found = corrected_readings(nominal, nominal.replace(d_6=nominal.d[5] + 0.01), q)
    about = {"unit": "rad", "of_readings": True}
    (said,) = correction_summary(nominal, nominal, q, found, recorded=recorded, **about)["warnings"]
    assert said.startswith("In 1 row (row 2) the arm is outside the poses of the calibration (joint 3 by up to 20 deg)")
    assert correction_summary(nominal, nominal, q, found, recorded=q, **about)["warnings"] == []


def test_poses_of_a_urdf_are_in_its_base_link():
    specification = aj.files.load_specification(URDF, base="shoulder", tip="tool0")
    base = aj.files.urdf_chain(specification.urdf).base
    assert not np.allclose(base, np.eye(4))
    program: dict = {}
    exec(aj.files.python_program(specification.arm, title="", base=base), program)
    record = SimpleNamespace(recording=SimpleNamespace(nominal=specification))
    q = Q[:, : specification.arm.joints]
    in_base_link = np.stack([program["pose"](row) for row in q])
    np.testing.assert_allclose(in_first_frame(record, in_base_link), specification.arm.pose(q), rtol=0, atol=1e-9)


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("header", "row", "options", "part"),
    [
        ([], [0] * 6, (), "--unit"),
        ([], [0] * 5, ("--unit", "deg"), "q_1 to q_6"),
        ([f"q_{i}_deg" for i in range(1, 7)], [0] * 6, ("--unit", "rad"), "states deg"),
        ([f"q_{i}_deg" for i in range(1, 7)], [0] * 6, ("--near", "0,0,0,0,0,0"), "the first is 'q_1_deg'"),
        (["x", "y", "z", "qw", "qx", "qy", "qz"], [1, 2, 3, 1, 0, 0, 0], ("--unit", "deg"), "--near"),
        (["x", "y", "z"], [1, 2, 3], ("--unit", "deg"), "or give --near"),
        (
            ["x", "y", "z", "qw", "qx", "qy", "qz"],
            [1, 2, 3, 1, 0, 0, 1],
            ("--unit", "deg", "--near", "0,0,0,0,0,0"),
            "row 1",
        ),
        ([f"q_{i}_deg" for i in range(1, 7)], [0] * 6, ("--in-frame", "A"), "no columns x, y and z"),
        ([f"q_{i}_deg" for i in range(1, 7)] + ["x", "y", "z"], [0] * 9, ("--in-frame", "A"), "of its frames (none)"),
        ([f"q_{i}_deg" for i in range(1, 7)], [0] * 6, ("--positions", "1,2"), "three, x, y and z"),
        (["qw", "qx", "qy", "qz"], [1, 0, 0, 0], ("--unit", "deg", "--near", "0,0,0,0,0,0"), "x, y and z"),
        ([], [0] * 6, ("--unit", "deg", "--probe", "1,2"), "--probe"),
    ],
)
def test_refusals(arms, header, row, options, part):
    write(arms[0] / "bad.csv", header, [row])
    assert part in run(arms, "bad.csv", "-o", "no.csv", *options, expect=2).stderr
    assert not (arms[0] / "no.csv").exists()
