"""Robots in URDF: a serial chain read into an arm, and a calibrated arm written back into the user's own file."""

import math
import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers
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
from ..kinematics.chain import JointKinds
from ..kinematics.parameters import ArmSpecification, UrdfSource, single, with_tool
from .atomic_write import write_text
from .inputs import InputFile
from .urdf_text import Robot, UrdfJoint, edited, parse_urdf
from .urdf_tree import base_and_tip, check_moving, joints_between

_REVOLUTION = (-2 * math.pi, 2 * math.pi)  # limits of a continuous joint: readings of -pi to pi and of 0 to 2 pi
_LONGEST = 50_000.0  # mm; no serial chain is as long


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


class LinkMasses(NamedTuple):
    """What each joint carries up to the next one: mass, and centre of mass in the D-H frame after the joint."""

    mass: Float[np.ndarray, " n"]  # kg; 0 where the file states none
    centre: Float[np.ndarray, "n 3"]  # mm; 0 where there is no mass


class ExportedUrdf(NamedTuple):
    """A URDF with calibrated origins."""

    text: str
    tip: str  # the link whose origin is the calibrated tip
    changed: tuple[str, ...]  # joints with another origin
    notes: tuple[str, ...]  # what was added, in sentences


def read_urdf(
    path: str | os.PathLike, *, base: str | None = None, tip: str | None = None, probe: Numbers | None = None
) -> ArmSpecification:
    """The arm of a serial chain of a URDF; meshes are not read.

    Args:
        path: The file.
        base: Name of the link that does not move; by default the root of the file.
        tip: Name of the link at the end; by default the only one that has no link after it.
        probe: A tool's tip in the tip link's frame, mm; by default that frame's origin.

    Returns:
        The arm, in mm and rad, in the first D-H frame, which is the base link's frame where the first axis is its z
        axis; and with it the text of the file, for `save_urdf`.

    Raises:
        InputError: Naming the file, the joint or link, and what to do.
    """
    file = InputFile(path)
    try:
        try:
            text = file.content.decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError("it is not text in UTF-8; save it as UTF-8.") from error
        robot = parse_urdf(text)
        base, tip = base_and_tip(robot, base, tip)
        source = UrdfSource(text, base, tip)
        arm = urdf_chain(source).arm
        if probe is not None:
            arm = with_tool(arm, probe)
        return ArmSpecification(arm, _name(file), urdf=source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def urdf_chain(source: UrdfSource) -> UrdfChain:
    """The chain between two links of a URDF as an arm; exact, whatever the directions of the axes.

    Args:
        source: The text of the file and the names of the links.

    Raises:
        InputError: There is no chain, or a joint in it is of a kind that an arm does not have.

    Example:
        >>> chain = aj.files.urdf_chain(aj.files.load_specification("robot.urdf").urdf)
        >>> print([joint.name for joint in chain.joints])
        ['turn', 'lift', 'bend']
        >>> print((chain.base @ chain.arm.pose([0.0, 0.0, 0.0]))[:3, 3].round(3), "mm")
        [750.   0. 300.] mm
    """
    robot = parse_urdf(source.text)
    joints, before, waiting = [], [], np.eye(4)
    path = joints_between(robot, source.base, source.tip)
    for joint in path:
        if joint.kind == "fixed":
            waiting = waiting @ joint.origin
            continue
        check_moving(joint)
        joints.append(joint)
        before.append(waiting)
        waiting = np.eye(4)
    if not joints:
        raise InputError(f"no joint moves between {quoted(source.base)} and {quoted(source.tip)}; name other links.")
    length = sum(float(np.linalg.norm(joint.origin[:3, 3])) for joint in path)
    if length > _LONGEST:
        raise InputError(
            f"the chain from {quoted(source.base)} to {quoted(source.tip)} is {length / 1000:,.0f} m long, as if its "
            "lengths were in mm; a URDF is in m, so divide them by 1000."
        )
    last = path[-1] if path[-1].kind == "fixed" else None
    tip_before = _product([joint.origin for joint in path[path.index(joints[-1]) + 1 : len(path) - (last is not None)]])
    frames, frame = [], np.eye(4)
    for fixed, joint in zip(before, joints, strict=True):
        frame = frame @ fixed @ joint.origin
        frames.append(frame)
    tip = frame @ tip_before if last is None else frame @ tip_before @ last.origin
    directions = np.array([frame[:3, :3] @ joint.axis for frame, joint in zip(frames, joints, strict=True)])
    base, geometry = dh_of_axes(Axes(directions, np.array([frame[:3, 3] for frame in frames]), tip))
    limits = [_REVOLUTION if joint.kind == "continuous" else joint.limits or _REVOLUTION for joint in joints]
    prismatic = tuple(joint.kind == "prismatic" for joint in joints)
    arm = arm_of(geometry._replace(kinds=JointKinds(prismatic) if any(prismatic) else None), limits)
    return UrdfChain(arm, base, robot, tuple(joints), tuple(before), tip_before, last)


def link_masses(chain: UrdfChain) -> LinkMasses:
    """Mass and centre of mass of what each joint carries up to the next one, side branches included at reading 0.

    Args:
        chain: The chain, from `urdf_chain`.

    Returns:
        Masses ``(n,)``, kg, and centres of mass ``(n, 3)`` in each link's D-H frame, mm.

    Example:
        >>> chain = aj.files.urdf_chain(aj.files.load_specification("robot.urdf").urdf)
        >>> print(aj.files.link_masses(chain).mass, "kg")
        [4.  3.  1.5] kg
    """
    frames, frame = dh_frames(geometry_of(chain.arm), chain.base)[1:], np.eye(4)
    mass, centre = np.zeros(len(chain.joints)), np.zeros((len(chain.joints), 3))
    stops = {joint.name for joint in chain.joints}
    for i, (origin, joint) in enumerate(zip(chain.origins, chain.joints, strict=True)):
        frame = frame @ origin
        waiting = [(joint.child, frame)]
        moment = np.zeros(3)
        while waiting:
            name, at = waiting.pop()
            link = chain.robot.links[name]
            if link.mass and link.centre is not None:
                mass[i] += link.mass
                moment += link.mass * (at[:3, :3] @ link.centre + at[:3, 3])
            waiting += [
                (other.child, at @ other.origin)
                for other in chain.robot.joints.values()
                if other.parent == name and other.name not in stops
            ]
        if mass[i]:
            centre[i] = frames[i][:3, :3].T @ (moment / mass[i] - frames[i][:3, 3])
    return LinkMasses(mass, centre)


def urdf_of(arm: Arm, nominal: ArmSpecification) -> ExportedUrdf:
    """The user's URDF with the origins of a calibrated arm; comments, meshes, order and other numbers stay.

    The base link stays, and a joint's frame moves along its axis, and turns about it, no more than the calibration
    says: no data on the tip determine that. The zero offset of a prismatic joint shifts its frame along its axis. Where
    the arm has a tool beyond the tip link, or no fixed joint ends at the tip link, the calibrated tip is the origin of
    a link that is added.

    Args:
        arm: The calibrated arm.
        nominal: The arm that `read_urdf` gave.

    Raises:
        InputError: The nominal arm is not from a URDF, or the arms do not fit together.

    Example:
        >>> robot = aj.files.load_specification("robot.urdf")
        >>> exported = aj.files.urdf_of(robot.arm.replace(a_2=401.0), robot)
        >>> print(exported.changed, exported.tip)
        ('bend',) flange
    """
    if nominal.urdf is None:
        raise InputError("the nominal arm was not read from a URDF, so there is none to write; choose --format toml.")
    chain = urdf_chain(nominal.urdf)
    if single(arm).joints != len(chain.joints):
        raise InputError(
            f"the arm has {arm.joints} joints, but the URDF {len(chain.joints)}; give one that was calibrated from it."
        )
    before, after = geometry_of(chain.arm), geometry_of(arm)
    origins: dict[str, tuple[str | None, str | None]] = {}
    frame, nominal_origins = np.eye(4), chain.origins
    frames = calibrated_frames(nominal_origins, before, after, chain.base)
    for joint, fixed, old, new in zip(chain.joints, chain.before, nominal_origins, frames, strict=True):
        frame = frame @ new
        if new is not old:
            origins[joint.name] = _written(inverse(fixed) @ new, joint.origin)
    tip = tip_frame(after, chain.base)
    tool = np.asarray(nominal.arm.probe) - np.asarray(chain.arm.probe)
    has_tool = bool(np.linalg.norm(tool) > 1e-9)
    # A tool is no part of the file: the tip link then follows the last D-H frame alone.
    link = tip_frame(after._replace(probe=before.probe), chain.base) if has_tool else tip
    if chain.tip_joint is not None and not same_transform(frame @ chain.tip, link):
        moved = inverse(frame @ chain.tip_before) @ link
        origins[chain.tip_joint.name] = _written(moved, chain.tip_joint.origin)
    elif chain.tip_joint is None:
        link = frame @ chain.tip
    name, added, notes = nominal.urdf.tip, "", ()
    if not same_transform(link, tip):
        name, added = _added_link(chain.robot, nominal.urdf.tip, inverse(link) @ tip)
        notes = (f"the calibrated tip is the origin of the link {quoted(name)}, which was added.",)
    return ExportedUrdf(edited(nominal.urdf.text, origins, chain.robot, added), name, tuple(origins), notes)


def save_urdf(arm: Arm, path: str | os.PathLike, *, nominal: ArmSpecification) -> ExportedUrdf:
    """Write the user's URDF with the origins of a calibrated arm, as `urdf_of` makes it.

    Args:
        arm: The calibrated arm.
        path: The file to write.
        nominal: The arm as `read_urdf` or `load_specification` gave it.

    Raises:
        InputError: The nominal arm is not from a URDF, or the file cannot be written.

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


def _product(transforms: Sequence[Transform]) -> Transform:
    result = np.eye(4)
    for transform in transforms:
        result = result @ transform
    return result


def _name(file: InputFile) -> str:
    return os.path.splitext(os.path.basename(os.fspath(file)))[0]


def _written(new: Transform, old: Transform) -> tuple[str | None, str | None]:
    """xyz in m and rpy in rad with all digits; None where the file's own text says the same."""
    middle = old.copy()
    middle[:3, 3] = new[:3, 3]
    xyz = None if same_transform(middle, old) else _digits(new[:3, 3] / 1000)
    rpy = None if same_transform(middle, new) else _digits(roll_pitch_yaw(new[:3, :3]))
    return xyz, rpy


def _digits(values: Float[np.ndarray, " 3"]) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)  # -0.0 becomes 0.0


def _added_link(robot: Robot, tip: str, transform: Transform) -> tuple[str, str]:
    from xml.sax.saxutils import quoteattr

    name = next(
        name
        for name in (f"{tip}_probe{suffix}" for suffix in ("", *range(2, 1000)))
        if name not in robot.links and f"{name}_joint" not in robot.joints
    )
    xyz, rpy = _digits(transform[:3, 3] / 1000), _digits(roll_pitch_yaw(transform[:3, :3]))
    lines = [
        f"  <link name={quoteattr(name)}/>",
        f'  <joint name={quoteattr(name + "_joint")} type="fixed">',
        f"    <parent link={quoteattr(tip)}/>",
        f"    <child link={quoteattr(name)}/>",
        f'    <origin xyz="{xyz}" rpy="{rpy}"/>',
        "  </joint>",
    ]
    return name, "".join(f"{line}\n" for line in lines)
