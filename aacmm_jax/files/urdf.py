"""Robots in URDF and MJCF: a serial chain read into an arm, and a calibrated arm written back into the user's file."""

import math
import os
from collections.abc import Container, Iterable, Iterator, Sequence
from functools import reduce
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.rotations import roll_pitch_yaw
from ..core.text import quoted
from ..kinematics.arm import Arm, arm_of
from ..kinematics.axes_to_dh import (
    Axes,
    Transform,
    calibrated_frames,
    dh_frames,
    dh_of_axes,
    geometry_of,
    inverse,
    same_transform,
    tip_frame,
)
from ..kinematics.chain import Geometry, JointKinds
from ..kinematics.parameters import ArmSpecification, UrdfSource, single
from ..kinematics.robots import chain_of
from .mjcf import edited_mjcf
from .mjcf_text import parse_robot
from .outputs import write_text
from .urdf_text import MOVING, ExportedUrdf, Robot, UrdfJoint, edited, listed_links, mimic_of, unused_name

_REVOLUTION = (-2 * math.pi, 2 * math.pi)  # limits of a continuous joint: readings of -pi to pi and of 0 to 2 pi
_LONGEST = 50_000.0  # mm; no serial chain is as long
_LARGEST, _IN_DEGREES = 15.0, 720.0  # rad: limits of joints end below; those in degrees are mostly between
_SAME_PLACE = 1e-9  # mm: a probe nearer to the tip link than this is no tool beyond it


class UrdfChain(NamedTuple):
    """The joints that move between base and tip, and the arm that they are.

    ``arm.pose(q)`` takes the joint values of the URDF without a change of sign, those of prismatic joints in mm.
    ``base @ arm.pose(q)`` is the pose of the tip link in the base link, in mm, as long as the arm has the probe that it
    was read with.
    """

    arm: Arm
    base: Transform  # the first D-H frame in the base link, mm
    robot: Robot
    joints: tuple[UrdfJoint, ...]
    before: tuple[Transform, ...]  # fixed joints before each joint: its parent in the frame of the joint before
    tip_before: Transform  # likewise for the last fixed joint, or for the tip
    tip_joint: UrdfJoint | None  # the fixed joint that ends at the tip link, where there is one

    @property
    def origins(self) -> list[Transform]:
        """Each joint in the frame of the joint before it at reading 0, mm."""
        return [before @ joint.origin for before, joint in zip(self.before, self.joints, strict=True)]

    @property
    def tip(self) -> Transform:
        """The tip link in the frame of the last joint, mm."""
        return self.tip_before if self.tip_joint is None else self.tip_before @ self.tip_joint.origin

    def carried_links(self, base: str, stops: Iterable[str] = ()) -> Iterator[tuple[int, str, Transform]]:
        """The links that the base link (0) and each joint carry up to the next joint, side branches included but for
        those of joints that are ``stops``: number of the joint, name of the link, and its frame in the base link at
        reading 0."""
        stops, frame = {joint.name for joint in self.joints} | set(stops), np.eye(4)
        starts = [base, *(joint.child for joint in self.joints)]
        for number, (start, origin) in enumerate(zip(starts, [np.eye(4), *self.origins], strict=True)):
            frame = frame @ origin
            waiting = [(start, frame)]
            while waiting:
                link, link_frame = waiting.pop()
                yield number, link, link_frame
                after = (joint for joint in self.robot.joints.values() if joint.parent == link)
                waiting += [(joint.child, link_frame @ joint.origin) for joint in after if joint.name not in stops]


class LinkMasses(NamedTuple):
    """What each joint carries up to the next one: mass, and centre of mass in the D-H frame after the joint."""

    mass: Float[np.ndarray, " n"]  # kg; 0 where the file states none
    centre: Float[np.ndarray, "n 3"]  # mm; 0 where there is no mass


def located(source: UrdfSource, arm: Arm) -> UrdfSource:
    """The same source with its links as seen from the frames of an arm, which may have a tool beyond the tip link; that
    of a robot as it is."""
    if arm.chains:
        return source
    chain = urdf_chain(source)
    probe = np.asarray(chain.arm.probe)
    without_tool = np.allclose(arm.probe, probe, rtol=0, atol=_SAME_PLACE)
    first = tuple(map(tuple, chain.base.tolist()))
    follows = chain.tip_joint is not None and without_tool
    return source._replace(first=first, link=tuple(probe.tolist()), follows=follows)


