"""Captures in HDF5: poses, reference lengths, other observations, touched spheres, nominal and true arm, URDF."""

import os
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError, naming
from ..data.capture import Capture, ReferenceLength, check_one_capture, check_readings
from ..data.capture_data import UNKNOWN, Repeated
from ..data.noise import ArmNoise
from ..data.observations.declared import Entry
from ..data.observations.observation import AbstractObservation
from ..data.observations.simulated import kinds
from ..data.recording import ProbedSphere, ReadImage, RecordedAs, Recording, checked_sphere
from ..kinematics.arm import Arm, correction_names, reading_as, readings_unit
from ..kinematics.beside import BY_JOINT, CHAIN, COLUMNS
from ..kinematics.corrected_arm import loads_of
from ..kinematics.parameters import ArmSpecification, UrdfSource, single
from ..kinematics.priors import Prior
from ..kinematics.robots import chain_facts
from .arm_tables import GEOMETRY, with_coefficients
from .hdf5 import Stored, StoredTable, Table, Variable, check_sense, columns, undamaged, write_tables
from .records import Field, attribute_name, record_in, row_values, rows_in, rows_table, table_of, values_in
from .schema import ARM, IMAGES, LENGTHS, RECORDED_AS, RECORDING, SPHERES, USUAL_NOISE
from .stored_checks import read_checked
from .urdf import located

_OBSERVATION = "observation_"
_BESIDE = {  # the variables of what was recorded beside the joints' readings
    CHAIN: ("chain", "1", "number of the robot's chain that the pose is of, from 0; 1.004: the link after joint 4"),
    "torques": ("torque", "N m", "torque of the joint's drive"),
    "directions": (
        "direction",
        "1",
        "1 after a rising reading of the joint, -1 after a falling one, 0 unknown",
    ),
    "load": ("load", "kg", "mass of the load"),
    "thermometer": ("temperature", "degC", "temperature of the arm"),
}


def save_capture(path: str | os.PathLike, recording: Recording, summary: Mapping[str, Any] | None = None) -> None:
    """Write a capture with its arms to HDF5, whole or not at all.

    Args:
        path: the file to write.
        recording: the capture, with its nominal arm.
        summary: what ``aacmm show`` prints of the file; without it, ``show`` computes it, which takes longer.

    Example:
        >>> aj.files.save_capture("capture.h5", recording)
        >>> print(np.array_equal(aj.files.load_capture("capture.h5").capture.q, capture.q))
        True
    """
    write_tables(path, "capture", recording_tables(recording), recording_attributes(recording), summary=summary)


