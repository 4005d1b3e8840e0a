"""URDF in and out, against an independent reader; and what is refused."""

import re
from pathlib import Path

import numpy as np
import pytest
import yourdfpy

import aacmm_jax as aj
from aacmm_jax.files.arm_tables import with_model
from aacmm_jax.files.urdf import urdf_chain, urdf_of
from aacmm_jax.kinematics.axes_to_dh import dh_frames, geometry_of
from aacmm_jax.summaries.calibration import masses_sentence

from ..refusals import assert_refused

FILE = Path(__file__).with_name("six_axis.urdf")
TEXT = FILE.read_text()
JOINTS = [f"joint_{i}" for i in range(1, 7)]
Q = np.random.default_rng(0).uniform(-1.9, 1.9, (20, 6))


def independent(path: Path, tip: str, base: str = "world") -> np.ndarray:
    """Poses of a link by yourdfpy, mm."""
    model = yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=True)
    poses = []
    for row in Q:
        model.update_cfg(dict(zip(JOINTS, row, strict=True)))
        poses.append(model.get_transform(tip, base).copy())
    found = np.array(poses)
    found[:, :3, 3] *= 1000
    return found


def assert_same(found, expected):
    found, expected = np.asarray(found), np.asarray(expected)
    np.testing.assert_allclose(found[:, :3, 3], expected[:, :3, 3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[:, :3, :3], expected[:, :3, :3], rtol=0, atol=1e-12)


def written(folder: Path, text: str, name: str = "robot.urdf") -> Path:
    path = folder / name
    path.write_bytes(text.encode())
    return path


@pytest.fixture(scope="module")
def nominal():
    return aj.files.load_specification(FILE, tip="tool0")


def changed(arm: aj.Arm, seed: int = 1) -> aj.Arm:
    """The arm as a calibration might find it: every parameter is another."""
    random = np.random.default_rng(seed)
    lengths, angles = random.normal(size=(2, 6)), 1e-3 * random.normal(size=(3, 6))
    beta = np.zeros(6) if arm.beta is None else arm.beta
    return arm.replace(
        a=arm.a + lengths[0],
        d=arm.d + lengths[1],
        alpha=arm.alpha + angles[0],
        theta=arm.theta + angles[1],
        beta=beta + angles[2],
        probe=arm.probe + random.normal(size=3),
    )


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("tip", ["tool0", "flange"])
def test_arm_is_the_chain_of_the_file(tip):
    arm = aj.load_arm(FILE, base="base_link", tip=tip)
    assert_same(arm.pose(Q), independent(FILE, tip))  # the first axis is z of the base: no other frame
    assert arm.limits[0] == (-2 * np.pi, 2 * np.pi)
    assert arm.limits[1] == (-1.9, 2.1)


def test_readings_are_the_joint_values_of_the_file(nominal):
    """No sign changes: a positive step of a joint turns the tip about its axis by the right-hand rule."""
    chain = urdf_chain(nominal.urdf)
    assert [joint.name for joint in chain.joints] == JOINTS
    q = np.zeros(6)
    before, after = (np.asarray(nominal.arm.pose(x)) for x in (q, q + 1e-6 * np.eye(6)[1]))
    turn = (after[:3, :3] @ before[:3, :3].T - np.eye(3)) / 1e-6
    axis = np.array([np.sin(0.2), -np.cos(0.2), 0])  # -y of the shoulder, which joint 1 turns by 0.2 at reading 0
    np.testing.assert_allclose([turn[2, 1], turn[0, 2], turn[1, 0]], axis, atol=1e-6)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("text", [TEXT, TEXT.replace("\n", "\r\n"), "\ufeff" + TEXT, TEXT.rstrip()])
def test_uncalibrated_export_is_the_file_to_the_byte(tmp_path, text):
    path = written(tmp_path, text)
    specification = aj.files.load_specification(path, tip="tool0")
    found = aj.files.save_urdf(specification.arm, tmp_path / "out.urdf", nominal=specification)
    assert (tmp_path / "out.urdf").read_bytes() == path.read_bytes()
    assert (found.changed, found.notes, found.tip) == ((), (), "tool0")


@pytest.mark.filterwarnings("ignore")
def test_calibrated_export_is_the_calibrated_arm(tmp_path, nominal):
    arm = changed(nominal.arm)
    found = aj.files.save_urdf(arm, tmp_path / "out.urdf", nominal=nominal)
    expected = np.asarray(arm.pose(Q))
    assert_same(aj.load_arm(tmp_path / "out.urdf", tip="tool0").pose(Q), expected)
    assert_same(independent(tmp_path / "out.urdf", "tool0"), expected)
    assert found.changed == (*JOINTS, "flange-tool0")
    # Nothing but origins changed; joint_3, which had none, got one.
    assert without_origins(found.text) == without_origins(TEXT)
    assert found.text.count("<origin") == TEXT.count("<origin") + 1


def without_origins(text: str) -> str:
    return re.sub(r"\s*<origin[^>]*>", "", text)


@pytest.mark.filterwarnings("ignore")
def test_one_zero_offset_changes_one_origin(tmp_path, nominal):
    found = urdf_of(nominal.arm.replace(theta_4=float(nominal.arm.theta[3]) + 0.01), nominal)
    assert found.changed == ("joint_4",)
    before, after = (text.splitlines() for text in (TEXT, found.text))
    (line,) = [i for i, (one, other) in enumerate(zip(before, after, strict=True)) if one != other]
    assert 'xyz="0.35 0 0.03"' in after[line]  # only rpy changed


@pytest.mark.first_rows(1)
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("tip", "probe"), [("flange", None), ("tool0", (3.0, -4.0, 100.0))])
def test_a_tip_that_no_origin_moves_becomes_a_link(tmp_path, tip, probe):
    """Where no fixed joint ends at the tip link, or the arm has a tool, the calibrated tip is a link of its own."""
    nominal = aj.files.load_specification(FILE, tip=tip, probe=probe)
    arm = changed(nominal.arm)
    found = aj.files.save_urdf(arm, tmp_path / "out.urdf", nominal=nominal)
    assert found.tip == f"{tip}_probe"
    assert found.notes
    expected = np.asarray(arm.pose(Q))
    assert_same(aj.load_arm(tmp_path / "out.urdf", tip=found.tip).pose(Q), expected)
    assert_same(independent(tmp_path / "out.urdf", found.tip), expected)
    if probe is not None:  # the tool's own error does not move the flange
        shifted = urdf_of(nominal.arm.replace(probe_z=float(nominal.arm.probe[2]) + 2), nominal)
        assert shifted.changed == ()


