"""A study: its specification, the nominal arm, perhaps a recording; and the programs and values of every cell."""

import hashlib
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration.scale_anchor import default_method, scale_anchor
from ..calibration.task import check_enough, check_observed
from ..core.errors import InputError
from ..core.units import ARCSEC, DEG, M
from ..data.capture import Capture
from ..data.recording import Recording
from ..files.arms import specification_toml
from ..kinematics.arm import Arm, correction_names, joint_limits, without_corrections
from ..kinematics.parameters import ArmSpecification, Parameters, single
from ..kinematics.priors import Prior
from ..model.observed import Observed
from .joint_models import (
    Identified,
    all_joints,
    check_deviations,
    coefficients_of,
    deviation_of,
    identified,
    prior_of,
)
from .settings import CellValues, Fixture, Setting
from .specification import Distribution, Point, Region, Specification, label

_MODEL = "identification.model"
_NONE = Distribution(uniform=0.0)
POOL_PARTS = 32  # independent parts of a pose pool; trial t draws from part t modulo this


@contextmanager
def _naming(key: str) -> Iterator[None]:
    """Prefix an error with the key of the specification that it is about."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{key}: {error}") from error


class _Contents(NamedTuple):
    specification: Specification
    nominal: ArmSpecification
    recording: Recording | None


class Study:
    """A Monte Carlo study of calibrations: made by `make_study` and `read_study`, run by `run_study`. Immutable.

    Studies are equal where they give the same numbers (`digest`), whatever their names and the sources of their files.
    A copy or an unpickled study, as workers receive it, keeps its own contents.

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
        single(nominal.arm)
        if recording is not None:
            true = None if recording.true is None else _picklable(recording.true)
            recording = recording._replace(nominal=_picklable(recording.nominal), true=true)
        self._contents = _Contents(specification, _picklable(nominal), recording)
        self._check()

    def __reduce__(self):
        return _restored, (self.digest, self._contents)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Study) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def specification(self) -> Specification:
        """What is asked."""
        return self._contents.specification

    @property
    def nominal(self) -> ArmSpecification:
        """The nominal arm."""
        return self._contents.nominal

    @property
    def recording(self) -> Recording | None:
        """The recording whose configurations are used, where the study names one."""
        return self._contents.recording

    @property
    def capture(self) -> Capture | None:
        """The capture of the recording."""
        return None if self.recording is None else self.recording.capture

    @property
    def observed(self) -> bool:
        """Whether the capture has observations besides sockets and lengths."""
        return self.capture is not None and bool(self.capture.observations)

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
        found = {}
        for name, levels in self.specification.factors().items():
            labels = [label(level) for level in levels]
            found[name] = labels if all(isinstance(one, float) for one in labels) else [str(one) for one in labels]
        return found

    @cached_property
    def space(self) -> Parameters:
        """What true arms deviate in and any cell identifies, on the nominal arm: the free parameters, and coefficients
        of joint corrections."""
        spaces = list(self._spaces.values())
        names = [name for space in spaces for name in space.names]
        coefficients = [name for name in correction_names(self._joints) if not name.startswith("gravity_")]
        beta = spaces[0].base.beta
        base = self._joints if beta is None else self._joints.replace(beta=beta)
        return Parameters(base, tuple(dict.fromkeys([*names, *coefficients])))

    def identified(self, setting: Setting) -> Identified:
        """The free parameters of the cells of a setting, and their prior."""
        return Identified(self._spaces[setting.model], self._prior(setting.model, setting.prior))

    def _prior(self, model: str | None, text: str | None) -> Prior | None:
        with _naming("identification.prior"):
            return prior_of(self.nominal, self._spaces[model], model, text)

    @property
    def plain_arm(self) -> Arm:
        """The nominal arm whose joints do what they read: of configurations that trials begin with."""
        return without_corrections(self.nominal.arm) if self.nominal.arm.corrections is not None else self.nominal.arm

    @cached_property
    def _joints(self) -> Arm:
        """The nominal arm with all corrections of the study."""
        found = self.nominal.arm
        for key in ("deviation.model", _MODEL):
            with _naming(key):
                models = dict.fromkeys(cell[key] for cell in self.cells if key in cell)
                found = all_joints(self.nominal._replace(arm=found), models)
        return found

    @cached_property
    def _spaces(self) -> dict[str | None, Parameters]:
        """The free parameters by model of the joints."""
        held, models = self.specification.identification.held, dict.fromkeys(cell.get(_MODEL) for cell in self.cells)
        with _naming("identification.held"):
            return {model: identified(self.nominal, self._joints, held, model) for model in models}

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that the numbers depend on: studies with the same digest give the same numbers."""
        arm = specification_toml(self.nominal._replace(name=""))
        content = [self.specification.content(), arm]
        if self.capture is not None:
            q, names, sizes = np.asarray(self.capture.q), self.capture.names, self.capture.sizes
            lengths = [(r.start, r.end, float(r.value), float(r.u)) for r in self.capture.lengths]
            content += [q.tobytes().hex(), repr((names, sizes, lengths))]
            for observation in self.capture.observations:
                content.append(repr((observation.kind, observation.name)))
                for name, value in observation.stored().items():
                    array = np.asarray(value)
                    content.append(
                        f"{name} {array.shape} {array.tobytes().hex() if array.dtype.kind == 'f' else array.tolist()}"
                    )
        return hashlib.sha256("\n".join(content).encode()).hexdigest()

    @cached_property
    def settings(self) -> list[Setting]:
        """The setting of each cell."""
        keys = [(cell["identification.hold"], cell.get(_MODEL)) for cell in self.cells]
        anchors = {key: self._scale_anchor(*key) for key in dict.fromkeys(keys)}
        recorded = self._recorded_fixtures()
        return [self._setting(cell, anchors[key], recorded) for cell, key in zip(self.cells, keys, strict=True)]

    @cached_property
    def eccentric(self) -> bool:
        """Whether any cell has eccentric encoders (their sines are then computed for all)."""
        return bool(np.any(self.cell_values.eccentricity > 0))

    @cached_property
    def cell_values(self) -> CellValues:
        """The values of all cells."""
        return CellValues(*(np.array(column) for column in zip(*map(self._values_of, self.cells), strict=True)))

    @cached_property
    def most_poses(self) -> dict[int, int]:
        """The most poses that any cell takes at an end, of sockets (1) and of reference lengths (2)."""
        fixtures = {fixture for setting in dict.fromkeys(self.settings) for fixture in setting.fixtures}
        return {ends: max((one.poses for one in fixtures if one.ends == ends), default=0) for ends in (1, 2)}

    def _recorded_fixtures(self) -> tuple[Fixture, ...] | None:
        if self.capture is None:
            return None
        rows = zip(self.capture.names, self.capture.sizes, _centroids(self.nominal.arm, self.capture), strict=True)
        return tuple(Fixture(name, size, (point,)) for name, size, point in rows)

    def _setting(self, cell: Mapping[str, Any], hold: str | None, recorded: tuple[Fixture, ...] | None) -> Setting:
        arm, random_start = self.nominal.arm, cell["identification.start"] == "random"
        joints = cell.get(_MODEL), cell.get("identification.prior")
        method = self._method(cell, self._prior(*joints))
        if recorded is not None:
            return Setting(recorded, (), hold, method, random_start, True, *joints)
        region, poses = cell.get("capture.region"), cell["capture.poses"]
        points = cell.get("capture.positions_mm")
        if points is not None:
            fixtures = [Fixture(f"S{i + 1}", poses, (tuple(point),)) for i, point in enumerate(points)]
        else:
            fixtures = [Fixture(f"S{i + 1}", poses, None, region) for i in range(cell["capture.sockets"])]
        fixtures += _reference_fixtures(cell, region)
        degrees = cell.get("capture.joint_limits_deg")
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
        return Setting(
            tuple(fixtures), tuple((float(a), float(b)) for a, b in limits), hold, method, random_start, False, *joints
        )

    def _method(self, cell: Mapping[str, Any], prior: Prior | None) -> str:
        asked = cell.get("identification.method")
        if self.observed:
            return self._observed_method(asked)
        if asked == "two-stage" and prior is not None:
            raise InputError(
                "identification.method is 'two-stage', which ignores a prior; use 'joint', or prior = 'none' in "
                "[identification]."
            )
        if asked is not None:
            return asked
        reference = self.specification.reference is not None
        scaled = reference if self.capture is None else bool(self.capture.lengths)
        return default_method(self.nominal.arm, general=prior is not None) if scaled else "stage1"

    def _observed_method(self, asked: str | None) -> str:
        """All observations are solved at once: jointly, or as stage 1 where nothing fixes the scale."""
        assert self.capture is not None
        fixed = bool(self.capture.lengths) or any(one.fixes_scale for one in self.capture.observations)
        possible = "joint" if fixed else "stage1"
        if asked not in (None, possible):
            raise InputError(
                f"identification.method is '{asked}', but captures with observations besides sockets are solved at "
                f"once, {'as they fix the scale' if fixed else 'and these leave the scale open'}; use '{possible}'."
            )
        return possible

    def _scale_anchor(self, hold: str, model: str | None) -> str | None:
        space = self._spaces[model]
        with _naming("identification.hold"):
            return scale_anchor(space, space.base, None if hold == "none" else hold, capture=self.capture).hold

    def _values_of(self, cell: Mapping[str, Any]) -> tuple:
        """The fields of `CellValues` for one cell."""
        space, nominal, override = self.space, self.nominal, self.specification.bounds.override
        is_length_of = space.lengths
        coefficients = np.isin(space.names, correction_names(self._joints))
        drawn, units = zip(*(deviation_of(cell, self._joints, name) for name in space.names), strict=True)
        true = coefficients_of(nominal, cell["deviation.model"]) if "deviation.model" in cell else space.names
        deviations = [
            _NONE if one is None or (corrects and name not in true) else one
            for one, corrects, name in zip(drawn, coefficients, space.names, strict=True)
        ]
        unit = np.where(coefficients, 1.0, np.where(is_length_of, 1.0, DEG))
        width = np.array(units) * [one.uniform if one.normal is None else one.normal for one in deviations]
        length, angle = cell.get("bounds.length_mm"), cell.get("bounds.angle_deg")
        length = nominal.length if length is None else length
        angle = nominal.angle if angle is None else math.radians(angle)
        half = np.where(coefficients, np.inf, np.where(is_length_of, length, angle))
        for name, value in (nominal.override if override is None else override).items():
            if override is not None or name in space.names:
                with _naming("bounds.override"):
                    half[space.index(name)] = value if override is None else value * unit[space.index(name)]
        shift = np.where(is_length_of, cell["bounds.length_shift_mm"], math.radians(cell["bounds.angle_shift_deg"]))
        centre = self._nominal_vector
        return (
            width,
            [one.normal is not None for one in deviations],
            centre - half + shift,
            centre + half + shift,
            cell["noise.encoder_arcsec"] * ARCSEC,
            cell["noise.resolution_arcsec"] * ARCSEC,
            cell["noise.seating_mm"],
            cell["noise.eccentricity_arcsec"] * ARCSEC,
            cell.get("noise.linear_encoder_mm", M * cell["noise.encoder_arcsec"] * ARCSEC),
            cell.get("noise.linear_resolution_mm", 0.0),
            cell.get("reference.u_mm", math.nan),
        )

    @cached_property
    def _nominal_vector(self) -> Float[np.ndarray, " p"]:
        return np.asarray(self.space.vector())

    def _check(self) -> None:
        """Refuse everything that can be known to be wrong before work starts, but for what cannot be reached."""
        capture, pool = self.capture, self.specification.capture.pool
        if capture is not None and self.specification.reference is not None:
            raise InputError("the capture file brings its reference lengths; leave [reference] out.")
        if capture is not None and capture.columns not in (self.nominal.arm.joints, self.nominal.arm.columns):
            raise InputError("the capture and the arm differ in their number of joints; name the arm that recorded it.")
        deviations = self.specification.deviation
        given = [key for key in type(deviations).model_fields if getattr(deviations, key) is not None]
        check_deviations(given, self._joints, self.space.names)
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
                placements, poses = pool_capacity(self, fixture)
                if fixture.points is None and placements < 2:
                    raise InputError(
                        f"a capture.pool of {pool} poses holds fewer than two placements of {fixture.poses} poses in "
                        f"each of its {POOL_PARTS} parts; give at least {2 * POOL_PARTS * fixture.ends * poses}."
                    )
                if fixture.poses > poses:
                    raise InputError(
                        f"{fixture.poses} poses are more than the pool has for a socket ({poses}); give a larger "
                        f"capture.pool than {pool}."
                    )
        _ = self.cell_values  # its checks


@lru_cache(maxsize=4)
def _derived(digest: str) -> dict[str, Any]:
    """What this process has derived from studies of one digest: filled by the first that is restored, shared by all."""
    return {}


def _restored(digest: str, contents: _Contents) -> Study:
    """A copied or unpickled study, with its own contents.

    What is derived from them depends on the digest alone: a worker receives the study with every block, and derives
    once.
    """
    study = object.__new__(Study)
    study._contents = contents
    shared = _derived(digest)
    if not shared:
        study._check()
        shared.update({name: value for name, value in vars(study).items() if name != "_contents"}, digest=digest)
    vars(study).update(shared)
    return study


def _picklable(specification: ArmSpecification) -> ArmSpecification:
    """The same arm file with a plain dict: its default for ``override``, a mapping proxy, cannot be pickled."""
    return specification._replace(override=dict(specification.override))


def pool_capacity(study: Study, fixture: Fixture) -> tuple[int, int]:
    """Placements of a fixture in each part of its pool, and poses at each of its ends (a power of two)."""
    rows = study.specification.capture.pool // (POOL_PARTS * fixture.ends)
    if fixture.points is not None:
        return 1, 2 ** int(math.log2(rows))
    poses = max(2 ** math.ceil(math.log2(1.25 * study.most_poses[fixture.ends])), 16)
    return rows // poses, poses


def _centroids(arm: Arm, capture: Capture) -> list[Point]:
    tips, ends = np.asarray(arm.position(capture.q)), np.cumsum(capture.sizes)
    return [tuple(tips[end - size : end].mean(axis=0).tolist()) for size, end in zip(capture.sizes, ends, strict=True)]


def _reference_fixtures(cell: Mapping[str, Any], region: Region | None) -> list[Fixture]:
    if "reference.poses" not in cell:
        return []
    poses, region = cell["reference.poses"], cell.get("reference.region", region)
    if "reference.ends_mm" in cell:
        pairs = cell["reference.ends_mm"]
        return [Fixture(f"L{i + 1}", poses, (tuple(a), tuple(b))) for i, (a, b) in enumerate(pairs)]
    length = cell["reference.length_mm"]
    return [Fixture(f"L{i + 1}", poses, None, region, length) for i in range(cell["reference.positions"])]
