"""Whether an arm is held still, from the stream of its readings alone."""

from collections import deque
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .samples import Sample

_WINDOW = 0.4  # s


class Rest(NamedTuple):
    """A moment of rest: since and until when, s; mean readings and their standard deviations; number of samples."""

    since: float
    until: float
    q: Float[np.ndarray, " n"]
    u: Float[np.ndarray, " n"]
    count: int


class Stillness:
    """Takes samples in order; `rest` is the present moment of rest, or None while the arm moves."""

    def __init__(self, joints: int):
        self.joints, self.rest = joints, None
        self._recent: deque[Sample] = deque()

    rest: Rest | None

    def add(self, sample: Sample) -> None:
        """Take one sample that has readings."""
        recent = self._recent
        recent.append(sample)
        while recent[-1].time - recent[0].time > _WINDOW:
            recent.popleft()
        q = np.array([s.q for s in recent])
        still = len(q) > 20 and recent[-1].time - recent[0].time > 0.3 and np.ptp(q, axis=0).max() < 2e-3
        since = recent[0].time if self.rest is None else self.rest.since
        self.rest = Rest(since, sample.time, q.mean(axis=0), q.std(axis=0), len(q)) if still else None
