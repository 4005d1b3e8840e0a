"""A study with everything it needs: its specification, the nominal arm, perhaps a recording; and what each cell comes to."""

import hashlib
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..calibration.checks import check_enough
from ..calibration.scale_anchor import scale_anchor
from ..core.errors import InputError, nearest
from ..core.units import ARCSEC, DEG
from ..data.capture import Capture
from ..data.recording import Recording
from ..files.arms import load_specification, specification_toml
from ..files.captures import load_capture
from ..files.toml import read_toml
from ..files.whole_file import storable
from ..kinematics.arm import Arm, checked_limits, is_length
from ..kinematics.parameters import Parameters
from ..kinematics.specification import ArmSpecification, single
from .specification import Point, Region, Specification, checked, label

_KINDS = {"a": "a_mm", "d": "d_mm", "probe": "probe_mm", "alpha": "alpha_deg", "theta": "theta_deg", "beta": "beta_deg"}


@contextmanager
def _at(place: str) -> Iterator[None]:
    """Names the place in the specification that a refusal is about."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{place}: {error}") from error


class Stand(NamedTuple):
    """What holds the tip: a socket (one end), or a reference length with two."""

    name: str
    poses: int  # at each end
    points: tuple[Point, ...] | None  # where it stands, mm; or None: at random in the region
    region: Region | None = None
    length: float | None = None  # of a reference length at random, mm

    @property
    def ends(self) -> int:
        """Points that hold the tip."""
        return len(self.points) if self.points is not None else 1 if self.length is None else 2


class Setting(NamedTuple):
    """What fixes the compiled programs of a cell, and the poses it draws from."""

    stands: tuple[Stand, ...]
    limits: tuple[tuple[float, float], ...]  # rad
    hold: str | None
    method: str
    random_start: bool
    recorded: bool  # the poses are those of the recording

    @property
    def sizes(self) -> tuple[int, ...]:
        """Poses in each socket."""
        return tuple(stand.poses for stand in self.stands for _ in range(stand.ends))


class Numbers(NamedTuple):
    """What differs from cell to cell but compiles to the same program; the first axis is the cell. mm and rad."""

    width: Float[np.ndarray, "c p"]  # of the deviation
    normal: Bool[np.ndarray, "c p"]
    lower: Float[np.ndarray, "c p"]
    upper: Float[np.ndarray, "c p"]
    encoder: Float[np.ndarray, " c"]
    resolution: Float[np.ndarray, " c"]
    seating: Float[np.ndarray, " c"]
    eccentricity: Float[np.ndarray, " c"]
    u: Float[np.ndarray, " c"]  # of reference lengths; NaN: as recorded


class _Contents(NamedTuple):
    specification: Specification
    nominal: ArmSpecification
    recording: Recording | None


class Study:
    """A Monte Carlo study of calibrations: made by `make_study` and `read_study`, run by `run_study`.

    Immutable; pickles to its contents, so that it can be sent to workers.
    """

    def __init__(self, specification: Specification, nominal: ArmSpecification, recording: Recording | None = None):
        self._contents = _Contents(specification, nominal._replace(arm=single(nominal.arm)), recording)
        self._check()

    def __reduce__(self):
        return _restored, (self.digest + self.specification.name, *self._contents)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Study) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def specification(self) -> Specification:
        """What was asked."""
        return self._contents.specification

    @property
    def nominal(self) -> ArmSpecification:
        """The nominal arm."""
        return self._contents.nominal

    @property
    def recording(self) -> Recording | None:
        """The capture whose poses are used, where the study names one."""
        return self._contents.recording

    @property
    def capture(self) -> Capture | None:
        """The capture of the recording."""
        return None if self.recording is None else self.recording.capture

    @property
    def trials(self) -> int:
        """Trials in each cell."""
        return self.specification.trials

    @cached_property
    def cells(self) -> list[dict[str, Any]]:
        """The grid: of each cell, every level by its dotted name."""
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
        """The free parameters, on the nominal arm."""
        held = self.specification.identification.held
        with _at("identification.held"):
            return Parameters.free_of(self.nominal.arm, held=self.nominal.held if held is None else held)

    @cached_property
    def _lengths(self) -> Bool[np.ndarray, " p"]:
        return self.space.lengths

    @cached_property
    def _vector(self) -> Float[np.ndarray, " p"]:
        return np.asarray(self.space.vector())

    @cached_property
    def digest(self) -> str:
        """Two studies with the same digest give the same numbers."""
        arm = specification_toml(self.nominal._replace(name=""))
        content = [self.specification.model_dump_json(exclude={"name", "arm"}), arm]
        if self.capture is not None:
            lengths = [(r.start, r.end, float(r.value), float(r.u)) for r in self.capture.lengths]
            content += [np.asarray(self.capture.q).tobytes().hex(), repr((self.capture.names, self.capture.sizes, lengths))]
        return hashlib.sha256("\n".join(content).encode()).hexdigest()

    @cached_property
    def settings(self) -> list[Setting]:
        """The setting of each cell."""
        holds = {name: self._hold(name) for name in dict.fromkeys(cell["identification.hold"] for cell in self.cells)}
        recorded = self._recorded_stands()
        return [self._setting(cell, holds[cell["identification.hold"]], recorded) for cell in self.cells]

    @cached_property
    def eccentric(self) -> bool:
        """Whether any cell has eccentric encoders (their sines are then computed for all)."""
        return bool(np.any(self.numbers.eccentricity > 0))

    @cached_property
    def numbers(self) -> Numbers:
        """The numbers of all cells."""
        return Numbers(*(np.array(column) for column in zip(*map(self._numbers, self.cells), strict=True)))

    @cached_property
    def most_poses(self) -> dict[int, int]:
        """The most poses that any cell takes at an end, of sockets (1) and of reference lengths (2)."""
        stands = {stand for setting in dict.fromkeys(self.settings) for stand in setting.stands}
        return {ends: max((stand.poses for stand in stands if stand.ends == ends), default=0) for ends in (1, 2)}

    def _recorded_stands(self) -> tuple[Stand, ...] | None:
        if self.capture is None:
            return None
        rows = zip(self.capture.names, self.capture.sizes, _centroids(self.nominal.arm, self.capture), strict=True)
        return tuple(Stand(name, size, (point,)) for name, size, point in rows)

    def _setting(self, cell: Mapping[str, Any], hold: str | None, recorded: tuple[Stand, ...] | None) -> Setting:
        arm, method, random_start = self.nominal.arm, self._method(cell), cell["identification.start"] == "random"
        if recorded is not None:
            return Setting(recorded, (), hold, method, random_start, recorded=True)
        region, poses = cell.get("capture.region"), cell["capture.poses"]
        points = cell.get("capture.positions_mm")
        if points is not None:
            stands = [Stand(f"S{i + 1}", poses, (tuple(point),)) for i, point in enumerate(points)]
        else:
            stands = [Stand(f"S{i + 1}", poses, None, region) for i in range(cell["capture.sockets"])]
        stands += _reference_stands(cell, region)
        degrees = cell.get("capture.joint_limits_deg")
        if degrees is not None and len(degrees) != arm.joints:
            raise InputError(
                f"capture.joint_limits_deg has {len(degrees)} rows, but the arm has {arm.joints} joints; give [lowest, highest] "
                "for each."
            )
        rows = arm.limits if degrees is None else [[math.radians(x) for x in pair] for pair in degrees]
        limits = checked_limits([(-math.pi, math.pi)] * arm.joints if rows is None else rows, arm.joints)
        return Setting(tuple(stands), tuple((float(a), float(b)) for a, b in limits), hold, method, random_start, False)

    def _method(self, cell: Mapping[str, Any]) -> str:
        if "identification.method" in cell:
            return cell["identification.method"]
        has_lengths = bool(self.capture.lengths) if self.capture is not None else self.specification.reference is not None
        return "two-stage" if has_lengths else "stage1"

    def _hold(self, hold: str) -> str | None:
        with _at("identification.hold"):
            return scale_anchor(self.space, self.nominal.arm, None if hold == "none" else hold).hold

    def _numbers(self, cell: Mapping[str, Any]) -> tuple:
        space, nominal, table = self.space, self.nominal, self.specification.bounds
        deviations = [_deviation(cell, name) for name in space.names]
        factor = np.where(self._lengths, 1.0, DEG)
        width = factor * [one.uniform if one.normal is None else one.normal for one in deviations]
        length, angle = cell.get("bounds.length_mm"), cell.get("bounds.angle_deg")
        length = nominal.length if length is None else length
        angle = nominal.angle if angle is None else math.radians(angle)
        half = np.where(self._lengths, length, angle)
        for name, value in (nominal.override if table.override is None else table.override).items():
            if table.override is not None or name in space.names:
                with _at("bounds.override"):
                    half[space.index(name)] = value if table.override is None else value * factor[space.index(name)]
        shift = np.where(self._lengths, cell["bounds.length_shift_mm"], math.radians(cell["bounds.angle_shift_deg"]))
        noise = [cell[f"noise.{name}"] for name in ("encoder_arcsec", "resolution_arcsec", "seating_mm", "eccentricity_arcsec")]
        return (
            width,
            [one.normal is not None for one in deviations],
            self._vector - half + shift,
            self._vector + half + shift,
            *(value * (1.0 if i == 2 else ARCSEC) for i, value in enumerate(noise)),
            cell.get("reference.u_mm", math.nan),
        )

    def _check(self) -> None:
        """Everything that can be known to be wrong before work starts, but for what cannot be reached."""
        recorded = self.capture is not None
        if recorded and self.specification.reference is not None:
            raise InputError("the capture file brings its reference lengths; leave [reference] out.")
        if recorded and self.capture.joints != self.nominal.arm.joints:  # pyright: ignore[reportOptionalMemberAccess]
            raise InputError("the capture and the arm differ in their number of joints; name the arm that recorded it.")
        unknowns = len(self.space.names) - int(self.space.lengths.any())
        for setting in dict.fromkeys(self.settings):
            check_enough(setting.sizes, unknowns)
            if setting.method != "stage1" and recorded and not self.capture.lengths:  # pyright: ignore
                raise InputError("the capture file holds no reference length; use method = 'stage1', or another file.")
            for stand in () if recorded else setting.stands:
                placements, poses = pose_choice(self, stand)
                if stand.points is None and placements < 2:
                    raise InputError(
                        f"a capture.pool of {self.specification.capture.pool} poses has room for less than two places of "
                        f"{stand.poses} poses in each of its {BATCHES} parts; give at least {2 * BATCHES * stand.ends * poses}."
                    )
                if stand.poses > poses:
                    raise InputError(
                        f"{stand.poses} poses are more than the pool has for a socket ({poses}); give a "
                        f"larger capture.pool than {self.specification.capture.pool}."
                    )
        _ = self.numbers  # its checks


@lru_cache(maxsize=4)
def _known(digest: str, contents: "_Lazy") -> Study:
    return Study(*contents.contents)


class _Lazy:
    """Contents that count as equal to any others, so that the digest alone decides what is known."""

    def __init__(self, contents: tuple):
        self.contents = contents

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Lazy)

    def __hash__(self) -> int:
        return 0


def _restored(digest: str, *contents: Any) -> Study:
    """A pickled study: the one that this process has already, where it has, with all that it has worked out."""
    return _known(digest, _Lazy(contents))


BATCHES = 32  # independent pools; trial t draws from pool t modulo this


def pose_choice(study: Study, stand: Stand) -> tuple[int, int]:
    """Placements of a stand in each batch's pool, and poses at each of its ends (a power of two)."""
    share = study.specification.capture.pool // (BATCHES * stand.ends)
    if stand.points is not None:
        return 1, 2 ** int(math.log2(share))
    poses = max(2 ** math.ceil(math.log2(1.25 * study.most_poses[stand.ends])), 16)
    return share // poses, poses


