"""Captures in HDF5: poses, reference lengths, other observations, touched spheres, nominal and true arm, URDF."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..core.errors import naming
from ..data.capture import Capture, ReferenceLength, check_one_capture, check_readings
from ..data.capture_data import UNKNOWN, Repeated
from ..data.noise import ArmNoise
from ..data.recording import ProbedSphere, Recording, checked_sphere
from ..kinematics.arm import Arm, readings_unit
from ..kinematics.parameters import ArmSpecification, UrdfSource, single
from ..kinematics.priors import Prior
from .corrections import corrected_of, correction_variables
from .hdf5 import Stored, StoredTable, Table, Variable, check_sense, columns, undamaged, write_tables
from .observations import observation_tables, observations_of, reading_variables, readings_of
from .records import record_in, row_values, rows_table, table_of, values_in
from .schema import LENGTHS, RECORDING, SPECIFICATION, SPHERES, USUAL_NOISE
from .sense import read_checked

_GEOMETRY = {
    "alpha": ("rad", "link twist"),
    "a": ("mm", "link length"),
    "d": ("mm", "link offset"),
    "theta": ("rad", "joint zero offset"),
    "beta": ("rad", "Hayati's angle"),
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
        InputError: the file does not exist, is damaged, is not of this kind, or was written by another version.

    Example:
        >>> aj.files.save_capture("capture.h5", recording)
        >>> print(aj.files.load_capture("capture.h5").capture.sizes)
        (40, 10)
    """
    with undamaged(path):
        return recording_of(path, read_checked(path, ("capture", "calibration")))


def recording_attributes(recording: Recording) -> Mapping[str, Any]:
    """Root attributes of a file that holds a recording."""
    return table_of(recording, RECORDING).attributes


def recording_tables(recording: Recording) -> dict[str, Table]:
    """The tables of a recording: ``capture``, ``reference``, ``nominal_arm``, and one for each observation."""
    capture, arm = recording.capture, recording.nominal.arm
    unit = readings_unit(arm)
    check_one_capture(capture)
    poses = reading_variables("angle", np.asarray(capture.q), arm.joints, unit)
    poses |= columns("pose", socket=([capture.names[i] for i in capture.owner], "", "socket that held the tip"))
    if capture.visits is not None:
        visits = np.array(capture.visits)
        poses |= columns("pose", visit=(visits, "1", "number of the visit to the socket; -1 unknown"))
    # Copies that were left out: poses by socket, and lengths by their ends.
    (sockets, counts), (starts, ends) = (tuple(zip(*rows, strict=True)) or ((), ()) for rows in capture.repeated)
    attributes = {
        "sessions": capture.sessions or None,
        "repeated_sockets": sockets or None,
        "repeated_poses": counts or None,
        "repeated_starts": starts or None,
        "repeated_ends": ends or None,
    }
    tables = {
        "capture": Table(poses, attributes),
        "reference": rows_table("length", capture.lengths, LENGTHS),
        "nominal_arm": arm_table(recording.nominal),
    }
    if recording.nominal.urdf is not None:
        tables["urdf"] = _urdf_table(recording.nominal.urdf)
    if recording.true is not None:
        tables["true_arm"] = arm_table(recording.true)
    if recording.spheres:
        tables["sphere"] = sphere_table(recording.spheres, unit=unit, joints=arm.joints)
    if recording.usual is not None:
        tables["usual_noise"] = table_of(recording.usual, USUAL_NOISE)
    return tables | observation_tables(capture.observations, arm.joints, unit)


def recording_of(path: str | os.PathLike, stored: Stored) -> Recording:
    """The recording that a file's tables hold."""
    poses, nominal = stored.tables["capture"], specification_of(path, stored, "nominal_arm")
    q, owner = readings_of(poses, "angle"), np.asarray(poses["socket"]).astype(str)
    names = list(dict.fromkeys(owner.tolist()))
    visits = poses.get("visit")
    if visits is not None:
        visits = {name: visits[owner == name] for name in names if np.all(visits[owner == name] != UNKNOWN)}
    given = poses.attributes
    repeated = Repeated(
        tuple(zip(given.get("repeated_sockets", ()), given.get("repeated_poses", ()), strict=True)),
        tuple(zip(given.get("repeated_starts", ()), given.get("repeated_ends", ()), strict=True)),
    )
    true = specification_of(path, stored, "true_arm") if "true_arm" in stored.tables else None
    with naming(path):
        capture = Capture(
            {name: q[owner == name] for name in names},
            lengths_of(stored),
            observations_of(path, stored),
            repeated=repeated,
            sessions=given.get("sessions") or (),
            visits=visits,
        )
        spheres = tuple(checked_sphere(sphere, capture.columns) for sphere in spheres_of(stored))
        check_readings(capture, nominal.arm, advice='import them with unit = "deg" in [angles] of the manifest')
    return Recording(
        capture,
        nominal._replace(urdf=_urdf_of(stored.tables.get("urdf"))),
        true,
        spheres=spheres,
        usual=record_in(ArmNoise, USUAL_NOISE, stored.tables.get("usual_noise")),
        **values_in(Recording, RECORDING, stored.tables, stored.attributes),
    )