def urdf_chain(source: UrdfSource, *, alone: bool = True) -> UrdfChain:
    """The chain between two links of a URDF, or between bodies and sites of MJCF, as an arm; exact, whatever the
    directions of the axes.

    Args:
        source: The text of the file and the names of the links.
        alone: Whether joints that mimic another one follow it, which must be in the chain; a part of a robot has them
            as joints with a reading.

    Example:
        >>> chain = aj.files.urdf_chain(aj.files.load_specification("robot.urdf").urdf)
        >>> print([joint.name for joint in chain.joints])
        ['turn', 'lift', 'bend']
        >>> print((chain.base @ chain.arm.pose([0.0, 0.0, 0.0]))[:3, 3].round(3), "mm")
        [750.   0. 300.] mm
    """
    robot = parse_robot(source.text)
    if len(source.tips) > 1:
        tips = listed_links(source.tips)
        raise InputError(f"the file has several chains, which end at {tips}; choose one tip (tip= or --tip).")
    path = joints_between(robot, source.base, source.tip)
    joints, before, frames, frame, fixed = [], [], [], np.eye(4), np.eye(4)
    for joint in path:
        fixed_before, fixed = fixed, fixed @ joint.origin
        if joint.kind != "fixed":
            _check_moving(joint, [other.name for other in path] if alone else robot.joints)
            frame, fixed = frame @ fixed_before @ joint.origin, np.eye(4)
            joints.append(joint)
            before.append(fixed_before)
            frames.append(frame)
    if not joints:
        raise InputError(
            f"there is no moving joint between {quoted(source.base)} and {quoted(source.tip)}; choose other links."
        )
    length = sum(float(np.linalg.norm(joint.origin[:3, 3])) for joint in path)
    if length > _LONGEST:
        raise InputError(
            f"the chain from {quoted(source.base)} to {quoted(source.tip)} is {length / 1000:,.0f} m long, so its "
            f"lengths are probably in mm; {robot.document.format.name} uses m, so divide the lengths by 1000."
        )
    *after, last = path[path.index(joints[-1]) :]
    tip_joint = last if last.kind == "fixed" else None
    tip_before = reduce(np.matmul, [joint.origin for joint in after[1:]], np.eye(4))
    tip = frame @ tip_before if tip_joint is None else frame @ tip_before @ tip_joint.origin
    directions = np.array([frame[:3, :3] @ joint.axis for frame, joint in zip(frames, joints, strict=True)])
    base, geometry = dh_of_axes(Axes(directions, np.array([frame[:3, 3] for frame in frames]), tip))
    limits = [_REVOLUTION if joint.kind == "continuous" else joint.limits or _REVOLUTION for joint in joints]
    prismatic = tuple(joint.kind == "prismatic" for joint in joints)
    arm = arm_of(geometry._replace(kinds=JointKinds(prismatic) if any(prismatic) else None), limits)
    place = {joint.name: number for number, joint in enumerate(joints, start=1)}
    if alone and (mimic := {joint.name: mimic_of(joint, robot) for joint in joints if joint.mimics is not None}):
        arm = arm.replace(mimic=[(place[name], place[source], *rest) for name, (source, *rest) in mimic.items()])
    return UrdfChain(arm, base, robot, tuple(joints), tuple(before), tip_before, tip_joint)


def link_masses(chain: UrdfChain) -> LinkMasses:
    """Mass and centre of mass of what each joint carries up to the next one, side branches included at reading 0.

    Args:
        chain: The chain, from `urdf_chain`.

    Example:
        >>> chain = aj.files.urdf_chain(aj.files.load_specification("robot.urdf").urdf)
        >>> print(aj.files.link_masses(chain).mass, "kg")
        [4.  3.  1.5] kg
    """
    mass, moment = np.zeros(len(chain.joints)), np.zeros((len(chain.joints), 3))
    for number, name, frame in chain.carried_links(chain.joints[0].parent):
        link = chain.robot.links[name]
        if number and link.mass and link.centre is not None:
            mass[number - 1] += link.mass
            moment[number - 1] += link.mass * (frame[:3, :3] @ link.centre + frame[:3, 3])
    centre = np.zeros_like(moment)
    for i, frame in enumerate(dh_frames(geometry_of(chain.arm), chain.base)[1:]):
        if mass[i]:
            centre[i] = frame[:3, :3].T @ (moment[i] / mass[i] - frame[:3, 3])
    return LinkMasses(mass, centre)


