"""Robots of several chains in files: URDF with several tips, manifests with a chain, and what is stored of them."""

from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.files.arms import specification_toml
from aacmm_jax.kinematics.collisions import capsule_ends
from aacmm_jax.kinematics.parameters import ArmSpecification

LIMIT = '<limit lower="-2" upper="2"/>'


def joint(name: str, kind: str, parent: str, child: str, origin: str, more: str = "") -> str:
    """A joint of a URDF."""
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<link name="{child}"/><joint name="{name}" type="{kind}">{ends}<origin {origin}/>{more}</joint>'


SIDES = "".join(
    joint(f"{side}1", "revolute", "trunk", f"{side}a", f'xyz="0 {y} 0.1" rpy="{y} 0 0"', f'<axis xyz="0 0 1"/>{LIMIT}')
    + joint(f"{side}2", "revolute", f"{side}a", f"{side}b", 'xyz="0.3 0 0.1" rpy="1.5 0.2 0"', LIMIT)
    + joint(f"{side}3", "revolute", f"{side}b", f"{side}c", 'xyz="0.3 0.1 0" rpy="0.1 1.2 0"', LIMIT)
    + joint(f"{side}4", "fixed", f"{side}c", f"{side}_tool", 'xyz="0.2 0.1 0.1"')
    for side, y in (("left", 0.2), ("right", -0.2))
)
LIFT = joint("lift", "prismatic", "base", "trunk", 'xyz="0 0 0.3" rpy="0 0.1 0"', f'<axis xyz="0 0 1"/>{LIMIT}')
MIMIC = '<mimic joint="right3" multiplier="-0.5" offset="0.1"/>'
FINGER = joint("finger", "prismatic", "right_tool", "finger", 'xyz="0.05 0 0"', LIMIT + MIMIC)
ROBOT = (
    f'<robot name="two"><link name="base"/>{LIFT}{SIDES}{FINGER}{joint("c", "fixed", "trunk", "camera", "")}</robot>'
)


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    """A trunk on a lift with two arms, one of which has a finger that follows another joint."""
    path = tmp_path / "two.urdf"
    path.write_text(ROBOT)
    return path


def readings(robot: aj.Arm) -> np.ndarray:
    """Readings of all joints, with a chain that takes turns."""
    q = np.random.default_rng(0).uniform(-1, 1, (6, robot.joints))
    return np.column_stack([q, np.arange(6) % len(robot.chains)])


def test_fingers_of_grippers_are_no_chains(tmp_path):
    fingers = "".join(
        joint(f"{side}_finger{i}", "prismatic", f"{side}_tool", f"{side}_f{i}", "", LIMIT)
        for side in ("left", "right")
        for i in (1, 2)
    )
    follower = joint("follower", "prismatic", "left_f1", "jaw", "", LIMIT + '<mimic joint="right_finger1"/>')
    path = tmp_path / "grippers.urdf"
    for more in ("", follower):
        path.write_text(f'<robot name="two"><link name="base"/>{LIFT}{SIDES}{fingers}{more}</robot>')
        assert [name for name, _ in aj.load_arm(path).chains] == ["left_tool", "right_tool"]


def test_several_tips_are_a_robot(urdf):
    robot = aj.load_arm(urdf)
    assert [name for name, _ in robot.chains] == ["left_tool", "finger"]
    (followed,) = robot.mimic
    assert followed[2:] == (-500.0, 100.0)  # mm by rad, and mm
    for tips in (["left_tool", "right_tool"], ["right_tool", "left_tool"]):
        chosen = aj.load_arm(urdf, tip=tips)
        for tip in tips:
            plain, chain = aj.load_arm(urdf, tip=tip), aj.kinematics.chain_of(chosen, tip)
            q = np.random.default_rng(1).uniform(-1, 1, (5, plain.joints))
            np.testing.assert_allclose(chosen.pose(chain.readings(q)), plain.pose(q), atol=1e-9)


@pytest.mark.slow
def test_a_calibrated_robot_is_written_back(urdf):
    nominal = aj.files.load_specification(urdf)
    assert aj.files.urdf_of(nominal.arm, nominal).text == ROBOT
    calibrated = aj.perturbed_arm(aj.Parameters.free_of(nominal.arm), length=3.0, angle=0.01, seed=1)
    exported = aj.files.save_urdf(calibrated, urdf.with_name("calibrated.urdf"), nominal=nominal)
    assert "lift" not in exported.changed
    again, q = aj.load_arm(urdf.with_name("calibrated.urdf")), readings(calibrated)
    np.testing.assert_allclose(again.pose(q), calibrated.pose(q), atol=1e-9)


