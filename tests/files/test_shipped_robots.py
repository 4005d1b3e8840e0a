"""The shipped robots against descriptions of other origin: same poses from the same readings, up to base and flange.

Origins of the joints are those of the makers' ROS packages, in m and rad: where and how each joint's frame is in the
frame of the joint before it, and its axis. The shipped arms are from tables in manuals.
"""

from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.kinematics.axes_to_dh import rotation

from ..refusals import assert_refused

R = np.pi / 2
X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)


def universal_robots(d1, a2, a3, d4, d5, d6):
    """``config/*/default_kinematics.yaml`` of Universal_Robots_ROS2_Description."""
    return [
        ((0, 0, d1), (0, 0, 0), Z),
        ((0, 0, 0), (R, 0, 0), Z),
        ((-a2, 0, 0), (0, 0, 0), Z),
        ((-a3, 0, d4), (0, 0, 0), Z),
        ((0, -d5, 0), (R, 0, 0), Z),
        ((0, d6, 0), (R, 2 * R, 2 * R), Z),
        ((0, 0, 0), (0, 0, 0), None),
    ]


ORIGINS = {
    "ur3e": universal_robots(0.15185, 0.24355, 0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": universal_robots(0.1625, 0.425, 0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": universal_robots(0.1807, 0.6127, 0.57155, 0.17415, 0.11985, 0.11655),
    # kortex_description, arms/gen3/7dof
    "gen3": [
        ((0, 0, 0.15643), (2 * R, 0, 0), Z),
        ((0, 0.005375, -0.12838), (R, 0, 0), Z),
        ((0, -0.21038, -0.006375), (-R, 0, 0), Z),
        ((0, 0.006375, -0.21038), (R, 0, 0), Z),
        ((0, -0.20843, -0.006375), (-R, 0, 0), Z),
        ((0, 0.00017505, -0.10593), (R, 0, 0), Z),
        ((0, -0.10593, -0.00017505), (-R, 0, 0), Z),
        ((0, 0, -0.061525), (2 * R, 0, 0), None),
    ],
    # kortex_description, arms/gen3_lite/6dof, and the tool frame of its gripper
    "gen3-lite": [
        ((0, 0, 0.12825), (0, 0, 0), Z),
        ((0, -0.03, 0.115), (R, 0, 0), Z),
        ((0, 0.28, 0), (-2 * R, 0, 0), Z),
        ((0, -0.14, 0.02), (R, 0, 0), Z),
        ((0.0285, 0, 0.105), (0, R, 0), Z),
        ((-0.105, 0, 0.0285), (0, -R, 0), Z),
        ((0, 0, 0.13), (0, 0, R), None),
    ],
    # abb_irb120_support (ROS-Industrial), irb120_3_58
    "irb120": [
        ((0, 0, 0), (0, 0, 0), Z),
        ((0, 0, 0.29), (0, 0, 0), Y),
        ((0, 0, 0.27), (0, 0, 0), Y),
        ((0, 0, 0.07), (0, 0, 0), X),
        ((0.302, 0, 0), (0, 0, 0), Y),
        ((0.072, 0, 0), (0, 0, 0), X),
        ((0, 0, 0), (0, R, 0), None),
    ],
}
# Files of example-robot-data, and the links at the ends. The Panda's lengths are those of the FR3.
FILES = {
    "ur10": ("ur10_robot.urdf", "base_link", "tool0"),
    "fr3": ("panda.urdf", "panda_link0", "panda_link8"),
    "so100": ("so100.urdf", "base", "gripper"),
}
# Rotations about z of base and flange, deg, in which these descriptions differ from the makers' tables.
ENDS = {"ur10": (180, 0), "gen3-lite": (0, 90)}
# so100.urdf has 1.57079 for a right angle, the others ten digits.
TOLERANCES = {"so100": 0.01, "ur10": 1e-5, "fr3": 1e-5}


def urdf_of(origins) -> str:
    links = "".join(f'<link name="link_{i}"/>' for i in range(len(origins) + 1))
    joints = ""
    for i, (xyz, rpy, axis) in enumerate(origins):
        origin = f'<origin xyz="{" ".join(map(repr, xyz))}" rpy="{" ".join(map(repr, rpy))}"/>'
        moving = "" if axis is None else f'<axis xyz="{" ".join(map(str, axis))}"/>'
        ends = f'<parent link="link_{i}"/><child link="link_{i + 1}"/>'
        kind = "fixed" if axis is None else "continuous"
        joints += f'<joint name="joint_{i + 1}" type="{kind}">{ends}{origin}{moving}</joint>'
    return f'<robot name="test">{links}{joints}</robot>'


def described(name: str, folder: Path) -> aj.Arm:
    if name in ORIGINS:
        (folder / "robot.urdf").write_text(urdf_of(ORIGINS[name]))
        return aj.load_arm(folder / "robot.urdf")
    file, base, tip = FILES[name]
    found = [one for one in metadata.files("example-robot-data") or () if one.name == file]
    return aj.load_arm(str(found[0].locate()), base=base, tip=tip)


@pytest.mark.first_rows(6)
@pytest.mark.parametrize("name", [*ORIGINS, *FILES])
def test_the_poses_are_those_of_its_urdf(tmp_path, name):
    arm, other = aj.load_arm(name), described(name, tmp_path)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, arm.joints))
    poses, expected = np.asarray(arm.pose(q)), np.asarray(other.pose(q))
    base, flange = (rotation(2, np.deg2rad(degrees)) for degrees in ENDS.get(name, (0, 0)))
    found = base @ poses @ flange
    tolerance = TOLERANCES.get(name, 1e-9)
    np.testing.assert_allclose(found[:, :3, 3], expected[:, :3, 3], rtol=0, atol=tolerance)
    np.testing.assert_allclose(found[:, :3, :3], expected[:, :3, :3], rtol=0, atol=1e-3 * tolerance + 1e-12)


def test_the_panda_and_its_successor_have_the_same_lengths():
    fr3, panda = aj.load_arm("fr3"), aj.load_arm("panda")
    for kind in ("a", "d"):
        np.testing.assert_array_equal(getattr(fr3, kind), getattr(panda, kind))


def test_parallel_axes_have_beta_and_a_tool_is_stated_where_the_arm_is_named():
    robot = aj.files.load_specification("ur10e", probe=(30, 0, 100))
    assert robot.free == ("beta_2", "beta_3")
    assert {"d_2", "d_3"} <= set(robot.held or ())
    np.testing.assert_array_equal(robot.arm.probe, (30, 0, 100))
    assert_refused(lambda: aj.load_arm("ur10e", probe=(1, 2)), "probe")
