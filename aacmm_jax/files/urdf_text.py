"""The text of a URDF: joints, links and collision shapes with their places, and edits of the origins of joints.

The format's specification: wiki.ros.org/urdf/XML. Only direct children of ``<robot>`` count, since transmissions,
controllers and simulators have elements of the same names.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.rotations import roll_pitch_yaw_matrix
from ..core.text import quoted, shorten
from ..kinematics.axes_to_dh import Transform
from .xml_text import Document, Element, Format, Names, replaced, with_values

_LARGEST_ANGLE = 6.3  # rad, of roll, pitch and yaw: one revolution
_METRE = 1000.0  # mm
_ZERO = (0.0, 0.0, 0.0)
MOVING = ("revolute", "continuous", "prismatic")
_LISTED = 12  # links that a message names

URDF = Format("a URDF", "robot", {
    "robot": Names("", "", "joint link", others=True),
    "link": Names("name", "inertial", "collision origin", others=True),  # an origin there means nothing
    "joint": Names("name type", "origin parent child axis limit mimic calibration", others=True),
    "origin": Names("xyz rpy"),
    "parent": Names("link"),
    "child": Names("link"),
    "axis": Names("xyz"),
    "limit": Names("lower upper", others=True),
    "mimic": Names("joint multiplier offset"),
    "calibration": Names("rising falling", others=True),
    "inertial": Names("", "origin mass inertia"),
    "mass": Names("value"),
    "collision": Names("name", "origin geometry", others=True),
    "geometry": Names("", "", "box cylinder sphere mesh", others=True),
    "box": Names("size"),
    "cylinder": Names("radius length"),
    "sphere": Names("radius"),
    "mesh": Names("filename scale"),
}, ("joint", "link"))  # fmt: skip


class Placement(NamedTuple):
    """Where an element of MJCF is, beyond what a URDF can say: transforms in mm."""

    body: Element | None = None  # of the first joint of a body: the body, whose place in its parent is in the origin
    outer: Transform = np.eye(4)  # the frames about the body, or about the site, in the parent
    around: Transform = np.eye(4)  # the frames about the joint in its body
    anchor: Transform = np.eye(4)  # a point on the axis, by a shift in the body
    reference: Transform = np.eye(4)  # the motion from reading 0 to the reading at which the file draws the robot
    drawn: float = 0.0  # this reading, rad or mm
    equality: Element | None = None  # that couples the joint to the one it mimics


class UrdfJoint(NamedTuple):
    """A joint as the file states it, in mm and rad; of MJCF also what stands for it in a tree of links."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Transform  # of the child in the parent at reading 0, mm
    axis: Float[np.ndarray, " 3"] | None  # of length 1, in the child; None where it is 0
    limits: tuple[float, float] | None  # rad, or mm of a prismatic joint
    mimics: str | None
    element: Element
    place: Placement | None = None  # of MJCF


class UrdfLink(NamedTuple):
    """A link: its mass in kg and its centre of mass in its frame in mm, or None where the file does not state them."""

    mass: float | None = None
    centre: Float[np.ndarray, " 3"] | None = None


class UrdfShape(NamedTuple):
    """A collision shape of a link: a box of three edges, a cylinder (radius, length), a sphere (radius), or a mesh."""

    kind: str
    origin: Transform  # in the link's frame, mm
    size: tuple[float, ...]  # mm; of a mesh the scale from its numbers to mm
    file: str  # of a mesh


class Robot(NamedTuple):
    """What a URDF says of kinematics and masses."""

    joints: dict[str, UrdfJoint]
    links: dict[str, UrdfLink]
    joint_before: dict[str, UrdfJoint]  # by link the joint that it is the child of
    document: Document


class ExportedUrdf(NamedTuple):
    """A URDF or MJCF with the origins of a calibrated arm."""

    text: str
    tip: str  # the link, or site, whose origin is the calibrated tip
    changed: tuple[str, ...]  # joints with another origin; of MJCF bodies, joints and sites
    notes: tuple[str, ...]  # what was added, in sentences


