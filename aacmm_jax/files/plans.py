"""Plans as files: the poses of a calibration or of an acceptance test as CSV, and the manifest for the readings."""

import json
import os
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

from ..acceptance.procedure import TOUCHED, Procedure
from ..acceptance.procedure_items import ProcedureItem
from ..acceptance.standards import PLANNED
from ..core.text import csv_text
from ..core.units import DEG
from ..data.observations.declared import Entry
from ..data.observations.observation import AbstractObservation
from ..data.observations.socket import Socket
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
    above = points + plan.retract * plan.cones.normals[plan.owner]
    return _poses_csv(
        plan.arm, ["socket"], [[owner] for owner in owners], points, plan.q, angles, plan.motion.approach, above
    )


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
        lines += ["", "[[socket]]", f"name = {_quoted(name)}", f"file = {_quoted(name + '.csv')}"]
    for length in plan.lengths:
        lines += [
            "",
            "[[length]]",
            f"from = {_quoted(length.start)}",
            f"to = {_quoted(length.end)}",
            f"value = {round(float(length.value), 6)!r}   # mm: the calibrated length",
            f"u = {float(length.u)!r}   # mm: its standard uncertainty",
        ]
    return "\n".join(lines) + "\n"


def kit_csv(plan: KitPlan, angles: Angles = "deg") -> str:
    """A row for each pose of a plan with a kit: observation, point of an artefact or plane, position, readings."""
    labels, points, q, approach, above = [], [], [], [], []
    motions = plan.motions or (None,) * len(plan.kit)
    for simulated, one, motion in zip(plan.kit, plan.observations, motions, strict=True):
        label, readings = _label(one), np.asarray(one.q)
        held = [""] * len(readings) if label is None else [str(text) for text in one.stored()[label.name]]
        labels += [[one.name, point] for point in held]
        arm = plan.arm if simulated.offset is None else plan.arm.replace(probe=simulated.offset)
        points.append(np.asarray(arm.position(readings)))
        q.append(readings)
        moved = np.full_like(readings, np.nan) if motion is None or motion.approach is None else motion.approach
        approach.append(moved)
        above.append(np.asarray(arm.position(moved)))
    tips, readings = np.concatenate(points), np.concatenate(q)
    if not plan.retract:
        return _poses_csv(plan.arm, ["observation", "point"], labels, tips, readings, angles)
    moved, over = np.concatenate(approach), np.concatenate(above)
    return _poses_csv(plan.arm, ["observation", "point"], labels, tips, readings, angles, moved, over)


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
    for one in plan.observations:
        lines += ["", *_table(one, plan.arm.joints)]
    return "\n".join(lines) + "\n"


def _table(observation: AbstractObservation, joints: int) -> list[str]:
    """The table of one observation."""
    file, stored, label = observation.name.replace("/", "-"), observation.stored(), _label(observation)
    lines = [f"[[{observation.table}]]", f"name = {_quoted(observation.name)}"]
    if label is None:
        lines.append(f"file = {_quoted(file + '.csv')}")
    else:
        held = dict.fromkeys(str(text) for text in stored[label.name])
        files = ", ".join(f"{_quoted(point)} = {_quoted(f'{file}-{point}.csv')}" for point in held)
        lines.append(f"files = {{ {files} }}")
    if isinstance(observation, Socket):
        return lines + ([f"target = {_quoted(observation.target)}"] if observation.target else [])
    columns, next_column = [], joints + 1
    for entry in observation.entries:
        value = stored.get(entry.name)
        if value is None or entry.name == "q" or entry is label:
            continue
        if not entry.dimensions:
            lines += _single(entry, value)
        elif entry.dimensions[0] == "pose" and entry.required:
            # A rotation is recorded as a quaternion.
            count = 4 if entry.unit == "1" else 3 ** (len(entry.dimensions) - 1)
            numbers = list(range(next_column, next_column + count))
            columns.append(f"{entry.name} = {numbers if count > 1 else numbers[0]}")
            next_column += count
            lines += ['rotation = "quaternion wxyz"'] if entry.unit == "1" else []
        elif entry.dimensions[-1] == "axis" and entry.dimensions[0] != "pose":
            names = [str(name) for name in stored[entry.dimensions[0]]]
            points = ", ".join(
                f"{_quoted(name)} = {[round(float(x), 6) for x in point]}"
                for name, point in zip(names, np.asarray(value), strict=True)
            )
            lines.append(f"{entry.name} = {{ {points} }}   # {entry.unit}: {entry.says}")
    if columns:
        u = _largest_u(observation)
        lines += [f"columns = {{ {', '.join(columns)} }}", f"u = {u!r}   # mm: standard uncertainty (k = 1)"]
    return lines


def _single(entry: Entry, value: object) -> list[str]:
    if entry.content == "text":
        return [f"{entry.name} = {_quoted(str(value))}"] if value else []
    if entry.content == "truth":
        return [f"{entry.name} = true"] if value else []
    return [f"{entry.name} = {round(float(np.asarray(value)), 9)!r}   # {entry.unit}: {entry.says}"]


