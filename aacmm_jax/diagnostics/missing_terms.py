"""What a calibration's model may lack: known functions of the readings and of the order of the poses.

Of joint i, the model's angle is its reading and a zero. What it lacks is a further function phi of the readings, whose
column is that of theta_i times phi: those of `kinematics.corrections` (harmonics of an eccentric, tilted or oval
encoder, a wrong gear ratio, the moment of gravity about the axis where the joint or the link behind it bends), and a
zero that drifts from pose to pose, evenly or until it has settled. A base that moves and an arm that grows, meanwhile
or with its temperature, move the tip itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm
from ..kinematics.chain import forward_pass, joint_motion
from ..kinematics.corrected_arm import function_values
from ..kinematics.correction_kinds import Term
from ..kinematics.corrections import KINDS, all_sought, model_of, model_with, terms_of
from .equations import Rows
from .residual_tests import ScoreTest

# Terms that no kind of joint correction has: what residuals follow, of joint {i}, and what causes that.
_WORDS: dict[str, tuple[str, str]] = {
    "zero": ("a zero offset of joint {i}, which is fixed", "a wrong zero offset"),
    "drifting zero": ("a drift of joint {i} from pose to pose", "a zero offset that drifts"),
    "drifting base": ("a drift of the tip from pose to pose", "a base or socket that moves"),
    "growing arm": ("a growth of the arm from pose to pose", "an arm that warms or cools"),
}
# An arm that was just switched on warms up, and what it does dies away: after these parts of the capture, to 1 / e.
_SETTLED = (0.03, 0.1, 0.3)
_WARMS_UP = "arm, base or instrument that were still warming up"


class MissingTerm(NamedTuple):
    """A term that the model may lack: of one joint, in mrad, or of the tip, in mm."""

    kind: str  # "zero", "drifting zero", "drifting base", "growing arm", or what a kind of correction is sought by
    joint: int | None  # from 1; None: of the tip
    values: Float[np.ndarray, "N _k"] | Float[np.ndarray, "N 3 _k"]  # pose by pose, for coefficients of 1
    relative: bool = False  # whether its size is that of the coefficient
    follows: str = ""  # what residuals follow then, in words
    cause: str = ""  # what causes that
    concerns: str = "tip"  # the joint, socket or observation
    column: int | None = None  # of `Rows.extra`, where that is not the joint's
    first: int = -1  # pose from which on it applies, of a step
    correction: tuple[str, str] | None = None  # model and option of the joint correction that describes it
    rather: str = ""  # kind of the joint's term that is taken instead where it explains as much

    @property
    def source(self) -> int | None:
        """The column of `Rows.extra` by which it moves the rows; None: it moves the tip."""
        return self.joint - 1 if self.column is None and self.joint is not None else self.column


class FoundTerm(NamedTuple):
    """A term that explains residuals, and what explains them as well."""

    kind: str
    joint: int | None
    test: ScoreTest
    probability: float  # Bonferroni's: of all candidates of its family
    amplitude: float  # half the range of what the term adds over the poses, rad or mm; of a gear ratio, relative
    others: tuple[MissingTerm, ...]
    term: MissingTerm

    @property
    def alternatives(self) -> tuple[tuple[str, int | None], ...]:
        """What explains as much, by kind and joint."""
        return tuple((term.kind, term.joint) for term in self.others)


def wider_model(terms: Sequence[FoundTerm], arm: Arm | None) -> str:
    """The model that the arm has, with the terms that were found besides; empty where that is no other model."""
    functions = () if arm is None or arm.corrections is None else arm.corrections.functions.terms
    present = [term for term in functions if isinstance(term, Term)]
    sought, added = all_sought(), []
    joints = max(1 if arm is None else arm.joints, *(term.joint or 1 for term in terms))
    for term in terms:
        if term.term.correction is not None:
            model, option = term.term.correction
            added += KINDS[model].terms(joints, option, None)
        if term.kind not in sought:
            continue
        kind, default = sought[term.kind]
        # All of its default functions where the model has none yet, as a first harmonic is seldom alone.
        alone, usual = kind.terms(joints, default.option, None), kind.terms(joints, "", None)
        in_usual = {*alone} <= {*usual} and not any(other.kind.model == kind.model for other in present)
        added += usual if in_usual else alone
    wider = model_of([*present, *added]) if added else ""
    return "" if present and wider == model_of(present) else wider


def columns_of(terms: Sequence[MissingTerm], rows: Sequence[Rows], further: int = 0) -> list[Float[np.ndarray, "R _"]]:
    """The columns of each term in the rows of all poses, and zeros in ``further`` ones after these."""
    if not terms:
        return []
    widths = [term.values.shape[-1] for term in terms]
    of_tip = np.repeat([term.source is None for term in terms], widths)
    sources = np.repeat([term.source or 0 for term in terms], widths)[~of_tip]
    size = sum(part.residual.size for part in rows)
    columns = np.zeros((size + further, sum(widths)))
    for mask, by_tip in ((of_tip, True), (~of_tip, False)):
        chosen = [term.values for term in terms if (term.source is None) == by_tip]
        if not chosen:
            continue
        values, blocks = np.concatenate(chosen, axis=-1), []
        for part in rows:
            at = values[part.poses]
            moved = part.by_tip @ at if by_tip else part.extra[..., sources] * at[:, None]
            blocks.append(moved.reshape(part.residual.size, -1))
        columns[:size, mask] = np.concatenate(blocks)
    return np.split(columns, np.cumsum(widths)[:-1], axis=1)


def missing_terms(arm: Arm, q: Float[np.ndarray, "N n"]) -> list[MissingTerm]:
    """Everything that is looked for. Masses are not known, so each link that bends a joint has its own coefficient.

    ``q`` are all readings in their order, rad, with what was recorded beside them.
    """
    arm = to_numpy(arm)
    order = np.linspace(-1.0, 1.0, len(q))[:, None]
    tip = np.moveaxis(np.asarray(forward_pass(arm.geometry, joint_motion(arm.geometry, q)).tip), -1, 0)[:, :, None]

    def named(kind: str, joint: int | None, values: np.ndarray, relative: bool = False) -> MissingTerm:
        follows, cause = words[kind]
        concerns = "tip" if joint is None else f"joint {joint}"
        return MissingTerm(kind, joint, values, relative, follows.format(i=joint), cause, concerns)

    words = {name: (sought.follows, sought.cause) for name, (_, sought) in all_sought().items()} | _WORDS
    of_joints, of_tip = [], []
    for settles in (0.0, *_SETTLED):
        time = np.exp(-(order + 1) / (2 * settles)) if settles else order
        drifts = [
            named("drifting base", None, time[:, :, None] * np.eye(3)),
            named("growing arm", None, time[:, :, None] * tip / 1e3),  # by 1 mm a m
        ]
        of_tip += [_settling(term) for term in drifts] if settles else drifts
        drifts = [named("drifting zero", joint, time) for joint in range(1, arm.joints + 1)]
        of_joints += [_settling(term) for term in drifts] if settles else drifts
    of_joints += [named("zero", joint, np.ones_like(order), relative=True) for joint in range(1, arm.joints + 1)]
    for name, (kind, sought) in all_sought().items():
        terms = terms_of(model_with(kind, sought.option), arm.joints)
        if not {kind.column_of(term) for term in terms} - {""} <= {*arm.beside.names(q.shape[1])}:
            continue
        values = function_values(arm, terms, q)
        if kind.of_arm:
            growth = [row for row, term in zip(values, terms, strict=True) if not term.joint and np.ptp(row) > 0]
            of_tip += [named(name, None, row[:, None, None] * tip / 1e3) for row in growth]
        for joint in sorted({term.joint for term in terms if term.joint}):
            # A scale has no revolution to repeat, and carries what it moves.
            if joint not in arm.prismatic or sought.of_slides:
                of_joint = values[[term.joint == joint for term in terms]].T
                of_joints.append(named(name, joint, of_joint, sought.relative)._replace(rather=sought.rather))
                if kind.rows == 3 and of_joint.shape[1] > 1:  # of equal weights: one coefficient, as their side has
                    of_joints.append(named(name, joint, of_joint.sum(axis=1, keepdims=True)))
    return [*of_joints, *of_tip]


def _settling(drift: MissingTerm) -> MissingTerm:
    return drift._replace(follows=f"{drift.follows} that settles", cause=_WARMS_UP)
