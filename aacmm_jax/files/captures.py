"""Captures in HDF5: poses, reference lengths, other observations, touched spheres, nominal and true arm, URDF."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..data.arm_classes import ArmNoise
from ..data.capture import Capture, ReferenceLength, check_one_capture, check_readings
from ..data.copies import UNKNOWN, Repeated
from ..data.noise import Noise
from ..data.recording import Recording
from ..data.sphere import ProbedSphere, checked_sphere
from ..kinematics.arm import Arm, readings_unit
from ..kinematics.parameters import ArmSpecification, UrdfSource, single
from .corrections import corrected_of, correction_variables
from .hdf5 import (
    Stored,
    Table,
    Variable,
    axes,
    check_sense,
    columns,
    names_in,
    need,
    numbering,
    read_tables,
    undamaged,
    write_tables,
)
from .observations import observation_tables, observations_of
from .prior_attributes import attributes_of_prior, prior_of_attributes
from .sense import check_recording
from .temperatures import reading_variables, readings_of

_KINDS = {
    "alpha": "link twist",
    "a": "link length",
    "d": "link offset",
    "theta": "joint zero offset",
    "beta": "Hayati's angle",
}


def save_capture(path: str | os.PathLike, recording: Recording, summary: Mapping[str, Any] | None = None) -> None:
    """Write a capture with its arms to HDF5, whole or not at all.

    Args:
        path: the file to write.
        recording: the capture, with its nominal arm.
        summary: what ``aacmm show`` prints of the file; without it, ``show`` computes it, which takes longer.

    Raises:
        InputError: the file cannot be written, or a name holds a character that no file can hold.

    Example:
        >>> aj.files.save_capture("capture.h5", recording)
        >>> print(np.array_equal(aj.files.load_capture("capture.h5").capture.q, capture.q))
        True
    """
    write_tables(path, "capture", recording_tables(recording), recording_attributes(recording), summary=summary)


def load_capture(path: str | os.PathLike) -> Recording:
    """Read a capture with its arms, from a capture file or from a calibration file.

    Args:
        path: the file to read.

    Returns:
        The recording, in mm and rad.

    Raises:
        InputError: the file does not exist, is damaged, is not of this kind, or was written by a newer version.

    Example:
        >>> aj.files.save_capture("capture.h5", recording)
        >>> print(aj.files.load_capture("capture.h5").capture.sizes)
        (40, 10)
    """
    stored = read_tables(path, ("capture", "calibration"))
    with undamaged(path):
        return recording_of(path, stored)


def recording_attributes(recording: Recording) -> dict[str, Any]:
    """Root attributes of a file that holds a recording."""
    return {
        "seed": recording.seed,
        "sources": list(recording.sources) or None,
        "measured": recording.measured or None,
        "acceptance": list(recording.acceptance) or None,
        "measuring_range_mm": recording.measuring_range,
        **_attributes_of_usual(recording.usual),
    }


def _attributes_of_usual(usual: ArmNoise | None) -> dict[str, Any]:
    """Of the noise that the nominal arm's file states."""
    if usual is None:
        return {}
    return {
        "usual_class": usual.arm_class,
        "usual_source": usual.source,
        "usual_encoder_arcsec": np.asarray(usual.noise.encoder_arcsec),
        "usual_linear_encoder_mm": linear_encoder_attribute(usual.noise),
        "usual_seating_mm": float(usual.noise.seating),
    }


def _usual_of(attributes: Mapping[str, Any]) -> ArmNoise | None:
    """What `_attributes_of_usual` wrote; earlier files have none."""
    if "usual_class" not in attributes:
        return None
    # A calibration has a noise of its own beside it.
    own = {name.removeprefix("usual_"): value for name, value in attributes.items() if name.startswith("usual_")}
    noise = noise_of_attributes(own)
    return ArmNoise(attributes["usual_class"], noise, attributes.get("usual_source", ""))


def linear_encoder_attribute(noise: Noise) -> Any:
    """Standard deviation of the readings of prismatic joints, mm; None where it follows from the others."""
    return None if noise.linear_encoder is None else np.asarray(noise.linear_encoder)


