"""What an arm file (TOML) may hold, a commented template of one, and what ``--model`` and ``--prior`` say of an arm."""

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, FiniteFloat, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from ..core.errors import InputError
from ..core.text import number
from ..core.units import ARCSEC, DEG, LENGTH_UNITS, UM, M
from ..data.noise import CLASSES, SEATING, ArmNoise, Noise, class_noise, noise_of_repeatability
from ..kinematics.arm import Arm, correction_names
from ..kinematics.corrected_arm import corrected_like, with_corrections
from ..kinematics.parameters import ArmSpecification
from ..kinematics.priors import MIXED, Prior, possible_names, unit_of_group
from .toml import Point, Strict, each_once
from .urdf import link_masses, urdf_chain

GEOMETRY = {"alpha": "rad", "a": "mm", "d": "mm", "theta": "rad", "beta": "rad", "probe": "mm"}
_MOST_JOINTS = 20
# alpha, a, d, joint by joint, as often as needed: of a small measuring arm (shoulder, elbow, wrist), and of a shorter
# chain, whose tip still reaches a volume.
_ROWS = ((-90, 0, 300), (90, 0, 0), (-90, 0, 400), (90, 0, 0), (-90, 0, 400), (90, 0, 0))
_FEW_ROWS = ((-90, 0, 300), (90, 300, 0), (-90, 0, 0), (90, 100, 0), (0, 0, 0))


class JointTable(Strict):
    """A row of D-H parameters, in the file's units."""

    alpha: FiniteFloat
    a: FiniteFloat
    d: FiniteFloat
    theta: FiniteFloat = 0.0
    beta: FiniteFloat | None = None
    limits: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> "JointTable":
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            low, high = self.limits
            raise ValueError(f"the limits are {low:g} to {high:g}; the lower limit must be below the upper limit.")
        return self


class Identification(Strict):
    """The table ``[identification]``: what a calibration may change, in the file's units."""

    held: list[str] | None = None
    free: list[str] = Field(default_factory=list)
    length: PositiveFloat = 10.0
    angle: PositiveFloat | None = None
    override: dict[str, PositiveFloat] = Field(default_factory=dict)


class NoiseTable(Strict):
    """The table ``[noise]``: a class, a published repeatability, or standard deviations."""

    arm_class: Annotated[Literal["measuring arm", "robot", "hobby arm"] | None, Field(alias="class")] = None
    repeatability_mm: PositiveFloat | None = None  # pose repeatability of ISO 9283
    encoder_arcsec: NonNegativeFloat | list[FiniteFloat] | None = None
    seating_mm: NonNegativeFloat | None = None
    source: str = ""

    @model_validator(mode="after")
    def _one_statement(self) -> "NoiseTable":
        if self.repeatability_mm is not None and self.encoder_arcsec is not None:
            raise ValueError(
                "repeatability_mm and encoder_arcsec both state the precision of the readings; give only one of the "
                "two."
            )
        return self

    def noise(self, arm: Arm, default: str) -> ArmNoise:
        """The noise; what the table does not state is that of its class, by default ``default``."""
        name = self.arm_class or default
        seating = SEATING if self.seating_mm is None else self.seating_mm
        if self.repeatability_mm is not None:
            noise = noise_of_repeatability(arm, self.repeatability_mm, seating)
        else:
            usual = np.asarray(class_noise(arm, name).encoder_arcsec)
            stated = self.encoder_arcsec
            noise = Noise(encoder_arcsec=usual if stated is None else stated, seating=seating)
        noise.check(arm.joints)
        return ArmNoise(name, noise, self.source or f"class {name}: {CLASSES[name].source}")


