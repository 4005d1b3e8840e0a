"""Plans as files: the poses of a calibration or of an acceptance test as CSV, and the manifest for the readings."""

import json
import os
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np

from ..acceptance.procedure import TOUCHED, Procedure, ProcedureItem
from ..acceptance.standards import PLANNED
from ..core.text import csv_text
from ..core.units import DEG
from ..data.observations.declared import Entry
from ..data.observations.held import Socket
from ..data.observations.observation import AbstractObservation
from ..kinematics.arm import Arm, by_joint
from ..kinematics.parameters import UrdfSource
from ..planning.design import Plan
from ..planning.kit import KitPlan
from .outputs import write_text

Angles = Literal["deg", "rad"]


def save_plan(path: str | os.PathLike, plan: Plan | KitPlan, *, angles: Angles = "deg") -> None:
    """Write the poses of a plan as CSV, in the order in which to take them.

    Columns: ``pose``, ``move`` (where there are approach points: "approach", "pose" and "retract" for each pose),
    ``socket`` (of a kit: ``observation`` and ``point``), ``x_mm``, ``y_mm``, ``z_mm`` (the tip), ``q_1_deg`` or
    ``q_1_rad`` and so on (joint readings; ``q_1_mm`` of a prismatic joint), ``probe_direction_x``, ``_y``, ``_z`` (the
    last frame's z axis).

    Args:
        path: the file to write.
        plan: what `planning.plan` or `planning.plan_kit` returned.
        angles: the unit of the joint readings.

    Raises:
        InputError: the file cannot be written.

    Example:
        >>> from pathlib import Path
        >>> planned = aj.planning.plan(arm, sockets=four, poses=12, lengths=bars, candidates=60)
        >>> aj.files.save_plan("plan.csv", planned)
        >>> print(Path("plan.csv").read_text().split(",")[:6])
        ['pose', 'socket', 'x_mm', 'y_mm', 'z_mm', 'q_1_deg']
    """
    write_text(path, plan_csv(plan, angles) if isinstance(plan, Plan) else kit_csv(plan, angles))


def plan_csv(plan: Plan, angles: Angles = "deg") -> str:
    """The text of `save_plan`."""
    names = list(plan.sockets)
    owners = [names[owner] for owner in plan.owner]
    points = np.array([plan.sockets[name] for name in owners])
    approach, above = plan.motion.approach, points + plan.retract * plan.cones.normals[plan.owner]
    moves = None if approach is None else (approach, above)
    return _poses_csv(plan.arm, ["socket"], [[owner] for owner in owners], (plan.q, points), angles, moves)


def plan_manifest(plan: Plan, arm: str, urdf: UrdfSource | None = None, angles: Angles = "deg") -> str:
    """A manifest for the readings of a planned calibration, in which the calibrated lengths are to be filled in.

    ``urdf``: where the arm is a URDF, its links.
    """
    lines = _manifest_start(
        arm,
        urdf,
        "# A calibration, as planned. Fill in the calibrated lengths and uncertainties (k = 1), record a file for each",
        "# socket (one row a pose, in the order of the plan), then: aacmm import THIS.toml -o capture.h5",
        angles=angles,
    )
    for name in plan.sockets:
        lines += _table("socket", {"name": name, "file": f"{name}.csv"})
    for length in plan.lengths:
        ends = {"from": length.start, "to": length.end}
        lines += _table("length", ends | _length(round(float(length.value), 6), float(length.u)))
    return "\n".join(lines) + "\n"


def kit_csv(plan: KitPlan, angles: Angles = "deg") -> str:
    """A row for each pose of a plan with a kit: observation, point of an artefact or plane, position, readings."""
    labels, points, q, approach, above = [], [], [], [], []
    motions = plan.motions or (None,) * len(plan.kit)
    for simulated, observation, motion in zip(plan.kit, plan.observations, motions, strict=True):
        label, readings = _label(observation), np.asarray(observation.q)
        touched = [""] * len(readings) if label is None else observation.stored()[label.name]
        labels += [[observation.name, str(point)] for point in touched]
        arm = plan.arm if simulated.offset is None else plan.arm.replace(probe=simulated.offset)
        points.append(np.asarray(arm.position(readings)))
        q.append(readings)
        moved = np.full_like(readings, np.nan) if motion is None or motion.approach is None else motion.approach
        approach.append(moved)
        above.append(np.asarray(arm.position(moved)))
    poses = np.concatenate(q), np.concatenate(points)
    moves = (np.concatenate(approach), np.concatenate(above)) if plan.retract else None
    return _poses_csv(plan.arm, ["observation", "point"], labels, poses, angles, moves)


