"""ROS: ``<calibration rising=... falling=.../>`` of a URDF's joint, the positions at which its reference switch changes
(wiki.ros.org/urdf/XML/joint). robot_calibration adds the offset of a joint to ``rising``, for drivers that read it."""

from ...core.errors import InputError
from ...kinematics.parameters import UrdfSource
from ..urdf import urdf_chain
from ..xml_text import replaced, with_values
from .offsets import ZeroOffsets, ZerosInFile


def ros_calibration(source: UrdfSource, zeros: ZeroOffsets) -> ZerosInFile:
    """A URDF whose joints have the zero offsets in ``<calibration>``; origins stay.

    Args:
        source: The URDF that the arm was read from.
        zeros: The offsets, from `zero_offsets`; rad, or mm of prismatic joints, which become m.

    Example:
        >>> robot = aj.files.load_specification("robot.urdf")
        >>> zeros = aj.files.ZeroOffsets(np.array([0.0, 0.01, 0.0]), ("rad",) * 3, np.zeros(3), 1.0, 0.1, 0.2)
        >>> text = aj.files.ros_calibration(robot.urdf, zeros).text
        >>> print([line.strip() for line in text.splitlines() if "calibration" in line])
        ['<calibration rising="0.01"/>']
    """
    if source.format != "URDF":
        raise InputError("the nominal arm was read from MJCF, which has no <calibration>; export mjcf.")
    content, changes = source.text.encode(), []
    for joint, offset, unit in zip(urdf_chain(source).joints, zeros.offsets, zeros.units, strict=True):
        amount = float(offset) * (1.0 if unit == "rad" else 1e-3)
        old = joint.element.child("calibration")
        edges = [] if old is None else [edge for edge in ("rising", "falling") if edge in old.attributes]
        values = {edge: repr(float(old.numbers(edge, (0.0,))[0]) + amount) for edge in edges if old is not None}
        values = values or {"rising": repr(amount)}
        if amount and old is not None:
            changes.append((*old.place, with_values(content[slice(*old.place)].decode(), values)))
        elif amount:  # after the joint's start tag, indented as what follows
            after = content[(end := joint.element.place[1]) :]
            tag = with_values("<calibration/>", values)
            changes.append((end, end, after[: len(after) - len(after.lstrip())].decode() + tag))
    return ZerosInFile(replaced(source.text, changes), (
        "<calibration> holds zero offsets only, and only drivers that read it apply them; do not use it together with "
        "origins of --format urdf, which contain the offsets.",
    ))  # fmt: skip
