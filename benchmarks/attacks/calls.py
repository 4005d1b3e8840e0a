"""Hostile calls, half of them of Python functions and half of commands."""

from collections.abc import Iterator
from pathlib import Path

from . import commands, python_calls
from .outcomes import Attempt


def attack(folder: Path, seed: int, count: int) -> Iterator[Attempt]:
    """So many calls, half of either kind."""
    yield from python_calls.attack(seed, count - count // 2)
    yield from commands.attack(folder, seed, count // 2)
