"""The manifest of a capture (TOML): which text files hold which socket or observation, in which unit; the lengths.

A manifest of points, instead of poses, is for acceptance tests of arms that report coordinates.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..acceptance.results import Measured
from ..core.errors import InputError, naming, nearest
from ..core.text import shorten
from ..data.capture import Capture, ReferenceLength, check_readings, join_sessions
from ..data.noise import ArmNoise
from ..data.observations.held import Socket
from ..data.observations.measured import MeasuredPoints
from ..data.recording import ProbedSphere, ReadImage, ReadingSet, Recording, checked_sphere
from ..kinematics.arm import Arm, reading_as
from ..kinematics.parameters import ArmSpecification
from ..kinematics.robots import together
from ..kinematics.workspace import Reach
from ..model.robot_bases import with_found_bases
from .arms import arm_beside, for_capture, read_arm, usual_noise, with_load_centre
from .controllers.lerobot import angles_by_motors
from .inputs import InputFile
from .manifest_pixels import Cameras, Detecting, Progress, observations_of, without_progress
from .manifest_readings import Readings, points_of
from .manifest_rows import Source, name_of, parts
from .manifest_tables import TABLES, Length, PointsManifest, PosesManifest, Recorded, base_transform
from .outputs import as_path
from .patterns import check_fields, check_name, fields_of, fill, in_braces, matching
from .reading_sets import other_readings, with_deviations
from .toml import read_toml
from .urdf_robots import joint_names, link_numbers

_QUIETLY = Detecting()


def read_manifest(
    path: str | os.PathLike, *, progress: Progress = without_progress, overlays: str | os.PathLike | None = None
) -> Recording:
    """Read a manifest and every file it names, in mm and rad; paths are relative to the manifest.

    A field in braces matches part of a path and makes one socket for each value found: with
    ``file = "run_1/{place}/hole_{hole}.csv"`` and ``name = "{place}/{hole}"``, the length ``from = "{place}/0"``,
    ``to = "{place}/1"`` is measured at every place. Angles: reading -> sign * (reading - offset), in the stated unit.
    ``columns`` picks by header name, shell pattern or number; where nothing is stated, readings are the columns with
    names of joints in the header, or all. Units in the header must agree with those stated. All keys are listed in the
    reference of file formats, and explained in the guide to manifests.

    ``arm`` is a shipped name, an arm file (TOML), a URDF, or a ``kinematics.yaml``. Where the arm's file names no free
    parameters, they are those that such observations determine.

    Args:
        path: the manifest (TOML).
        progress: called with the names of images before they are read, and a word for what is done; yields them.
        overlays: folder to which a picture of each image is written, with the corners that were found in it.

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
    manifest = path if isinstance(path, InputFile) else InputFile(path)
    detecting = Detecting(progress, None if overlays is None else Path(overlays), {})
    recording, readings = _read(manifest, detecting)
    other = other_readings(manifest, recording, readings.header, lambda changed: _read(changed, detecting)[0])
    return recording._replace(other_readings=other)


def readings_of_manifest(path: str | os.PathLike) -> Readings:
    """With which columns and unit the first table that a manifest names was read. Raises `InputError`."""
    return _read(path, written=[])[1]


def deviations_of_manifest(path: str | os.PathLike) -> list[ReadingSet]:
    """The captures of a manifest with deviations added to its measured points, and subtracted from them, where its
    table has columns of these. Raises `InputError`."""
    manifest = InputFile(path)
    if "[[points]]" not in manifest.text and "[[transforms]]" not in manifest.text:
        return []
    return with_deviations(
        manifest, readings_of_manifest(manifest).header, lambda changed: _read(changed, written=[])[0]
    )


class WrittenRotations(NamedTuple):
    """Measured orientations as a table of a manifest has them."""

    table: int  # its number among those of its kind
    name: str
    q: Float[np.ndarray, "m n"]  # rad
    points: Float[np.ndarray, "m 3"]  # mm
    numbers: Float[np.ndarray, "m k"]
    unit: str | None  # where the manifest or the header states one


def written_rotations(path: str | os.PathLike) -> tuple[Recording, list[WrittenRotations]]:
    """What a manifest's tables of orientations hold, whatever their convention, and the recording without them: the
    orientations of transforms that have positions only. Raises `InputError`."""
    written: list[WrittenRotations] = []
    return _read(path, written=written)[0], written