def test_masses_of_what_each_joint_carries(nominal):
    chain = urdf_chain(nominal.urdf)
    found = aj.files.link_masses(chain)
    np.testing.assert_allclose(found.mass, [4, 4, 0, 0, 0, 0])
    # In the world at reading 0: shoulder at z = 300 + 100; upper (3 kg at 200), its cover (1 kg at 400) from z = 400.
    frames = dh_frames(geometry_of(chain.arm), chain.base)
    first, second = (frames[i + 1][:3, :3] @ found.centre[i] + frames[i + 1][:3, 3] for i in (0, 1))
    np.testing.assert_allclose(first, [0, 0, 400], atol=1e-9)
    along = 50 * np.array([np.cos(0.2), np.sin(0.2)])
    np.testing.assert_allclose(second, [*along, 400 + (3 * 200 + 400) / 4], atol=1e-9)


def test_gravity_is_one_model_with_or_without_masses(nominal):
    """Those of a URDF, which seldom has all, count only where the model says so, which a result then states."""
    general = with_model(nominal, "gravity").arm
    assert all(term.number and term.loads is None for term in general.corrections.functions.terms)
    assert masses_sentence(general) is None
    loaded = with_model(nominal, "gravity=masses").arm
    assert set(loaded.corrections.functions.names) == {"compliance_2"}  # the masses end there, and axis 1 is vertical
    assert masses_sentence(loaded).startswith(
        "Masses taken as known (gravity=masses): 4, 4, 0, 0, 0, 0 kg by link, 8 kg in all."
    )


def test_files_keep_the_urdf(tmp_path, nominal):
    sockets = {"A": Q[:4]}
    recording = aj.Recording(aj.Capture(sockets), nominal)
    aj.files.save_capture(tmp_path / "capture.h5", recording)
    assert aj.files.load_capture(tmp_path / "capture.h5").nominal.urdf == nominal.urdf
    assert nominal.urdf.text == TEXT


