"""Plans as files: the poses of a calibration or of an acceptance test as CSV, and the manifest for the readings."""

import json
import math
import os
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from ..acceptance.procedure import TOUCHED, Procedure, ProcedureItem
from ..acceptance.standards import STANDARDS
from ..core.errors import InputError
from ..core.text import csv_text
from ..core.units import DEG
from ..data.observations.declared import FREE, Entry
from ..data.observations.held import Socket
from ..data.observations.observation import AbstractObservation
from ..data.observations.pixels import Pixels
from ..kinematics.arm import Arm, by_joint
from ..kinematics.parameters import UrdfSource
from ..kinematics.robots import chain_of, chains_taken
from ..planning.design import Plan
from ..planning.kit import KitPlan
from ..planning.motion import start_from
from .outputs import write_text

Angles = Literal["deg", "rad"]
Planned = Plan | KitPlan | Procedure
_IN_SPACE = ("points", "transforms", "pixels")  # kinds of observations that leave the tip free


def save_plan(path: str | os.PathLike, plan: Planned, *, angles: Angles = "deg") -> None:
    """Write the poses of a plan as CSV, in the order in which to take them.

    Columns: ``pose``, ``move`` (where there are approach points: "approach", "pose" and "retract" for each pose),
    ``socket`` (of a kit: ``observation`` and ``point``; of an acceptance test: ``test``, ``name`` and the ``file`` for
    the reading), ``chain`` (of a robot, whose other joints are at rest), ``x_mm``, ``y_mm``, ``z_mm`` (the tip),
    ``q_1_deg`` or ``q_1_rad`` and so on (joint readings; ``q_1_mm`` of a prismatic joint), ``probe_direction_x``,
    ``_y``, ``_z`` (the last frame's z axis).

    Args:
        path: the file to write.
        plan: what `planning.plan`, `planning.plan_kit` or `acceptance.plan_procedure` returned.
        angles: the unit of the joint readings.

    Example:
        >>> from pathlib import Path
        >>> planned = aj.planning.plan(arm, sockets=four, poses=12, lengths=bars, candidates=60)
        >>> aj.files.save_plan("plan.csv", planned)
        >>> print(Path("plan.csv").read_text().split(",")[:6])
        ['pose', 'socket', 'x_mm', 'y_mm', 'z_mm', 'q_1_deg']
    """
    write_text(path, plan_csv(plan, angles))


def plan_csv(plan: Planned, angles: Angles = "deg", both_sides: bool = False) -> str:
    """The text of `save_plan`; with ``both_sides`` every pose twice, reached by each joint from opposite sides."""
    moved = above = None  # readings and tips of the approach, which has a row before and after each pose
    if isinstance(plan, Plan):
        names = list(plan.sockets)
        headings, labels = ["socket"], [[names[owner]] for owner in plan.owner]
        q, tips = plan.q, np.array([plan.sockets[name] for (name,) in labels])
        moved, above = plan.motion.approach, tips + plan.retract * plan.cones.normals[plan.owner]
    elif isinstance(plan, KitPlan):
        headings, (labels, q, tips, moved, above) = ["observation", "point"], _kit_poses(plan)
        moved = moved if plan.retract else None
    else:
        items = (*plan.sockets, *plan.touches)
        headings, labels = (
            ["test", "name", "file"],
            [[item.test, item.name, _file_of(plan, item)] for item in items for _ in item.q],
        )
        q, tips = (np.concatenate([getattr(item, kind) for item in items]) for kind in ("q", "points"))
    headings = [*headings, "chain"] if plan.arm.chains else headings
    labels = [[*label, *chain] for label, chain in zip(labels, _chain_labels(plan.arm, q), strict=True)]
    readings = [f"q_{i}_{unit}" for i, unit in enumerate(by_joint(plan.arm, angles, "mm"), start=1)]
    direction = [f"probe_direction_{axis}" for axis in "xyz"]
    move = [] if moved is None and not both_sides else ["move"]
    rows: list[list[Any]] = [["pose", *move, *headings, "x_mm", "y_mm", "z_mm", *readings, *direction]]
    unit, digits = (DEG, 3) if angles == "deg" else (1.0, 6)
    units = np.array(by_joint(plan.arm, unit, 1.0))

    def numbers(q: np.ndarray, tips: np.ndarray) -> list[list[str]]:
        rows = zip(tips, q[:, : len(units)] / units, np.asarray(plan.arm.pose(q))[:, :3, 2], strict=True)
        return [
            [*(f"{x:.3f}" for x in tip), *(f"{x:.{digits}f}" for x in reading), *(f"{x:.2f}" for x in axis)]
            for tip, reading, axis in rows
        ]

    if both_sides:
        rows[0] += [f"direction_{i}" for i in range(1, plan.arm.joints + 1)]
        for i, name, reading, tip, side in _from_both_sides(plan, q, tips):
            (values,) = numbers(reading[None], tip[None])
            rows.append([i + 1, name, *labels[i], *values, *(f"{sign:.0f}" for sign in side)])
        return csv_text(rows)
    at_poses, around = numbers(q, tips), [] if moved is None or above is None else numbers(moved, above)
    for i, label in enumerate(labels):
        pose = [i + 1, *(["pose"] if move else []), *label, *at_poses[i]]
        if moved is None or not np.all(np.isfinite(moved[i])):
            rows.append(pose)
            continue
        before, after = ([i + 1, name, *label, *around[i]] for name in ("approach", "retract"))
        rows += [before, pose, after]
    return csv_text(rows)