def _label(observation: AbstractObservation) -> Entry | None:
    """The entry that names what each pose was in."""
    return next((e for e in observation.entries if e.content == "text" and e.dimensions == ("pose",)), None)


def kit_manifest(plan: KitPlan, arm: str, urdf: UrdfSource | None = None, angles: Angles = "deg") -> str:
    """A manifest for the readings of a plan with a kit, in which certified values are to be filled in.

    Files hold the joint readings in their first columns and, where something is measured, its numbers in the next.
    ``urdf`` says the links where the arm is a URDF.
    """
    lines = _manifest_start(
        arm,
        urdf,
        "# A calibration, as planned. Fill in certified values and uncertainties (k = 1), record the files (one row a",
        "# pose, in the order of the plan: joint readings, then what was measured), then: aacmm import THIS.toml -o",
        "# capture.h5",
        angles=angles,
    )
    for observation in plan.observations:
        lines += _table(observation.table, _observation(observation, plan.arm.joints))
    return "\n".join(lines) + "\n"


def _observation(observation: AbstractObservation, joints: int) -> dict[str, Any]:
    """The table of one observation."""
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
            count = 4 if entry.unit == "1" else 3 ** (len(entry.dimensions) - 1)
            columns[entry.name] = list(range(next_column, next_column + count)) if count > 1 else next_column
            next_column += count
            table |= {"rotation": "quaternion wxyz"} if entry.unit == "1" else {}
        elif entry.dimensions[-1] == "axis" and entry.dimensions[0] != "pose":
            points = zip(stored[entry.dimensions[0]], np.asarray(value).tolist(), strict=True)
            table[entry.name] = {str(name): [round(x, 6) for x in point] for name, point in points}, says
    if columns:
        covariance = getattr(observation, "covariance", None)
        u = np.sqrt(covariance) if covariance is not None else getattr(observation, "u", 0.0)
        table |= {"columns": columns, "u": (round(float(np.max(u)), 9), "mm: standard uncertainty (k = 1)")}
    return table


def _manifest_start(
    arm: str, urdf: UrdfSource | None, *comments: str, acceptance: str | None = None, angles: Angles = "deg"
) -> list[str]:
    """The first lines of a manifest of readings; those of prismatic joints are in mm, which is the default."""
    entries = {"arm": arm} | ({} if urdf is None else {"base": urdf.base, "tip": urdf.tip})
    entries |= {} if acceptance is None else {"acceptance": acceptance}
    date = "# date = 2026-01-31   # when it was recorded"
    return [*comments, *_entries(entries), date, "", "[angles]", f'unit = "{angles}"']


def _table(heading: str, entries: Mapping[str, Any]) -> list[str]:
    """A table of a manifest."""
    return ["", f"[[{heading}]]", *_entries(entries)]


def _entries(entries: Mapping[str, Any]) -> list[str]:
    """Lines of TOML: of each key a value, or a value and what it is."""
    pairs = {key: entry if isinstance(entry, tuple) else (entry, "") for key, entry in entries.items()}
    return [f"{key} = {_toml(value)}" + (f"   # {says}" if says else "") for key, (value, says) in pairs.items()]


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{_key(key)} = {_toml(entry)}' for key, entry in value.items())} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False)  # as TOML writes texts, numbers and truth values


def _key(name: str) -> str:
    return name if name.isidentifier() and name.isascii() else _toml(name)


def _length(value: float, u: float) -> dict[str, Any]:
    return {"value": (value, "mm: the calibrated length"), "u": (u, "mm: its standard uncertainty")}


def procedure_csv(procedure: Procedure, angles: Angles = "deg") -> str:
    """A row for each pose of an acceptance test: test, name, file for its reading, position, readings."""
    items = (*procedure.sockets, *procedure.touches)
    labels = ([item.test, item.name, file_of(procedure, item)] for item in items for _ in item.q)
    q, points = (np.concatenate([getattr(item, kind) for item in items]) for kind in ("q", "points"))
    return _poses_csv(procedure.arm, ["test", "name", "file"], labels, (q, points), angles)


