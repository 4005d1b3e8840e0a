"""Captures in HDF5: the poses, the reference lengths, the nominal arm and, for a simulation, the true one."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from . import storage
from .arm import Arm
from .capture import Capture, ReferenceLength
from .errors import InputError
from .recording import ArmSpecification, ProbedSphere, Recording, checked_sphere, single
from .storage import Table, Variable

_KINDS = {"alpha": "link twist", "a": "link length", "d": "link offset", "theta": "joint zero offset", "beta": "Hayati's angle"}


def save_capture(path: str | os.PathLike, recording: Recording) -> None:
    """Write a capture with its arms to HDF5, whole or not at all."""
    storage.write_tables(path, "capture", recording_tables(recording), recording_attributes(recording))


def load_capture(path: str | os.PathLike) -> Recording:
    """Read a capture with its arms. Raises `InputError` where the file is missing, damaged, foreign or newer."""
    stored = storage.read_tables(path, ("capture", "calibration"))
    with storage.undamaged(path):
        return recording_of(path, stored)


def recording_attributes(recording: Recording) -> dict[str, Any]:
    """Root attributes of a file that holds a recording."""
    return {"seed": recording.seed, "sources": list(recording.sources) or None}


def recording_tables(recording: Recording) -> dict[str, Table]:
    """The tables of a recording: ``capture``, ``reference``, ``nominal_arm`` and perhaps ``true_arm``."""
    capture = recording.capture
    owner = [capture.names[i] for i in capture.owner]
    tables = {
        "capture": Table(
            {
                "pose": Variable(("pose",), np.arange(1, len(owner) + 1), "1", "pose number"),
                "joint": Variable(("joint",), np.arange(1, capture.joints + 1), "1", "joint number"),
                "angle": Variable(("pose", "joint"), np.asarray(capture.q), "rad", "joint angle as read"),
                "socket": Variable(("pose",), owner, "", "socket that held the tip"),
            }
        ),
        "reference": Table(
            {
                "length": Variable(("length",), np.arange(1, len(capture.lengths) + 1), "1", "reference length number"),
                "start": Variable(("length",), [length.start for length in capture.lengths], "", "socket at one end"),
                "end": Variable(("length",), [length.end for length in capture.lengths], "", "socket at the other end"),
                "value": Variable(("length",), [float(length.value) for length in capture.lengths], "mm", "calibrated length"),
                "u": Variable(("length",), [float(length.u) for length in capture.lengths], "mm", "standard uncertainty"),
            }
        ),
        "nominal_arm": arm_table(recording.nominal),
    }
    if recording.true is not None:
        tables["true_arm"] = arm_table(recording.true)
    if recording.spheres:
        tables["sphere"] = _sphere_table(recording.spheres)
    return tables


def _sphere_table(spheres: Sequence[ProbedSphere]) -> Table:
    """Touched spheres, one row a touch; what belongs to a sphere stands in every row of it."""
    rows = [(sphere, number, q) for sphere in spheres for number, group in enumerate(sphere.groups, start=1) for q in group]
    each = {
        "sphere": ([sphere.name for sphere, *_ in rows], "", "reference sphere"),
        "test": ([sphere.test for sphere, *_ in rows], "", "acceptance test that the sphere was touched for"),
        "group": ([number for _, number, _ in rows], "1", "repeat, or orientation of the wrist"),
        "diameter": ([sphere.diameter for sphere, *_ in rows], "mm", "calibrated diameter"),
        "u": ([sphere.u for sphere, *_ in rows], "mm", "standard uncertainty of the diameter"),
        "stylus": ([sphere.stylus for sphere, *_ in rows], "mm", "diameter of the probe's ball"),
    }
    variables = {name: Variable(("touch",), *column) for name, column in each.items()}
    variables["touch"] = Variable(("touch",), np.arange(1, len(rows) + 1), "1", "touch number")
    joints = rows[0][2].shape[0]
    variables["joint"] = Variable(("joint",), np.arange(1, joints + 1), "1", "joint number")
    variables["angle"] = Variable(("touch", "joint"), np.array([q for *_, q in rows]), "rad", "joint angle as read")
    return Table(variables)


def _spheres_of(path: str | os.PathLike, stored: storage.Stored) -> tuple[ProbedSphere, ...]:
    table = stored.tables.get("sphere")
    if table is None:
        return ()
    storage.need(path, table, "sphere", "test", "group", "diameter", "u", "stylus", "angle", of="entry")
    keys = list(zip(table["sphere"].tolist(), table["test"].tolist(), strict=True))
    found = []
    for name, test in dict.fromkeys(keys):
        rows = np.array([key == (name, test) for key in keys])
        first = int(rows.argmax())
        groups = tuple(table["angle"][rows & (table["group"] == number)] for number in np.unique(table["group"][rows]))
        numbers = (float(table[what][first]) for what in ("diameter", "u", "stylus"))
        found.append(ProbedSphere(str(name), test, groups, *numbers))
    return tuple(found)


def recording_of(path: str | os.PathLike, stored: storage.Stored) -> Recording:
    """The recording that a file's tables hold."""
    storage.need(path, stored.tables, "capture", "reference", "nominal_arm")
    poses, reference = stored.tables["capture"], stored.tables["reference"]
    storage.need(path, poses, "angle", "socket", of="entry")
    storage.need(path, reference, "start", "end", "value", "u", of="entry")
    owner = np.asarray(poses["socket"]).astype(str)
    names = list(dict.fromkeys(owner.tolist()))
    rows = zip(reference["start"], reference["end"], reference["value"], reference["u"], strict=True)
    try:
        capture = Capture(
            {name: poses["angle"][owner == name] for name in names},
            [ReferenceLength(str(start), str(end), float(value), float(u)) for start, end, value, u in rows],
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    true = specification_of(path, stored, "true_arm") if "true_arm" in stored.tables else None
    try:
        spheres = tuple(checked_sphere(sphere, capture.joints) for sphere in _spheres_of(path, stored))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    sources = tuple(stored.attributes.get("sources") or ())
    return Recording(
        capture, specification_of(path, stored, "nominal_arm"), true, stored.attributes.get("seed"), spheres, sources
    )


def arm_table(specification: ArmSpecification) -> Table:
    """An arm as a table over ``joint``, with its proposed identification in attributes."""
    arm = single(specification.arm)
    variables = {
        "joint": Variable(("joint",), np.arange(1, arm.joints + 1), "1", "joint number"),
        "axis": Variable(("axis",), ["x", "y", "z"], "", "axis of the last frame"),
        "probe": Variable(("axis",), np.asarray(arm.probe), "mm", "tip in the last frame"),
    }
    for kind, long_name in _KINDS.items():
        values = getattr(arm, kind)
        if values is not None:
            unit = "mm" if kind in ("a", "d") else "rad"
            variables[kind] = Variable(("joint",), np.asarray(values), unit, long_name)
    if arm.limits is not None:
        for side, name in enumerate(("lowest", "highest")):
            values = [limit[side] for limit in arm.limits]
            variables[name] = Variable(("joint",), values, "rad", f"{name} reading of the joint")
    attributes: dict[str, Any] = {
        "name": specification.name,
        "half_width_length_mm": specification.length,
        "half_width_angle_rad": specification.angle,
        "override_names": list(specification.override) or None,
        "override_half_widths": [float(width) for width in specification.override.values()] or None,
        "held": None if specification.held is None else ",".join(specification.held),
    }
    return Table(variables, attributes)


def specification_of(path: str | os.PathLike, stored: storage.Stored, table: str) -> ArmSpecification:
    """The arm that a table holds."""
    arrays: Mapping[str, np.ndarray] = stored.tables[table]
    attributes = stored.table_attributes[table]
    storage.need(path, arrays, "alpha", "a", "d", "theta", "probe", of="entry")
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
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    override = zip(attributes.get("override_names") or [], attributes.get("override_half_widths") or [], strict=True)
    return ArmSpecification(
        arm=arm,
        name=attributes.get("name", ""),
        held=None if held is None else tuple(name for name in held.split(",") if name),
        length=attributes.get("half_width_length_mm", 10.0),
        angle=attributes.get("half_width_angle_rad", 0.0175),
        override=dict(override),
    )