def _centroids(arm: Arm, capture: Capture) -> list[Point]:
    tips, ends = np.asarray(arm.position(capture.q)), np.cumsum(capture.sizes)
    return [tuple(tips[end - size : end].mean(axis=0).tolist()) for size, end in zip(capture.sizes, ends, strict=True)]


def _reference_stands(cell: Mapping[str, Any], region: Region | None) -> list[Stand]:
    if "reference.poses" not in cell:
        return []
    poses, region = cell["reference.poses"], cell.get("reference.region", region)
    if "reference.ends_mm" in cell:
        pairs = cell["reference.ends_mm"]
        return [Stand(f"L{i + 1}", poses, (tuple(a), tuple(b))) for i, (a, b) in enumerate(pairs)]
    length = cell["reference.length_mm"]
    return [Stand(f"L{i + 1}", poses, None, region, length) for i in range(cell["reference.positions"])]


def _deviation(cell: Mapping[str, Any], name: str) -> Any:
    """The distribution of one free parameter: that of its kind, else that of all lengths or angles."""
    general = "length_mm" if is_length(name) else "angle_deg"
    return cell.get(f"deviation.{_KINDS[name.rpartition('_')[0]]}", cell[f"deviation.{general}"])


def study_of_file(path: str | os.PathLike) -> Study:
    """Read a study's specification (TOML); the arm and the capture it names lie beside it, or ship with the package.

    Raises `InputError` that names the file, the place in it and the mend.
    """
    path = Path(path)
    specification = read_toml(path, Specification)
    if not specification.arm and specification.capture.file is None:
        raise InputError(f"{path}: 'arm' is missing; add it.")
    try:
        recording = None
        if specification.capture.file is not None:
            recording = load_capture(path.parent / specification.capture.file)
        nominal = recording.nominal if recording is not None and not specification.arm else _arm(path.parent, specification.arm)
        return Study(specification, nominal, recording)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _arm(folder: Path, name: str) -> ArmSpecification:
    beside = folder / name
    return load_specification(beside if name.endswith(".toml") or beside.is_file() else name)


