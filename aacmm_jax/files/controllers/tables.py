"""The Denavit-Hartenberg parameters of an arm for other programs: a table as CSV, and a Python program."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from ...core.arguments import checked_arguments
from ...core.rotations import roll_pitch_yaw
from ...core.units import DEG
from ...data.recording import RecordedAs
from ...kinematics.arm import Arm, by_joint, correction_names, parameter_unit, value_of, without_corrections
from ...kinematics.axes_to_dh import Transform, canonical_origins, geometry_of
from ...kinematics.chain import Geometry
from ...kinematics.parameters import single

_UNITS = {"mm-deg": ("mm", "deg", 1.0, 1 / DEG), "m-rad": ("m", "rad", 1e-3, 1.0)}
_STANDARD = "T_i = Rz(q_i + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)"
_CRAIG = "T_i = Tx(a) Rx(alpha) Ry(beta) Rz(q_i + theta) Tz(d), with a, alpha and beta of the link before joint i"
_SLIDES = "readings of the prismatic joints ({}) are added to d: Rz(theta) Tz(q_i + d)"


@checked_arguments
def dh_table(
    arm: Arm,
    *,
    convention: Literal["standard", "craig"] = "standard",
    units: Literal["mm-deg", "m-rad"] = "mm-deg",
    base: Transform | None = None,
) -> str:
    """A Denavit-Hartenberg table as CSV, with comments that say what each column is and where base and tip are.

    Args:
        arm: One arm.
        convention: ``"standard"``, or ``"craig"`` (modified): the link before each joint instead of that after it.
        units: ``"mm-deg"`` or ``"m-rad"``.
        base: The first frame in a robot's base link, mm, where it is another one.

    Example:
        >>> for line in aj.files.dh_table(arm).splitlines()[-3:]:
        ...     print(line)
        4,0.0,0.0,62.0,-90.00021045914971,0.0
        5,0.0,500.0,0.0,-90.00021045914971,0.0
        6,0.0,11.5,0.0,-90.0,0.0
    """
    length_unit, angle_unit, length, angle = _UNITS[units]

    def placed(transform: Transform) -> str:
        xyz, rpy = length * transform[:3, 3], angle * roll_pitch_yaw(transform[:3, :3])
        return f"x y z = {row_of(xyz, ' ')} {length_unit}, roll pitch yaw = {row_of(rpy, ' ')} {angle_unit}"

    geometry = geometry_of(without_corrections(single(arm)))
    links = np.stack([length * geometry.a, angle * geometry.alpha, angle * _beta(geometry)], axis=1)
    lines = [f"# {_CRAIG if convention == 'craig' else _STANDARD}"]
    if arm.prismatic:
        lines.append(f"# {_SLIDES.format(', '.join(map(str, arm.prismatic)))}")
    if base is not None and not np.array_equal(base, np.eye(4)):
        lines.append(f"# first frame in the base link: {placed(base)}")
    if convention == "craig":
        links = np.concatenate([np.zeros((1, 3)), links[:-1]])
        lines.append(f"# tip in the last frame: {placed(canonical_origins(geometry)[-1])}")
    else:
        lines.append(f"# tip in the last frame: x y z = {row_of(length * geometry.probe, ' ')} {length_unit}")
    heads = [f"theta_{angle_unit}", f"d_{length_unit}", f"a_{length_unit}", f"alpha_{angle_unit}", f"beta_{angle_unit}"]
    lines.append(",".join(["joint", *heads]))
    joints = np.stack([angle * geometry.theta, length * geometry.d], axis=1)
    lines += [f"{i},{row_of(row)}" for i, row in enumerate(np.concatenate([joints, links], axis=1), start=1)]
    if arm.corrections is not None:
        lines.append("# coefficients of joint corrections, which are not Denavit-Hartenberg parameters:")
        coefficients = ((name, float(value_of(arm, name))) for name in correction_names(arm))
        lines += [f"# {name} = {value!r} {parameter_unit(arm, name)}" for name, value in coefficients if value != 0]
    return "\n".join(lines) + "\n"


def python_program(
    arm: Arm, *, title: str, base: Transform | None = None, recorded_as: RecordedAs | None = None
) -> str:
    """A Python program of the arm that needs NumPy only: ``position(q)`` and ``pose(q)``, mm and rad.

    Args:
        arm: One arm.
        title: The first line of its documentation.
        base: The first frame in a robot's base link, mm; poses are in the base link then.
        recorded_as: How readings are written; the program has ``position_of_readings(readings)`` then.

    Example:
        >>> program = aj.files.python_program(result.arm, title="Calibrated arm")
        >>> namespace = {}
        >>> exec(program, namespace)
        >>> print(np.abs(namespace["position"](q) - result.arm.position(q)).max() < 1e-9)
        True
    """
    geometry = geometry_of(single(arm))
    values = {"THETA": geometry.theta, "D": geometry.d, "A": geometry.a, "ALPHA": geometry.alpha}
    values |= {"BETA": _beta(geometry), "PROBE": geometry.probe}
    constants = [f"{name} = [{row_of(row, ', ')}]" for name, row in values.items()]
    constants.append(f"PRISMATIC = {by_joint(arm, False, True)}")
    rows = ",\n".join(f"    [{row_of(row, ', ')}]" for row in (np.eye(4) if base is None else base))
    templates = Path(__file__).parents[1] / "templates"
    program = (templates / "program.txt").read_text("utf-8")
    program = program.format(title=repr(title), base=rows, constants="\n".join(constants))
    if recorded_as is None:
        return program
    names, unit, factors, offsets = recorded_as
    rows = ",\n".join(f"    [{row_of(row, ', ')}]" for row in factors)
    columns = ",\n".join(f"    {name!r}" for name in names)
    of_readings = (templates / "program_readings.txt").read_text("utf-8")
    return program + of_readings.format(columns=columns, unit=repr(unit), factors=rows, offsets=row_of(offsets, ", "))


def _beta(geometry: Geometry) -> Float[np.ndarray, " n"]:
    return np.zeros(len(geometry.theta)) if geometry.beta is None else np.asarray(geometry.beta)


def row_of(values: Iterable[float], separator: str = ",") -> str:
    """Numbers with all digits."""
    # Below 1e-12 of any unit is rounding.
    return separator.join(repr(float(value) if abs(value) > 1e-12 else 0.0) for value in values)
