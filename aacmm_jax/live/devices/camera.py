"""A camera that sees a target: ``camera:0?target=board``, or the path of a video in place of the number.

The target is one of the kit; corners are found as in images (`camera.detect`).
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError, nearest, require
from ...data.observations.simulated_pixels import SimulatedPixels
from ..places import Setup
from ..samples import Sample
from .device import AbstractDevice, numbers_of
from .lines import RETRY

_BUFFERED = 10  # images at most that a camera holds ready
_WAITED = 0.004  # s that it takes to get an image that was not ready


def open_device(where: str, options: Mapping[str, str], setup: Setup) -> "Camera":
    """The camera of a number, or a video."""
    require("camera", "a camera")
    options = dict(options)
    names = list(dict.fromkeys(p.thing.board for p in setup.places if isinstance(p.thing, SimulatedPixels)))
    name = options.pop("target", names[0] if len(names) == 1 else None)
    if name is None or name not in setup.targets:
        hint = nearest(name, setup.targets) if name else f"; the kit has {', '.join(setup.targets) or 'none'}"
        raise InputError(f"device 'camera:{where}' names no target of the kit; write camera:{where}?target=NAME{hint}")
    return Camera(where, setup.targets[name], numbers_of(f"camera:{where}", options, {"rate": 5.0})["rate"])


class Camera(AbstractDevice):
    """Looks for the target in at most ``rate`` images a second."""

    def __init__(self, where: str, target: Any, rate: float):
        super().__init__(f"camera:{where}")
        if not 0 < rate <= 100:
            raise InputError(f"device 'camera:{where}' has rate={rate:g}; give a number above 0 and at most 100.")
        self._where, self._target, self._period = where, target, 1 / rate
        self._is_file = Path(where).is_file()
        self._capture: Any = None
        self._due = self._retry_at = 0.0

    def read(self) -> list[Sample]:
        import cv2

        from ...camera.detection import detect

        now = time.monotonic()
        if self._capture is None:
            if now < self._retry_at:
                time.sleep(0.02)
                return []
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # else it reports every attempt
            self._capture = cv2.VideoCapture(int(self._where) if self._where.isdecimal() else self._where)
            self._retry_at = now + RETRY
        if not self._newest(now):
            self.close()
            self._retry_at, self.message = now + RETRY, "no image; trying again"
            return []
        self.connected, self.message = True, ""
        if now < self._due:
            return []
        self._due, self.lines, seen_at = now + self._period, self.lines + 1, time.monotonic()
        _, image = self._capture.retrieve()
        try:
            found = detect(np.asarray(image).mean(axis=2).astype(np.uint8), self._target)
        except InputError as error:
            self.bad[str(error)[:80]] += 1
            return []
        if found.refused:
            self.bad["target not found"] += 1
            self.message = found.refused
            return []
        seen = {"corners": found.corners, "ids": found.ids}
        return [Sample(now, None, {}, seen, time.monotonic() - seen_at)]

    def _newest(self, now: float) -> bool:
        """Go on to the newest image, past those that waited while the last one was searched."""
        for _ in range(1 if self._is_file or now < self._due else _BUFFERED):
            began = time.monotonic()
            if not self._capture.grab():
                return False
            if time.monotonic() - began > _WAITED:
                break
        return True

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
        self._capture, self.connected = None, False