class CorrectionsTable(Strict):
    """The table ``[corrections]``: a model, or coefficients by name with the nominal arm that they are of."""

    model: str | None = None
    coefficients: dict[str, FiniteFloat] = Field(default_factory=dict)  # rad, or mm of a prismatic joint
    gravity: Point = Field(default_factory=lambda: [0.0, 0.0, -1.0])
    mass: list[NonNegativeFloat] | None = None  # of each link, kg
    centre: list[Point] | None = None  # of its mass in its frame, in the unit of lengths
    nominal: dict[str, list[FiniteFloat]] = Field(default_factory=dict)  # in the file's units

    @model_validator(mode="after")
    def _one_of_both(self) -> "CorrectionsTable":
        if (self.model is None) == (not self.coefficients):
            raise ValueError(
                "exactly one of model and coefficients is needed; give model = 'gravity,harmonics=1', for example, or "
                "the coefficients by name."
            )
        if (
            self.mass is not None
            and self.model is not None
            and not {"gravity=masses", "torque"} & {kind.strip() for kind in self.model.split(",")}
        ):
            raise ValueError(
                "the keys mass and centre apply only to the models gravity=masses and torque; write one of these, or "
                "remove the keys."
            )
        if self.nominal and not self.coefficients:
            raise ValueError("the key nominal applies only to coefficients, but a model is given; remove nominal.")
        unknown = set(self.nominal) - {*GEOMETRY}
        if unknown:
            raise ValueError(
                f"nominal has the unknown key '{min(unknown)}'; the allowed keys are alpha, a, d, theta, beta and "
                "probe, each with a list of numbers."
            )
        return self

    def corrected(self, arm: Arm, units: Mapping[str, float]) -> Arm:
        """The arm with these corrections; ``units`` are the file's, in mm and rad."""
        centre = None if self.centre is None else units["mm"] * np.array(self.centre)
        options = {"mass": self.mass, "centre": centre, "gravity": self.gravity}
        if self.model is not None:
            return with_corrections(arm, self.model, **options)
        nominal = {kind: units[GEOMETRY[kind]] * np.array(row) for kind, row in self.nominal.items()}
        return with_coefficients(arm, self.coefficients, nominal, options)


def with_coefficients(
    arm: Arm, coefficients: Mapping[str, float], nominal: Mapping[str, np.ndarray], options: Mapping[str, Any]
) -> Arm:
    """The arm with coefficients of functions that are of another, nominal, arm; ``options`` of `with_corrections`."""
    corrected = with_corrections(arm.replace(**nominal), list(coefficients), **options)
    values = np.array(list(coefficients.values()), dtype=float)
    return corrected_like(corrected, arm).replace(coefficients=values, gravity=options["gravity"])


class PriorTable(Strict):
    """The table ``[priors]`` of an arm file: by group, in the units of that file."""

    sd: dict[str, PositiveFloat] = Field(default_factory=dict)
    mean: dict[str, FiniteFloat] = Field(default_factory=dict)
    learn: list[str] = Field(default_factory=list)

    def prior(self, arm: Arm, units: Mapping[str, float]) -> Prior:
        """The prior; ``units`` are the file's, in mm and rad; others, such as rad/m, are the same in every file."""
        names = possible_names(arm)
        sd, mean = (
            {group: value * units.get(unit_of_group(group, names), 1.0) for group, value in values.items()}
            for values in (self.sd, self.mean)
        )
        prior = Prior(sd, mean=mean, learn=self.learn)
        prior.check(arm)
        return prior


class ChainTable(Strict):
    """A chain of a robot: its joints, from the base to the tip, from 1."""

    name: str
    joints: Annotated[list[PositiveInt], Field(min_length=1)]