def test_the_base_of_an_arm_beside_another_is_written_back(tmp_path):
    path = tmp_path / "table.urdf"
    path.write_text(ROBOT.replace(LIFT, joint("lift", "fixed", "base", "trunk", 'xyz="0 0 0.3"')))
    nominal = aj.files.load_specification(path, tip=["left_tool", "right_tool"])
    calibrated = aj.perturbed_arm(aj.Parameters.free_of(nominal.arm), length=3.0, angle=0.01, seed=1)
    path.write_text(aj.files.urdf_of(calibrated, nominal).text)
    q = readings(calibrated)
    np.testing.assert_allclose(
        aj.load_arm(path, tip=["left_tool", "right_tool"]).pose(q), calibrated.pose(q), atol=1e-9
    )


def test_toml_and_captures_keep_a_robot(urdf, tmp_path):
    robot = aj.load_arm(urdf)
    (tmp_path / "robot.toml").write_text(specification_toml(ArmSpecification(robot, "two")))
    again = aj.load_arm(tmp_path / "robot.toml")
    facts = ("chains", "fixed", "mimic", "prismatic", "limits")
    assert [getattr(again, fact) for fact in facts] == [getattr(robot, fact) for fact in facts]
    q = readings(robot)
    np.testing.assert_array_equal(again.position(q), robot.position(q))
    recording = aj.data.Recording(aj.Capture({"A": q}), ArmSpecification(robot, "two"))
    aj.files.save_capture(tmp_path / "capture.h5", recording)
    stored = aj.files.load_capture(tmp_path / "capture.h5")
    np.testing.assert_array_equal(stored.capture.sockets["A"], q)
    np.testing.assert_array_equal(stored.nominal.arm.position(q), robot.position(q))
    assert [getattr(stored.nominal.arm, fact) for fact in facts] == [getattr(robot, fact) for fact in facts]


MANIFEST = """arm = { left = "panda", right = "panda" }
bases = { right = [0, -700, 0, 0, 0, 10] }
angles = { unit = "rad" }
socket = [
  { name = "A", file = "left_A.csv", chain = "left" },
  { name = "A", file = "right_A.csv", chain = "right" },
  { name = "B", file = "left_B.csv", chain = "left" },
  { name = "B", file = "right_B.csv", chain = "right" },
  { name = "C", file = "left_C.csv", chain = "left" },
  { name = "C", file = "right_C.csv", chain = "right" },
]
"""


