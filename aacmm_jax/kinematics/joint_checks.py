"""Checks of what is stated of an arm's joints: limits, chains, and joints that follow others."""

import math
from collections.abc import Iterable, Mapping, Sequence

from ..core.errors import InputError
from ..core.text import pluralise

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
