"""Arms in TOML files, one row per joint or a URDF, files of robots, and the arms that ship with the package."""

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arrays import Numbers
from ..core.errors import InputError, naming, nearest
from ..core.text import printable
from ..data.capture import Capture
from ..data.noise import ArmNoise
from ..kinematics.arm import Arm, correction_names, is_length, reading_as, with_chains
from ..kinematics.axes_to_dh import without_far_frames
from ..kinematics.beside import COLUMNS
from ..kinematics.corrected_arm import loads_of
from ..kinematics.independence import nearly_parallel
from ..kinematics.parameters import ArmSpecification, single, with_tool
from ..kinematics.robots import chain_facts
from ..uncertainty.target_parameters import determined_parameters, only_targets
from .arm_tables import GEOMETRY, ArmFile, Identification, NoiseTable
from .controllers.universal_robots import read_ur_kinematics
from .inputs import ROBOT_FILES
from .outputs import as_path, storable, write_text
from .toml import read_toml
from .urdf_robots import read_urdf

_SHIPPED = Path(__file__).with_name("shipped_arms")
_OTHER_FORMATS = (*ROBOT_FILES, ".yaml", ".yml", ".conf")
_MODEL = re.compile(r"[a-z]+\d+[a-z]{0,2}")  # ur5, iiwa7: a robot of its own, not a misspelt name
_SMALLEST, _LARGEST = 5.0, 50_000.0  # mm: no arm's tip is always as near its base, or ever as far
_FAR = 10_000.0  # mm: no link is as long, but frames on nearly parallel axes may be as far away


def shipped_arms() -> tuple[str, ...]:
    """Names of the arms that come with the package.

    Example:
        >>> print(aj.files.shipped_arms()[:5])
        ('cheng2018-ra7125', 'cheng2018-simulation', 'fr3', 'gen3', 'gen3-lite')
    """
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))


def load_arm(
    source: str | os.PathLike,
    *,
    base: str | None = None,
    tip: str | Sequence[str] | None = None,
    probe: Numbers | None = None,
) -> Arm:
    """The arm of a file.

    A table whose nearly parallel axes have frames more than 10 m away, as those of Universal Robots, gets d = 0 and
    Hayati's beta there, which changes no position (`kinematics.without_far_frames`); unless the file proposes an
    identification, whose names are of the table's own parameters.

    The position of an arm from a URDF is in the frame of its base link where the first axis is that frame's z axis,
    and in the first D-H frame otherwise (`files.urdf_chain` has the transform); readings are the URDF's joint values.

    Args:
        source: Name of a shipped arm (``"cheng2018-simulation"``), or path of a TOML file, a URDF, MJCF (``.xml``),
            or a Universal Robots ``kinematics.yaml``.
        base: Of a URDF: the link that does not move; by default its root. Of MJCF: a body, by default ``"world"``.
        tip: Of a URDF: the link at the end, or those at the ends of a robot's chains, which are named after them; by
            default the links without one after them, one for each chain of joints. Of MJCF likewise: bodies or sites,
            by default bodies.
        probe: A tool's tip ``(3,)`` in the frame of the last link, mm; by default that frame's origin. Not of an arm
            file that states one.

    Example:
        >>> panda = aj.load_arm("panda")
        >>> print(panda.joints, panda.a)
        7 [  0.    0.   82.5 -82.5   0.   88.    0. ]
    """
    return read_arm(source, base=base, tip=tip, probe=probe)[0].arm


def load_specification(
    source: str | os.PathLike,
    *,
    base: str | None = None,
    tip: str | Sequence[str] | None = None,
    probe: Numbers | None = None,
    capture: Capture | None = None,
) -> ArmSpecification:
    """The arm of a file with its name, its proposed identification and, of a URDF, what an export needs.

    A file without an ``[identification]`` table gets the parameters that thorough data would determine well, of
    `Parameters.independent`, and the default bounds. With a capture of targets alone, an arm that ships with the
    package gets the parameters that this capture determines. ``source`` is, like all arguments that are not named here,
    that of `load_arm`; ``probe`` is in mm.

    Args:
        capture: What was observed, where it is known.

    Example:
        >>> robot = aj.files.load_specification("robot.urdf")
        >>> print(robot.name, robot.arm.joints, robot.arm.limits[0])
        robot 3 (-3.0, 3.0)
        >>> print(robot.space().names)
        ('alpha_1', 'alpha_2', 'a_1', 'a_2', 'theta_2', 'theta_3', 'beta_2', 'probe_x', 'probe_y')
    """
    specification, proposed = read_arm(source, base=base, tip=tip, probe=probe)
    return for_capture(specification, proposed, capture)


