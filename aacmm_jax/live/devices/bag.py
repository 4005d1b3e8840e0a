"""A recording of ROS played back, pose by pose as ``aacmm import`` reads it: ``bag:path?speed=10&table=/tf:tool``."""

import time
from collections.abc import Mapping

import numpy as np

from ...core.errors import InputError
from ...core.text import number
from ...files.manifest_tables import Angles
from ...files.table_columns import reading_columns
from ...files.table_sources.sources import input_table
from ...files.text_table import TextTable
from ..places import Setup
from ..samples import Sample
from .device import AbstractDevice

_RATE = 50.0  # samples a second
_MOVE, _HOLD = 0.5, 1.5  # s
_POINT = ["x", "y", "z"]


def open_device(where: str, options: Mapping[str, str], setup: Setup) -> "Bag":
    """The recording at a path."""
    unknown = sorted(set(options) - {"speed", "table"})
    if unknown:
        raise InputError(f"device 'bag:{where}' has no option '{unknown[0]}'; it has speed and table.")
    try:
        speed = number(options.get("speed", "1"))
    except ValueError:
        speed = 0.0
    if not 0 < speed <= 1000:
        raise InputError(f"speed of device 'bag:{where}' must be above 0 and at most 1000.")
    tables = [options["table"]] if "table" in options else []
    return Bag(where, TextTable(input_table(where), tables=tables), speed, setup)


class Bag(AbstractDevice):
    """Moves from pose to pose of the recording and rests in each; after the last one it stays there."""

    def __init__(self, where: str, text: TextTable, speed: float, setup: Setup):
        super().__init__(f"bag:{where}")
        arm = setup.specification.arm
        points = text.pick(_POINT) if text.has(_POINT) else []
        picked = reading_columns(text, arm.joints, points, None)
        rows = Angles(unit="rad", linear_unit="m").converted(text.numbers(picked), arm)
        # Recordings of ROS have points in m.
        self._points = text.numbers(points) * 1000.0 if points else None
        self.joints, self.connected, self._speed = arm.joints, True, speed
        self._rows, self._time, self._read_at = rows, 0.0, time.monotonic()

    def read(self) -> list[Sample]:
        now = time.monotonic()
        due, first = self._time + (now - self._read_at) * self._speed, int(self._time * _RATE)
        last = int(due * _RATE)
        if last == first:
            time.sleep(0.002)
            return []
        self._time, self._read_at = due, now
        self.lines += last - first
        return [self._at(i / _RATE) for i in range(first + 1, last + 1)]

    def _at(self, moment: float) -> Sample:
        pose, into = divmod(moment, _MOVE + _HOLD)
        i = min(int(pose), len(self._rows) - 1)
        share = 1.0 if pose > i else min(into / _MOVE, 1.0)
        q = self._rows[max(i - 1, 0)] * (1 - share) + self._rows[i] * share
        points = {} if self._points is None or share < 1 else {"points": np.array(self._points[i])}
        return Sample(moment, q, {}, points)
