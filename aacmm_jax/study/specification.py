"""Specification of a study: tables in TOML or from Python. Any value may be a list; the study is the grid of all lists.

Every number has its unit in its name. After validation every factor is a list, of one level where one value was given.
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, model_validator

from ..files.toml import Strict, validated

# More cells than a grid of four factors with ten levels each are a mistake.
MOST_CELLS = 10_000
MOST_TRIALS = 10**10


def _depth(value: Any) -> int:
    """Depth of nested lists."""
    return 1 + max(map(_depth, value), default=0) if isinstance(value, list | tuple) else 0


def _levels_of(natural: int) -> BeforeValidator:
    """One level becomes a list of one. ``natural``: depth of the lists in a single level."""
    return BeforeValidator(
        lambda value: value if isinstance(value, list | tuple) and (not value or _depth(value) > natural) else [value]
    )


def _different(levels: list) -> list:
    for i, level in enumerate(levels):
        if level in levels[:i]:
            raise ValueError(f"the value {_label(level)} is given twice; give each value once.")
    return levels


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] < pair[1]:
        raise ValueError(f"{pair[0]:g} to {pair[1]:g} is not a range; give the lower number first.")
    return pair


Level = TypeVar("Level")
Levels = Annotated[list[Level], _levels_of(0), Field(min_length=1), AfterValidator(_different)]
Amount = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1, le=100_000)]
Few = Annotated[int, Field(ge=1, le=1000)]
Pair = Annotated[tuple[float, float], Field(strict=False), AfterValidator(_ordered)]
Point = Annotated[tuple[float, float, float], Field(strict=False)]
Points = Annotated[list[Point], Field(min_length=1)]
Ends = Annotated[list[Annotated[tuple[Point, Point], Field(strict=False)]], Field(min_length=1)]


class _Table(BaseModel):
    model_config = Strict.model_config


class Distribution(_Table):
    """Deviation of one kind of parameter: uniform within a half-width, or normal with a standard deviation.

    A plain number is a uniform half-width.
    """

    uniform: Amount | None = None
    normal: Amount | None = None

    @model_validator(mode="before")
    @classmethod
    def _plain(cls, value: Any) -> Any:
        return {"uniform": value} if isinstance(value, int | float) else value

    @model_validator(mode="after")
    def _one(self) -> "Distribution":
        if (self.uniform is None) == (self.normal is None):
            raise ValueError("give either uniform (a half-width) or normal (a standard deviation).")
        return self


class DeviationTable(_Table):
    """Deviation of the true arm from the nominal one, independent for every free parameter.

    ``length_mm`` and ``angle_deg`` apply to all lengths and angles that have no table entry of their own. Coefficients
    of joint corrections deviate where one of the last keys says so: those of ``model``, what the joints of true arms
    do; by default those of all models of the study.
    """

    length_mm: Levels[Distribution] = [Distribution(uniform=0.0)]
    angle_deg: Levels[Distribution] = [Distribution(uniform=0.0)]
    a_mm: Levels[Distribution] | None = None
    d_mm: Levels[Distribution] | None = None
    probe_mm: Levels[Distribution] | None = None
    alpha_deg: Levels[Distribution] | None = None
    theta_deg: Levels[Distribution] | None = None
    beta_deg: Levels[Distribution] | None = None
    model: Levels[str] | None = None
    harmonics_arcsec: Levels[Distribution] | None = None
    harmonics_mm: Levels[Distribution] | None = None  # of prismatic joints
    gear_ppm: Levels[Distribution] | None = None
    coupled_ppm: Levels[Distribution] | None = None
    gravity_mrad_per_m: Levels[Distribution] | None = None
    gravity_mrad_per_knm: Levels[Distribution] | None = None  # of links whose masses are known


class Region(_Table):
    """Positions allowed for sockets and reference lengths, in the base frame: x, y, z, and distance from the origin."""

    x_mm: Pair | None = None
    y_mm: Pair | None = None
    z_mm: Pair | None = None
    distance_mm: Pair | None = None

    @model_validator(mode="after")
    def _bounded(self) -> "Region":
        if self.distance_mm is None and None in (self.x_mm, self.y_mm, self.z_mm):
            raise ValueError("a region needs distance_mm, or x_mm, y_mm and z_mm; add the missing key.")
        return self


class CaptureTable(_Table):
    """``positions_mm`` of sockets, or a number of ``sockets`` at random in a ``region``, or a capture ``file``, or a
    ``kit`` of artefacts and instruments (`files.read_kit`), with which a capture is simulated once.

    ``poses`` is their number in each socket, ``pool`` the number that the study generates for each socket to draw from.
    """

    file: str | None = None
    kit: str | None = None
    positions_mm: Annotated[list[Points], _levels_of(2), Field(min_length=1), AfterValidator(_different)] | None = None
    sockets: Levels[Few] | None = None
    poses: Levels[Count] = [70]
    region: Levels[Region] | None = None
    joint_limits_deg: Annotated[list[list[Pair]], _levels_of(2), Field(min_length=1)] | None = None
    pool: Annotated[int, Field(ge=4096, le=2**24)] = 32_768

    @model_validator(mode="after")
    def _one(self) -> "CaptureTable":
        if sum(given is not None for given in (self.file, self.kit, self.positions_mm, self.sockets)) != 1:
            raise ValueError("give exactly one of positions_mm, sockets (with a region), file and kit.")
        if self.sockets is not None and self.region is None:
            raise ValueError("sockets at random positions need a region; add region.")
        generated = {"poses", "region", "joint_limits_deg", "pool"} & self.model_fields_set
        if self.recorded and generated:
            source = "kit" if self.file is None else "file"
            raise ValueError(
                f"{min(generated)} applies to generated poses, but {source} already states the poses; remove one of "
                "the two."
            )
        return self

    @property
    def recorded(self) -> bool:
        """Whether the poses are those of one capture."""
        return self.file is not None or self.kit is not None


class NoiseTable(_Table):
    """Standard deviations of a reading, of a coordinate of the seated tip, and of both coefficients of every encoder's
    first harmonic; and the resolution of a reading.

    The readings of prismatic joints err by ``linear_encoder_mm``, by default what ``encoder_arcsec`` is at 1 m, and
    have the resolution ``linear_resolution_mm``.
    """

    encoder_arcsec: Levels[Amount] = [0.0]
    resolution_arcsec: Levels[Amount] = [0.0]
    linear_encoder_mm: Levels[Amount] | None = None
    linear_resolution_mm: Levels[Amount] | None = None
    seating_mm: Levels[Amount] = [0.0]
    eccentricity_arcsec: Levels[Amount] = [0.0]


class BoundsTable(_Table):
    """Bounds: half-widths (default: those of the arm's file) about the nominal arm, and shifts of their centre."""

    length_mm: Levels[Amount] | None = None
    angle_deg: Levels[Amount] | None = None
    length_shift_mm: Levels[float] = [0.0]
    angle_shift_deg: Levels[float] = [0.0]
    override: dict[str, Amount] | None = None  # half-widths by name, mm or deg


class ReferenceTable(_Table):
    """The reference length, its number of positions, of poses at each end, and its standard uncertainty.

    It is placed at random in the ``region`` (default: that of the capture), or between ``ends_mm``, which define its
    length.
    """

    length_mm: Levels[Annotated[float, Field(gt=0)]] | None = None
    positions: Levels[Few] = [1]
    ends_mm: Annotated[list[Ends], _levels_of(3), Field(min_length=1)] | None = None
    poses: Levels[Count] = [5]
    u_mm: Levels[Amount] = [0.0]
    region: Levels[Region] | None = None

    @model_validator(mode="after")
    def _one(self) -> "ReferenceTable":
        if (self.length_mm is None) == (self.ends_mm is None):
            raise ValueError("give either length_mm (for random positions in the region) or ends_mm.")
        if self.ends_mm is not None and "positions" in self.model_fields_set:
            raise ValueError("ends_mm determines the number of positions; remove positions.")
        for start, end in itertools.chain(*(self.ends_mm or [])):
            if start == end:
                raise ValueError("ends_mm has two ends at the same position; move one of the ends.")
        return self


class IdentificationTable(_Table):
    """How the arm is identified. ``start``: the nominal arm, or random within the bounds (but for the scale anchor).

    ``model``: what the joints do besides their readings, as ``--model`` of calibrate, in place of the corrections of
    the arm's file; ``prior`` as ``--prior``, with the same defaults.
    """

    model: Levels[str] | None = None
    prior: Levels[str] | None = None
    method: Levels[Literal["stage1", "two-stage", "joint"]] | None = None
    hold: Levels[str] = ["longest"]
    start: Levels[Literal["nominal", "random"]] = ["nominal"]
    held: list[str] | None = None
    max_steps: Annotated[int, Field(ge=1, le=1_000_000)] = 300


class Specification(_Table):
    """A study. Lists (but for ``override`` and ``held``) are factors of the grid, the last varying fastest."""

    name: str = ""
    arm: str = ""
    trials: Annotated[int, Field(ge=1, le=10**8)]  # in each cell
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    deviation: DeviationTable = DeviationTable()
    capture: CaptureTable
    noise: NoiseTable = NoiseTable()
    bounds: BoundsTable = BoundsTable()
    reference: ReferenceTable | None = None
    identification: IdentificationTable = IdentificationTable()

    @model_validator(mode="after")
    def _sensible(self) -> "Specification":
        sizes = {name: len(levels) for name, levels in self.factors().items()}
        cells = math.prod(sizes.values())
        if cells > MOST_CELLS:
            grid = " x ".join(f"{size} of {name}" for name, size in sizes.items())
            raise ValueError(f"the grid has {cells:,} cells ({grid}), more than {MOST_CELLS:,}; give shorter lists.")
        if cells * self.trials > MOST_TRIALS:
            raise ValueError(
                f"{cells} cells of {self.trials:,} trials are more than {MOST_TRIALS:,}; give fewer trials."
            )
        reference, scaled = self.reference, set(self.identification.method or ()) & {"two-stage", "joint"}
        if reference is None and not self.capture.recorded and scaled:
            raise ValueError(
                "the methods two-stage and joint need a reference length; add [reference], or use method = 'stage1'."
            )
        at_random = reference is not None and reference.length_mm is not None and reference.region is None
        if at_random and self.capture.region is None:
            raise ValueError(
                "a reference length at a random position needs a region; give the region in [reference], or give "
                "ends_mm."
            )
        return self

    def content(self) -> str:
        """All that the numbers of a study depend on, as JSON."""
        return self.model_dump_json(exclude={"name", "arm"})

    def factors(self) -> dict[str, list]:
        """Values with more than one level: dotted name -> levels, in the order of the tables."""
        return {name: levels for name, levels in self._levels() if len(levels) > 1}

    def _levels(self) -> Iterator[tuple[str, list]]:
        for table in ("deviation", "capture", "noise", "bounds", "reference", "identification"):
            model = getattr(self, table)
            for name in () if model is None else type(model).model_fields:
                value = getattr(model, name)
                if isinstance(value, list) and name != "held":
                    yield f"{table}.{name}", value

    def cells(self) -> list[dict[str, Any]]:
        """Every cell of the grid: dotted name -> level, of every factor and every constant."""
        names, levels = zip(*self._levels(), strict=True)
        return [dict(zip(names, chosen, strict=True)) for chosen in itertools.product(*levels)]


def label(level: Any) -> float | str:
    """A level as shown in tables: a number as it is, anything else as a short text."""
    if isinstance(level, Distribution) and level.uniform is not None:
        return level.uniform
    return float(level) if isinstance(level, int | float) else _label(level)


def _label(level: Any) -> str:
    if isinstance(level, BaseModel):
        given = level.model_dump(exclude_none=True)
        return ", ".join(f"{name} {_label(value)}" for name, value in given.items())
    if isinstance(level, list | tuple):
        return "(" + ", ".join(map(_label, level)) + ")"
    return repr(float(level)).removesuffix(".0") if isinstance(level, int | float) else str(level)


def unit(name: str) -> str:
    """The unit that a dotted name ends in; "1" for counts and choices."""
    if "_mrad_per_" in name:
        return "mrad/(kN m)" if name.endswith("knm") else "mrad/m"
    last = name.rpartition("_")[2]
    return last if last in ("mm", "deg", "arcsec", "ppm") else "1"


def checked(**tables: Any) -> Specification:
    """A specification from Python or NumPy values, or `InputError` in one sentence."""
    return validated(Specification, _python(tables), "the study")


def _python(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _python(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_python(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value
