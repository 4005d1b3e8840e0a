"""Whether an arm is held still, from the stream of its readings alone.

A hand trembles by far more than encoders are noisy, quickly and slowly, and creeps before it stops, so no threshold in
rad tells rest from motion. Whatever moves smoothly shows in the first three polynomials (drift, curvature and its
change) through the last 0.3 s of every joint. How large these are at rest is learned from the rests themselves: the
first ones are found by a whole second in which there is no more drift than the scatter explains, and so is one with a
hand that trembles more than before.
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .samples import Sample

_SHORT, _LONG = 0.3, 1.0  # s
_FEWEST = 12  # samples in the shorter time; of slower streams it is longer
_GAP = 0.5  # s without a sample, after which everything begins anew
_ORDER = 3  # of polynomials
# Mean square of the drift, and of all three, in those of rests, up to which an arm is at rest: at rest they exceed this
# once in a thousand times, whether a hand trembles at 10 Hz or wanders with a correlation time of 0.1 s.
_DRIFT, _WHOLE = 3.5, 2.4
_ENDED = 4.0  # factor of these, from which a rest has ended
_CREEP = 0.7  # root mean square of all three over a second, in scatters, that a wandering hand reaches at rest
_STOPPED = 3.0  # factor between the scatters of a second and of 0.3 s, if the arm has come to rest meanwhile
_AGAIN = 3  # decisions one after the other
_RESTS = 9  # that are remembered


class Rest(NamedTuple):
    """A moment of rest: since and until when, s; mean readings and their standard deviations; number of samples."""

    since: float
    until: float
    q: Float[np.ndarray, " n"]
    u: Float[np.ndarray, " n"]
    count: int


class Stillness:
    """Takes samples in order; `rest` is the present moment of rest, or None while the arm moves.

    Example:
        >>> stillness, random = aj.live.Stillness(2), np.random.default_rng(0)
        >>> for i in range(150):
        ...     stillness.add(aj.live.Sample(i / 100, np.array([0.5, 1.0]) + 1e-5 * random.normal(size=2)))
        >>> print(stillness.rest.count > 100, stillness.rest.q.round(3))
        True [0.5 1. ]
    """

    rest: Rest | None

    def __init__(self, joints: int):
        self.joints = joints
        self._quantum = np.full(joints, np.inf)  # smallest change of a reading: the step of a counter
        self._known: deque[Float[np.ndarray, "k n"]] = deque(maxlen=_RESTS)  # mean squares of polynomials at rest
        self._known_long: deque[float] = deque(maxlen=_RESTS)
        self._clear()

    def _clear(self) -> None:
        self._times, self._q = np.zeros(0), np.zeros((0, self.joints))
        self._seen, self._seen_long = list[np.ndarray](), list[float]()
        self.rest, self._agreed = None, 0

    def _end(self) -> None:
        """The arm moves; what the rest has shown is learned."""
        late = len(self._times) - int(np.searchsorted(self._times, self._times[-1] - _SHORT)) if len(self._times) else 0
        if len(self._seen) > late + _FEWEST:  # the last ones may have the next motion in them
            self._known.append(np.mean(self._seen[:-late], axis=0))
        if len(self._seen_long) > late:
            self._known_long.append(float(np.mean(self._seen_long[:-late])))
        self._seen, self._seen_long = [], []
        self.rest, self._agreed = None, 0

    def add(self, sample: Sample) -> None:
        """Take one sample that has readings; one that is not later than the last is left out."""
        if sample.q is None:
            return
        q, times = np.asarray(sample.q, dtype=float)[: self.joints], self._times
        if len(times) and sample.time <= times[-1]:
            return
        if len(times) and sample.time - times[-1] > _GAP:
            self._clear()
        elif len(times):
            step = np.abs(q - self._q[-1])
            self._quantum = np.where(step > 0, np.minimum(self._quantum, step), self._quantum)
        first = int(np.searchsorted(self._times, sample.time - 1.2 * _LONG))
        first = min(first, max(len(self._times) - 4 * _FEWEST, 0))
        self._times = np.append(self._times[first:], sample.time)
        self._q = np.concatenate([self._q[first:], q[None]])
        self._judge()

    def _judge(self) -> None:
        now = self._times[-1]
        count, short = self._polynomials(_SHORT, _FEWEST)
        if short is None:
            return
        _, long = self._polynomials(_LONG, 3 * _FEWEST)
        # A counter is uncertain by its step over the root of 12; of readings with noise their smallest change is tiny.
        floor = np.where(np.isfinite(self._quantum), self._quantum, 0.0) / np.sqrt(12) + 1e-12
        drift = whole = np.inf
        if self._known:
            usual = short.squares / np.maximum(np.median(self._known, axis=0), floor**2)
            drift, whole = float(np.mean(usual[0])), float(np.mean(usual))
        creep = np.inf if long is None else float(np.sqrt(np.mean(long.squares / np.maximum(long.scatter, floor) ** 2)))
        if self.rest is not None:
            if drift > _ENDED * _DRIFT and creep > _CREEP:
                self._end()
                return
            if self._times[-count] > self._began:  # nothing of the motion before is in it
                self._seen.append(short.squares)
            if now - self._began > _LONG:
                self._seen_long.append(creep)
            self._extend(1, self.rest.since)
            return
        most = max(1.5 * float(np.median(self._known_long)), 0.15) if self._known_long else _CREEP
        stopped = long is not None and bool(np.any(long.scatter > _STOPPED * np.maximum(short.scatter, floor)))
        if self._known and not stopped and len(self._times) >= 2 * count:
            before = _Polynomials.of(self._times[-2 * count : -count], self._q[-2 * count : -count])
            usual = before.squares[0] / np.maximum(np.median(self._known, axis=0)[0], floor**2)
            stopped = float(np.mean(usual)) > _ENDED * _DRIFT
        usual_rest = drift < _DRIFT and whole < _WHOLE and (stopped or creep < _CREEP)
        self._agreed = self._agreed + 1 if usual_rest or creep < min(most, _CREEP) else 0
        if self._agreed >= _AGAIN:
            self._total, self._squares, self._count = np.zeros(self.joints), np.zeros(self.joints), 0
            self._origin, self._began = self._q[-1], now
            self._extend(count, self._times[-count])

    def _polynomials(self, duration: float, fewest: int) -> "tuple[int, _Polynomials | None]":
        """Through the last readings; the number of these, and None where there are too few."""
        now = self._times[-1]
        count = max(len(self._times) - int(np.searchsorted(self._times, now - duration - 1e-9)), fewest)
        if count > len(self._times) or now - self._times[-count] < 0.9 * duration:
            return count, None
        return count, _Polynomials.of(self._times[-count:], self._q[-count:])

    def _extend(self, count: int, since: float) -> None:
        away = self._q[-count:] - self._origin
        self._count += count
        self._total, self._squares = self._total + away.sum(axis=0), self._squares + (away**2).sum(axis=0)
        mean = self._total / self._count
        u = np.sqrt(np.maximum(self._squares / self._count - mean**2, 0.0))
        self.rest = Rest(float(since), float(self._times[-1]), self._origin + mean, u, self._count)


class _Polynomials(NamedTuple):
    """Of the first orders, through a stretch of readings."""

    squares: Float[np.ndarray, "k n"]  # their mean squares
    scatter: Float[np.ndarray, " n"]  # about them

    @classmethod
    def of(cls, times: Float[np.ndarray, " m"], q: Float[np.ndarray, "m n"]) -> "_Polynomials":
        t = 2 * (times - times[0]) / (times[-1] - times[0]) - 1
        basis, _ = np.linalg.qr(t[:, None] ** np.arange(_ORDER + 1))
        along = basis.T @ (q - q[-1])
        left = q - q[-1] - basis @ along
        scatter = np.sqrt(np.sum(left**2, axis=0) / max(len(t) - _ORDER - 1, 1))
        return cls(along[1:] ** 2 / len(t), scatter)