def test_manifest_and_arm_file_name_a_urdf(tmp_path, nominal):
    written(tmp_path, TEXT)
    np.savetxt(tmp_path / "a.csv", Q[:4], delimiter=",")
    manifest = written(
        tmp_path,
        'arm = "robot.urdf"\ntip = "tool0"\nprobe = [0, 0, 50]\n[angles]\nunit = "rad"\n[[socket]]\nfile = "a.csv"\n',
        "capture.toml",
    )
    found = aj.files.read_manifest(manifest).nominal
    assert (found.urdf.base, found.urdf.tip) == ("world", "tool0")
    np.testing.assert_allclose(
        found.arm.position(Q), (np.asarray(nominal.arm.pose(Q)) @ [0, 0, 50, 1])[:, :3], atol=1e-9
    )
    head = 'urdf = "robot.urdf"\ntip = "tool0"\nlength_unit = "mm"\nangle_unit = "deg"\n'
    arm = written(tmp_path, head + 'probe = [0, 0, 50]\n[identification]\nheld = ["d_1"]\nangle = 2\n', "arm.toml")
    stated = aj.files.load_specification(arm)
    assert (stated.held, stated.urdf.tip, stated.name) == (("d_1",), "tool0", "arm")
    np.testing.assert_array_equal(stated.arm.probe, found.arm.probe)
    assert_refused(lambda: aj.load_arm(arm, tip="tool0"), "is not a URDF", "omit base and tip")
    assert_refused(lambda: aj.load_arm("panda", probe=(0, 0, 1)), "already states the probe")
    both = written(tmp_path, head + "joint = [{alpha = 0, a = 1, d = 0}]\n", "both.toml")
    assert_refused(lambda: aj.load_arm(both), "exactly one of joint and urdf", "or urdf")


def joint(name: str, **changes: str) -> tuple[str, str]:
    """A replacement in the text: the joint's elements with other ones."""
    start = TEXT.index(f'name="{name}"')
    old = TEXT[start : TEXT.index("</joint>", start)]
    new = old
    for key, value in changes.items():
        new = re.sub(rf"<{key}[^>]*/>", value, new)
    return old, new