class ArmFile(Strict):
    """An arm file."""

    name: str = ""
    source: str = ""
    convention: Literal["standard", "craig"] = "standard"
    length_unit: Literal["mm", "m"]
    angle_unit: Literal["rad", "deg"]
    probe: Point = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    joint: list[JointTable] = Field(default_factory=list)
    prismatic: Annotated[list[PositiveInt], AfterValidator(each_once)] = Field(default_factory=list)  # joints from 1
    fixed: list[PositiveInt] = Field(default_factory=list)  # joints that do not move
    mimic: list[Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]] = Field(default_factory=list)
    chains: list[ChainTable] = Field(default_factory=list)
    further_probes: list[Point] = Field(default_factory=list)  # of the chains after the first
    urdf: str | None = None  # instead of rows of joints: a URDF beside this file
    base: str | None = None  # its links
    tip: str | list[str] | None = None
    torques: bool = False
    directions: bool = False
    load: bool = False
    load_centre: list[FiniteFloat] | None = None  # of mass, in the frame of the probe; by default the tip
    thermometer: bool = False
    identification: Identification | None = None
    corrections: CorrectionsTable | None = None
    noise: NoiseTable | None = None
    priors: PriorTable | None = None

    @classmethod
    def other_kind(cls, content: Mapping[str, Any], path: str | os.PathLike) -> str | None:
        """A manifest, which names the arm."""
        if "joint" in content or "urdf" in content:
            return None
        if "arm" in content:
            arm = f"arm = '{content['arm']}'" if isinstance(content["arm"], str) else "arm"
            return (
                f"is a manifest, not an arm file; give the arm that it names ({arm}), or read the manifest with aacmm "
                "import or aj.files.read_manifest."
            )
        if isinstance(content.get("points"), Mapping):
            return "is a manifest of points, not an arm file; give an arm file, or read it with aj.files.read_points."
        return None

    @property
    def units(self) -> dict[str, float]:
        """The units of lengths and angles, in mm and rad."""
        return {"mm": LENGTH_UNITS[self.length_unit], "rad": {"rad": 1.0, "deg": DEG}[self.angle_unit]}

    @model_validator(mode="after")
    def _rows_or_urdf(self) -> "ArmFile":
        if bool(self.joint) == (self.urdf is not None):
            raise ValueError(
                "exactly one of joint and urdf is needed; give joint (one row per joint) or urdf (the name of a URDF "
                "file)."
            )
        if self.urdf is None and (self.base is not None or self.tip is not None):
            raise ValueError("base and tip apply only to a URDF, whose links they name; remove both, or give urdf.")
        if self.urdf is not None and self.prismatic:
            raise ValueError(
                "the key prismatic applies only to an arm without urdf, because a URDF states which of its joints are "
                "prismatic; remove prismatic."
            )
        return self

    @model_validator(mode="after")
    def _unit_of_angles(self) -> "ArmFile":
        """Refuse twists that can only be in the other unit."""
        for i, joint in enumerate(self.joint, start=1):
            if self.angle_unit == "rad" and abs(joint.alpha) > 2 * math.pi:
                raise ValueError(
                    f"joint {i} has alpha = {joint.alpha:g} rad, more than a revolution; is alpha in degrees? Correct "
                    "angle_unit or alpha."
                )
        twists = [joint.alpha for joint in self.joint if joint.alpha]
        quarters = [twist / (math.pi / 2) for twist in twists]
        if self.angle_unit == "deg" and twists and all(abs(x - round(x)) < 1e-3 and 1 <= abs(x) < 3 for x in quarters):
            raise ValueError(
                f"every alpha that is not 0 is a multiple of pi/2 (for example {twists[0]:g}), which is unusual for "
                "angles in degrees; are the angles in rad? Correct angle_unit or alpha."
            )
        return self

    @model_validator(mode="after")
    def _consistent_rows(self) -> "ArmFile":
        if not self.joint:
            return self
        first = self.joint[0]
        if len({joint.limits is None for joint in self.joint}) > 1:
            raise ValueError("limits are given for some joints only; give limits for all joints or for none.")
        if max(self.prismatic, default=0) > len(self.joint):
            raise ValueError(
                f"prismatic names joint {max(self.prismatic)}, but the arm has {len(self.joint)} joints; correct "
                "prismatic."
            )
        if self.prismatic and first.limits is None:
            raise ValueError(
                f"joint {min(self.prismatic)} is prismatic, but has no limits; give limits for every joint (in "
                "length_unit for prismatic joints)."
            )
        if self.convention == "craig" and (first.alpha or first.a):
            raise ValueError(
                "joint 1 has a twist or a length before its axis (alpha_0, a_0), which the standard convention cannot "
                "represent; choose a base frame whose z axis is the first joint axis, so that both are 0."
            )
        if self.convention == "craig" and any(joint.beta for joint in self.joint):
            raise ValueError(
                "beta (Hayati's angle) is possible only with convention = 'standard', but the convention is 'craig'; "
                "remove beta."
            )
        return self


