"""A part of a capture's poses drawn at random, to calibrate with, and the others, to test the result on."""

from ..core.errors import InputError
from ..core.random_keys import random_generator
from .capture import Capture, check_one_capture
from .visits import visits_of


def draw_poses(capture: Capture, count: int, seed: int = 0) -> tuple[Capture, Capture]:
    """Divide the poses of a capture at random.

    Args:
        capture: The capture.
        count: How many poses to draw, of sockets and other observations alike.
        seed: Of the random numbers.

    Returns:
        A capture of the drawn poses, and one of the others; each with the reference lengths whose two sockets it has.

    Raises:
        InputError: The capture is a batch, or has not more poses than these.
    """
    check_one_capture(capture)
    sizes = [*capture.sizes, *(observation.q.shape[0] for observation in capture.observations)]
    total = sum(sizes)
    if not 0 < count < total:
        raise InputError(f"{count} of {total} poses cannot be drawn; give a number from 1 to {total - 1}.")
    drawn = set(random_generator(seed).choice(total, count, replace=False).tolist())
    halves = []
    for wanted in (True, False):
        first, rows = 0, []
        for size in sizes:
            rows.append([i for i in range(size) if (first + i in drawn) is wanted])
            first += size
        of_sockets = zip(capture.sockets.items(), rows, strict=False)
        sockets = {name: q[chosen] for (name, q), chosen in of_sockets if chosen}
        of_others = zip(capture.observations, rows[len(capture.names) :], strict=True)
        others = [observation.select(chosen) for observation, chosen in of_others if chosen]
        known = {*sockets, *(observation.name for observation in others)}
        lengths = [length for length in capture.lengths if {length.start, length.end} <= known]
        known_visits = visits_of(capture)
        visits = {
            name: known_visits[name][chosen]
            for name, chosen in zip(capture.names, rows, strict=False)
            if chosen and name in known_visits
        }
        halves.append(Capture(sockets, lengths, others, sessions=capture.sessions, visits=visits))
    return halves[0], halves[1]
