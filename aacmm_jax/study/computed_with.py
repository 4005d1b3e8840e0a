"""What the numbers of a study depend on besides the study: versions, the kind of device, settings of the environment.

A study's file keeps it, the names of its blocks contain its checksum, and every worker compares its own before it
computes a block: so no study mixes numbers that were computed in two ways. Random numbers need none of this, see
`core.random_keys`. Two processors may round differently all the same, and are not told apart.
"""

import json
import os
from importlib import metadata
from typing import Any

import jax

from ..core._compat import jax_setting
from ..core.errors import InputError

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


def computed_with() -> str:
    """What the numbers that this process computes depend on, as JSON; settings are left out where they are as usual."""
    used = {name: metadata.version(name) for name in _PACKAGES} | {"platform": jax.default_backend()}
    for name, usual in _SETTINGS.items():
        if (value := jax_setting(name, usual)) != usual:
            used[name.upper()] = str(value)
    environment = {name: os.environ.get(name, "") for name in _ENVIRONMENT} | {_FLAGS: _flags()}
    return json.dumps(used | {name: text for name, text in environment.items() if text}, sort_keys=True)


def check_same(begun: str, where: str, advice: str) -> None:
    """Raise `InputError` where this process computes with something else than ``begun``, naming the first difference.

    ``where`` names the study's file; ``advice`` is an alternative to what the message asks for.
    """
    now = computed_with()
    if now == begun:
        return
    then, here = json.loads(begun), json.loads(now)
    name = next(name for name in sorted({*then, *here}, key=str.lower) if then.get(name) != here.get(name))
    was, present = then.get(name), here.get(name)
    again = (
        f"install {name} {was}" if name in _PACKAGES else f"unset {name}" if was is None else f"set {name} to {was!r}"
    )
    if name == "platform":
        again = f"continue on a {was}"
    raise InputError(
        f"{where} was begun with {_shown(name, was)}, and here is {_shown(name, present)}, which can change the "
        f"numbers; {again}, or {advice}."
    )


def _shown(name: str, value: str | None) -> str:
    if name in _PACKAGES or name == "platform":
        return f"{name} {value}"
    return f"no {name}" if value is None else f"{name}={value}"


def _flags() -> str:
    """XLA's flags that change programs, in one order."""
    return " ".join(sorted({flag for flag in os.environ.get(_FLAGS, "").split() if not flag.startswith(_HARMLESS)}))
