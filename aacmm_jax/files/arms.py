"""Arms in TOML files, one row per joint or a URDF, URDF files, and the arms that ship with the package."""

import math
import os
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, FiniteFloat, PositiveFloat, PositiveInt, model_validator

from ..core.arrays import Numbers
from ..core.errors import InputError, nearest
from ..core.text import printable
from ..core.units import DEG
from ..data.arm_classes import ArmNoise
from ..data.capture import Capture
from ..kinematics.arm import Arm
from ..kinematics.axes_to_dh import without_far_frames
from ..kinematics.independence import nearly_parallel
from ..kinematics.parameters import ArmSpecification, single, with_tool
from ..uncertainty.target_parameters import determined_parameters
from .arm_noise import NoiseTable, stated_noise
from .atomic_write import storable, write_text
from .corrections import CorrectionsTable, corrections_toml
from .outputs import as_path
from .priors import PriorTable, prior_toml
from .toml import Strict, each_once, read_toml
from .ur_kinematics import read_ur_kinematics
from .urdf import read_urdf

if TYPE_CHECKING:
    from tomlkit import TOMLDocument

_LENGTH_UNITS = {"mm": 1.0, "m": 1000.0}
_ANGLE_UNITS = {"rad": 1.0, "deg": DEG}
_ROBOTS = (".urdf", ".xacro")  # the latter for the message that says how to expand it
_SMALLEST, _LARGEST = 5.0, 50_000.0  # mm: no arm's tip is always as near its base, or ever as far
_FAR = 10_000.0  # mm: no link is as long, but frames on nearly parallel axes may be as far away
_OTHER_FORMATS = (*_ROBOTS, ".yaml", ".yml")


class _Joint(Strict):
    alpha: FiniteFloat
    a: FiniteFloat
    d: FiniteFloat
    theta: FiniteFloat = 0.0
    beta: FiniteFloat | None = None
    limits: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> "_Joint":
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            low, high = self.limits
            raise ValueError(f"the limits are {low:g} to {high:g}; the lower must be below the upper.")
        return self


class _Identification(Strict):
    held: list[str] | None = None
    free: list[str] = Field(default_factory=list)
    length: PositiveFloat = 10.0
    angle: PositiveFloat | None = None
    override: dict[str, PositiveFloat] = Field(default_factory=dict)


