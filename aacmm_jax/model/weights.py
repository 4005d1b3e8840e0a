"""Weights of poses, the inverse covariances of their tips, and the elimination of the sockets' positions under them."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Weights(NamedTuple):
    """Weights of poses. Layout as in `chain`: components before poses, which are last; leading axes may be a batch.

    With W_j the inverse covariance of tip j: ``root`` R_j has R_j^T R_j = W_j, so it whitens the tip's error. A socket
    shifted by c moves its whitened tips by R_j c; ``basis`` B_j = R_j T spans the same shifts orthonormally (the sum of
    B_j^T B_j over a socket is I), where ``centroid_factor`` T of the socket has T T^T = (sum of W_j)^-1, the covariance
    of its weighted centroid.
    """

    root: Float[Array, "*batch 3 3 N"]  # 1/mm
    basis: Float[Array, "*batch 3 3 N"]
    centroid_factor: Float[Array, "*batch 3 3 s"]  # mm

    @classmethod
    def of(cls, covariances: Float[Array, "*batch 3 3 N"], sizes: tuple[int, ...]) -> "Weights":
        """Weights of tips with these covariances (mm^2)."""
        root = inverse_root(covariances)
        members = jnp.asarray(membership(sizes))
        total = _product(_transposed(root), root) @ members.T  # sum of W over each socket
        centroid_factor = _transposed(inverse_root(total))
        return cls(root, _product(root, centroid_factor @ members), centroid_factor)

    def whiten(self, rows: Float[Array, "... 3 N"]) -> Float[Array, "... 3 N"]:
        """R_j times every pose's vector; more axes than the weights' (parameters) come after the batch."""
        return _applied(self.root, rows)

    def sums(self, whitened: Float[Array, "... 3 N"], sizes: tuple[int, ...]) -> Float[Array, "... 3 s"]:
        """Coordinates, socket by socket, of the part that a shift of the socket accounts for."""
        return _applied(_transposed(self.basis), whitened) @ jnp.asarray(membership(sizes).T)

    def centred(self, whitened: Float[Array, "... 3 N"], sizes: tuple[int, ...]) -> Float[Array, "... 3 N"]:
        """Whitened rows less what a shift of their socket accounts for."""
        return whitened - _applied(self.basis, self.sums(whitened, sizes) @ jnp.asarray(membership(sizes)))

    def centroids(self, rows: Float[Array, "... 3 N"], sizes: tuple[int, ...]) -> Float[Array, "... 3 s"]:
        """Weighted mean of each socket's rows."""
        return _applied(self.centroid_factor, self.sums(self.whiten(rows), sizes))


def membership(sizes: tuple[int, ...]) -> Float[np.ndarray, "s N"]:
    """1 where a pose belongs to a socket."""
    owner = np.repeat(np.arange(len(sizes)), sizes)
    return (owner[None, :] == np.arange(len(sizes))[:, None]).astype(float)


def inverse_root(matrix: Float[Array, "... 3 3 N"]) -> Float[Array, "... 3 3 N"]:
    """Inverse Cholesky factors of many 3 x 3 matrices, written out, since LAPACK takes 1 us for each."""
    a, b, c = (matrix[..., i, i, :] for i in range(3))
    ba, ca, cb = matrix[..., 1, 0, :], matrix[..., 2, 0, :], matrix[..., 2, 1, :]
    p = 1 / jnp.sqrt(a)
    l1, l2 = ba * p, ca * p
    q = 1 / jnp.sqrt(b - l1 * l1)
    l3 = (cb - l2 * l1) * q
    r = 1 / jnp.sqrt(c - l2 * l2 - l3 * l3)
    zero = jnp.zeros_like(p)
    rows = ((p, zero, zero), (-l1 * p * q, q, zero), ((l1 * l3 * q - l2) * p * r, -l3 * q * r, r))
    return jnp.stack([jnp.stack(row, axis=-2) for row in rows], axis=-3)


def _transposed(matrix: Float[Array, "... 3 3 N"]) -> Float[Array, "... 3 3 N"]:
    return jnp.swapaxes(matrix, -3, -2)


def _product(one: Float[Array, "... 3 3 N"], other: Float[Array, "... 3 3 N"]) -> Float[Array, "... 3 3 N"]:
    return jnp.sum(one[..., :, :, None, :] * other[..., None, :, :, :], axis=-3)


def _applied(matrix: Float[Array, "... 3 3 N"], rows: Float[Array, "... 3 N"]) -> Float[Array, "... 3 N"]:
    extra = rows.ndim + 1 - matrix.ndim
    matrix = matrix.reshape(*matrix.shape[:-3], *(1,) * extra, *matrix.shape[-3:])
    return jnp.sum(matrix * rows[..., None, :, :], axis=-2)