def noise_of_attributes(attributes: Mapping[str, Any]) -> Noise:
    """The noise of ``encoder_arcsec``, ``linear_encoder_mm`` and ``seating_mm``."""
    linear = attributes.get("linear_encoder_mm")  # files of version 2 and before have none
    return Noise(
        encoder_arcsec=np.squeeze(np.atleast_1d(attributes.get("encoder_arcsec", 0.0))),
        seating=attributes.get("seating_mm", 0.0),
        linear_encoder=None if linear is None else np.squeeze(np.atleast_1d(linear)),
    )


def recording_tables(recording: Recording) -> dict[str, Table]:
    """The tables of a recording: ``capture``, ``reference``, ``nominal_arm``, and one for each observation."""
    capture, arm = recording.capture, recording.nominal.arm
    unit = readings_unit(arm)
    check_one_capture(capture)
    owner = [capture.names[i] for i in capture.owner]
    poses, lengths = capture.repeated
    tables = {
        "capture": Table(
            numbering("pose", len(owner))
            | reading_variables("angle", np.asarray(capture.q), arm.joints, unit)
            | columns("pose", socket=(owner, "", "socket that held the tip"))
            | _visits_of(capture),
            {
                "repeated_sockets": [n for n, _ in poses] or None,
                "repeated_poses": [n for _, n in poses] or None,
                "sessions": list(capture.sessions) or None,
            },
        ),
        "reference": reference_table(capture.lengths)._replace(
            attributes={
                "repeated_start": [a for a, _ in lengths] or None,
                "repeated_end": [b for _, b in lengths] or None,
            }
        ),
        "nominal_arm": arm_table(recording.nominal),
    }
    if recording.nominal.urdf is not None:
        tables["urdf"] = _urdf_table(recording.nominal.urdf)
    if recording.true is not None:
        tables["true_arm"] = arm_table(recording.true)
    if recording.spheres:
        tables["sphere"] = sphere_table(recording.spheres, unit=unit, joints=arm.joints)
    return tables | observation_tables(capture.observations, arm.joints, unit)


def reference_table(lengths: Sequence[ReferenceLength]) -> Table:
    """Reference lengths, one row each."""
    rows = columns(
        "length",
        start=([length.start for length in lengths], "", "socket at one end"),
        end=([length.end for length in lengths], "", "socket at the other end"),
        value=([float(length.value) for length in lengths], "mm", "calibrated length"),
        u=([float(length.u) for length in lengths], "mm", "standard uncertainty"),
    )
    return Table(numbering("length", len(lengths), "reference length number") | rows)


def lengths_of(path: str | os.PathLike, stored: Stored) -> list[ReferenceLength]:
    """The reference lengths that a file holds."""
    table = stored.tables["reference"]
    need(path, table, "start", "end", "value", "u", of="entry")
    rows = zip(table["start"], table["end"], table["value"], table["u"], strict=True)
    return [ReferenceLength(str(start), str(end), float(value), float(u)) for start, end, value, u in rows]


def sphere_table(
    spheres: Sequence[ProbedSphere], *, points: bool = False, unit: str = "rad", joints: int | None = None
) -> Table:
    """Touched spheres, by poses or points, one row a touch; what belongs to a sphere is in every row of it.

    ``unit`` is that of readings, of so many joints.
    """
    rows = [
        (sphere, number, q) for sphere in spheres for number, group in enumerate(sphere.groups, start=1) for q in group
    ]
    variables = columns(
        "touch",
        sphere=([sphere.name for sphere, *_ in rows], "", "reference sphere"),
        test=([sphere.test for sphere, *_ in rows], "", "acceptance test that the sphere was touched for"),
        group=([number for _, number, _ in rows], "1", "repeat, or orientation of the wrist"),
        diameter=([sphere.diameter for sphere, *_ in rows], "mm", "calibrated diameter"),
        u=([sphere.u for sphere, *_ in rows], "mm", "standard uncertainty of the diameter"),
        stylus=([sphere.stylus for sphere, *_ in rows], "mm", "diameter of the probe's ball"),
        form=([sphere.form for sphere, *_ in rows], "mm", "calibrated form error"),
        u_form=([sphere.u_form for sphere, *_ in rows], "mm", "standard uncertainty of the form error"),
    )
    variables |= numbering("touch", len(rows))
    values = np.array([touched for *_, touched in rows])
    if points:
        return Table(
            variables | axes() | {"position": Variable(("touch", "axis"), values, "mm", "centre of the probe")}
        )
    return Table(variables | reading_variables("angle", values, joints or values.shape[1], unit, "touch"))