class _ArmModel(Strict):
    name: str = ""
    source: str = ""
    convention: Literal["standard", "craig"] = "standard"
    length_unit: Literal["mm", "m"]
    angle_unit: Literal["rad", "deg"]
    probe: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3, default_factory=lambda: [0.0, 0.0, 0.0])]
    joint: list[_Joint] = Field(default_factory=list)
    prismatic: Annotated[list[PositiveInt], AfterValidator(each_once)] = Field(default_factory=list)  # joints from 1
    urdf: str | None = None  # instead of rows of joints: a URDF beside this file
    base: str | None = None  # its links
    tip: str | None = None
    thermometer: bool = False
    identification: _Identification | None = None
    corrections: CorrectionsTable | None = None
    noise: NoiseTable | None = None
    priors: PriorTable | None = None

    @model_validator(mode="after")
    def _one_description(self) -> "_ArmModel":
        if bool(self.joint) == (self.urdf is not None):
            raise ValueError("give either joint, one row a joint, or urdf, the name of a URDF file.")
        if self.urdf is None and (self.base is not None or self.tip is not None):
            raise ValueError("base and tip are links of a URDF; leave them out, or give urdf.")
        return self

    @model_validator(mode="after")
    def _unit_of_angles(self) -> "_ArmModel":
        """Refuse twists that can only be in the other unit."""
        twists = [joint.alpha for joint in self.joint if joint.alpha]
        for number, joint in enumerate(self.joint, start=1):
            if self.angle_unit == "rad" and abs(joint.alpha) > 2 * math.pi:
                raise ValueError(
                    f"joint {number} has alpha = {joint.alpha:g} rad, more than a revolution; is it in degrees? "
                    "Correct angle_unit or alpha."
                )
        quarters = [twist / (math.pi / 2) for twist in twists]
        if self.angle_unit == "deg" and twists and all(abs(x - round(x)) < 1e-3 and 1 <= abs(x) < 3 for x in quarters):
            raise ValueError(
                f"every alpha is a multiple of pi/2, such as {twists[0]:g}, which is no common twist in degrees; is it "
                "in rad? Correct angle_unit or alpha."
            )
        return self

    @model_validator(mode="after")
    def _all_or_none(self) -> "_ArmModel":
        if len({joint.limits is None for joint in self.joint}) > 1:
            raise ValueError("limits are given for some joints only; give them for all or for none.")
        if self.urdf is not None and self.prismatic:
            raise ValueError("prismatic is for rows of joints, but a URDF says itself which are; leave it out.")
        if not self.joint:
            return self
        if max(self.prismatic, default=0) > len(self.joint):
            raise ValueError(f"prismatic names joint {max(self.prismatic)}, but there are {len(self.joint)} joints.")
        if self.prismatic and self.joint[0].limits is None:
            raise ValueError(
                f"joint {min(self.prismatic)} is prismatic, and nothing says how far it slides; give every joint "
                "limits (in length_unit of prismatic joints)."
            )
        first = self.joint[0]
        if self.convention == "craig" and (first.alpha or first.a):
            raise ValueError(
                "joint 1 has a twist or a length before its axis (alpha_0, a_0), which standard form cannot hold; "
                "choose the base frame on the first axis, so that both are 0."
            )
        if self.convention == "craig" and any(joint.beta for joint in self.joint):
            raise ValueError("beta is Hayati's angle of the standard form; leave it out of a craig table.")
        return self


def shipped_arms() -> tuple[str, ...]:
    """Names of the arms that come with the package.

    Example:
        >>> print(aj.files.shipped_arms()[:5])
        ('cheng2018-ra7125', 'cheng2018-simulation', 'fr3', 'gen3', 'gen3-lite')
    """
    folder = resources.files("aacmm_jax.files") / "shipped_arms"
    return tuple(sorted(item.name.removesuffix(".toml") for item in folder.iterdir() if item.name.endswith(".toml")))


def load_arm(
    source: str | os.PathLike, *, base: str | None = None, tip: str | None = None, probe: Numbers | None = None
) -> Arm:
    """The arm of a file.

    A table whose nearly parallel axes have frames more than 10 m away, as those of Universal Robots, gets d = 0 and
    Hayati's beta there, which changes no position (`kinematics.without_far_frames`); unless the file proposes an
    identification, whose names are of the table's own parameters.

    The position of an arm from a URDF is in the frame of its base link where the first axis is that frame's z axis,
    and in the first D-H frame otherwise (`files.urdf_chain` has the transform); readings are the URDF's joint values.

    Args:
        source: Name of a shipped arm (``"cheng2018-simulation"``), or path of a TOML file, a URDF, or a Universal
            Robots ``kinematics.yaml``.
        base: Of a URDF: the link that does not move; by default its root.
        tip: Of a URDF: the link at the end; by default the only one that has no link after it.
        probe: A tool's tip ``(3,)`` in the frame of the last link, mm; by default that frame's origin. Not of an arm
            file that states one.

    Raises:
        InputError: There is neither, or the file is not an arm's.

    Example:
        >>> panda = aj.load_arm("panda")
        >>> print(panda.joints, panda.a)
        7 [  0.    0.   82.5 -82.5   0.   88.    0. ]
    """
    return read_arm(source, base=base, tip=tip, probe=probe)[0].arm


