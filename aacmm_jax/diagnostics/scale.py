"""What fixes the scale of a calibrated arm, whether k may be the scale of an arm, and whether reference lengths agree:
with each other, and with the arm that the poses determine."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration.record import REPEATABILITY, CalibrationRecord
from ..calibration.redrawn import covariance_of_lengths
from ..calibration.results import PLAUSIBLE_SCALE, plausible
from ..calibration.scale_anchor import scale_set_by_clause
from ..calibration.stages import ends_between, positions_at_ends
from ..core.distributions import chi_square_tail, f_tail
from ..core.numpy_or_jax import to_numpy
from ..core.text import shorten
from ..core.units import INCH, M
from ..model.observed import Observed
from ..uncertainty.shared_kinds import PLACES
from .arm_size import KEPT, size_of, u_of_size
from .culprits import culprits_of
from .equations import EXACT, LEAST_U, PRIOR, Block, Rows, lengths_in_solve, linearisation_of, scale_anchor_of
from .findings import Case, Finding, chance_text
from .residual_tests import LEVEL, consistency
from .usability import on_bounds

ORDER, NEEDS = 66, "nothing"
_SUSPICIOUS = 0.005  # of a fixed link: beyond it the nominal value or a reference length is wrong
# By k, which is a length measured by the nominal arm over its reference value: one in m, read as mm, makes k = 1000.
_MISTAKEN_UNITS = {
    M: "Are the reference lengths in m by mistake?",
    10.0: "Are the reference lengths in cm by mistake?",
    INCH: "Are the reference lengths in inches by mistake?",
    1 / M: "Is the arm in m, or are the reference lengths in um by mistake?",
    1 / 10.0: "Is the arm in cm by mistake?",
    1 / INCH: "Is the arm in inches by mistake?",
}
# A length is named where chi-square falls below a ninth without it, to what chance exceeds in over 5 % of cases.
_CLEAR, _AGREE = 9.0, 0.05
_FAR = 100.0  # or its gain is so many times the mean square of what is left without it
_SET_BY, _FAR_FROM_1 = "scale-set-by-fixed-lengths", "scale-far-from-1"
_MOST_U = 4.0  # standard uncertainties of k, beyond which what fixes the scale is wrong
_PULLED = 0.5  # standard uncertainties of the scale, from which the noise of the poses shifts it too much
_FEW = 2  # lengths, of which each may be the wrong one where they disagree


class Lengths(NamedTuple):
    """Reference lengths and certified values against each other, by the arm that the poses determine."""

    birge_ratio: float
    degrees_of_freedom: int
    probability: float
    number: int
    odd: str = ""  # the one without which the others agree
    difference: float = 0.0  # of that one from what the others say, mm
    names: tuple[str, ...] = ()  # of all of them
    by_u: float = 1.0  # the Birge ratio without shared errors
    smaller: float = 1.0  # probability of a smaller one


def test(case: Case) -> list[Finding]:
    """Lengths that disagree, at most one finding on the scale, and one where the arm could not be divided by k."""
    record = case.record
    fits = record.plausible_scale and not record.implausible_residual
    of_lengths, of_k = _of_lengths(case) if fits else None, _of_k(record)
    if fits and (of_k is None or of_k.code == _FAR_FROM_1):
        of_k = _of_size(record) or _of_weak_scale(case) or of_k
    if (
        of_lengths is not None
        and of_k is not None
        and of_k.code == _SET_BY
        and abs(record.k - 1) > _MOST_U * record.u_k
    ):
        # What is fixed is wrong, rather than all lengths that contradict it.
        of_k, of_lengths = of_k._replace(severity="doubt", doubt="fixed lengths contradict the reference lengths"), None
    findings = [finding for finding in (of_k, of_lengths) if finding is not None]
    if record.against_division and record.plausible_scale:
        findings.append(
            Finding(
                "not-divided",
                f"The division by k was not possible because of {shorten(record.against_division)}; poses and "
                "reference lengths were solved jointly instead.",
                concerns=tuple(record.against_division),
            )
        )
    return findings


def _of_k(record: CalibrationRecord) -> Finding | None:
    k, set_by = record.k, record.scale_set_by
    if record.method == REPEATABILITY and not set_by:
        by_lengths = f" According to the reference lengths, k = {k:.6f}." if math.isfinite(k) else ""
        return Finding(
            "nominal-scale",
            "The scale is taken from the nominal arm and assumed exact; all lengths carry its error." + by_lengths,
            severity="doubt",
            doubt="no measurement sets the scale",
        )
    if not math.isfinite(k):
        return None
    if not plausible(k):
        mistakes = (question for ratio, question in _MISTAKEN_UNITS.items() if abs(k / ratio - 1) < 0.1)
        low, high = PLAUSIBLE_SCALE
        return Finding(
            "implausible-scale",
            f"The scale factor k = {k:.6g} is not plausible (expected {low:g} to {high:g}).",
            advice=next(mistakes, "Check units, sockets, lengths and arm."),
            severity="unusable",
            doubt="the reference lengths give an implausible scale",
        )
    if set_by and record.method == "two-stage":
        return Finding(
            _SET_BY,
            f"{scale_set_by_clause(set_by)}, so the reference lengths had no effect: according to them, the arm is "
            f"{k:.6f} times too large (u = {record.u_k:.2g}).",
            advice="Free one of these lengths, or use the fixed and the reference lengths together (--method joint).",
            concerns=set_by,
        )
    sides = on_bounds(record)
    if record.hold is None and sides and not set_by:
        return Finding(
            "scale-stopped-by-bounds",
            f"In stage 1, every length was free, and the arm {'shrank' if k < 1 else 'grew'} (k = {k:.5f}) until "
            f"parameters reached their bounds: {shorten([f'{name} ({side})' for name, side in sides.items()])}. "
            "Stage 2 (scale fix) corrects the scale.",
            "The uncertainty of k is computed as if these parameters were exact.",
            "Hold a length (--hold) to avoid this.",
            concerns=tuple(sides),
        )
    if record.hold is not None and abs(k - 1) > max(_SUSPICIOUS, 3 * record.u_k):
        return Finding(
            _FAR_FROM_1,
            f"The scale factor k = {k:.5f} is far from 1.",
            advice=f"Is the nominal value of {record.hold} right, and is each reference length right?",
            concerns=(record.hold,),
        )
    return None


def _of_size(record: CalibrationRecord) -> Finding | None:
    """All lengths of the arm together too long or too short, as no maker leaves them."""
    size = size_of(record)
    if size is None or size.probability >= LEVEL or record.scale_set_by:
        return None
    capture = record.recording.capture
    names = [o.name for o in capture.observations if o.fixes_scale]
    lengths = [f"{length.start} - {length.end}" for length in capture.lengths]
    source = f"instrument or artefact ({shorten(names, 3)})" if names else f"lengths ({shorten(lengths, 3)})"
    return Finding(
        _FAR_FROM_1,
        f"All lengths of the calibrated arm are {100 * abs(size.factor):.2g} % (u = {100 * size.u:.1g} %) "
        f"{'longer' if size.factor > 0 else 'shorter'} than nominal, where a maker keeps {100 * KEPT:g} %: most likely "
        f"the scale of the {source} is wrong.",
        "Every length that the arm measures is wrong by as much, and U does not contain it.",
        "Check its unit, certificate and temperature, and the nominal lengths of the arm.",
        severity="doubt",
        doubt=f"the scale seems wrong by {100 * abs(size.factor):.2g} %",
        probability=size.probability,
        concerns=tuple(names or lengths),
    )


def _of_weak_scale(case: Case) -> Finding | None:
    """A scale by certified values that are so uncertain that the poses shrink the arm.

    Where the arm is smaller by s, so are the residuals of n degrees of freedom, and the cost, n / 2, falls by n s; with
    s^2 / (2 u^2) for the scale, the minimum is at s = n u^2.
    """
    record, freedom = case.record, float(case.left.degrees_of_freedom) if case.testable else 0.0
    observations = record.recording.capture.observations
    # Residuals in px do not fall where the arm is smaller.
    measured = any(o.fixes_scale and not (o.certified and o.lengths) for o in observations)
    if measured or record.divided or record.method == REPEATABILITY or record.prior is not None:
        return None
    u = u_of_size(record)
    if freedom * u < _PULLED:
        return None
    names = [o.name for o in observations if o.certified]
    return Finding(
        "weak-scale",
        f"The certified values determine the scale to {100 * u:.1g} % only. As the residuals of many poses are smaller "
        f"where the arm is, its lengths are too short by about {100 * freedom * u**2:.1g} %.",
        "U does not contain this.",
        "State smaller u if the certificate allows, or measure a longer reference length.",
        severity="doubt",
        doubt="the certified values determine the scale poorly",
        concerns=tuple(names),
    )


def _of_lengths(case: Case) -> Finding | None:
    lengths = case.once(lengths_of)
    named = any(culprit.kind == "certified" for culprit in culprits_of(case))
    if lengths is None or lengths.probability >= LEVEL or named:
        return None
    kinds = set() if case.record.shared is None else set(case.record.shared.kinds)
    odd = ""
    if lengths.odd:
        odd = f"; {lengths.odd} differs by {lengths.difference:+.3g} mm from the others, which agree with each other"
    likely = "Look for a wrong length, or for errors outside the D-H model."
    agree = not culprits_of(case)
    few = agree and len(lengths.names) <= _FEW
    if few and not odd:  # each of them may be the wrong one
        likely = f"The poses agree, so one of these lengths is most likely wrong: {' or '.join(lengths.names)}."
    predicted = "the poses, the stated u and the shared errors" if kinds and not odd else "the poses and the stated u"
    # Errors of places take the part of what u(k) had for lengths that disagree.
    enlarged = case.record.final_method == "two-stage" and PLACES not in kinds
    return Finding(
        "lengths-disagree",
        f"Reference lengths disagree with the arm: the errors of the {lengths.number} lengths are "
        f"{lengths.birge_ratio:.2g} times as large as {predicted} predict (Birge ratio, "
        f"{chance_text(lengths.probability)}){odd}.",
        "u(k) includes this disagreement." if enlarged else "",
        likely,
        severity="doubt",
        doubt=f"a reference length seems wrong: {lengths.odd or ' or '.join(lengths.names)}" if odd or few else "",
        probability=lengths.probability,
        concerns=(lengths.odd,) if lengths.odd else lengths.names if few else (),
        explains=1 - 1 / lengths.birge_ratio**2 if agree and (odd or few) else None,  # of the errors of the lengths
    )


class Related(NamedTuple):
    """Lengths and certified values, and the equations of the poses that say what they should be."""

    units: Float[np.ndarray, " l"]  # of their residuals, mm
    poses: list[Block]
    relations: Block
    covariance: Float[np.ndarray, "l l"]
    scale: tuple[Float[np.ndarray, " R"], Float[np.ndarray, " l"]] | None  # derivatives by the scale anchor


def lengths_of(case: Case) -> Lengths | None:
    """Lengths and certified values against the arm as the poses alone determine it, but for its scale; None where there
    are too few to contradict each other.

    Shared errors, where the calibration has found them, are part of what is expected, unless a single length
    is what all others contradict.
    """
    if not case.testable:
        return None
    record, (rows, relations), freedom = case.record, case.chunks, case.left.degrees_of_freedom
    capture = record.recording.capture
    afterwards = bool(capture.lengths) and not lengths_in_solve(record)
    related = lengths_of_sockets(record, rows) if afterwards else _of_observations(record, rows, relations)
    if related is None:
        return None
    names, covariance = [f"{length.start} - {length.end}" for length in capture.lengths], related.covariance
    if not afterwards:
        certified = Observed.of(capture, None).certified()
        names += [part for part, (value, _) in certified.items() for _ in np.asarray(value)]
    plain = _tested(record, related, covariance, freedom, names)
    if plain is None or plain.odd or record.shared is None or not capture.lengths:
        return plain
    # Errors of places that so few lengths have taught only say again that these disagree.
    if plain.number <= _FEW and set(record.shared.kinds) == {PLACES} and not culprits_of(case):
        return plain
    by_shared = covariance_of_lengths(record.shared, to_numpy(record.calibrated.arm), record.names, capture)
    number = len(by_shared)  # they come before certified values
    by_shared = by_shared / (related.units[:number, None] * related.units[:number])
    lengths = _tested(record, related, covariance + np.pad(by_shared, (0, len(names) - number)), freedom, names)
    return lengths and lengths._replace(by_u=plain.by_u, smaller=plain.smaller)


def _tested(
    record: CalibrationRecord, related: Related, covariance: Float[np.ndarray, "l l"], freedom: int, names: list[str]
) -> Lengths | None:
    tested = consistency(related.poses, related.relations, covariance, related.scale)
    number, square = tested.degrees_of_freedom, max(tested.square, 0.0)
    if number < 1:
        return None

    def probability(square: float, number: int) -> float:
        if record.given_noise is not None:
            return chi_square_tail(square, number)
        return f_tail(square / number, number, freedom)

    worst = int(np.argmax(tested.gains))
    rest = max(square - tested.gains[worst], 0.0)
    chance = probability(square, number)
    ratio = float(np.sqrt(square / number))
    lengths = Lengths(ratio, number, chance, len(names), names=tuple(names), by_u=ratio, smaller=1 - chance)
    agree = number > 1 and probability(rest, number - 1) > _AGREE and _CLEAR * rest < square
    if agree or (number > 1 and tested.gains[worst] > _FAR * max(rest / (number - 1), 1.0)):
        return lengths._replace(odd=names[worst], difference=float(tested.shifts[worst] * related.units[worst]))
    return lengths


def lengths_of_sockets(record: CalibrationRecord, rows: Sequence[Rows]) -> Related | None:
    """The positions of sockets are eliminated: a length has the scatter of its ends besides its own u."""
    capture, anchor = record.recording.capture, scale_anchor_of(record)
    kept, p = np.array([name != anchor for name in record.names]), len(record.names)
    linear = linearisation_of(record, record.names, noise=record.noise, lengths=False)
    influence, observed = linear.influence(), linear.observed
    ends = ends_between(observed, np.asarray(linear.with_fitted_geometry())[p:], influence.d_inverses, capture)
    error = np.asarray(ends.measured - ends.nominal)
    if np.max(np.abs(error)) < EXACT:
        return None
    # Positions follow the arm as the means of their tips do.
    followers = []
    for name in positions_at_ends(capture):
        class_index, component, first = observed.layout.component_of(int(observed.positions[name][0]))
        followers.append(-influence.follow[class_index][component, first : first + 3])
    slopes = np.einsum("lec,ech->lh", ends.by_positions, np.stack(followers))[:, :p]
    scale = None
    if anchor is not None:
        by_anchor = np.asarray(record.calibrated.arm.jacobian(capture.readings, (anchor,)))
        scale = np.concatenate([(p.by_tip @ by_anchor[p.poses]).ravel() for p in rows]), slopes[:, ~kept][:, 0]
    further = rows[0].shared.shape[2] - int(kept.sum())  # unknowns of sockets with very many poses
    relations = Block("", None, error, np.pad(slopes[:, kept], ((0, 0), (0, further))), np.zeros((len(error), 0)))
    poses, covariance = [part.block("") for part in rows], np.asarray(ends.covariance(np.ones(())))
    return Related(np.ones(len(error)), poses, relations, covariance, scale)


def _of_observations(record: CalibrationRecord, rows: Sequence[Rows], relations: Sequence[Block]) -> Related | None:
    lengths = [block for block in relations if block.fixture != PRIOR]
    if not lengths:
        return None
    capture, anchor, (related,), scale = record.recording.capture, scale_anchor_of(record), lengths, None
    stated = [np.asarray(u) for _, u in Observed.of(capture, None).certified().values()]
    units = np.maximum(np.concatenate([[float(length.u) for length in capture.lengths], *stated]), LEAST_U)
    # What a prior says counts as the poses do: lengths are compared with all else.
    poses = [*(part.block("") for part in rows), *(block for block in relations if block.fixture == PRIOR)]
    measured = any(o.fixes_scale and not o.certified for o in capture.observations)
    if anchor is not None and (record.hold is None or lengths_in_solve(record)) and not measured:
        column = record.names.index(anchor)
        scale = np.concatenate([block.shared[:, column] for block in poses]), related.shared[:, column]
        *poses, related = (b._replace(shared=np.delete(b.shared, column, axis=1)) for b in (*poses, related))
    return Related(units, poses, related, np.eye(len(units)), scale)
