"""Fedorov's exchange (1972): from many candidate poses, those whose information makes an objective small."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.errors import InputError

Kind = Literal["functions", "trace", "determinant"]
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
    progress: Callable[[float], None] = lambda fraction: None,
) -> Int[np.ndarray, " count"]:
    """Indices of ``count`` candidates, at least ``least`` in every socket (one number, or one each): added greedily,
    then exchanged one by one until a whole sweep improves nothing (Fedorov 1972). ``progress`` is called with the
    fraction done."""
    chosen: list[int] = []
    taken = np.zeros(len(candidates.owner), dtype=bool)
    information = candidates.base.copy()
    for number in range(count):
        allowed = ~taken & _allowed(candidates, chosen, count, least)
        best = _best(candidates, information, objective, allowed)
        chosen.append(best)
        taken[best] = True
        information += candidates.rows[best].T @ candidates.rows[best]
        progress(0.3 * (number + 1) / count)
    best_value, best_chosen = objective.value(covariance_of(information, candidates.parameters)), list(chosen)
    for sweep in range(sweeps):
        for i in range(count):
            old = chosen[i]
            rest = chosen[:i] + chosen[i + 1 :]
            information -= candidates.rows[old].T @ candidates.rows[old]
            taken[old] = False
            allowed = ~taken & _allowed(candidates, rest, count, least)
            new = _best(candidates, information, objective, allowed)
            chosen[i] = new
            taken[new] = True
            information += candidates.rows[new].T @ candidates.rows[new]
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
    p, (_, each, unknowns) = candidates.parameters, candidates.rows.shape
    flat = candidates.rows.reshape(-1, unknowns)
    times = np.full(len(candidates.rows), count / len(candidates.rows))
    for iteration in range(iterations + 1):
        covariance = np.linalg.inv(candidates.base + (flat * np.repeat(times, each)[:, None]).T @ flat)
        if iteration < iterations:
            root = _root(objective.gradient(covariance[:p, :p]))
            gain = np.sum((flat @ (covariance[:, :p] @ root)).reshape(len(times), -1) ** 2, axis=1)
            times *= gain**_RELAXATION
            times *= count / times.sum()
    return objective.value(covariance[:p, :p])


def _root(matrix: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """A root of a semidefinite matrix; it is singular where lengths do not depend on a parameter."""
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(matrix)
        return vectors * np.sqrt(np.maximum(values, 0.0))


def covariance_of(information: Float[np.ndarray, "P P"], parameters: int) -> Float[np.ndarray, "p p"]:
    """Covariance of the parameters, the sockets' positions eliminated."""
    return np.linalg.inv(information)[:parameters, :parameters]


def _allowed(
    candidates: Candidates, chosen: list[int], count: int, least: int | Int[np.ndarray, " s"]
) -> Bool[np.ndarray, " c"]:
    """Candidates that may be taken next, so that every socket can still get its least number."""
    sockets = candidates.owner.max() + 1
    present = np.bincount(candidates.owner[chosen], minlength=sockets) if chosen else np.zeros(sockets, dtype=int)
    short = np.maximum(least - present, 0)
    if short.sum() >= count - len(chosen):
        return (short > 0)[candidates.owner]
    return np.ones(len(candidates.owner), dtype=bool)


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
        _, outer = _products(moved[:, :, :p], objective.gradient(inverse[:p, :p]), 0.0)
        improvement = np.trace(np.linalg.solve(inner, outer), axis1=1, axis2=2)
    if not (allowed.any() and np.all(np.isfinite(improvement))):
        raise InputError(
            "there are fewer candidate poses than poses to choose, or they add no information; give more candidates."
        )
    return int(np.argmax(np.where(allowed, improvement, -np.inf)))


def _products(
    rows: Float[np.ndarray, "c r k"], matrix: Float[np.ndarray, "k k"], one: float = 1.0
) -> tuple[Float[np.ndarray, "c r k"], Float[np.ndarray, "c r r"]]:
    """A M and I + A M A^T of each candidate's rows A, or without I; A M as one long product, a tenth of the time."""
    c, r, k = rows.shape
    moved = (rows.reshape(c * r, k) @ matrix).reshape(c, r, k)
    return moved, one * np.eye(r) + np.einsum("crk,csk->crs", moved, rows)
