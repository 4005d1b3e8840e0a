"""Compiled programs are kept between processes, in the user's own cache folder; set up when the package is imported.

AACMM_JAX_CACHE=0 leaves JAX's setting alone, and so does whoever has set a folder (JAX_COMPILATION_CACHE_DIR).
"""

import os
import sys
from pathlib import Path

_LEAST_SECONDS = "0.1"  # shorter compilations are not kept: reading them would take as long


def cache_folder() -> Path | None:
    """The folder, or None where it is turned off or anybody else could write to it: what is read there is run."""
    if os.environ.get("AACMM_JAX_CACHE", "").strip().lower() in {"0", "false", "off", "no"}:
        return None
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aacmm_jax"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except (OSError, RuntimeError):  # no home, or none to write to
        return None
    private = os.name != "posix" or (found.st_uid == os.getuid() and not found.st_mode & 0o022)
    return folder if private else None


def set_up() -> None:
    """Tell JAX, by its environment where it is not imported yet, so that processes started from here have it too."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    imported = sys.modules.get("jax")
    if imported is not None and imported.config.jax_compilation_cache_dir is not None:
        return
    folder = cache_folder()
    if folder is None:
        return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", _LEAST_SECONDS)
    if imported is not None:
        imported.config.update("jax_compilation_cache_dir", str(folder))
        imported.config.update("jax_persistent_cache_min_compile_time_secs", float(_LEAST_SECONDS))
