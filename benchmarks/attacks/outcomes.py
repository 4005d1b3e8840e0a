"""What all attacks share: how one attempt ended, calls with a time limit, and results that are compared exactly."""

import contextlib
import io
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import aacmm_jax as aj

SAME, REFUSED, OTHER, DONE = "same result", "refused in one sentence", "another valid input", "done"
SILENT, UNEXPECTED, HANG, LOST = "silent difference", "unexpected failure", "hang", "half-written or lost file"
LARGE = "much memory"
FAILURES = (SILENT, UNEXPECTED, HANG, LOST, LARGE)


class Attempt(NamedTuple):
    """One attempt: what was attacked and how, the outcome, and what shows it where it is a failure."""

    target: str
    outcome: str
    detail: str = ""


class Hang(BaseException):
    """The time limit of a call has passed; no `Exception`, as code under attack catches those."""


@contextlib.contextmanager
def limited_time(seconds: float) -> Iterator[None]:
    """`Hang` in work that takes longer."""

    def stop(*_: object) -> None:
        raise Hang

    former = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, former)


def is_sentence(text: str) -> bool:
    """Whether a message is one line that ends as a sentence does, and no longer than anybody reads."""
    return text.endswith((".", "?")) and "\n" not in text and len(text) <= 1000


def ending(call: Callable[[], Any], seconds: float = 20, said: list[str] | None = None) -> tuple[str | None, Any]:
    """How a call ended: None and its result, or the outcome and the message; ``said`` gets its warnings."""
    try:
        with limited_time(seconds), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = call()
        if said is not None:
            said += [str(one.message) for one in caught]
        return None, result
    except aj.InputError as error:
        return (REFUSED if is_sentence(str(error)) else UNEXPECTED), str(error)
    except Hang:
        return HANG, f"after {seconds:g} s"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return UNEXPECTED, f"{type(error).__name__}: {error}"


def read_again(
    read: Callable[[], Any], expected: Any, different: str = SILENT, names: Iterable[str] = ()
) -> tuple[str, str]:
    """The outcome of reading a changed file, and the message.

    ``different`` is what another result is. Where the change is one of ``names`` (of elements, attributes, keys,
    columns), another result is silent unless a warning says one of them; values are data.
    """
    said: list[str] = []
    outcome, found = ending(read, said=said)
    if outcome is not None:
        return outcome, found
    if exact(found) == expected:
        return SAME, ""
    names = tuple(names)
    named = any(name in sentence for name in names for sentence in said)
    return (OTHER if named else SILENT if names else different), " ".join(said)


def exact(value: Any) -> Any:
    """A result as nested tuples that compare equal exactly where every bit of it is equal."""
    if isinstance(value, dict):
        return tuple((key, exact(item)) for key, item in sorted(value.items()))
    if isinstance(value, tuple | list | frozenset):
        items = sorted(value) if isinstance(value, frozenset) else value
        return tuple(exact(item) for item in items)
    if isinstance(value, np.ndarray) and value.dtype == object:
        return tuple(map(str, value.tolist()))
    if isinstance(value, np.ndarray | np.generic | jax.Array | float):
        array = np.asarray(value)
        return array.dtype.str, array.shape, array.tobytes()
    leaves, structure = jax.tree.flatten(value)
    if len(leaves) == 1 and leaves[0] is value:
        return repr(value)
    return str(structure), tuple(exact(leaf) for leaf in leaves)


def command_line(words: list[str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command, run in this process."""
    from aacmm_jax.cli import main

    output, errors, former = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = ["aacmm", *words]
    code: Any = 0
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
            main()
    except SystemExit as ended:
        code = ended.code or 0
    finally:
        sys.argv = former
    return code, output.getvalue(), errors.getvalue()


def contents(folder: Path) -> dict[str, bytes]:
    """Every ordinary file below a folder."""
    found = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}