@pytest.fixture
def two_arms(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """A manifest of two arms that were in the same three sockets, and the base of the second."""
    panda = aj.load_arm("panda")
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = aj.kinematics.axes_to_dh.rotation(2, 0.2)[:3, :3], (40.0, -820.0, 5.0)
    robot = aj.kinematics.together({"left": panda, "right": panda}, bases={"right": base})
    places = {"A": (450, -350, 300), "B": (500, -450, 200), "C": (400, -400, 400)}
    capture = aj.simulate(robot, places, poses=8)
    for socket, q in capture.sockets.items():
        for number, (name, _) in enumerate(robot.chains):
            own = aj.kinematics.chain_of(robot, name).of_robot(np.asarray(q)[np.asarray(q)[:, -1] == number])
            np.savetxt(tmp_path / f"{name}_{socket}.csv", own, delimiter=",")
    (tmp_path / "two.toml").write_text(MANIFEST)
    return tmp_path / "two.toml", base


@pytest.mark.slow
def test_bases_are_found_from_what_two_arms_touched(two_arms):
    path, base = two_arms
    recording = aj.files.read_manifest(path)
    assert recording.capture.sizes == (8, 8, 8)
    np.testing.assert_allclose(aj.kinematics.chain_of(recording.nominal.arm, "right").base, base, atol=1e-6)


REFUSED = {
    'chain = "left" }': ('chain = "middle" }', "has no chain 'middle'"),
    ', chain = "left"': ("", "state the chain"),
    "bases = { right": ("bases = { wrong", "unknown arm 'wrong'"),
    "700, 0, 0, 0, 10]": ("700]", "x, y, z in mm"),
    'right_A.csv", chain = "right"': ('left_A.csv", chain = "left"', "defined twice"),
}


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("line", REFUSED)
def test_manifests_are_refused_in_one_sentence(two_arms, line):
    path, _ = two_arms
    other, words = REFUSED[line]
    path.write_text(MANIFEST.replace(line, other, 1))
    with pytest.raises(aj.InputError, match=words) as error:
        aj.files.read_manifest(path)
    assert "\n" not in str(error.value)


LOOPED = ROBOT.replace('<parent link="base"/>', '<parent link="left_tool"/>')
BAD = {
    "cyclic": (LOOPED, {"base": "trunk"}, "loop"),
    "no such tip": (ROBOT, {"tip": ["left_tool", "hand"]}, "no link 'hand'"),
    "mimics what is not in a chain": (ROBOT.replace('joint="right3"', 'joint="none"'), {}, "mimics 'none'"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_refused_in_one_sentence(tmp_path, what):
    text, options, words = BAD[what]
    (tmp_path / "bad.urdf").write_text(text)
    with pytest.raises(aj.InputError, match=words) as error:
        aj.load_arm(tmp_path / "bad.urdf", **options)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_the_body_of_a_robot_has_the_collision_shapes_of_all_chains_once(tmp_path):
    shape = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'
    path = tmp_path / "two.urdf"
    links = ("trunk", *(f"{side}{part}" for side in ("left", "right") for part in "abc"))
    text = ROBOT
    for link in links:
        text = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{shape}</link>')
    path.write_text(text)
    tips = ["left_tool", "right_tool"]
    robot, body = to_numpy(aj.load_arm(path, tip=tips)), aj.files.load_cell(path, tip=tips).cell.body
    assert sorted(body.names) == sorted(links)
    pairs = {frozenset((body.names[i], body.names[j])) for i, j in body.pairs}
    assert frozenset(("lefta", "rightc")) in pairs
    assert frozenset(("lefta", "leftb")) not in pairs
    q = readings(robot)
    start, _ = capsule_ends(body, robot, q)
    for tip, links in (("left_tool", ("trunk", "lefta", "leftc")), ("right_tool", ("trunk", "rightb"))):
        own = aj.files.load_cell(path, tip=tip).cell.body
        plain, chain = to_numpy(aj.load_arm(path, tip=tip)), aj.kinematics.chain_of(robot, tip)
        alone, _ = capsule_ends(own, plain, chain.of_robot(q))
        for link in links:
            np.testing.assert_allclose(start[body.names.index(link)], alone[own.names.index(link)], atol=1e-9)


CONTACTS = """
arm = "two.urdf"
tip = ["left_tool", "right_tool"]
angles = { unit = "rad", columns = ["q_1", "q_2", "q_3", "q_4"] }
[[socket]]
file = "left.csv"
group = "contact"
chain = "left_tool"
[[contact_sphere]]
name = "ball"
file = "right.csv"
columns = { socket = "contact" }
chain = "right_tool"
diameter = 30.0
stylus = 6.0
"""


# Joint 6 of the robot is that from the trunk, which the lift carries, to the right arm, whose joints are 7 to 9.
LINKS = {"": 1, "link = 3\n": 1.008, 'link = "righta"\n': 1.007, 'link = "trunk"\n': 1.006}
NO_LINKS = {
    'link = "leftb"\n': "chain 'right_tool' has no moving link 'leftb'; choose one of trunk, righta, rightb",
    "link = 5\n": "link 5 does not exist; give the number of a link of the chain, 1 to 4",
}


@pytest.mark.slow
@pytest.mark.parametrize("line", [*LINKS, *NO_LINKS])
def test_contacts_of_a_manifest_name_the_sockets_of_the_other_chain(urdf, tmp_path, line):
    q = np.random.default_rng(0).uniform(-1, 1, (6, 4))
    rows = [",".join([f"c{i}", *map(str, row)]) for i, row in enumerate(q.tolist())]
    for side in ("left", "right"):
        (tmp_path / f"{side}.csv").write_text("\n".join(["contact,q_1,q_2,q_3,q_4", *rows]))
    (tmp_path / "m.toml").write_text(CONTACTS + line)
    if line in NO_LINKS:
        with pytest.raises(aj.InputError, match=NO_LINKS[line]):
            aj.files.read_manifest(tmp_path / "m.toml")
        return
    recording = aj.files.read_manifest(tmp_path / "m.toml")
    aj.files.save_capture(tmp_path / "c.h5", recording)
    capture = aj.files.load_capture(tmp_path / "c.h5").capture
    (contact,) = capture.observations
    assert contact.kind == "sphere contact"
    assert contact.socket == tuple(f"c{i}" for i in range(6)) == tuple(capture.sockets)
    assert {int(q[0, -1]) for q in capture.sockets.values()} == {0}
    assert set(np.asarray(contact.q)[:, -1]) == {LINKS[line]}
    assert contact.radius == 18.0