def load_noise(
    source: str | os.PathLike, *, base: str | None = None, tip: str | Sequence[str] | None = None
) -> ArmNoise:
    """The noise that is usual for the arm of a file: that of its ``[noise]`` table, else that of its class.

    A file without the table is that of a measuring arm, or of a robot where it is a URDF, names one, or is a
    ``kinematics.yaml`` (`data.noise`). Plans assume this noise; a calibration estimates it from the data, and
    compares it with that of a table. ``source`` is, like all arguments that are not named here, that of `load_arm`.

    Returns:
        Class of the arm, its noise (rad and mm, as `Noise` has it), and where the numbers come from.

    Example:
        >>> usual = aj.files.load_noise("panda")
        >>> print(f"{usual.noise.encoder_arcsec:.1f} arcsec: {usual.source}")
        9.0 arcsec: Franka Emika data sheet: pose repeatability +-0.1 mm by ISO 9283
    """
    arm, model = load_arm(source, base=base, tip=tip), _arm_file(_path_of(source))
    default = "measuring arm" if model is not None and model.urdf is None else "robot"
    table = NoiseTable() if model is None or model.noise is None else model.noise
    with naming(f"{source}: [noise]"):
        return table.noise(arm, default)


def usual_noise(
    source: str | os.PathLike, *, base: str | None = None, tip: str | Sequence[str] | None = None
) -> ArmNoise | None:
    """The noise of the ``[noise]`` table of an arm's file, as `load_noise` has it; None where it has none.

    ``source`` is, like all arguments that are not named here, that of `load_arm`.

    Example:
        >>> print(aj.files.usual_noise("robot.urdf"))
        None
    """
    model = _arm_file(_path_of(source))
    return None if model is None or model.noise is None else load_noise(source, base=base, tip=tip)


def _plain(name: str) -> str:
    """The name of an arm without capitals, hyphens, underscores and blanks."""
    return re.sub(r"[-_ ]", "", name.lower())


def _path_of(source: str | os.PathLike) -> Path:
    """The file that is meant: a shipped arm's, or the one at a path."""
    shipped = isinstance(source, str) and source in shipped_arms()
    return _SHIPPED / f"{source}.toml" if shipped else as_path(source)


def _arm_file(path: Path) -> ArmFile | None:
    """What an arm file says; None for a URDF or a ``kinematics.yaml``."""
    return None if path.suffix.lower() in _OTHER_FORMATS else read_toml(path, ArmFile)


def urdf_folder(source: str | os.PathLike) -> Path:
    """The folder of the URDF of an arm, in which its meshes are looked for: its own, or that of the file naming it."""
    path = as_path(source)
    model = _arm_file(path) if os.path.isfile(path) else None
    return (path if model is None or model.urdf is None else path.parent / model.urdf).parent


def arm_beside(folder: Path, arm: str) -> str | Path:
    """What a file means by the name of an arm: a file beside it, or a shipped arm."""
    file = folder / arm
    return file if arm.endswith((".toml", *_OTHER_FORMATS)) or os.path.isfile(file) else arm


def read_arm(
    source: str | os.PathLike,
    *,
    base: str | None = None,
    tip: str | Sequence[str] | None = None,
    probe: Numbers | None = None,
) -> tuple[ArmSpecification, bool]:
    """The arm of a file as `load_specification` takes it, and whether the file proposes an identification."""
    path = _path_of(source)
    suffix = path.suffix.lower()
    if suffix in ROBOT_FILES:
        return read_urdf(path, base=base, tip=tip, probe=probe), False
    if base is not None or tip is not None:
        raise InputError(f"{source} is not a URDF or MJCF, but base and tip name links of one; omit base and tip.")
    if suffix in _OTHER_FORMATS:
        return read_ur_kinematics(path, probe=probe), False
    if suffix != ".toml" and not os.path.exists(path):
        names = shipped_arms()
        if re.fullmatch(r"so[-_]?(arm)?[-_]?101", str(source).lower()):
            raise InputError(
                f"'{source}' does not ship with the package, and so100 has other zeros; give the URDF of the "
                "SO-101 (arm = 'so101.urdf', tip = 'gripper_frame_link')."
            )
        asked = _plain(str(source))
        same = [name for name in names if _plain(name) == asked]
        shortened = any(name.partition("-")[0] == asked for name in names)
        if _MODEL.fullmatch(asked) and not same and not shortened:
            raise InputError(
                f"'{source}' does not ship with the package, and a robot of a similar name has other dimensions; give "
                f"the URDF of this robot (arm = '{source}.urdf'), or an arm file."
            )
        raise InputError(
            f"'{source}' is neither a file nor an arm that ships with the package"
            f"{nearest(asked, same or names, most=len(names))}"
        )
    model = read_toml(path, ArmFile)
    if probe is not None and any(model.probe):
        raise InputError(
            f"{path} already states the probe, so no other probe can be given; change the probe in that file, or with "
            "arm.replace(probe=...)."
        )
    with naming(path):
        return _specification(path, model, probe), model.identification is not None