def unused_name(name: str, *names: Collection[str]) -> str:
    """The name, with a number where it is one of ``names``."""
    taken = set().union(*names)
    return next(new for i in range(1, len(taken) + 2) if (new := name if i == 1 else f"{name}{i}") not in taken)


def urdf_robot(document: Document) -> Robot:
    """The joints and links of a URDF; `InputError` where a value is not a number, or a name is missing or there
    twice."""
    joints, links = {}, {}
    for element in document.root.children:
        items, read = (joints, _joint) if element.name == "joint" else (links, _link)
        name = element.text("name")
        if name in items:
            raise InputError(f"{element.where} occurs twice; rename one of the two.")
        items[name] = read(element)
    return tree_of(joints, links, document)


def tree_of(joints: dict[str, UrdfJoint], links: dict[str, UrdfLink], document: Document) -> Robot:
    """The robot of joints and links; `InputError` where a link is missing, or is the child of two joints."""
    before: dict[str, UrdfJoint] = {}
    for joint in joints.values():
        for link in (joint.parent, joint.child):
            if link not in links:
                raise InputError(
                    f"joint {quoted(joint.name)} names the link {quoted(link)}, which does not exist; add this link."
                )
        if joint.child in before:
            raise InputError(
                f"link {quoted(joint.child)} is the child of two joints, {quoted(before[joint.child].name)} and "
                f"{quoted(joint.name)}; a URDF must be a tree, so remove one of the two joints."
            )
        before[joint.child] = joint
    return Robot(joints, links, before, document)


def _origin(element: Element) -> Transform:
    """The transform, mm, of the ``<origin>`` in it; by default none."""
    transform, origin = np.eye(4), element.child("origin")
    if origin is not None:
        angles = origin.numbers("rpy", _ZERO)
        if np.any(np.abs(angles) > _LARGEST_ANGLE):
            raise InputError(
                f"{origin.where} has rpy = {quoted(origin.attributes['rpy'])}, more than a revolution, so it is "
                "probably in degrees; a URDF uses rad, so convert the angles."
            )
        transform[:3, :3] = roll_pitch_yaw_matrix(angles)
        transform[:3, 3] = _METRE * origin.numbers("xyz", _ZERO)
    return transform


def _joint(element: Element) -> UrdfJoint:
    ends = []
    for end in ("parent", "child"):
        child = element.child(end)
        if child is None:
            raise InputError(f"{element.where} has no <{end} link=...>; add it.")
        ends.append(child.text("link"))
    kind = element.text("type")
    axis, limit, mimic = (element.child(part) for part in ("axis", "limit", "mimic"))
    direction = np.array([1.0, 0.0, 0.0])  # which the format's specification says
    if axis is not None:
        axis.text("xyz")
        direction = axis.numbers("xyz", _ZERO)
    size = float(np.linalg.norm(direction))
    limits = None
    if limit is not None and {"lower", "upper"} & limit.attributes.keys():
        unit = _METRE if kind == "prismatic" else 1.0
        limits = (unit * limit.numbers("lower", (0.0,))[0], unit * limit.numbers("upper", (0.0,))[0])
    return UrdfJoint(
        element.text("name"),
        kind,
        *ends,
        origin=_origin(element),
        axis=direction / size if size > 0 else None,
        limits=limits,
        mimics=None if mimic is None else mimic.attributes.get("joint", ""),
        element=element,
    )


def _link(element: Element) -> UrdfLink:
    inertial = element.child("inertial")
    mass = None if inertial is None else inertial.child("mass")
    if inertial is None or mass is None:
        return UrdfLink()
    mass.text("value")
    value = float(mass.numbers("value", (0.0,))[0])
    if value < 0:
        raise InputError(f"{mass.where} is {value:g} kg; a mass cannot be negative.")
    return UrdfLink(value, _origin(inertial)[:3, 3])