def urdf_of(arm: Arm, nominal: ArmSpecification) -> ExportedUrdf:
    """The user's URDF or MJCF with the origins of a calibrated arm; comments, meshes, order and other numbers stay.

    The base link stays, and a joint's frame moves along its axis, and turns about it, no more than the calibration
    says: no data on the tip determine that. The zero offset of a prismatic joint shifts its frame along its axis. Where
    the arm has a tool beyond the tip link, or no fixed joint ends at the tip link, the calibrated tip is the origin of
    a link that is added. The base of an arm of a robot is the origin of its first joint. In
    MJCF, the bodies have the origins, sites are links, and files that were included stand in the text.

    Args:
        arm: The calibrated arm.
        nominal: The arm that `read_urdf` gave.

    Example:
        >>> robot = aj.files.load_specification("robot.urdf")
        >>> exported = aj.files.urdf_of(robot.arm.replace(a_2=401.0), robot)
        >>> print(exported.changed, exported.tip)
        ('bend',) flange
    """
    if nominal.urdf is None:
        raise InputError(
            "the nominal arm was not read from a URDF or MJCF, so a URDF cannot be exported; choose --format toml, or "
            "import the readings again with the URDF of the robot as the arm (arm = 'robot.urdf', tip = '...')."
        )
    source, probes = nominal.urdf, np.asarray(nominal.arm.probe).reshape(-1, 3)
    wanted = {"joints": single(arm).joints, "chains": [name for name, _ in arm.chains]}
    if wanted != {"joints": nominal.arm.joints, "chains": [name for name, _ in nominal.arm.chains]}:
        raise InputError(
            f"the arm has {arm.joints} joints, but the chain has {nominal.arm.joints}; give an arm that was "
            "calibrated from this file."
        )
    if not arm.chains:
        chain = urdf_chain(source)
        return _exported(source, chain, geometry_of(arm), chain.base, (), probes[0])
    first, plain = urdf_chain(source._replace(tips=source.tips[:1]), alone=False).base, arm.replace(mimic=())
    tips, changed, notes = [], {}, []
    text = source.text
    for tip, probe in zip(source.tips, probes, strict=True):
        part, chain = chain_of(plain, tip), urdf_chain(source._replace(tips=(tip,)), alone=False)
        branching = [i for i, joint in enumerate(part.joints) if part.names[f"theta_{i + 1}"] != f"theta_{joint}"]
        one = source._replace(text=text, tips=(tip,))
        exported = _exported(one, chain, geometry_of(part.arm), first @ part.base, branching, probe)
        text, tips, notes = exported.text, [*tips, exported.tip], [*notes, *exported.notes]
        changed |= dict.fromkeys(exported.changed)
    return ExportedUrdf(text, ", ".join(tips), tuple(changed), tuple(notes))


def _exported(
    source: UrdfSource,
    nominal: UrdfChain,
    after: Geometry,
    base: Transform,
    branching: Sequence[int],
    probe: Float[np.ndarray, " 3"],
) -> ExportedUrdf:
    """The text with the origins of one calibrated chain on its calibrated base; its joints after which chains separate
    (from 0) do not turn with the zero offset, which is another one in each chain. ``probe`` is the nominal one."""
    before = geometry_of(nominal.arm)
    frames = calibrated_frames(nominal.origins, before, after, nominal.base, base, branching)
    last = inverse(reduce(np.matmul, frames, np.eye(4)))
    has_tool = bool(np.linalg.norm(probe - np.asarray(before.probe)) > _SAME_PLACE)
    tip = last @ tip_frame(after, base)
    # A tool is no part of the file: the tip link then follows the last D-H frame alone.
    link = last @ tip_frame(after._replace(probe=before.probe), base) if has_tool else tip
    chain = urdf_chain(source, alone=False)  # as the text has it, which other chains may have changed
    if source.format == "MJCF":
        path = joints_between(chain.robot, source.base, source.tip)
        return edited_mjcf(source.text, chain.robot, path, nominal.robot.joints, frames, link, tip)
    return _edited_urdf(source, chain, frames, link, tip)


