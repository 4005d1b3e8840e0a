"""Weights of poses, the inverse covariances of their tips, and the elimination of the sockets' positions under them."""

from typing import NamedTuple

from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, namespace
from .socket_sums import sums_over_sockets, to_poses


class Weights(NamedTuple):
    """Weights of poses. Layout as in `chain`: components before poses, which are last; leading axes may be a batch.

    With W_j the inverse covariance of tip j: ``root`` R_j has R_j^T R_j = W_j, so it whitens the tip's error. A socket
    shifted by c moves its whitened tips by R_j c; ``basis`` B_j = R_j T spans the same shifts orthonormally (the sum of
    B_j^T B_j over a socket is I), where ``centroid_factor`` T of the socket has T T^T = (sum of W_j)^-1, the covariance
    of its weighted centroid.
    """

    root: Float[AnyArray, "*batch 3 3 N"]  # 1/mm
    basis: Float[AnyArray, "*batch 3 3 N"]
    centroid_factor: Float[AnyArray, "*batch 3 3 s"]  # mm

    @classmethod
    def of(cls, covariances: Float[AnyArray, "*batch 3 3 N"], sizes: tuple[int, ...]) -> "Weights":
        """Weights of tips with these covariances (mm^2)."""
        root = inverse_root(covariances)
        total = sums_over_sockets(_product(_transposed(root), root), sizes)  # sum of W over each socket
        centroid_factor = _transposed(inverse_root(total))
        return cls(root, _product(root, to_poses(centroid_factor, sizes)), centroid_factor)

    def whiten(self, rows: Float[AnyArray, "... 3 N"]) -> Float[AnyArray, "... 3 N"]:
        """R_j times every pose's vector; more axes than the weights' (parameters) come after the batch."""
        return _applied(self.root, rows)

    def sums(self, whitened: Float[AnyArray, "... 3 N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... 3 s"]:
        """Coordinates, socket by socket, of the part that a shift of the socket accounts for."""
        return sums_over_sockets(_applied(_transposed(self.basis), whitened), sizes)

    def centred(self, whitened: Float[AnyArray, "... 3 N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... 3 N"]:
        """Whitened rows less what a shift of their socket accounts for."""
        return whitened - _applied(self.basis, to_poses(self.sums(whitened, sizes), sizes))

    def centroids(self, rows: Float[AnyArray, "... 3 N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... 3 s"]:
        """Weighted mean of each socket's rows."""
        return _applied(self.centroid_factor, self.sums(self.whiten(rows), sizes))


def inverse_root(matrix: Float[AnyArray, "... 3 3 N"]) -> Float[AnyArray, "... 3 3 N"]:
    """Inverse Cholesky factors of many 3 x 3 matrices, written out, since LAPACK takes 1 us for each."""
    xp = namespace(matrix)
    a, b, c = (matrix[..., i, i, :] for i in range(3))
    ba, ca, cb = matrix[..., 1, 0, :], matrix[..., 2, 0, :], matrix[..., 2, 1, :]
    p = 1 / xp.sqrt(a)
    l1, l2 = ba * p, ca * p
    q = 1 / xp.sqrt(b - l1 * l1)
    l3 = (cb - l2 * l1) * q
    r = 1 / xp.sqrt(c - l2 * l2 - l3 * l3)
    zero = xp.zeros_like(p)
    rows = ((p, zero, zero), (-l1 * p * q, q, zero), ((l1 * l3 * q - l2) * p * r, -l3 * q * r, r))
    return xp.stack([xp.stack(row, axis=-2) for row in rows], axis=-3)


def _transposed(matrix: Float[AnyArray, "... 3 3 N"]) -> Float[AnyArray, "... 3 3 N"]:
    return matrix.swapaxes(-3, -2)


def _product(one: Float[AnyArray, "... 3 3 N"], other: Float[AnyArray, "... 3 3 N"]) -> Float[AnyArray, "... 3 3 N"]:
    return namespace(one, other).sum(one[..., :, :, None, :] * other[..., None, :, :, :], axis=-3)


def _applied(matrix: Float[AnyArray, "... 3 3 N"], rows: Float[AnyArray, "... 3 N"]) -> Float[AnyArray, "... 3 N"]:
    extra = rows.ndim + 1 - matrix.ndim
    matrix = matrix.reshape(*matrix.shape[:-3], *(1,) * extra, *matrix.shape[-3:])
    return namespace(matrix, rows).sum(matrix * rows[..., None, :, :], axis=-2)
