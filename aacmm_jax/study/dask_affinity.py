"""The cores that each local Dask worker uses. Dask is optional, so import this module only where Dask is used."""

import os

import distributed


class Affinity(distributed.WorkerPlugin):
    """Restricts every worker to its part of the cores; otherwise each would use all, and wait for the others.

    A class of a module and not of a function, so that workers started later can unpickle it by name.
    """

    name = "aacmm-affinity"

    def __init__(self, cores: list[int], workers: int):
        self.cores, self.workers = cores, workers

    def setup(self, worker: distributed.Worker) -> None:
        """Called by Dask on the worker."""
        if hasattr(os, "sched_setaffinity"):
            number, count = int(worker.name) % self.workers, len(self.cores)
            part = self.cores[number * count // self.workers : (number + 1) * count // self.workers]
            os.sched_setaffinity(0, part or self.cores)