def load_specification(
    source: str | os.PathLike, *, base: str | None = None, tip: str | None = None, probe: Numbers | None = None
) -> ArmSpecification:
    """The arm of a file with its name, its proposed identification and, of a URDF, what an export needs.

    A file without an ``[identification]`` table gets the parameters that thorough data would determine well, of
    `Parameters.independent`, and the default bounds.

    Args:
        source: As of `load_arm`.
        base: As of `load_arm`.
        tip: As of `load_arm`.
        probe: As of `load_arm`, mm.

    Raises:
        InputError: There is neither, or the file is not an arm's.

    Example:
        >>> robot = aj.files.load_specification("robot.urdf")
        >>> print(robot.name, robot.arm.joints, robot.arm.limits[0])
        robot 3 (-3.0, 3.0)
        >>> print(robot.space().names)
        ('alpha_1', 'alpha_2', 'a_1', 'a_2', 'theta_2', 'theta_3', 'beta_2', 'probe_x', 'probe_y')
    """
    found, proposed = read_arm(source, base=base, tip=tip, probe=probe)
    return found if proposed else with_parameters(found)


def load_noise(source: str | os.PathLike, *, base: str | None = None, tip: str | None = None) -> ArmNoise:
    """The noise that is usual for the arm of a file: that of its ``[noise]`` table, else that of its class.

    A file without the table is that of a measuring arm, or of a robot where it is a URDF, names one, or is a
    ``kinematics.yaml`` (`data.arm_classes`). Plans assume this noise; a calibration estimates it from the data, and
    compares it with that of a table.

    Args:
        source: As of `load_arm`.
        base: As of `load_arm`.
        tip: As of `load_arm`.

    Returns:
        Class of the arm, its noise (rad and mm, as `Noise` has it), and where the numbers come from.

    Raises:
        InputError: There is no such arm, or the numbers are none of this arm.

    Example:
        >>> usual = aj.files.load_noise("panda")
        >>> print(f"{usual.noise.encoder_arcsec:.1f} arcsec: {usual.source}")
        9.0 arcsec: Franka Emika data sheet: pose repeatability +-0.1 mm by ISO 9283
    """
    arm, model = load_arm(source, base=base, tip=tip), _model_of(source)
    try:
        table = None if model is None else model.noise
        return stated_noise(arm, table, "measuring arm" if model is not None and model.urdf is None else "robot")
    except InputError as error:
        raise InputError(f"{source}: [noise] {error}") from error


def usual_noise(source: str | os.PathLike, *, base: str | None = None, tip: str | None = None) -> ArmNoise | None:
    """The noise of the ``[noise]`` table of an arm's file; None where it has none.

    Args:
        source: As of `load_arm`.
        base: As of `load_arm`.
        tip: As of `load_arm`.

    Returns:
        Class of the arm, its noise (rad and mm, as `Noise` has it), and where the numbers come from.

    Example:
        >>> print(aj.files.usual_noise("robot.urdf"))
        None
    """
    model = _model_of(source)
    return None if model is None or model.noise is None else load_noise(source, base=base, tip=tip)


def _model_of(source: str | os.PathLike) -> _ArmModel | None:
    """What an arm file says; None for a URDF or a ``kinematics.yaml``."""
    if isinstance(source, str) and source in shipped_arms():
        with resources.as_file(resources.files("aacmm_jax.files") / "shipped_arms" / f"{source}.toml") as path:
            return read_toml(path, _ArmModel)
    path = as_path(source)
    return None if path.suffix.lower() in _OTHER_FORMATS else read_toml(path, _ArmModel)


def urdf_folder(source: str | os.PathLike) -> Path:
    """The folder of the URDF of an arm, in which its meshes are looked for: its own, or that of the file naming it."""
    path = as_path(source)
    model = _model_of(path) if os.path.isfile(path) else None
    return (path if model is None or model.urdf is None else path.parent / model.urdf).parent


def arm_beside(folder: Path, arm: str) -> str | Path:
    """What a file means by the name of an arm: a file beside it, or a shipped arm."""
    file = folder / arm
    return file if arm.endswith((".toml", *_OTHER_FORMATS)) or os.path.isfile(file) else arm