def _specification(path: Path, model: ArmFile, probe: Numbers | None) -> ArmSpecification:
    units = model.units
    if model.urdf is not None:
        tool = units["mm"] * np.array(model.probe) if probe is None else probe
        specification = read_urdf(path.parent / model.urdf, base=model.base, tip=model.tip, probe=tool)
    else:
        arm = _arm_of_rows(model)
        specification = ArmSpecification(arm if probe is None else with_tool(arm, probe))
    if model.load_centre is not None:
        centre, tool = units["mm"] * np.array(model.load_centre), units["mm"] * np.array(model.probe)
        specification = with_load_centre(specification, centre, tool if probe is None else probe)
    arm = reading_as(specification.arm, [name for name in COLUMNS if getattr(model, name)])
    if model.corrections is not None:
        arm = model.corrections.corrected(arm, units)
    prior = None if model.priors is None else model.priors.prior(arm, units)
    specification = specification._replace(arm=arm, name=model.name or path.stem, prior=prior)
    proposed = model.identification
    if proposed is None:
        return specification
    widths = {name: units["mm" if is_length(name) else "rad"] * width for name, width in proposed.override.items()}
    specification = specification._replace(
        held=None if proposed.held is None else tuple(proposed.held),
        free=tuple(proposed.free),
        length=proposed.length * units["mm"],
        angle=specification.angle if proposed.angle is None else proposed.angle * units["rad"],
        override=widths,
        stated=() if path.parent == _SHIPPED else _stated(proposed),
    )
    specification.bounds()  # refuses names that the arm does not have
    return specification


def with_load_centre(specification: ArmSpecification, centre: Numbers, tool: Numbers | None) -> ArmSpecification:
    """The arm with the centre of mass of its load, mm, in the frame in which the tool is stated: of a URDF in its tip
    links, else in the last frames. `InputError` where these are not three numbers, or three of each chain."""
    arm = specification.arm
    centres = np.asarray(arm.replace(load_centre=centre).load_centre)
    if specification.urdf is not None:
        probe = np.asarray(arm.probe)
        centres = centres + probe - (0.0 if tool is None else np.resize(tool, probe.shape))
    return specification._replace(arm=arm.replace(load_centre=centres))


def _stated(proposed: Identification) -> tuple[str, ...]:
    """What a person chose in the table ``[identification]``."""
    keys = proposed.model_fields_set
    return ("parameters",) * bool(keys & {"held", "free"}) + ("bounds",) * bool(keys & {"length", "angle", "override"})


def _arm_of_rows(model: ArmFile) -> Arm:
    """The arm of a table of joints."""
    rows, (length, angle) = model.joint, model.units.values()
    links = [(row.alpha, row.a) for row in rows]
    if model.convention == "craig":
        # Rx(alpha_{i-1}) Tx(a_{i-1}) Rz Tz: the link after joint i is in row i + 1; there is none after the last joint.
        links = [*links[1:], (0.0, 0.0)]
    units = [length if i in model.prismatic else angle for i in range(1, len(rows) + 1)]
    limits = [[unit * limit for limit in row.limits or ()] for row, unit in zip(rows, units, strict=True)]
    arm = Arm(
        alpha=[angle * twist for twist, _ in links],
        a=[length * a for _, a in links],
        d=[length * row.d for row in rows],
        theta=[angle * row.theta for row in rows],
        beta=None
        if all(row.beta is None for row in rows)
        else [0.0 if row.beta is None else angle * row.beta for row in rows],
        probe=[length * x for point in (model.probe, *model.further_probes) for x in point],
        fixed=model.fixed,
        mimic=[(int(joint), int(source), factor, offset) for joint, source, factor, offset in model.mimic],
        chains=[(chain.name, chain.joints) for chain in model.chains],
        limits=None if rows[0].limits is None else limits,
        prismatic=model.prismatic,
    )
    far = not arm.chains and any(abs(float(arm.d[i - 1])) > _FAR for i in nearly_parallel(arm))
    # A proposed identification names parameters as the table has them.
    arm = without_far_frames(arm) if far and model.identification is None else arm
    q = with_chains(arm, np.random.default_rng(0).uniform(-math.pi, math.pi, (16, arm.joints)))
    reach = float(np.linalg.norm(np.asarray(arm.position(q)), axis=1).max())
    if 0 < reach < _SMALLEST or reach > _LARGEST:
        raise InputError(
            f"with lengths in {model.length_unit}, the tip is at most {reach:.3g} mm from the base; are the lengths "
            f"in {'m' if reach < _SMALLEST else 'mm'}? Correct length_unit or the lengths."
        )
    return arm