def load_capture(path: str | os.PathLike) -> Recording:
    """Read a capture with its arms, in mm and rad, from a capture file or from a calibration file.

    Args:
        path: the file to read.

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
    """The tables of a recording: ``capture``, ``reference``, ``nominal_arm``, and one for each observation.

    Those of observations are named by number, since names of observations may hold what names of groups may not.
    """
    capture, arm, urdf = recording.capture, recording.nominal.arm, recording.nominal.urdf
    check_one_capture(capture)
    poses = _reading_variables("angle", np.asarray(capture.q), arm)
    poses |= columns("pose", socket=([capture.names[i] for i in capture.owner], "", "socket of the pose"))
    if capture.visits is not None:
        visits = np.array(capture.visits)
        poses |= columns("pose", visit=(visits, "1", "number of the visit to the socket; -1 if unknown"))
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
    if urdf is not None:  # so that an export does not need the file
        lines = urdf.text.splitlines(keepends=True)
        variables = columns("urdf_line", text=(lines, "", "line of the URDF, including its line break"))
        tables["urdf"] = Table(variables, {"base": urdf.base, "tip": "\n".join(urdf.tips)})
    if recording.true is not None:
        tables["true_arm"] = arm_table(recording.true)
    if recording.as_found is not None:
        tables["as_found_arm"] = arm_table(recording.as_found)
    if recording.spheres:
        tables["sphere"] = sphere_table(recording.spheres, arm)
    if recording.images:
        tables["images"] = rows_table("image", recording.images, IMAGES)
    if recording.usual is not None:
        tables["usual_noise"] = table_of(recording.usual, USUAL_NOISE)
    if recording.recorded_as is not None:
        tables["recorded_as"] = table_of(recording.recorded_as, RECORDED_AS)
    for number, observation in enumerate(capture.observations, start=1):
        stored = observation.stored()
        q = stored.pop("q", None)
        fields = {entry.name: _field(entry) for entry in observation.entries if entry.name in stored}
        table = table_of(SimpleNamespace(**stored), fields)
        readings = {} if q is None else _reading_variables("q", np.asarray(q), arm)
        attributes = {"kind": observation.kind, "name": observation.name} | dict(table.attributes)
        tables[f"{_OBSERVATION}{number}"] = Table(readings | table.variables, attributes)
    return tables


def recording_of(path: str | os.PathLike, stored: Stored) -> Recording:
    """The recording that a file's tables hold."""
    poses, nominal = stored.tables["capture"], specification_of(path, stored, "nominal_arm")
    q, owner = _readings_of(poses, "angle"), np.asarray(poses["socket"]).astype(str)
    names = list(dict.fromkeys(owner.tolist()))
    nominal = nominal._replace(arm=reading_as(nominal.arm, _recorded(poses)))
    visits = poses.get("visit")
    if visits is not None:
        visits = {name: visits[owner == name] for name in names if np.all(visits[owner == name] != UNKNOWN)}
    given = poses.attributes
    repeated = Repeated(
        tuple(zip(given.get("repeated_sockets", ()), given.get("repeated_poses", ()), strict=True)),
        tuple(zip(given.get("repeated_starts", ()), given.get("repeated_ends", ()), strict=True)),
    )
    numbers = sorted(int(name.removeprefix(_OBSERVATION)) for name in stored.tables if name.startswith(_OBSERVATION))
    true, as_found = (
        specification_of(path, stored, name) if name in stored.tables else None for name in ("true_arm", "as_found_arm")
    )
    with naming(path):
        capture = Capture(
            {name: q[owner == name] for name in names},
            lengths_of(stored),
            [_observation(path, stored.tables[f"{_OBSERVATION}{number}"]) for number in numbers],
            repeated=repeated,
            sessions=given.get("sessions") or (),
            visits=visits,
        )
        spheres = tuple(checked_sphere(sphere, capture.columns) for sphere in spheres_of(stored))
        check_readings(capture, nominal.arm, advice='import the readings with unit = "deg" in [angles] of the manifest')
    table = stored.tables.get("urdf")
    if table is not None:
        text = "".join(map(str, table["text"]))
        source = UrdfSource(text, table.attributes["base"], tuple(table.attributes["tip"].split("\n")))
        with naming(path):
            nominal = nominal._replace(urdf=located(source, nominal.arm))
    return Recording(
        capture,
        nominal,
        true,
        spheres=spheres,
        usual=record_in(ArmNoise, USUAL_NOISE, stored.tables.get("usual_noise")),
        as_found=as_found,
        recorded_as=record_in(RecordedAs, RECORDED_AS, stored.tables.get("recorded_as")),
        images=rows_in(ReadImage, IMAGES, "image", stored.tables.get("images")),
        **values_in(Recording, RECORDING, stored.tables, stored.attributes),
    )


def _field(entry: Entry) -> Field:
    if entry.content == "ids":
        return Field(entry.says, entry.unit, entry.dimensions, "count")
    return Field(entry.says, entry.unit, entry.dimensions, "number" if entry.content == "points" else entry.content)


def _observation(path: str | os.PathLike, table: StoredTable) -> AbstractObservation:
    """The observation of a table, by the entries that its kind declares; checked as when it was made."""
    attributes = table.attributes
    kind = kinds().get(attributes["kind"])
    if kind is None:
        raise InputError(
            f"{path} contains an observation of the unknown kind '{attributes['kind']}'; update aacmm_jax, or create "
            "the file again."
        )
    values: dict[str, Any] = {}
    for entry in kind.entries:
        name = entry.name if entry.dimensions else attribute_name(entry.name, _field(entry))
        source = table if entry.dimensions else attributes
        if entry.name == "q" and name in table:
            values[name] = _readings_of(table, name)
        elif entry.required or name in source:
            value = source[name]
            values[entry.name] = value.astype(str) if entry.dimensions and entry.content == "text" else value
    return kind.rebuilt(attributes["name"], values)