def _poses_csv(
    arm: Arm,
    headings: list[str],
    labels: Iterable[list[str]],
    poses: tuple[np.ndarray, np.ndarray],
    angles: Angles = "deg",
    moves: tuple[np.ndarray, np.ndarray] | None = None,
) -> str:
    """A row for each pose: number, labels, where the tip is (mm), joint readings, direction of the probe.

    ``poses`` are readings and tips; ``moves`` are those of the approach, which have a row before and after each pose;
    not where they are not finite.
    """
    readings = [f"q_{i}_{unit}" for i, unit in enumerate(by_joint(arm, angles, "mm"), start=1)]
    direction = [f"probe_direction_{axis}" for axis in "xyz"]
    move = [] if moves is None else ["move"]
    rows: list[list[Any]] = [["pose", *move, *headings, "x_mm", "y_mm", "z_mm", *readings, *direction]]
    unit, digits = (DEG, 3) if angles == "deg" else (1.0, 6)
    units = np.array(by_joint(arm, unit, 1.0))

    def numbers(q: np.ndarray, tips: np.ndarray) -> list[list[str]]:
        rows = zip(tips, q / units, np.asarray(arm.pose(q))[:, :3, 2], strict=True)
        return [
            [*(f"{x:.3f}" for x in tip), *(f"{x:.{digits}f}" for x in reading), *(f"{x:.2f}" for x in axis)]
            for tip, reading, axis in rows
        ]

    at_poses, around = numbers(*poses), None if moves is None else numbers(*moves)
    for i, label in enumerate(labels):
        pose = [i + 1, *(["pose"] if move else []), *label, *at_poses[i]]
        if moves is None or around is None or not np.all(np.isfinite(moves[0][i])):
            rows.append(pose)
            continue
        before, after = ([i + 1, name, *label, *around[i]] for name in ("approach", "retract"))
        rows += [before, pose, after]
    return csv_text(rows)


def file_of(procedure: Procedure, item: ProcedureItem) -> str:
    """The file that a manifest of `procedure_manifest` expects an item's readings in."""
    if item.test not in TOUCHED:
        return f"{item.name}.csv"
    several = sum((other.test, other.name) == (item.test, item.name) for other in procedure.touches) > 1
    return f"{item.name}/{item.test.replace(' ', '-')}" + (f"-{item.group}" if several else "") + ".csv"


def procedure_manifest(procedure: Procedure, arm: str, urdf: UrdfSource | None = None, angles: Angles = "deg") -> str:
    """A manifest for the readings of an acceptance test, in which the calibrated values are to be filled in.

    ``urdf``: where the arm is a URDF, its links.
    """
    lines = _manifest_start(
        arm,
        urdf,
        f"# {PLANNED[procedure.standard]}, as planned. Fill in the calibrated values and uncertainties (k = 1) of your",
        "# artefacts, record a file for each socket and each group of touches (one row a pose, in the order of the",
        "# plan), then: aacmm import THIS.toml -o acceptance.h5",
        acceptance=procedure.standard,
        angles=angles,
    )
    size = f"measuring_range = {procedure.measuring_range:.0f}   # mm: its diameter, as the maker states it"
    lines.insert(lines.index(""), size if procedure.range_stated else f"# {size}; planned: twice the reach")
    kinds = dict.fromkeys(item.name.split("/")[0] for item in procedure.sockets)
    for kind in kinds:
        pattern = f"{kind}/{{zone}}" if kind == "spat" else f"{kind}/{{position}}/{{side}}"
        lines += _table("socket", {"name": pattern, "file": f"{pattern}.csv"})
    for kind in kinds:
        value = next((value for start, _, value in procedure.lengths if start.startswith(f"{kind}/")), None)
        if value is not None:
            ends = {"from": f"{kind}/{{position}}/a", "to": f"{kind}/{{position}}/b"}
            lines += _table("length", ends | _length(value, 0.002))
    for sphere in procedure.spheres:
        touches = [item for item in procedure.touches if (item.name, TOUCHED[item.test]) == (sphere.name, sphere.test)]
        entries = {
            "name": sphere.name,
            "test": sphere.test,
            "files": [file_of(procedure, item) for item in touches],
            "diameter": (sphere.diameter, "mm: the calibrated diameter"),
            "u": (0.0005, "mm: its standard uncertainty"),
            "stylus": (sphere.stylus, "mm: diameter of the probe's ball"),
            "form": (0.0, "mm: its calibrated form error"),
            "u_form": (0.0, "mm: the standard uncertainty of that"),
        }
        lines += _table("sphere", entries)
    return "\n".join(lines) + "\n"
