"""The manifest of a capture (TOML): which text files hold which socket, in which unit, and the lengths."""

import datetime
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    FiniteFloat,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    model_validator,
)

from ..core.errors import InputError
from ..core.units import ARCSEC, DEG
from ..data.capture import Capture, ReferenceLength
from ..data.recording import Recording
from ..data.sphere import ProbedSphere, SphereTest, checked_sphere
from .arms import load_specification
from .inputs import InputFile, fingerprint
from .outputs import as_path
from .patterns import check_fields, check_name, fields_of, fill, in_braces, matches
from .text_table import read_numbers
from .toml import Strict, each_once, read_toml

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_UNITS = {"rad": 1.0, "deg": DEG, "arcsec": ARCSEC}


class _Angles(Strict):
    unit: Literal["rad", "deg", "arcsec", "counts"]
    counts_per_turn: _Positive | Annotated[list[_Positive], Field(min_length=1)] | None = None
    sign: Literal[1, -1] | list[Literal[1, -1]] = 1
    offset: FiniteFloat | list[FiniteFloat] = 0.0
    columns: Annotated[list[PositiveInt], AfterValidator(each_once)] | None = None

    @model_validator(mode="after")
    def _counts(self) -> "_Angles":
        if (self.unit == "counts") != (self.counts_per_turn is not None):
            raise ValueError("give counts_per_turn with unit = 'counts', and only with it.")
        return self


class _Files(Strict):
    """What is recorded in one file, or in several."""

    file: str | None = None
    files: Annotated[list[str], Field(min_length=1), AfterValidator(each_once)] | None = None

    @property
    def paths(self) -> list[str]:
        return [self.file] if self.file is not None else list(self.files or ())


class _Socket(_Files):
    name: str | None = None
    exclude: list[str] = Field(default_factory=list)

    @model_validator(mode="after")
    def _one(self) -> "_Socket":
        if (self.file is None) == (self.files is None):
            raise ValueError("a socket needs either file or files.")
        if self.files is not None and self.name is None:
            raise ValueError("a socket of several files needs a name.")
        return self


class _Length(Strict):
    start: str = Field(alias="from")
    end: str = Field(alias="to")
    value: float
    u: NonNegativeFloat = 0.0


class _Sphere(_Files):
    name: str
    test: SphereTest
    diameter: PositiveFloat
    u: NonNegativeFloat = 0.0
    stylus: NonNegativeFloat = 0.0
    form: NonNegativeFloat = 0.0

    @model_validator(mode="after")
    def _one(self) -> "_Sphere":
        if (self.file is None) == (self.files is None):
            raise ValueError("a sphere needs either file or files (one for each repeat, or orientation).")
        return self


class _Points(Strict):
    unit: Literal["mm", "m", "um", "inch"]
    columns: Annotated[list[PositiveInt], Field(min_length=3, max_length=3), AfterValidator(each_once)] | None = None
    reach: PositiveFloat | None = None  # mm
    shoulder: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)] | None = None  # mm

    @model_validator(mode="after")
    def _both(self) -> "_Points":
        if (self.reach is None) != (self.shoulder is None):
            raise ValueError(
                "give reach and shoulder together: zones are distances from the shoulder, in the points' frame."
            )
        return self


def _day(value: Any) -> Any:
    return value.date() if isinstance(value, datetime.datetime) else value


class _Recorded(Strict):
    """What manifests of poses and of points have in common."""

    date: Annotated[datetime.date, Field(strict=False), BeforeValidator(_day)] | None = None  # when it was recorded
    socket: list[_Socket] = Field(default_factory=list)
    length: list[_Length] = Field(default_factory=list)
    sphere: list[_Sphere] = Field(default_factory=list)


class _Manifest(_Recorded):
    arm: str
    angles: _Angles
    socket: Annotated[list[_Socket], Field(min_length=1)]  # pyright: ignore[reportGeneralTypeIssues]


class PointsManifest(_Recorded):
    """A manifest of points instead of poses."""

    points: _Points


