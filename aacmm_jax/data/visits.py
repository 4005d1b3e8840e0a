"""Visits to sockets: which poses were taken without lifting the tip in between."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from jaxtyping import Int

from ..core.arrays import Numbers, is_concrete
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import AnyArray
from .copies import first_of_each

UNKNOWN = -1


def checked_visits(visits: Mapping[str, Numbers] | None, blocks: Mapping[str, AnyArray]) -> tuple[int, ...] | None:
    """A number for the visit of each pose of the sockets, each other visit another one; None where none is known.

    Args:
        visits: Number of the visit of each pose by socket.
        blocks: Readings of all sockets ``(m, n)``; the first of each pose is kept, as in a capture.

    Raises:
        InputError: A socket is unknown, or its visits are not one whole number a pose.
    """
    if visits is not None and not isinstance(visits, Mapping):
        raise InputError("the visits must be a dictionary: {'A': [1, 1, 2, 2]}, one number for each pose of a socket.")
    if not visits:
        return None
    found, known = [], 0
    for name in visits:
        if name not in blocks:
            raise InputError(f"visits are given for the unknown socket '{name}'{nearest(name, list(blocks))}")
    for name, block in blocks.items():
        if name not in visits:
            rows = np.full(block.shape[0], UNKNOWN)
        else:
            given = np.asarray(visits[name])
            numbers = given.shape == block.shape[:1] and given.dtype.kind in "iuf"
            if not numbers or not np.all(np.isfinite(given)) or np.any(given != np.round(given)):
                raise InputError(
                    f"the visits of socket '{name}' must be {block.shape[0]} whole numbers, one for each of its poses."
                )
            rows = known + np.unique(given, return_inverse=True)[1]
            known = int(rows.max()) + 1
        found.append(rows[first_of_each(block)] if is_concrete(block) else rows)
    return tuple(int(number) for number in np.concatenate(found))


def visits_of(capture: Any, names: Collection[str] | None = None) -> dict[str, Int[np.ndarray, " m"]]:
    """The visit of each pose of the sockets of a capture whose visits are known: of all, or of some names."""
    if capture.visits is None:
        return {}
    parts = np.split(np.array(capture.visits, dtype=int), np.cumsum(capture.sizes)[:-1])
    found = {name: rows for name, rows in zip(capture.names, parts, strict=True) if np.all(rows != UNKNOWN)}
    return found if names is None else {name: rows for name, rows in found.items() if name in names}
