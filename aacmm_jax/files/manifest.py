"""The manifest of a capture (TOML): which text files hold which socket or observation, in which unit; the lengths.

A manifest of points, instead of poses, is for acceptance tests of arms that report coordinates.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..acceptance.results import Measured
from ..core.errors import InputError, naming, nearest
from ..core.text import shorten
from ..data.capture import Capture, ReferenceLength, check_readings, join_sessions
from ..data.observations.held import Socket
from ..data.observations.observation import AbstractObservation
from ..data.recording import ProbedSphere, Recording, checked_sphere
from ..kinematics.workspace import Reach
from .arms import arm_beside, read_arm, usual_noise, with_parameters
from .inputs import InputFile
from .manifest_rows import Readings, Source, name_of, parts, points_of
from .manifest_tables import TABLES, Length, PointsManifest, PosesManifest, Recorded, Sessions
from .outputs import as_path
from .patterns import check_fields, check_name, fields_of, fill, in_braces, matches
from .toml import read_toml


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
        Capture and nominal arm, in mm and rad, with the SHA-256 of each file.

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
        readings = Readings(nominal.arm, model.angles)
        source = Source(manifest, "q", readings)
        sockets, lengths, spheres = _read_recorded(model, source)
        # Where another tip than the arm's own probe was held, it is an observation.
        seats = [seated for seated in sockets.values() if not seated.target]
        observed: list[tuple[str, AbstractObservation]] = [
            (seated.session, Socket(seated.name, seated.poses, target=seated.target))
            for seated in sockets.values()
            if seated.target
        ]
        for kind in TABLES:
            for entry in () if kind is Socket else getattr(model, kind.table):
                for values in _fields(path.parent, entry, kind.table):
                    name = name_of(entry, values)
                    for part in parts(source, kind, entry, values, f"[[{kind.table}]] '{name}'"):
                        named = f"{name}/{part.group}" if entry.group is not None else name
                        observed.append((part.session, kind.rebuilt(named, part.rows)))
        if not seats and not observed:
            raise InputError("there is neither a [[socket]] nor another observation; add one.")
        if any(seated.session for seated in seats) or any(session for session, _ in observed):
            remounted = (model.sessions or Sessions()).probe == "remounted"
            capture = _in_sessions(seats, lengths, observed, remounted)
        elif model.sessions is not None:
            raise InputError("[sessions] is for tables with a session, but there is none; leave it out.")
        else:
            capture = _capture(seats, lengths, [observation for _, observation in observed])
        if capture.columns == nominal.arm.joints + 1:
            nominal = nominal._replace(arm=nominal.arm.replace(thermometer=True))
        check_readings(capture, nominal.arm)
        recording = Recording(
            capture,
            nominal if proposed else with_parameters(nominal, capture),
            spheres=spheres,
            sources=source.fingerprints(),
            measured=str(model.date or ""),
            acceptance=(model.acceptance,) if isinstance(model.acceptance, str) else tuple(model.acceptance),
            measuring_range=model.measuring_range,
            usual=usual_noise(arm, base=model.base, tip=model.tip),
        )
        return recording, readings


def read_points(path: str | os.PathLike) -> Measured:
    """Read a manifest of points and every file that it names; paths are relative to the manifest.

    ``[points]`` has ``unit`` (mm, m, um, inch; by default that of the header), optionally ``columns`` of x, y and z,
    the ``measuring_range`` that the maker states (a diameter, mm), and, for the zones of ASME B89.4.22, the arm's
    ``reach`` and ``shoulder`` (x, y, z) in mm. ``[[socket]]``, ``[[length]]`` and ``[[sphere]]`` are those of
    `read_manifest`, with files of x, y, z: columns of these names, or the only three.

    Args:
        path: the manifest (TOML).

    Returns:
        The measured points, mm.

    Raises:
        InputError: names the file, the place in it and what to do.

    Example:
        >>> from pathlib import Path
        >>> np.savetxt("near.csv", true.position(capture.sockets["A"]), delimiter=",")
        >>> _ = Path("points.toml").write_text('''[points]
        ... unit = "mm"
        ... [[socket]]
        ... name = "near"
        ... file = "near.csv"
        ... ''')
        >>> print(aj.files.read_points("points.toml").sockets["near"].shape)
        (40, 3)
    """
    model = read_toml(manifest := InputFile(path), PointsManifest)
    stated = model.points
    with naming(as_path(path)):
        source = Source(manifest, "points", lambda text, wanted: points_of(text, wanted, stated))
        seated, lengths, spheres = _read_recorded(model, source)
        for length in lengths:
            for end in (length.start, length.end):
                if end not in seated:
                    raise InputError(
                        f"length '{length.start}' to '{length.end}' names the unknown socket '{end}'"
                        f"{nearest(end, seated)}"
                    )
        if not seated and not spheres:
            raise InputError("there is neither a [[socket]] nor a [[sphere]], so nothing can be tested; add one.")
        return Measured(
            {name: socket.poses for name, socket in seated.items()},
            tuple(lengths),
            spheres,
            None if stated.reach is None else Reach(np.array(stated.shoulder), stated.reach),
            sources=source.fingerprints(),
            measured=str(model.date or ""),
            measuring_range=stated.measuring_range,
        )


class _Seated(NamedTuple):
    """The poses of one socket."""

    session: str  # empty where there are none
    name: str  # within its session
    poses: np.ndarray
    target: str
    visits: np.ndarray | None


def _read_recorded(
    model: Recorded, source: Source
) -> tuple[dict[str, _Seated], list[ReferenceLength], tuple[ProbedSphere, ...]]:
    """The sockets, lengths and spheres that a manifest names; names of sockets begin with their session."""
    sockets: dict[str, _Seated] = {}
    fields: list[dict[str, str]] = []
    for entry in model.socket:
        for values in _fields(source.folder, entry, "socket"):
            fields.append(values)
            stated = name_of(entry, values)
            named = "" if entry.name is None and entry.group is not None else stated
            for part in parts(source, Socket, entry, values, f"[[socket]] '{stated}'"):
                within = "/".join(filter(None, (named, part.group)))
                name = "/".join(filter(None, (part.session, within)))
                check_name(name)
                if name in sockets:
                    raise InputError(f"socket '{name}' is defined twice; give its files in one [[socket]].")
                visits = None if entry.visits is None else part.files
                poses, target = part.rows[source.quantity], part.rows.get("target", "")
                sockets[name] = _Seated(part.session, within, poses, target, visits)
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
    return sockets, _lengths(model.length, fields, sockets), tuple(spheres)


def _capture(
    seats: Sequence[_Seated], lengths: Sequence[ReferenceLength], observed: Sequence[AbstractObservation]
) -> Capture:
    visits = {seated.name: seated.visits for seated in seats if seated.visits is not None}
    return Capture({seated.name: seated.poses for seated in seats}, lengths, observed, visits=visits or None)


def _in_sessions(
    seats: Sequence[_Seated],
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
    for what, text, of_others in (("name", name, of_session), *(("file", file, set()) for file in entry.paths[1:])):
        if fields_of(text) | of_others != fields:
            raise InputError(
                f"{table} {what} '{text}' has {in_braces(fields_of(text))}, but file '{first}' has "
                f"{in_braces(fields)}; use the same fields in the name and in every file."
            )
    if entry.exclude and not fields:
        raise InputError(f"exclude is for files with a field in braces, but '{first}' has none; leave it out.")
    yield from matches(folder, first, entry.exclude) if fields else [{}]


def _lengths(
    entries: Sequence[Length], fields: Sequence[dict[str, str]], sockets: Mapping[str, _Seated]
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
