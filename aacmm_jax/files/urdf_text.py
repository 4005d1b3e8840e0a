"""The text of a URDF: its joints and links with their places in it, and edits that leave everything else as it is.

The format's specification: wiki.ros.org/urdf/XML. Only direct children of ``<robot>`` count, since transmissions,
controllers and simulators have elements of the same names. A document type is refused: its entities could name other
files, or grow to any size.
"""

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.rotations import roll_pitch_yaw_matrix
from ..core.text import is_control, number, quoted
from ..kinematics.axes_to_dh import Transform
from .urdf_elements import Element, Place, elements

_LARGEST = 1e6  # m and rad, of positions, angles and directions
_LARGEST_ANGLE = 6.3  # rad, of roll, pitch and yaw: one revolution
_METRE = 1000.0  # mm


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
    place: Place
    origin_place: Place | None  # where there is an <origin>


class UrdfLink(NamedTuple):
    """A link: its mass in kg and its centre of mass in its frame in mm, or None where the file does not state them."""

    name: str
    mass: float | None
    centre: Float[np.ndarray, " 3"] | None


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
    end: int  # where </robot> begins, as bytes of the text in UTF-8


@lru_cache(maxsize=4)  # for the chain, the masses and the export, which each take the text
def parse_urdf(text: str) -> Robot:
    """The joints and links of a URDF.

    Args:
        text: The whole file.

    Raises:
        InputError: It is no XML or no URDF, a value is no number, or a name is unknown, missing or there twice.
    """
    root, end = elements(text)
    joints, links = {}, {}
    for element in root.children:
        if element.name in ("joint", "link"):
            name = _attribute(element, "name", f"a {element.name}")
            found = joints if element.name == "joint" else links
            if name in found:
                raise InputError(f"line {element.line}: {element.name} {quoted(name)} is there twice; rename one.")
            found[name] = (_joint if element.name == "joint" else _link)(element, name)
    for joint in joints.values():
        for link in (joint.parent, joint.child):
            if link not in links:
                raise InputError(
                    f"joint {quoted(joint.name)} names the link {quoted(link)}, which is not there; add it."
                )
    return Robot(joints, links, end)


def collision_shapes(text: str) -> dict[str, tuple[UrdfShape, ...]]:
    """The collision shapes of each link that has some; kinds that a URDF does not know are left out.

    Args:
        text: The whole file, which `parse_urdf` takes.

    Raises:
        InputError: A shape has no size, or a number is none.
    """
    root, _ = elements(text)
    found: dict[str, tuple[UrdfShape, ...]] = {}
    for link in root.children:
        if link.name == "link":
            name = _attribute(link, "name", "a link")
            shapes = (_shape(child, f"link {quoted(name)}") for child in link.children if child.name == "collision")
            known = tuple(shape for shape in shapes if shape is not None)
            if known:
                found[name] = known
    return found


def _shape(collision: Element, what: str) -> UrdfShape | None:
    geometry = collision.child("geometry")
    if geometry is None or not geometry.children:
        return None
    element, origin = geometry.children[0], _origin(collision.child("origin"), what)
    if element.name == "mesh":
        scale = _numbers(element, "scale", what, (1.0, 1.0, 1.0))
        return UrdfShape(
            "mesh", origin, tuple((_METRE * scale).tolist()), _attribute(element, "filename", f"a mesh of {what}")
        )
    sizes = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}.get(element.name)
    if sizes is None:
        return None
    missing = (0.0,) * 3 if element.name == "box" else (0.0,)
    size = np.concatenate([_METRE * _numbers(element, name, what, missing) for name in sizes])
    if not np.all(size > 0):
        raise InputError(
            f"line {element.line}: a collision {element.name} of {what} has no size above 0; give its "
            f"{' and '.join(sizes)}."
        )
    return UrdfShape(element.name, origin, tuple(size.tolist()), "")


def edited(text: str, origins: Mapping[str, tuple[str | None, str | None]], robot: Robot, added: str = "") -> str:
    """The text with other origins, and with elements added at its end; everything else stays to the byte.

    Args:
        text: The whole file.
        origins: By joint the new xyz (m) and rpy (rad), each None where it stays.
        robot: What `parse_urdf` found in the text.
        added: Elements to add before ``</robot>``.
    """
    content = text.encode()
    changes: list[tuple[int, int, bytes]] = []
    for name, values in origins.items():
        joint = robot.joints[name]
        new = {key: value for key, value in zip(("xyz", "rpy"), values, strict=True) if value is not None}
        if joint.origin_place is None:
            written = "".join(f' {key}="{value}"' for key, value in new.items())
            at = joint.place.end
            blank = re.match(rb"\s*", content[at:])
            indent = blank.group().decode() if blank else ""
            changes.append((at, at, f"{indent}<origin{written}/>".encode()))
        else:
            start, end = joint.origin_place
            changes.append((start, end, _with_attributes(content[start:end].decode(), new).encode()))
    changes.append((robot.end, robot.end, added.encode()))
    for start, end, new_content in sorted(changes, reverse=True):
        content = content[:start] + new_content + content[end:]
    return content.decode()


