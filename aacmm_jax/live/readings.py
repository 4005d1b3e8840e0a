"""What devices have said so far: the present readings, whether the arm is at rest, and what came beside them."""

import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ..kinematics.arm import Arm, by_joint
from .samples import BUTTONS, Sample
from .sides import Sides
from .stillness import Rest, Stillness

_MOST_MEASURED = 500
_APART = 0.02  # rad, or m of prismatic joints: least change of a joint between two poses that are taken by themselves


class Readings:
    """The stream of an arm, sample by sample."""

    def __init__(self, arm: Arm):
        self.q: Float[np.ndarray, " n"] | None = None
        self.columns: dict[str, float] = {}
        self.measured: list[Mapping[str, Any]] = []  # what instruments have seen since the arm is at rest
        self.time = -np.inf  # of the device, at the last reading
        self._still_from = np.inf  # of this computer, when the present rest began
        self._arm, self._times = arm, deque[float](maxlen=50)
        self._stillness, self.sides = Stillness(arm.joints), Sides(arm)
        self._pressed: frozenset[str] = frozenset()  # buttons of the arm

    @property
    def rest(self) -> Rest | None:
        """The present rest; None while the arm moves."""
        return self._stillness.rest

    @property
    def rate(self) -> float:
        """Readings a second."""
        lasted = self._times[-1] - self._times[0] if self._times else 0.0
        return (len(self._times) - 1) / lasted if lasted > 0 else 0.0

    def add(self, sample: Sample) -> tuple[frozenset[str], bool]:
        """The buttons that this sample says are pressed anew, and whether the device's clock has begun anew."""
        self.columns |= sample.columns
        now = frozenset(name for name in BUTTONS if self.columns.get(name))
        pressed, self._pressed, anew = now - self._pressed, now, False
        if sample.q is not None:
            self.q, anew = sample.q, sample.time < self.time
            if anew:
                self._stillness = Stillness(self._arm.joints)
            self.time = sample.time
            self._stillness.add(sample)
            self.sides.add(sample.q)
            self._times.append(sample.time)
            if self.rest is None:
                self.measured, self._still_from = [], np.inf
            elif self._still_from == np.inf:
                self._still_from = time.monotonic() - (self.rest.until - self.rest.since)
        if sample.measured and time.monotonic() - sample.delay >= self._still_from:  # else it was seen on the way
            self.measured = [*self.measured[-_MOST_MEASURED:], sample.measured]
        return pressed, anew

    def beside(self) -> dict[str, float]:
        """The columns of a pose; what a device knows of its directions counts before what was seen of them."""
        return self.sides.columns() | {name: value for name, value in self.columns.items() if name not in BUTTONS}

    def is_near(self, rest: Rest, q: Float[np.ndarray, " n"]) -> bool:
        """Whether a rest is at a configuration."""
        return bool(np.max(np.abs(rest.q - q) / np.array(by_joint(self._arm, 1.0, 1000.0))) < _APART)