def read_arm(
    source: str | os.PathLike, *, base: str | None = None, tip: str | None = None, probe: Numbers | None = None
) -> tuple[ArmSpecification, bool]:
    """The arm of a file as `load_specification` takes it, and whether the file proposes an identification."""
    shipped = isinstance(source, str) and source in shipped_arms()
    path = as_path(source)
    suffix = "" if shipped else path.suffix.lower()
    if suffix not in _ROBOTS and (base is not None or tip is not None):
        raise InputError(f"{source} is no URDF, so it has no links; leave out base and tip.")
    if suffix in _OTHER_FORMATS:
        found = (
            read_urdf(path, base=base, tip=tip, probe=probe)
            if suffix in _ROBOTS
            else read_ur_kinematics(path, probe=probe)
        )
        return found, False
    if shipped:
        with resources.as_file(resources.files("aacmm_jax.files") / "shipped_arms" / f"{source}.toml") as path:
            return _specification(path, probe)
    if not os.path.exists(path) and path.suffix != ".toml":
        known = shipped_arms()
        raise InputError(
            f"'{source}' is neither a file nor an arm that ships with the package"
            f"{nearest(str(source), known, most=len(known))}"
        )
    return _specification(path, probe)


def _specification(path: Path, probe: Numbers | None) -> tuple[ArmSpecification, bool]:
    model = read_toml(path, _ArmModel)
    if probe is not None and any(model.probe):
        raise InputError(f"{path} states the probe itself; change it there, or with arm.replace(probe=...).")
    length, angle = _LENGTH_UNITS[model.length_unit], _ANGLE_UNITS[model.angle_unit]
    try:
        if model.urdf is not None:
            tool = length * np.array(model.probe) if probe is None else probe
            found = read_urdf(path.parent / model.urdf, base=model.base, tip=model.tip, probe=tool)
            found = found._replace(name=model.name or path.stem)
        else:
            arm = _arm_of_rows(model, length, angle)
            _check_size(arm, model.length_unit)
            found = ArmSpecification(arm, model.name or path.stem)
            if probe is not None:
                found = found._replace(arm=with_tool(found.arm, probe))
        if model.thermometer:
            found = found._replace(arm=found.arm.replace(thermometer=True))
        if model.corrections is not None:
            found = found._replace(arm=model.corrections.corrected(found.arm, length, angle))
        if model.priors is not None:
            found = found._replace(prior=model.priors.prior(found.arm, length, angle))
        wanted = model.identification
        if wanted is None:
            return found, False
        specification = found._replace(
            held=None if wanted.held is None else tuple(wanted.held),
            free=tuple(wanted.free),
            length=wanted.length * length,
            angle=0.0175 if wanted.angle is None else wanted.angle * angle,
            override={
                name: width * (length if name.split("_")[0] in ("a", "d", "probe") else angle)
                for name, width in wanted.override.items()
            },
        )
        specification.bounds()
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return specification, True


def _arm_of_rows(model: _ArmModel, length: float, angle: float) -> Arm:
    """The arm of a table of joints; ``length`` and ``angle`` are its units in mm and rad."""
    rows = model.joint
    links = [(row.alpha, row.a) for row in rows]
    if model.convention == "craig":
        # Rx(alpha_{i-1}) Tx(a_{i-1}) Rz Tz: the link after joint i is in row i + 1; there is none after the last joint.
        links = [*links[1:], (0.0, 0.0)]
    beta = (
        None
        if all(row.beta is None for row in rows)
        else [angle * (0.0 if row.beta is None else row.beta) for row in rows]
    )
    arm = Arm(
        alpha=[angle * twist for twist, _ in links],
        a=[length * a for _, a in links],
        d=[length * row.d for row in rows],
        theta=[angle * row.theta for row in rows],
        beta=beta,
        probe=[length * x for x in model.probe],
        limits=None
        if rows[0].limits is None
        else [
            [(length if i in model.prismatic else angle) * x for x in row.limits or ()] for i, row in enumerate(rows, 1)
        ],
        prismatic=model.prismatic,
    )
    far = any(abs(float(arm.d[i - 1])) > _FAR for i in nearly_parallel(arm))
    # A proposed identification names parameters as the table has them.
    return without_far_frames(arm) if far and model.identification is None else arm


