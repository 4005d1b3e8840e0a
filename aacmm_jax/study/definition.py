"""A study: its specification, the nominal arm, perhaps a recording; and the setting and values of every cell."""

import hashlib
import math
from collections.abc import Mapping
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..calibration.scale_anchor import default_method, scale_anchor
from ..calibration.task import check_enough, check_observed
from ..core.errors import InputError, naming
from ..core.units import ARCSEC, DEG, M
from ..data.capture import Capture
from ..data.recording import Recording
from ..files.arms import specification_toml
from ..kinematics.arm import Arm, correction_names, joint_limits, without_corrections
from ..kinematics.parameters import ArmSpecification, Parameters, single
from ..kinematics.priors import Prior
from ..model.observed import Observed
from .joint_models import all_joints, check_deviations, coefficients_of, deviation_of, prior_of, space_of
from .specification import Distribution, Point, Region, Specification, label

_MODEL = "identification.model"
POOL_PARTS = 32  # independent parts of a pose pool; trial t draws from part t modulo this


class Fixture(NamedTuple):
    """What fixes the tip: a socket (one end), or a reference length (two ends)."""

    name: str
    poses: int  # at each end
    points: tuple[Point, ...] | None  # positions of the ends, mm; None: drawn at random in the region
    region: Region | None = None
    length: float | None = None  # of a reference length at random, mm

    @property
    def ends(self) -> int:
        """Number of points at which the tip is fixed."""
        return len(self.points) if self.points is not None else 1 if self.length is None else 2


class Setting(NamedTuple):
    """What determines the compiled program of a cell, and its pose pool."""

    fixtures: tuple[Fixture, ...]
    limits: tuple[tuple[float, float], ...]  # rad, or mm of prismatic joints; none of a recording
    hold: str | None
    method: str
    random_start: bool
    recorded: bool  # the poses are those of the recording
    model: str | None = None  # of the joints; None: that of the nominal arm
    prior: str | None = None  # as a text; None: the default

    @property
    def sizes(self) -> tuple[int, ...]:
        """Poses in each socket."""
        return tuple(fixture.poses for fixture in self.fixtures for _ in range(fixture.ends))


class CellValues(NamedTuple):
    """What differs from cell to cell within one compiled program; the first axis is the cell. mm and rad."""

    width: Float[np.ndarray, "c p"]  # of the deviation
    normal: Bool[np.ndarray, "c p"]
    lower: Float[np.ndarray, "c p"]
    upper: Float[np.ndarray, "c p"]
    encoder: Float[np.ndarray, " c"]
    resolution: Float[np.ndarray, " c"]
    seating: Float[np.ndarray, " c"]
    eccentricity: Float[np.ndarray, " c"]
    linear_encoder: Float[np.ndarray, " c"]  # of prismatic joints
    linear_resolution: Float[np.ndarray, " c"]
    u: Float[np.ndarray, " c"]  # of reference lengths; NaN: as recorded