ISLAND = ('<link name="wrist_2"/>', '<link name="wrist_2"/><link name="island"/>')
BACK = '<child link="base_link"/></joint><joint name="back" type="fixed"><parent link="tool0"/><child link="world"/>'
REFUSED = {
    "several tips": (None, {"tip": None}, ["'upper_cover', 'tool0', 'left_finger'", "choose the tip"]),
    "unknown tip": (None, {"tip": "tool9"}, ["no link 'tool9'", "its links are 'world'"]),
    "branches": (None, {"base": "upper_cover"}, ["two branches", "separate at 'upper'"]),
    "exchanged": (None, {"base": "tool0", "tip": "world"}, ["is after the tip 'world'", "exchange base and tip"]),
    "same": (None, {"base": "tool0"}, ["same link"]),
    "nothing moves": (None, {"tip": "base_link"}, ["no moving joint between 'world' and 'base_link'"]),
    "endless slide": (joint("finger_1", limit=""), {"tip": "left_finger"}, ["'finger_1' is prismatic and has no"]),
    "reversed slide": (
        joint("finger_1", limit='<limit lower="0.04" upper="0"/>'), {"tip": "left_finger"}, ["limits 0.04 and 0 m;"]
    ),
    "mimic": (
        ('<mimic joint="joint_6"/>', '<mimic joint="finger_1"/>'),
        {"tip": "right_finger"},
        ["'finger_2' mimics 'finger_1'"],
    ),
    "floating": (("joint_4\" type=\"revolute", "joint_4\" type=\"floating"), {}, ["'joint_4' is floating"]),
    "planar": (("joint_4\" type=\"revolute", "joint_4\" type=\"planar"), {}, ["'joint_4' is planar"]),
    "type": (("joint_4\" type=\"revolute", "joint_4\" type=\"screw"), {}, ["unknown type 'screw'"]),
    "zero axis": (joint("joint_5", axis='<axis xyz="0 0 0"/>'), {}, ["'joint_5'", "axis of length 0"]),
    "no limits": (joint("joint_5", limit=""), {}, ["'joint_5' is revolute and has no limits", "continuous"]),
    "reversed limits": (joint("joint_5", limit='<limit lower="1" upper="-1"/>'), {}, ["limits 1 and -1 rad"]),
    "limits in degrees": (joint("joint_5", limit='<limit lower="-90" upper="120"/>'), {}, ["-90 and 120 rad"]),
    "angles in degrees": (('rpy="0 -1.5708 0"', 'rpy="0 -90 0"'), {}, ["of joint", "rpy = '0 -90 0'", "in degrees"]),
    "no root": (('<child link="base_link"/>', BACK), {"tip": None}, ["every link has a joint before it", "a tree"]),
    "not finite": (('xyz="0.35 0 0.03"', 'xyz="nan 0 0"'), {}, ["'nan 0 0'", "3 numbers"]),
    "millimetres": (('xyz="0.35 0 0.03"', 'xyz="350 0 30"'), {}, ["352 m long", "divide the lengths by 1000"]),
    "two parents": (('<child link="upper_cover"/>', '<child link="forearm"/>'), {}, ["child of two joints"]),
    "circle": (('<child link="base_link"/>', BACK), {"base": "base_link"}, ["form a loop"]),
    "no such link": (('<link name="wrist_2"/>', ""), {}, ["names the link 'wrist_2', which does not exist"]),
    "twice": (('<link name="wrist_2"/>', '<link name="wrist_2"/><link name="wrist_2"/>'), {}, ["occurs twice"]),
    "no chain": (ISLAND, {"base": "island"}, ["no chain of joints from 'island' to 'tool0'"]),
    "roots": (ISLAND, {"tip": None}, ["2 root links, 'world', 'island'"]),
    "numbers": (('xyz="0.35 0 0.03"', 'xyz="0.35 0"'), {}, ["line ", "joint 'joint_4'", "'0.35 0'", "3 numbers"]),
    "no number": (('xyz="0.35 0 0.03"', 'xyz="a 0 0"'), {}, ["'a 0 0'"]),
    "huge": (('rpy="0 -1.5708 0"', 'rpy="1e300 0 0"'), {}, ["'1e300 0 0'", "below 1e+06"]),
    "infinite": (('xyz="0.35 0 0.03"', 'xyz="inf 0 0"'), {}, ["'inf 0 0'"]),
    "mass": (('<mass value="3"/>', '<mass value="-3"/>'), {}, ["<mass> of link 'upper' is -3 kg"]),
    "no parent": (('<parent link="wrist_1"/>', ""), {}, ["joint 'joint_5' has no <parent"]),
    "no name": (('<link name="wrist_2"/>', "<link/>"), {}, ["a link has no name"]),
    "xacro": (('<link name="wrist_2"/>', '<xacro:arm name="x"/>'), {}, ["xacro FILE.xacro > FILE.urdf"]),
    "xacro value": (('xyz="0.35 0 0.03"', 'xyz="${length} 0 0"'), {}, ["xacro FILE.xacro > FILE.urdf"]),
    "no XML": (("</robot>", ""), {}, ["not valid XML", "correct the file at this point"]),
    "another format": (("<robot", "<model"), {}, ["root element is <model>"]),
    "misspelt origin": (
        ('<origin xyz="0.35', '<orign xyz="0.35'), {}, ["line 50: joint 'joint_4'", "<orign>; did you mean '<origin>'?"]
    ),
    "Origin": (('<origin xyz="0.35', '<Origin xyz="0.35'), {}, ["<Origin>; did you mean '<origin>'?"]),
    "xzy": (('xyz="0.35', 'xzy="0.35'), {}, ["line 50: <origin> of joint 'joint_4'", "'xzy'; did you mean 'xyz'?"]),
    "rpY": (('rpy="0 1.5708 0"', 'rpY="0 1.5708 0"'), {}, ["'rpY'; did you mean 'rpy'?"]),
    "axes": (joint("joint_5", axis='<axes xyz="0 1 0"/>'), {}, ["joint 'joint_5'", "<axes>; did you mean '<axis>'?"]),
    "Lower": (('lower="-2"', 'Lower="-2"'), {}, ["<limit> of joint 'joint_5'", "'Lower'; did you mean 'lower'?"]),
    "two origins": (
        ('<origin xyz="0.35', '<origin xyz="0 0 0"/><origin xyz="0.35'), {}, [
            "second <origin>, after the first in line"
        ]
    ),
    "two axes": (joint("joint_5", axis='<axis xyz="0 1 0"/><axis xyz="1 0 0"/>'), {}, ["has a second <axis>"]),
    "axis without xyz": (joint("joint_5", axis="<axis/>"), {}, ["<axis> of joint 'joint_5' has no xyz"]),
    "misspelt link": (('<link name="wrist_2"/>', '<Link name="wrist_2"/>'), {}, ["the robot", "<Link>; did you mean"]),
    "misspelt mass": (('<mass value="3"/>', '<mas value="3"/>'), {}, ["<inertial> of link 'upper'", "<mas>"]),
    "mass outside": (
        ('<inertial><origin xyz="0 0 0.2"/><mass value="3"/>', '<mass value="3"/><inertial>'), {},
        ["link 'upper' contains <mass>, which is not allowed there"],
    ),
    "inside an origin": (
        ('<origin xyz="0.08 0 0"/>', '<origin xyz="0.08 0 0"><axis xyz="0 0 1"/></origin>'), {},
        ["contains <axis>, which is not allowed there; move it"],
    ),
    "text": (('<origin xyz="0.35 0 0.03"', 'origin xyz="0.35" <origin'), {}, ["'origin xyz=\"0.35\"'"]),
    "quaternion": (('rpy="0 1.5708 0"', 'quat_xyzw="0 1 0 0"'), {}, ["quat_xyzw", "as rpy"]),
    "two shapes": (
        ('<link name="wrist_2"/>', '<link name="wrist_2"><collision><geometry><sphere radius="1"/><box size="1 1 1"/>'
         "</geometry></collision></link>"), {}, ["<geometry> of link 'wrist_2' has two shapes"]
    ),
}  # fmt: skip


