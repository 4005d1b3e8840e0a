"""The manifest of a capture (TOML): which text files hold which socket or observation, in which unit; the lengths."""

import datetime
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    FiniteFloat,
    NonNegativeFloat,
    PositiveFloat,
    create_model,
    model_validator,
)

from ..acceptance.standards import Standard
from ..core.errors import InputError, naming
from ..core.text import shorten
from ..data.capture import Capture, ReferenceLength, check_readings, join_sessions
from ..data.observations.held import Socket
from ..data.observations.observation import AbstractObservation
from ..data.recording import ProbedSphere, Recording, SphereTest, checked_sphere
from ..kinematics.corrections import REFERENCE_TEMPERATURE
from .arms import arm_beside, read_arm, usual_noise, with_parameters
from .inputs import InputFile, InputFiles
from .manifest_angles import Angles, Readings
from .manifest_observations import Source, name_of, observations, parts
from .manifest_tables import FIELDS, TABLES, Picked, SocketTable, Table
from .outputs import as_path
from .patterns import check_fields, check_name, fields_of, fill, in_braces, matches
from .text_lines import TABLE_SHARE
from .toml import Strict, each_once, read_toml


class _Length(Strict):
    start: str = Field(alias="from")
    end: str = Field(alias="to")
    value: float
    u: NonNegativeFloat = 0.0
    expansion: FiniteFloat = 0.0  # of the artefact, 1/K
    temperature_C: FiniteFloat = REFERENCE_TEMPERATURE  # at which it was measured
    u_expansion: NonNegativeFloat = 0.0
    u_temperature: NonNegativeFloat = 0.0  # K

    def between(self, start: str, end: str) -> ReferenceLength:
        """The length between these sockets, as long as it was when it was measured."""
        return ReferenceLength.at_temperature(
            *(start, end, self.value, self.u),
            expansion=self.expansion,
            temperature=self.temperature_C,
            u_expansion=self.u_expansion,
            u_temperature=self.u_temperature,
        )


class _Sphere(Table):
    name: str
    test: SphereTest
    diameter: PositiveFloat
    u: NonNegativeFloat = 0.0
    stylus: NonNegativeFloat = 0.0
    form: NonNegativeFloat = 0.0
    u_form: NonNegativeFloat = 0.0


class _Points(Strict):
    unit: Literal["mm", "m", "um", "inch"] | None = None  # by default that of the header
    columns: Picked | None = None  # of x, y and z
    reach: PositiveFloat | None = None  # mm
    measuring_range: PositiveFloat | None = None  # diameter of the measuring volume as the maker states it, mm
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
    socket: list[SocketTable] = Field(default_factory=list)
    length: list[_Length] = Field(default_factory=list)
    sphere: list[_Sphere] = Field(default_factory=list)


class _Sessions(Strict):
    """What differs between the sessions that tables name."""

    probe: Literal["remounted", "same"] = "remounted"


class _Poses(_Recorded):
    arm: str
    base: str | None = None  # links of a URDF
    tip: str | None = None
    probe: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)] | None = None  # mm, from the tip link
    acceptance: Standard | Annotated[list[Standard], AfterValidator(each_once)] = Field(default_factory=list)
    measuring_range: PositiveFloat | None = None  # diameter of the measuring volume as the maker states it, mm
    angles: Angles | None = None
    sessions: _Sessions | None = None


PosesManifest: type[_Poses] = create_model("PosesManifest", __base__=_Poses, **FIELDS)


class PointsManifest(_Recorded):
    """A manifest of points instead of poses."""

    points: _Points

    @model_validator(mode="after")
    def _own_tip(self) -> "PointsManifest":
        for entry in (*self.socket, *self.sphere):
            seated = isinstance(entry, SocketTable) and (entry.target or entry.session)
            if seated or entry.temperature_C is not None:
                raise ValueError(
                    "target, session and temperature_C are for manifests of poses, but "
                    f"'{entry.name or entry.paths[0]}' has points, which say where the tip was; leave them out."
                )
        return self


