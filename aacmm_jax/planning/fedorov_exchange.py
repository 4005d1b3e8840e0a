"""Exchange of design points: from many candidate poses, the few whose information serves a criterion best."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.errors import InputError


class Candidates(NamedTuple):
    """Rows of information that each candidate pose would add, whitened, and the socket that it is of.

    Unknowns are the free parameters in natural steps and, after them, three coordinates of every socket.
    """

    rows: Float[np.ndarray, "c 3 P"]
    owner: Int[np.ndarray, " c"]
    base: Float[np.ndarray, "P P"]  # information that is there anyway: of the reference lengths, and a trace of prior
    parameters: int  # how many of the unknowns are parameters


class Goal(NamedTuple):
    """What a design shall make small: variances of some functions of the parameters, or of the parameters, or their volume.

    - "functions": their variances, with derivatives ``functions`` ``(v, p)``;
    - "trace": the variances along the axes of the covariance (A; E with a high power);
    - "determinant": the product of these (D).

    ``power`` r weighs a variance v by v^r, so that large ones count: 0 for the sum, 8 nearly for the largest alone.
    """

    kind: Literal["functions", "trace", "determinant"]
    functions: Float[np.ndarray, "v p"]
    power: float = 0.0

    def value(self, covariance: Any) -> Any:
        """The logarithm of what is minimised; of arrays of NumPy, or of JAX, through which it can be differentiated."""
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
        """The derivative by the covariance, but for a factor."""
        if self.kind == "trace":
            return np.linalg.matrix_power(covariance / np.trace(covariance), int(self.power))
        variances = self.variances(covariance)
        weights = (variances / variances.max()) ** self.power
        return (self.functions * weights[:, None]).T @ self.functions


def exchange(
    candidates: Candidates,
    count: int,
    goal: Goal,
    *,
    least: int = 2,
    sweeps: int = 12,
    tell: Callable[[float], None] | None = None,
) -> Int[np.ndarray, " count"]:
    """Which ``count`` candidates to take, at least ``least`` in every socket: added greedily, then exchanged one by one until a
    whole sweep gains nothing (Fedorov 1972). ``tell`` is called with the share done."""
    chosen: list[int] = []
    taken = np.zeros(len(candidates.owner), dtype=bool)
    information = candidates.base.copy()
    for number in range(count):
        best = _best(candidates, information, goal, ~taken & _wanted(candidates, chosen, count, least))
        chosen.append(best)
        taken[best] = True
        information += candidates.rows[best].T @ candidates.rows[best]
        if tell:
            tell(0.3 * (number + 1) / count)
    best_value, best_chosen = goal.value(covariance_of(information, candidates.parameters)), list(chosen)
    for sweep in range(sweeps):
        for place in range(count):
            old = chosen[place]
            rest = chosen[:place] + chosen[place + 1 :]
            information -= candidates.rows[old].T @ candidates.rows[old]
            taken[old] = False
            new = _best(candidates, information, goal, ~taken & _wanted(candidates, rest, count, least))
            chosen[place] = new
            taken[new] = True
            information += candidates.rows[new].T @ candidates.rows[new]
        value = goal.value(covariance_of(information, candidates.parameters))
        if tell:
            tell(0.3 + 0.7 * (sweep + 1) / sweeps)
        if value >= best_value - 1e-3:
            break
        best_value, best_chosen = value, list(chosen)
    return np.array(best_chosen)


def covariance_of(information: Float[np.ndarray, "P P"], parameters: int) -> Float[np.ndarray, "p p"]:
    """Covariance of the parameters, the sockets' positions eliminated."""
    return np.linalg.inv(information)[:parameters, :parameters]


def _wanted(candidates: Candidates, chosen: list[int], count: int, least: int) -> Bool[np.ndarray, " c"]:
    """Candidates that may be taken next, so that every socket still gets its share."""
    sockets = candidates.owner.max() + 1
    have = np.bincount(candidates.owner[chosen], minlength=sockets) if chosen else np.zeros(sockets, dtype=int)
    short = np.maximum(least - have, 0)
    if short.sum() >= count - len(chosen):
        return (short > 0)[candidates.owner]
    return np.ones(len(candidates.owner), dtype=bool)


def _best(candidates: Candidates, information: np.ndarray, goal: Goal, allowed: np.ndarray) -> int:
    """The candidate that improves the criterion most, by the matrix determinant lemma or Woodbury's identity."""
    inverse = np.linalg.inv(information)
    flat = candidates.rows.reshape(-1, information.shape[0])
    moved = (flat @ inverse).reshape(candidates.rows.shape)
    inner = np.eye(3) + moved @ candidates.rows.transpose(0, 2, 1)
    p = candidates.parameters
    if goal.kind == "determinant":
        # The determinant of the parameters alone: that of everything over that of the sockets'.
        sockets = np.linalg.inv(information[p:, p:])
        part = candidates.rows[:, :, p:]
        own = np.eye(3) + (part.reshape(-1, len(sockets)) @ sockets).reshape(part.shape) @ part.transpose(0, 2, 1)
        gain = np.linalg.slogdet(inner)[1] - np.linalg.slogdet(own)[1]
    else:
        weighted = inverse[:, :p] @ goal.weighted(inverse[:p, :p]) @ inverse[:p]
        outer = (flat @ weighted).reshape(candidates.rows.shape) @ candidates.rows.transpose(0, 2, 1)
        gain = np.trace(np.linalg.solve(inner, outer), axis1=1, axis2=2)
    if not (allowed.any() and np.all(np.isfinite(gain))):
        raise InputError("there are fewer candidate poses than poses to choose, or they add nothing; ask for more candidates.")
    return int(np.argmax(np.where(allowed, gain, -np.inf)))
