"""The text of a URDF: joints, links and collision shapes with their places, and edits that leave all else as it is.

The format's specification: wiki.ros.org/urdf/XML. Only direct children of ``<robot>`` count, since transmissions,
controllers and simulators have elements of the same names.

A misspelt ``<origin>`` or ``xyz=`` would count as one that is missing, and the arm would be another one without any
message. So in elements that are read, names that nearly are, or elsewhere are, those of the format are refused, and in
those without room for other tools' data every other name as well. Names with a prefix (``drake:...``) pass.

The parser is expat: it says where each tag is in bytes, which edits need, and in which line, which messages need. A
document type is refused: its entities could name other files, or grow to any size.
"""

import difflib
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple
from xml.parsers import expat

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError, nearest
from ..core.rotations import roll_pitch_yaw_matrix
from ..core.text import is_control, is_number, number, quoted
from ..kinematics.axes_to_dh import Transform

_MOST_CHARACTERS = 20_000_000  # the largest robots of public collections have a twentieth of it
_DEEPEST = 64  # levels of elements; a URDF has six
_ALIKE = 0.7  # of difflib: one wrong, missing, exchanged or repeated letter in four
_LARGEST = 1e6  # m and rad, of positions, angles and directions
_LARGEST_ANGLE = 6.3  # rad, of roll, pitch and yaw: one revolution
_METRE = 1000.0  # mm
_ZERO = (0.0, 0.0, 0.0)
_EXPAND = "so the file is a xacro file; expand it with 'xacro FILE.xacro > FILE.urdf' and give FILE.urdf."


class _Names(NamedTuple):
    """The names in an element that is read, divided by blanks."""

    attributes: str = ""
    once: str = ""  # children, of each at most one
    often: str = ""
    others: bool = False  # whether names that are not like these pass


_NAMES = {
    "robot": _Names("", "", "joint link", others=True),
    "link": _Names("name", "inertial", "collision origin", others=True),  # an origin there means nothing
    "joint": _Names("name type", "origin parent child axis limit mimic", others=True),
    "origin": _Names("xyz rpy"),
    "parent": _Names("link"),
    "child": _Names("link"),
    "axis": _Names("xyz"),
    "limit": _Names("lower upper", others=True),
    "mimic": _Names("joint multiplier offset"),
    "inertial": _Names("", "origin mass inertia"),
    "mass": _Names("value"),
    "collision": _Names("name", "origin geometry", others=True),
    "geometry": _Names("", "", "box cylinder sphere mesh", others=True),
    "box": _Names("size"),
    "cylinder": _Names("radius length"),
    "sphere": _Names("radius"),
    "mesh": _Names("filename scale"),
}


class Element(NamedTuple):
    """An element that is read, with those inside it."""

    name: str
    attributes: dict[str, str]
    words: str  # what messages call it
    line: int
    place: tuple[int, int]  # where its start tag begins and ends, as bytes of the text in UTF-8
    children: list["Element"]

    @property
    def where(self) -> str:
        """Its line and name, as messages begin."""
        return f"line {self.line}: {self.words}"

    def child(self, name: str) -> "Element | None":
        """The first child of a name."""
        return next((child for child in self.children if child.name == name), None)

    def text(self, name: str) -> str:
        """An attribute that must be there."""
        value = self.attributes.get(name, "")
        if not value:
            raise InputError(f"{self.where} has no {name}; add it.")
        if any(map(is_control, value)):
            raise InputError(f"{self.where} has a control character in {name}; remove the character.")
        return value

    def numbers(self, name: str, default: tuple[float, ...]) -> Float[np.ndarray, " k"]:
        """The numbers of an attribute, as many as by default."""
        text = self.attributes.get(name)
        if text is None:
            return np.array(default)
        stated, count = f"{self.where} has {name} = {quoted(text)}", len(default)
        if "${" in text or "$(" in text:
            raise InputError(f"{stated}, {_EXPAND}")
        values = np.array([number(part) for part in text.split()] if all(map(is_number, text.split())) else [])
        if count == 3 and np.any(np.abs(values) >= _LARGEST):  # limits may be as large as one likes
            raise InputError(f"{stated}; the numbers must be below {_LARGEST:g}.")
        if len(values) != count or not np.all(np.isfinite(values)):
            raise InputError(f"{stated}; give {'one number' if count == 1 else f'{count} numbers'}.")
        return values

    def origin(self) -> Transform:
        """The transform, mm, of the ``<origin>`` in it; by default none."""
        transform, origin = np.eye(4), self.child("origin")
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

    def check_attributes(self) -> None:
        """Refuse attributes that `check_name` does."""
        names = _NAMES[self.name].attributes.split()
        for key in self.attributes:
            if key == "quat_xyzw":
                raise InputError(f"{self.where} has a quaternion (quat_xyzw); write the rotation as rpy instead.")
            if key not in names and ":" not in key and key != "xmlns":
                self.check_name("attribute", key, names)

    def check_name(self, what: str, name: str, names: list[str]) -> None:
        """Refuse the name of an attribute or element in it that is misspelt, or none of ``names``."""
        if not _NAMES[self.name].others or difflib.get_close_matches(name.casefold(), names, n=1, cutoff=_ALIKE):
            shape = "<{}>" if what == "element" else "{}"
            meant = nearest(shape.format(name.casefold()), map(shape.format, names)) if names else "; remove it."
            shown = f"<{quoted(name)[1:-1]}>" if what == "element" else quoted(name)
            raise InputError(f"{self.where} has an unknown {what} {shown}{meant}")


