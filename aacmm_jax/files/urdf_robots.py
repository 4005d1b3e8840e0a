"""Robots of several chains in a URDF or MJCF: the chains from one base to several tips as one arm."""

import os
from collections import Counter
from collections.abc import Sequence, Set
from itertools import takewhile
from pathlib import Path

from ..core.arrays import Numbers
from ..core.errors import InputError, naming
from ..core.text import quoted
from ..kinematics.arm import Arm
from ..kinematics.axes_to_dh import inverse
from ..kinematics.parameters import ArmSpecification, UrdfSource, with_tool
from ..kinematics.robots import together
from .inputs import InputFile
from .mjcf import with_includes
from .mjcf_text import parse_robot
from .urdf import UrdfChain, ends_of, joints_between, located, urdf_chain
from .urdf_text import MOVING, Robot, UrdfJoint, listed_links, mimic_of


def read_urdf(
    path: str | os.PathLike,
    *,
    base: str | None = None,
    tip: str | Sequence[str] | None = None,
    probe: Numbers | None = None,
) -> ArmSpecification:
    """The arm of a serial chain of a URDF or MJCF, or the robot of several, in the first D-H frame, with the text of
    the file; arguments as of `load_arm`."""
    file = InputFile(path)
    with naming(path):
        try:
            text = file.content.decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError("the file is not UTF-8 text; save it as UTF-8.") from error
        text = with_includes(text, Path(file))
        robot, given = parse_robot(text), () if tip is None else (tip,) if isinstance(tip, str) else tuple(tip)
        base, tips = ends_of(robot, base, given)
        chosen = tips if given else moving_tips(robot, base, tips)
        if len(chosen) < min(2, len(tips)):
            raise InputError(
                f"the file has several chains, which end at {listed_links(tips)}; choose the tip (tip= or --tip)."
            )
        source = UrdfSource(text, base, tuple(dict.fromkeys(chosen)))
        arm = urdf_arm(source)
        arm = arm if probe is None else with_tool(arm, probe)
        return ArmSpecification(arm, Path(file).stem, urdf=located(source, arm))


def urdf_chains(source: UrdfSource) -> dict[str, UrdfChain]:
    """The chain to each tip of a robot, by the name of the tip; joints that follow others have a reading here."""
    tips = {tip: source._replace(tips=(tip,)) for tip in source.tips}
    return {tip: urdf_chain(one, alone=False) for tip, one in tips.items()}


def urdf_arm(source: UrdfSource) -> Arm:
    """The arm between a base and a tip, or the robot of several tips, whose chains have the names of the tips."""
    if len(source.tips) == 1:
        return urdf_chain(source).arm
    chains = urdf_chains(source)
    first = next(iter(chains.values()))
    joints = {tip: [joint.name for joint in chain.joints] for tip, chain in chains.items()}
    every = {joint.name: joint for chain in chains.values() for joint in chain.joints}
    mimic = {name: mimic_of(joint, first.robot) for name, joint in every.items() if joint.mimics is not None}
    for name, (followed, *_) in mimic.items():
        if followed not in every:
            raise InputError(
                f"joint {quoted(name)} mimics {quoted(followed)}, which is in none of the chains; choose tips so that "
                "both joints are part of the robot, or neither."
            )
    arms = {tip: chain.arm for tip, chain in chains.items()}
    bases = {tip: inverse(first.base) @ chain.base for tip, chain in chains.items()}
    return together(arms, joints=joints, bases=bases, mimic=mimic)


def moving_tips(robot: Robot, base: str, tips: list[str]) -> list[str]:
    """One tip for each chain of moving joints that is no beginning of another one, the one after most joints. Chains
    that differ in their last joint alone are the fingers of a gripper, and end before it; likewise chains before a
    joint that mimics one that is in none of them."""
    paths = [joints_between(robot, base, tip) for tip in tips]
    paths = [path for path in paths if all(joint.kind in ("fixed", *MOVING) for joint in path)]
    while True:
        chains = _longest_chains(robot, paths)
        others = robot.joints.keys() - {name for moving in chains for name in moving}

        def stays(joint: UrdfJoint, others: Set[str] = others) -> bool:
            return joint.kind == "fixed" or others.isdisjoint((joint.name, joint.mimics))

        shorter = [list(takewhile(stays, path)) for path in paths]
        if [*map(len, shorter)] == [*map(len, paths)]:
            return list(chains.values())
        paths = shorter


def _longest_chains(robot: Robot, paths: list[list[UrdfJoint]]) -> dict[tuple[str, ...], str]:
    """By the moving joints the tip of each chain; as of `moving_tips`."""
    ends: dict[tuple[str, ...], tuple[int, str]] = {}
    for path in paths:
        moving = tuple(joint.name for joint in path if joint.kind != "fixed")
        if moving:
            ends[moving] = max(ends.get(moving, (0, "")), (len(path), path[-1].child), key=lambda end: end[0])
    before = Counter(moving[:-1] for moving in ends)
    fingers = [moving for moving in ends if before[moving[:-1]] > 1]
    for moving in fingers:
        del ends[moving]
        ends.setdefault(moving[:-1], (0, robot.joints[moving[-1]].parent))
    inner = {moving[:count] for moving in ends for count in range(len(moving))}
    return {moving: tip for moving, (_, tip) in ends.items() if moving and moving not in inner}


def joint_names(source: UrdfSource) -> list[str]:
    """The names of the moving joints of the chain, from the base."""
    return [joint.name for joint in _path(source) if joint.kind != "fixed"]


def link_numbers(source: UrdfSource) -> dict[str, int]:
    """The links of the chain, and the number of the moving joint before each."""
    path = _path(source)
    return {joint.child: sum(other.kind != "fixed" for other in path[:i]) for i, joint in enumerate(path, start=1)}


def _path(source: UrdfSource) -> list[UrdfJoint]:
    return joints_between(parse_robot(source.text), source.base, source.tip)
