"""A planned acceptance test as a plain dictionary with the unit in every key."""

from typing import Any

from ..acceptance.procedure import Procedure
from ..acceptance.standards import PLANNED


def procedure_summary(procedure: Procedure, arm: str) -> dict[str, Any]:
    """What to set up and how many poses to take; the unit in every key."""
    lengths: dict[float, int] = {}
    for *_, value in procedure.lengths:
        lengths[value] = lengths.get(value, 0) + 1
    return {
        "kind": "acceptance plan",
        "arm": arm,
        "standard": PLANNED[procedure.standard],
        "poses": procedure.poses,
        "reach_mm": procedure.reach.radius,
        "shoulder_mm": procedure.reach.shoulder.tolist(),
        "bars": [{"length_mm": value, "positions": count} for value, count in lengths.items()],
        "spheres": [
            {"name": sphere.name, "test": sphere.test, "diameter_mm": sphere.diameter, "centre_mm": sphere.centre.tolist()}
            for sphere in procedure.spheres
        ],
        "items": [
            {
                "test": item.test,
                "name": item.name,
                "group": item.group,
                "position_mm": item.points.mean(axis=0).tolist(),
                "poses": len(item.q),
            }
            for item in (*procedure.sockets, *procedure.touches)
        ],
        "warnings": list(procedure.left_out),
    }
