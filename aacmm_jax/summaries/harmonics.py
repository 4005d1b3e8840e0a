"""Many coefficients of harmonics, joint by joint: what a table says of them where it has no room for each."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

_MOST_LISTED = 48  # coefficients of harmonics that a table lists one by one
_NAME = re.compile(r"(?:cos|sin)(\d+)_(\d+)")

Row = Mapping[str, Any]


def listed_apart(parameters: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    """The parameters that a table lists one by one, and the coefficients of harmonics if there are too many.

    Args:
        parameters: Rows of a summary, with their name as "parameter".
    """
    harmonics = [row for row in parameters if _NAME.fullmatch(row["parameter"])]
    if len(harmonics) <= _MOST_LISTED:
        return list(parameters), []
    return [row for row in parameters if not _NAME.fullmatch(row["parameter"])], harmonics


def harmonics_by_joint(coefficients: Sequence[Row]) -> list[dict[str, Any]]:
    """Coefficients of harmonics, joint by joint.

    Args:
        coefficients: Rows of a summary, of harmonics only.

    Returns:
        Rows with "joint", "coefficients", "orders" in words, "rms", which the harmonics have over a whole revolution,
        in the unit "unit", and the "largest" coefficient, itself a row.
    """
    joints: dict[int, list[tuple[int, Row]]] = {}
    for row in coefficients:
        found = _NAME.fullmatch(row["parameter"])
        if found is not None:
            joints.setdefault(int(found[2]), []).append((int(found[1]), row))
    return [
        {
            "joint": joint,
            "coefficients": len(rows),
            "orders": _orders([order for order, _ in rows]),
            "unit": rows[0][1]["unit"],
            "rms": math.sqrt(sum(row["calibrated"] ** 2 for _, row in rows) / 2),
            "largest": max((row for _, row in rows), key=lambda row: abs(row["calibrated"])),
        }
        for joint, rows in sorted(joints.items())
    ]


def _orders(orders: Sequence[int]) -> str:
    each = sorted(set(orders))
    whole = each[-1] - each[0] + 1 == len(each)
    return f"{each[0]} to {each[-1]}" if whole and len(each) > 1 else ", ".join(map(str, each))
