"""What a page may ask of a session, how often, and the JSON that it gets."""

import json
import math
import time
from collections.abc import Callable
from typing import Any

from ..core.errors import InputError

# What the page may ask for, with its fields; each is a method of the session.
_ACTIONS: dict[str, dict[str, type]] = {
    "take": {},
    "undo": {},
    "skip": {},
    "exclude": {"pose": int, "excluded": bool},
    "mark": {"text": str},
    "temperature": {"celsius": float},
    "auto": {"on": bool},
    "place": {"name": str},
    "finish": {"calibrate": bool},
}
_KINDS = {
    int: "number of a pose",
    float: "usable number",
    str: "text of at most 200 printable characters",
    bool: "choice of true or false",
}
_USABLE: dict[type, Callable[[Any], bool]] = {
    int: lambda value: 0 <= value < 2**31,
    float: lambda value: abs(value) < 2**31,
    str: lambda value: len(value) <= 200 and value.isprintable(),
    bool: lambda value: True,
}
_A_SECOND, _BURST = 20.0, 40.0  # actions


class Allowance:
    """Actions that may still be done: so many a second, and some saved up."""

    def __init__(self) -> None:
        self.left, self.at = _BURST, time.monotonic()

    def take(self) -> bool:
        """Whether one more may be done, which then counts."""
        now = time.monotonic()
        self.left, self.at = min(_BURST, self.left + (now - self.at) * _A_SECOND), now
        if self.left < 1:
            return False
        self.left -= 1
        return True


def action_of(body: bytes) -> tuple[str, dict[str, Any]]:
    """Name and fields of an action; everything that is not in the table is refused."""
    try:
        given = json.loads(body)
    except (ValueError, RecursionError):
        raise InputError("an action must be JSON") from None
    name = str(given.get("action")) if isinstance(given, dict) else ""
    if (wanted := _ACTIONS.get(name)) is None:
        raise InputError(f"an action must be one of {', '.join(_ACTIONS)}")
    fields = {key: value for key, value in given.items() if key != "action"}
    if fields.keys() != wanted.keys():
        raise InputError(f"{name} takes {', '.join(wanted) or 'no fields'}")
    for key, kind in wanted.items():
        if kind is float and type(fields[key]) is int:
            fields[key] = float(min(fields[key], 2**31))
        if type(fields[key]) is not kind or not _USABLE[kind](fields[key]):
            raise InputError(f"{key} of {name} is not a {_KINDS[kind]}")
    return name, fields


def as_json(state: Any) -> bytes:
    """JSON, in which a number that is not finite is null: a browser reads no other."""

    def finite(value: Any) -> Any:
        if isinstance(value, float):
            return value if math.isfinite(value) else None
        if isinstance(value, dict):
            return {key: finite(item) for key, item in value.items()}
        return [finite(item) for item in value] if isinstance(value, list | tuple) else value

    try:
        text = json.dumps(state, allow_nan=False, separators=(",", ":"))
    except ValueError:
        text = json.dumps(finite(state), allow_nan=False, separators=(",", ":"))
    return text.encode()