def spheres_of(path: str | os.PathLike, stored: Stored, entry: str = "angle") -> tuple[ProbedSphere, ...]:
    """The touched spheres that a file holds, by their ``angle`` or ``position``."""
    table = stored.tables.get("sphere")
    if table is None:
        return ()
    need(path, table, "sphere", "test", "group", "diameter", "u", "stylus", "form", entry, of="entry")
    touched = readings_of(table, entry)
    keys = list(zip(table["sphere"].tolist(), table["test"].tolist(), strict=True))
    found = []
    for name, test in dict.fromkeys(keys):
        rows = np.array([key == (name, test) for key in keys])
        first = int(rows.argmax())
        groups = tuple(touched[rows & (table["group"] == number)] for number in np.unique(table["group"][rows]))
        numbers = (float(table[what][first]) for what in ("diameter", "u", "stylus", "form"))
        u_form = float(table["u_form"][first]) if "u_form" in table else 0.0  # files of earlier versions have none
        found.append(ProbedSphere(str(name), test, groups, *numbers)._replace(u_form=u_form))
    return tuple(found)


def recording_of(path: str | os.PathLike, stored: Stored) -> Recording:
    """The recording that a file's tables hold."""
    need(path, stored.tables, "capture", "reference", "nominal_arm")
    poses = stored.tables["capture"]
    need(path, poses, "angle", "socket", of="entry")
    q = readings_of(poses, "angle")
    owner = np.asarray(poses["socket"]).astype(str)
    names = list(dict.fromkeys(owner.tolist()))
    try:
        sockets = {name: q[owner == name] for name in names}
        capture = Capture(
            sockets,
            lengths_of(path, stored),
            observations_of(path, stored),
            repeated=_repeated_of(stored),
            sessions=stored.table_attributes["capture"].get("sessions") or (),
            visits=_known_visits(poses, owner),
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    true = specification_of(path, stored, "true_arm") if "true_arm" in stored.tables else None
    try:
        spheres = tuple(checked_sphere(sphere, capture.columns) for sphere in spheres_of(path, stored))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    sources = tuple(stored.attributes.get("sources") or ())
    attributes = stored.attributes
    nominal = specification_of(path, stored, "nominal_arm")._replace(urdf=_urdf_of(path, stored))
    check_recording(path, stored)
    try:
        check_readings(capture, nominal.arm, advice='import them with unit = "deg" in [angles] of the manifest')
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return Recording(
        capture,
        nominal,
        true,
        attributes.get("seed"),
        spheres,
        sources,
        attributes.get("measured", ""),
        names_in(attributes.get("acceptance")),
        attributes.get("measuring_range_mm"),
        _usual_of(attributes),
    )


def _visits_of(capture: Capture) -> dict[str, Variable]:
    """The visit of each pose, where some are known."""
    if capture.visits is None:
        return {}
    return columns("pose", visit=(np.array(capture.visits), "1", "number of the visit to the socket; -1 unknown"))


def _known_visits(poses: Mapping[str, np.ndarray], owner: np.ndarray) -> dict[str, np.ndarray] | None:
    """Visits by socket; files of earlier versions have none."""
    if "visit" not in poses:
        return None
    visits = np.asarray(poses["visit"])
    known = [name for name in dict.fromkeys(owner.tolist()) if np.all(visits[owner == name] != UNKNOWN)]
    return {name: visits[owner == name] for name in known}


def _repeated_of(stored: Stored) -> Repeated:
    """Copies that were left out before the file was written; files of version 0.1 do not say."""
    poses, lengths = (stored.table_attributes[table] for table in ("capture", "reference"))
    return Repeated(
        tuple(zip(poses.get("repeated_sockets", ()), poses.get("repeated_poses", ()), strict=True)),
        tuple(zip(lengths.get("repeated_start", ()), lengths.get("repeated_end", ()), strict=True)),
    )


def _urdf_table(source: UrdfSource) -> Table:
    """The text of the URDF that the nominal arm was read from, so that an export does not need the file."""
    lines = source.text.splitlines(keepends=True)
    variables = numbering("urdf_line", len(lines))
    variables |= columns("urdf_line", text=(lines, "", "line of the URDF, with its end"))
    return Table(variables, {"base": source.base, "tip": source.tip})


def _urdf_of(path: str | os.PathLike, stored: Stored) -> UrdfSource | None:
    table = stored.tables.get("urdf")
    if table is None:
        return None
    need(path, table, "text", of="entry")
    attributes = stored.table_attributes["urdf"]
    return UrdfSource("".join(map(str, table["text"])), attributes["base"], attributes["tip"])


def arm_table(specification: ArmSpecification) -> Table:
    """An arm as a table over ``joint``, with its proposed identification in attributes."""
    arm = single(specification.arm)
    variables = numbering("joint", arm.joints) | axes("axis of the last frame")
    variables |= columns("axis", probe=(np.asarray(arm.probe), "mm", "tip in the last frame"))
    for kind, long_name in _KINDS.items():
        values = getattr(arm, kind)
        if values is not None:
            unit = "mm" if kind in ("a", "d") else "rad"
            variables[kind] = Variable(("joint",), np.asarray(values), unit, long_name)
    variables |= correction_variables(arm)
    if arm.limits is not None:
        for side, name in enumerate(("lowest", "highest")):
            values = [limit[side] for limit in arm.limits]
            variables[name] = Variable(("joint",), values, readings_unit(arm), f"{name} reading of the joint")
    attributes: dict[str, Any] = {
        "name": specification.name,
        "prismatic": list(arm.prismatic) or None,
        "thermometer": arm.thermometer or None,
        "half_width_length_mm": specification.length,
        "half_width_angle_rad": specification.angle,
        "override_names": list(specification.override) or None,
        "override_half_widths": [float(width) for width in specification.override.values()] or None,
        "held": None if specification.held is None else list(specification.held) or "",
        "free": list(specification.free) or None,
        **attributes_of_prior(specification.prior),
    }
    return Table(variables, attributes)


def specification_of(path: str | os.PathLike, stored: Stored, table: str) -> ArmSpecification:
    """The arm that a table holds."""
    arrays: Mapping[str, np.ndarray] = stored.tables[table]
    attributes = stored.table_attributes[table]
    need(path, arrays, "alpha", "a", "d", "theta", "probe", of="entry")
    limits = None
    if "lowest" in arrays:
        limits = list(zip(arrays["lowest"].tolist(), arrays["highest"].tolist(), strict=True))
    held = attributes.get("held")
    try:
        arm = Arm(
            alpha=arrays["alpha"],
            a=arrays["a"],
            d=arrays["d"],
            theta=arrays["theta"],
            beta=arrays.get("beta"),
            probe=arrays["probe"],
            limits=limits,
            prismatic=[int(joint) for joint in np.atleast_1d(attributes.get("prismatic", ()))],
            thermometer=bool(attributes.get("thermometer", False)),
        )
        arm = corrected_of(path, arm, arrays)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    widths = attributes.get("override_half_widths") or []
    widths = [attributes.get("half_width_length_mm", 10.0), attributes.get("half_width_angle_rad", 0.0175), *widths]
    check_sense(path, {"a half-width is not positive and finite": not all(0 < width < np.inf for width in widths)})
    override = zip(attributes.get("override_names") or [], attributes.get("override_half_widths") or [], strict=True)
    return ArmSpecification(
        arm=arm,
        name=attributes.get("name", ""),
        held=None if held is None else names_in(held),
        length=attributes.get("half_width_length_mm", 10.0),
        angle=attributes.get("half_width_angle_rad", 0.0175),
        override=dict(override),
        free=names_in(attributes.get("free")),
        prior=prior_of_attributes(attributes),
    )