def _edited_urdf(
    source: UrdfSource, chain: UrdfChain, frames: list[Transform], link: Transform, tip: Transform
) -> ExportedUrdf:
    """The text with other origins; ``link`` and ``tip`` as of `edited_mjcf`."""
    origins: dict[str, dict[str, str]] = {}
    for joint, fixed, new in zip(chain.joints, chain.before, frames, strict=True):
        if values := _changed(inverse(fixed) @ new, joint.origin):
            origins[joint.name] = values
    if chain.tip_joint is None:
        link = chain.tip
    elif not same_transform(chain.tip, link):
        origins[chain.tip_joint.name] = _changed(inverse(chain.tip_before) @ link, chain.tip_joint.origin)
    name, added, notes = source.tip, "", ()
    if not same_transform(link, tip):
        joints = [joint.removesuffix("_joint") for joint in chain.robot.joints]
        name = unused_name(f"{name}_probe", chain.robot.links, joints)
        origin = " ".join(f'{key}="{text}"' for key, text in _attributes(inverse(link) @ tip).items())
        added = (
            f"  <link name={quoteattr(name)}/>\n"
            f'  <joint name={quoteattr(name + "_joint")} type="fixed">\n'
            f"    <parent link={quoteattr(source.tip)}/>\n"
            f"    <child link={quoteattr(name)}/>\n"
            f"    <origin {origin}/>\n"
            "  </joint>\n"
        )
        notes = (f"the calibrated tip is the origin of the link {quoted(name)}, which was added to the URDF.",)
    return ExportedUrdf(edited(source.text, origins, chain.robot, added), name, tuple(origins), notes)


def save_urdf(arm: Arm, path: str | os.PathLike, *, nominal: ArmSpecification) -> ExportedUrdf:
    """Write the user's URDF or MJCF with the origins of a calibrated arm, as `urdf_of` makes it.

    Args:
        arm: The calibrated arm.
        path: The file to write.
        nominal: The arm as `read_urdf` or `load_specification` gave it.

    Example:
        >>> robot = aj.files.load_specification("robot.urdf")
        >>> calibrated = robot.arm.replace(a_2=401.0)
        >>> exported = aj.files.save_urdf(calibrated, "calibrated.urdf", nominal=robot)
        >>> print(aj.load_arm("calibrated.urdf").a, exported.tip)
        [ 50. 401. 300.] flange
    """
    exported = urdf_of(arm, nominal)
    write_text(path, exported.text)
    return exported


def _changed(new: Transform, old: Transform) -> dict[str, str]:
    """xyz in m and rpy in rad with all digits, those of which the file's own text does not say the same."""
    shifted, attributes = old.copy(), _attributes(new)
    shifted[:3, 3] = new[:3, 3]
    same = {"xyz": same_transform(shifted, old), "rpy": same_transform(shifted, new)}
    return {key: text for key, text in attributes.items() if not same[key]}


def _attributes(transform: Transform) -> dict[str, str]:
    values = {"xyz": transform[:3, 3] / 1000, "rpy": roll_pitch_yaw(transform[:3, :3])}
    # 0.0 is added, as -0.0 becomes 0.0.
    return {key: " ".join(repr(float(value) + 0.0) for value in three) for key, three in values.items()}