def read_manifest(path: str | os.PathLike) -> Recording:
    """Read a manifest and every file it names; paths are relative to the manifest.

    A field in braces matches part of a path and makes one socket for each value found: with
    ``file = "run_1/{place}/hole_{hole}.csv"`` and ``name = "{place}/{hole}"``, the length ``from = "{place}/0"``,
    ``to = "{place}/1"`` is measured at every place. A field that makes up a whole folder or file name, such as
    ``{place}``, matches anything but "/"; next to other text in a name, as ``{hole}``, it matches letters, digits and
    "-" only, so that ``hole_0_pose.csv`` is left alone. ``exclude = ["*_old.csv"]`` in ``[[socket]]`` leaves out the
    files that match such a shell pattern. Angles: reading -> sign * (reading - offset), in the stated unit.

    Args:
        path: the manifest (TOML).

    Returns:
        The recording: capture and nominal arm, in mm and rad, with the SHA-256 of each file.

    Raises:
        InputError: names the file, the place in it and what to do.
    """
    path = as_path(path)
    model = read_toml(manifest := InputFile(path), _Manifest)
    try:
        nominal = load_specification(_arm_source(path, model.arm))
        joints = nominal.arm.joints
        if model.angles.columns is not None and len(model.angles.columns) != joints:
            raise InputError(
                f"angles.columns picks {len(model.angles.columns)} columns, but the arm has {joints} joints; "
                "pick one a joint."
            )
        files = [manifest]

        def angles(file: Path) -> np.ndarray:
            files.append(read := InputFile(file))
            table = read_numbers(read, model.angles.columns)
            if table.shape[1] != joints:
                raise InputError(
                    f"{file} has {table.shape[1]} columns, but the arm has {joints} joints; give one column a joint, "
                    "or pick them with columns = [...] in [angles]."
                )
            return _radians(table, model.angles)

        sockets, lengths, spheres = recorded(path.parent, model, angles)
        sources = tuple(fingerprint(file, path.parent) for file in files)
        return Recording(
            Capture(sockets, lengths), nominal, spheres=spheres, sources=sources, measured=str(model.date or "")
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def recorded(
    folder: Path, model: _Recorded, read: Callable[[Path], np.ndarray]
) -> tuple[dict[str, np.ndarray], list[ReferenceLength], tuple[ProbedSphere, ...]]:
    """The sockets, lengths and spheres that a manifest names, each file read by ``read``."""
    sockets: dict[str, np.ndarray] = {}
    fields: list[dict[str, str]] = []
    for entry in model.socket:
        for name, files, values in _expand(folder, entry):
            check_name(name)
            if name in sockets:
                raise InputError(f"socket '{name}' is defined twice; give its files in one [[socket]].")
            sockets[name] = np.concatenate([read(file) for file in files])
            fields.append(values)
    spheres = []
    for entry in model.sphere:
        if any((entry.name, entry.test) == (other.name, other.test) for other in spheres):
            raise InputError(f"sphere '{entry.name}' is defined twice for one test; give its files in one [[sphere]].")
        groups = tuple(read(folder / file) for file in entry.paths)
        sphere = ProbedSphere(entry.name, entry.test, groups, entry.diameter, entry.u, entry.stylus, entry.form)
        spheres.append(checked_sphere(sphere))
    return sockets, _lengths(model.length, fields, sockets), tuple(spheres)


def _arm_source(manifest: Path, arm: str) -> str | Path:
    file = manifest.parent / arm
    return file if arm.endswith(".toml") or os.path.isfile(file) else arm


def _radians(readings: np.ndarray, angles: _Angles) -> np.ndarray:
    joints = readings.shape[1]

    def a_joint(value: float | list, what: str) -> np.ndarray:
        array = np.asarray(value, dtype=float)
        if array.ndim and array.shape != (joints,):
            raise InputError(
                f"angles.{what} has {array.size} values, but there are {joints} joints; give one, or one a joint."
            )
        return array

    unit = (
        2 * math.pi / a_joint(angles.counts_per_turn, "counts_per_turn")
        if angles.counts_per_turn
        else _UNITS[angles.unit]
    )
    return a_joint(angles.sign, "sign") * (readings - a_joint(angles.offset, "offset")) * unit


def _expand(folder: Path, entry: _Socket) -> Iterator[tuple[str, list[Path], dict[str, str]]]:
    """Sockets of one entry: name, files and the values of its fields in braces."""
    first = entry.paths[0]
    for text in (entry.name or "", *entry.paths):
        check_fields(text)
    fields = fields_of(first)
    for what, text in (("name", entry.name or ""), *(("file", file) for file in entry.paths[1:])):
        if fields_of(text) != fields:
            raise InputError(
                f"socket {what} '{text}' has {in_braces(fields_of(text))}, but file '{first}' has {in_braces(fields)}; "
                "use the same fields in the name and in every file."
            )
    if not fields:
        if entry.exclude:
            raise InputError(f"exclude is for files with a field in braces, but '{first}' has none; leave it out.")
        yield Path(first).stem if entry.name is None else entry.name, [folder / file for file in entry.paths], {}
        return
    assert entry.name is not None  # its fields are those of the file
    for values in matches(folder, first, entry.exclude):
        yield fill(entry.name, values), [folder / fill(file, values) for file in entry.paths], values


def _lengths(
    entries: list[_Length], fields: list[dict[str, str]], sockets: Mapping[str, np.ndarray]
) -> list[ReferenceLength]:
    """Reference lengths; one with fields in braces gives every combination that the sockets' files have."""
    lengths = []
    for entry in entries:
        check_fields(entry.start)
        check_fields(entry.end)
        names = fields_of(entry.start) | fields_of(entry.end)
        if not names:
            lengths.append(ReferenceLength(entry.start, entry.end, entry.value, entry.u))
            continue
        choices = {tuple((name, values[name]) for name in sorted(names)) for values in fields if names <= values.keys()}
        if not choices:
            raise InputError(
                f"length from '{entry.start}' to '{entry.end}' uses a field that no [[socket]] has; "
                "name the fields alike."
            )
        pairs = [(fill(entry.start, dict(choice)), fill(entry.end, dict(choice))) for choice in sorted(choices)]
        # The field may also be in the names of sockets that this length is not between.
        known = [pair for pair in pairs if pair[0] in sockets or pair[1] in sockets]
        lengths += [ReferenceLength(*pair, entry.value, entry.u) for pair in known or pairs]
    # Repeated measurements have other values, or are named in the other direction.
    given = [(length.start, length.end, float(length.value)) for length in lengths]
    for start, end, value in given:
        if given.count((start, end, value)) > 1:
            raise InputError(f"length from '{start}' to '{end}' of {value:g} mm is given twice; give it once.")
    return lengths
