"""Packages that only some uses need, the extras of pyproject.toml, and what is said where one is not installed."""

import importlib.util

from .errors import InputError

# By extra, the package whose presence says whether it is installed.
_PACKAGES = {"plot": "matplotlib", "report": "jinja2", "data": "xarray", "dask": "distributed"}


class MissingExtra(InputError, ImportError):
    """Something asked for needs an extra that is not installed; the message has the command that installs it."""


def require(extra: str, use: str) -> None:
    """Raise `MissingExtra` where an extra is not installed. Double quotes are right in every shell, cmd.exe included.

    Args:
        extra: Its name in pyproject.toml.
        use: What needs it, as the subject of the message.
    """
    package = _PACKAGES[extra]
    if importlib.util.find_spec(package) is None:
        raise MissingExtra(f'{use} needs {package}; install it with: pip install "aacmm_jax[{extra}]"')
