"""Which order, signs and zeros of joint readings fit an arm: all of them, by costs of halves of the chain.

The tip is o + R p, with the transform (R, o) of the first joints and the tip p in their last frame, which only the
other joints change. A sum of squares over the poses is then a product of a matrix that the first half of a hypothesis
has with one that the other half has. So a few thousand halves give the cost of millions of hypotheses, some five
million a second, without an approximation.
"""

import itertools
import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm
from ..kinematics.chain import Geometry, JointKinds, tip_pose

_MOST = 6_000_000  # hypotheses of one family: about a second
_BLOCK = 50_000  # hypotheses of one array, so that it stays in the processor's cache
_KEPT = 3000
_POSES, _EACH = 36, 9  # of the search: in all, and in one socket
_EIGHTH = math.pi / 4  # of zeros: Gauss and Newton find the right one from an eighth of a revolution away


class Evidence(NamedTuple):
    """What recorded poses must agree with.

    Args:
        q: Readings, a column each for as many joints as the arm has, rad.
        owner: Number of the socket that each pose was held in, from 0 and not decreasing; of points all 0.
        points: Where the tip was, mm; None: the tips of a socket coincide, wherever it is.
        rotations: Orientation of the last frame, in the base frame.
        own_frame: Whether the points are in an instrument's frame, which is unknown, and not in the base frame.
    """

    q: Float[np.ndarray, "m n"]
    owner: Int[np.ndarray, " m"]  # not decreasing
    points: Float[np.ndarray, "m 3"] | None = None
    rotations: Float[np.ndarray, "m 3 3"] | None = None
    own_frame: bool = False

    @property
    def in_base(self) -> bool:
        """Whether the points are known in the base frame."""
        return self.points is not None and not self.own_frame

    def at(self, rows: Int[np.ndarray, " k"]) -> "Evidence":
        """Some of the poses, with sockets numbered anew."""
        owner = np.unique(self.owner[rows], return_inverse=True)[1]
        points, rotations = (None if part is None else part[rows] for part in (self.points, self.rotations))
        return Evidence(self.q[rows], owner, points, rotations, self.own_frame)

    def scaled(self, angle: float, length: float) -> "Evidence":
        """With readings and positions in other units, of which these are the factors."""
        return self._replace(q=angle * self.q, points=None if self.points is None else length * self.points)

    def thinned(self, most: int = _POSES, each: int = _EACH) -> "Evidence":
        """At most about so many poses, in sockets at most so many each, evenly from beginning to end."""
        if self.points is not None:
            return self.at(_evenly(np.arange(len(self.q)), most))
        rows = [_evenly(np.flatnonzero(self.owner == i), each) for i in range(self.owner.max() + 1)]
        rows.sort(key=len, reverse=True)
        ends = np.cumsum([len(part) for part in rows])
        count = max(1, int(np.sum(ends <= most)))
        return self.at(np.sort(np.concatenate(rows[:count])))


