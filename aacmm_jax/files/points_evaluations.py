"""An evaluation of points, without an arm's poses: acceptance tests of what an arm's own program reported; in HDF5."""

import os

import numpy as np

from ..acceptance.metrics import Measured
from ..acceptance.record import PointsRecord
from ..kinematics.workspace import Reach
from .captures import lengths_of, reference_table, sphere_table, spheres_of
from .evaluations import limit_table, limits_in
from .hdf5 import Table, Variable, need, read_tables, undamaged, write_tables


def save_points(path: str | os.PathLike, record: PointsRecord) -> None:
    """Write an evaluation of points to HDF5, whole or not at all."""
    measured = record.measured
    owner = [name for name, points in measured.sockets.items() for _ in points]
    position = np.concatenate([np.zeros((0, 3)), *measured.sockets.values()])
    tables = {
        "points": Table(
            {
                "point": Variable(("point",), np.arange(1, len(owner) + 1), "1", "point number"),
                "axis": Variable(("axis",), ["x", "y", "z"], "", "axis"),
                "position": Variable(("point", "axis"), position, "mm", "centre of the probe"),
                "socket": Variable(("point",), owner, "", "socket that held it"),
            }
        ),
        "reference": reference_table(measured.lengths),
        "limits": limit_table(record.limits),
    }
    if measured.spheres:
        tables["sphere"] = sphere_table(measured.spheres, points=True)
    reach = measured.reach
    attributes = {
        "of": "points",
        "u_test_mm": record.u_test,
        "sources": list(measured.sources) or None,
        "measured": measured.measured or None,
        "reach_mm": None if reach is None else reach.radius,
        "shoulder_mm": None if reach is None else reach.shoulder,
    }
    write_tables(path, "evaluation", tables, attributes)


def load_points(path: str | os.PathLike) -> PointsRecord:
    """Read an evaluation of points. Raises `InputError` where the file is missing, damaged, foreign, newer or none."""
    stored = read_tables(path, ("evaluation",))
    need(path, stored.tables, "points", "reference", "limits")
    with undamaged(path):
        table, attributes = stored.tables["points"], stored.attributes
        owner = np.asarray(table["socket"]).astype(str)
        sockets = {name: table["position"][owner == name] for name in dict.fromkeys(owner.tolist())}
        reach = None
        if attributes.get("reach_mm") is not None:
            reach = Reach(np.array(attributes["shoulder_mm"]), float(attributes["reach_mm"]))
        measured = Measured(
            sockets,
            tuple(lengths_of(path, stored)),
            spheres_of(path, stored, "position"),
            reach,
            sources=tuple(attributes.get("sources") or ()),
            measured=attributes.get("measured", ""),
        )
        return PointsRecord(measured, limits_in(stored), float(attributes["u_test_mm"]))