def make_study(
    *,
    arm: Arm | ArmSpecification | str | os.PathLike,
    trials: int,
    capture: Capture | Mapping[str, Any],
    seed: int = 0,
    name: str = "",
    **tables: Mapping[str, Any],
) -> Study:
    """A study from Python: ``deviation``, ``noise``, ``bounds``, ``reference`` and ``identification`` are tables as in TOML.

    ``arm`` is an arm, a shipped name or a file; ``capture`` a table, or a `Capture` whose poses are used. Any value of a
    table may be a list; the study is their grid. Raises `InputError` in one sentence.
    """
    nominal = arm if isinstance(arm, ArmSpecification) else ArmSpecification(arm) if isinstance(arm, Arm) else None
    nominal = load_specification(arm) if nominal is None else nominal  # pyright: ignore[reportArgumentType]
    unknown = [key for key in tables if key not in ("deviation", "noise", "bounds", "reference", "identification")]
    if unknown:
        known = ["deviation", "noise", "bounds", "reference", "identification"]
        raise InputError(f"a study has no table '{unknown[0]}'{nearest(unknown[0], known)}")
    recording = None
    if isinstance(capture, Capture):
        recording, capture = Recording(capture, nominal), {"file": "(in memory)"}
    elif not isinstance(capture, Mapping):
        raise InputError(f"capture is a {type(capture).__name__}; give a table (positions_mm, sockets or file), or a Capture.")
    elif capture.get("file") is not None:
        recording = load_capture(capture["file"])
    specification = checked(name=storable(name), arm=nominal.name, trials=trials, seed=seed, capture=capture, **tables)
    return Study(specification, nominal, recording)


class Block(NamedTuple):
    """Trials of some cells: all of one setting."""

    first_cell: int
    last_cell: int  # not included
    first_trial: int
    last_trial: int  # not included

    @property
    def size(self) -> int:
        """How many trials it holds."""
        return (self.last_cell - self.first_cell) * (self.last_trial - self.first_trial)