def read_manifest(path: str | os.PathLike) -> Recording:
    """Read a manifest and every file it names; paths are relative to the manifest.

    A field in braces matches part of a path and makes one socket for each value found: with
    ``file = "run_1/{place}/hole_{hole}.csv"`` and ``name = "{place}/{hole}"``, the length ``from = "{place}/0"``,
    ``to = "{place}/1"`` is measured at every place. A field that makes up a whole folder or file name, such as
    ``{place}``, matches anything but "/"; next to other text in a name, as ``{hole}``, it matches letters, digits and
    "-" only, so that ``hole_0_pose.csv`` is left alone. ``exclude = ["*_old.csv"]`` in ``[[socket]]`` leaves out the
    files that match such a shell pattern. ``visits = "files"`` says that the tip was lifted between the ``files`` of a
    socket. Angles: reading -> sign * (reading - offset), in the stated unit. Readings of
    prismatic joints are in ``linear_unit`` of ``[angles]``, by default mm; sign and offset hold for them too.
    A column temperature_C, by that name in the header of every table, is the temperature of the arm, C;
    ``temperature_C = 22.5`` in a table of the manifest states it for all of its poses. In ``[[length]]`` it is that of
    the artefact, with its ``expansion`` (1/K), where ``value`` holds at 20 C.

    ``[[points]]``, ``[[transforms]]``, ``[[touched_sphere]]``, ``[[touched_cylinder]]``, ``[[plane]]``,
    ``[[parallel_planes]]``, ``[[artefact]]`` and ``[[distances]]`` are observations of these kinds. Their ``file``
    holds readings and measured values (or ``readings`` is a file of readings with as many rows).

    In all tables ``columns`` picks by header name, shell pattern or number, ``columns = { q = "q*_rad", points =
    ["x", "y", "z"] }``, or those of the readings alone, ``columns = ["J1", "J2", "J3"]``. Where nothing is stated, they
    are those with names of joints in the header, or all. ``units``, ``rotation``, ``coverage_factor``, ``delimiter``,
    ``decimal`` and ``skip`` say how they are written, ``group`` names a column that divides the table into several
    sockets or observations, and ``preset`` (csv, leica, xyzijk, ipa) fills in what is not stated. Units in the header
    must agree with those stated.

    ``session = "monday"`` in such tables, with fields in braces if needed, or ``columns = { session = "day" }`` for
    each row, makes sessions of one arm (`data.capture.join_sessions`); names are then ``monday/name``, in lengths too.
    ``[sessions] probe = "same"`` says that the probe was not remounted between them.
    ``acceptance`` (jjf, asme, iso, or a list) says for which standards' acceptance procedure the poses were taken, and
    ``measuring_range`` the diameter of the measuring volume that the arm's maker states, mm.

    ``arm`` is a shipped name, an arm file (TOML), a URDF, or a ``kinematics.yaml``. Of a URDF, ``base`` and ``tip``
    name the links at the ends of the chain; ``probe`` is a tool's tip in the last frame, mm, of an arm that states
    none. Where the arm's file names no free parameters, they are those that such observations determine.

    Args:
        path: the manifest (TOML).

    Returns:
        The recording: capture and nominal arm, in mm and rad, with the SHA-256 of each file.

    Raises:
        InputError: names the file, the place in it and what to do.

    Example:
        >>> from pathlib import Path
        >>> columns = "q1,q2,q3,q4,q5,q6"
        >>> np.savetxt("cone.csv", np.degrees(capture.sockets["A"]), delimiter=",", header=columns, comments="")
        >>> _ = Path("capture.toml").write_text('''arm = "cheng2018-simulation"
        ... angles = { unit = "deg" }
        ... socket = [{ name = "A", file = "cone.csv" }]
        ... ''')
        >>> print(aj.files.read_manifest("capture.toml").capture.sizes)
        (40,)
    """
    return _read(path)[0]


def readings_of_manifest(path: str | os.PathLike) -> Readings:
    """With which columns and unit the first table that a manifest names was read. Raises `InputError`."""
    return _read(path)[1]