class UrdfJoint(NamedTuple):
    """A joint as the file states it, in mm and rad."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Transform  # of the child in the parent at reading 0, mm
    axis: Float[np.ndarray, " 3"] | None  # of length 1, in the child; None where it is 0
    limits: tuple[float, float] | None  # rad, or mm of a prismatic joint
    mimics: str | None
    element: Element


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
    end: int  # where </robot> begins, as bytes of the text in UTF-8


@lru_cache(maxsize=4)  # for the chain, the masses and the export, which each take the text
def parse_urdf(text: str) -> Robot:
    """The joints and links of a URDF.

    Raises `InputError` where it is no XML or no URDF, a value is not a number, or a name is unknown, missing or there
    twice.
    """
    root, end = _parsed(text)
    joints, links, before = {}, {}, {}
    for element in root.children:
        items, read = (joints, _joint) if element.name == "joint" else (links, _link)
        name = element.text("name")
        if name in items:
            raise InputError(f"{element.where} occurs twice; rename one of the two.")
        items[name] = read(element)
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
    return Robot(joints, links, before, end)


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
        origin=element.origin(),
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
    return UrdfLink(value, inertial.origin()[:3, 3])


def collision_shapes(text: str) -> dict[str, tuple[UrdfShape, ...]]:
    """The collision shapes of each link that has some, of a text that `parse_urdf` takes; kinds that a URDF does not
    know are left out. Raises `InputError` where a shape has no size."""
    shapes: dict[str, tuple[UrdfShape, ...]] = {}
    for link in _parsed(text)[0].children:
        for collision in link.children if link.name == "link" else ():
            geometry = collision.child("geometry")
            if collision.name == "collision" and geometry is not None and geometry.children:
                name, shape = link.text("name"), _shape(geometry.children[0], collision.origin())
                shapes[name] = (*shapes.get(name, ()), shape)
    return shapes


def _shape(element: Element, origin: Transform) -> UrdfShape:
    if element.name == "mesh":
        scale = _METRE * element.numbers("scale", (1.0, 1.0, 1.0))
        return UrdfShape("mesh", origin, tuple(scale.tolist()), element.text("filename"))
    names = _NAMES[element.name].attributes.split()
    missing = _ZERO if element.name == "box" else (0.0,)
    size = np.concatenate([_METRE * element.numbers(name, missing) for name in names])
    if not np.all(size > 0):
        raise InputError(f"{element.where} has no positive size; give its {' and '.join(names)}.")
    return UrdfShape(element.name, origin, tuple(size.tolist()), "")


def edited(text: str, origins: Mapping[str, Mapping[str, str]], robot: Robot, added: str = "") -> str:
    """The text with other origins, and with elements ``added`` at its end; everything else stays to the byte.

    ``origins`` has by joint the new xyz (m) and rpy (rad), those that change.
    """
    content = text.encode()
    changes: list[tuple[int, int, str]] = [(robot.end, robot.end, added)]
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
        for key, value in values.items():
            tag, count = re.subn(
                rf"""(\s{key}\s*=\s*)("[^"]*"|'[^']*')""",
                lambda match, value=value: f"{match[1]}{match[2][0]}{value}{match[2][0]}",
                tag,
                count=1,
            )
            if not count:
                tag = re.sub(r"\s*/?>$", lambda end, key=key, value=value: f' {key}="{value}"{end[0]}', tag)
        changes.append((start, end, tag))
    for start, end, tag in sorted(changes, reverse=True):
        content = content[:start] + tag.encode() + content[end:]
    return content.decode()