def lengths_of(stored: Stored) -> tuple[ReferenceLength, ...]:
    """The reference lengths that a file holds."""
    table = stored.tables["reference"]
    columns = (table[name].tolist() for name in LENGTHS)
    return tuple(ReferenceLength(*row) for row in zip(*columns, strict=True))


def sphere_table(
    spheres: Sequence[ProbedSphere], *, points: bool = False, unit: str = "rad", joints: int | None = None
) -> Table:
    """Touched spheres, by poses or points, one row a touch; what belongs to a sphere is in every row of it.

    ``unit`` is that of readings, of so many joints.
    """
    rows = [
        (sphere, number, q) for sphere in spheres for number, group in enumerate(sphere.groups, start=1) for q in group
    ]
    variables = rows_table("touch", (sphere for sphere, *_ in rows), SPHERES).variables | columns(
        "touch", group=([number for _, number, _ in rows], "1", "repeat, or orientation of the wrist")
    )
    values = np.array([touched for *_, touched in rows])
    if points:
        return Table(variables | {"position": Variable(("touch", "axis"), values, "mm", "centre of the probe")})
    return Table(variables | reading_variables("angle", values, joints or values.shape[1], unit, "touch"))


def spheres_of(stored: Stored, entry: str = "angle") -> tuple[ProbedSphere, ...]:
    """The touched spheres that a file holds, by their ``angle`` or ``position``."""
    table = stored.tables.get("sphere")
    if table is None:
        return ()
    touched, groups = readings_of(table, entry), table["group"]
    keys = list(zip(table["sphere"].tolist(), table["test"].tolist(), strict=True))
    spheres = []
    for key in dict.fromkeys(keys):
        rows = np.array([other == key for other in keys])
        values = row_values(ProbedSphere, SPHERES, "touch", table, int(rows.argmax()))
        members = tuple(touched[rows & (groups == number)] for number in np.unique(groups[rows]))
        spheres.append(ProbedSphere(groups=members, **values))
    return tuple(spheres)


def _urdf_table(source: UrdfSource) -> Table:
    """The text of the URDF that the nominal arm was read from, so that an export does not need the file."""
    lines = source.text.splitlines(keepends=True)
    variables = columns("urdf_line", text=(lines, "", "line of the URDF, with its end"))
    return Table(variables, {"base": source.base, "tip": source.tip})


def _urdf_of(table: StoredTable | None) -> UrdfSource | None:
    if table is None:
        return None
    return UrdfSource("".join(map(str, table["text"])), table.attributes["base"], table.attributes["tip"])


def arm_table(specification: ArmSpecification) -> Table:
    """An arm as a table over ``joint``, with its proposed identification in attributes."""
    arm = single(specification.arm)
    variables = columns("axis", probe=(np.asarray(arm.probe), "mm", "tip in the last frame"))
    for kind, (unit, says) in _GEOMETRY.items():
        values = getattr(arm, kind)
        if values is not None:
            variables |= columns("joint", **{kind: (np.asarray(values), unit, says)})
    variables |= correction_variables(arm)
    if arm.limits is not None:
        for name, values in zip(("lowest", "highest"), np.transpose(arm.limits), strict=True):
            variables |= columns("joint", **{name: (values, readings_unit(arm), f"{name} reading of the joint")})
    attributes = {"prismatic": arm.prismatic or None, "thermometer": arm.thermometer or None}
    prior = specification.prior
    if prior is not None:
        # Without a standard deviation a group is learned, or nothing is known of it.
        attributes |= {
            "prior_groups": prior.groups,
            "prior_sd": [float(prior.sd[group]) if group in prior.sd else np.inf for group in prior.groups],
            "prior_learned": [group for group, learned in zip(prior.groups, prior.learned, strict=True) if learned],
            "prior_mean_of": tuple(prior.mean),
            "prior_mean": [float(value) for value in prior.mean.values()],
        }
    return Table(variables, attributes | dict(table_of(specification, SPECIFICATION).attributes))


def specification_of(path: str | os.PathLike, stored: Stored, name: str) -> ArmSpecification:
    """The arm that a table holds."""
    table = stored.tables[name]
    attributes, limits = table.attributes, None
    if "lowest" in table:
        limits = list(zip(table["lowest"].tolist(), table["highest"].tolist(), strict=True))
    with naming(path):
        arm = Arm(
            **{kind: table.get(kind) if kind == "beta" else table[kind] for kind in (*_GEOMETRY, "probe")},
            limits=limits,
            prismatic=list(attributes.get("prismatic", ())),
            thermometer=bool(attributes.get("thermometer", False)),
        )
        arm = corrected_of(arm, table)
    proposed = values_in(ArmSpecification, SPECIFICATION, table, attributes)
    widths = (proposed["length"], proposed["angle"], *proposed["override"].values())
    check_sense(path, {"a half-width is not positive and finite": not all(0 < width < np.inf for width in widths)})
    prior = None
    if "prior_groups" in attributes:
        sd = dict(zip(attributes["prior_groups"], attributes["prior_sd"], strict=True))
        mean = dict(zip(attributes["prior_mean_of"], attributes["prior_mean"], strict=True))
        prior = Prior(sd, mean=mean, learn=tuple(attributes["prior_learned"]))
    return ArmSpecification(arm=arm, prior=prior, **proposed)
