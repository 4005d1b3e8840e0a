"""Robots in MJCF: the text with what it includes, and with the places of bodies of a calibrated arm."""

from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.text import quoted
from ..kinematics.axes_to_dh import UNCHANGED, Transform, inverse, same_transform
from .inputs import InputFile
from .mjcf_text import ORIENTATIONS, shift
from .urdf_text import ExportedUrdf, Placement, Robot, UrdfJoint, unused_name
from .xml_text import MOST_CHARACTERS, Element, replaced, scan, with_values

_SAME = {"quat": "|".join(ORIENTATIONS)}


def with_includes(text: str, file: Path) -> str:
    """The text of MJCF with each ``<include file=.../>`` replaced by the elements of that file, as MuJoCo reads it.

    Files are looked for in the folder of ``file`` and below it, and each is included once at most. Raises `InputError`.
    """
    folder = file.resolve().parent
    seen, size = {file.resolve()}, [len(text)]

    def expanded(text: str, where: str) -> tuple[str, tuple[int, int]]:
        """The text with what it includes, and where the elements in its root begin and end, in bytes of the text."""
        changes: list[tuple[int, int, str]] = []
        opened: list[tuple[str, dict[str, str], int, tuple[int, int]]] = []
        inner = [0, 0]

        def start(name: str, attributes: dict[str, str], line: int, place: tuple[int, int]) -> None:
            if not opened:
                inner[0] = place[1]
            opened.append((name, attributes, line, place))

        def end(name: str, place: tuple[int, int]) -> None:
            _, attributes, line, (begin, _) = opened.pop()
            inner[1] = place[0]
            if name == "include" and opened and not any(tag[0] == "include" for tag in opened):
                changes.append((begin, place[1], included(attributes.get("file", ""), f"{where}line {line}")))

        scan(text, start, end)
        grown = sum(len(part.encode()) - (end - begin) for begin, end, part in changes)
        return replaced(text, changes), (inner[0], inner[1] + grown)

    def included(name: str, where: str) -> str:
        path = (folder / name).resolve() if "\0" not in name else folder
        if not name or not path.is_relative_to(folder):
            raise InputError(
                f"{where} includes {quoted(name)}, which is not in the folder of the file; put it there, or save the "
                "whole model by MuJoCo (mj_saveLastXML) and give that file."
            )
        if path in seen:
            raise InputError(f"{where} includes {quoted(name)} a second time; remove one of the two.")
        seen.add(path)
        text = InputFile(path).text
        size[0] += len(text)
        if size[0] > MOST_CHARACTERS:
            raise InputError(
                f"{where} includes {quoted(name)}; together these files have more than {MOST_CHARACTERS:,} "
                "characters, so give a smaller model."
            )
        whole, (begin, after) = expanded(text, f"{quoted(name)} ")
        return whole.encode()[begin:after].decode().strip()

    return expanded(text, "")[0] if "<include" in text else text


