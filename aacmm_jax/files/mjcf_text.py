"""The text of MJCF, MuJoCo's format: bodies, joints and sites as the joints and links of a URDF, which have the same
chains.

The format's specification: mujoco.readthedocs.io/en/stable/XMLreference.html. A body moves by its joints, one after the
other, each about an axis through a point of the body, away from where the file draws it, at the readings ``ref``. So a
body becomes a chain of links, one a joint; without joints, it is fixed to its parent, and so is a site to its body.
Degrees, unless the compiler says otherwise; m, as in a URDF.
"""

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.rotations import rotation_matrix
from ..core.text import quoted
from ..core.units import DEG
from ..kinematics.axes_to_dh import Transform, inverse
from .urdf_text import URDF, Placement, Robot, UrdfJoint, UrdfLink, tree_of, unused_name, urdf_robot
from .xml_text import Document, Element, Format, Names, parse_xml

_METRE = 1000.0  # mm
_PLACE = "pos quat axisangle xyaxes zaxis euler"
ORIENTATIONS = tuple(_PLACE.split()[1:])
_KINDS = {"hinge": "revolute", "slide": "prismatic", "ball": "spherical", "free": "floating"}
_IN_BODY = "joint freejoint site body frame"
MJCF = Format("MJCF", "mujoco", {
    "mujoco": Names("model", "", "compiler default worldbody equality", others=True),
    "compiler": Names("angle eulerseq coordinate autolimits", others=True),
    "default": Names("class", "", "default joint site equality", others=True),
    "worldbody": Names("", "", "body site frame", others=True),
    "body": Names(f"name childclass {_PLACE}", "inertial", _IN_BODY, others=True),
    "frame": Names(f"name childclass {_PLACE}", "", _IN_BODY, others=True),
    "joint": Names("name class type pos axis range limited ref joint1 joint2 active polycoef", others=True),
    "freejoint": Names("name", others=True),
    "site": Names(f"name class {_PLACE}", others=True),
    "inertial": Names(f"mass {_PLACE} diaginertia fullinertia", others=True),
    "equality": Names("active", "", "joint", others=True),
}, ("body", "joint", "freejoint", "site", "frame"))  # fmt: skip


@lru_cache(maxsize=4)  # for the chain, the masses and the export, which each take the text
def parse_robot(text: str) -> Robot:
    """The joints and links of a URDF or of MJCF.

    Raises `InputError` where it is not XML or neither of them, a value is not a number, or a name is unknown, missing
    or there twice.
    """
    document = parse_xml(text, (URDF, MJCF))
    return (urdf_robot if document.format is URDF else mjcf_robot)(document)


def mjcf_robot(document: Document) -> Robot:
    """The bodies and sites of MJCF as links; `InputError` as of `parse_robot`."""
    return _Reader(document).robot


