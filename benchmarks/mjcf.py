"""Chains of public MJCF models against MuJoCo's kinematics: ``python benchmarks/mjcf.py FOLDER_OR_FILE...``

Every chain from the last joint that an arm cannot have, or from the world, to each body or site that a chain ends at is
read, compared in 20 random configurations, perturbed in every parameter by about 1 mm or 1 mrad, exported, and compared
again as MuJoCo reads the export; then the chains of several tips as one robot, with joints that follow others, whose
equalities MuJoCo must find fulfilled. Printed are the largest differences by file, mm. The models are not part of the
project: packages such as robosuite, dm_control, gymnasium-robotics and metaworld, or MuJoCo Menagerie, have them.
"""

import sys
from pathlib import Path

import mujoco
import numpy as np

from aacmm_jax import InputError
from aacmm_jax.files.mjcf import with_includes
from aacmm_jax.files.mjcf_text import parse_robot
from aacmm_jax.files.urdf import _joints_before, urdf_chain, urdf_of
from aacmm_jax.files.urdf_robots import read_urdf, urdf_chains
from aacmm_jax.kinematics.arm import by_joint, parameter_unit, value_of
from aacmm_jax.kinematics.parameters import ArmSpecification, UrdfSource
from aacmm_jax.kinematics.robots import chains_of, mount_names

CONFIGURATIONS, FEWEST = 20, 3  # configurations, and joints of a chain that is exported
_KINDS = ("fixed", "revolute", "continuous", "prismatic")


