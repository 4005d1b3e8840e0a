"""Every serial chain of the robots of example-robot-data, against two independent readers; of some robots, or of all.

``pytest -m exhaustive -s`` on this file prints the largest differences by robot.
"""

from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.files.mjcf_text import parse_robot
from aacmm_jax.files.urdf import urdf_chain, urdf_of
from aacmm_jax.files.urdf_robots import read_urdf, urdf_chains
from aacmm_jax.kinematics.arm import by_joint, parameter_unit, value_of
from aacmm_jax.kinematics.parameters import ArmSpecification, UrdfSource
from aacmm_jax.kinematics.robots import chains_of, mount_names

CONFIGURATIONS = 1000
# Files that the independent readers cannot read (a robot without a name).
UNREADABLE = ("ur3.urdf",)
# Tips of files in which other chains have joints without limits, or joints that mimic one that does not exist.
TIPS = {
    "centauro": [*(f"ball{i}_tip" for i in (1, 2)), *(f"ankle2_{i}" for i in range(1, 5))],
    "alex_psyonic_hands": ["Head", "LeftGripperYawLink", "RightGripperYawLink"],
}


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
            joint.kind in ("revolute", "continuous", "prismatic") and limited and joint.axis is not None
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
            moved = np.tile(np.eye(4), (len(q), 1, 1))
            along = np.outer(q[:, names.index(joint.name)], axis)
            if joint.type == "prismatic":
                moved[:, :3, 3] = along
            else:
                moved[:, :3, :3] = Rotation.from_rotvec(along).as_matrix()
            poses = poses @ moved
    return poses


def by_pinocchio(model, base: str, tip: str, names: list[str], q: np.ndarray) -> np.ndarray:
    """Poses of the tip link in mm by Pinocchio, whose continuous joints take cosine and sine, prismatic ones m."""
    import pinocchio

    data = model.createData()
    joints = [model.joints[model.getJointId(name)] for name in names]
    ends = [model.getFrameId(link, pinocchio.BODY) for link in (base, tip)]
    poses = np.empty((len(q), 4, 4))
    for pose, readings in zip(poses, q, strict=True):
        values = pinocchio.neutral(model)
        for joint, reading in zip(joints, readings, strict=True):
            reading = reading / 1000 if joint.shortname().startswith("JointModelP") else reading
            at = slice(joint.idx_q, joint.idx_q + joint.nq)
            values[at] = (np.cos(reading), np.sin(reading)) if joint.nq == 2 else reading
        pinocchio.forwardKinematics(model, data, values)
        first, last = (pinocchio.updateFramePlacement(model, data, end) for end in ends)
        pose[:] = first.actInv(last).homogeneous
    poses[:, :3, 3] *= 1000
    return poses


class Differences:
    """The largest difference of positions (mm) and of entries of rotation matrices."""

    def __init__(self):
        self.position = self.rotation = 0.0

    def __str__(self) -> str:
        return f"{self.position:8.1e} {self.rotation:8.1e}"

    def check(self, found: np.ndarray, expected: np.ndarray) -> None:
        difference = np.abs(found - expected)
        self.position = max(self.position, float(difference[:, :3, 3].max()))
        self.rotation = max(self.rotation, float(difference[:, :3, :3].max()))
        assert self.position <= 1e-9
        assert self.rotation <= 1e-12


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "every", [pytest.param(15, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.exhaustive)]
)
def test_every_chain_in_and_out(tmp_path, every):
    """Of each robot, or of each fifteenth."""
    import pinocchio
    import yourdfpy

    random = np.random.default_rng(0)
    arms, slides, seen = 0, 0, set()
    print("\nlargest differences, mm and rad, with yourdfpy and Pinocchio; after a calibration; its errors in mm")
    for path in robots()[::every]:
        text = path.read_text(encoding="utf-8")
        robot = parse_robot(text)
        model = yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=True)
        other = pinocchio.buildModelFromXML(text)
        parents = {joint.parent for joint in robot.joints.values()}
        tips = {tip: ends(robot, tip) for tip in robot.links if tip not in parents}
        tips = {tip: (base, moving) for tip, (base, moving) in tips.items() if moving}
        differences, errors = [Differences() for _ in range(4)], []
        for tip, (base, moving) in sorted(tips.items(), key=lambda item: -item[1][1]):
            source = UrdfSource(text, base, (tip,))
            chain = urdf_chain(source)
            parts = np.concatenate([*chain.origins, chain.tip]).tobytes(), *(j.axis.tobytes() for j in chain.joints)
            if parts in seen:  # of a variant of the same robot
                continue
            seen.add(parts)
            names = [joint.name for joint in chain.joints]
            slides += bool(chain.arm.prismatic)
            q = random.uniform(-np.pi, np.pi, (CONFIGURATIONS, moving)) * by_joint(chain.arm, 1.0, 100.0)
            found, expected = chain.base @ np.asarray(chain.arm.pose(q)), by_yourdfpy(model, base, tip, names, q)
            differences[0].check(found, expected)
            differences[1].check(found, by_pinocchio(other, base, tip, names, q))
            model.update_cfg(dict(zip(names, q[0] * by_joint(chain.arm, 1.0, 1e-3), strict=True)))
            np.testing.assert_allclose(model.get_transform(tip, base)[:3, 3] * 1000, expected[0, :3, 3], atol=1e-9)
            nominal = ArmSpecification(chain.arm, urdf=source)
            assert urdf_of(chain.arm, nominal).text == text
            if moving < 5:
                continue
            if errors:
                arm = perturbed(chain.arm, random)
            else:  # one chain of each robot
                arm, error = calibrated(chain.arm)
                errors.append(error)
            exported = urdf_of(arm, nominal)
            (tmp_path / "out.urdf").write_text(exported.text, encoding="utf-8")
            again = urdf_chain(UrdfSource(exported.text, base, (exported.tip,)))
            q = q[:100]
            expected = chain.base @ np.asarray(arm.pose(q))
            Differences().check(again.base @ np.asarray(again.arm.pose(q)), expected)
            reread = yourdfpy.URDF.load(str(tmp_path / "out.urdf"), load_meshes=False, build_scene_graph=False)
            differences[2].check(by_yourdfpy(reread, base, exported.tip, names, q), expected)
            reread = pinocchio.buildModelFromXML(exported.text)
            differences[3].check(by_pinocchio(reread, base, exported.tip, names, q), expected)
        arms += len(errors)
        found = f"{errors[0][0]:9.4f} {errors[0][1]:8.4f}" if errors else ""
        print(f"{path.stem:28}", *differences, found)
    print(len(seen), "chains")
    assert arms >= 15 // every
    assert slides >= 5 // every
    assert len(seen) >= 150 // every


