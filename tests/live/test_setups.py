"""Live captures from files, and the command in a terminal."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.live.guidance import Guide

KIT = """
[[artefact]]
name = "bar"
points = { 1 = [0, 0, 0], 2 = [300, 0, 0] }
frame = [0, 0, 0.7, 300, -200, 300]
u = 0.001
poses = 4
places = 2
[[socket]]
name = "A"
point = [400, 200, 300]
poses = 4
[[points]]
name = "tracker"
box = [[200, -300, 100], [600, 300, 500]]
u = 0.02
"""
MANIFEST = """
arm = "cheng2018-simulation"
[[socket]]
name = "A"
file = "A.csv"
[[socket]]
name = "B"
file = "B.csv"
[[artefact]]
name = "plate"
files = { 1 = "1.csv", 2 = "2.csv", 3 = "3.csv" }
coordinates = { 1 = [0, 0, 0], 2 = [100, 0, 0], 3 = [0, 100, 0] }
u = 0.002
[[length]]
from = "A"
to = "B"
value = 500.01
u = 0.002
"""
HEADER = "pose,move,observation,point,x_mm,y_mm,z_mm," + ",".join(f"q_{i}_deg" for i in range(1, 7))
ROWS = [("A", "", 400, 0, 300), ("B", "", 400, 500, 300)]
ROWS += [("plate", str(i), x, y, 200) for i, x, y in ((1, 300, 100), (2, 300, 200), (3, 200, 100))]


def plan(folder):
    lines = [HEADER]
    for i, row in enumerate(ROWS, start=1):
        for move in ("approach", "pose"):
            lines.append(",".join(map(str, (i, move, *row, *range(i, i + 6)))))
    (folder / "plan.toml").write_text(MANIFEST)
    (folder / "plan.csv").write_text("\n".join(lines))
    return folder / "plan.toml"


def test_the_places_of_a_kit(tmp_path):
    (tmp_path / "kit.toml").write_text(KIT)
    setup = aj.live.read_setup("cheng2018-simulation", kit=tmp_path / "kit.toml")
    names = ["bar/1/1", "bar/1/2", "bar/2/1", "bar/2/2", "tracker", "A"]
    assert sorted(place.name for place in setup.places) == sorted(names)
    assert setup.place("bar/1/2").position is None  # where it is put up is found by touching
    assert setup.place("tracker").is_free
    assert not setup.place("A").is_free


def test_the_places_and_poses_of_a_plan(tmp_path):
    setup = aj.live.read_setup("cheng2018-simulation", plan=plan(tmp_path))
    assert [name for name, _ in setup.planned] == ["A", "B", "plate/1", "plate/2", "plate/3"]
    np.testing.assert_allclose(np.degrees(setup.planned[1][1]), np.arange(2, 8))
    for name, point, *position in ROWS:
        place = setup.place(f"{name}/{point}" if point else name)
        np.testing.assert_allclose(place.position, position, atol=1e-9)
    assert [(length.start, length.end, float(length.value)) for length in setup.lengths] == [("A", "B", 500.01)]


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda plan: plan.with_suffix(".csv").unlink(), "plan.csv is missing"),
        (lambda plan: plan.with_suffix(".csv").write_text("pose,x_mm\n1,2\n"), "no columns q_1_deg"),
        (lambda plan: plan.write_text(MANIFEST.replace('name = "B"', 'name = "C"')), "no pose in 'C'"),
        (lambda plan: plan.write_text(MANIFEST + '[[transforms]]\nname = "T"\nfile = "t.csv"\n'), "--kit"),
    ],
)
def test_plans_that_do_not_fit_are_refused(tmp_path, change, says):
    change(plan(tmp_path))
    with pytest.raises(aj.InputError, match=says):
        aj.live.read_setup("cheng2018-simulation", plan=tmp_path / "plan.toml")


def test_instruments_and_sessions_make_a_capture(tmp_path):
    (tmp_path / "kit.toml").write_text(KIT.replace("places = 2\n", ""))
    setup = aj.live.read_setup("cheng2018-simulation", kit=tmp_path / "kit.toml")
    random, poses = np.random.default_rng(0), []
    for number, place in enumerate(["A", "tracker", "bar/2", "A", "bar/1", "tracker", "tracker", "A"], start=1):
        measured = {"points": random.normal(size=3)} if place == "tracker" else {}
        q = random.normal(size=6)
        poses.append(aj.live.TakenPose(number, place, 0.0, q, q, {}, measured, session=1 + (number > 6)))
    poses.append(poses[0]._replace(number=9))  # the same readings again
    poses.append(poses[0]._replace(number=10, q=np.zeros(6), excluded=True))
    capture, numbers = aj.live.capture_of(setup, poses)
    rows = np.asarray(capture.readings)
    by_number = {pose.number: pose.q for pose in poses}
    assert sorted(numbers) == [1, 2, 3, 4, 5, 6, 7, 8]
    for row, number in zip(rows, numbers, strict=True):
        np.testing.assert_array_equal(row, by_number[number])
    tracker = next(part for part in capture.observations if part.name == "session 1/tracker")
    np.testing.assert_array_equal(tracker.points, [poses[1].measured["points"], poses[5].measured["points"]])
    with pytest.raises(aj.InputError, match="has no measured point"):
        aj.live.capture_of(setup, [poses[1]._replace(measured={})])


LENGTH = """
[[socket]]
name = "B"
point = [400, 500, 300]
[[length]]
from = "A"
to = "B"
value = 300.02
u = 0.002
"""


def kit_of_sockets(folder, lengths):
    (folder / "kit.toml").write_text(KIT[KIT.index("[[socket]]") : KIT.index("[[points]]")] + lengths)
    return aj.live.read_setup("cheng2018-simulation", kit=folder / "kit.toml")


@pytest.mark.slow
def test_certified_lengths_of_a_kit_give_the_scale(tmp_path):
    assert Guide(kit_of_sockets(tmp_path, LENGTH), 0.1).search.scaled
    assert not Guide(kit_of_sockets(tmp_path, LENGTH[: LENGTH.index("[[length]]")]), 0.1).search.scaled


def test_certified_lengths_of_a_kit_are_in_the_capture(tmp_path):
    setup, random = kit_of_sockets(tmp_path, LENGTH), np.random.default_rng(0)
    poses = [aj.live.TakenPose(i, "AB"[i % 2], 0.0, random.normal(size=6), np.zeros(6)) for i in range(4)]
    for taken, sessions in ((poses, [""]), ([p._replace(session=1 + (p.number > 1)) for p in poses], ["1", "2"])):
        lengths = aj.live.capture_of(setup, taken)[0].lengths
        ends = [(f"session {s}/A", f"session {s}/B") if s else ("A", "B") for s in sessions]
        assert [(length.start, length.end) for length in lengths] == ends
        assert {(float(length.value), float(length.u)) for length in lengths} == {(300.02, 0.002)}
    at = aj.live.open_device("simulated:?seed=1", setup).positions
    assert np.linalg.norm(at["A"] - at["B"]) == pytest.approx(300.02, abs=1e-9)
    with pytest.raises(aj.InputError, match=r"\[\[length\]\], which only a live capture uses"):
        aj.files.read_kit(tmp_path / "kit.toml")
    with pytest.raises(aj.InputError, match=r"A - C: the kit has no \[\[socket\]\] 'C'"):
        kit_of_sockets(tmp_path, LENGTH.replace('to = "B"', 'to = "C"'))


@pytest.mark.slow
def test_the_plan_of_the_laboratorys_page_is_captured(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "readers" / "measuring_arm_laboratory.md").read_text()
    (planning,) = re.findall(r"^\$ aacmm (plan (?:.*\\\n)*.*)$", page, re.M)
    (capturing,) = re.findall(r"^aacmm (live .*)$", page, re.M)
    command = [sys.executable, "-m", "aacmm_jax"]
    subprocess.run(
        [*command, *shlex.split(planning.replace("\\\n", " "))], cwd=tmp_path, check=True, capture_output=True
    )
    simulated = shlex.split(capturing.replace("serial:/dev/ttyUSB0", "'simulated:?speed=20'"))
    live = subprocess.Popen(
        [*command, *simulated, "--terminal"], cwd=tmp_path, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert live.stdout.readline().startswith("pose 1 in ")
    output, _ = live.communicate("q", timeout=120)
    assert live.returncode == 0, output
    assert "are kept in capture.h5.journal" in output


def test_a_robot_of_several_chains_is_captured_chain_by_chain():
    arm = aj.load_arm("cheng2018-simulation")
    robot = aj.kinematics.together({"left": arm, "right": arm})
    with pytest.raises(aj.InputError, match=r"of one chain, but this robot has 2 \(left, right\); name the tip"):
        aj.live.setup_of(aj.kinematics.ArmSpecification(robot, "two"), aj.files.load_noise("cheng2018-simulation"), [])


@pytest.mark.slow
def test_the_command_in_a_terminal(tmp_path):
    (tmp_path / "kit.toml").write_text(KIT.replace("places = 2\n", "").partition("[[points]]")[0])
    command = [sys.executable, "-m", "aacmm_jax", "live", "cheng2018-simulation", "--terminal", "--kit", "kit.toml"]
    command += ["--device", "simulated:?speed=20", "-o", "c.h5", "--capture-only"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline().startswith("pose 1 in ")
    output, errors = process.communicate("f", timeout=120)
    assert process.returncode == 0, errors
    assert "written: c.h5" in output
    assert aj.files.load_capture(tmp_path / "c.h5").nominal.arm.joints == 6


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--kit", "absent.toml"], "absent.toml"),
        ([], "give either a plan"),
        (["--kit", "kit.toml", "--plan", "kit.toml"], "give either a plan"),
    ],
)
def test_wrong_options_are_one_sentence(tmp_path, arguments, says):
    (tmp_path / "kit.toml").write_text(KIT)
    options = zip(arguments[::2], arguments[1::2], strict=True)
    given = {name.removeprefix("--"): tmp_path / file for name, file in options}
    with pytest.raises(aj.InputError, match=says):
        aj.live.read_setup("cheng2018-simulation", **given)