def frame(model, data, name: str) -> np.ndarray:
    """Of a body or site, mm."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    place = data.body(name) if body >= 0 else data.site(name)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = place.xmat.reshape(3, 3), 1000 * place.xpos
    return transform


def poses(model, base: str, tip: str, joints: list, q: np.ndarray) -> np.ndarray:
    """Of the tip in the base, by MuJoCo."""
    data, found = mujoco.MjData(model), []
    for row in q:
        data.qpos[:] = model.qpos0
        for joint, value in zip(joints, row, strict=True):
            data.joint(joint.name).qpos = value / 1000 if joint.kind == "prismatic" else value
        mujoco.mj_kinematics(model, data)
        found.append(np.linalg.inv(frame(model, data, base)) @ frame(model, data, tip))
    return np.array(found)


def chains(robot):
    """Base and tip of every chain whose links and joints have names."""
    inner = {joint.parent for joint in robot.joints.values() if joint.element.name != "site"}
    for tip in (link for link in robot.links if link not in inner):
        base = tip
        for joint in _joints_before(robot, tip):
            stops = joint.kind not in _KINDS or joint.mimics or (joint.kind == "prismatic" and joint.limits is None)
            if stops or " in line " in f"{joint.name} {joint.child}" or (joint.kind != "fixed" and joint.axis is None):
                break
            base = joint.parent if ", joint " not in joint.parent else base
        if base != tip and "(site)" not in tip and " in line " not in base:
            yield base, tip


def compare(path: Path, random: np.random.Generator) -> str:
    """What a file came to, in a line."""
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        return f"not read by MuJoCo: {str(error).splitlines()[0]}"
    try:
        text = with_includes(path.read_text(encoding="utf-8-sig"), path)
        robot = parse_robot(text)
    except InputError as error:
        return f"refused: {error}"
    count, moved, worst = 0, 0, np.zeros(2)
    for base, tip in chains(robot):
        source = UrdfSource(text, base, (tip,))
        try:
            chain = urdf_chain(source)
        except InputError:
            continue
        arm, joints = chain.arm, list(chain.joints)
        n, count, moved = arm.joints, count + 1, max(moved, arm.joints)
        q = random.uniform(-3, 3, (CONFIGURATIONS, n)) * by_joint(arm, 1.0, 100.0)
        read = chain.base @ np.asarray(arm.pose(q)) - poses(model, base, tip, joints, q)
        worst[0] = max(worst[0], np.abs(read[:, :3, 3]).max())
        nominal = ArmSpecification(arm, urdf=source)
        assert urdf_of(arm, nominal).text == text, (path, tip)
        if n < FEWEST:
            continue
        change = {kind: random.normal(size=n) for kind in ("a", "d")}
        change |= {kind: 1e-3 * random.normal(size=n) for kind in ("alpha", "theta", "beta")}
        change |= {"probe": random.normal(size=3)}
        old = {kind: np.zeros(n) if getattr(arm, kind) is None else getattr(arm, kind) for kind in change}
        calibrated = arm.replace(**{kind: old[kind] + values for kind, values in change.items()})
        exported = urdf_of(calibrated, nominal)
        again = loaded(path, exported.text)
        difference = chain.base @ np.asarray(calibrated.pose(q)) - poses(again, base, exported.tip, joints, q)
        worst[1] = max(worst[1], np.abs(difference[:, :3, 3]).max())
    line = f"{count:3} chains, up to {moved:2} joints: read {worst[0]:.1e}, exported {worst[1]:.1e}"
    return line + whole(path, model, random)


def whole(path: Path, model, random: np.random.Generator) -> str:
    """What the chains of several tips came to as one robot."""
    try:
        nominal = read_urdf(path)
    except InputError:
        return ""
    robot, source = nominal.arm, nominal.urdf
    if not robot.chains:
        return ""
    q = random.uniform(-3, 3, (CONFIGURATIONS, robot.joints)) * by_joint(robot, 1.0, 100.0)
    read = robot_differences(robot, source, model, source.tips, q)
    chains = chains_of(robot.replace(mimic=())).values()
    names = dict.fromkeys(name for chain in chains for name in (*chain.names.values(), *mount_names(chain)))
    step = {"mm": 1.0, "rad": 1e-3}
    moved = robot.replace(
        **{name: float(value_of(robot, name)) + random.normal() * step[parameter_unit(robot, name)] for name in names}
    )
    assert urdf_of(robot, nominal).text == source.text, path
    exported = urdf_of(moved, nominal)
    written = robot_differences(moved, source, loaded(path, exported.text), exported.tip.split(", "), q)
    return f"; {len(robot.chains)} chains as a robot with {len(robot.mimic)} followers: {read}, {written}"


def robot_differences(robot, source: UrdfSource, model, tips, q: np.ndarray) -> str:
    """The largest difference of a robot's tips from MuJoCo's, mm, and by how much equalities are not fulfilled."""
    data, worst, unfulfilled = mujoco.MjData(model), 0.0, 0.0
    first = urdf_chain(source._replace(tips=source.tips[:1]), alone=False).base
    joints = q.copy()
    for joint, followed, factor, offset in robot.mimic:
        joints[:, joint - 1] = factor * q[:, followed - 1] + offset
    chains = list(zip(chains_of(robot.replace(mimic=())).values(), urdf_chains(source).values(), tips, strict=True))
    used = {joint.name for _, urdf, _ in chains for joint in urdf.joints if joint.mimics}
    for row, values in zip(q, joints, strict=True):
        data.qpos[:] = model.qpos0
        for chain, urdf, _ in chains:
            for joint, number in zip(urdf.joints, chain.joints, strict=True):
                data.joint(joint.name).qpos = values[number - 1] / (1000 if joint.kind == "prismatic" else 1)
        mujoco.mj_forward(model, data)
        for kind, number, distance in zip(data.efc_type, data.efc_id, data.efc_pos, strict=True):
            equality = kind == mujoco.mjtConstraint.mjCNSTR_EQUALITY
            equality = equality and model.eq_type[number] == mujoco.mjtEq.mjEQ_JOINT
            if equality and model.joint(model.eq_obj1id[number]).name in used:
                unfulfilled = max(unfulfilled, abs(distance))
        for number, (_, _, tip) in enumerate(chains):
            expected = np.linalg.inv(frame(model, data, source.base)) @ frame(model, data, tip)
            found = first @ np.asarray(robot.pose(np.append(row, number)))
            worst = max(worst, np.abs(found - expected)[:3, 3].max())
    return f"{worst:.1e}" + (f" (equalities {unfulfilled:.1e})" if robot.mimic else "")


def loaded(path: Path, text: str):
    """A text as MuJoCo reads it beside a file, where it looks for meshes."""
    beside = path.with_name(f"{path.stem}-exported.xml")
    beside.write_text(text, encoding="utf-8")
    try:
        return mujoco.MjModel.from_xml_path(str(beside))
    finally:
        beside.unlink()


def main(*places: str) -> None:
    random = np.random.default_rng(0)
    for place in map(Path, places):
        for path in sorted(place.rglob("*.xml")) if place.is_dir() else [place]:
            if "<mujoco" in path.read_text(encoding="utf-8", errors="replace"):
                print(f"{path.parent.name}/{path.name}: {compare(path, random)}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
