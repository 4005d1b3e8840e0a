"""Whether JAX can start on the platforms that it is told to use, and the CPU in their place for the command line.

In Python these settings are those of the whole program, so that they are not changed there: a sentence says what is
wrong with them. It is a `RuntimeError`, as JAX's own, and no `InputError`: to those, readers add the name of a file.
"""

import functools
import os
import sys

_SETTINGS = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")  # environment variables; the second is an older name
_GUARDS = [f"JAX_TRANSFER_GUARD{kind}" for kind in ("", "_HOST_TO_DEVICE", "_DEVICE_TO_DEVICE", "_DEVICE_TO_HOST")]


def _told() -> str:
    """The settings that name more than the CPU; where there are none, JAX takes what is there."""
    given = {name: os.environ.get(name, "") for name in _SETTINGS}
    return " and ".join(f"{name}={value}" for name, value in given.items() if value not in ("", "cpu"))


def check_backend() -> None:
    """Raise `RuntimeError` where JAX has been imported and cannot start."""
    jax = sys.modules.get("jax")
    if jax is None:
        return
    try:
        jax.devices()
    except Exception as error:  # a RuntimeError, or an AssertionError where nothing that is named is there
        told = _told()
        raise RuntimeError(
            f"JAX cannot start, as {f'{told} names no device' if told else 'it finds no device'} that this machine and "
            f"this installation have; {'unset it' if told else 'see its message'}, or set JAX_PLATFORMS=cpu."
        ) from error


@functools.cache
def check_setting() -> None:
    """The same, once, where a setting names more than the CPU; otherwise JAX is not started for it."""
    if _told():
        check_backend()


def prepare_command() -> str | None:
    """Before a command computes: go on on the CPU where JAX cannot start on what it is told to use; a sentence says so.

    Settings that are for finding copies to and from a device in programs with jit forbid what a command does.
    """
    for name in _GUARDS:
        os.environ.pop(name, None)
    if not _told():
        return None
    import jax

    try:
        check_backend()
    except RuntimeError as error:
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