def _reading_variables(name: str, readings: Float[np.ndarray, "N n"], arm: Arm, rows: str = "pose") -> dict:
    """Readings as variables: those of the joints, and what was recorded beside them."""
    variables = {name: Variable((rows, "joint"), readings[:, : arm.joints], readings_unit(arm), "joint reading")}
    if arm.chains:
        variables["chain"] = Variable((rows,), readings[:, arm.joints], *_BESIDE[CHAIN][1:])
    slices = arm.beside.slices(readings.shape[1])
    for beside in arm.beside.names(readings.shape[1]):
        values, (variable, *says) = readings[:, slices[beside]], _BESIDE[beside]
        by_joint = beside in BY_JOINT
        axes = (rows, "joint") if by_joint else (rows,)
        variables[variable] = Variable(axes, values if by_joint else values[:, 0], *says)
    return variables


def _readings_of(table: Mapping[str, np.ndarray], name: str) -> Float[np.ndarray, "N n"]:
    """The readings that `_reading_variables` wrote, with what was recorded beside them."""
    beside = [table[_BESIDE[column][0]] for column in (CHAIN, *COLUMNS) if _BESIDE[column][0] in table]
    return np.column_stack([table[name], *beside]) if beside else table[name]


def _recorded(table: Mapping[str, np.ndarray]) -> list[str]:
    return [name for name in COLUMNS if _BESIDE[name][0] in table]


def lengths_of(stored: Stored) -> tuple[ReferenceLength, ...]:
    """The reference lengths that a file holds."""
    table = stored.tables["reference"]
    columns = (table[name].tolist() for name in LENGTHS if name in table)  # earlier versions: not whether corrected
    return tuple(ReferenceLength(*row) for row in zip(*columns, strict=True))


def sphere_table(spheres: Sequence[ProbedSphere], arm: Arm | None = None) -> Table:
    """Touched spheres, by poses of an arm or by points, one row a touch, with what belongs to the sphere in each."""
    rows = [
        (sphere, number, q) for sphere in spheres for number, group in enumerate(sphere.groups, start=1) for q in group
    ]
    values = np.array([touched for *_, touched in rows])
    variables = rows_table("touch", (sphere for sphere, *_ in rows), SPHERES).variables | columns(
        "touch", group=([number for _, number, _ in rows], "1", "number of the repetition or wrist orientation")
    )
    if arm is None:
        return Table(variables | {"position": Variable(("touch", "axis"), values, "mm", "centre of the probe")})
    return Table(variables | _reading_variables("angle", values, arm, "touch"))


def spheres_of(stored: Stored, entry: str = "angle") -> tuple[ProbedSphere, ...]:
    """The touched spheres that a file holds, by their ``angle`` or ``position``."""
    table = stored.tables.get("sphere")
    if table is None:
        return ()
    touched, groups = _readings_of(table, entry), table["group"]
    keys = list(zip(table["sphere"].tolist(), table["test"].tolist(), strict=True))
    spheres = []
    for key in dict.fromkeys(keys):
        rows = np.array([other == key for other in keys])
        values = row_values(ProbedSphere, SPHERES, "touch", table, int(rows.argmax()))
        members = tuple(touched[rows & (groups == number)] for number in np.unique(groups[rows]))
        spheres.append(ProbedSphere(groups=members, **values))
    return tuple(spheres)


