"""Kinds of corrections that tests register, and forget afterwards."""

import contextlib
from collections.abc import Iterator

from aacmm_jax.kinematics.corrections import KINDS, coefficient_of, terms_of


@contextlib.contextmanager
def forgotten_kinds() -> Iterator[None]:
    """Kinds that are registered meanwhile are unknown afterwards."""
    before = dict(KINDS)
    try:
        yield
    finally:
        KINDS.clear()
        KINDS.update(before)
        coefficient_of.cache_clear()
        terms_of.cache_clear()