def _chain_labels(arm: Arm, q: np.ndarray) -> list[list[str]]:
    """What says of which chain of a robot each pose is; nothing without chains."""
    return [[name] for name in chains_taken(arm, q)] or [[]] * len(q)


def _from_both_sides(plan: Planned, q: np.ndarray, tips: np.ndarray) -> Iterator[tuple[int, str, Any, Any, Any]]:
    """Number of the pose, name of the move, readings, tip and directions of approach: every pose twice, with a start
    before it, so that each joint comes to it from one side and then from the other. The sides of the joints are drawn,
    so that play of one differs from that of another. Raises `InputError` where something holds the tip."""
    held = (
        [thing.name for thing in plan.observations if thing.kind not in _IN_SPACE] if isinstance(plan, KitPlan) else []
    )
    if held or not isinstance(plan, KitPlan):
        what = f"'{held[0]}' is touched" if held else "the poses are in sockets or on artefacts"
        raise InputError(
            f"--both-sides moves every joint towards its pose from either side, which takes the tip out of what holds "
            f"it, but {what}; plan for an instrument or camera that sees the arm (--kit)."
        )
    n, random = plan.arm.joints, np.random.default_rng(0)
    for i, (reading, tip) in enumerate(zip(q, tips, strict=True)):
        sides = random.choice([-1.0, 1.0], len(reading))[:n]
        for side in (sides, -sides):
            start = np.append(start_from(plan.arm, reading[:n], side), reading[n:])
            yield i, "approach", start, np.asarray(plan.arm.position(start)), side
            yield i, "pose", reading, tip, side