def _read(
    path: str | os.PathLike, detecting: Detecting = _QUIETLY, written: list[WrittenRotations] | None = None
) -> tuple[Recording, Readings]:
    model = read_toml(manifest := InputFile(path), PosesManifest)
    path = as_path(path)
    with naming(path):
        nominal, proposed = _nominal(path.parent, model)
        source = Source(manifest, "q")
        source.rotation_units = None if written is None else {}
        angles = model.angles
        if angles is not None and angles.calibration is not None:
            angles = angles_by_motors(angles, source.open(angles.calibration), nominal.arm.joints)
        urdf = nominal.urdf
        chains = {} if urdf is None else {tip: urdf._replace(tips=(tip,)) for tip in urdf.tips}
        names = {tip: joint_names(chain) for tip, chain in chains.items()}
        links = {tip: link_numbers(chain) for tip, chain in chains.items()}
        source.rows = readings = Readings(nominal.arm, angles, names, links)
        sockets, lengths, spheres = _read_recorded(model, source)
        observed: list[tuple[str, Any]] = [(seat.session, seat) for seat in sockets.values() if not seat.target]
        # Where another tip than the arm's own probe was held, it is an observation.
        others = [seat for seat in sockets.values() if seat.target]
        observed += [(seat.session, Socket(seat.name, seat.poses, target=seat.target)) for seat in others]
        cameras, images = Cameras(source, model.camera, model.target), list[ReadImage]()
        for entry in model.pixels:
            for values in _fields(source, entry, "pixels"):
                seen, read = observations_of(cameras, source, entry, values, detecting)
                observed, images = [*observed, *seen], [*images, *read]
        for kind in TABLES:
            for number, entry in enumerate(() if kind is Socket else getattr(model, kind.table)):
                for values in _fields(source, entry, kind.table):
                    name = name_of(entry, values)
                    for part in parts(source, kind, entry, values, f"[[{kind.table}]] '{name}'"):
                        named = f"{name}/{part.group}" if entry.group is not None else name
                        made, rows = kind, part.rows
                        if written is not None and source.rotation_units and "rotations" in rows:
                            unit = source.rotation_units[f"[[{kind.table}]] '{name}'"]
                            row = rows["q"], rows["points"], rows["rotations"], unit
                            written.append(WrittenRotations(number, named, *row))
                            made, kept = MeasuredPoints, {entry.name for entry in MeasuredPoints.entries}
                            rows = {key: value for key, value in rows.items() if key in kept} | {"target": named}
                        observed.append((part.session, made.rebuilt(named, rows)))
        source.check_used()
        if not observed:
            raise InputError("the manifest contains no [[socket]] and no other observation; add at least one.")
        probe = "remounted" if model.sessions is None else model.sessions.probe
        if model.sessions is not None and not any(session for session, _ in observed):
            raise InputError(
                "[sessions] applies only to tables with a session, but no table has a session; remove [sessions]."
            )
        capture = _capture(lengths, observed, probe == "remounted")
        nominal = nominal._replace(arm=with_found_bases(reading_as(nominal.arm, readings.beside), capture))
        check_readings(capture, nominal.arm)
        if model.load_centre is not None and "load" not in readings.beside:
            raise InputError("load_centre is given, but no table has load_kg; add it, or remove load_centre.")
        as_found = None if model.as_found is None else _as_found(arm_beside(path.parent, model.as_found), nominal.arm)
        recording = Recording(
            capture,
            for_capture(nominal, proposed, capture),
            spheres=spheres,
            sources=source.fingerprints(),
            measured=str(model.date or ""),
            acceptance=(model.acceptance,) if isinstance(model.acceptance, str) else tuple(model.acceptance),
            measuring_range=model.measuring_range,
            usual=None if isinstance(arm := model.arm, dict) else _usual_noise(path.parent, arm, model),
            as_found=as_found,
            stated=_stated(model),
            read_as=None if model.angles is None else model.angles.read_as(nominal.arm.joints),
            recorded_as=readings.recorded_as,
            images=tuple(images),
            notes=tuple(source.notes),
        )
        return recording, readings


