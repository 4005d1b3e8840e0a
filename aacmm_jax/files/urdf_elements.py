"""The elements of a URDF with their places in the text, and whether their names are those that the format knows.

A misspelt ``<origin>`` or ``xyz=`` would otherwise count as one that is not there, and the arm would be another one
without a word. So in what makes an arm (joints, masses, collision shapes) unknown and repeated names are refused.
Elements of other tools pass: those with a prefix (``drake:...``), and beside joints and links any but misspelt ones.
"""

import difflib
from collections.abc import Callable
from typing import Any, NamedTuple
from xml.parsers import expat

from ..core.errors import InputError, nearest
from ..core.text import quoted

_MOST_CHARACTERS = 20_000_000  # the largest robots of public collections have a twentieth of it
_DEEPEST = 64  # levels of elements; a URDF has six
_ALIKE = 0.7  # of difflib: one wrong, missing, exchanged or repeated letter in four


class Place(NamedTuple):
    """Where a start tag is in the text, as bytes of its UTF-8."""

    start: int
    end: int


class Element(NamedTuple):
    """An element with what is inside it."""

    name: str
    attributes: dict[str, str]
    line: int
    place: Place
    children: list["Element"]
    texts: list[tuple[int, str]]  # lines of text that are not blank, with their numbers

    def child(self, name: str) -> "Element | None":
        """The first child of a name."""
        return next((child for child in self.children if child.name == name), None)


class _Names(NamedTuple):
    """What an element may hold, names divided by blanks."""

    attributes: str | None  # None: any, as none of them but a name is read
    once: str = ""  # children, of each at most one
    often: str = ""
    others: bool = False  # whether children of other tools pass, whose names are not like any of these


# wiki.ros.org/urdf/XML and what urdfdom reads besides; after a "+" what other tools write into public files. Elements
# without an entry are not looked into, as nothing of them is read: visuals, materials, dynamics, ...
_KNOWN = {
    "robot": _Names(None, often="joint link material", others=True),
    "link": _Names(None, "inertial + origin", "visual collision", others=True),
    "joint": _Names(
        "name type + dont_collapse",
        "origin parent child axis limit mimic dynamics calibration safety_controller + joint_properties",
        "+ gazebo transmission ros2_control hardware hardwareInterface plugin sensor physics param provide_feedback",
    ),
    "origin": _Names("xyz rpy"),
    "parent": _Names("link"),
    "child": _Names("link"),
    "axis": _Names("xyz"),
    "limit": _Names(
        "lower upper effort velocity acceleration deceleration jerk + command_effort current gear_velocity damping "
        "friction"
    ),
    "mimic": _Names("joint multiplier offset"),
    "inertial": _Names("", "origin mass inertia"),
    "mass": _Names("value"),
    "inertia": _Names("ixx ixy ixz iyy iyz izz"),
    "collision": _Names(None, "origin geometry + material verbose", others=True),
    "geometry": _Names(None, "box cylinder sphere mesh", others=True),
    "box": _Names("size"),
    "cylinder": _Names("radius length"),
    "sphere": _Names("radius"),
    "mesh": _Names("filename scale"),
}


def elements(text: str) -> tuple[Element, int]:
    """The root element of a URDF, and where its end tag begins, as bytes of the text in UTF-8.

    Args:
        text: The whole file.

    Raises:
        InputError: It is no XML or no URDF, or a name in it is unknown or there twice.
    """
    root, end = _parsed(text)
    if root.name != "robot":
        raise InputError(f"its root element is {_tag(root.name)}, but that of a URDF is <robot>; name a URDF file.")
    _check(root, "the robot", "the robot")
    return root, end


