"""When an arm stood still, found from its joint readings alone."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter1d, minimum_filter1d

_WINDOW = 0.25  # s
_FEWEST = 5  # readings in a window
_SMALLEST = 1e-7  # rad: no encoder resolves it
_WIDER = 3.0  # than the usual range of the readings in a window: what their noise reaches now and then
_APART = 1.0  # decades between the ranges of windows with and without motion
_BINS = 200


def standstills(t: Float[np.ndarray, " N"], q: Float[np.ndarray, "N n"]) -> list[tuple[int, int]]:
    """The first and the last reading of each standstill, without half a window at either end.

    The range of the readings in a short window is that of their noise while the arm stands, and orders of magnitude
    larger while it moves. So the two kinds of windows are told apart by Otsu's threshold of its logarithm (1979,
    doi:10.1109/TSMC.1979.4310076), by the joint that moves most; then each joint must stay within three times its
    usual range when the arm stands, or one step of its encoder. What drifts beyond that over the whole standstill is a
    slow motion. Two standstills in succession in the same place count once, as the longer one.

    Args:
        t: time, s, ascending.
        q: readings, rad or m.
    """
    interval = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    window = max(_FEWEST, round(_WINDOW / interval)) if interval > 0 else _FEWEST
    if len(t) < 2 * window:
        return []
    ranges = maximum_filter1d(q, window, axis=0) - minimum_filter1d(q, window, axis=0)
    motion, steps = np.log10(ranges.max(axis=1) + _SMALLEST), np.abs(np.diff(q, axis=0))
    standing = motion <= _otsu(motion)
    if np.all(standing) or motion[~standing].mean() - motion[standing].mean() < _APART:
        # One kind of window only. Noise goes to and fro; a motion adds its steps up.
        if np.median(ranges.max(axis=1)) > 0.5 * (window - 1) * np.median(steps.max(axis=1)):
            return []
        standing[:] = True
    step = np.where(steps > 0, steps, np.inf).min(axis=0)
    allowed = np.maximum(_WIDER * np.median(ranges[standing], axis=0), 1.01 * np.where(np.isfinite(step), step, 0))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.all(ranges <= allowed, axis=1), [0]]).astype(int)))
    kept: list[tuple[int, int]] = []
    for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
        inside = q[first : last + 1]
        gap = len(inside) > 1 and np.diff(t[first : last + 1]).max() > _WINDOW + 5 * interval
        if len(inside) < window or gap or np.any(np.ptp(inside, axis=0) > _WIDER * allowed):
            continue
        if kept:
            before = kept[-1]
            if np.all(np.abs(inside.mean(axis=0) - q[before[0] : before[1] + 1].mean(axis=0)) <= allowed):
                if last - first > before[1] - before[0]:
                    kept[-1] = (int(first), int(last))
                continue
        kept.append((int(first), int(last)))
    return kept


def _otsu(values: Float[np.ndarray, " N"]) -> float:
    """The threshold that leaves the least variance within two classes."""
    counts, edges = np.histogram(values, _BINS)
    centres = (edges[1:] + edges[:-1]) / 2
    below = np.cumsum(counts)[:-1]
    above = len(values) - below
    sums = np.cumsum(counts * centres)[:-1]
    total = float(counts @ centres)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = below * above * (sums / below - (total - sums) / above) ** 2
    between[(below == 0) | (above == 0)] = -1.0
    best = np.flatnonzero(between >= between.max() * (1 - 1e-12))  # a gap between the classes has many of them
    return float(edges[1 + best[len(best) // 2]])
