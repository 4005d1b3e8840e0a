"""Checks of what is stated of an arm's joints: limits, chains, joints that follow others; and of its readings."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray
from ..core.text import pluralise
from .beside import extras

Limits = Sequence[Sequence[float]]  # lowest and highest reading of each joint


def checked_chains(
    chains: Mapping[str, Sequence[int]] | Iterable[tuple[str, Sequence[int]]], joints: int
) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """The joints of each chain by name, or `InputError` where they are no chains of so many joints."""
    pairs = chains.items() if isinstance(chains, Mapping) else chains
    made = tuple((str(name), tuple(int(i) for i in numbers)) for name, numbers in pairs)
    for name, numbers in made:
        if not numbers or sorted(set(numbers)) != list(numbers) or not 1 <= numbers[0] <= numbers[-1] <= joints:
            raise InputError(
                f"chain '{name}' has the joints {list(numbers)}; give increasing numbers from 1 to {joints}."
            )
    if len({name for name, _ in made}) < len(made):
        raise InputError("two chains have the same name; give each chain its own name.")
    if made and (missing := set(range(1, joints + 1)).difference(*(numbers for _, numbers in made))):
        raise InputError(f"joint {min(missing)} is in none of the chains; add it to a chain, or remove it.")
    return made


def checked_mimic(
    mimic: Iterable[tuple[int, int, float, float]], joints: int, fixed: tuple[int, ...]
) -> tuple[tuple[int, int, float, float], ...]:
    """Joints that follow another one, or `InputError`."""
    made = tuple((int(i), int(source), float(factor), float(offset)) for i, source, factor, offset in mimic)
    following = {*fixed, *(i for i, *_ in made)}
    for i, source, factor, offset in made:
        if not (1 <= i <= joints and 1 <= source <= joints) or source in following or i in fixed:
            raise InputError(
                f"joint {i} mimics joint {source}; a joint can mimic only another joint that moves by itself."
            )
        if not (math.isfinite(factor) and math.isfinite(offset)):
            raise InputError(f"joint {i} mimics joint {source} by {factor} and {offset}; give finite numbers.")
    return made


def checked_limits(
    limits: Limits, joints: int, prismatic: tuple[int, ...] = (), fixed: tuple[int, ...] = ()
) -> tuple[tuple[float, float], ...]:
    """Lowest and highest reading of each joint, rad or mm, 0 of fixed ones; or `InputError` that names the joint."""
    try:
        rows = [tuple(float(reading) for reading in row) for row in limits]
    except (TypeError, ValueError):
        rows = []  # no rows of numbers
    if len(rows) != joints or any(len(row) != 2 for row in rows):
        units = "rad (prismatic joints: mm)" if prismatic else "rad"
        raise InputError(f"limits must be {pluralise(joints, 'row')} of (lowest, highest) in {units}, one per joint.")
    for i, (low, high) in enumerate(rows, start=1):
        if i in fixed:
            rows[i - 1] = (0.0, 0.0)
        elif not -math.inf < low < high < math.inf:
            reading = f"{low:g} to {high:g} {'mm' if i in prismatic else 'rad'}"
            raise InputError(
                f"limits of joint {i} are {reading}; both limits must be finite, and the lower limit below the "
                "upper limit."
            )
    return tuple((low, high) for low, high in rows)


def checked_readings(arm: Any, q: Numbers, like: AnyArray | None = None) -> Float[AnyArray, "... n"]:
    """Readings as an array like the arm's or another, or `InputError` where they do not have the arm's columns."""
    array, joints = as_array(q, "q", like=arm.alpha if like is None else like), arm.joints
    if array.ndim == 0 or array.shape[-1] not in arm.possible_columns:
        raise InputError(
            f"q has shape {array.shape}, but the arm has {joints} joints{_beside_joints(arm)}; the last axis must run "
            "over the joints."
        )
    check_chain(arm, array, "q")
    return array


def check_chain(arm: Any, readings: AnyArray, where: str) -> None:
    """Raise `InputError` where known readings of a robot, which ``where`` names, have a number that is no chain's, and
    no link's."""
    if arm.chains and is_concrete(readings):
        chain = np.asarray(readings)[..., arm.joints]
        wrong = ~arm.geometry.kinds.is_body(chain)
        if np.any(wrong):
            raise InputError(
                f"{where} has the chain {chain[wrong].flat[0]:g} in the column after the joints; give the number of a "
                f"chain, 0 to {len(arm.chains) - 1}."
            )


def with_chains(arm: Any, q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m columns"]:
    """Readings of all joints with the number of a chain, which take turns; those of an arm without chains as they
    are."""
    return np.column_stack([q, np.arange(len(q)) % len(arm.chains)]) if arm.chains else q


def _beside_joints(arm: Any) -> str:
    return ", the number of a chain" * bool(arm.chains) + extras(arm.beside.possible)


def check_columns(arm: Any, columns: int) -> None:
    """Raise `InputError` where readings of a capture have not the columns of an arm; without temperatures it was at
    20 C."""
    if columns not in arm.possible_columns:
        other = _beside_joints(arm)
        if columns == arm.joints + 1:
            other = ", or use an arm with thermometer=True if the last column is the temperature"
        elif columns >= 2 * arm.joints and "torques" not in arm.beside.possible:
            other = ", or use an arm with torques=True if columns of torques follow"
        raise InputError(
            f"the capture has {columns} columns, but the arm has {arm.joints} joints; give one column per joint{other}."
        )
    arm.beside.names(columns)
