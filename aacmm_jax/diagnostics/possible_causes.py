"""All causes among which `culprits` selects: functions and steps, fixed parameters, certified values, and variances."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.distributions import student_tail
from ..model.observed import Observed
from .equations import PRIOR, Rows, lengths_in_solve
from .findings import Case
from .hypotheses import couplings, fixed_parameters, shifted_seats, steps
from .missing_terms import MissingTerm, missing_terms
from .residual_tests import LEVEL, orthonormal

_FEWEST = 6  # poses of a socket or observation whose scatter is compared with that of the others
_MOST_GROUPS = 60
_SEVERAL = 4  # lengths, from which they are compared with each other
_FAR = 10.0  # residual of a length over the scatter of the others, from which it stands out in any case
_APART = 0.01  # part of a fixed parameter's effect that no free one has, below which it is redundant
_MEASURED = {"rad": "orientations", "px": "pixels"}
_SMALL = 1e-9  # part of a residual that the model leaves, below which nothing is left


class Cause(NamedTuple):
    """What may be wrong: columns of a term, a pose or a certified value, or a variance."""

    kind: str
    family: str
    name: str
    term: MissingTerm | None = None
    row: int = -1  # of the relations
    of_noise: Callable[[Rows], np.ndarray] | None = None  # (m, r, c): errors that scatter along these
    named: bool = True  # whether it is named; a cause that is not still counts among the explanations of other effects


def of_functions(case: Case) -> list[Cause]:
    """Causes that are functions of the readings, and of the order of the poses."""
    arm, capture = case.record.calibrated.arm, case.record.recording.capture
    q = np.asarray(capture.readings)
    functions = missing_terms(arm, q)
    gravity = [term for term in functions if term.kind == "gravity"]
    families = {
        "function": functions,
        "step": steps(arm, capture, gravity),
        "seat": shifted_seats(capture),
        "coupling": couplings(arm, q),
    }
    return [Cause("term", family, term.concerns, term) for family, terms in families.items() for term in terms]


def of_parameters(case: Case) -> list[Cause]:
    """Parameters that are no unknowns: those that are fixed, and the scale anchor."""
    free = [name for name in case.record.names if name != case.equations.anchor]
    joints, poses = case.record.calibrated.arm.joints, len(np.asarray(case.record.recording.capture.readings))
    if len(case.record.scale_set_by) == 1:  # without it the arm could shrink
        free += case.record.scale_set_by
    terms = fixed_parameters(case.equations.extra, free, joints, poses)
    apart = _apart_from_free(case.equations.rows)
    return [Cause("fixed", "fixed", term.concerns, term) for term in terms if apart[term.column] > _APART]


def _apart_from_free(rows: Sequence[Rows]) -> Float[np.ndarray, " e"]:
    """Part of the effect of each of `Rows.extra` on the poses that free parameters and geometry cannot have, 0 to 1.

    A fixed parameter without such a part is redundant: what speaks for another value of it is the prior of the others.
    """
    stacked = []
    for part in rows:
        flat = [columns.reshape(part.residual.size, -1) for columns in (part.private, part.shared, part.extra)]
        basis = np.linalg.qr(flat[0])[0]
        stacked.append([columns - basis @ (basis.T @ columns) for columns in flat[1:]])
    shared, extra = (np.concatenate(columns) for columns in zip(*stacked, strict=True))
    basis = orthonormal(shared)
    left = np.linalg.norm(extra - basis @ (basis.T @ extra), axis=0)
    return left / np.maximum(np.linalg.norm(extra, axis=0), 1e-300)


def of_certified(case: Case) -> list[Cause]:
    """Certified values, and lengths that took part in the least squares."""
    capture = case.record.recording.capture
    lengths = capture.lengths if lengths_in_solve(case.record) else ()
    names = [f"{length.start} - {length.end}" for length in lengths]
    points = {f"coordinates of {getattr(o, 'artefact', '')}": getattr(o, "names", ()) for o in capture.observations}
    for part, (value, _) in Observed.of(capture, None).certified().items():
        labels, size = points.get(part, ()), np.asarray(value).size
        whole = [part.partition(" of ")[2] or part] * size
        names += [label for label in labels for _ in range(3)] if 3 * len(labels) == size else whole
    residuals = [block.residual for block in case.chunks[1] if block.fixture != PRIOR]
    if len(names) != sum(map(len, residuals)):
        return []
    causes = [Cause("certified", "certified", name, row=row) for row, name in enumerate(names)]
    if len(lengths) < _SEVERAL:
        return causes
    # Where all lengths scatter more than their certificates, as errors of places make them do, one is wrong only if it
    # stands out: its squared studentised residual, over the mean square of the others without it.
    first, number = len(case.left.values) - sum(len(block.residual) for block in case.chunks[1]), len(lengths)
    rows = slice(first, first + number)
    projector = np.eye(number) - case.left.basis[rows] @ case.left.basis[rows].T
    deleted = projector / np.maximum(np.diag(projector), _SMALL)  # what deleting each one changes
    squares = case.left.values[rows] ** 2 / np.maximum(np.diag(projector), _SMALL)
    others = np.sum((case.left.values[rows][:, None] - deleted * case.left.values[rows]) ** 2, axis=0)
    freedom = np.maximum(np.trace(projector) - np.sum(deleted * projector, axis=0), 1.0)
    ratios = np.sqrt(squares / np.maximum(others / freedom, 1.0))
    # Few degrees of freedom leave the scatter of the others open, but not by a power of ten.
    stands_out = (number * student_tail(ratios, freedom) < LEVEL) | (ratios > _FAR)
    return [cause._replace(named=cause.row >= number or bool(stands_out[cause.row])) for cause in causes]


def of_variances(case: Case, rows: Sequence[Rows]) -> list[Cause]:
    """One encoder, or one socket or observation, that is noisier; the seat, beside the encoders; and what was measured
    in rad or px, beside what was measured in mm."""

    def of_joint(joint: int) -> Callable[[Rows], np.ndarray]:
        return lambda part: part.extra[..., [joint]]

    def of_group(name: str) -> Callable[[Rows], np.ndarray]:
        return lambda part: np.broadcast_to(
            np.eye(part.residual.shape[1]) * (part.name == name), (*part.residual.shape, part.residual.shape[1])
        )

    def of_unit(name: str, among: np.ndarray) -> Callable[[Rows], np.ndarray]:
        return lambda part: part.measured * among if part.name == name else 0.0 * part.measured

    if not case.shows_noise:
        return []
    joints = case.record.calibrated.arm.joints
    causes = [Cause("noisy joint", "noise", f"joint {j + 1}", of_noise=of_joint(j)) for j in range(joints)]
    causes.append(Cause("tip", "noise", "tip", of_noise=lambda part: part.by_tip))
    for observation in case.record.recording.capture.observations:
        others = np.array(observation.row_units) != "mm"
        if 0 < others.sum() < len(others):
            name = f"{_MEASURED[observation.row_units[-1]]} of {observation.name}"
            causes.append(Cause("stated u", "noise", name, of_noise=of_unit(observation.name, others)))
    poses: dict[str, int] = {}
    for part in rows:
        poses[part.name] = poses.get(part.name, 0) + len(part.poses)
    groups = [name for name, count in poses.items() if count >= _FEWEST]
    if 1 < len(groups) <= _MOST_GROUPS:
        causes += [Cause("scatter", "noise", name, of_noise=of_group(name)) for name in groups]
    return causes