def for_capture(specification: ArmSpecification, proposed: bool, capture: Capture | None) -> ArmSpecification:
    """The arm of a file with the parameters for a capture, where its file proposes none.

    What the file of a shipped arm proposes is meant for its own probe, which is not what a capture of targets observes:
    their places in the last frame are unknown, so that other parameters of the last joints are determined.
    """
    targets = capture is not None and only_targets(capture) and "parameters" not in specification.stated
    return with_parameters(specification, capture) if targets or not proposed else specification


def with_parameters(specification: ArmSpecification, capture: Capture | None = None) -> ArmSpecification:
    """The same with the parameters that are determined; by default by tips in sockets."""
    try:
        space = determined_parameters(specification.arm, capture)
    except InputError:  # an arm of one or two joints, which has one configuration for each position of the tip
        return specification
    held = tuple(name for name in space.held if not name.startswith("beta_"))
    widths = {name: width for name, width in specification.override.items() if name in space.names}
    free = tuple(name for name in space.names if name.startswith("beta_"))
    return specification._replace(held=held, free=free, override=widths)


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
    write_text(path, specification_toml(ArmSpecification(arm, name), source=source, proposed=False))


def specification_toml(specification: ArmSpecification, *, source: str = "", proposed: bool = True) -> str:
    """The text of an arm file: standard convention, mm and rad; with its identification where that is ``proposed``."""
    import tomlkit

    document, arm = tomlkit.document(), single(specification.arm)
    named = {"name": specification.name, "source": source}
    document.update({key: printable(storable(text)) for key, text in named.items() if text})
    document.update({"convention": "standard", "length_unit": "mm", "angle_unit": "rad"})
    geometry = {kind: np.asarray(getattr(arm, kind)).tolist() for kind in GEOMETRY if getattr(arm, kind) is not None}
    document["probe"] = geometry.pop("probe")[:3]
    if arm.load_centre is not None:
        document["load_centre"] = list(arm.load_centre)
    facts = {"prismatic": list(arm.prismatic)} | dict.fromkeys(arm.recorded, True) | chain_facts(arm)
    document.update({key: fact for key, fact in facts.items() if fact})
    rows = tomlkit.array().multiline(True)
    for i in range(arm.joints):
        row = tomlkit.inline_table()
        row.update({kind: values[i] for kind, values in geometry.items()})
        if arm.limits is not None:
            row["limits"] = [-1.0, 1.0] if i + 1 in arm.fixed else list(arm.limits[i])
        rows.append(row)
    document["joint"] = rows
    if arm.corrections is not None:
        nominal, loads = arm.corrections.nominal, loads_of(arm)
        values = np.asarray(arm.coefficients).tolist()
        document["corrections"] = _given(
            gravity=np.asarray(arm.gravity).tolist(),
            mass=None if loads is None else list(loads.mass),
            centre=None if loads is None else [list(centre) for centre in loads.centre],
            coefficients=dict(zip(correction_names(arm)[: len(values)], values, strict=True)),
            nominal=_given(**{kind: getattr(nominal, kind) for kind in GEOMETRY}),
        )
    if proposed:
        document["identification"] = _given(
            held=None if specification.held is None else list(specification.held),
            free=list(specification.free) or None,
            length=float(specification.length),
            angle=float(specification.angle),
            override={name: float(width) for name, width in specification.override.items()} or None,
        )
    prior = specification.prior if proposed else None
    if prior is not None:  # a group of which nothing is known cannot be in it
        document["priors"] = _given(
            sd={group: float(value) for group, value in prior.sd.items()} or None,
            mean={group: float(value) for group, value in prior.mean.items()} or None,
            learn=[group for group, learned in zip(prior.groups, prior.learned, strict=True) if learned] or None,
        )
    return document.as_string()


def _given(**entries: Any) -> dict[str, Any]:
    """Entries that are not None; arrays as lists."""
    listed = {key: value.tolist() if hasattr(value, "tolist") else value for key, value in entries.items()}
    return {key: value for key, value in listed.items() if value is not None}
