"""Larger damage than a bit, where HDF5 keeps what describes the data: the file gives the same result or is refused.

Each file is damaged with its seal (the SHA-256 of its bytes, at its end) as written, missing or cut, and recomputed.
With a recomputed seal, which anybody can make, other values are a forgery that no reader can tell; everything else must
still end as it should. The files are read in a process of its own: whatever it does, the attack goes on.
"""

import hashlib
import multiprocessing
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .flips import Target, targets
from .outcomes import HANG, LARGE, OTHER, SILENT, UNEXPECTED, Attempt, exact, read_again
from .samples import make

SEALS = ("as written", "missing", "recomputed")
SECONDS = 120  # without an answer: more than all limits of time in the package for files of this size
MEMORY = 2**19  # KiB by which an attempt may raise the most that the process has taken
_SIGNATURES = (b"GCOL", b"TREE", b"SNOD", b"HEAP", b"OHDR", b"OCHK", b"FRHP", b"FHDB", b"BTHD", b"BTLF", b"FSHD")
_SEAL = b"\naacmm_jax: SHA-256"
_PAGE = 512


def damaged(content: bytes, random: np.random.Generator) -> tuple[bytes, str]:
    """A file with one damage of some kind, and what it is."""
    found, size = bytearray(content), int(random.choice([8, 16, 64]))
    kind = str(random.choice(["bit", "zeros", "ones", "noise", "pages swapped", "cut", "end cut"]))
    if kind in ("cut", "end cut"):
        left = int(random.integers(len(found)) if kind == "cut" else len(found) - random.integers(1, 201))
        return bytes(found[:left]), f"cut to {left} bytes"
    place = int(random.integers(len(found) - 64))
    if random.random() < 0.6:
        signature = _SIGNATURES[int(random.integers(len(_SIGNATURES)))]
        starts = [i for i in range(len(found)) if found.startswith(signature, i)] if signature in found else [place]
        place = min(starts[int(random.integers(len(starts)))] + int(random.integers(200)), len(found) - 64)
    if kind == "bit":
        found[place] ^= 1 << int(random.integers(8))
    elif kind == "pages swapped":
        one, other = (int(start) * _PAGE for start in random.integers(len(found) // _PAGE, size=2))
        found[one : one + _PAGE], found[other : other + _PAGE] = (
            found[other : other + _PAGE],
            found[one : one + _PAGE],
        )
        return bytes(found), f"bytes {one} and {other}: {kind}"
    else:
        values = {"zeros": bytes(size), "ones": b"\xff" * size, "noise": random.bytes(size)}
        found[place : place + size] = values[kind]
    return bytes(found), f"byte {place}: {size} {kind}"


def with_seal(content: bytes, original: bytes, seal: str, random: np.random.Generator) -> bytes:
    """A damaged file with the seal of the original one, with none or a part of it, or with its own."""
    if seal == "recomputed":
        return content + original.replace(
            original.split(b": ")[-1], hashlib.sha256(content).hexdigest().encode() + b"\n"
        )
    return content + (original if seal == "as written" else original[: int(random.integers(-40, len(original)))])


def _attempts(folder: Path, kind: str, seed: list[int], first: int, count: int, pipe: Any) -> None:
    """In a process of its own: damage a file, read it, and send how that ended."""
    from aacmm_jax.files import reader_process

    reader_process._CPU_SECONDS = 0.5  # less than it has, for many files exceed it
    target: Target = targets(folder)[kind]
    content = target.file.read_bytes()
    end = content.rindex(_SEAL) if _SEAL in content else len(content)  # blocks of a study have checksums instead
    expected = exact(target.read())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(first, count):
        random, seal = np.random.default_rng([*seed, number]), SEALS[number % len(SEALS)]
        changed, what = damaged(content[:end], random)
        target.file.write_bytes(with_seal(changed, content[end:], seal, random))
        pipe.send((number, what, None, None))
        outcome, message = read_again(target.read, expected, OTHER if seal == "recomputed" else SILENT)
        largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if largest > before + MEMORY:
            outcome, message, before = LARGE, f"{largest - before} KiB", largest
        pipe.send((number, what, outcome, message))
    pipe.send(None)


def attempts(folder: Path, kind: str, seed: list[int], count: int) -> Iterator[Attempt]:
    """So many damages of one file; a process that hangs or crashes is replaced."""
    context, number = multiprocessing.get_context("spawn"), -1
    file, what = targets(folder)[kind].file, ""
    content = file.read_bytes()

    def attempt(outcome: str, detail: str) -> Attempt:
        return Attempt(f"{kind}, seal {SEALS[number % len(SEALS)]}", outcome, f"{what}: {detail}")

    while number < count - 1:
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_attempts, args=(folder, kind, seed, number + 1, count, sender))
        process.start()
        sender.close()
        try:
            while receiver.poll(SECONDS):
                if (found := receiver.recv()) is None:
                    break
                number, what, outcome, message = found
                if outcome is not None:
                    yield attempt(outcome, message)
            else:
                yield attempt(HANG, f"no answer for {SECONDS} s")
        except EOFError:
            process.join()
            yield attempt(UNEXPECTED, f"the process ended with {process.exitcode}")
        process.kill()
        process.join()
        file.write_bytes(content)


def attack(folder: Path, seed: int, count: int) -> Iterator[Attempt]:
    """So many damages, over files of all kinds and the three seals."""
    make(folder)
    for number, kind in enumerate(found := targets(folder)):
        share = count * (number + 1) // len(found) - count * number // len(found)
        yield from attempts(folder, kind, [seed, number], share)
