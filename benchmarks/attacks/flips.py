"""Single bits of files are flipped. The file gives the same result as before, or is refused in one sentence."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import aacmm_jax as aj

from .outcomes import Attempt, command_line, exact, read_again
from .samples import READERS, make, studies, study_results

COMMAND_SHARE = 20  # one flip in so many is read by the command line instead


class Target(NamedTuple):
    """A file whose bits are flipped, and what is read of it."""

    file: Path
    read: Callable[[], Any]
    command: list[str]  # of the command line, that reads it


def targets(folder: Path) -> dict[str, Target]:
    """What to do with the files that `make` has made."""

    def target(file: Path, load: Callable[[Path], Any], shown: Path) -> Target:
        return Target(file, lambda: load(shown), ["show", str(shown), "--json"])

    files = {kind: folder / f"{kind}.h5" for kind in READERS}
    found = {kind: target(file, READERS[kind], file) for kind, file in files.items()}
    return found | {kind: target(file, study_results, study) for kind, (file, study) in studies(folder).items()}


def through_the_command_line(target: Target) -> Target:
    """The same file, read by the command."""

    def read() -> Any:
        code, output, errors = command_line(target.command)
        if code == 2:
            raise aj.InputError(errors.strip().removeprefix("Error: "))
        return code, output, errors

    return target._replace(read=read)


def flips(kind: str, target: Target, count: int, random: np.random.Generator) -> Iterator[Attempt]:
    """Flip single bits of a file, one at a time."""
    content = target.file.read_bytes()
    expected = exact(target.read())
    try:
        places = zip(random.integers(len(content), size=count), random.integers(8, size=count), strict=True)
        for position, bit in places:
            damaged = bytearray(content)
            damaged[position] ^= 1 << int(bit)
            target.file.write_bytes(damaged)
            outcome, message = read_again(target.read, expected)
            yield Attempt(kind, outcome, f"byte {position}, bit {bit}: {message}")
    finally:
        target.file.write_bytes(content)
    assert exact(target.read()) == expected


def attack(folder: Path, seed: int, count: int) -> Iterator[Attempt]:
    """So many flips, over files of all kinds."""
    make(folder)
    found = targets(folder)
    for number, (kind, target) in enumerate(found.items()):
        random = np.random.default_rng([seed, number])
        share = count * (number + 1) // len(found) - count * number // len(found)
        by_command = share // COMMAND_SHARE
        yield from flips(kind, target, share - by_command, random)
        yield from flips(f"{kind} (command)", through_the_command_line(target), by_command, random)