def _largest_u(observation: AbstractObservation) -> float:
    """Standard uncertainty of what an instrument measures, mm."""
    covariance = getattr(observation, "covariance", None)
    values = np.sqrt(np.asarray(covariance)) if covariance is not None else np.asarray(getattr(observation, "u", 0.0))
    return round(float(np.max(values)), 9)


def _manifest_start(
    arm: str, urdf: UrdfSource | None, *comments: str, acceptance: str | None = None, angles: Angles = "deg"
) -> list[str]:
    """The first lines of a manifest of readings; those of prismatic joints are in mm, which is the default."""
    date = "# date = 2026-01-31   # when it was recorded"
    links = [] if urdf is None else [f"base = {_quoted(urdf.base)}", f"tip = {_quoted(urdf.tip)}"]
    made_for = [] if acceptance is None else [f"acceptance = {_quoted(acceptance)}"]
    return [*comments, f"arm = {_quoted(arm)}", *links, *made_for, date, "", "[angles]", f'unit = "{angles}"']


def procedure_csv(procedure: Procedure, angles: Angles = "deg") -> str:
    """A row for each pose of an acceptance test: test, name, file for its reading, position, readings."""
    items = (*procedure.sockets, *procedure.touches)
    labels = ([item.test, item.name, file_of(procedure, item)] for item in items for _ in item.q)
    points, q = (np.concatenate([getattr(item, kind) for item in items]) for kind in ("points", "q"))
    return _poses_csv(procedure.arm, ["test", "name", "file"], labels, points, q, angles)


def _poses_csv(
    arm: Arm,
    headings: list[str],
    labels: Iterable[list[str]],
    points: np.ndarray,
    q: np.ndarray,
    angles: Angles = "deg",
    approach: np.ndarray | None = None,
    above: np.ndarray | None = None,
) -> str:
    """A row for each pose: number, labels, where the tip is (mm), joint readings, direction of the probe.

    With approach configurations, a row for them before and after each pose; not where they are not finite.
    """
    readings = [f"q_{i}_{unit}" for i, unit in enumerate(by_joint(arm, angles, "mm"), start=1)]
    direction = [f"probe_direction_{axis}" for axis in "xyz"]
    moves = [] if approach is None else ["move"]
    rows: list[list[Any]] = [["pose", *moves, *headings, "x_mm", "y_mm", "z_mm", *readings, *direction]]
    unit, digits = (DEG, 3) if angles == "deg" else (1.0, 6)
    units = np.array(by_joint(arm, unit, 1.0))

    def numbers(at: np.ndarray, tips: np.ndarray) -> list[list[str]]:
        axes = np.asarray(arm.pose(at))[:, :3, 2]
        rows = zip(tips, at / units, axes, strict=True)
        return [
            [*(f"{x:.3f}" for x in tip), *(f"{x:.{digits}f}" for x in reading), *(f"{x:.2f}" for x in axis)]
            for tip, reading, axis in rows
        ]

    found = numbers(q, points)
    around = None if approach is None or above is None else numbers(approach, above)
    for number, label in enumerate(labels):
        pose = [number + 1, *(["pose"] if moves else []), *label, *found[number]]
        if around is None or approach is None or not np.all(np.isfinite(approach[number])):
            rows.append(pose)
            continue
        before, after = ([number + 1, move, *label, *around[number]] for move in ("approach", "retract"))
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
        lines += ["", "[[socket]]", f"name = {_quoted(pattern)}", f"file = {_quoted(pattern + '.csv')}"]
    for kind in kinds:
        value = next((value for start, _, value in procedure.lengths if start.startswith(f"{kind}/")), None)
        if value is not None:
            ends = [f"{key} = {_quoted(f'{kind}/{{position}}/{side}')}" for key, side in (("from", "a"), ("to", "b"))]
            lines += [
                "",
                "[[length]]",
                *ends,
                f"value = {value!r}   # mm: the calibrated length",
                "u = 0.002   # mm: its standard uncertainty",
            ]
    for sphere in procedure.spheres:
        of = [item for item in procedure.touches if item.name == sphere.name and TOUCHED[item.test] == sphere.test]
        files = ", ".join(_quoted(file_of(procedure, item)) for item in of)
        lines += [
            "",
            "[[sphere]]",
            f"name = {_quoted(sphere.name)}",
            f"test = {_quoted(sphere.test)}",
            f"files = [{files}]",
        ]
        lines += [
            f"diameter = {sphere.diameter!r}   # mm: the calibrated diameter",
            "u = 0.0005   # mm: its standard uncertainty",
        ]
        lines += [
            f"stylus = {sphere.stylus!r}   # mm: diameter of the probe's ball",
            "form = 0.0   # mm: its calibrated form error",
            "u_form = 0.0   # mm: the standard uncertainty of that",
        ]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)  # a TOML basic string