def collision_shapes(robot: Robot) -> dict[str, tuple[UrdfShape, ...]]:
    """The collision shapes of each link of a URDF that has some; kinds that a URDF does not know are left out. Raises
    `InputError` where a shape has no size."""
    shapes: dict[str, tuple[UrdfShape, ...]] = {}
    for link in robot.document.root.children:
        for collision in link.children if link.name == "link" else ():
            geometry = collision.child("geometry")
            if collision.name == "collision" and geometry is not None and geometry.children:
                name, shape = link.text("name"), _shape(geometry.children[0], _origin(collision))
                shapes[name] = (*shapes.get(name, ()), shape)
    return shapes


def _shape(element: Element, origin: Transform) -> UrdfShape:
    if element.name == "mesh":
        scale = _METRE * element.numbers("scale", (1.0, 1.0, 1.0))
        return UrdfShape("mesh", origin, tuple(scale.tolist()), element.text("filename"))
    names = URDF.names[element.name].attributes.split()
    missing = _ZERO if element.name == "box" else (0.0,)
    size = np.concatenate([_METRE * element.numbers(name, missing) for name in names])
    if not np.all(size > 0):
        raise InputError(f"{element.where} has no positive size; give its {' and '.join(names)}.")
    return UrdfShape(element.name, origin, tuple(size.tolist()), "")


def listed_links(links: Iterable[str]) -> str:
    """Names of links as a message lists them."""
    return shorten([quoted(link) for link in links], _LISTED)


def mimic_of(joint: UrdfJoint, robot: Robot) -> tuple[str, float, float]:
    """The joint that a joint mimics, the factor and the offset, by readings in rad and mm.

    The equality of MJCF is a polynomial of the motions from where the file draws the two joints, in rad and m.
    """
    assert joint.mimics is not None
    followed = robot.joints[joint.mimics]
    unit, by = (_METRE if kind == "prismatic" else 1.0 for kind in (joint.kind, followed.kind))
    if joint.place is None or joint.place.equality is None:
        element = joint.element.child("mimic") or joint.element
        factor, offset = (float(element.numbers(*of)[0]) for of in (("multiplier", (1.0,)), ("offset", (0.0,))))
        return joint.mimics, factor * unit / by, offset * unit
    element, usual = joint.place.equality, (0.0, 1.0, 0.0, 0.0, 0.0)
    given = element.attributes.get("polycoef", "").split()  # those that are missing are as usual
    text = " ".join([*given, *map(str, usual[len(given) :])])
    offset, factor, *higher = element._replace(attributes={"polycoef": text}).numbers("polycoef", usual)
    if any(higher):
        raise InputError(
            f"{element.where} has polycoef = {quoted(text)}, but joint {quoted(joint.name)} can follow another joint "
            "only by an offset and a factor; choose links without this joint between them."
        )
    factor *= unit / by
    drawn = 0.0 if followed.place is None else followed.place.drawn
    return joint.mimics, float(factor), float(offset * unit + joint.place.drawn - factor * drawn)


def edited(text: str, origins: Mapping[str, Mapping[str, str]], robot: Robot, added: str = "") -> str:
    """The text with other origins, and with elements ``added`` at its end; everything else stays to the byte.

    ``origins`` has by joint the new xyz (m) and rpy (rad), those that change.
    """
    content = text.encode()
    end = robot.document.end
    changes: list[tuple[int, int, str]] = [(end, end, added)]
    for name, values in origins.items():
        joint = robot.joints[name].element
        origin = joint.child("origin")
        if origin is None:  # an element after the joint's start tag, indented as what follows
            start = end = joint.place[1]
            after = content[end:]
            tag = after[: len(after) - len(after.lstrip())].decode() + "<origin/>"
        else:
            start, end = origin.place
            tag = content[start:end].decode()
        changes.append((start, end, with_values(tag, values)))
    return replaced(text, changes)
