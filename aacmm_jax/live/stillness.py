"""Whether an arm is held still, from the stream of its readings alone.

A hand trembles by far more than encoders are noisy, quickly and slowly, and creeps before it stops, so no threshold in
rad tells rest from motion. Whatever moves smoothly shows in the first three polynomials (drift, curvature and its
change) through the last 0.36 s of every joint. How large these are at rest is learned from the rests themselves: the
first ones are found by a whole second in which there is no more drift than the scatter explains, and so is one with a
hand that trembles more than before.

In 0.36 s a slow creep and a hand that wanders differ less the slower the creep is, and the less it matters: what a
creep of the rate r does to a mean over the time T is r T / 2, the distance from the mean to where the arm is now. The
mean is taken over the last 0.2 s only, so that every creep which would move it by more than the scatter of its readings
drifts far enough in 0.36 s to be told from rest. A longer mean, up to a second, is taken once its drift is harmless.
"""

from collections import deque
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from .samples import Sample

_SHORT, _LONG = 0.36, 1.0  # s
_MEAN = 1 / 3  # part of the shorter time over which readings are averaged first
_FEWEST = 12  # samples in the shorter time; of slower streams it is longer
_GAP = 0.5  # s without a sample, after which everything begins anew
_ORDER = 3  # of polynomials
_REFUSED = 0.001  # probability that the drift of an arm at rest is refused, at one moment
_ENDED = 4.0  # factor of the largest drift of a rest, from which it has ended
_CREEP = 0.7  # root mean square of all three over a second, in scatters, that a wandering hand reaches at rest
_CALM = 4.0  # mean square of the scatter before the shorter time, in its own, from which the arm moved before
_EVERY = 0.005  # s between decisions
_AGAIN = 3  # decisions one after the other
_RESTS = 9  # that are remembered


class Rest(NamedTuple):
    """A moment of rest: since and until when, s; the mean of the last readings, their standard deviation at rest, and
    how many they are."""

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
        self._usual = np.full((_ORDER, joints), np.inf)  # their medians
        self._most_drift, self._most_whole = (float(chdtri(n, _REFUSED)) / n for n in (joints, _ORDER * joints))
        self._clear()

    def _clear(self) -> None:
        self._times, self._q = np.zeros(0), np.zeros((0, self.joints))
        self._seen, self._judged = list[np.ndarray](), -np.inf
        self.rest, self._agreed = None, 0

    def _end(self) -> None:
        """The arm moves; what the rest has shown is learned."""
        late = len(self._times) - int(np.searchsorted(self._times, self._times[-1] - _SHORT)) if len(self._times) else 0
        if len(self._seen) > late + _FEWEST:  # the last ones may have the next motion in them
            self._known.append(np.mean(self._seen[:-late], axis=0))
            self._usual = np.median(self._known, axis=0)
        self._seen = []
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
        if sample.time - self._judged > _EVERY:
            self._judged = sample.time
            self._judge()

    def _judge(self) -> None:
        now = self._times[-1]
        count, short = self._polynomials(_SHORT, _FEWEST)
        if short is None:
            return
        seconds, long = self._polynomials(_LONG, 3 * _FEWEST)
        # A counter is uncertain by its step over the root of 12; of readings with noise their smallest change is tiny.
        floor = np.where(np.isfinite(self._quantum), self._quantum, 0.0) / np.sqrt(12) + 1e-12
        drift = whole = np.inf
        if self._known:
            usual = short.squares / np.maximum(self._usual, floor**2)
            drift, whole = float(np.mean(usual[0])), float(np.mean(usual))
        relative = None if long is None else long.squares / np.maximum(long.scatter, floor) ** 2
        creep = np.inf if relative is None else float(np.sqrt(np.mean(relative)))
        if self.rest is None:
            usual_rest = drift < self._most_drift and whole < self._most_whole
            slow_rest = creep < _CREEP and self._is_calm(seconds, count, short, floor)
            self._agreed = self._agreed + 1 if usual_rest or slow_rest else 0
            if self._agreed < _AGAIN:
                return
            since = self._times[-count]
            self._began = self._times[-seconds] if slow_rest else now  # from when on there is only rest
        else:
            since = self.rest.since
            begins = (
                drift > _ENDED * self._most_drift if self._known else not self._is_calm(seconds, count, short, floor)
            )
            if begins:  # readings that may be of a motion are not averaged
                if creep > _CREEP:
                    self._end()
                return
        if self._times[-count] > self._began:  # nothing of the motion before is in it
            self._seen.append(short.squares)
        averaged = max(round(_MEAN * count), 2)
        # Drift over a second moves the mean over it by the root of three times its mean square.
        if now - self._began > _LONG and relative is not None and 3 * float(np.mean(relative[0])) < 1:
            averaged = seconds
        readings = self._q[-averaged:]
        away = readings - readings[-1]
        u = away.std(axis=0)
        if self._known and averaged < count:  # too short a time to show how far a hand wanders at rest
            u = np.sqrt(short.scatter**2 + np.sum(self._usual, axis=0))
        self.rest = Rest(float(since), float(now), readings[-1] + away.mean(axis=0), u, averaged)

    def _is_calm(self, seconds: int, count: int, short: "_Polynomials", floor: Float[np.ndarray, " n"]) -> bool:
        """Whether a second has no motion in it that scatters about its polynomials: neither its end nor a beginning."""
        before = np.maximum(_Polynomials.of(self._q[-seconds:-count]).scatter, floor)
        begins = np.mean(short.squares / before**2) > _CREEP**2
        ended = np.mean((before / np.maximum(short.scatter, floor)) ** 2) > _CALM
        return not begins and not ended

    def _polynomials(self, duration: float, fewest: int) -> "tuple[int, _Polynomials | None]":
        """Through the last readings; the number of these, and None where there are too few."""
        now = self._times[-1]
        count = max(len(self._times) - int(np.searchsorted(self._times, now - duration - 1e-9)), fewest)
        if count > len(self._times) or now - self._times[-count] < 0.9 * duration:
            return count, None
        return count, _Polynomials.of(self._q[-count:])


class _Polynomials(NamedTuple):
    """Of the first orders, through a stretch of readings."""

    squares: Float[np.ndarray, "k n"]  # their mean squares
    scatter: Float[np.ndarray, " n"]  # about them

    @classmethod
    def of(cls, q: Float[np.ndarray, "m n"]) -> "_Polynomials":
        away, count = q - q[-1], len(q)
        along = _basis(count) @ away
        left = np.einsum("mn,mn->n", away, away) - np.sum(along**2, axis=0)
        return cls(along[1:] ** 2 / count, np.sqrt(np.maximum(left, 0.0) / max(count - _ORDER - 1, 1)))


@lru_cache(1000)
def _basis(count: int) -> Float[np.ndarray, "k m"]:
    """Orthonormal polynomials over so many readings, which are as far apart as the device took them, whenever they
    arrived."""
    t = np.linspace(-1, 1, count)
    return np.ascontiguousarray(np.linalg.qr(t[:, None] ** np.arange(_ORDER + 1))[0].T)
