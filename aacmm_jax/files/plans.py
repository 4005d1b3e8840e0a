"""Plans as files: the poses of a calibration or of an acceptance test as CSV, and the manifest for the readings."""

import csv
import io
import json
import os
from collections.abc import Iterable

import numpy as np

from ..acceptance.procedure import TOUCHED, Procedure
from ..acceptance.procedure_items import ProcedureItem
from ..acceptance.standards import PLANNED
from ..core.units import DEG
from ..kinematics.arm import Arm
from ..kinematics.parameters import UrdfSource
from ..planning.design import Plan
from .atomic_write import write_text


def save_plan(path: str | os.PathLike, plan: Plan) -> None:
    """Write the poses of a plan as CSV, in the order in which to take them.

    Columns: ``pose``, ``socket``, ``x_mm``, ``y_mm``, ``z_mm`` (the socket), ``q_1_deg`` and so on (joint readings),
    ``probe_direction_x``, ``_y``, ``_z`` (the last frame's z axis).

    Args:
        path: the file to write.
        plan: what `planning.plan` returned.

    Raises:
        InputError: the file cannot be written.
    """
    write_text(path, plan_csv(plan))


def plan_csv(plan: Plan) -> str:
    """The text of `save_plan`."""
    names = list(plan.sockets)
    owners = [names[owner] for owner in plan.owner]
    return _poses_csv(
        plan.arm, ["socket"], ([owner] for owner in owners), [plan.sockets[name] for name in owners], plan.q
    )


def plan_manifest(plan: Plan, arm: str, urdf: UrdfSource | None = None) -> str:
    """A manifest for the readings of a planned calibration, in which the calibrated lengths are to be filled in.

    ``urdf``: where the arm is a URDF, its links.
    """
    lines = _manifest_start(
        arm,
        urdf,
        "# A calibration, as planned. Fill in the calibrated lengths and uncertainties (k = 1), record a file for each",
        "# socket (one row a pose, in the order of the plan), then: aacmm import THIS.toml -o capture.h5",
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


def _manifest_start(arm: str, urdf: UrdfSource | None, *comments: str) -> list[str]:
    """The first lines of a manifest of readings in degrees."""
    date = "# date = 2026-01-31   # when it was recorded"
    links = [] if urdf is None else [f"base = {_quoted(urdf.base)}", f"tip = {_quoted(urdf.tip)}"]
    return [*comments, f"arm = {_quoted(arm)}", *links, date, "", "[angles]", 'unit = "deg"']


def procedure_csv(procedure: Procedure) -> str:
    """A row for each pose of an acceptance test: test, name, file for its reading, position, readings."""
    items = (*procedure.sockets, *procedure.touches)
    labels = ([item.test, item.name, file_of(procedure, item)] for item in items for _ in item.q)
    points, q = (np.concatenate([getattr(item, kind) for item in items]) for kind in ("points", "q"))
    return _poses_csv(procedure.arm, ["test", "name", "file"], labels, points, q)


def _poses_csv(arm: Arm, headings: list[str], labels: Iterable[list[str]], points: Iterable, q: np.ndarray) -> str:
    """A row for each pose: number, labels, where the tip is (mm), joint readings (deg), direction of the probe."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    readings = [f"q_{i}_deg" for i in range(1, arm.joints + 1)]
    direction = [f"probe_direction_{axis}" for axis in "xyz"]
    writer.writerow(["pose", *headings, "x_mm", "y_mm", "z_mm", *readings, *direction])
    directions = np.asarray(arm.pose(q))[:, :3, 2]
    for number, (label, point, reading, axis) in enumerate(
        zip(labels, points, q / DEG, directions, strict=True), start=1
    ):
        numbers = [*(f"{x:.3f}" for x in (*point, *reading)), *(f"{x:.2f}" for x in axis)]
        writer.writerow([number, *label, *numbers])
    return text.getvalue()


def file_of(procedure: Procedure, item: ProcedureItem) -> str:
    """The file that a manifest of `procedure_manifest` expects an item's readings in."""
    if item.test not in TOUCHED:
        return f"{item.name}.csv"
    several = sum(other.test == item.test for other in procedure.touches) > 1
    return f"{item.name}/{item.test.replace(' ', '-')}" + (f"-{item.group}" if several else "") + ".csv"


def procedure_manifest(procedure: Procedure, arm: str, urdf: UrdfSource | None = None) -> str:
    """A manifest for the readings of an acceptance test, in which the calibrated values are to be filled in.

    ``urdf``: where the arm is a URDF, its links.
    """
    lines = _manifest_start(
        arm,
        urdf,
        f"# {PLANNED[procedure.standard]}, as planned. Fill in the calibrated values and uncertainties (k = 1) of your",
        "# artefacts, record a file for each socket and each group of touches (one row a pose, in the order of the",
        "# plan), then: aacmm import THIS.toml -o acceptance.h5",
    )
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
        ]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)  # a TOML basic string