def arm_table(specification: ArmSpecification) -> Table:
    """An arm as a table over ``joint``, with its proposed identification in attributes."""
    arm, prior = single(specification.arm), specification.prior
    values = dict.fromkeys(ARM) | specification._asdict() | {kind: getattr(arm, kind) for kind in GEOMETRY}
    values |= {"probe": np.asarray(arm.probe)[:3]} | (facts := chain_facts(arm))
    if arm.chains:
        values["chains"] = [f"{','.join(map(str, joints))} {name}" for name, joints in arm.chains]
    values |= {name: np.ravel(facts[name]).tolist() for name in {"mimic", "further_probes"} & facts.keys()}
    values |= {"prismatic": arm.prismatic or None} | {name: name in arm.recorded or None for name in COLUMNS}
    values["load_centre"] = arm.load_centre
    if arm.limits is not None:
        values["lowest"], values["highest"] = np.transpose(arm.limits)
    if arm.corrections is not None:
        numbers, loads = np.asarray(arm.coefficients), loads_of(arm)
        values |= {f"nominal_{kind}": getattr(arm.corrections.nominal, kind) for kind in GEOMETRY}
        values |= {} if loads is None else {"mass": loads.mass, "centre": loads.centre}
        values |= {"coefficient": correction_names(arm)[: len(numbers)], "coefficients": numbers}
        values |= {"coefficient_unit": [function.unit for function in arm.corrections.functions.terms]}
        values["gravity"] = arm.gravity
    if prior is not None:
        # Without a standard deviation a group is learned, or nothing is known of it.
        values |= {
            "prior_groups": prior.groups,
            "prior_sd": [float(prior.sd[group]) if group in prior.sd else np.inf for group in prior.groups],
            "prior_learned": [group for group, learned in zip(prior.groups, prior.learned, strict=True) if learned],
            "prior_mean_of": tuple(prior.mean),
            "prior_mean": [float(value) for value in prior.mean.values()],
        }
    table = table_of(SimpleNamespace(**values), ARM)
    for name in {"lowest", "highest"} & table.variables.keys():
        table.variables[name] = table.variables[name]._replace(units=readings_unit(arm))
    return table


def specification_of(path: str | os.PathLike, stored: Stored, name: str) -> ArmSpecification:
    """The arm that a table holds."""
    table = stored.tables[name]
    attributes, limits = table.attributes, None
    if "lowest" in table:
        limits = list(zip(table["lowest"].tolist(), table["highest"].tolist(), strict=True))
    chains = [str(text).partition(" ") for text in attributes.get("chains", ())]
    geometry = {kind: table.get(kind) if kind == "beta" else table[kind] for kind in GEOMETRY}
    geometry["probe"] = np.append(table["probe"], attributes.get("further_probes", ()))
    with naming(path):
        arm = Arm(
            **geometry,
            limits=limits,
            prismatic=list(attributes.get("prismatic", ())),
            fixed=list(attributes.get("fixed", ())),
            mimic=[(int(i), int(j), x, y) for i, j, x, y in np.reshape(attributes.get("mimic", ()), (-1, 4)).tolist()],
            chains=[(name, [int(i) for i in joints.split(",")]) for joints, _, name in chains],
            load_centre=attributes.get("load_centre"),
        )
        arm = reading_as(arm, [name for name in COLUMNS if attributes.get(name, False)])
        if "coefficients" in table:
            nominal = {kind: table[f"nominal_{kind}"] for kind in GEOMETRY if f"nominal_{kind}" in table}
            coefficients = dict(zip(map(str, table["coefficient"]), table["coefficients"], strict=True))
            options = {key: table.get(key) for key in ("mass", "centre", "gravity")}
            arm = with_coefficients(arm, coefficients, nominal, options)
    fields = {key: field for key, field in ARM.items() if key in ArmSpecification._fields}
    proposed = values_in(ArmSpecification, fields, table, attributes)
    widths = (proposed["length"], proposed["angle"], *proposed["override"].values())
    check_sense(
        path, {"a half-width of the bounds is not positive and finite": not all(0 < width < np.inf for width in widths)}
    )
    prior = None
    if "prior_groups" in attributes:
        sd = dict(zip(attributes["prior_groups"], attributes["prior_sd"], strict=True))
        mean = dict(zip(attributes["prior_mean_of"], attributes["prior_mean"], strict=True))
        prior = Prior(sd, mean=mean, learn=tuple(attributes["prior_learned"]))
    return ArmSpecification(arm=arm, prior=prior, **proposed)
