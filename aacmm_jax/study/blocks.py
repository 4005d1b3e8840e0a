"""What is stored of every trial, how trials are cut into blocks, and what their numbers are computed with.

A study's file keeps what its numbers depend on besides the study (versions, the kind of device, settings of the
environment), the names of its blocks contain its checksum, and every worker compares its own before it computes a
block: so no study mixes numbers that were computed in two ways. Random numbers need none of this, see
`core.random_keys`. Two processors may round differently all the same, and are not told apart.
"""

import json
import os
from importlib import metadata
from typing import Any, NamedTuple

import jax
import numpy as np

from ..core._compat import jax_setting
from ..core.errors import InputError
from .definition import Study

MOST_BLOCKS = 10_000  # files in one folder
DIMENSIONS = ("cell", "trial", "parameter")

_PACKAGES = ("aacmm_jax", "jax", "jaxlib", "numpy", "scipy")
# Settings of JAX that change programs, with their defaults; benchmarks/attacks/settings.py tries all that JAX has.
_SETTINGS: dict[str, Any] = {
    "jax_default_dtype_bits": "64",
    "jax_default_matmul_precision": None,
    "jax_disable_jit": False,
    "jax_disable_most_optimizations": False,
    "jax_exec_time_optimization_effort": 0.0,
    "jax_memory_fitting_effort": 0.0,
    "jax_memory_fitting_level": "O2",
    "jax_optimization_level": "UNKNOWN",
}
_FLAGS = "XLA_FLAGS"
# What linear algebra, functions of NumPy and those of the C library are computed with.
_ENVIRONMENT = ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "GLIBC_TUNABLES", "MKL_CBWR")
_HARMLESS = (
    "--xla_cpu_multi_thread_eigen",
    "--xla_cpu_parallel_codegen_split_count",
    "--xla_dump",
    "--xla_force_host_platform_device_count",
    "--xla_hlo_profile",
)


class Variable(NamedTuple):
    """One array of results."""

    units: str
    long_name: str
    dtype: str = "f8"
    fill: float = np.nan  # of trials that have not run
    by_parameter: bool = False  # whether it has an axis for the parameters


METRICS = {
    "k": Variable("1", "k, measured / nominal"),
    "scale": Variable("1", "scale after stage 1, identified / true"),
    "scale_error": Variable("1", "scale error after the scale fix, identified / true - 1"),
    "de_stage1": Variable("mm", "DE before the scale fix"),
    "deltam_stage1": Variable("mm", "Deltam before the scale fix"),
    "length_error_stage1": Variable("mm", "largest length error before the scale fix"),
    "angle_error_stage1": Variable("rad", "largest angle error before the scale fix"),
    "de": Variable("mm", "DE after the scale fix"),
    "deltam": Variable("mm", "Deltam after the scale fix"),
    "length_error": Variable("mm", "largest length error after the scale fix"),
    "angle_error": Variable("rad", "largest angle error after the scale fix"),
}
VARIABLES = {
    "converged": Variable("1", "1 if every solve ended at a minimum, 0 if not, -1 if not yet run", "i1", -1),
    "reason": Variable("1", "why the last solve ended (see the attribute reasons)", "i1", -1),
    "steps": Variable("1", "evaluations of all solves", "i4", -1),
    **METRICS,
    "truth_inside": Variable("1", "1 if the true arm lies inside the bounds", "i1", -1),
    "active": Variable("1", "bound reached: -1 the lower, +1 the upper, 0 none, -128 if not yet run", "i1", -128, True),
    "estimate": Variable("mm or rad", "identified parameters at the end of the solve", by_parameter=True),
    "true": Variable("mm or rad", "parameters of the true arm", by_parameter=True),
}


class Block(NamedTuple):
    """Trials of some cells, all of one setting; the last ones are not included."""

    first_cell: int
    last_cell: int
    first_trial: int
    last_trial: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its part of the arrays of all cells and trials."""
        return slice(self.first_cell, self.last_cell), slice(self.first_trial, self.last_trial)

    @property
    def shape(self) -> tuple[int, int]:
        """Cells, and trials in each."""
        return self.last_cell - self.first_cell, self.last_trial - self.first_trial

    @property
    def size(self) -> int:
        """Number of trials."""
        return self.shape[0] * self.shape[1]


def blocks_of(study: Study, chunk: int) -> list[Block]:
    """Blocks of about ``chunk`` trials, in order: all trials of some cells that have the same compiled program, or some
    trials of one cell."""
    cells, trials = len(study.cells), study.trials
    if cells * -(-trials // chunk) > MOST_BLOCKS:
        raise InputError(
            f"the study has {cells} cells of {trials:,} trials each, which makes more than {MOST_BLOCKS:,} blocks in "
            f"chunks of {chunk} trials; give a larger chunk."
        )

    def of_one_setting(count: int) -> bool:
        groups = (study.settings[i : i + count] for i in range(0, cells, count))
        return all(len(set(group)) == 1 for group in groups)

    together = max(filter(of_one_setting, range(1, min(max(chunk // trials, 1), cells) + 1)))
    # Blocks of nearly equal size: a short last one would run the same compiled program for fewer trials.
    size = -(-trials // -(-trials // chunk))
    return [
        Block(cell, min(cell + together, cells), trial, min(trial + size, trials))
        for cell in range(0, cells, together)
        for trial in range(0, trials, size)
    ]


def computed_with() -> str:
    """What the numbers that this process computes depend on, as JSON; settings are left out where they are as usual."""
    used = {name: metadata.version(name) for name in _PACKAGES} | {"platform": jax.default_backend()}
    for name, usual in _SETTINGS.items():
        if (value := jax_setting(name, usual)) != usual:
            used[name.upper()] = str(value)
    flags = {flag for flag in os.environ.get(_FLAGS, "").split() if not flag.startswith(_HARMLESS)}
    environment = {name: os.environ.get(name, "") for name in _ENVIRONMENT} | {_FLAGS: " ".join(sorted(flags))}
    return json.dumps(used | {name: text for name, text in environment.items() if text}, sort_keys=True)


def check_same(begun: str, where: str, advice: str) -> None:
    """Raise `InputError` where this process computes with something else than ``begun``, naming the first difference.

    ``where`` names the study's file; ``advice`` is an alternative to what the message asks for.
    """
    then, here = json.loads(begun), json.loads(computed_with())
    for name in sorted({*then, *here}, key=str.lower):
        sign = " " if name in (*_PACKAGES, "platform") else "="
        before, now = (f"{name}{sign}{side[name]}" if name in side else f"no {name}" for side in (then, here))
        if before != now:
            raise InputError(
                f"{where} was begun with {before}, but this process has {now}, which can change the results; use the "
                f"same environment, or {advice}."
            )