def _read(path: str | os.PathLike) -> tuple[Recording, Readings]:
    model = read_toml(manifest := InputFile(path), PosesManifest)
    path = as_path(path)
    with naming(path):
        arm = arm_beside(path.parent, model.arm)
        nominal, proposed = read_arm(arm, base=model.base, tip=model.tip, probe=model.probe)
        files = InputFiles(manifest, TABLE_SHARE)
        readings = Readings(nominal.arm, model.angles)
        source = Source(path.parent, files.open, "q", readings)
        recorded = read_recorded(model, source)
        # Where another tip than the arm's own probe was held, it is an observation.
        seats = [seated for seated in recorded.sockets.values() if not seated.target]
        targets = [seated for seated in recorded.sockets.values() if seated.target]
        observed: list[tuple[str, AbstractObservation]] = [
            (seated.session, Socket(seated.name, seated.poses, target=seated.target)) for seated in targets
        ]
        for kind in TABLES:
            for entry in () if kind is Socket else getattr(model, kind.table):
                for values in _fields(path.parent, entry, kind.table):
                    observed += observations(source, kind, entry, values)
        if not seats and not observed:
            raise InputError("there is neither a [[socket]] nor another observation; add one.")
        if any(seated.session for seated in seats) or any(session for session, _ in observed):
            remounted = (model.sessions or _Sessions()).probe == "remounted"
            capture = _in_sessions(seats, recorded.lengths, observed, remounted)
        elif model.sessions is not None:
            raise InputError("[sessions] is for tables with a session, but there is none; leave it out.")
        else:
            capture = _capture(seats, recorded.lengths, [observation for _, observation in observed])
        if capture.columns == nominal.arm.joints + 1:
            nominal = nominal._replace(arm=nominal.arm.replace(thermometer=True))
        check_readings(capture, nominal.arm)
        recording = Recording(
            capture,
            nominal if proposed else with_parameters(nominal, capture),
            spheres=recorded.spheres,
            sources=files.sources(path.parent),
            measured=str(model.date or ""),
            acceptance=(model.acceptance,) if isinstance(model.acceptance, str) else tuple(model.acceptance),
            measuring_range=model.measuring_range,
            usual=usual_noise(arm, base=model.base, tip=model.tip),
        )
        return recording, readings


class Seated(NamedTuple):
    """The poses of one socket."""

    session: str  # empty where there are none
    name: str  # within its session
    poses: np.ndarray
    target: str
    visits: np.ndarray | None


class Recorded(NamedTuple):
    """The sockets, lengths and spheres that a manifest names; names of sockets begin with their session."""

    sockets: dict[str, Seated]
    lengths: list[ReferenceLength]
    spheres: tuple[ProbedSphere, ...]


def read_recorded(model: _Recorded, source: Source) -> Recorded:
    """Read the tables of sockets and spheres of a manifest. Raises `InputError`."""
    sockets: dict[str, Seated] = {}
    fields: list[dict[str, str]] = []
    for entry in model.socket:
        for values in _fields(source.folder, entry, "socket"):
            fields.append(values)
            for seated in _seated(source, entry, values):
                name = "/".join(filter(None, (seated.session, seated.name)))
                check_name(name)
                if name in sockets:
                    raise InputError(f"socket '{name}' is defined twice; give its files in one [[socket]].")
                sockets[name] = seated
    spheres = []
    for entry in model.sphere:
        if any((entry.name, entry.test) == (other.name, other.test) for other in spheres):
            raise InputError(f"sphere '{entry.name}' is defined twice for one test; give its files in one [[sphere]].")
        # A group is a repeat, or an orientation: a file, or the rows of one value in the column of groups.
        groups = [
            part.rows[source.quantity][part.files == file]
            for part in parts(source, Socket, entry, {}, f"[[sphere]] '{entry.name}'")
            for file in dict.fromkeys(part.files.tolist())
        ]
        numbers = (entry.diameter, entry.u, entry.stylus, entry.form, entry.u_form)
        spheres.append(checked_sphere(ProbedSphere(entry.name, entry.test, tuple(groups), *numbers)))
    return Recorded(sockets, _lengths(model.length, fields, sockets), tuple(spheres))


def _seated(source: Source, entry: SocketTable, values: Mapping[str, str]) -> Iterator[Seated]:
    """The sockets of one entry: one, or one for each session and group."""
    stated = name_of(entry, values)
    named = "" if entry.name is None and entry.group is not None else stated
    for part in parts(source, Socket, entry, values, f"[[socket]] '{stated}'"):
        name = "/".join(filter(None, (named, part.group)))
        visits = None if entry.visits is None else part.files
        yield Seated(part.session, name, part.rows[source.quantity], part.rows.get("target", ""), visits)


