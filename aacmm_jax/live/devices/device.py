"""What every device has: what came since, what was bad of it, and whether it is connected."""

import abc
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError, nearest
from ...core.text import number
from ...data.recording import RecordedAs
from ...kinematics.arm import Arm
from ..places import Place
from ..samples import Sample


class AbstractDevice(abc.ABC):
    """A device that is read live. `read` never raises for what the device sends, and connects again by itself.

    Args:
        name: The text that describes it.
        joints: How many joints it reads; 0 of an instrument.
        connected: Whether it is.
        message: What is wrong at present; empty where nothing is.
        lines: How many lines, messages or images were read.
        bad: How many of these could not be used, by reason.
        read_as: Which of its readings is that of each joint, and in which direction (`Recording.read_as`).
        recorded_as: How its readings are written (`Recording.recorded_as`); None where that is not known.
        sources: Files that its readings depend on (`Recording.sources`).

    Example:
        >>> class Resting(aj.live.AbstractDevice):
        ...     joints, connected = 6, True
        ...
        ...     def read(self):
        ...         return [aj.live.Sample(0.0, np.zeros(6))]
        >>> print(len(Resting("an arm at rest").read()))
        1
    """

    name: str
    joints: int = 0
    connected: bool = False
    message: str = ""
    lines: int = 0
    read_as: tuple[int, ...] | None = None
    recorded_as: RecordedAs | None = None
    sources: tuple[str, ...] = ()
    bad: Counter[str]

    def __init__(self, name: str):
        self.name, self.bad = name, Counter()

    @abc.abstractmethod
    def read(self) -> list[Sample]:
        """What has come since the last call, the oldest first; waits for at most some hundredths of a second."""

    def asked(  # noqa: B027
        self, place: Place | None, q: Float[np.ndarray, " n"] | None, start: Float[np.ndarray, " n"] | None = None
    ) -> None:
        """Say which pose is wanted next, and where the motion to it begins; only what moves by itself heeds it."""

    def truth(self) -> Arm | None:
        """The arm itself, which only a simulation knows."""
        return None

    def close(self) -> None:  # noqa: B027
        """Give up the connection."""

    def raw(self) -> bytes:
        """Whole lines that came since the last call, as they came; nothing of what sends no lines."""
        return b""

    def state(self) -> dict[str, Any]:
        """What people see of it."""
        return {
            "name": self.name,
            "connected": self.connected,
            "lines": self.lines,
            "bad": dict(self.bad),
            "message": self.message,
        }


def check_joints(devices: Sequence[AbstractDevice], joints: int) -> None:
    """`InputError` where no device reads the joints of an arm, or one reads those of another arm."""
    if not any(device.joints for device in devices):
        raise InputError("no device reads the joints; add one with --device.")
    for device in devices:
        if device.joints not in (0, joints):
            raise InputError(
                f"device {device.name} reads {device.joints} joints, but the arm has {joints}; correct its line "
                "format, or name the right arm."
            )


def numbers_of(where: str, options: Mapping[str, str], known: Mapping[str, float]) -> dict[str, float]:
    """Options that are numbers, by name, with their defaults; `InputError` for others."""
    values = dict(known)
    for name, text in options.items():
        if name not in known:
            raise InputError(f"device '{where}' has no option '{name}'{nearest(name, known)}")
        try:
            values[name] = number(text)
        except ValueError:
            values[name] = math.nan
        if not math.isfinite(values[name]):
            raise InputError(f"option {name} of device '{where}' is '{text}'; give a number.")
    return values
