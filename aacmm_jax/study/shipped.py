"""Studies that ship with the package, as examples and as they are."""

import os
from importlib import resources
from pathlib import Path

from ..core.errors import InputError, nearest
from .definition import Study, study_of_file


def shipped_studies() -> tuple[str, ...]:
    """Names of the studies that come with the package."""
    folder = resources.files("aacmm_jax.study") / "shipped_studies"
    return tuple(sorted(item.name.removesuffix(".toml") for item in folder.iterdir() if item.name.endswith(".toml")))


def read_study(source: str | os.PathLike) -> Study:
    """A study by shipped name (``"bound-sensitivity"``) or from a TOML file; what it names lies beside it, or ships too.

    Raises `InputError` that names the file, the place in it and the mend.
    """
    if isinstance(source, str) and source in shipped_studies():
        with resources.as_file(resources.files("aacmm_jax.study") / "shipped_studies" / f"{source}.toml") as path:
            return study_of_file(path)
    try:
        there = Path(source).exists()
    except OSError:  # a name too long to be one
        there = False
    if not there and Path(source).suffix != ".toml":
        raise InputError(
            f"'{source}' is neither a file nor a study that ships with the package{nearest(str(source), shipped_studies())}"
        )
    return study_of_file(source)
