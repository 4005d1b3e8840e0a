"""Whether JAX can start on the platforms that it is told to use, and the CPU in their place for the command line.

In Python this setting is the whole program's, so that nothing is changed there: a sentence says what is wrong with it.
"""

import os
import sys

from .errors import InputError

_SETTINGS = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")  # environment variables; the second is an older name
_GUARDS = [f"JAX_TRANSFER_GUARD{kind}" for kind in ("", "_HOST_TO_DEVICE", "_DEVICE_TO_DEVICE", "_DEVICE_TO_HOST")]


def check_backend() -> None:
    """Raise `InputError` where JAX has been imported and cannot start."""
    jax = sys.modules.get("jax")
    if jax is None:
        return
    try:
        jax.devices()
    except Exception as error:  # a RuntimeError, or an AssertionError where nothing that is named is there
        told = " and ".join(f"{name}={os.environ[name]}" for name in _SETTINGS if os.environ.get(name))
        reason = f"{told} names no device" if told else "it finds no device"
        raise InputError(
            f"JAX cannot start, as {reason} that this machine and this installation have; unset "
            f"{'it' if told else 'the options of JAX'}, or set JAX_PLATFORMS=cpu."
        ) from error


def prepare_command() -> str | None:
    """Before a command computes: go on on the CPU where JAX cannot start on what it is told to use; a sentence says so.

    Settings that are for finding copies to and from a device in programs with jit forbid what a command does.
    """
    for name in _GUARDS:
        os.environ.pop(name, None)
    if all(os.environ.get(name, "cpu") in ("", "cpu") for name in _SETTINGS):
        return None  # JAX takes what is there
    import jax

    try:
        check_backend()
    except InputError as error:
        for name in _SETTINGS:
            if name in os.environ:
                os.environ[name] = "cpu"  # for processes started from here
                jax.config.update(name.lower(), "cpu")
        check_backend()
        return f"Warning: {str(error).partition(';')[0]}; computing on the CPU instead."
    return None


def is_from_jax(error: BaseException) -> bool:
    """Whether JAX itself raised an exception, for its own reasons: no memory on a device, a setting that forbids."""
    return any(kind.__module__.partition(".")[0] in ("jax", "jaxlib") for kind in type(error).__mro__)
