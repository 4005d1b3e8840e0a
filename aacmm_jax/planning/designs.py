"""Optimal designs: of many candidate poses, those whose information makes an objective small (Fedorov 1972)."""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.errors import InputError

Kind = Literal["functions", "trace", "determinant"]
Layout = TypeVar("Layout")
Poses = TypeVar("Poses")
_RELAXATION = 0.7  # exponent; 0.5 never makes variances larger, 1 never determinants


class Candidates(NamedTuple):
    """Candidate poses: their whitened rows of the design matrix, and the sockets (or other places) that they belong to.

    Unknowns are the free parameters in natural steps and, after them, those of the geometry: three coordinates of every
    socket. All candidates have as many rows as the one that has most; those that it has not are 0.
    """

    rows: Float[np.ndarray, "c r P"]
    owner: Int[np.ndarray, " c"]
    base: Float[np.ndarray, "P P"]  # information of reference lengths, certified values and a weak prior
    parameters: int  # how many of the unknowns are parameters

    def information(self, rows: Float[np.ndarray, "m r P"]) -> Float[np.ndarray, "P P"]:
        """Information of the rows of some poses, with the base."""
        flat = rows.reshape(-1, rows.shape[-1])
        return self.base + flat.T @ flat


class Objective(NamedTuple):
    """What a design minimises: variances of functions of the parameters, of the parameters, or their volume.

    - "functions": variances of functions with derivatives ``functions`` ``(v, p)``;
    - "trace": variances along the axes of the covariance (A; E with a high power);
    - "determinant": the product of these (D).

    Variances v are summed as v^(r + 1) with ``power`` r: 0 for their sum, 8 for nearly the largest alone.
    """

    kind: Kind
    functions: Float[np.ndarray, "v p"]
    power: float = 0.0

    def value(self, covariance: Float[np.ndarray, "p p"]) -> float:
        """The logarithm of what is minimised."""
        if self.kind == "determinant":
            return float(np.linalg.slogdet(covariance)[1] / len(covariance))
        r = self.power + 1
        if self.kind == "trace":
            unit = np.trace(covariance)
            return float(np.log(np.trace(np.linalg.matrix_power(covariance / unit, int(r)))) / r + np.log(unit))
        variances = self.variances(covariance)
        largest = variances.max()
        return float(np.log(np.mean((variances / largest) ** r)) / r + np.log(largest))

    def variances(self, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " v"]:
        """Variances of the functions."""
        return np.sum(self.functions @ covariance * self.functions, axis=1)

    def gradient(self, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
        """Derivative of the value by the covariance."""
        if self.kind == "determinant":
            unscaled = np.linalg.inv(covariance)
        elif self.kind == "trace":
            unscaled = np.linalg.matrix_power(covariance / np.trace(covariance), int(self.power))
        else:
            variances = self.variances(covariance)
            weights = (variances / variances.max()) ** self.power
            unscaled = (self.functions * weights[:, None]).T @ self.functions
        # A covariance t times as large has a value larger by log t, so the derivative times the covariance has trace 1.
        return unscaled / np.sum(unscaled * covariance)


def exchange(
    candidates: Candidates,
    count: int,
    objective: Objective,
    *,
    least: int | Int[np.ndarray, " s"] = 2,
    sweeps: int = 12,
    start: Sequence[int] = (),
    progress: Callable[[float], None] = lambda fraction: None,
) -> Int[np.ndarray, " count"]:
    """Indices of ``count`` candidates, at least ``least`` in every socket (one number, or one each): added greedily to
    those of ``start``, then exchanged one by one until a whole sweep improves nothing (Fedorov 1972). ``progress`` is
    called with the fraction done."""
    owner, rows = candidates.owner, candidates.rows
    available = np.ones(len(owner), dtype=bool)
    chosen = [int(i) for i in start]
    available[chosen] = False
    information = candidates.information(rows[chosen])

    def take(others: list[int]) -> int:
        """Take the candidate that goes best with the others, so that every socket can still get its least number."""
        nonlocal information
        short = np.maximum(least - np.bincount(owner[np.array(others, dtype=int)], minlength=owner.max() + 1), 0)
        allowed = available & (short > 0)[owner] if short.sum() >= count - len(others) else available
        best = _best(candidates, information, objective, allowed)
        available[best] = False
        information += rows[best].T @ rows[best]
        return best

    for number in range(len(chosen), count):
        chosen.append(take(chosen))
        progress(0.3 * (number + 1) / count)
    best_value, best_chosen = objective.value(covariance_of(information, candidates.parameters)), list(chosen)
    for sweep in range(sweeps):
        for i in range(count):
            information -= rows[chosen[i]].T @ rows[chosen[i]]
            available[chosen[i]] = True
            chosen[i] = take(chosen[:i] + chosen[i + 1 :])
        value = objective.value(covariance_of(information, candidates.parameters))
        progress(0.3 + 0.7 * (sweep + 1) / sweeps)
        if value >= best_value - 1e-3:
            break
        best_value, best_chosen = value, list(chosen)
    return np.array(best_chosen)


def relaxed_value(candidates: Candidates, count: int, objective: Objective, iterations: int) -> float:
    """Nearly the smallest value of ``count`` poses where each candidate may be taken a fraction of a time.

    The fractions, equal at first, are multiplied by a power of the candidate's derivative (the multiplicative algorithm
    of Silvey, Titterington and Torsney 1978): at a hundredth of the cost this ranks sets of candidates as exchange
    does. Without iterations it is the value for random poses.
    """
    p, (_, rows, unknowns) = candidates.parameters, candidates.rows.shape
    flat = candidates.rows.reshape(-1, unknowns)
    times = np.full(len(candidates.rows), count / len(candidates.rows))
    for iteration in range(iterations + 1):
        covariance = np.linalg.inv(candidates.base + (flat * np.repeat(times, rows)[:, None]).T @ flat)
        if iteration < iterations:
            gradient = objective.gradient(covariance[:p, :p])
            try:
                root = np.linalg.cholesky(gradient)
            except np.linalg.LinAlgError:  # singular, where lengths do not depend on a parameter
                values, vectors = np.linalg.eigh(gradient)
                root = vectors * np.sqrt(np.maximum(values, 0.0))
            gain = np.sum((flat @ (covariance[:, :p] @ root)).reshape(len(times), -1) ** 2, axis=1)
            times *= gain**_RELAXATION
            times *= count / times.sum()
    return objective.value(covariance[:p, :p])


def covariance_of(information: Float[np.ndarray, "P P"], parameters: int) -> Float[np.ndarray, "p p"]:
    """Covariance of the parameters, the sockets' positions eliminated."""
    return np.linalg.inv(information)[:parameters, :parameters]


def _best(
    candidates: Candidates,
    information: Float[np.ndarray, "P P"],
    objective: Objective,
    allowed: Bool[np.ndarray, " c"],
) -> int:
    """The candidate that improves the criterion most.

    With rows A of a candidate and C the covariance so far, the determinant of the information grows by |I + A C A^T|
    (the matrix determinant lemma), and C becomes C - C A^T (I + A C A^T)^-1 A C (Woodbury), so that to first order a
    criterion with the derivative G by C falls by the trace of (I + A C A^T)^-1 A C G C A^T.
    """
    rows, p = candidates.rows, candidates.parameters
    inverse = np.linalg.inv(information)
    moved, inner = _products(rows, inverse)
    if objective.kind == "determinant":
        # The determinant of the parameters' block: that of all unknowns over that of the geometry.
        _, of_geometry = _products(rows[:, :, p:], np.linalg.inv(information[p:, p:]))
        improvement = np.linalg.slogdet(inner)[1] - np.linalg.slogdet(of_geometry)[1]
    else:
        _, outer = _products(moved[:, :, :p], objective.gradient(inverse[:p, :p]), identity=0.0)
        improvement = np.trace(np.linalg.solve(inner, outer), axis1=1, axis2=2)
    if not (allowed.any() and np.all(np.isfinite(improvement))):
        raise InputError(
            "there are fewer candidate poses than poses to choose, or the candidates add no information; give more "
            "candidates."
        )
    return int(np.argmax(np.where(allowed, improvement, -np.inf)))


def _products(
    rows: Float[np.ndarray, "c r k"], matrix: Float[np.ndarray, "k k"], identity: float = 1.0
) -> tuple[Float[np.ndarray, "c r k"], Float[np.ndarray, "c r r"]]:
    """A M and ``identity`` I + A M A^T of each candidate's rows A; A M as one long product, a tenth of the time."""
    c, r, k = rows.shape
    moved = (rows.reshape(c * r, k) @ matrix).reshape(c, r, k)
    return moved, identity * np.eye(r) + np.einsum("crk,csk->crs", moved, rows)


def best_layout(
    shortlist: Sequence[Layout],
    poses_in: Callable[[Layout, Layout | None, Poses | None], Poses | None],
    score: Callable[[Layout, Poses], float],
    neighbour: Callable[[Layout], Layout | None],
    tries: int,
    report: Callable[[float], None],
) -> Layout:
    """The layout with the lowest score among some good ones and, then, neighbours of the best so far.

    ``poses_in(layout, best, poses)`` are poses in a layout, which may reuse those in the best; None where it is not
    reached. ``report`` is called with the fraction done.
    """
    best, best_poses, best_score = None, None, np.inf
    for number in range(len(shortlist) + tries):
        report(0.4 + 0.6 * number / (len(shortlist) + tries))
        if number < len(shortlist):
            layout, poses = shortlist[number], poses_in(shortlist[number], None, None)
        elif best is None:
            break
        else:
            layout = neighbour(best)
            poses = None if layout is None else poses_in(layout, best, best_poses)
        value = np.inf if layout is None or poses is None else score(layout, poses)
        if value < best_score:
            best, best_poses, best_score = layout, poses, value
    report(1.0)
    return shortlist[0] if best is None else best
