"""Which order, signs and zeros of joint readings fit an arm: all of them, by costs of halves of the chain.

The tip is o + R p, with the transform (R, o) of the first joints and the tip p in their last frame, which only the
other joints change. A sum of squares over the poses is then a product of a matrix that the first half of a hypothesis
has with one that the other half has. So a few thousand halves give the cost of millions of hypotheses, some five
million a second, without an approximation.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm
from ..kinematics.chain import Geometry, JointKinds, tip_pose

_MOST = 6_000_000  # hypotheses of one family: about a second
_BLOCK = 50_000  # hypotheses of one array, so that it stays in the processor's cache
_KEPT = 3000
_POSES, _PER_SOCKET = 36, 9  # of the search: in all, and in one socket
_EIGHTH = math.pi / 4  # of zeros: Gauss and Newton find the right one from an eighth of a revolution away


class Evidence(NamedTuple):
    """What recorded poses must agree with."""

    q: Float[np.ndarray, "m n"]  # readings, a column each for as many joints as the arm has, rad
    owner: Int[np.ndarray, " m"]  # the socket that each pose was held in, from 0 and not decreasing; of points all 0
    points: Float[np.ndarray, "m 3"] | None = None  # of the tip, mm; None: those of a socket coincide, wherever it is
    rotations: Float[np.ndarray, "m 3 3"] | None = None  # of the last frame, in the base frame
    own_frame: bool = False  # whether points are in an instrument's frame, which is unknown, not in the base frame

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

    def thinned(self, most: int = _POSES, per_socket: int = _PER_SOCKET) -> "Evidence":
        """At most about so many poses, in sockets at most so many each, evenly from beginning to end."""
        if self.points is not None:
            return self.at(_evenly(np.arange(len(self.q)), most))
        rows = [_evenly(np.flatnonzero(self.owner == i), per_socket) for i in range(self.owner.max() + 1)]
        rows.sort(key=len, reverse=True)
        count = max(1, int(np.sum(np.cumsum([len(part) for part in rows]) <= most)))
        return self.at(np.sort(np.concatenate(rows[:count])))


class Hypothesis(NamedTuple):
    """How readings of joints follow from recorded columns: joint i is ``signs[i] * angle * q[order[i]] + offsets[i]``;
    points are ``length`` times those that were recorded."""

    order: tuple[int, ...]  # the column of each joint, from 0
    signs: tuple[int, ...]
    offsets: tuple[float, ...]  # rad
    angle: float = 1.0
    length: float = 1.0

    def readings(self, q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
        """The readings of the joints, rad."""
        return self.angle * q[:, list(self.order)] * np.array(self.signs) + np.array(self.offsets)

    @property
    def changed(self) -> tuple[str, ...]:
        """What it changes, as `Recording.stated` names it: columns, sign, offset, unit, units."""
        of_each = {
            "columns": self.order != tuple(sorted(self.order)),
            "sign": min(self.signs) < 0,
            "offset": any(self.offsets),
            "unit": self.angle != 1,
            "units": self.length != 1,
        }
        return tuple(name for name, differs in of_each.items() if differs)

    @property
    def changes(self) -> int:
        """Number of mistakes that it names: units, signs, exchanges of two columns, zeros; one zero of all joints, such
        as the middle of servos, is one."""
        order, exchanges = list(self.order), 0
        for i in range(len(order)):
            while (j := order[i]) != i:
                order[i], order[j] = order[j], j
                exchanges += 1
        units = (self.angle != 1) + (self.length != 1)
        zeros = sum(offset != 0 for offset in self.offsets)
        zeros = min(zeros, len(set(self.offsets))) if zeros == len(self.offsets) else zeros
        return exchanges + units + sum(sign < 0 for sign in self.signs) + zeros


def search(arm: Arm, evidence: Evidence, lever: float) -> tuple[list[float], list[Hypothesis], int]:
    """The best hypotheses for the nominal arm, by a few dozen poses, in the order of their RMS residual, mm, and how
    many there were; an error of orientation counts ``lever`` mm a rad.

    Tried are, each with all signs: all orders of columns, with as many zeros a quarter of a revolution off as the
    budget allows; the orders that people make (two columns exchanged, reversed, shifted by one), with one or two zeros
    off by a quarter or an eighth; and the order as it is, with all zeros off.
    """
    n = arm.joints
    middle, probe, oriented = n // 2, np.asarray(arm.probe), evidence.rotations is not None
    links, turning = _links(arm, evidence.q), np.ones(n, dtype=bool)
    turning[[i - 1 for i in arm.prismatic]] = False
    turning[0] &= evidence.in_base  # elsewhere the base takes up the zero of the first joint
    every = []
    for columns in itertools.combinations(range(n), middle):
        others = [i for i in range(n) if i not in columns]
        every.append((list(itertools.permutations(columns)), list(itertools.permutations(others))))
    likely = [([order[:middle]], [order[middle:]]) for order in _likely_orders(n)]
    families = (
        # Orders of both halves, the step of zeros in eighths of a revolution, and how many may be off.
        (every, 2, 1 if evidence.own_frame else n),
        (likely, 2, 2),
        (likely, 1, 1),
        (likely[:1], 2, n),
        (likely[:1], 1, 3),
    )
    best, choices, tried = np.zeros(0), np.zeros((0, 3, n), dtype=int), 0
    for orders, step, most in families:
        count, joints = 2**n * sum(len(first) * len(last) for first, last in orders), int(np.sum(turning))
        moved = [math.comb(joints, k) * (8 // step - 1) ** k for k in range(min(most, joints) + 1)]
        sizes = count * np.cumsum(moved)
        most = int(np.sum(sizes <= _MOST)) - 1
        if most < 0:
            continue
        tried += int(sizes[most])
        for orders_first, orders_last in orders:
            first = _half(links[:middle], turning[:middle], orders_first, np.zeros(3), (step, most), True)
            last = _half(links[middle:], turning[middle:], orders_last, probe, (step, most), oriented)
            for k in range(most + 1):
                front, rear = first.at(first.zeros == k), last.at(last.zeros <= most - k)
                rows = max(1, _BLOCK // max(len(rear.points), 1))
                for start in range(0, len(front.points) if len(rear.points) else 0, rows):
                    part = front.at(slice(start, start + rows))
                    costs = _costs(part, rear, evidence, lever)
                    new = np.flatnonzero(costs < (np.max(best) if len(best) == _KEPT else np.inf))
                    halves = [
                        half.choices[i] for half, i in zip((part, rear), np.divmod(new, costs.shape[1]), strict=True)
                    ]
                    best = np.concatenate([best, costs.ravel()[new]])
                    choices = np.concatenate([choices, np.concatenate(halves, axis=2)])
                    if len(best) > _KEPT:
                        kept = np.argpartition(best, _KEPT)[:_KEPT]
                        best, choices = best[kept], choices[kept]
    residuals: dict[Hypothesis, float] = {}  # the families overlap
    for i in np.argsort(best, kind="stable"):
        order, signs, eighths = (tuple(part.tolist()) for part in choices[i])
        hypothesis = Hypothesis(order, signs, tuple(k * _EIGHTH for k in eighths))
        residuals.setdefault(hypothesis, math.sqrt(max(best[i], 0) / len(evidence.q)))
    return list(residuals.values()), list(residuals), tried


def _likely_orders(n: int) -> list[tuple[int, ...]]:
    """As recorded, two columns exchanged, reversed, and shifted by one."""
    plain = tuple(range(n))
    orders = [plain, plain[::-1], (*plain[1:], 0), (n - 1, *plain[:-1])]
    for i, j in itertools.combinations(range(n), 2):
        orders.append((*plain[:i], j, *plain[i + 1 : j], i, *plain[j + 1 :]))
    return list(dict.fromkeys(orders))


def _links(arm: Arm, q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "n n 2 8 m 4 4"]:
    """Transforms of single links, by joint, recorded column, sign (plus first) and zero in eighths of a revolution."""
    signs, zeros = np.array([1, -1])[:, None, None], np.arange(8)[:, None] * _EIGHTH
    readings = signs * q.T[:, None, None, :] + zeros
    whole, poses = to_numpy(arm.geometry), []
    for i in range(arm.joints):
        alpha, a, d, theta = (getattr(whole, name)[i : i + 1] for name in ("alpha", "a", "d", "theta"))
        beta = None if whole.beta is None else whole.beta[i : i + 1]
        kinds = JointKinds((True,)) if i + 1 in arm.prismatic else None
        link = Geometry(alpha, a, d, theta, beta, 0 * whole.probe, kinds)
        poses.append(np.asarray(tip_pose(link, readings.reshape(-1, 1))).reshape(*readings.shape, 4, 4))
    return np.stack(poses)


class _Half(NamedTuple):
    """Hypotheses about some of the joints, and what they make of the poses."""

    choices: Int[np.ndarray, "h 3 j"]  # columns, signs, and zeros in eighths of a revolution
    rotations: Float[np.ndarray, "h m 3 3"]
    points: Float[np.ndarray, "h m 3"]

    @property
    def zeros(self) -> Int[np.ndarray, " h"]:
        """How many zeros are moved."""
        return np.sum(self.choices[:, 2] != 0, axis=1)

    def at(self, rows: np.ndarray | slice) -> "_Half":
        return _Half(*(np.ascontiguousarray(part[rows]) for part in self))


def _half(
    links: Float[np.ndarray, "j n 2 8 m 4 4"],
    turning: np.ndarray,
    orders: list[tuple[int, ...]],
    end: Float[np.ndarray, " 3"],
    allowed: tuple[int, int],
    oriented: bool,
) -> _Half:
    """All signs and the allowed zeros (their step, and how many are moved) of these links, whose columns are in one of
    these orders; ``end`` is the point in the last of their frames, mm. Rotations are left out if not needed."""
    parts, m, (step, most) = [], links.shape[4], allowed
    for order in orders:
        choices = np.zeros((1, 3, 0), dtype=int)
        points, rotations = np.tile(end, (1, m, 1)), np.tile(np.eye(3), (1, m if oriented else 0, 1, 1))
        for i in reversed(range(len(order))):
            zeros = range(0, 8, step) if turning[i] else (0,)
            added = np.array([(order[i], sign, zero) for sign in (1, -1) for zero in zeros])[:, :, None]
            new, old = (part.ravel() for part in np.indices((len(added), len(choices))))
            choices = np.concatenate([added[new], choices[old]], axis=2)
            few = np.sum(choices[:, 2] != 0, axis=1) <= most
            choices, new, old = choices[few], new[few], old[few]
            pose = links[i, order[i], (added[new, 1, 0] < 0).astype(int), added[new, 2, 0]]
            turns = np.ascontiguousarray(pose[..., :3, :3])
            points = np.einsum("hmij,hmj->hmi", turns, points[old]) + pose[..., :3, 3]
            rotations = np.einsum("hmij,hmjk->hmik", turns[:, : rotations.shape[1]], rotations[old])
        parts.append(_Half(choices, rotations, points))
    return _Half(*(np.concatenate(part) for part in zip(*parts, strict=True)))


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
    determinant = np.sum(h[0] * np.cross(h[1], h[2], axis=0), axis=0)
    # Smith 1961: eigenvalues of the symmetric S = h^T h, whose trace is 1, are 1/3 + 2 p cos(...), where the deviation
    # D = S - I/3 has p^2 = |D|^2 / 6 = (|S|^2 - 1/3) / 6 and det D = det S - (1 - |S|^2) / 6 + 2/27.
    norm = np.sum(np.einsum("ca...,cb...->ab...", h, h) ** 2, axis=(0, 1))
    p = np.sqrt(np.maximum(norm - 1 / 3, 0) / 6) + 1e-100
    half = (determinant**2 - (1 - norm) / 6 + 2 / 27) / (2 * p**3)
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