def _nominal(folder: Path, model: Any) -> tuple[ArmSpecification, bool]:
    """The arm that a manifest names, or the robot of several arms, and whether its file proposes an identification."""
    options = {"base": model.base, "tip": model.tip, "probe": model.probe}
    if isinstance(model.arm, str):
        if model.bases:
            raise InputError("bases are given, but the manifest names one arm; remove bases.")
        nominal, proposed = read_arm(arm_beside(folder, model.arm), **options)
        return _loaded(model, nominal), proposed
    arms = {name: read_arm(arm_beside(folder, file), **options)[0].arm for name, file in model.arm.items()}
    for name in model.bases:
        if name not in arms:
            raise InputError(f"bases names the unknown arm '{name}'{nearest(name, arms)}")
    bases = {name: base_transform(np.array(numbers)) for name, numbers in model.bases.items()}
    return _loaded(model, ArmSpecification(together(arms, bases=bases), " and ".join(arms))), False


def _loaded(model: Any, nominal: ArmSpecification) -> ArmSpecification:
    centre = model.load_centre
    return nominal if centre is None else with_load_centre(nominal, centre, model.probe)


def _usual_noise(folder: Path, arm: str, model: Any) -> ArmNoise | None:
    return usual_noise(arm_beside(folder, arm), base=model.base, tip=model.tip)


def _stated(model: Any) -> tuple[str, ...]:
    """What the manifest states of readings and points, as `Recording.stated` names it."""
    given = set() if model.angles is None else model.angles.model_fields_set
    stated = given & {"columns", "sign", "offset", "unit"}
    for table in (entry for kind in TABLES for entry in getattr(model, kind.table)):
        picked = "q" in table.columns if isinstance(table.columns, dict) else bool(table.columns)
        stated |= {
            name
            for name, by_hand in (("columns", picked), ("unit", "q" in table.units), ("units", "points" in table.units))
            if by_hand
        }
    return tuple(sorted(stated))


def _as_found(file: str | Path, nominal: Arm) -> ArmSpecification:
    """The arm as it arrived, which reads as the nominal one does."""
    specification = read_arm(file)[0]
    arm = reading_as(specification.arm, nominal.recorded)
    if (arm.joints, arm.prismatic) != (nominal.joints, nominal.prismatic):
        raise InputError(
            f"as_found = '{Path(file).name}' has {arm.joints} joints or other prismatic joints than arm, which has "
            f"{nominal.joints}; name the file of the same arm with the parameters that it had on arrival."
        )
    return specification._replace(arm=arm)


def read_points(path: str | os.PathLike) -> Measured:
    """Read a manifest of points and every file that it names, in mm; paths are relative to the manifest.

    ``[points]`` has ``unit`` (mm, m, um, inch; by default that of the header), and for the zones of ASME B89.4.22 the
    arm's ``reach`` and ``shoulder`` (x, y, z) in mm. ``[[socket]]``, ``[[length]]`` and ``[[sphere]]`` are those of
    `read_manifest`, with files of x, y, z: columns of these names, or the only three.

    Args:
        path: the manifest (TOML).

    Example:
        >>> from pathlib import Path
        >>> np.savetxt("near.csv", true.position(capture.sockets["A"]), delimiter=",")
        >>> text = 'points = { unit = "mm" }\\nsocket = [{ name = "near", file = "near.csv" }]'
        >>> _ = Path("points.toml").write_text(text)
        >>> print(aj.files.read_points("points.toml").sockets["near"].shape)
        (40, 3)
    """
    model = read_toml(manifest := InputFile(path), PointsManifest)
    stated = model.points
    with naming(as_path(path)):
        source = Source(manifest, "points")
        source.rows = lambda text, wanted: points_of(text, wanted, stated)
        seated, lengths, spheres = _read_recorded(model, source)
        source.check_used()
        for length in lengths:
            for end in (length.start, length.end):
                if end not in seated:
                    raise InputError(
                        f"length from '{length.start}' to '{length.end}' names the unknown socket "
                        f"'{end}'{nearest(end, seated)}"
                    )
        if not seated and not spheres:
            raise InputError(
                "the manifest contains no [[socket]] and no [[sphere]], so nothing can be tested; add at least one."
            )
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
    if model.measurements is not None:
        source.put_in_place(model.measurements)
    sockets: dict[str, _Seated] = {}
    chains: set[tuple[str, str | None]] = set()
    fields: list[dict[str, str]] = []
    for entry in model.socket:
        for values in _fields(source, entry, "socket"):
            fields.append(values)
            stated = name_of(entry, values)
            named = "" if entry.name is None and entry.group is not None else stated
            for part in parts(source, Socket, entry, values, f"[[socket]] '{stated}'"):
                within = "/".join(filter(None, (named, part.group)))
                name = "/".join(filter(None, (part.session, within)))
                check_name(name)
                visits = None if entry.visits is None else part.files
                poses, target = part.rows[source.quantity], part.rows.get("target", "")
                if name in sockets:  # two chains of a robot may be in one socket
                    other = sockets[name]
                    if (name, entry.chain) in chains or None in (entry.chain, *(chain for _, chain in chains)):
                        raise InputError(f"socket '{name}' is defined twice; give its files in one [[socket]].")
                    visits, poses = None, np.concatenate([other.poses, poses])
                chains.add((name, entry.chain))
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


