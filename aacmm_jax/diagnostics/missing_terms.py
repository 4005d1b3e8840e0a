"""What a calibration's model may lack: known functions of the readings and of the order of the poses.

Of joint i, the model's angle is its reading and a zero. What it lacks is a further function phi of the readings, whose
column is that of theta_i times phi: those of `kinematics.corrections` (harmonics of an eccentric, tilted or oval
encoder, a wrong gear ratio, the moment of gravity about the axis where the joint or the link behind it bends), and a
zero that drifts from pose to pose. A base that moves and an arm that grows, meanwhile or with its temperature, move the
tip itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..core.text import shorten
from ..core.units import ARCSEC
from ..kinematics.arm import DOWN, Arm
from ..kinematics.chain import forward_pass, joint_motion
from ..kinematics.corrected_arm import function_values
from ..kinematics.correction_kinds import Term
from ..kinematics.corrections import all_sought, model_of, model_with, terms_of
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS
from .equations import Block, Rows, wider
from .findings import Case, Finding, by_equations, chance_text, rounded
from .residual_tests import LEVEL, Residuals, ScoreTest, score_tests

ORDER, NEEDS = 60, "fit"
MOST_TERMS = 6  # that are looked for one after the other
_AS_WELL = 6.0  # difference of the information criterion (Akaike 1974) below which another term explains as much
# Part of the residuals. A step of a joint, 1 mrad, turns the residuals themselves by 1e-3 of their size, and so does
# the frame of a station that imitates it: in what is left of its column after the frame, linear equations are wrong.
_SECOND_ORDER = 3e-3
# Terms that no kind of joint correction has: what residuals follow, of joint {i}, and what causes that.
_OTHERS: dict[str, tuple[str, str]] = {
    "zero": ("a zero offset of joint {i}, which is fixed", "a wrong zero offset"),
    "drifting zero": ("a drift of joint {i} from pose to pose", "a zero offset that drifts"),
    "drifting base": ("a drift of the tip from pose to pose", "a base or socket that moves"),
    "growing arm": ("a growth of the arm from pose to pose", "an arm that warms or cools"),
}


class MissingTerm(NamedTuple):
    """A term that the model may lack: of one joint, in mrad, or of the tip, in mm."""

    kind: str  # "zero", "drifting zero", "drifting base", "growing arm", or what a kind of correction is sought by
    joint: int | None  # from 1; None: of the tip
    values: Float[np.ndarray, "N _k"] | Float[np.ndarray, "N 3 _k"]  # pose by pose, for coefficients of 1
    relative: bool = False  # whether its size is that of the coefficient


class FoundTerm(NamedTuple):
    """A term that explains residuals, and what explains them as well."""

    kind: str
    joint: int | None
    test: ScoreTest
    probability: float  # Holm's: of all candidates
    amplitude: float  # half the range of what the term adds over the poses, rad or mm; of a gear ratio, relative
    alternatives: tuple[tuple[str, int | None], ...]
    term: MissingTerm


def test(case: Case) -> list[Finding]:
    """Terms that the model lacks, in one finding: each explains what those before it leave."""
    terms = case.once(missing)
    if not terms:
        return []
    sought, texts, causes = all_sought(), [], []
    words = {name: (kind.follows, kind.cause) for name, (_, kind) in sought.items()} | _OTHERS
    for term in terms:
        if term.term.relative and term.kind != "zero":
            amplitude = f"{rounded(100 * term.amplitude)} %"
        else:
            unit, size = ("mm", 1.0) if term.joint is None else ("arcsec", ARCSEC)
            amplitude = f"{rounded(term.amplitude / size)} {unit}"
        follows, cause = words[term.kind]
        texts.append(f"{follows.format(i=term.joint)} ({amplitude})")
        causes.append(cause)
    named = {(term.kind, term.joint) for term in terms}
    others = dict.fromkeys(other for term in terms for other in term.alternatives if other not in named)
    likely = [words[kind][0].format(i=joint) for kind, joint in others]
    model = wider_model(terms, case.record.calibrated.arm)
    probability = max(term.probability for term in terms)
    shared = set() if case.record.shared is None else set(case.record.shared.kinds)
    return [
        Finding(
            "missing-terms",
            f"Residuals follow {shorten(texts, 3)} ({chance_text(probability)}), which the model does not describe. "
            f"Possible causes: {', '.join(dict.fromkeys(causes))}{f'; try --model {model}' if model else ''}."
            + (f" Equally likely: {shorten(likely, 3)}." if likely else ""),
            "The stated uncertainties include these errors as estimated from the residuals."
            if shared - {PLACES, VISITS, SUCCESSIVE}
            else "Every stated uncertainty is too small.",
            severity="doubt",
            probability=probability,
            concerns=tuple(dict.fromkeys("tip" if t.joint is None else f"joint {t.joint}" for t in terms)),
        )
    ]


@by_equations
def missing(case: Case) -> tuple[FoundTerm, ...]:
    """The terms that the model of a calibration lacks."""
    if not case.scatters:
        return ()
    return found_terms(case.record.calibrated.arm, np.asarray(case.record.recording.capture.readings), *case.chunks)


@by_equations
def explained(case: Case) -> tuple[list[Rows], list[Block]]:
    """The equations of a calibration, with these terms as further unknowns."""
    (rows, relations), terms = case.chunks, case.once(missing)
    if not terms:
        return rows, relations
    columns = np.concatenate(columns_of([term.term for term in terms], rows), axis=1)
    parts = np.split(columns, np.cumsum([part.residual.size for part in rows])[:-1])
    extended = [
        part._replace(shared=np.concatenate([part.shared, added.reshape(*part.residual.shape, -1)], axis=2))
        for part, added in zip(rows, parts, strict=True)
    ]
    return extended, wider(relations, columns.shape[1])


def wider_model(terms: Sequence[FoundTerm], arm: Arm | None) -> str:
    """The model that the arm has, with the terms that were found besides; empty where that is no other model."""
    functions = () if arm is None or arm.corrections is None else arm.corrections.functions.terms
    present = [term for term in functions if isinstance(term, Term)]
    sought, added = all_sought(), []
    joints = max(1 if arm is None else arm.joints, *(term.joint or 1 for term in terms))
    for kind, default in (sought[term.kind] for term in terms if term.kind in sought):
        # All of its default functions where the model has none yet, as a first harmonic is seldom alone.
        option = default.option if any(term.kind.model == kind.model for term in present) else ""
        added += kind.terms(joints, option, None)
    wider = model_of([*present, *added]) if added else ""
    return "" if present and wider == model_of(present) else wider


def columns_of(terms: Sequence[MissingTerm], rows: Sequence[Rows]) -> list[Float[np.ndarray, "R _"]]:
    """The columns of each term in the rows of all poses."""
    columns = []
    for term in terms:
        blocks = []
        for part in rows:
            values = term.values[part.poses]
            moved = part.by_tip @ values if term.joint is None else part.extra[..., [term.joint - 1]] * values[:, None]
            blocks.append(moved.reshape(part.residual.size, -1))
        columns.append(np.concatenate(blocks))
    return columns


def missing_terms(arm: Arm, q: Float[np.ndarray, "N n"]) -> list[MissingTerm]:
    """Everything that is looked for. Masses are not known, so each link that bends a joint has its own coefficient.

    ``q`` are all readings in their order, rad; with a thermometer, the temperature last, C.
    """
    arm = to_numpy(arm)
    order = np.linspace(-1.0, 1.0, len(q))[:, None]
    tip = np.moveaxis(np.asarray(forward_pass(arm.geometry, joint_motion(arm.geometry, q)).tip), -1, 0)[:, :, None]
    of_joints, of_tip = (
        [],
        [
            MissingTerm("drifting base", None, order[:, :, None] * np.eye(3)),
            MissingTerm("growing arm", None, order[:, :, None] * tip / 1e3),  # by 1 mm a m
        ],
    )
    for joint in range(1, arm.joints + 1):
        of_joints.append(MissingTerm("zero", joint, np.ones_like(order), relative=True))
        of_joints.append(MissingTerm("drifting zero", joint, order))
    nominal = arm.geometry if arm.corrections is None else arm.corrections.nominal
    gravity = np.asarray(DOWN if arm.gravity is None else arm.gravity)
    for name, (kind, sought) in all_sought().items():
        terms = terms_of(model_with(kind, sought.option), arm.joints)
        values = function_values(nominal, terms, q, gravity)
        if kind.of_arm:
            growth = [row for row, term in zip(values, terms, strict=True) if not term.joint and np.ptp(row) > 0]
            of_tip += [MissingTerm(name, None, row[:, None, None] * tip / 1e3) for row in growth]
        for joint in sorted({term.joint for term in terms if term.joint}):
            # A scale has no revolution to repeat, and carries what it moves.
            if joint not in arm.prismatic or sought.of_slides:
                of_joint = values[[term.joint == joint for term in terms]].T
                of_joints.append(MissingTerm(name, joint, of_joint, sought.relative))
    return [*of_joints, *of_tip]


def found_terms(
    arm: Arm, q: Float[np.ndarray, "N n"], rows: Sequence[Rows], relations: Sequence[Block]
) -> tuple[FoundTerm, ...]:
    """Terms that the model of a calibrated arm lacks, the one that explains most first; ``q`` are all readings in their
    order, ``rows`` the equations of the poses, and ``relations`` those of lengths, certified values and priors."""
    left = Residuals.of([*(part.block("") for part in rows), *relations])
    candidates, others_rows = missing_terms(arm, q), sum(len(block.residual) for block in relations)
    columns = [np.pad(values, ((0, others_rows), (0, 0))) for values in columns_of(candidates, rows)]
    chosen: list[tuple[int, ScoreTest, float, list[int]]] = []
    rest, least = left, _SECOND_ORDER * float(np.sqrt(left.cost))
    for _ in range(MOST_TERMS):
        tests = score_tests(rest, columns, least)
        number = sum(test.degrees_of_freedom[0] > 0 for test in tests)
        significant = [i for i, test in enumerate(tests) if test.probability * number < LEVEL]
        if not significant:
            break
        criterion = {}  # Akaike's, less what is common to all
        for i in significant:
            remaining = max(rest.cost - tests[i].gain, 1e-300) / rest.cost
            criterion[i] = len(rest.values) * float(np.log(remaining)) + 2 * tests[i].degrees_of_freedom[0]
        best, *others = sorted(significant, key=criterion.__getitem__)
        others = [i for i in others if criterion[i] < criterion[best] + _AS_WELL]
        chosen.append((best, tests[best], min(tests[best].probability * number, 1.0), others))
        rest = rest.extended(columns[best])
    if not chosen:
        return ()
    (together,) = score_tests(left, [np.concatenate([columns[i] for i, *_ in chosen], axis=1)], least)
    coefficients = np.split(together.coefficients, np.cumsum([columns[i].shape[1] for i, *_ in chosen])[:-1])
    terms = []
    for (i, test, probability, others), coefficient in zip(chosen, coefficients, strict=True):
        term = candidates[i]
        added = (term.values @ coefficient).reshape(len(q), -1)
        size = abs(coefficient[0]) if term.relative else np.linalg.norm(np.ptp(added, axis=0)) / 2
        amplitude = float(size) * (1.0 if term.joint is None else 1e-3)
        alternatives = tuple((candidates[j].kind, candidates[j].joint) for j in others)
        terms.append(FoundTerm(term.kind, term.joint, test, probability, amplitude, alternatives, term))
    return tuple(terms)
