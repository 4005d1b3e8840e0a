"""Sockets in which the seat shifted between two poses: found in the recorded order, and divided there.

A change point is judged twice. Among everything else that may be wrong, a displacement that begins amid a socket must
be a cause that the selection of `diagnostics.culprits` names, which it does for one sound capture of 500 (`SURE`, over
all poses at which something may have changed). And that the tip rests elsewhere in this socket alone must explain
nearly as much: what moved everything else as well, a base between two certified sockets, is no matter of a socket.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from ..calibration.record import CalibrationRecord, Removed
from ..core.errors import InputError
from ..data.capture import Capture, visits_of
from ..data.capture_data import ReferenceLength
from ..data.observations.held import Socket
from ..diagnostics.contradictions import SEAT, with_removed
from ..diagnostics.culprits import culprits_of
from ..diagnostics.findings import Case, case_of
from ..diagnostics.hypotheses import shifted_seats
from ..diagnostics.missing_terms import columns_of
from ..diagnostics.residual_tests import Candidates, ScoreTest
from .automatic import Record, Solve

Masks = Mapping[str, np.ndarray]  # observation -> which of its poses are held out
_DISPLACED = ("shifted seat", "moved base")  # causes that a division describes, where they begin amid a socket
_AS_WELL = 0.8  # of the gain of such a cause, that the division must have
_PART = 0.1  # of the excess of the residuals that it explains: smaller ones are as well errors that the model lacks
_MOST = 6


class Division(NamedTuple):
    """A socket that is divided."""

    socket: str
    later: str  # name of the socket that its later poses are
    first: int  # the first of these
    joined: frozenset[tuple[str, str]]  # both ends of the reference lengths that end in the later part


def with_divided_sockets(
    record: CalibrationRecord, solve: Solve, recorded: Record
) -> tuple[CalibrationRecord, tuple[Division, ...]]:
    """The calibration with each socket divided at a shift of its seat, and how; as it is where there is none."""
    divisions: list[Division] = []
    while len(divisions) < _MOST and (shift := _shift(case_of(record))) is not None:
        socket, first, test, probability = shift
        division = _division(record, socket, first)
        part = record.recording._replace(capture=divided(record.recording.capture, [division]))
        try:
            again = recorded(solve(part), part)
        except InputError:
            break
        if not again.converged or not again.observed.rms < record.observed.rms:
            break
        removed = Removed(
            kind=SEAT,
            group=f"{socket} from pose {first + 1} on by {np.linalg.norm(test.coefficients):.2g} mm",
            members=(socket, division.later),
            ratio=test.ratio,
            degrees_of_freedom=test.degrees_of_freedom,
            probability=probability,
            rms_with=record.observed.rms,
        )
        record = with_removed(record, again, [removed])._replace(decisions=record.decisions)
        divisions.append(division)
    return record, tuple(divisions)


def _shift(case: Case) -> tuple[str, int, ScoreTest, float] | None:
    """The socket whose seat shifted, the first pose afterwards, its test and its probability by chance."""
    capture = case.record.recording.capture
    ends = np.cumsum([0, *(part.q.shape[0] for part in capture.parts)])
    for culprit in culprits_of(case):
        term = None if culprit.term is None else culprit.term.term
        if term is None or term.kind not in _DISPLACED or culprit.explains < _PART:
            continue
        number = int(np.searchsorted(ends, term.first, side="right")) - 1
        part, rows = capture.parts[number], case.chunks[0]
        spanned = term.kind == "moved base" and _spans(capture, part.name)
        near = shifted_seats(capture, term) if isinstance(part, Socket) and not spanned else []
        if not near:
            continue
        columns = [_padded(case, columns) for columns in columns_of([term, *near], rows)]
        of_term, *tests = Candidates.of(case.left, columns).tests(case.left)
        best = int(np.argmax([test.gain for test in tests]))
        if tests[best].gain >= _AS_WELL * of_term.gain:
            return part.name, near[best].first - int(ends[number]), tests[best], culprit.probability
    return None


def _spans(capture: Capture, socket: str) -> bool:
    """Whether a reference length joins sockets that were recorded before and after this one: a base that moved in
    between changed it, and an artefact that did not."""
    order = [part.name for part in capture.parts]
    ends = [sorted((order.index(length.start), order.index(length.end))) for length in capture.lengths]
    return any(first < order.index(socket) < last for first, last in ends)


def _padded(case: Case, columns: np.ndarray) -> np.ndarray:
    """With the rows of the relations, of which such columns say nothing."""
    return np.pad(columns, ((0, len(case.left.values) - len(columns)), (0, 0)))


def _division(record: CalibrationRecord, socket: str, first: int) -> Division:
    """Each reference length ends in the part where the arm measures it closer to its certified value."""
    capture, arm = record.recording.capture, record.calibrated.arm
    tips = {part.name: np.asarray(arm.position(part.q)) for part in capture.parts}
    parts, joined = (tips[socket][:first].mean(axis=0), tips[socket][first:].mean(axis=0)), set()
    for length in capture.lengths:
        if socket in (length.start, length.end):
            other = tips[length.end if length.start == socket else length.start].mean(axis=0)
            errors = [abs(np.linalg.norm(part - other) - float(length.value)) for part in parts]
            joined |= {(length.start, length.end)} if errors[1] < errors[0] else set()
    return Division(socket, f"{socket} (from pose {first + 1})", first, frozenset(joined))


def divided(capture: Capture, divisions: Iterable[Division]) -> Capture:
    """A capture with each of these sockets as two."""
    for socket, later, first, joined in divisions:
        visits, lengths = visits_of(capture), list(capture.lengths)
        parts, seats = [], len(capture.names)
        for number, part in enumerate(capture.parts):
            pair = [part]
            if part.name == socket:
                rows = np.arange(part.q.shape[0])
                pair = [part.select(rows[:first]), part.select(rows[first:]).changed(name=later)]
                if socket in visits:
                    visits |= {socket: visits[socket][:first], later: visits[socket][first:]}
            parts += [(number < seats, one) for one in pair]
        for number, length in enumerate(lengths):
            if (length.start, length.end) in joined:
                start, end = (later if name == socket else name for name in (length.start, length.end))
                lengths[number] = ReferenceLength(start, end, length.value, length.u)
        sockets = {part.name: part.q for seat, part in parts if seat}
        others = [part for seat, part in parts if not seat]
        capture = Capture(sockets, lengths, others, capture.repeated, capture.sessions, visits)
    return capture


def divided_alike(capture: Capture, masks: Masks, divisions: Iterable[Division]) -> tuple[Capture, Masks]:
    """The capture with the held-out poses that ``masks`` names, and these, divided as the rest was: where poses are
    held out between the last pose before a shift and the first after it, in the middle of these."""
    masks = dict(masks)
    for division in divisions:
        mask = masks[division.socket]
        kept = np.flatnonzero(~mask)
        first = int(kept[division.first - 1] + kept[division.first] + 1) // 2
        capture = divided(capture, [division._replace(first=first)])
        masks |= {division.socket: mask[:first], division.later: mask[first:]}
    return capture, masks
