"""Information matrices in arrow form: a dense head, and many small blocks that only the head couples.

The unknowns are the head (parameters and shared geometry), then the blocks, class by class of one size. With H the
head, D the blocks and C what couples each with the head, the step of the head follows from the Schur complement
H - sum C^T D^-1 C (Brown 1958; Triggs et al. 2000, section 6), and those of the blocks by substitution: linear in their
number. An ordinary dense matrix is a head without blocks. Leading axes may be a batch.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from ..core.linear_algebra import inverse_cholesky, solve_positive_definite
from ..core.numpy_or_jax import AnyArray, namespace

Vector = Float[AnyArray, "*batch z"]
Mask = Bool[AnyArray, "*batch z"]


class Arrow(NamedTuple):
    """A symmetric matrix in arrow form; ``crossed`` and ``private`` have one entry for each class of blocks."""

    head: Float[AnyArray, "*batch h h"]
    crossed: tuple[Float[AnyArray, "*batch K k h"], ...] = ()
    private: tuple[Float[AnyArray, "*batch K k k"], ...] = ()

    @classmethod
    def of(cls, matrix: "Arrow | Float[AnyArray, '*batch p p']") -> "Arrow":
        """The matrix in this form."""
        return matrix if isinstance(matrix, Arrow) else cls(matrix)

    @property
    def shape(self) -> tuple[tuple[int, int], ...]:
        """Number and size of the blocks of each class."""
        return tuple((part.shape[-3], part.shape[-1]) for part in self.private)

    def split(self, vector: Shaped[AnyArray, "*batch z"]) -> tuple[AnyArray, list[AnyArray]]:
        """The head of a vector, and its blocks ``(*batch, K, k)`` class by class."""
        return split(vector, self.head.shape[-1], self.shape)

    def diagonal(self) -> Vector:
        """The diagonal."""
        parts = (namespace(part).diagonal(part, axis1=-2, axis2=-1) for part in (self.head, *self.private))
        return joined(*parts)

    def sum(self) -> Float[AnyArray, "*batch"]:
        """The sum of what is stored, which is finite where everything is."""
        xp = namespace(self)
        total = xp.sum(self.head, axis=(-2, -1))
        for part in (*self.crossed, *self.private):
            total = total + xp.sum(part, axis=(-3, -2, -1))
        return total

    def scaled(self, scale: Vector) -> "Arrow":
        """S A S with a diagonal S."""
        head, parts = self.split(scale)
        crossed = (c * s[..., None] * head[..., None, None, :] for c, s in zip(self.crossed, parts, strict=True))
        private = (d * s[..., :, None] * s[..., None, :] for d, s in zip(self.private, parts, strict=True))
        return Arrow(self.head * head[..., :, None] * head[..., None, :], tuple(crossed), tuple(private))

    def times(self, vector: Vector) -> Vector:
        """The product with a vector."""
        head, parts = self.split(vector)
        top, below = (self.head @ head[..., None])[..., 0], []
        for crossed, block, part in zip(self.crossed, self.private, parts, strict=True):
            flat = _rows_of(crossed)
            top = top + (part.reshape(*part.shape[:-2], 1, -1) @ flat)[..., 0, :]
            of_head = (flat @ head[..., None])[..., 0]
            below.append((block @ part[..., None])[..., 0] + of_head.reshape(part.shape))
        return joined(top, *below)

    def damped_solution(self, right: Vector, fixed: Mask, damping: Float[AnyArray, "*batch"]) -> Vector:
        """Solution x of (A + damping I) x = right in the unknowns that are not fixed; 0 for those that are."""
        xp = namespace(self, right, fixed, damping)
        right = xp.where(fixed, 0.0, right)
        (head_fixed, fixed_of), (head_right, rights) = self.split(fixed), self.split(right)
        head = _damped(self.head, head_fixed, damping)
        followers = []
        for crossed, block, still, part in zip(self.crossed, self.private, fixed_of, rights, strict=True):
            # Schur complement by whitened blocks: with W D W^T = I, C^T D^-1 C = (W C)^T (W C).
            whitening = inverse_cholesky(_damped(block, still, damping[..., None]))
            crossed = xp.where(still[..., None] | head_fixed[..., None, None, :], 0.0, crossed)
            by_head, alone = whitening @ crossed, (whitening @ part[..., None])[..., 0]
            flat = _rows_of(by_head)
            transposed = xp.swapaxes(flat, -1, -2)
            head = head - transposed @ flat
            head_right = head_right - (transposed @ alone.reshape(*alone.shape[:-2], -1)[..., None])[..., 0]
            followers.append((whitening, by_head, alone))
        # Substitution: x_block = D^-1 (r_block - C x_head), with D^-1 = W^T W.
        solution = solve_positive_definite(head, head_right)
        below = []
        for whitening, by_head, alone in followers:
            rest = alone - (by_head @ solution[..., None, :, None])[..., 0]
            below.append((xp.swapaxes(whitening, -1, -2) @ rest[..., None])[..., 0])
        return joined(solution, *below)


def _rows_of(blocks: Shaped[AnyArray, "*batch K k h"]) -> Shaped[AnyArray, "*batch r h"]:
    """The rows of all blocks of a class, one below the other; the head may have no unknowns."""
    *batch, count, size, width = blocks.shape
    return blocks.reshape(*batch, count * size, width)


def split(
    vector: Shaped[AnyArray, "*batch z"], head: int, shape: Sequence[tuple[int, int]]
) -> tuple[AnyArray, list[AnyArray]]:
    """The head of a vector, and its blocks ``(*batch, K, k)`` class by class."""
    parts, first = [], head
    for count, size in shape:
        parts.append(vector[..., first : first + count * size].reshape(*vector.shape[:-1], count, size))
        first += count * size
    return vector[..., :head], parts


def joined(head: Float[AnyArray, "*batch h"], *parts: Float[AnyArray, "*batch _ _"]) -> Vector:
    """The vector with this head and these blocks."""
    if not parts:
        return head
    flat = [part.reshape(*part.shape[:-2], -1) for part in parts]
    return namespace(head, parts).concatenate([head, *flat], axis=-1)


def _damped(
    matrix: Float[AnyArray, "*batch k k"], fixed: Bool[AnyArray, "*batch k"], damping: Any
) -> Float[AnyArray, "*batch k k"]:
    """With the damping on the diagonal, and ones there for what is fixed and coupled with nothing."""
    xp, inside = namespace(matrix, fixed), ~fixed
    matrix = xp.where(inside[..., :, None] & inside[..., None, :], matrix, 0.0)
    added = xp.where(fixed, 1.0, damping[..., None])
    unit = np.eye(matrix.shape[-1])
    return matrix + added[..., :, None] * unit.reshape((1,) * (added.ndim - 1) + unit.shape)