def calibrated(arm: aj.Arm) -> tuple[aj.Arm, tuple[float, float]]:
    """A calibration of an arm that is built otherwise, and the RMS errors of the tip before and after it, mm."""
    # The limits of legs and fingers let few poses reach a socket.
    arm = arm.replace(limits=[(-reach, reach) for reach in by_joint(arm, np.pi, 500.0)])
    space = aj.Parameters.independent(arm)
    nominal = space.base
    true = aj.perturbed_arm(space, length=0.5, angle=5e-4, seed=1)
    q = np.random.default_rng(0).uniform(-2, 2, (52, arm.joints))
    places = np.asarray(nominal.position(q[:2]))
    sockets = {name: tuple(place) for name, place in zip("AB", places, strict=True)}
    capture = aj.simulate(true, sockets, poses=25, lengths=[("A", "B", 0.002)], encoder_arcsec=1, seating=0.005, seed=2)
    result = aj.calibrate(nominal, capture, aj.Bounds.around(nominal, space))
    errors = [np.asarray(one.position(q[2:])) - np.asarray(true.position(q[2:])) for one in (nominal, result.arm)]
    before, after = (float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) for error in errors)
    return result.arm, (before, after)


def whole_robots() -> dict[str, ArmSpecification]:
    """The robots of several chains, by their name; those whose text is that of another one once."""
    found: dict[str, ArmSpecification] = {}
    for path in robots():
        try:
            robot = read_urdf(path, tip=TIPS.get(path.stem))
        except aj.InputError:
            continue
        if robot.arm.chains and robot.urdf.text not in {one.urdf.text for one in found.values()}:
            found[f"{path.parent.parent.name}/{path.stem}"] = robot
    return found


def from_pinocchio(robot: aj.Arm, source: UrdfSource, text: str, tips: list[str], q: np.ndarray) -> Differences:
    """The largest differences of the poses of a robot's tips from those that Pinocchio reads in a text."""
    import pinocchio

    model, differences = pinocchio.buildModelFromXML(text), Differences()
    first = urdf_chain(source._replace(tips=source.tips[:1]), alone=False).base
    all_joints = q.copy()  # with those that follow others
    for joint, followed, factor, offset in robot.mimic:
        all_joints[:, joint - 1] = factor * q[:, followed - 1] + offset
    chains = zip(chains_of(robot.replace(mimic=())).values(), urdf_chains(source).values(), tips, strict=True)
    for number, (chain, urdf, tip) in enumerate(chains):
        names, own = [joint.name for joint in urdf.joints], np.array(chain.joints) - 1
        found = first @ np.asarray(robot.pose(np.column_stack([q, np.full(len(q), number)])))
        differences.check(found, by_pinocchio(model, source.base, tip, names, all_joints[:, own]))
    return differences


@pytest.mark.parametrize(
    "every", [pytest.param(8, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.exhaustive)]
)
def test_whole_robots_in_and_out(every):
    """All chains of a robot at once: read, every parameter changed by about 1 mm or 1 mrad, and exported."""
    random, found = np.random.default_rng(0), whole_robots()
    assert len(found) >= 40
    names = {name.split("/")[1] for name in found}
    assert {"talos_full_v2", "tiago_dual", "tiago_pro", "g1_29dof_with_hand_rev_1_0", "baxter", "pr2"} <= names
    print("\nlargest differences from Pinocchio, mm and rad: as read; after an export")
    for name, nominal in list(found.items())[::every]:
        source, robot = nominal.urdf, nominal.arm
        assert urdf_of(robot, nominal).text == source.text
        q = random.uniform(-np.pi, np.pi, (20, robot.joints)) * by_joint(robot, 1.0, 100.0)
        read = from_pinocchio(robot, source, source.text, list(source.tips), q)
        chains = chains_of(robot.replace(mimic=())).values()
        names = dict.fromkeys(name for chain in chains for name in (*chain.names.values(), *mount_names(chain)))
        moved = robot.replace(**{
            name: float(value_of(robot, name)) + random.normal() * {"mm": 1.0, "rad": 1e-3}[parameter_unit(robot, name)]
            for name in names
        })  # fmt: skip
        exported = urdf_of(moved, nominal)
        written = from_pinocchio(moved, source, exported.text, exported.tip.split(", "), q)
        print(f"{name:50} {len(robot.chains):2} chains, {robot.joints:3} joints ", read, written, flush=True)


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
