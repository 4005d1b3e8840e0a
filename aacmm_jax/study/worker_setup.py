"""Compiled programs in worker processes: JAX may have been imported there before anybody said where they are kept."""

import os
from typing import Any, NamedTuple

import jax

from ..core._compat import reset_compilation_cache
from ..core.compilation_cache import set_up


class CacheSettings(NamedTuple):
    """JAX's settings of the compilation cache."""

    folder: str | None
    least_seconds: float  # shorter compilations are not kept

    @classmethod
    def current(cls) -> "CacheSettings":
        """Those of this process."""
        config: Any = jax.config
        return cls(config.jax_compilation_cache_dir, config.jax_persistent_cache_min_compile_time_secs)


def use_compilation_cache(settings: CacheSettings | None = None) -> None:
    """Use the cache of these settings; by default that of the environment, or else the user's own folder."""
    if settings is None:
        set_up()
        known = CacheSettings.current()
        seconds = os.environ.get("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", known.least_seconds)
        settings = CacheSettings(known.folder, float(seconds))
    jax.config.update("jax_compilation_cache_dir", settings.folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", settings.least_seconds)
    reset_compilation_cache()  # a process that has compiled without a cache would never look for one again