@lru_cache(maxsize=1)
def _parsed(text: str) -> tuple[Element, int]:
    """The root element, and where its end tag begins."""
    if len(text) > _MOST_CHARACTERS:
        raise InputError(f"the file has {len(text):,} characters, more than {_MOST_CHARACTERS:,}; give a URDF file.")
    content = text.encode()
    parser = expat.ParserCreate("utf-8")
    stack: list[Element | None] = []  # None: not read
    root: list[Element] = []
    ends = [0]

    def start(name: str, attributes: dict[str, str]) -> None:
        line, begin = parser.CurrentLineNumber, parser.CurrentByteIndex
        if name.startswith("xacro:"):
            raise InputError(f"line {line} has <{quoted(name)[1:-1]}>, {_EXPAND}")
        if len(stack) > _DEEPEST:
            raise InputError(f"line {line} nests elements too deeply; at most {_DEEPEST} levels are allowed.")
        parent = stack[-1] if stack else None
        if not stack and name != "robot":
            raise InputError(
                f"the root element is <{quoted(name)[1:-1]}>, but a URDF has the root element <robot>; give a URDF "
                "file."
            )
        if stack and (parent is None or not _is_read(name, parent, line)):
            stack.append(None)
            return
        if parent is None:
            words = "the robot"
        elif parent.name == "robot":
            words = f"{name} {quoted(attributes['name'])}" if attributes.get("name") else f"a {name}"
        else:
            words = f"<{name}> of {parent.words.partition(' of ')[2] if parent.words[0] == '<' else parent.words}"
        # A ``>`` in a value does not end a tag.
        tag = re.compile(rb"""<(?:[^"'>]++|"[^"]*+"|'[^']*+')*+>""").match(content, begin)
        place = (begin, len(content) if tag is None else tag.end())  # None of no XML, which the parser refuses
        element = Element(name, attributes, words, line, place, [])
        element.check_attributes()
        (root if parent is None else parent.children).append(element)
        stack.append(element)

    def end(_: str) -> None:
        stack.pop()
        ends.append(parser.CurrentByteIndex)

    def text_between(data: str) -> None:
        if data.strip() and stack[-1] is not None:
            raise InputError(
                f"line {parser.CurrentLineNumber}: {stack[-1].words} contains the text {quoted(data.strip())}, which "
                "is not allowed there; remove the text."
            )

    def refuse_entities(name: str, *_: object) -> None:
        raise InputError(
            f"the file declares a document type, {quoted(name)}, which aacmm does not accept; remove <!DOCTYPE ...>."
        )

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = text_between, refuse_entities
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise InputError(f"the file is not valid XML: {error}; correct the file at this point.") from error
    return root[0], ends[-1]


def _is_read(name: str, parent: Element, line: int) -> bool:
    """Whether an element is read; refuse one whose name is misspelt, repeated or at the wrong place."""
    parent = parent._replace(line=line)  # for messages
    once, often = _NAMES[parent.name].once.split(), _NAMES[parent.name].often.split()
    if name in (*once, *often):
        earlier = parent.child(name)
        if name in once and earlier is not None:
            raise InputError(
                f"{parent.where} has a second <{name}>, after the first in line {earlier.line}; remove one of the two."
            )
        if parent.name == "geometry" and parent.children:
            raise InputError(f"{parent.where} has two shapes; put each shape into its own <collision>.")
        return name in _NAMES
    if name in _NAMES:
        raise InputError(f"{parent.where} contains <{name}>, which is not allowed there; move it to the right element.")
    if ":" not in name:
        parent.check_name("element", name, [*once, *often])
    return False