def edited_mjcf(
    text: str,
    robot: Robot,
    path: list[UrdfJoint],
    read: Mapping[str, UrdfJoint],
    frames: list[Transform],
    link: Transform,
    tip: Transform,
) -> ExportedUrdf:
    """The text with the places of a calibrated chain; all else stays to the byte.

    A body moves as a joint of a URDF does; where it has several joints, those after the first get another axis and
    position in it. Orientations are written as quaternions, whatever they were. Where no body or site without joints
    ends at the tip link, or the tip is beyond it, the calibrated tip is a site that is added.

    Args:
        text: The file.
        robot: The robot that it is.
        path: The joints from base to tip, fixed ones included.
        read: Joints by name as the user's file has them, where ``text`` has another chain of the robot already.
        frames: Of each moving joint its frame in that of the joint before it, at reading 0, mm.
        link: The tip link in the frame of the last moving joint, mm.
        tip: The calibrated tip in this frame, mm.
    """
    content, remaining = text.encode(), iter(frames)
    tags: dict[tuple[int, int], str] = {}
    changed: list[str] = []
    # The frame of a moving joint in the file is parallel to its body. From there, ``turned`` leads to the frame of this
    # joint in the calibrated chain, ``since`` to the body or site that was last on the path, ``inside`` to ``body``.
    since, turned, inside, anchor, body = np.eye(4), np.eye(4), np.eye(4), np.eye(4), path[0].element

    def state(element: Element, name: str, values: dict[str, str]) -> None:
        if values:
            tags[element.place] = with_values(content[slice(*element.place)].decode(), values, _SAME)
            changed.append(name)

    for joint in path:
        place, old = joint.place or Placement(), read.get(joint.name, joint)
        if joint.kind == "fixed":
            if place.body is None and joint.element.name == "body":  # from the last joint of a body to the body
                continue
            origin = inverse(place.outer) @ joint.origin
            if joint is path[-1]:
                moved = inverse(since @ place.outer) @ turned @ link
                state(joint.element, joint.child, _changed(moved, origin))
                origin = moved
            since = since @ place.outer @ origin
            if place.body is not None:
                body, inside = place.body, since
            continue
        new = turned @ next(remaining) @ (old.place or place).reference
        if place.body is not None:  # the first joint of a body stays where it is in it
            body, anchor = place.body, place.anchor
            moved = inverse(since @ place.outer) @ new @ inverse(anchor)
            stated = inverse(place.outer) @ joint.origin @ place.reference @ inverse(anchor)
            state(body, body.attributes.get("name", joint.name), _changed(moved, stated))
            turned = np.eye(4)
        elif joint.axis is not None and old.axis is not None:
            anchor, turned = shift(anchor[:3, 3] + new[:3, 3]), new - shift(new[:3, 3]) + np.eye(4)
            values, within = {}, inverse(place.around)
            point, axis = within @ anchor, within[:3, :3] @ turned[:3, :3] @ old.axis
            if np.abs(anchor - place.anchor).max() > UNCHANGED[0]:
                values["pos"] = _row(point[:3, 3] / 1000)
            if np.abs(turned[:3, :3] @ old.axis - joint.axis).max() > UNCHANGED[1]:
                values["axis"] = _row(axis)
            state(joint.element, joint.name, values)
        since = inside = inverse(anchor)
    name, notes, added = path[-1].child, (), []
    if not same_transform(since, turned @ tip):
        name = unused_name(f"{name}_probe", robot.links)
        values = " ".join(f'{key}="{value}"' for key, value in _values(inverse(inside) @ turned @ tip).items())
        begin, end = body.place
        tag = tags.get(body.place, content[begin:end].decode())
        site = f"<site name={quoteattr(name)} {values}/>"
        if tag.endswith("/>"):  # a body without elements
            tags[body.place] = f"{tag[:-2].rstrip()}>{site}</body>"
        else:
            added.append((end, end, site))  # in the same line, as elements without a name are called by theirs
        notes = (f"the calibrated tip is the site {quoted(name)}, which was added to the MJCF.",)
    changes = [(begin, end, tag) for (begin, end), tag in tags.items()]
    return ExportedUrdf(replaced(text, [*changes, *added]), name, tuple(changed), notes)


def _changed(new: Transform, old: Transform) -> dict[str, str]:
    """pos in m and quat with all digits, those of which the file's own text does not say the same."""
    (length, angle), difference = UNCHANGED, np.abs(new - old)
    same = {"pos": difference[:3, 3].max() <= length, "quat": difference[:3, :3].max() <= angle}
    return {key: value for key, value in _values(new).items() if not same[key]}


def _values(transform: Transform) -> dict[str, str]:
    from scipy.spatial.transform import Rotation  # takes long to import

    quaternion = Rotation.from_matrix(transform[:3, :3]).as_quat(scalar_first=True, canonical=True)
    return {"pos": _row(transform[:3, 3] / 1000), "quat": _row(quaternion)}


def _row(values: Float[np.ndarray, " k"]) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)  # 0.0 is added, as -0.0 becomes 0.0