def _with_attributes(tag: str, values: Mapping[str, str]) -> str:
    """A start tag with other values of some attributes; those it lacks are added at its end."""
    for name, value in values.items():
        pattern = re.compile(rf"""(\s{name}\s*=\s*)("[^"]*"|'[^']*')""")
        if pattern.search(tag):
            tag = pattern.sub(lambda found, value=value: f"{found[1]}{found[2][0]}{value}{found[2][0]}", tag, count=1)
        else:
            head = re.fullmatch(r"(.*?)(\s*/?>)", tag, re.DOTALL)
            assert head is not None
            tag = f'{head[1]} {name}="{value}"{head[2]}'
    return tag


def _joint(element: Element, name: str) -> UrdfJoint:
    what = f"joint {quoted(name)}"
    ends = []
    for end in ("parent", "child"):
        child = element.child(end)
        if child is None:
            raise InputError(f"line {element.line}: {what} has no <{end} link=...>; add it.")
        ends.append(_attribute(child, "link", f"the <{end}> of {what}"))
    kind = _attribute(element, "type", what)
    origin, axis, limit, mimic = (element.child(part) for part in ("origin", "axis", "limit", "mimic"))
    direction = np.array([1.0, 0.0, 0.0])  # which the format's specification says
    if axis is not None:
        _attribute(axis, "xyz", f"<axis> of {what}")
        direction = _numbers(axis, "xyz", what, (0.0, 0.0, 0.0))
    size = float(np.linalg.norm(direction))
    unit = _METRE if kind == "prismatic" else 1.0
    limits = None
    if limit is not None and ("lower" in limit.attributes or "upper" in limit.attributes):
        low, high = (_numbers(limit, side, what, (0.0,))[0] for side in ("lower", "upper"))
        limits = (unit * low, unit * high)
    return UrdfJoint(
        name=name,
        kind=kind,
        parent=ends[0],
        child=ends[1],
        origin=_origin(origin, what),
        axis=direction / size if size > 0 else None,
        limits=limits,
        mimics=None if mimic is None else mimic.attributes.get("joint", ""),
        place=element.place,
        origin_place=None if origin is None else origin.place,
    )


def _link(element: Element, name: str) -> UrdfLink:
    inertial = element.child("inertial")
    mass = None if inertial is None else inertial.child("mass")
    if inertial is None or mass is None:
        return UrdfLink(name, None, None)
    what = f"link {quoted(name)}"
    _attribute(mass, "value", f"<mass> of {what}")
    value = _numbers(mass, "value", what, (0.0,))[0]
    if value < 0:
        raise InputError(f"line {mass.line}: the mass of {what} is {value:g} kg; it cannot be negative.")
    return UrdfLink(name, float(value), _origin(inertial.child("origin"), what)[:3, 3])


def _origin(element: Element | None, what: str) -> Transform:
    transform = np.eye(4)
    if element is not None:
        angles = _numbers(element, "rpy", what, (0.0, 0.0, 0.0))
        if np.any(np.abs(angles) > _LARGEST_ANGLE):
            raise InputError(
                f"line {element.line}: rpy of {what} is {quoted(element.attributes['rpy'])}, more than a "
                "revolution, as if in degrees; a URDF is in rad, so convert it."
            )
        transform[:3, :3] = roll_pitch_yaw_matrix(angles)
        transform[:3, 3] = _METRE * _numbers(element, "xyz", what, (0.0, 0.0, 0.0))
    return transform


def _numbers(element: Element, name: str, what: str, default: tuple[float, ...]) -> Float[np.ndarray, " k"]:
    text = element.attributes.get(name)
    if text is None:
        return np.array(default)
    if "${" in text or "$(" in text:
        raise InputError(
            f"line {element.line}: {name} of {what} is {quoted(text)}, so it is a xacro file; expand it with "
            "'xacro FILE.xacro > FILE.urdf' and name that."
        )
    try:
        values = np.array([number(part) for part in text.split()])
    except ValueError:
        values = np.array([])
    if len(default) == 3 and np.any(np.abs(values) >= _LARGEST):  # limits may be as large as one likes
        raise InputError(f"line {element.line}: {name} of {what} is {quoted(text)}; it must be below {_LARGEST:g}.")
    if len(values) != len(default) or not np.all(np.isfinite(values)):
        wanted = "a number" if len(default) == 1 else f"{len(default)} numbers"
        raise InputError(f"line {element.line}: {name} of {what} is {quoted(text)}; it must be {wanted}.")
    return values


def _attribute(element: Element, name: str, what: str) -> str:
    value = element.attributes.get(name, "")
    if not value:
        raise InputError(f"line {element.line}: {what} has no {name}; add it.")
    if any(is_control(character) for character in value):
        raise InputError(f"line {element.line}: the {name} of {what} holds a control character; take it out.")
    return value