def _check(element: Element, what: str, owner: str) -> None:
    """Refuse names that are unknown, repeated or at another place, in the element and in what it holds.

    ``what`` is the element and ``owner`` the joint or link that it is in, in words.
    """
    known = _KNOWN[element.name]
    where = f"line {element.line}: {what}"
    for line, text in element.texts:
        raise InputError(f"line {line}: {what} holds the text {quoted(text)}, which belongs to no element; correct it.")
    _check_attributes(element, known, where)
    once, often = _words(known.once), _words(known.often)
    found: dict[str, Element] = {}
    for child in element.children:
        name = child.name
        if ":" in name:
            continue
        if name not in (*once, *often):
            alike = difflib.get_close_matches(name.casefold(), (*once, *often), n=1, cutoff=_ALIKE)
            if known.others and not alike and name not in _KNOWN:
                continue
            raise InputError(f"line {child.line}: {what} has an unknown element {_tag(name)}{_meant(name, known)}")
        if name in once and name in found:
            raise InputError(
                f"line {child.line}: {what} has a second {_tag(name)}, after that of line {found[name].line}; take one "
                "of them out."
            )
        found.setdefault(name, child)
        if name in ("joint", "link"):
            called = child.attributes.get("name", "")
            words = f"{name} {quoted(called)}" if called else f"a {name}"
            _check(child, words, words)
        elif name in _KNOWN:
            _check(child, f"<{name}> of {owner}", owner)
    if element.name == "geometry" and len(element.children) > 1:
        raise InputError(f"{where} has {len(element.children)} shapes; give each a <collision> of its own.")


def _check_attributes(element: Element, known: _Names, where: str) -> None:
    names = None if known.attributes is None else _words(known.attributes)
    for name in element.attributes:
        if names is None or name in names or ":" in name or name == "xmlns":
            continue
        if name == "quat_xyzw":
            raise InputError(f"{where} has a quaternion, quat_xyzw, which is not read; write its angles as rpy.")
        meant = nearest(name.casefold(), [one for one in names if one != "+"])
        raise InputError(f"{where} has an unknown attribute {quoted(name)}{meant}")


def _words(names: str) -> list[str]:
    return [name for name in names.split() if name != "+"]


def _meant(name: str, known: _Names) -> str:
    """What an unknown element is probably meant to be; those of other tools are not proposed."""
    names = [*known.once.partition("+")[0].split(), *known.often.partition("+")[0].split()]
    return nearest(_tag(name.casefold()), [f"<{one}>" for one in names]) if names else ", but holds none; move it."


def _tag(name: str) -> str:
    return f"<{quoted(name)[1:-1]}>"


def _parsed(text: str) -> tuple[Element, int]:
    """The root element, and where its end tag begins."""
    if len(text) > _MOST_CHARACTERS:
        raise InputError(f"it has {len(text):,} characters, and {_MOST_CHARACTERS:,} are the most; name a URDF file.")
    content = text.encode()
    parser = expat.ParserCreate("utf-8")
    stack: list[Element] = []
    found: dict[str, Any] = {}

    def start(name: str, attributes: dict[str, str]) -> None:
        line = parser.CurrentLineNumber
        if name.startswith("xacro:"):
            raise InputError(
                f"line {line} has {_tag(name)}, so it is a xacro file; expand it with "
                "'xacro FILE.xacro > FILE.urdf' and name that."
            )
        if len(stack) > _DEEPEST:
            raise InputError(f"line {line} nests elements too deeply; no URDF has more than {_DEEPEST} levels.")
        begin = parser.CurrentByteIndex
        element = Element(name, attributes, line, Place(begin, _end_of_tag(content, begin)), [], [])
        if stack:
            stack[-1].children.append(element)
        else:
            found["root"] = element
        stack.append(element)

    def end(_: str) -> None:
        stack.pop()
        found["end"] = parser.CurrentByteIndex

    def between(data: str) -> None:
        if data.strip():
            stack[-1].texts.append((parser.CurrentLineNumber, data.strip()))

    def refuse(name: str, *_: object) -> None:
        raise InputError(f"it has a document type, {quoted(name)}, as no URDF needs; leave it out.")

    handlers: dict[str, Callable[..., None]] = {
        "StartElementHandler": start,
        "EndElementHandler": end,
        "CharacterDataHandler": between,
        "StartDoctypeDeclHandler": refuse,
    }
    for name, handler in handlers.items():
        setattr(parser, name, handler)
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise InputError(f"it is not valid XML: {error}; correct it there.") from error
    return found["root"], found["end"]


def _end_of_tag(content: bytes, start: int) -> int:
    """Where a start tag ends; a ``>`` in a value does not end it."""
    quote = 0
    for position in range(start, len(content)):
        character = content[position]
        if quote:
            quote = 0 if character == quote else quote
        elif character in b"\"'":
            quote = character
        elif character == ord(">"):
            return position + 1
    return len(content)  # of text that is no XML, which the parser refuses
