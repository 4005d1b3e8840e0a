"""MJCF in and out, against MuJoCo; and what is refused."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.files.mjcf import with_includes
from aacmm_jax.files.mjcf_text import parse_robot
from aacmm_jax.files.urdf import urdf_chain, urdf_of
from aacmm_jax.kinematics.axes_to_dh import dh_frames, geometry_of
from aacmm_jax.kinematics.parameters import ArmSpecification, UrdfSource

from ..refusals import assert_refused
from .test_urdf import changed

# A gantry's slide, two joints in one body, a frame, classes, every orientation, a reference reading, unnamed elements.
TEXT = """<?xml version="1.0"?>
<!-- <body name="not a body"/> -->
<mujoco model="six axes">
  <compiler angle="degree" eulerseq="zYx" meshdir="somewhere"/>
  <option timestep="0.002"/>
  <default>
    <geom size="0.01"/>
    <joint axis="0 1 0" damping="1"/>
    <default class="arm">
      <site euler="10 20 30" size="0.01"/>
      <default class="upward"><joint axis="0 0 2"/></default>
    </default>
  </default>
  <worldbody>
    <light pos="0 0 3"/>
    <geom type="plane" size="1 1 1"/>
    <body name="base" pos="0.1 0.2 0.3" quat="2 0 0 1" childclass="arm">
      <geom/>
      <body name="slide" pos="0 0 0.1" zaxis="0.1 0 1">
        <joint name="joint_1" type="slide" class="upward" range="-0.3 0.5" ref="0.05"/>
        <inertial pos="0 0 0.02" mass="2" diaginertia="1 1 1"/>
        <geom/>
        <frame pos="0.02 0 0.1" axisangle="0 0 1 25">
          <body name="shoulder" pos="0 0 0.2">
            <joint name="joint_2" pos="0.01 0.02 0.03" range="-100 120"/>
            <joint name="joint_3" pos="0.01 0 0.05" axis="1 0 0.01" ref="15" range="-90 90"/>
            <geom/>
            <site name="shoulder"/><site name="hand"/>
            <body>
              <geom/>
              <body name="forearm" pos="0.35 0 0.03" xyaxes="0 1 0.1 -1 0 0">
                <frame euler="0 5 0" pos="0 0.01 0">
                  <joint name="joint_4" type="hinge" limited="true" range="-60 90"/>
                </frame>
                <geom/>
                <body name="wrist" pos="0.08 0 0" euler="-30 15 5">
                  <joint name="joint_5" axis="1 0 0" range="-170 170"/>
                  <geom/>
                  <site name="on the wrist" pos="0 0.05 0"/>
                  <body name="hand" pos="0 0 0.06" euler="0 0 10">
                    <joint name="joint_6" class="upward"/>
                    <geom/>
                    <site name="tool" pos='0 0 0.1'/>
                    <site name="plain" class="main" pos="0 0.01 0.1"/>
                    <body name="finger" pos="0 0.02 0.1"><joint type="ball"/><geom/></body>
                    <body name="flange" pos="0 0 0.05"><geom/></body>
                  </body>
                </body>
              </body>
            </body>
          </body>
        </frame>
      </body>
    </body>
    <body name="ball" pos="1 0 0"><freejoint/><geom/></body>
  </worldbody>
  <actuator><motor joint="joint_2"/></actuator>
</mujoco>
"""
JOINTS = [f"joint_{i}" for i in range(1, 7)]
Q = np.random.default_rng(0).uniform(-1.9, 1.9, (20, 6)) * [100, 1, 1, 1, 1, 1]


def by_mujoco(text: str, tip: str, base: str = "world") -> np.ndarray:
    """Poses of a body or site in a body, mm."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)

    def frame(name: str) -> np.ndarray:
        bodies = [model.body(i).name for i in range(model.nbody)]
        place = data.body(name) if name in bodies else data.site(name)
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = place.xmat.reshape(3, 3), 1000 * place.xpos
        return transform

    poses = []
    for q in Q:
        for name, value in zip(JOINTS, q, strict=True):
            data.joint(name).qpos = value / 1000 if name == "joint_1" else value
        mujoco.mj_kinematics(model, data)
        poses.append(np.linalg.inv(frame(base)) @ frame(tip))
    return np.array(poses)