class Study:
    """A Monte Carlo study of calibrations: made by `make_study` and `read_study`, run by `run_study`. Immutable.

    Studies are equal where they give the same numbers (`digest`), whatever their names and the sources of their files.

    Args:
        specification: What is asked.
        nominal: The nominal arm, its name and its proposed identification; mm and rad.
        recording: The capture whose configurations are used, where the specification names one.

    Raises:
        InputError: Whatever can be known to be wrong before work starts, but for fixtures out of reach.

    Example:
        >>> print(len(study.cells), "cells of", study.trials, "trials:", study.factors)
        4 cells of 20 trials: {'bounds.length_mm': [5.0, 10.0], 'bounds.length_shift_mm': [0.0, 3.0]}
    """

    def __init__(self, specification: Specification, nominal: ArmSpecification, recording: Recording | None = None):
        if single(nominal.arm).chains and recording is None:
            raise InputError(
                "a study of a robot with several chains needs the poses of a capture; simulate one (aacmm simulate), "
                "and name its file in [capture]."
            )
        self.specification, self.nominal, self.recording = specification, _picklable(nominal), recording
        if recording is not None:
            true = None if recording.true is None else _picklable(recording.true)
            self.recording = recording._replace(nominal=_picklable(recording.nominal), true=true)
        self._check()

    def __getstate__(self) -> dict[str, Any]:
        """A copy has the contents and the digest; the rest is derived again, in a worker once: `equal_study`."""
        return {name: getattr(self, name) for name in ("specification", "nominal", "recording", "digest")}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Study) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def capture(self) -> Capture | None:
        """The capture of the recording."""
        return None if self.recording is None else self.recording.capture

    @property
    def observed(self) -> bool:
        """Whether the capture has observations besides sockets and lengths, or is of a robot, and so solved at once."""
        return self.capture is not None and bool(self.capture.observations or self.nominal.arm.chains)

    @property
    def trials(self) -> int:
        """Trials in each cell."""
        return self.specification.trials

    @cached_property
    def cells(self) -> list[dict[str, Any]]:
        """The cells of the grid: of each, every level by its dotted name."""
        return self.specification.cells()

    @cached_property
    def factors(self) -> dict[str, list]:
        """What varies: dotted name -> the levels, as numbers or short texts."""
        factors = {}
        for name, levels in self.specification.factors().items():
            labels = [label(level) for level in levels]
            factors[name] = labels if all(isinstance(text, float) for text in labels) else list(map(str, labels))
        return factors

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that the numbers depend on: studies with the same digest give the same numbers."""
        content = [self.specification.content(), specification_toml(self.nominal._replace(name=""))]
        if self.capture is not None:
            q, names, sizes = np.asarray(self.capture.q), self.capture.names, self.capture.sizes
            lengths = [(r.start, r.end, float(r.value), float(r.u)) for r in self.capture.lengths]
            content += [q.tobytes().hex(), repr((names, sizes, lengths))]
            for observation in self.capture.observations:
                content.append(repr((observation.kind, observation.name)))
                for name, value in observation.stored().items():
                    array = np.asarray(value)
                    values = array.tobytes().hex() if array.dtype.kind == "f" else array.tolist()
                    content.append(f"{name} {array.shape} {values}")
        return hashlib.sha256("\n".join(content).encode()).hexdigest()

    @property
    def plain_arm(self) -> Arm:
        """The nominal arm whose joints do what they read: of configurations that trials begin with."""
        return without_corrections(self.nominal.arm)

    @cached_property
    def joints(self) -> Arm:
        """The nominal arm with all corrections of the study."""
        arm = self.nominal.arm
        for key in ("deviation.model", _MODEL):
            with naming(key):
                models = dict.fromkeys(cell[key] for cell in self.cells if key in cell)
                arm = all_joints(self.nominal._replace(arm=arm), models)
        return arm

    @cached_property
    def _spaces(self) -> dict[str | None, Parameters]:
        """The free parameters by model of the joints."""
        held, models = self.specification.identification.held, dict.fromkeys(cell.get(_MODEL) for cell in self.cells)
        with naming("identification.held"):
            return {model: space_of(self.nominal, self.joints, held, model) for model in models}

    @cached_property
    def space(self) -> Parameters:
        """What true arms deviate in and any cell identifies, on the nominal arm: the free parameters, and coefficients
        of joint corrections."""
        spaces = list(self._spaces.values())
        names = [name for space in spaces for name in space.names]
        coefficients = [name for name in correction_names(self.joints) if not name.startswith("gravity_")]
        beta = spaces[0].base.beta
        base = self.joints if beta is None else self.joints.replace(beta=beta)
        return Parameters(base, tuple(dict.fromkeys([*names, *coefficients])))

    def identified(self, setting: Setting) -> tuple[Parameters, Prior | None]:
        """The free parameters of the cells of a setting, and their prior."""
        space = self._spaces[setting.model]
        with naming("identification.prior"):
            return space, prior_of(self.nominal, space, setting.model, setting.prior)

    @cached_property
    def settings(self) -> list[Setting]:
        """The setting of each cell."""
        recorded, capture, anchors = None, self.capture, {}
        if capture is not None:
            tips = np.split(np.asarray(self.nominal.arm.position(capture.q)), np.cumsum(capture.sizes))[:-1]
            points = [tuple(tip.mean(axis=0).tolist()) for tip in tips]
            rows = zip(capture.names, capture.sizes, points, strict=True)
            recorded = tuple(Fixture(name, size, (point,)) for name, size, point in rows)
        settings = []
        for cell in self.cells:
            model, prior, hold = cell.get(_MODEL), cell.get("identification.prior"), cell["identification.hold"]
            space = self._spaces[model]
            if (hold, model) not in anchors:
                with naming("identification.hold"):
                    asked = None if hold == "none" else hold
                    anchors[hold, model] = scale_anchor(space, space.base, asked, capture=capture).hold
            setting = Setting(
                fixtures=_fixtures(cell) if recorded is None else recorded,
                limits=self._limits(cell.get("capture.joint_limits_deg")) if recorded is None else (),
                hold=anchors[hold, model],
                method="",
                random_start=cell["identification.start"] == "random",
                recorded=recorded is not None,
                model=model,
                prior=prior,
            )
            settings.append(setting._replace(method=self._method(cell.get("identification.method"), setting)))
        return settings

    def _limits(self, degrees: list[tuple[float, float]] | None) -> tuple[tuple[float, float], ...]:
        arm = self.nominal.arm
        if degrees is not None and len(degrees) != arm.joints:
            raise InputError(
                f"capture.joint_limits_deg has {len(degrees)} rows, but the arm has {arm.joints} joints; give "
                "[lowest, highest] for each."
            )
        if degrees is not None and arm.prismatic:
            raise InputError(
                f"capture.joint_limits_deg is in degrees, but joint {arm.prismatic[0]} is prismatic; state the limits "
                "in the arm's file."
            )
        limits = joint_limits(arm, None if degrees is None else [[math.radians(x) for x in pair] for pair in degrees])
        return tuple((float(lowest), float(highest)) for lowest, highest in limits)

    def _method(self, asked: str | None, setting: Setting) -> str:
        """Observations besides sockets are solved at once: jointly, or as stage 1 where nothing fixes the scale."""
        capture, prior = self.capture, self.identified(setting)[1]
        scaled = self.specification.reference is not None if capture is None else bool(capture.lengths)
        if capture is not None and self.observed:
            scaled = scaled or any(observation.fixes_scale for observation in capture.observations)
            possible = "joint" if scaled else "stage1"
            if asked not in (None, possible):
                raise InputError(
                    f"identification.method is '{asked}', but captures of robots, and those with observations other "
                    "than sockets, are solved in one step, "
                    f"{'because they fix the scale' if scaled else 'and these observations do not fix the scale'}; "
                    f"use '{possible}'."
                )
            return possible
        if asked == "two-stage" and prior is not None:
            raise InputError(
                "identification.method is 'two-stage', which ignores a prior; use method = 'joint', or prior = 'none' "
                "in [identification]."
            )
        if asked is not None:
            return asked
        return default_method(self.nominal.arm, general=prior is not None) if scaled else "stage1"

    @cached_property
    def cell_values(self) -> CellValues:
        """The values of all cells."""
        rows = [(*self._deviations(cell), *self._bounds(cell), *_noise(cell)) for cell in self.cells]
        return CellValues(*(np.array(column) for column in zip(*rows, strict=True)))

    def _deviations(self, cell: Mapping[str, Any]) -> tuple[np.ndarray, list[bool]]:
        """Half-widths or standard deviations of the parameters of true arms, and which are standard deviations."""
        names, corrections = self.space.names, set(correction_names(self.joints))
        true = coefficients_of(self.nominal, cell["deviation.model"]) if "deviation.model" in cell else names
        widths, normal = [], []
        for name in names:
            drawn, unit = deviation_of(cell, self.joints, name)
            if drawn is None or (name in corrections and name not in true):
                drawn = Distribution(uniform=0.0)
            normal.append(drawn.normal is not None)
            widths.append(unit * (drawn.normal or drawn.uniform or 0.0))
        return np.array(widths), normal

    def _bounds(self, cell: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the parameters; coefficients of corrections have none."""
        space, nominal, override = self.space, self.nominal, self.specification.bounds.override
        coefficients = np.isin(space.names, correction_names(self.joints))
        length = cell.get("bounds.length_mm", nominal.length)
        angle = math.radians(cell["bounds.angle_deg"]) if "bounds.angle_deg" in cell else nominal.angle
        half = np.where(coefficients, np.inf, np.where(space.lengths, length, angle))
        if override is None:  # in the units of the arm's file
            for name in set(nominal.override) & set(space.names):
                half[space.index(name)] = nominal.override[name]
        for name, value in (override or {}).items():
            with naming("bounds.override"):
                at = space.index(name)
            half[at] = value * (1.0 if coefficients[at] or space.lengths[at] else DEG)
        shift = np.where(space.lengths, cell["bounds.length_shift_mm"], math.radians(cell["bounds.angle_shift_deg"]))
        centre = np.asarray(space.vector())
        return centre - half + shift, centre + half + shift

    def pool_capacity(self, fixture: Fixture) -> tuple[int, int]:
        """Placements of a fixture in each part of its pool, and poses at each of its ends (a power of two)."""
        rows = self.specification.capture.pool // (POOL_PARTS * fixture.ends)
        if fixture.points is not None:
            return 1, 2 ** int(math.log2(rows))
        poses = max(2 ** math.ceil(math.log2(1.25 * self._most_poses[fixture.ends])), 16)
        return rows // poses, poses

    @cached_property
    def _most_poses(self) -> dict[int, int]:
        """The most poses that any cell takes at an end, of sockets (1) and of reference lengths (2)."""
        fixtures = {fixture for setting in dict.fromkeys(self.settings) for fixture in setting.fixtures}
        return {ends: max((item.poses for item in fixtures if item.ends == ends), default=0) for ends in (1, 2)}

    def _check(self) -> None:
        """Refuse everything that can be known to be wrong before work starts, but for what cannot be reached."""
        capture = self.capture
        if capture is not None and self.specification.reference is not None:
            raise InputError("the capture file already contains its reference lengths; remove [reference].")
        if capture is not None and capture.columns not in (self.nominal.arm.joints, self.nominal.arm.columns):
            raise InputError(
                "the capture and the arm have different numbers of joints; give the arm with which the capture was "
                "recorded."
            )
        deviations = self.specification.deviation
        given = [key for key in type(deviations).model_fields if getattr(deviations, key) is not None]
        check_deviations(given, self.joints, self.space.names)
        for setting in dict.fromkeys(self.settings):
            space = self._spaces[setting.model]
            if capture is not None and self.observed:
                observed, unknowns = Observed.of(capture, space.base), len(space.names) - (setting.method == "stage1")
                check_observed(observed, space, np.asarray(space.vector()), unknowns)
                continue
            check_enough(setting.sizes, len(space.names) - int(space.lengths.any()))
            if setting.method != "stage1" and capture is not None and not capture.lengths:
                raise InputError("the capture file has no reference length; use method = 'stage1', or another file.")
            for fixture in () if capture is not None else setting.fixtures:
                pool, (placements, poses) = self.specification.capture.pool, self.pool_capacity(fixture)
                if fixture.points is None and placements < 2:
                    raise InputError(
                        f"a capture.pool of {pool} poses is too small, because each of its {POOL_PARTS} parts must "
                        f"contain at least two placements with {fixture.poses} poses; give at least "
                        f"{2 * POOL_PARTS * fixture.ends * poses}."
                    )
                if fixture.poses > poses:
                    raise InputError(
                        f"{fixture.poses} poses per socket are needed, but the pool has only {poses} per socket; give "
                        f"a capture.pool larger than {pool}."
                    )
        _ = self.cell_values  # its checks