def _capture(lengths: Sequence[ReferenceLength], observed: Sequence[tuple[str, Any]], remounted: bool) -> Capture:
    """One capture of all sessions, each but the first with a probe of its own where that was ``remounted``."""
    by_session: dict[str, list[Any]] = {session: [] for session, _ in observed}
    for session, item in observed:
        by_session[session].append(item)
    if len(by_session) > 1 and "" in by_session:
        without = [item.name for item in by_session[""]]
        raise InputError(
            f"{shorten(without)} has no session, but other tables have a session; state the session in every table."
        )
    lengths_of: dict[str, list[ReferenceLength]] = {session: [] for session in by_session}
    for length in lengths:  # named session/name
        ends = (length.start, length.end)
        session = next((name for name in by_session if all(end.startswith(f"{name}/") for end in ends)), None)
        if "" in by_session:
            lengths_of[""].append(length)
        elif session is None:
            raise InputError(
                f"length from '{length.start}' to '{length.end}' is not between two sockets of the same session; write "
                "the names of the sockets as session/name."
            )
        else:
            start, end = (end.removeprefix(f"{session}/") for end in ends)
            lengths_of[session].append(replace(length, start=start, end=end))
    captures = {}
    for session, items in by_session.items():
        seats = [item for item in items if isinstance(item, _Seated)]
        captures[session] = Capture(
            {seated.name: seated.poses for seated in seats},
            lengths_of[session],
            [item for item in items if not isinstance(item, _Seated)],
            visits={seated.name: seated.visits for seated in seats if seated.visits is not None} or None,
        )
    return captures[""] if "" in captures else join_sessions(captures, own_probe=remounted)


def _fields(source: Source, entry: Any, table: str) -> Iterator[dict[str, str]]:
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
        raise InputError(
            f"file '{first}' has {in_braces(fields)}, so its table needs a name with the same fields; add name = "
            f'"{line}" to [[{table}]].'
        )
    for what, text, of_others in (("name", name, of_session), *(("file", file, set()) for file in entry.paths[1:])):
        if fields_of(text) | of_others != fields:
            raise InputError(
                f"{table} {what} '{text}' has {in_braces(fields_of(text))}, but file '{first}' has "
                f"{in_braces(fields)}; use the same fields in the name and in every file."
            )
    if entry.exclude and not fields:
        raise InputError(
            f"exclude applies only to file names with a field in braces, but '{first}' has no such field; remove "
            "exclude."
        )
    yield from source.fields(first, entry.exclude) if fields else [{}]


def _lengths(
    entries: Sequence[Length], fields: Sequence[dict[str, str]], sockets: Mapping[str, _Seated]
) -> list[ReferenceLength]:
    """Reference lengths; one with fields in braces gives every combination that the sockets' files have, or else every
    pair of sockets with such names, as a column of groups gives them."""
    lengths = []
    for entry in entries:
        check_fields(entry.start)
        check_fields(entry.end)
        names = fields_of(entry.start) | fields_of(entry.end)
        choices = {tuple((name, values[name]) for name in sorted(names)) for values in fields if names <= values.keys()}
        if not choices and fields_of(entry.end) <= fields_of(entry.start):
            named = matching(entry.start, sockets)
            choices = {tuple(sorted(values.items())) for values in named if fill(entry.end, values) in sockets}
        if not choices and names:
            raise InputError(
                f"length from '{entry.start}' to '{entry.end}' uses a field that no [[socket]] has; use only fields "
                "that occur in the names of sockets."
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
