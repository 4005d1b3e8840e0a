"""A planned acceptance test on paper: poses as CSV, a manifest to be filled with what was recorded, and a plain dictionary."""

import csv
import io

import numpy as np

from ..acceptance.procedure import TOUCHED, Procedure
from ..acceptance.procedure_items import Item
from ..acceptance.standards import PLANNED

_DIRECTION = ("probe_direction_x", "probe_direction_y", "probe_direction_z")  # the last frame's z axis


def procedure_csv(procedure: Procedure) -> str:
    """A row a pose: what it is for, the file of the manifest that its reading goes into, where the probe's centre stands (mm), readings (deg)."""
    lines = io.StringIO()
    table = csv.writer(lines, lineterminator="\n")
    joints = range(1, procedure.arm.joints + 1)
    table.writerow(["pose", "test", "name", "file", "x_mm", "y_mm", "z_mm", *(f"q_{i}_deg" for i in joints), *_DIRECTION])
    number = 0
    for item in (*procedure.sockets, *procedure.touches):
        directions = np.asarray(procedure.arm.pose(item.q))[:, :3, 2]
        for point, q, direction in zip(item.points, np.degrees(item.q), directions, strict=True):
            number += 1
            numbers = [*(f"{x:.3f}" for x in point), *(f"{x:.3f}" for x in q), *(f"{x:.2f}" for x in direction)]
            table.writerow([number, item.test, item.name, file_of(procedure, item), *numbers])
    return lines.getvalue()


def file_of(procedure: Procedure, item: Item) -> str:
    """The file that a manifest of `procedure_manifest` expects an item's readings in."""
    if item.test not in TOUCHED:
        return f"{item.name}.csv"
    several = sum(other.test == item.test for other in procedure.touches) > 1
    return f"{item.name}/{item.test.replace(' ', '-')}" + (f"-{item.group}" if several else "") + ".csv"


def procedure_manifest(procedure: Procedure, arm: str) -> str:
    """A manifest for the readings: one text file for each socket, end of a bar, and group of touches. Calibrated values are to be filled in."""
    lines = [
        f"# {PLANNED[procedure.standard]}, as planned. Put the calibrated values and standard uncertainties of your artefacts in, record a file for each",
        "# socket and group of touches (one row a pose, in the order of the plan), then: aacmm import THIS.toml -o acceptance.h5",
        f"arm = {_quoted(arm)}",
        "# date = 2026-01-31   # when it was recorded",
        "",
        "[angles]",
        'unit = "deg"',
    ]
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
        lines += ["", "[[sphere]]", f"name = {_quoted(sphere.name)}", f"test = {_quoted(sphere.test)}", f"files = [{files}]"]
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
    import json

    return json.dumps(text, ensure_ascii=False)  # a TOML basic string