def arm_template(joints: int = 6) -> str:
    """The text of an arm file in which every key is explained, valid as it stands; of 1 to 20 joints."""
    if not 1 <= joints <= _MOST_JOINTS:
        raise InputError(
            f"no arm file can be written for {joints} joints; give a number of joints from 1 to {_MOST_JOINTS}."
        )
    pattern = _FEW_ROWS if joints < len(_ROWS) else _ROWS
    rows = [pattern[i % len(pattern)] if i + 1 < joints else (0, 0, 0) for i in range(joints)]
    lines = [
        f"  {{ alpha = {alpha:3d}, a = {a:3d}, d = {d:3d}, theta = 0, limits = [-170, 170] }},  # joint {number}"
        for number, (alpha, a, d) in enumerate(rows, start=1)
    ]
    text = (Path(__file__).with_name("templates") / "arm.toml").read_text("utf-8")
    return text.replace("{rows}", "\n".join(lines)).replace("{last}", str(joints))


_UNITS = {
    "mm": {"mm": 1.0, "um": UM, "m": M},
    "rad": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": DEG, "arcsec": ARCSEC},
    # Of joint corrections.
    "rad/m": {"rad/m": 1.0, "mrad/m": 1e-3},
    "1/K": {"um/m/K": 1e-6, "/K": 1.0},
    "1": {"": 1.0},
}
_LEARN = "learn"
_VALUE = re.compile(r"(?:(?P<mean>[^\s]+?)\s*\+-\s*)?(?P<sd>[^\s]+?)\s*(?P<unit>[a-zKN/() ]*)")


def with_model(specification: ArmSpecification, model: str) -> ArmSpecification:
    """The specification with another model of its joints; the masses of ``gravity=masses`` are those of its URDF.
    Raises `InputError` where the model names an unknown kind, or needs masses and there are none."""
    if not model.strip():
        raise InputError("the model is empty; give the model dh for an arm without joint corrections.")
    arm = with_corrections(specification.arm, model, **masses_of(specification))
    gone = {*correction_names(specification.arm)} - {*correction_names(arm)}
    held = specification.held
    return specification._replace(
        arm=arm,
        held=None if held is None else tuple(name for name in held if name not in gone),
        free=tuple(name for name in specification.free if name not in gone),
        override={name: width for name, width in specification.override.items() if name not in gone},
    )


def masses_of(specification: ArmSpecification) -> dict[str, Any]:
    """Mass and centre of mass of each link, as arguments of `with_corrections`; none where they are unknown."""
    if specification.urdf is None:
        return {}
    masses = link_masses(urdf_chain(specification.urdf))
    return masses._asdict() if np.any(masses.mass > 0) else {}


def prior_of_text(text: str, arm: Arm) -> Prior | None:
    """The prior that ``--prior`` states, such as ``length=0.5mm,angle=0.05deg,alpha=learn,d_3=750.2+-0.1mm``.

    "learn" alone learns the standard deviations of lengths and of angles; "none" is None, no prior. Raises `InputError`
    where the text is not of this form, or names no parameter of the arm.
    """
    if text.strip() in ("none", _LEARN):
        return None if text.strip() == "none" else Prior(learn=True)
    sd, mean, learn = {}, {}, []
    for part in filter(None, (part.strip() for part in text.split(","))):
        group, _, value = (word.strip() for word in part.rpartition("="))  # harmonics=2-3=learn
        group = {"length": "lengths", "angle": "angles"}.get(group, group)
        if group in sd or group in learn:
            raise InputError(f"--prior names '{group}' twice; give each group once.")
        if group:
            Prior(learn=[group]).check(arm)
        if value == _LEARN:
            learn.append(group)
            continue
        match = _VALUE.fullmatch(value)
        unit = unit_of_group(group, possible_names(arm))
        factors = {} if unit == MIXED else _UNITS.get(unit, {unit.removeprefix("1"): 1.0})
        try:
            if match is None or match["unit"] not in factors:
                raise ValueError(value)
            sd[group] = number(match["sd"]) * factors[match["unit"]]
            if match["mean"] is not None:
                mean[group] = number(match["mean"]) * factors[match["unit"]]
        except ValueError as error:
            units = ", ".join(factors) or "lengths and angles need separate groups, each with its own unit"
            raise InputError(
                f"--prior '{part}' is not of the form GROUP=NUMBER and unit ({units}), GROUP=MEAN+-NUMBER and unit, or "
                "GROUP=learn."
            ) from error
    prior = Prior(sd, mean=mean, learn=learn)
    prior.check(arm)
    return prior
