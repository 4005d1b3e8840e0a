"""What a study sets up on every Dask worker. Dask is optional, so import this module only where Dask is used."""

import distributed

from .worker_setup import use_compilation_cache


class CompilationCache(distributed.WorkerPlugin):
    """Every worker keeps its compiled programs, in the cache folder of its own machine and user.

    A class of a module and not of a function, so that workers started later can unpickle it by name.
    """

    name = "aacmm-compilation-cache"

    def setup(self, worker: distributed.Worker) -> None:
        """Called by Dask on the worker."""
        use_compilation_cache()
