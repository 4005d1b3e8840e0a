"""Devices that are read live; one module a kind, which `open_device` finds by the word before the colon.

A module has ``open_device(rest, options, setup)``: the text after the colon up to ``?``, and what follows as a
dictionary.
"""

import importlib
import pkgutil
from pathlib import Path
from urllib.parse import parse_qsl

from ...core.errors import InputError
from ..places import Setup
from .device import AbstractDevice

_NOT_KINDS = {"device", "line_format", "lines"}


def device_kinds() -> tuple[str, ...]:
    """The kinds of devices, as they are written before the colon."""
    modules = (module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]))
    return tuple(sorted(name for name in modules if name not in _NOT_KINDS))


def open_device(text: str, setup: Setup) -> AbstractDevice:
    """The device that a text describes: ``kind:where?option=value&...``.

    Args:
        text: What it says.
        setup: The arm that the device reads, and the places.

    Raises:
        InputError: The text is wrong, or an extra is not installed.

    Example:
        >>> specification = aj.files.load_specification("cheng2018-simulation")
        >>> cone = aj.data.observations.SimulatedSocket("A", (400, 200, 300), 5)
        >>> setup = aj.live.setup_of(specification, aj.files.load_noise("cheng2018-simulation"), [cone])
        >>> aj.live.open_device("simulated:?seed=1", setup).joints
        6
    """
    kind, colon, rest = text.partition(":")
    if not colon or kind not in device_kinds():
        kinds = ", ".join(f"{name}:" for name in device_kinds())
        raise InputError(f"device '{text}' does not begin with a kind of device; begin it with one of {kinds}")
    where, _, query = rest.partition("?")
    options = dict(parse_qsl(query, keep_blank_values=True))
    if len(options) != len([part for part in query.split("&") if part]):
        raise InputError(f"device '{text}' has an option that is not name=value, or is given twice; correct it.")
    module = importlib.import_module(f"{__package__}.{kind}")
    return module.open_device(where, options, setup)
