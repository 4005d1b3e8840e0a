"""The exception and the warning of the package, and a hint for misspelt words."""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Something given to the toolkit is wrong: the message says what, where, and what to do.

    Commands turn it into exit code 2 and one sentence; in Python it is an ordinary ``ValueError``.
    """


class IdentifiabilityWarning(UserWarning):
    """The data determine less than they seem to: some free parameters or the scale not at all, or copies count once.

    The message names the parameters, sockets or lengths.
    """


def nearest(word: str, known: Iterable[str], most: int = 12) -> str:
    """A hint ``; did you mean 'x'?`` for a misspelt word, or ``most`` of what is known when nothing is near."""
    known = list(known)
    matches = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    if matches:
        return f"; did you mean '{matches[0]}'?"
    shown = ", ".join(known[:most]) + (", ..." if len(known) > most else "")
    return f"; known are {shown}." if known else "."