@pytest.mark.first_rows(29)
@pytest.mark.parametrize("case", REFUSED)
def test_refusals_are_one_sentence(tmp_path, case):
    replacement, links, parts = REFUSED[case]
    text = TEXT if replacement is None else TEXT.replace(*replacement)
    assert replacement is None or text != TEXT
    path = written(tmp_path, text)
    assert_refused(lambda: aj.load_arm(path, **{"tip": "tool0"} | links), path, *parts)


OTHER_TOOLS = [
    ("</robot>", '<gazebo reference="flange"><limit/></gazebo><ros2_control name="a"><joint/></ros2_control></robot>'),
    ('<origin xyz="0.08 0 0"/>', '<origin xyz="0.08 0 0"/><drake:joint/><safety_controller k_velocity="1"/><gazebo/>'),
    ('<link name="flange"/>', '<link name="flange" drake:x="1"><origin/><contact><damping/></contact></link>'),
    ('type="fixed">', 'type="fixed" dont_collapse="true">'),
    ('effort="10"', 'effort="10" acceleration="3" jerk="1e300"'),
]


@pytest.mark.parametrize("replacement", OTHER_TOOLS)
def test_what_other_tools_write_passes(tmp_path, nominal, replacement):
    text = TEXT.replace(*replacement).replace("<robot ", '<robot xmlns:drake="https://drake.mit.edu" ')
    assert replacement[1] in text
    found = aj.load_arm(written(tmp_path, text), tip="tool0")
    np.testing.assert_array_equal(found.pose(Q), nominal.arm.pose(Q))


BOMB = '<!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (TEXT.replace("<!-- A small", BOMB + "<!-- A small").encode(), "document type"),
        (b"<robot>" + 100 * b"<a>" + 100 * b"</a>" + b"</robot>", "too deeply"),
        (b"<sdf/>", "root element is <sdf>"),
        (b"", "not valid XML"),
        (b"\xff\xfe\x00", "not UTF-8 text"),
        (b"<robot name='\x00'/>", "not valid XML"),
        (b"<robot><link name='a'/></robot>", "no moving joint after 'a'"),
        (b"<robot/>", "no <link>"),
    ],
)
def test_other_files_are_refused(tmp_path, content, part):
    path = tmp_path / "robot.urdf"
    path.write_bytes(content)
    assert_refused(lambda: aj.load_arm(path), path, part)


def test_export_needs_the_urdf(paper_arm, nominal):
    assert_refused(
        lambda: urdf_of(paper_arm, aj.files.load_specification("panda")),
        "not read from a URDF",
        "a URDF cannot be exported",
        "--format toml",
    )
    assert_refused(lambda: urdf_of(aj.load_arm("panda"), nominal), "has 7 joints, but the chain has 6")