class Hypothesis(NamedTuple):
    """How readings of joints follow from recorded columns: joint i is ``signs[i] * q[order[i]] + offsets[i]``."""

    order: tuple[int, ...]  # the column of each joint, from 0
    signs: tuple[int, ...]
    offsets: tuple[float, ...]  # rad

    def readings(self, q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
        """The readings of the joints, rad."""
        return q[:, list(self.order)] * np.array(self.signs) + np.array(self.offsets)

    @property
    def changes(self) -> int:
        """Number of mistakes that it names: signs, exchanges of two columns, zeros."""
        left, cycles = set(range(len(self.order))), 0
        while left:
            cycles, at = cycles + 1, next(iter(left))
            while at in left:
                left.remove(at)
                at = self.order[at]
        exchanges = len(self.order) - cycles
        return exchanges + sum(sign < 0 for sign in self.signs) + sum(offset != 0 for offset in self.offsets)


def as_recorded(joints: int) -> Hypothesis:
    """Nothing is exchanged, and nothing has another sign or zero."""
    return Hypothesis(tuple(range(joints)), (1,) * joints, (0.0,) * joints)


class Searched(NamedTuple):
    """Hypotheses in the order of their RMS residual, mm, and how many there were."""

    rms: list[float]
    hypotheses: list[Hypothesis]
    tried: int


def search(arm: Arm, evidence: Evidence, lever: float) -> Searched:
    """The best hypotheses for the nominal arm, by a few dozen poses; an error of orientation counts ``lever`` mm a rad.

    Tried are, each with all signs: all orders of columns, with as many zeros a quarter of a revolution off as the
    budget allows; the orders that people make (two columns exchanged, reversed, shifted by one), with one or two zeros
    off by a quarter or an eighth; and the order as it is, with all zeros off.
    """
    n = arm.joints
    joints = [i for i in range(n) if i or evidence.in_base]  # elsewhere the base takes up the zero of the first joint
    links = _Links(arm, evidence.q, joints)
    likely, plain = _likely_orders(n), [tuple(range(n))]
    families = (
        # Orders (all, or some), how many, the step of zeros in eighths of a revolution, and how many may be off.
        (None, math.factorial(n), 2, 1 if evidence.own_frame else n),
        (likely, len(likely), 2, 2),
        (likely, len(likely), 1, 1),
        (plain, 1, 2, n),
        (plain, 1, 1, 3),
    )
    best, tried = _Best(), 0
    for orders, count, step, most in families:
        sizes = [count * _variants(n, len(joints), k, 8 // step - 1) for k in range(min(most, len(joints)) + 1)]
        most = int(np.sum(np.array(sizes) <= _MOST)) - 1
        if most < 0:
            continue
        tried += sizes[most]
        for first, last in _halves(links, orders, step, most, evidence.rotations is not None):
            for k in range(most + 1):
                front, rear = first.at(first.zeros == k), last.at(last.zeros <= most - k)
                rows = max(1, _BLOCK // max(len(rear.signs), 1))
                for start in range(0, len(front.signs) if len(rear.signs) else 0, rows):
                    part = front.at(slice(start, start + rows))
                    best.take(_costs(part, rear, evidence, lever), part, rear)
    rms = np.sqrt(np.maximum(best.costs, 0) / len(evidence.q))
    order = np.argsort(rms, kind="stable")
    # The families overlap.
    residuals = {best.hypotheses[i]: float(rms[i]) for i in reversed(order)}
    return Searched(list(residuals.values())[::-1], list(residuals)[::-1], tried)


def _variants(n: int, joints: int, most: int, zeros: int) -> int:
    """Signs and zeros of one order, at most so many of them moved, each to one of so many."""
    return 2**n * sum(math.comb(joints, k) * zeros**k for k in range(most + 1))


def _likely_orders(n: int) -> list[tuple[int, ...]]:
    """As recorded, two columns exchanged, reversed, and shifted by one."""
    orders = [tuple(range(n))]
    for one, other in itertools.combinations(range(n), 2):
        order = list(range(n))
        order[one], order[other] = other, one
        orders.append(tuple(order))
    plain = orders[0]
    return list(dict.fromkeys([*orders, plain[::-1], (*plain[1:], 0), (n - 1, *plain[:-1])]))


class _Links:
    """Transforms of single links, by joint and recorded column, for both signs and eight zeros."""

    def __init__(self, arm: Arm, q: Float[np.ndarray, "m n"], joints: list[int]):
        self.joints, self.q, self._geometry = joints, q, to_numpy(arm.geometry)
        self.count, self.probe = arm.joints, np.asarray(arm.probe)
        self._kept: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    def variants(self, joint: int, step: int) -> tuple[Int[np.ndarray, " v"], Int[np.ndarray, " v"]]:
        """Signs and zeros (in eighths of a revolution) that are tried."""
        turns = joint in self.joints and not self._slides(joint)
        zeros = np.arange(0, 8, step) if turns else np.zeros(1, dtype=int)
        return np.repeat([1, -1], len(zeros)), np.tile(zeros, 2)

    def _slides(self, joint: int) -> bool:
        return self._geometry.kinds is not None and self._geometry.kinds.prismatic[joint]

    def of(
        self, joint: int, column: int, signs: Int[np.ndarray, " v"], zeros: Int[np.ndarray, " v"]
    ) -> tuple[Float[np.ndarray, "v m 3 3"], Float[np.ndarray, "v m 3"]]:
        """Rotations and translations of one link."""
        if (joint, column) not in self._kept:
            readings = np.array([[[s * self.q[:, column] + k * _EIGHTH] for k in range(8)] for s in (1, -1)])
            part = slice(joint, joint + 1)
            whole, slides = self._geometry, self._slides(joint)
            alpha, a, d, theta = whole.alpha[part], whole.a[part], whole.d[part], whole.theta[part]
            beta = None if whole.beta is None else whole.beta[part]
            link = Geometry(alpha, a, d, theta, beta, 0 * whole.probe, JointKinds((True,)) if slides else None)
            poses = np.asarray(tip_pose(link, readings.reshape(-1, 1))).reshape(2, 8, -1, 4, 4)
            self._kept[joint, column] = poses[..., :3, :3], poses[..., :3, 3]
        turns, shifts = self._kept[joint, column]
        chosen = (signs < 0).astype(int), zeros
        return turns[chosen], shifts[chosen]


class _Half(NamedTuple):
    """Hypotheses about some of the joints, and what they make of the poses."""

    columns: Int[np.ndarray, "h j"]
    signs: Int[np.ndarray, "h j"]
    eighths: Int[np.ndarray, "h j"]
    rotations: Float[np.ndarray, "h m 3 3"]
    points: Float[np.ndarray, "h m 3"]

    @property
    def zeros(self) -> Int[np.ndarray, " h"]:
        """How many zeros are moved."""
        return np.sum(self.eighths != 0, axis=1)

    def at(self, rows: np.ndarray | slice) -> "_Half":
        return _Half(*(np.ascontiguousarray(part[rows]) for part in self))


def _halves(
    links: _Links, orders: list[tuple[int, ...]] | None, step: int, most: int, oriented: bool
) -> Iterator[tuple[_Half, _Half]]:
    """Halves of hypotheses that belong together: of each of these orders, or of all."""
    n, middle, none = links.count, links.count // 2, np.zeros(3)

    def both(first: Iterable[tuple[int, ...]], last: Iterable[tuple[int, ...]]) -> tuple[_Half, _Half]:
        return (
            _half(links, 0, first, none, (step, most), True),
            _half(links, middle, last, links.probe, (step, most), oriented),
        )

    if orders is not None:
        for order in orders:
            yield both([order[:middle]], [order[middle:]])
        return
    for chosen in itertools.combinations(range(n), middle):
        others = tuple(i for i in range(n) if i not in chosen)
        yield both(itertools.permutations(chosen), itertools.permutations(others))


def _half(
    links: _Links,
    start: int,
    orders: Iterable[tuple[int, ...]],
    end: Float[np.ndarray, " 3"],
    allowed: tuple[int, int],
    oriented: bool,
) -> _Half:
    """All signs and the allowed zeros of joints from ``start`` on, whose columns are in one of these orders.

    ``allowed`` are the step of zeros, in eighths of a revolution, and how many may be moved; ``end`` is the point in
    the last of their frames, mm. Rotations are left out where they are not needed.
    """
    parts, m, (step, most) = [], len(links.q), allowed
    for order in orders:
        signs = eighths = np.zeros((1, 0), dtype=int)
        points, rotations = np.tile(end, (1, m, 1)), np.tile(np.eye(3), (1, m if oriented else 0, 1, 1))
        for joint, column in reversed(list(enumerate(order, start))):
            own_signs, own_eighths = links.variants(joint, step)
            new, old = (part.ravel() for part in np.indices((len(own_signs), len(signs))))
            few = (own_eighths[new] != 0) + np.sum(eighths[old] != 0, axis=1) <= most
            new, old = new[few], old[few]
            signs = np.column_stack([own_signs[new], signs[old]])
            eighths = np.column_stack([own_eighths[new], eighths[old]])
            turn, shift = links.of(joint, column, own_signs[new], own_eighths[new])
            points = np.einsum("hmij,hmj->hmi", turn, points[old]) + shift
            rotations = np.einsum("hmij,hmjk->hmik", turn[:, : rotations.shape[1]], rotations[old])
        columns = np.tile(np.array(order, dtype=int), (len(signs), 1))
        parts.append(_Half(columns, signs, eighths, rotations, points))
    return _Half(*(np.concatenate(part) for part in zip(*parts, strict=True)))


class _Best:
    """The hypotheses with the smallest costs so far."""

    def __init__(self):
        self.costs, self.hypotheses = np.zeros(0), []

    def take(self, costs: Float[np.ndarray, "f l"], first: _Half, last: _Half) -> None:
        flat = costs.ravel()
        bound = np.max(self.costs) if len(self.costs) >= _KEPT else np.inf
        new = np.flatnonzero(flat < bound)
        if len(new) > _KEPT:
            new = new[np.argpartition(flat[new], _KEPT)[:_KEPT]]
        rows, columns = np.divmod(new, costs.shape[1])
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True):
            order, signs, eighths = (
                tuple(np.concatenate([getattr(half, part)[k] for half, k in ((first, i), (last, j))]).tolist())
                for part in ("columns", "signs", "eighths")
            )
            self.hypotheses.append(Hypothesis(order, signs, tuple(k * _EIGHTH for k in eighths)))
        self.costs = np.concatenate([self.costs, flat[new]])
        if len(self.costs) > _KEPT:
            kept = np.argpartition(self.costs, _KEPT)[:_KEPT]
            self.costs, self.hypotheses = self.costs[kept], [self.hypotheses[i] for i in kept]


def _costs(first: _Half, last: _Half, evidence: Evidence, lever: float) -> Float[np.ndarray, "f l"]:
    """Sums of squared residuals, mm^2."""
    origins = first.points - evidence.points if evidence.in_base else first.points
    costs = 2 * _flat(np.einsum("fmij,fmi->fmj", first.rotations, origins)) @ _flat(last.points).T
    costs += np.sum(origins**2, axis=(1, 2))[:, None] + np.sum(last.points**2, axis=(1, 2))
    if evidence.in_base:
        if evidence.rotations is not None:
            turned = np.einsum("fmij,mik->fmjk", first.rotations, evidence.rotations)
            # Of a rotation R from the known S, 3 - tr(S^T R) is the squared angle where it is small.
            costs += lever**2 * (3 * len(evidence.q) - _flat(turned) @ _flat(last.rotations).T)
        return costs
    turned = np.ascontiguousarray(first.rotations.transpose(2, 0, 1, 3))  # by coordinate
    moved = first.points.transpose(2, 0, 1)
    ends = np.cumsum(np.bincount(evidence.owner)).tolist()
    for start, end in itertools.pairwise([0, *ends]):  # sockets, one after the other
        for part, shift in zip(turned, moved, strict=True):
            columns = slice(3 * start, 3 * end)
            sums = _flat(part)[:, columns] @ _flat(last.points)[:, columns].T
            sums += np.sum(shift[:, start:end], axis=1)[:, None]
            sums *= sums
            sums /= end - start
            costs -= sums
    if evidence.points is not None:
        points = evidence.points - evidence.points.mean(axis=0)
        products = [
            [_flat(part * weights[:, None]) @ _flat(last.points).T + (shift @ weights)[:, None] for weights in points.T]
            for part, shift in zip(turned, moved, strict=True)
        ]
        costs += np.sum(points**2) - 2 * _best_alignment(np.array(products))
    return costs


def _best_alignment(products: Float[np.ndarray, "3 3 f l"]) -> Float[np.ndarray, "f l"]:
    """The largest trace of a rotation times each matrix: the sum of its singular values, the last with the sign of the
    determinant (Kabsch 1976). The squared singular values are eigenvalues, from the characteristic polynomial."""
    size = np.sqrt(np.sum(products**2, axis=(0, 1))) + 1e-300
    h = products / size
    squares = np.einsum("ca...,cb...->ab...", h, h)
    determinant = (
        h[0, 0] * (h[1, 1] * h[2, 2] - h[1, 2] * h[2, 1])
        - h[0, 1] * (h[1, 0] * h[2, 2] - h[1, 2] * h[2, 0])
        + h[0, 2] * (h[1, 0] * h[2, 1] - h[1, 1] * h[2, 0])
    )
    # Smith 1961: eigenvalues of a symmetric matrix whose trace, here 1, is known.
    deviation = squares - np.eye(3)[:, :, None, None] / 3
    p = np.sqrt(np.sum(deviation**2, axis=(0, 1)) / 6) + 1e-300
    a, b, c, d, e, f = (deviation[i, j] / p for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    half = (a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)) / 2
    angle = np.arccos(np.clip(half, -1, 1)) / 3
    values = [1 / 3 + 2 * p * np.cos(angle + turn) for turn in (0, -2 * np.pi / 3, 2 * np.pi / 3)]  # largest first
    largest, middle, _ = (np.sqrt(np.maximum(value, 0)) for value in values)
    # The smallest from the determinant, which keeps its sign and digits.
    smallest = determinant / np.maximum(largest * middle, 1e-12)
    return size * (largest + middle + smallest)


def _flat(array: np.ndarray) -> np.ndarray:
    return array.reshape(len(array), -1)


def _evenly(rows: np.ndarray, most: int) -> np.ndarray:
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int))]