def _kit_poses(plan: KitPlan) -> tuple[list[list[str]], np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Labels, readings and tips of the poses of a plan with a kit, and those of the approach, which may be NaN."""
    labels, q, tips, moved, above = [], [], [], [], []
    motions = plan.motions or (None,) * len(plan.kit)
    for simulated, observation, motion in zip(plan.kit, plan.observations, motions, strict=True):
        label, readings = _label(observation), np.asarray(observation.q)
        touched = [""] * len(readings) if label is None else observation.stored()[label.name]
        labels += [[observation.name, str(point)] for point in touched]
        place = simulated.offset if simulated.aim is None else np.array(simulated.aim.place)
        arm = plan.arm if place is None else plan.arm.replace(probe=place)
        approach = None if motion is None else motion.approach
        q.append(readings)
        tips.append(np.asarray(arm.position(readings)))
        moved.append(np.full_like(readings, np.nan) if approach is None else approach)
        above.append(np.asarray(arm.position(moved[-1])))
    return labels, np.concatenate(q), np.concatenate(tips), np.concatenate(moved), np.concatenate(above)


def _label(observation: AbstractObservation) -> Entry | None:
    """The entry that names what each pose was in; None where nothing does, as of images not taken yet."""
    texts = (e for e in observation.entries if e.content == "text" and e.dimensions == ("pose",))
    return next((entry for entry in texts if getattr(observation, entry.name) is not None), None)


def _file_of(procedure: Procedure, item: ProcedureItem) -> str:
    """The file that the manifest of an acceptance test expects an item's readings in."""
    if item.test not in TOUCHED:
        return f"{item.name}.csv"
    several = sum((other.test, other.name) == (item.test, item.name) for other in procedure.touches) > 1
    return f"{item.name}/{item.test.replace(' ', '-')}" + (f"-{item.group}" if several else "") + ".csv"


_ROWS = "(one row per pose, in the order of the plan{}), then run: aacmm import THIS.toml -o {}.h5"
_ONE_TABLE = '# measurements = "THIS.csv"   # one table in place of the files, with the columns of the plan'
_WHAT = {
    Plan: "Manifest of a planned calibration. Fill in the calibrated lengths and uncertainties (k = 1), record one "
    "file per socket " + _ROWS.format("", "capture"),
    KitPlan: "Manifest of a planned calibration. Fill in certified values and uncertainties (k = 1), record the files "
    + _ROWS.format(": the joint readings first, then the measured values", "capture"),
    Procedure: "Manifest of a planned acceptance test ({}). Fill in the calibrated values and uncertainties (k = 1) of "
    "your artefacts, record one file per socket and per group of touches " + _ROWS.format("", "acceptance"),
}


def plan_manifest(
    plan: Planned,
    arm: str,
    urdf: UrdfSource | None = None,
    angles: Angles = "deg",
    targets: Sequence[Mapping[str, Any]] = (),
) -> str:
    """A manifest for the readings of a plan, in which the certified values are to be filled in.

    Files hold the joint readings in their first columns and, where something is measured, its numbers in the next;
    readings of prismatic joints are in mm. ``urdf``: where the arm is a URDF, its links. ``targets``: the targets of
    cameras, as in the kit.
    """
    entries: dict[str, Any] = {"arm": arm} | ({} if urdf is None else urdf.links)
    what, tables, size = _WHAT[type(plan)], [], []
    if isinstance(plan, Plan):
        for i, name in enumerate(plan.sockets):
            chains = dict.fromkeys(chains_taken(plan.arm, plan.q[plan.owner == i])) or {"": None}
            of_chain = ({"chain": chain} if chain else {} for chain in chains)
            tables += [
                ("socket", {"name": name, **chain, "file": "_".join([*chain.values(), name]) + ".csv"})
                for chain in of_chain
            ]
        for length in plan.lengths:
            value = _length(round(float(length.value), 6), float(length.u))
            tables.append(("length", {"from": length.start, "to": length.end} | value))
    elif isinstance(plan, KitPlan):
        tables += camera_tables([item for item in plan.observations if isinstance(item, Pixels)], targets)
        for item in plan.observations:
            names = chains_taken(plan.arm, np.asarray(item.q)[:1])
            joints = len(chain_of(plan.arm, names[0]).joints) if names else plan.arm.joints
            tables.append((item.table, _observation(item, joints) | ({"chain": names[0]} if names else {})))
    else:
        entries, what = entries | {"acceptance": plan.standard}, what.format(STANDARDS[plan.standard])
        stated = (
            f"measuring_range = {plan.measuring_range:.0f}   # mm: diameter of the measuring volume, as the maker "
            "states it"
        )
        size = [_ONE_TABLE, stated if plan.range_stated else f"# {stated} (the plan assumes twice the reach)"]
        tables = _of_procedure(plan)
    beside = ["# date = 2026-01-31   # day of the measurement", *size, "", "[angles]", f'unit = "{angles}"']
    return manifest_text(what, entries, beside, tables)


def manifest_text(
    what: str, entries: Mapping[str, Any], beside: Sequence[str], tables: Sequence[tuple[str, Mapping[str, Any]]]
) -> str:
    """A manifest: a comment, its first entries, other lines, and its tables."""
    comment = textwrap.fill(what, 118, initial_indent="# ", subsequent_indent="# ")
    lines = [comment, *_entries(entries), *beside]
    for heading, table in tables:
        lines += ["", f"[[{heading}]]", *_entries(table)]
    return "\n".join(lines) + "\n"


def camera_tables(
    observations: Sequence[Pixels], targets: Sequence[Mapping[str, Any]]
) -> list[tuple[str, dict[str, Any]]]:
    """The tables of targets, as they are stated, and those of the cameras of some observations."""
    cameras = {item.camera: item for item in observations}
    return [("target", dict(target)) for target in targets] + [("camera", _camera(item)) for item in cameras.values()]


def _of_procedure(procedure: Procedure) -> list[tuple[str, dict[str, Any]]]:
    """The tables of an acceptance test."""
    tables: list[tuple[str, dict[str, Any]]] = []
    kinds = dict.fromkeys(item.name.split("/")[0] for item in procedure.sockets)
    for kind in kinds:
        pattern = f"{kind}/{{zone}}" if not kind.startswith("bar") else f"{kind}/{{position}}/{{side}}"
        tables.append(("socket", {"name": pattern, "file": f"{pattern}.csv"}))
    for kind in kinds:
        value = next((value for start, _, value in procedure.lengths if start.startswith(f"{kind}/")), None)
        if value is not None:
            ends = {"from": f"{kind}/{{position}}/a", "to": f"{kind}/{{position}}/b"}
            tables.append(("length", ends | _length(value, 0.002)))
    for sphere in procedure.spheres:
        touches = [item for item in procedure.touches if (item.name, TOUCHED[item.test]) == (sphere.name, sphere.test)]
        entries = {
            "name": sphere.name,
            "test": sphere.test,
            "files": [_file_of(procedure, item) for item in touches],
            "diameter": (sphere.diameter, "mm: calibrated diameter"),
            "u": (0.0005, "mm: standard uncertainty of the diameter"),
            "stylus": (sphere.stylus, "mm: diameter of the probe's ball"),
            "form": (0.0, "mm: calibrated form error"),
            "u_form": (0.0, "mm: standard uncertainty of the form error"),
        }
        tables.append(("sphere", entries))
    return tables


def _camera(observation: Pixels) -> dict[str, Any]:
    """The table of a camera, with what was known of it for the plan."""
    names, u = observation.camera_model.names, np.asarray(observation.u_intrinsics)
    values = {name: round(float(x), 9) for name, x in zip(names, observation.intrinsics, strict=False)}
    table: dict[str, Any] = {"name": observation.camera, "model": observation.model}
    if observation.image_size is not None:
        table["image_size"] = [int(size) for size in observation.image_size]
    stated = {name: float(x) for name, x in zip(names, u, strict=False) if x > 0}
    says = '"free": the intrinsics are only starts; "exact"; or standard uncertainties by name'
    return table | {"intrinsics": values, "u": ("free" if np.any(u >= FREE) else stated or "exact", says)}


def images_table(observation: Pixels, says: str, kind: str = "png") -> dict[str, Any]:
    """The table of images that a camera took: files of a kind in a folder of their own, and a file of readings."""
    file = observation.name.replace("/", "-")
    return {
        "name": observation.name,
        "camera": observation.camera,
        "target": observation.board,
        "on_arm": "camera" if observation.on_arm else "target",
        "file": (f"{file}.csv", says),
        "images": f"{file}/*.{kind}",
    }


def _observation(observation: AbstractObservation, joints: int) -> dict[str, Any]:
    """The table of one observation."""
    if isinstance(observation, Pixels):
        return images_table(observation, "one row per image, in the order of the names of the images")
    file, stored, label = observation.name.replace("/", "-"), observation.stored(), _label(observation)
    table: dict[str, Any] = {"name": observation.name}
    if label is None:
        table["file"] = f"{file}.csv"
    else:
        table["files"] = {str(point): f"{file}-{point}.csv" for point in stored[label.name]}
    if isinstance(observation, Socket):
        return table | ({"target": observation.target} if observation.target else {})
    columns, next_column = {}, joints + 1
    for entry in observation.entries:
        value, says = stored.get(entry.name), f"{entry.unit}: {entry.says}"
        if value is None or entry.name == "q" or entry is label:
            continue
        if not entry.dimensions and entry.content in ("text", "truth"):
            table |= {entry.name: str(value) if entry.content == "text" else True} if value else {}
        elif not entry.dimensions:
            table[entry.name] = round(float(np.asarray(value)), 9), says
        elif entry.dimensions[0] == "pose" and entry.required:
            # A rotation is recorded as a quaternion.
            count = 4 if entry.unit == "1" else math.prod(entry.row_shape)
            columns[entry.name] = list(range(next_column, next_column + count)) if count > 1 else next_column
            next_column += count
            table |= {"rotation": "quaternion wxyz"} if entry.unit == "1" else {}
        elif entry.dimensions[-1] == "axis" and entry.dimensions[0] != "pose":
            points = zip(stored[entry.dimensions[0]], np.asarray(value).tolist(), strict=True)
            table[entry.name] = {str(name): [round(x, 6) for x in point] for name, point in points}, says
    if columns:
        covariance = getattr(observation, "covariance", None)
        u = np.sqrt(covariance) if covariance is not None else getattr(observation, "u", 0.0)
        unit = next((entry.unit for entry in observation.entries if entry.name == "u"), "mm")
        table |= {"columns": columns, "u": (round(float(np.max(u)), 9), f"{unit}: standard uncertainty (k = 1)")}
    return table


def _entries(entries: Mapping[str, Any]) -> list[str]:
    """Lines of TOML: of each key a value, or a value and what it is."""
    pairs = {key: entry if isinstance(entry, tuple) else (entry, "") for key, entry in entries.items()}
    return [f"{key} = {_toml(value)}" + (f"   # {says}" if says else "") for key, (value, says) in pairs.items()]


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        keys = [key if key.isidentifier() and key.isascii() else _toml(key) for key in value]
        pairs = zip(keys, map(_toml, value.values()), strict=True)
        return f"{{ {', '.join(f'{key} = {text}' for key, text in pairs)} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False)  # as TOML writes texts, numbers and truth values


def _length(value: float, u: float) -> dict[str, Any]:
    return {"value": (value, "mm: calibrated length"), "u": (u, "mm: standard uncertainty of the length")}
