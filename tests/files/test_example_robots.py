"""Every serial chain of the robots of example-robot-data, against an independent reader; slow, as these are many."""

from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.files.urdf import urdf_chain, urdf_of
from aacmm_jax.files.urdf_text import parse_urdf
from aacmm_jax.kinematics.parameters import ArmSpecification, UrdfSource

CONFIGURATIONS = 1000
# Files that the independent reader cannot read (a robot without a name).
UNREADABLE = ("ur3.urdf",)

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


def robots() -> list[Path]:
    """The URDF files of the package; without it, this fails and skips nothing."""
    files = metadata.files("example-robot-data") or ()
    found = [Path(str(file.locate())) for file in files if file.suffix == ".urdf" and file.name not in UNREADABLE]
    assert len(found) >= 60
    return found


def ends(robot, tip: str) -> tuple[str, int]:
    """The link furthest back from which only joints lead to the tip that an arm has, and how many of them move."""
    to = {joint.child: joint for joint in robot.joints.values()}
    base, moving = tip, 0
    while base in to:
        joint = to[base]
        limited = joint.kind == "continuous" or (joint.limits is not None and joint.limits[0] < joint.limits[1])
        if joint.kind != "fixed" and not (
            joint.kind in ("revolute", "continuous") and limited and joint.axis is not None
        ):
            break
        if joint.mimics is not None:
            break
        base, moving = joint.parent, moving + (joint.kind != "fixed")
    return base, moving


def by_yourdfpy(model, base: str, tip: str, names: list[str], q: np.ndarray) -> np.ndarray:
    """Poses of the tip link in mm, as products of the transforms that yourdfpy read."""
    to = {joint.child: joint for joint in model.robot.joints}
    path, link = [], tip
    while link != base:
        path.append(to[link])
        link = to[link].parent
    poses = np.tile(np.eye(4), (len(q), 1, 1))
    for joint in reversed(path):
        origin = np.eye(4) if joint.origin is None else np.array(joint.origin, dtype=float)
        origin[:3, 3] *= 1000
        poses = poses @ origin
        if joint.name in names:
            axis = np.array(joint.axis, dtype=float)
            axis /= np.linalg.norm(axis)
            turns = np.tile(np.eye(4), (len(q), 1, 1))
            turns[:, :3, :3] = Rotation.from_rotvec(np.outer(q[:, names.index(joint.name)], axis)).as_matrix()
            poses = poses @ turns
    return poses


def assert_same(found, expected):
    np.testing.assert_allclose(found[:, :3, 3], expected[:, :3, 3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[:, :3, :3], expected[:, :3, :3], rtol=0, atol=1e-12)


def test_every_chain_in_and_out(tmp_path):
    import yourdfpy

    random = np.random.default_rng(0)
    arms, chains = 0, 0
    for path in robots():
        text = path.read_text(encoding="utf-8")
        robot = parse_urdf(text)
        model = yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=True)
        parents = {joint.parent for joint in robot.joints.values()}
        tips = {tip: ends(robot, tip) for tip in robot.links if tip not in parents}
        arms += any(moving >= 5 for _, moving in tips.values())
        for tip, (base, moving) in tips.items():
            if not moving:
                continue
            source = UrdfSource(text, base, tip)
            chain = urdf_chain(source)
            names = [joint.name for joint in chain.joints]
            q = random.uniform(-np.pi, np.pi, (CONFIGURATIONS, moving))
            expected = by_yourdfpy(model, base, tip, names, q)
            assert_same(chain.base @ np.asarray(chain.arm.pose(q)), expected)
            model.update_cfg(dict(zip(names, q[0], strict=True)))
            np.testing.assert_allclose(model.get_transform(tip, base)[:3, 3] * 1000, expected[0, :3, 3], atol=1e-9)
            nominal = ArmSpecification(chain.arm, urdf=source)
            assert urdf_of(chain.arm, nominal).text == text
            chains += 1
            if moving >= 5:
                calibrated = perturbed(chain.arm, random)
                found = urdf_of(calibrated, nominal)
                (tmp_path / "out.urdf").write_text(found.text, encoding="utf-8")
                expected = chain.base @ np.asarray(calibrated.pose(q[:20]))
                again = urdf_chain(UrdfSource(found.text, base, found.tip))
                assert_same(again.base @ np.asarray(again.arm.pose(q[:20])), expected)
                reread = yourdfpy.URDF.load(str(tmp_path / "out.urdf"), load_meshes=False, build_scene_graph=False)
                assert_same(by_yourdfpy(reread, base, found.tip, names, q[:20]), expected)
    assert arms >= 15
    assert chains >= 100


def perturbed(arm: aj.Arm, random: np.random.Generator) -> aj.Arm:
    """Every parameter by about 1 mm or 1 mrad."""
    n, beta = arm.joints, np.zeros(arm.joints) if arm.beta is None else arm.beta
    return arm.replace(
        a=arm.a + random.normal(size=n),
        d=arm.d + random.normal(size=n),
        alpha=arm.alpha + 1e-3 * random.normal(size=n),
        theta=arm.theta + 1e-3 * random.normal(size=n),
        beta=beta + 1e-3 * random.normal(size=n),
        probe=arm.probe + random.normal(size=3),
    )