def _capture(
    seats: Sequence[Seated], lengths: Sequence[ReferenceLength], observed: Sequence[AbstractObservation]
) -> Capture:
    visits = {seated.name: seated.visits for seated in seats if seated.visits is not None}
    return Capture({seated.name: seated.poses for seated in seats}, lengths, observed, visits=visits or None)


def _in_sessions(
    seats: Sequence[Seated],
    lengths: Sequence[ReferenceLength],
    observed: Sequence[tuple[str, AbstractObservation]],
    remounted: bool,
) -> Capture:
    """One capture of all sessions, each but the first with a probe of its own where that was ``remounted``."""
    items = [*((seated.session, seated.name) for seated in seats), *((key, item.name) for key, item in observed)]
    without = [name for session, name in items if not session]
    if without:
        raise InputError(f"{shorten(without)} has no session, but other tables have; state it for every table.")
    lengths_of: dict[str, list[ReferenceLength]] = {session: [] for session, _ in items}
    for length in lengths:  # named session/name
        ends = (length.start, length.end)
        session = next((name for name in lengths_of if all(end.startswith(f"{name}/") for end in ends)), "")
        if not session:
            raise InputError(
                f"length from '{length.start}' to '{length.end}' is not between two sockets of one session; name them "
                "session/name."
            )
        start, end = (end.removeprefix(f"{session}/") for end in ends)
        lengths_of[session].append(ReferenceLength(start, end, length.value, length.u))
    captures = {}
    for session, between in lengths_of.items():
        observed_then = [observation for key, observation in observed if key == session]
        captures[session] = _capture([seated for seated in seats if seated.session == session], between, observed_then)
    return join_sessions(captures, own_probe=remounted)


def _fields(folder: Path, entry: Any, table: str) -> Iterator[dict[str, str]]:
    """The values of the fields in braces of one entry, for all files that match; nothing in them where it has none."""
    if not entry.paths:
        yield {}
        return
    first, name = entry.paths[0], entry.name or ""
    for text in (name, *entry.paths):
        check_fields(text)
    fields = fields_of(first)
    # A field that names the session need not be in the name.
    of_session = fields_of(getattr(entry, "session", None) or "") & fields
    if not name and fields:
        line = "/".join(f"{{{field}}}" for field in sorted(fields - of_session))
        raise InputError(f"file '{first}' has {in_braces(fields)}, so add name = \"{line}\" in [[{table}]].")
    for what, text, known in (("name", name, of_session), *(("file", file, set()) for file in entry.paths[1:])):
        if fields_of(text) | known != fields:
            raise InputError(
                f"{table} {what} '{text}' has {in_braces(fields_of(text))}, but file '{first}' has "
                f"{in_braces(fields)}; use the same fields in the name and in every file."
            )
    if entry.exclude and not fields:
        raise InputError(f"exclude is for files with a field in braces, but '{first}' has none; leave it out.")
    yield from matches(folder, first, entry.exclude) if fields else [{}]


def _lengths(
    entries: Sequence[_Length], fields: Sequence[dict[str, str]], sockets: Mapping[str, Seated]
) -> list[ReferenceLength]:
    """Reference lengths; one with fields in braces gives every combination that the sockets' files have."""
    lengths = []
    for entry in entries:
        check_fields(entry.start)
        check_fields(entry.end)
        names = fields_of(entry.start) | fields_of(entry.end)
        choices = {tuple((name, values[name]) for name in sorted(names)) for values in fields if names <= values.keys()}
        if not choices and names:
            raise InputError(
                f"length from '{entry.start}' to '{entry.end}' uses a field that no [[socket]] has; "
                "name the fields alike."
            )
        choices = choices if names else {()}
        pairs = [(fill(entry.start, dict(choice)), fill(entry.end, dict(choice))) for choice in sorted(choices)]
        # The field may also be in the names of sockets that this length is not between.
        between = [pair for pair in pairs if set(pair) & sockets.keys()]
        lengths += [entry.between(*pair) for pair in between or pairs]
    # Repeated measurements have other values, or are named in the other direction.
    given = [(length.start, length.end, float(length.value)) for length in lengths]
    for start, end, value in given:
        if given.count((start, end, value)) > 1:
            raise InputError(f"length from '{start}' to '{end}' of {value:g} mm is given twice; give it once.")
    return lengths
