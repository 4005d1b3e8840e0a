"""The exceptions and the warning of the package, a hint for misspelt words, and one for packages of an extra."""

import difflib
import importlib.util
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from .text import in_short, quoted

_COMPARED = 200  # characters of a word: comparing takes their square
# By extra of pyproject.toml, the package whose presence says whether it is installed.
_PACKAGES = {
    "plot": "matplotlib", "report": "jinja2", "data": "xarray", "dask": "distributed", "camera": "cv2",
    "excel": "openpyxl", "ros": "rosbags", "lerobot": "pyarrow", "live": "starlette", "certificate": "typst",
}  # fmt: skip


class InputError(ValueError):
    """Something given to the toolkit is wrong: the message says what, where, and what to do.

    Commands turn it into exit code 2 and one sentence; in Python it is an ordinary ``ValueError``.

    Example:
        >>> try:
        ...     aj.load_arm("pandda")
        ... except aj.InputError as error:
        ...     print(error)
        'pandda' is neither a file nor an arm that ships with the package; did you mean 'panda'?
    """

    def __init__(self, sentence: str = ""):
        super().__init__(in_short(sentence))


class MissingExtra(InputError, ImportError):
    """Something asked for needs an extra that is not installed; the message has the command that installs it."""


def require(extra: str, use: str, package: str | None = None) -> None:
    """Raise `MissingExtra` where an extra, or one ``package`` of it, is not installed; ``use`` is what needs it, as the
    subject of the message."""
    package = package or _PACKAGES[extra]
    if importlib.util.find_spec(package) is None:
        # Double quotes are right in every shell, cmd.exe included.
        raise MissingExtra(
            f'{use} needs {package}; install the extra {extra}: pip install "aacmm_jax[{extra}]", or in a clone: '
            f'pip install ".[{extra}]"'
        )


class IdentifiabilityWarning(UserWarning):
    """The data determine less than they seem to: some free parameters or the scale not at all, or copies count once.

    The message names the parameters, sockets or lengths.

    Example:
        >>> import warnings
        >>> everything = aj.Parameters.free_of(arm, held=())
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     _ = aj.calibrate(arm, capture, aj.Bounds.around(arm, everything))
        >>> print(caught[0].category.__name__)
        IdentifiabilityWarning
        >>> print(str(caught[0].message).partition(";")[0])
        Not determined by any measurement of this kind: d_1 (has no effect on the measurements)
    """


@contextmanager
def naming(where: object) -> Iterator[None]:
    """Have an `InputError` begin with where it is: a file, or a key of a specification."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def nearest(word: str, names: Iterable[str], most: int = 12) -> str:
    """A hint ``; did you mean 'x'?`` for a misspelt word, or ``most`` of the names when nothing is near."""
    names = list(names)
    matches = difflib.get_close_matches(word[:_COMPARED], names, n=1, cutoff=0.5)
    if matches:
        return f"; did you mean {quoted(matches[0])}?"
    shown = ", ".join(quoted(name)[1:-1] for name in names[:most]) + (", ..." if len(names) > most else "")
    return f"; choose one of {shown}." if names else "."
