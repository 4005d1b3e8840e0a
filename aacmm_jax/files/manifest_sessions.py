"""Sessions in a manifest: tables, or rows of them, that name the session in which they were recorded."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..core.errors import InputError
from ..core.text import shorten
from ..data.capture import Capture, ReferenceLength
from ..data.joined_captures import join_sessions
from ..data.observations.observation import AbstractObservation
from ..data.observations.socket import Socket
from .patterns import check_name, fields_of, fill


def session_name(text: str | None, values: Mapping[str, str], where: str) -> str:
    """The session of a table, whose fields in braces are filled in; empty where it states none."""
    if text is None:
        return ""
    unknown = fields_of(text) - values.keys()
    if unknown:
        raise InputError(f"{where}: session uses the unknown field {shorten(sorted(unknown))}.")
    session = fill(text, values)
    check_name(session)
    return session


def in_sessions(
    sessions: Mapping[str, str],
    sockets: Mapping[str, np.ndarray],
    lengths: Sequence[ReferenceLength],
    observations: Sequence[tuple[str, AbstractObservation]],
    remounted: bool,
    visits: Mapping[str, np.ndarray],
) -> Capture:
    """One capture of all sessions, each but the first with a probe of its own where that was ``remounted``.

    Names of sockets, and those that lengths give, begin with the session; those of other observations do not yet.
    """
    named = {name: sessions.get(name, "") for name in sockets}
    without = [name for name, session in named.items() if not session]
    without += [observation.name for session, observation in observations if not session]
    if without:
        raise InputError(f"{shorten(without)} has no session, but other tables have; give each one.")
    parts: dict[str, tuple[dict[str, np.ndarray], list[ReferenceLength], list[AbstractObservation]]] = {}
    known: dict[str, dict[str, np.ndarray]] = {}
    for name, session in named.items():
        own_name = name.removeprefix(f"{session}/")
        parts.setdefault(session, ({}, [], []))[0][own_name] = sockets[name]
        if name in visits:
            known.setdefault(session, {})[own_name] = visits[name]
    for session, observation in observations:
        own = observation
        if isinstance(observation, Socket):
            own = Socket(observation.name.removeprefix(f"{session}/"), observation.q, target=observation.target)
        parts.setdefault(session, ({}, [], []))[2].append(own)
    for length in lengths:
        both = [s for s in parts if length.start.startswith(f"{s}/") and length.end.startswith(f"{s}/")]
        if not both:
            raise InputError(
                f"length from '{length.start}' to '{length.end}' joins no two sockets of one session; name them "
                "session/name."
            )
        start, end = (name.removeprefix(f"{both[0]}/") for name in (length.start, length.end))
        parts[both[0]][1].append(ReferenceLength(start, end, length.value, length.u))
    return join_sessions(
        {session: Capture(*part, visits=known.get(session)) for session, part in parts.items()}, own_probe=remounted
    )
