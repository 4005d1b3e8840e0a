"""Fedorov's exchange (1972): from many candidate poses, those whose information makes an objective small."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.errors import InputError

Kind = Literal["functions", "trace", "determinant"]


class Candidates(NamedTuple):
    """Candidate poses: their whitened rows of the design matrix, and the sockets that they belong to.

    Unknowns are the free parameters in natural steps and, after them, three coordinates of every socket.
    """

    rows: Float[np.ndarray, "c 3 P"]
    owner: Int[np.ndarray, " c"]
    base: Float[np.ndarray, "P P"]  # information of the reference lengths and of a weak prior
    parameters: int  # how many of the unknowns are parameters

    def information(self, rows: Float[np.ndarray, "m 3 P"]) -> Float[np.ndarray, "P P"]:
        """Information of the rows of some poses, with the base."""
        return self.base + np.einsum("cki,ckj->ij", rows, rows)


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

    def value(self, covariance: Any) -> Any:
        """The logarithm of what is minimised; a covariance of JAX makes it differentiable."""
        tools: Any = jnp if isinstance(covariance, jax.Array) else np
        if self.kind == "determinant":
            return tools.linalg.slogdet(covariance)[1] / len(covariance)
        r = self.power + 1
        if self.kind == "trace":
            unit = tools.trace(covariance)
            return tools.log(tools.trace(tools.linalg.matrix_power(covariance / unit, int(r)))) / r + tools.log(unit)
        variances = self.variances(covariance)
        largest = variances.max()
        return tools.log(tools.mean((variances / largest) ** r)) / r + tools.log(largest)

    def variances(self, covariance: Any) -> Any:
        """Variances of the functions."""
        tools: Any = jnp if isinstance(covariance, jax.Array) else np
        return tools.einsum("vp,pq,vq->v", self.functions, covariance, self.functions)

    def weighted(self, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
        """The derivative by the covariance, up to a factor."""
        if self.kind == "trace":
            return np.linalg.matrix_power(covariance / np.trace(covariance), int(self.power))
        variances = self.variances(covariance)
        weights = (variances / variances.max()) ** self.power
        return (self.functions * weights[:, None]).T @ self.functions


def exchange(
    candidates: Candidates,
    count: int,
    objective: Objective,
    *,
    least: int = 2,
    sweeps: int = 12,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Int[np.ndarray, " count"]:
    """Indices of ``count`` candidates, at least ``least`` in every socket: added greedily, then exchanged one by one
    until a whole sweep improves nothing (Fedorov 1972). ``progress`` is called with the fraction done."""
    chosen: list[int] = []
    taken = np.zeros(len(candidates.owner), dtype=bool)
    information = candidates.base.copy()
    for number in range(count):
        best = _best(candidates, information, objective, ~taken & _allowed(candidates, chosen, count, least))
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
            new = _best(candidates, information, objective, ~taken & _allowed(candidates, rest, count, least))
            chosen[i] = new
            taken[new] = True
            information += candidates.rows[new].T @ candidates.rows[new]
        value = objective.value(covariance_of(information, candidates.parameters))
        progress(0.3 + 0.7 * (sweep + 1) / sweeps)
        if value >= best_value - 1e-3:
            break
        best_value, best_chosen = value, list(chosen)
    return np.array(best_chosen)


def covariance_of(information: Float[np.ndarray, "P P"], parameters: int) -> Float[np.ndarray, "p p"]:
    """Covariance of the parameters, the sockets' positions eliminated."""
    return np.linalg.inv(information)[:parameters, :parameters]


def _allowed(candidates: Candidates, chosen: list[int], count: int, least: int) -> Bool[np.ndarray, " c"]:
    """Candidates that may be taken next, so that every socket can still get its least number."""
    sockets = candidates.owner.max() + 1
    present = np.bincount(candidates.owner[chosen], minlength=sockets) if chosen else np.zeros(sockets, dtype=int)
    short = np.maximum(least - present, 0)
    if short.sum() >= count - len(chosen):
        return (short > 0)[candidates.owner]
    return np.ones(len(candidates.owner), dtype=bool)


def _best(candidates: Candidates, information: np.ndarray, objective: Objective, allowed: np.ndarray) -> int:
    """The candidate that improves the criterion most, by the matrix determinant lemma or Woodbury's identity."""
    inverse = np.linalg.inv(information)
    flat = candidates.rows.reshape(-1, information.shape[0])
    moved = (flat @ inverse).reshape(candidates.rows.shape)
    inner = np.eye(3) + moved @ candidates.rows.transpose(0, 2, 1)
    p = candidates.parameters
    if objective.kind == "determinant":
        # The determinant of the parameters' block: that of all unknowns over that of the sockets.
        sockets = np.linalg.inv(information[p:, p:])
        part = candidates.rows[:, :, p:]
        of_sockets = np.eye(3) + (part.reshape(-1, len(sockets)) @ sockets).reshape(part.shape) @ part.transpose(
            0, 2, 1
        )
        improvement = np.linalg.slogdet(inner)[1] - np.linalg.slogdet(of_sockets)[1]
    else:
        weighted = inverse[:, :p] @ objective.weighted(inverse[:p, :p]) @ inverse[:p]
        outer = (flat @ weighted).reshape(candidates.rows.shape) @ candidates.rows.transpose(0, 2, 1)
        improvement = np.trace(np.linalg.solve(inner, outer), axis1=1, axis2=2)
    if not (allowed.any() and np.all(np.isfinite(improvement))):
        raise InputError(
            "there are fewer candidate poses than poses to choose, or they add no information; give more candidates."
        )
    return int(np.argmax(np.where(allowed, improvement, -np.inf)))