@lru_cache(maxsize=4)
def equal_study(study: Study) -> Study:
    """The first of equal studies that this process was given: a worker receives one with every block."""
    return study


def _picklable(specification: ArmSpecification) -> ArmSpecification:
    """The same arm file with a plain dict: its default for ``override``, a mapping proxy, cannot be pickled."""
    return specification._replace(override=dict(specification.override))


def _fixtures(cell: Mapping[str, Any]) -> tuple[Fixture, ...]:
    """The sockets of a cell, then its reference lengths."""
    region, poses, points = cell.get("capture.region"), cell["capture.poses"], cell.get("capture.positions_mm")
    if points is not None:
        fixtures = [Fixture(f"S{i + 1}", poses, (tuple(point),)) for i, point in enumerate(points)]
    else:
        fixtures = [Fixture(f"S{i + 1}", poses, None, region) for i in range(cell["capture.sockets"])]
    if "reference.poses" in cell:
        poses, region = cell["reference.poses"], cell.get("reference.region", region)
        pairs, length = cell.get("reference.ends_mm"), cell.get("reference.length_mm")
        if pairs is not None:
            fixtures += [Fixture(f"L{i + 1}", poses, (tuple(a), tuple(b))) for i, (a, b) in enumerate(pairs)]
        else:
            count = cell["reference.positions"]
            fixtures += [Fixture(f"L{i + 1}", poses, None, region, length) for i in range(count)]
    return tuple(fixtures)


def _noise(cell: Mapping[str, Any]) -> tuple[float, ...]:
    """The fields of `CellValues` after the bounds; linear encoders err by what the others do at 1 m."""
    encoder = cell["noise.encoder_arcsec"] * ARCSEC
    return (
        encoder,
        cell["noise.resolution_arcsec"] * ARCSEC,
        cell["noise.seating_mm"],
        cell["noise.eccentricity_arcsec"] * ARCSEC,
        cell.get("noise.linear_encoder_mm", M * encoder),
        cell.get("noise.linear_resolution_mm", 0.0),
        cell.get("reference.u_mm", math.nan),
    )
