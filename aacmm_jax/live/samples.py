"""What devices give: one reading of a moment, of the joints, of an instrument, or of both."""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

BUTTONS = ("button", "skip")


class Sample(NamedTuple):
    """What one device has read at one moment; any part may be missing.

    Args:
        time: Of the device's own clock, or of the arrival, s.
        q: Joint readings ``(n,)``, rad, or mm of prismatic joints.
        columns: What was recorded beside them by name: ``temperature_C``, ``load_kg``, ``torque_1`` ..., and
            ``button`` and ``skip`` (1 while they are pressed): take this pose, and propose another.
        measured: What an instrument measured, by the entries of its observation: ``points`` (a tracked point ``(3,)``
            in the station's frame, mm), ``rotations`` ``(3, 3)``, ``values`` (a distance, mm), ``corners`` ``(c, 2)``
            (px) with ``ids`` ``(c,)``.
        delay: How long ago that was seen when it is given, s, as the search for corners in an image takes some time.

    Example:
        >>> aj.live.Sample(0.01, np.zeros(6), {"temperature_C": 20.1}).columns["temperature_C"]
        20.1
    """

    time: float
    q: Float[np.ndarray, " n"] | None = None
    columns: Mapping[str, float] = {}
    measured: Mapping[str, Float[np.ndarray, "..."] | Int[np.ndarray, "..."]] = {}
    delay: float = 0.0


def lines_of(samples: Sequence[Sample]) -> bytes:
    """Samples as lines of JSON, for devices that send none."""
    rows = ({name: value for name, value in sample._asdict().items() if value is not None} for sample in samples)
    return b"".join(json.dumps(row, default=lambda value: value.tolist()).encode() + b"\n" for row in rows)


def mean_measured(measured: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """What instruments saw of one pose: the mean of points and distances, the last of rotations and corners."""
    values: dict[str, np.ndarray] = {}
    for name in dict.fromkeys(name for one in measured for name in one):
        rows = [np.asarray(one[name]) for one in measured if name in one]
        averaged = name in ("points", "values")
        values[name] = np.mean(rows, axis=0) if averaged else rows[-1]
    return values
