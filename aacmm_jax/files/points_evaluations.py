"""An evaluation of points, without an arm's poses: acceptance tests of what an arm's own program reported; in HDF5."""

import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..acceptance.decision import Limit
from ..acceptance.suite import AcceptanceTest, Measured, accept
from ..kinematics.workspace import Reach
from . import storage
from .captures import lengths_of, reference_table, sphere_table, spheres_of
from .evaluations import limit_table, limits_in
from .storage import Table, Variable


class PointsRecord(NamedTuple):
    """What an evaluation of points is of; its figures follow from that."""

    measured: Measured
    limits: Mapping[str, Limit | float] = MappingProxyType({})
    u_test: float = 0.0  # standard uncertainty that seat, fixture and temperature add, mm

    def acceptance(self) -> list[AcceptanceTest]:
        """Every test that the points allow."""
        return accept(self.measured, self.limits, self.u_test)


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
    storage.write_tables(path, "evaluation", tables, attributes)


def load_points(path: str | os.PathLike) -> PointsRecord:
    """Read an evaluation of points. Raises `InputError` where the file is missing, damaged, foreign, newer or none."""
    stored = storage.read_tables(path, ("evaluation",))
    storage.need(path, stored.tables, "points", "reference", "limits")
    with storage.undamaged(path):
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