def _check_size(arm: Arm, unit: str) -> None:
    """Refuse lengths that can only be in the other unit."""
    q = np.random.default_rng(0).uniform(-math.pi, math.pi, (16, arm.joints))
    reach = float(np.linalg.norm(np.asarray(arm.position(q)), axis=1).max())
    if 0 < reach < _SMALLEST or reach > _LARGEST:
        other = "m" if reach < _SMALLEST else "mm"
        raise InputError(
            f"with its lengths in {unit}, the tip is at most {reach:.3g} mm from the base; are they in {other}? "
            "Correct length_unit or the lengths."
        )


def with_parameters(specification: ArmSpecification, capture: Capture | None = None) -> ArmSpecification:
    """The same with the parameters for an arm whose file proposes none.

    Args:
        specification: As of `read_arm`.
        capture: What was observed; by default tips in sockets.
    """
    try:
        space = determined_parameters(specification.arm, capture)
    except InputError:  # an arm of one or two joints, which has one configuration for each position of the tip
        return specification
    held = tuple(name for name in space.held if not name.startswith("beta_"))
    return specification._replace(held=held, free=tuple(name for name in space.names if name.startswith("beta_")))


def save_arm(arm: Arm, path: str | os.PathLike, *, name: str = "", source: str = "") -> None:
    """Write an arm as TOML: standard convention, mm and rad, digits enough to read back the same numbers.

    Args:
        arm: One arm.
        path: The file to write, whole or not at all.
        name: What people call it.
        source: Where its numbers come from, a sentence.

    Example:
        >>> aj.files.save_arm(result.arm, "calibrated.toml", name="calibrated arm")
        >>> print(np.array_equal(aj.load_arm("calibrated.toml").a, result.arm.a))
        True
    """
    write_text(path, arm_toml(arm, name=name, source=source))


def arm_toml(arm: Arm, *, name: str = "", source: str = "") -> str:
    """The text of an arm file without a proposed identification: standard convention, mm and rad."""
    return _document(ArmSpecification(arm, name), source).as_string()


def specification_toml(specification: ArmSpecification, *, source: str = "") -> str:
    """The text of an arm file with its proposed identification: standard convention, mm and rad."""
    import tomlkit

    document = _document(specification, source)
    proposed = tomlkit.table()
    if specification.held is not None:
        proposed["held"] = list(specification.held)
    if specification.free:
        proposed["free"] = list(specification.free)
    proposed["length"] = float(specification.length)
    proposed["angle"] = float(specification.angle)
    if specification.override:
        proposed["override"] = {name: float(width) for name, width in specification.override.items()}
    document["identification"] = proposed
    if specification.prior is not None:
        document["priors"] = prior_toml(specification.prior)
    return document.as_string()


def _document(specification: ArmSpecification, source: str) -> "TOMLDocument":
    import tomlkit

    document = tomlkit.document()
    arm = single(specification.arm)
    named = {"name": specification.name, "source": source}
    document.update({key: printable(storable(text)) for key, text in named.items() if text})
    document.update({"convention": "standard", "length_unit": "mm", "angle_unit": "rad"})
    document["probe"] = [float(x) for x in np.asarray(arm.probe)]
    facts = {"prismatic": list(arm.prismatic), "thermometer": arm.thermometer}
    document.update({key: fact for key, fact in facts.items() if fact})
    rows = tomlkit.array().multiline(True)
    for i in range(arm.joints):
        row = tomlkit.inline_table()
        for kind in ("alpha", "a", "d", "theta", "beta"):
            values = getattr(arm, kind)
            if values is not None:
                row[kind] = float(values[i])
        if arm.limits is not None:
            row["limits"] = list(arm.limits[i])
        rows.append(row)
    document["joint"] = rows
    if arm.corrections is not None:
        document["corrections"] = corrections_toml(arm)
    return document