def _check_moving(joint: UrdfJoint, others: Container[str]) -> None:
    """Refuse a joint that an arm does not have; ``others`` are the joints that it may mimic."""
    what, slides = f"joint {quoted(joint.name)}", joint.kind == "prismatic"
    if joint.kind not in MOVING:
        of_format = joint.kind in ("floating", "planar", "spherical")
        kind = f"is {joint.kind}" if of_format else f"has the unknown type {quoted(joint.kind)}"
        raise InputError(
            f"{what} {kind}, which cannot be part of an arm; choose links without this joint between them."
        )
    if joint.mimics is not None and joint.mimics not in others:
        raise InputError(
            f"{what} mimics {quoted(joint.mimics)}, which is not a joint of the same chain; choose links without "
            "this joint between them."
        )
    if joint.axis is None:
        raise InputError(f"{what} has an axis of length 0; correct <axis xyz=...> of the joint.")
    if joint.kind == "continuous":
        return
    unit, factor = ("m", 1e-3) if slides else ("rad", 1.0)
    limit = f"<limit lower=... upper=...> in {unit}" if joint.place is None else "range=..."
    other = "" if slides or joint.place is not None else ', or type="continuous"'
    limits = [f"{factor * limit:g}" for limit in joint.limits or ()]
    if joint.limits is None or not joint.limits[0] < joint.limits[1]:
        state = f"has the limits {' and '.join(limits)} {unit}" if limits else "has no limits"
        raise InputError(f"{what} is {joint.kind} and {state}; add {limit}, with lower below upper{other}.")
    if not slides and _LARGEST < max(map(abs, joint.limits)) <= _IN_DEGREES:
        raise InputError(
            f"{what} has the limits {' and '.join(limits)} rad, which are probably in degrees, but the "
            "file states rad; convert the limits."
        )


def _joints_before(robot: Robot, link: str) -> list[UrdfJoint]:
    """The joints from a link back to the root."""
    joints: list[UrdfJoint] = []
    while link in robot.joint_before:
        if len(joints) > len(robot.joint_before):
            raise InputError(
                f"the joints before link {quoted(link)} form a loop; a URDF must be a tree, so correct the joints."
            )
        joints.append(robot.joint_before[link])
        link = joints[-1].parent
    return joints


def joints_between(robot: Robot, base: str, tip: str) -> list[UrdfJoint]:
    """The joints from base to tip."""
    back = _joints_before(robot, tip)
    parents = [joint.parent for joint in back]
    if base in parents:
        return back[: parents.index(base) + 1][::-1]
    if base == tip:
        raise InputError(f"base and tip are the same link, {quoted(base)}; choose two different links.")
    other = [joint.parent for joint in _joints_before(robot, base)]
    if tip in other:
        raise InputError(
            f"the base {quoted(base)} is after the tip {quoted(tip)} in the chain of joints; exchange base and tip."
        )
    common = next((link for link in other if link in parents), None)
    if common is None:
        raise InputError(
            f"there is no chain of joints from {quoted(base)} to {quoted(tip)}; choose two links of the same arm."
        )
    raise InputError(
        f"{quoted(base)} and {quoted(tip)} are on two branches that separate at {quoted(common)}; choose "
        f"{quoted(common)} as the base, or a tip on the same branch as the base."
    )


def ends_of(robot: Robot, base: str | None, given: Sequence[str]) -> tuple[str, list[str]]:
    """The base and the tip links that are named, else the root, and the ends of chains that move."""
    for what, link in (("base", base), *(("tip", tip) for tip in given)):
        if link is not None and link not in robot.links:
            raise InputError(
                f"the file has no link {quoted(link)} for the {what}; its links are {listed_links(robot.links)}."
            )
    if base is None and given and (back := _joints_before(robot, given[0])):
        base = back[-1].parent
    if base is None:
        roots = [link for link in robot.links if link not in robot.joint_before]
        if not robot.links:
            raise InputError("the file has no <link>; give the file of a robot.")
        if not roots:
            raise InputError(
                "every link has a joint before it, so the joints form a loop; a URDF must be a tree, so correct the "
                "joints."
            )
        if len(roots) > 1:
            raise InputError(
                f"the file has {len(roots)} root links, {listed_links(roots)}; choose the base (base= or --base)."
            )
        base = roots[0]
    if given:
        return base, [*given]
    bodies = [joint for joint in robot.joints.values() if joint.element.name != "site"]
    tips, inner = [], {joint.parent for joint in bodies}
    for link in (joint.child for joint in bodies if joint.child not in inner):
        back = _joints_before(robot, link)
        parents = [joint.parent for joint in back]
        if base in parents and any(joint.kind != "fixed" for joint in back[: parents.index(base) + 1]):
            tips.append(link)
    if not tips:
        raise InputError(f"there is no moving joint after {quoted(base)}; choose another base (base= or --base).")
    return base, tips
