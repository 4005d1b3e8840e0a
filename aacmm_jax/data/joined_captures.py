"""Several captures as one: sessions of one arm, and batches of captures of one shape."""

from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core.arguments import checked_arguments, items_of
from ..core.arrays import Numbers, is_concrete
from ..core.errors import InputError
from .capture import Capture, check_one_capture
from .copies import visits_of
from .observations.declared import checked_name
from .observations.held import Socket
from .observations.observation import AbstractObservation
from .reference_length import ReferenceLength


@checked_arguments
def join_sessions(captures: Mapping[str, Capture], *, own_probe: bool = True) -> Capture:
    """Join captures that one arm took in several sessions, with its probe remounted in between, or on another base.

    Sockets, artefacts and stations of different sessions are different ones; what is unknown of the arm is the same.

    Args:
        captures: Name of a session -> its capture. Names of sockets and observations become ``session/name``.
        own_probe: Whether every session after the first has a probe of its own, whose place in the last frame is
            unknown; False where the probe stayed as it was.

    Returns:
        One capture of all sessions, to calibrate as a whole.

    Raises:
        InputError: A capture is a batch, or one has targets in more than one session.

    Example:
        >>> monday = aj.simulate(true, {"A": (400, 200, 300)}, poses=5, seed=1)
        >>> friday = aj.simulate(true, {"A": (500, 200, 300)}, poses=5, seed=2)
        >>> both = aj.join_sessions({"monday": monday, "friday": friday})
        >>> print(both.names, [observation.name for observation in both.observations])
        ('monday/A',) ['friday/A']
    """
    if not isinstance(captures, Mapping) or not captures:
        raise InputError("the sessions must be a dictionary of captures by name: {'Monday': capture, ...}.")
    sockets: dict[str, Numbers] = {}
    visits: dict[str, Numbers] = {}
    lengths: list[ReferenceLength] = []
    observations: list[AbstractObservation] = []
    for number, (session, capture) in enumerate(captures.items()):
        if not isinstance(capture, Capture):
            raise InputError(f"session '{session}' is a {type(capture).__name__}; give an aj.Capture.")
        check_one_capture(capture)
        checked_name(session, "a session")
        for name, readings in capture.sockets.items():
            if number and own_probe:
                observations.append(Socket(f"{session}/{name}", readings, target=f"probe of {session}"))
            else:
                sockets[f"{session}/{name}"] = readings
        visits |= {f"{session}/{name}": numbers for name, numbers in visits_of(capture).items()}
        lengths += [
            ReferenceLength(f"{session}/{length.start}", f"{session}/{length.end}", length.value, length.u)
            for length in capture.lengths
        ]
        probe = f"probe of {session}" if number and own_probe else ""
        observations += [observation.in_session(session, probe) for observation in capture.observations]
    visits = {name: rows for name, rows in visits.items() if name in sockets}
    return Capture(sockets, lengths, observations, sessions=tuple(captures), visits=visits)


def stack_captures(captures: Iterable[Capture]) -> Capture:
    """Stack captures into a batch for `identify_many`.

    Args:
        captures: Captures with the same sockets, numbers of poses, joints and reference lengths.

    Returns:
        A capture whose ``q`` is ``(batch, N, n)`` and whose lengths are ``(batch,)``; rad and mm.

    Raises:
        InputError: Where there is none, one is a batch, or they differ in shape.

    Example:
        >>> drawn = [aj.simulate(true, sockets, poses=10, noise=noise, seed=seed) for seed in (1, 2, 3)]
        >>> print(aj.stack_captures(drawn).q.shape)
        (3, 20, 6)
    """
    captures = items_of(captures, "captures")
    for capture in captures:
        if not isinstance(capture, Capture):
            raise InputError(f"a capture to stack is a {type(capture).__name__}; give a list of aj.Capture.")
    if not captures:
        raise InputError("there is no capture to stack; give at least one.")
    for capture in captures:
        check_one_capture(capture)
    shapes = {
        (c.names, c.sizes, tuple((r.start, r.end) for r in c.lengths), c.columns, _form(c.observations))
        for c in captures
    }
    if len(shapes) != 1:
        raise InputError(
            "captures of a batch must have the same sockets, numbers of poses, joints, lengths and observations."
        )
    arrays = [(capture.q, capture.lengths, capture.observations) for capture in captures]
    return eqx.tree_at(
        lambda c: (c.q, c.lengths, c.observations),
        captures[0],
        jax.tree.map(lambda *leaves: np.stack(leaves) if is_concrete(*leaves) else jnp.stack(leaves), *arrays),
    )


def _form(observations: tuple[AbstractObservation, ...]) -> tuple[Any, ...]:
    """What observations must share to be stacked."""
    leaves, structure = jax.tree.flatten(observations)
    return structure, tuple(leaf.shape for leaf in leaves)