def assert_same(found, expected):
    np.testing.assert_allclose(found[:, :3, 3], expected[:, :3, 3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[:, :3, :3], expected[:, :3, :3], rtol=0, atol=1e-12)


def read(text: str, tip: str, base: str = "world") -> ArmSpecification:
    source = UrdfSource(text, base, (tip,))
    return ArmSpecification(urdf_chain(source).arm, urdf=source)


def poses(specification: ArmSpecification, arm: aj.Arm | None = None) -> np.ndarray:
    """Of the tip in the base, as the arm has them that the text is, or another one in its place."""
    chain = urdf_chain(specification.urdf)
    return chain.base @ np.asarray((chain.arm if arm is None else arm).pose(Q))


@pytest.mark.slow
@pytest.mark.parametrize(("base", "tip"), [("world", "tool"), ("base", "plain"), ("base", "flange"), ("world", "hand")])
def test_chain_in_and_out(base, tip):
    nominal = read(TEXT, tip, base)
    assert_same(poses(nominal), by_mujoco(TEXT, tip, base))
    assert nominal.arm.prismatic == (1,)
    np.testing.assert_allclose(nominal.arm.limits[0], (-300, 500))
    np.testing.assert_allclose(np.degrees(nominal.arm.limits[2:4]), [(-90, 90), (-60, 90)])
    assert nominal.arm.limits[5] == (-2 * np.pi, 2 * np.pi)
    assert urdf_of(nominal.arm, nominal).text == TEXT
    arm = changed(nominal.arm)
    exported = urdf_of(arm, nominal)
    expected = poses(nominal, arm)
    assert exported.tip == (f"{tip}_probe" if tip == "hand" else tip)
    assert bool(exported.notes) == (tip == "hand")
    assert_same(poses(read(exported.text, exported.tip, base)), expected)
    assert_same(by_mujoco(exported.text, exported.tip, base), expected)
    assert set(exported.changed) == {"slide", "shoulder", "joint_3", "forearm", "wrist", "hand", tip} - (
        set() if tip != "hand" else {tip}
    ) | {"hand"}
    assert without_places(exported.text) == without_places(TEXT)


def without_places(text: str) -> str:
    """The text without what a calibration may change."""
    text = re.sub(r"\s*<site name=\"hand_probe\"[^>]*/>", "", text)
    place = re.compile(r"\s(pos|quat|axisangle|xyaxes|zaxis|euler|axis)=(\"[^\"]*\"|'[^']*')")
    return re.sub(r"<(body|joint|site) [^>]*>", lambda tag: place.sub("", tag[0]), text)


@pytest.mark.parametrize("change", ["theta_5", "d_1"])
def test_one_zero_offset_changes_one_body(change):
    nominal = read(TEXT, "tool")
    arm = nominal.arm.replace(**{change: 0.01 + float(getattr(nominal.arm, change[:-2])[int(change[-1]) - 1])})
    exported = urdf_of(arm, nominal)
    before, after = TEXT.splitlines(), exported.text.splitlines()
    lines = [(one, other) for one, other in zip(before, after, strict=True) if one != other]
    assert len(lines) == len(exported.changed) == 1
    assert_same(poses(read(exported.text, "tool")), poses(nominal, arm))


@pytest.mark.slow
def test_a_tool_is_a_site_beside_the_tip():
    """Of a site that is the tip, and of a body without elements, which gets an end tag."""
    text = TEXT.replace('<body name="flange" pos="0 0 0.05"><geom/></body>', '<body name="flange" pos="0 0 0.05"/>')
    for tip in ("tool", "flange"):
        nominal = read(text, tip)
        nominal = nominal._replace(arm=nominal.arm.replace(probe=np.add(nominal.arm.probe, [3, -4, 100])))
        exported = urdf_of(nominal.arm.replace(probe_z=float(nominal.arm.probe[2]) + 2), nominal)
        assert (exported.changed, exported.tip) == ((), f"{tip}_probe")
        arm = nominal.arm.replace(probe_z=float(nominal.arm.probe[2]) + 2)
        assert_same(poses(read(exported.text, exported.tip)), poses(nominal, arm))
        assert_same(by_mujoco(exported.text, exported.tip), poses(nominal, arm))


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("seed", range(10))
def test_any_orientation_and_axis(seed):
    """Random bodies, joints and orientations of every kind, with six joints in any of the bodies."""
    random = np.random.default_rng(seed)
    text, ends, bodies = "<mujoco><compiler angle='radian' eulerseq='XyZ'/><worldbody>", "", 0
    counts = {"quat": 4, "axisangle": 4, "xyaxes": 6, "zaxis": 3, "euler": 3}

    def row(count: int, scale: float = 1.0) -> str:
        return " ".join(repr(float(x)) for x in scale * random.normal(size=count))

    def place() -> str:
        kind = random.choice(list(counts))
        return f'pos="{row(3, 0.2)}" {kind}="{row(counts[kind])}"'

    for i, joint in enumerate(JOINTS):
        if i == 0 or random.random() < 0.6:
            outer, bodies = random.random() < 0.3, bodies + 1
            text += f"<frame {place()}>" * outer + f'<body name="body_{bodies}" {place()}><geom size="1"/>'
            ends = "</body>" + "</frame>" * outer + ends
        kind = ' type="slide" range="-1 1"' if i == 0 else ""
        anchor = f'pos="{row(3, 0.2)}"' if random.random() < 0.7 else ""
        within = random.random() < 0.3
        text += f"<frame {place()}>" * within
        text += f'<joint name="{joint}" {anchor} axis="{row(3)}" ref="{row(1)}"{kind}/>' + "</frame>" * within
    text += f'<site name="tip" {place()}/>{ends}</worldbody></mujoco>'
    tip = random.choice(["tip", f"body_{bodies}"])
    nominal = read(text, tip)
    assert_same(poses(nominal), by_mujoco(text, tip))
    assert urdf_of(nominal.arm, nominal).text == text
    arm = changed(nominal.arm)
    exported = urdf_of(arm, nominal)
    assert_same(poses(read(exported.text, exported.tip)), poses(nominal, arm))
    assert_same(by_mujoco(exported.text, exported.tip), poses(nominal, arm))


@pytest.mark.slow
def test_files_and_defaults(tmp_path):
    """As a file, through a capture; the tip by default is the only body without one in it, whatever its sites."""
    text = re.sub(r'<body name="(finger|ball)".*?</body>', "", TEXT)
    (tmp_path / "robot.xml").write_text(text)
    nominal = aj.files.load_specification(tmp_path / "robot.xml")
    assert (nominal.urdf.format, nominal.urdf.base, nominal.urdf.tip) == ("MJCF", "world", "flange")
    aj.files.save_capture(tmp_path / "capture.h5", aj.Recording(aj.Capture({"A": Q[:4]}), nominal))
    assert aj.files.load_capture(tmp_path / "capture.h5").nominal.urdf == nominal.urdf
    found = aj.files.save_urdf(nominal.arm, tmp_path / "out.xml", nominal=nominal)
    assert (tmp_path / "out.xml").read_bytes() == (tmp_path / "robot.xml").read_bytes()
    assert (found.changed, found.notes, found.tip) == ((), (), "flange")
    assert UrdfSource("<!-- <mujoco> --><robot/>", "", ()).format == "URDF"


def test_masses_of_what_each_joint_carries():
    chain = urdf_chain(UrdfSource(TEXT, "base", ("tool",)))
    masses = aj.files.link_masses(chain)
    np.testing.assert_allclose(masses.mass, [2, 0, 0, 0, 0, 0])
    frame = dh_frames(geometry_of(chain.arm), chain.base)[1]
    slide = np.array([0.1, 0, 1]) / np.hypot(0.1, 1)
    centre = [0, 0, 100] + 20 * slide - 50 * slide  # at reading 0, 50 mm below where the file draws it
    np.testing.assert_allclose(frame[:3, :3] @ masses.centre[0] + frame[:3, 3], centre, atol=1e-9)


def test_included_files_stand_in_the_text(tmp_path):
    head, _, tail = TEXT.partition("  <default>\n")
    (tmp_path / "parts").mkdir()
    defaults, _, tail = tail.partition("  <worldbody>")
    (tmp_path / "parts" / "defaults.xml").write_text(f"<?xml version='1.0'?><any>  <default>\n{defaults}</any>")
    body = tail[tail.index('<body name="wrist"') : tail.index("</frame>\n      </body>")]
    body = body[: body.rindex("</body>\n              </body>")] + "</body>"
    tail = tail.replace(body, "<include file='wrist.xml'></include>")
    (tmp_path / "wrist.xml").write_text(f"\ufeff<mujocoinclude>{body}</mujocoinclude>", encoding="utf-8")
    text = f'{head}  <include file="parts/defaults.xml"/>\n  <worldbody>{tail}'
    (tmp_path / "robot.xml").write_text(text)
    whole = with_includes(text, tmp_path / "robot.xml")
    assert "<include" not in whole
    assert " ".join(whole.split()) == " ".join(TEXT.split())
    arm = aj.load_arm(tmp_path / "robot.xml", tip="tool")
    np.testing.assert_array_equal(arm.pose(Q), read(TEXT, "tool").arm.pose(Q))


INCLUDED = {
    "outside": ('<include file="../robot.xml"/>', ["line 5 includes '../robot.xml'", "not in the folder"]),
    "absolute": ('<include file="/etc/hostname"/>', ["includes '/etc/hostname'", "not in the folder"]),
    "itself": ('<include file="robot.xml"/>', ["includes 'robot.xml' a second time"]),
    "no name": ("<include/>", ["includes ''"]),
    "missing": ('<include file="missing.xml"/>', ["missing.xml does not exist"]),
    "circle": ('<include file="circle.xml"/>', ["'circle.xml' line 1 includes 'circle.xml' a second time"]),
    "no XML": ('<include file="text.xml"/>', ["not valid XML"]),
    "no text": ('<include file="bytes.xml"/>', ["bytes.xml is not UTF-8 text"]),
}


@pytest.mark.parametrize("case", INCLUDED)
def test_refused_includes(tmp_path, case):
    element, parts = INCLUDED[case]
    (tmp_path / "circle.xml").write_text('<a><include file="circle.xml"/></a>')
    (tmp_path / "text.xml").write_text("text")
    (tmp_path / "bytes.xml").write_bytes(b"\xff\xfe\x00")
    path = tmp_path / "robot.xml"
    path.write_text(TEXT.replace('<option timestep="0.002"/>', element))
    assert_refused(lambda: aj.load_arm(path, tip="tool"), *parts)


REFUSED = {
    "several tips": ("", "", None, ["'finger', 'flange', 'ball'", "choose the tip"]),
    "free": ("", "", "ball", ["is floating", "choose links without"]),
    "ball": ("", "", "finger", ["is spherical", "choose links without"]),
    "class": ('class="upward" range', 'class="upwards" range', "tool", ["line 20: joint 'joint_1'", "'upwards'"]),
    "two orientations": ('quat="2 0 0 1"', 'quat="1 0 0 0" euler="0 0 0"', "tool", ["quat and euler", "remove one"]),
    "no direction": ('quat="2 0 0 1"', 'quat="0 0 0 0"', "tool", ["body 'base'", "'0 0 0 0'", "no direction"]),
    "parallel": ('xyaxes="0 1 0.1 -1 0 0"', 'xyaxes="0 1 0 0 2 0"', "tool", ["xyaxes", "no direction"]),
    "zero axis": ('axis="1 0 0" range="-1', 'axis="0 0 0" range="-1', "tool", ["'joint_5' has an axis of length 0"]),
    "slide": (' range="-0.3 0.5"', "", "tool", ["'joint_1' is prismatic and has no limits; add range=..."]),
    "global": ("compiler angle=", 'compiler coordinate="global" angle=', "tool", ["line 4", "global", "MuJoCo 2.3.3"]),
    "angle": ('angle="degree"', 'angle="grad"', "tool", ["angle = 'grad'; give degree or radian"]),
    "eulerseq": ('eulerseq="zYx"', 'eulerseq="zz"', "tool", ["eulerseq = 'zz'", "three of"]),
    "type": ('type="hinge"', 'type="screw"', "tool", ["'joint_4' has type = 'screw'; give hinge, slide, ball, free"]),
    "bodies": ('name="wrist"', 'name="hand"', "tool", ["body 'hand' has the name of another body"]),
    "joints": ('"joint_4"', '"joint_5"', "tool", ["joint 'joint_5' occurs twice"]),
    "mass": ('mass="2"', 'mass="-2"', "tool", ["a mass of -2 kg"]),
    "numbers": ('pos="0.08 0 0"', 'pos="0.08 0"', "tool", ["body 'wrist' has pos = '0.08 0'; give 3 numbers"]),
    "huge": ('pos="0.08 0 0"', 'pos="1e300 0 0"', "tool", ["below 1e+06"]),
    "millimetres": ('pos="0.35 0 0.03"', 'pos="350 0 30"', "tool", ["MJCF uses m", "divide the lengths by 1000"]),
    "misspelt": ('pos="0.08 0 0"', 'Pos="0.08 0 0"', "tool", ["body 'wrist'", "'Pos'; did you mean 'pos'?"]),
    "bodys": ("<light pos", '<bodys/><light pos', "tool", ["<bodys>; did you mean '<body>'?"]),
    "misplaced": ("<option", "<body/><option", "tool", ["contains <body>, which is not allowed there"]),
    "root": ("mujoco", "mujocu", "tool", ["root element is <mujocu>", "MJCF has the root element <mujoco>"]),
    "entities": ("<mujoco", '<!DOCTYPE m [<!ENTITY a "aa">]><mujoco', "tool", ["declares a document type"]),
    "deep": ("<light", f"{100 * '<a>'}{100 * '</a>'}<light", "tool", ["too deeply"]),
    "polynomial": (
        "<actuator>",
        '<equality><joint joint1="joint_5" joint2="joint_3" polycoef="0 1 0.5"/></equality><actuator>',
        "tool",
        ["polycoef = '0 1 0.5 0.0 0.0'", "joint 'joint_5' can follow another joint only by an offset and a factor"],
    ),
    "mimic": ("<actuator>", '<equality><joint joint1="joint_5" joint2="other"/></equality><actuator>', "tool", [
        "'joint_5' mimics 'other', which is not a joint of the same chain"
    ]),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_are_one_sentence(tmp_path, case):
    old, new, tip, parts = REFUSED[case]
    path: Path = tmp_path / "robot.xml"
    path.write_text(TEXT.replace(old, new) if old else TEXT)
    assert not old or path.read_text() != TEXT
    assert_refused(lambda: aj.load_arm(path, tip=tip), path, *parts)


def test_orientations_are_those_of_the_reference():
    """Without MuJoCo: angles about moving axes by small letters, about those that stand still by capital ones."""
    robot = parse_robot(TEXT)
    expected = Rotation.from_euler("Y", 15, degrees=True) * Rotation.from_euler("ZX", [-30, 5], degrees=True)
    np.testing.assert_allclose(robot.joints["joint_5"].origin[:3, :3], expected.as_matrix(), atol=1e-15)


# Two arms of a hinge and a slide on a turning trunk, one of which has a joint that follows another.
COUPLED = """<mujoco>
  <compiler angle="degree"/>
  <default><equality active="true"/></default>
  <worldbody>
    <body name="trunk" pos="0 0 0.3"><joint name="turn" range="-170 170"/><geom size="0.1"/>
      <body name="left" pos="0.1 0.2 0.1" euler="80 0 10"><joint name="left_1"/><geom size="0.1"/>
        <body name="left_hand" pos="0.3 0 0.1"><joint name="left_2" axis="1 0 0" range="-90 90"/><geom size="0.1"/>
          <body name="left_tool" pos="0 0.1 0"><geom size="0.1"/></body></body></body>
      <body name="right" pos="0.1 -0.2 0.1" euler="-80 0 0"><joint name="right_1" ref="20"/><geom size="0.1"/>
        <body name="right_hand" pos="0.3 0 0.1" euler="0 20 0"><geom size="0.1"/>
          <joint name="right_2" axis="1 0.2 0" type="slide" range="-0.3 0.3" ref="0.05"/>
          <joint name="right_3" pos="0.02 0 0.05" axis="0.1 1 0"/>
          <body name="right_tool" pos="0 0.1 0.2"><geom size="0.1"/></body></body></body>
    </body>
  </worldbody>
  <equality><joint name="gear" joint1="right_2" joint2="right_1" polycoef="0.01 -0.2 0"/>
    <joint joint1="right_3" joint2="left_1" polycoef="0.1 2" active="false"/></equality>
</mujoco>"""


@pytest.mark.slow
def test_several_tips_and_an_equality_are_a_robot(tmp_path):
    """MuJoCo finds the equality fulfilled, and the tips where the robot has them, as read and after an export."""
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "robot.xml").write_text(COUPLED)
    nominal = aj.files.load_specification(tmp_path / "robot.xml")
    robot = nominal.arm
    assert [name for name, _ in robot.chains] == ["left_tool", "right_tool"]
    ((follower, followed, factor, offset),) = robot.mimic
    assert aj.files.urdf_of(robot, nominal).text == COUPLED
    calibrated = aj.perturbed_arm(aj.Parameters.free_of(robot), length=3.0, angle=0.01, seed=1)
    exported = aj.files.urdf_of(calibrated, nominal)
    assert exported.text.count("<equality>") == 1
    assert {"right", "right_3"} <= set(exported.changed)
    q = np.random.default_rng(0).uniform(-1, 1, (8, robot.joints))
    numbers = {"turn": 1, "left_1": 3, "left_2": 4, "right_1": 6, "right_2": follower, "right_3": 8}
    assert (followed, factor, offset) == (6, -200.0, pytest.approx(10 + 50 + 200 * np.radians(20)))
    first = urdf_chain(nominal.urdf._replace(tips=("left_tool",)), alone=False).base
    for arm, text, tips in ((robot, COUPLED, nominal.urdf.tips), (calibrated, exported.text, exported.tip.split(", "))):
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        for row in q:
            for name, joint in numbers.items():
                data.joint(name).qpos = row[joint - 1]
            data.joint("right_2").qpos = (factor * row[followed - 1] + offset) / 1000
            mujoco.mj_forward(model, data)
            equality = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
            np.testing.assert_allclose(data.efc_pos[equality], 0, atol=1e-15)
            assert np.sum(equality) == 1
            for number, tip in enumerate(tips):
                pose = first @ np.asarray(arm.pose(np.append(row, number)))
                place = data.body(tip) if tip in nominal.urdf.tips else data.site(tip)
                np.testing.assert_allclose(pose[:3, 3], 1000 * place.xpos, rtol=0, atol=1e-9)