class _Reader:
    """The links and joints of bodies, with the settings of the compiler and the defaults."""

    def __init__(self, document: Document):
        settings: dict[str, Element] = {}  # the last compiler that states it
        for element in document.root.children:
            if element.name == "compiler":
                settings |= dict.fromkeys(element.attributes, element)

        def setting(name: str, usual: str, allowed: tuple[str, ...]) -> str:
            value = settings[name].attributes[name] if name in settings else usual
            if value not in allowed:
                raise InputError(f"{settings[name].where} has {name} = {quoted(value)}; give {' or '.join(allowed)}.")
            return value

        if settings and setting("coordinate", "local", ("local", "global")) == "global":
            raise InputError(
                f"{settings['coordinate'].where} has global coordinates; load and save the model with MuJoCo 2.3.3, "
                "which writes local ones."
            )
        self._angle = DEG if setting("angle", "degree", ("degree", "radian")) == "degree" else 1.0
        self._autolimits = setting("autolimits", "true", ("true", "false")) == "true"
        self._sequence = settings["eulerseq"].attributes["eulerseq"] if "eulerseq" in settings else "xyz"
        if len(self._sequence) != 3 or not set(self._sequence.lower()) <= set("xyz"):
            raise InputError(
                f"{settings['eulerseq'].where} has eulerseq = {quoted(self._sequence)}; give three of x, y, z, X, Y, Z."
            )
        self._defaults: dict[str, dict[str, dict[str, str]]] = {"main": {"joint": {}, "site": {}, "equality": {}}}
        self._bodies = {"world", *_body_names(document.root)}
        self._joints: dict[str, UrdfJoint] = {}
        self._links: dict[str, UrdfLink] = {"world": UrdfLink()}
        of_root = document.root.children
        for element in of_root:
            if element.name == "default":
                self._read_defaults(element, "main")
        for element in of_root:
            if element.name == "worldbody":
                self._read_children(element, "world", np.eye(4), "main")
        for element in of_root:
            for equality in element.children if element.name == "equality" else ():
                self._couple(self._with_defaults(equality, "main", "equality"))
        self.robot = tree_of(self._joints, self._links, document)

    def _couple(self, equality: Element) -> None:
        """A joint that follows another one by an equality."""
        joint, other = self._joints.get(equality.text("joint1")), equality.attributes.get("joint2")
        if joint is not None and other and equality.attributes.get("active") != "false":
            place = (joint.place or Placement())._replace(equality=equality)
            self._joints[joint.name] = joint._replace(mimics=other, place=place)

    def _read_defaults(self, element: Element, name: str) -> None:
        """The values of a class, and of those within it, which begin with its values."""
        for child in element.children:
            if child.name != "default":
                self._defaults[name][child.name] |= child.attributes
        for child in (child for child in element.children if child.name == "default"):
            inner = child.text("class")
            self._defaults.setdefault(inner, {kind: dict(values) for kind, values in self._defaults[name].items()})
            self._read_defaults(child, inner)

    def _with_defaults(self, element: Element, childclass: str, kind: str = "") -> Element:
        name = element.attributes.get("class", childclass)
        if name not in self._defaults:
            raise InputError(f"{element.where} has the class {quoted(name)}, which no <default> defines; add it.")
        values = self._defaults[name][kind or element.name]
        if element.attributes.keys() & set(ORIENTATIONS):  # in place of another way to state it
            values = {key: value for key, value in values.items() if key not in ORIENTATIONS}
        return element._replace(attributes=values | element.attributes)

    def _read_children(self, element: Element, link: str, outer: Transform, childclass: str) -> None:
        """Bodies and sites of a body, and of the frames in it."""
        childclass = element.attributes.get("childclass", childclass)
        for child in element.children:
            if child.name == "frame":
                self._read_children(child, link, outer @ self._transform(child), childclass)
            elif child.name == "body":
                self._read_body(child, link, outer, childclass)
            elif child.name == "site" and "fromto" not in (site := self._with_defaults(child, childclass)).attributes:
                place = outer @ self._transform(site)
                self._add(child, "fixed", link, self._new_link(child), place, Placement(outer=outer))

    def _read_body(self, element: Element, parent: str, outer: Transform, childclass: str) -> None:
        childclass = element.attributes.get("childclass", childclass)
        name, origin = self._new_link(element), outer @ self._transform(element)
        inertial = element.child("inertial")
        if inertial is not None:
            inertial.text("mass")
            mass = float(inertial.numbers("mass", (0.0,))[0])
            if mass < 0:
                raise InputError(f"{inertial.where} has a mass of {mass:g} kg; a mass cannot be negative.")
            self._links[name] = UrdfLink(mass, _METRE * inertial.numbers("pos", (0.0, 0.0, 0.0)))
        joints = list(self._joints_in(element, np.eye(4), childclass))
        if not joints:
            self._add(element, "fixed", parent, name, origin, Placement(element, outer))
        before = np.eye(4)
        for i, (joint, around) in enumerate(joints):
            kind = _KINDS["free" if joint.name == "freejoint" else joint.attributes.get("type", "hinge")]
            axis = joint.numbers("axis", (0.0, 0.0, 1.0))
            size = float(np.linalg.norm(axis))
            axis = axis / size if size > 0 else None
            unit = _METRE if kind == "prismatic" else self._angle
            reference = unit * float(joint.numbers("ref", (0.0,))[0])
            anchor, moved = np.eye(4), np.eye(4)
            anchor[:3, 3] = around[:3, :3] @ (_METRE * joint.numbers("pos", (0.0, 0.0, 0.0))) + around[:3, 3]
            if axis is not None:
                axis = around[:3, :3] @ axis
                if kind == "prismatic":
                    moved[:3, 3] = reference * axis
                else:
                    moved[:3, :3] = np.asarray(rotation_matrix(reference * axis))
            limits = self._limits(joint, unit)
            last = i == len(joints) - 1 and not anchor[:3, 3].any()
            child = name if last else unused_name(f"{name}, joint {i + 1}", self._links)
            self._links.setdefault(child, UrdfLink())
            place = Placement(element if i == 0 else None, outer, around, anchor, moved, reference)
            kind = "continuous" if kind == "revolute" and limits is None else kind
            origin = origin @ shift(anchor[:3, 3] - before[:3, 3]) @ inverse(moved)
            self._add(joint, kind, parent, child, origin, place, axis, limits)
            parent, before, origin = child, anchor, np.eye(4)
        if joints and parent != name:
            self._add(element, "fixed", parent, name, shift(-before[:3, 3]), Placement(anchor=before))
        self._read_children(element, name, np.eye(4), childclass)

    def _joints_in(self, element: Element, around: Transform, childclass: str) -> Iterator[tuple[Element, Transform]]:
        """The joints of a body with their defaults, and the frames about each."""
        for child in element.children:
            if child.name == "frame":
                inner = child.attributes.get("childclass", childclass)
                yield from self._joints_in(child, around @ self._transform(child), inner)
            elif child.name == "freejoint":
                yield child, around
            elif child.name == "joint":
                joint = self._with_defaults(child, childclass)
                if joint.attributes.get("type", "hinge") not in _KINDS:
                    raise InputError(
                        f"{joint.where} has type = {quoted(joint.attributes['type'])}; give {', '.join(_KINDS)}."
                    )
                yield joint, around

    def _limits(self, joint: Element, unit: float) -> tuple[float, float] | None:
        limited = joint.attributes.get("limited", "auto")
        if "range" not in joint.attributes or limited == "false" or (limited == "auto" and not self._autolimits):
            return None
        lower, upper = unit * joint.numbers("range", (0.0, 0.0))
        return None if limited == "auto" and lower == upper == 0 else (float(lower), float(upper))

    def _transform(self, element: Element) -> Transform:
        """pos and the orientation of an element in its parent, mm."""
        transform = np.eye(4)
        transform[:3, 3] = _METRE * element.numbers("pos", (0.0, 0.0, 0.0))
        stated = [name for name in ORIENTATIONS if name in element.attributes]
        if len(stated) > 1:
            raise InputError(f"{element.where} states its orientation by {' and '.join(stated)}; remove one of them.")
        if stated:
            transform[:3, :3] = self._rotation(element, stated[0])
        return transform

    def _rotation(self, element: Element, kind: str) -> Float[np.ndarray, "3 3"]:
        counts = {"quat": 4, "axisangle": 4, "xyaxes": 6, "zaxis": 3, "euler": 3}
        values = element.numbers(kind, (0.0,) * counts[kind])
        if kind == "euler":
            matrix = np.eye(3)
            for axis, x in zip(self._sequence, values, strict=True):  # capital letters: about axes that stand still
                turn = np.asarray(rotation_matrix(self._angle * x * np.eye(3)["xyz".index(axis.lower())]))
                matrix = matrix @ turn if axis.islower() else turn @ matrix
            return matrix
        directions = {"axisangle": values[:3], "xyaxes": values[:3], "zaxis": values, "quat": values}[kind]
        size = float(np.linalg.norm(directions))
        x = directions / size if size > 0 else directions
        y = values[3:] - (values[3:] @ x) * x if kind == "xyaxes" else x
        if size == 0 or not np.linalg.norm(y) > 1e-9:
            raise InputError(
                f"{element.where} has {kind} = {quoted(element.attributes[kind])}, which is no direction; correct it."
            )
        if kind == "quat":
            sine = float(np.linalg.norm(values[1:]))
            return np.asarray(rotation_matrix(2 * math.atan2(sine, values[0]) * values[1:] / max(sine, 1e-300)))
        if kind == "axisangle":
            return np.asarray(rotation_matrix(self._angle * values[3] * x))
        if kind == "xyaxes":
            y = y / np.linalg.norm(y)
            return np.stack([x, y, np.cross(x, y)], axis=1)
        normal = np.array([-x[1], x[0], 0.0])  # the least rotation from z; about x where it points down
        sine = float(np.linalg.norm(normal))
        normal = normal / sine if sine > 1e-10 else np.array([1.0, 0.0, 0.0])
        return np.asarray(rotation_matrix(math.atan2(sine, x[2]) * normal))

    def _new_link(self, element: Element) -> str:
        """The name of the link of a body or site."""
        name = element.text("name") if "name" in element.attributes else ""
        if element.name == "site" and (not name or name in self._bodies):  # sites have names of their own
            name = unused_name(f"{name} (site)" if name else f"site in line {element.line}", self._links)
        elif not name:
            name = unused_name(f"body in line {element.line}", self._links)
        elif name in self._links:
            raise InputError(f"{element.where} has the name of another body; rename one of the two.")
        self._links[name] = UrdfLink()
        return name

    def _add(
        self,
        element: Element,
        kind: str,
        parent: str,
        child: str,
        origin: Transform,
        place: Placement,
        axis: Float[np.ndarray, " 3"] | None = None,
        limits: tuple[float, float] | None = None,
    ) -> None:
        stated = element.attributes.get("name", "") and element.text("name")
        name = f"{child} (fixed)" if kind == "fixed" else stated or f"joint in line {element.line}"
        if stated == name and name in self._joints:
            raise InputError(f"{element.where} occurs twice; rename one of the two.")
        name = unused_name(name, self._joints)
        self._joints[name] = UrdfJoint(name, kind, parent, child, origin, axis, limits, None, element, place)


def _body_names(element: Element) -> Iterator[str]:
    for child in element.children:
        yield from [child.attributes.get("name", "")] if child.name == "body" else []
        yield from _body_names(child)


def shift(vector: Float[np.ndarray, " 3"]) -> Transform:
    """The transform without a rotation."""
    transform = np.eye(4)
    transform[:3, 3] = vector
    return transform
