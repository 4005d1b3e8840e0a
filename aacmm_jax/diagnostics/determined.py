"""What the data of a calibration determine, and what nothing checks: parameters on a bound or poorly determined,
few equations, and a single reference length."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..calibration.record import REPEATABILITY, CalibrationRecord
from ..core.numpy_or_jax import to_numpy
from ..core.text import shorten
from ..kinematics.independence import SHARE_OF_BOUNDS
from ..kinematics.parameters import Bounds, Parameters
from ..uncertainty.identifiability import Observability, observability, rms_of_noise
from .culprits import selection
from .equations import Block
from .findings import Case, Finding, by_equations
from .mistakes import TRY_ALL, mistake_in_data
from .residual_tests import Candidates, Residuals
from .usability import is_anchored, many_on_bounds, on_bounds

ORDER, NEEDS = 85, "fit"
_TOGETHER = 1e-3  # part of an undetermined direction, from which a parameter belongs to it
# Of those that the data do not tell from others well, and of the others, which wider bounds help.
_ON_BOUNDS = {
    "weak-on-bounds": (
        "On a bound because the data determine these parameters poorly: {names}.",
        "The uncertainties of these parameters depend on the width of the bounds.",
        "Fix one parameter of each combination named below (--held), and do not widen the bounds.",
    ),
    "on-bounds": (
        "On a bound: {names}.",
        "All uncertainties, including that of k, are computed as if these values were exact.",
        "Widen the bounds (--length-bound-mm, --angle-bound-deg), unless they are true limits of these parameters.",
    ),
}


def determined(case: Case) -> Observability:
    """What the data of a calibration determine about the calibrated arm, given its noise and bounds."""
    record = case.record
    arm, capture = record.calibrated.arm, record.recording.capture
    space = Parameters(arm, record.names)
    geometry, noise = to_numpy((arm.geometry, record.noise))
    sigma = rms_of_noise(geometry, np.asarray(capture.readings), noise)
    with_prior = () if record.prior is None else record.prior.with_prior
    bounds = Bounds(space, record.lower, record.upper)
    return observability(arm, capture, space, sigma=sigma, bounds=bounds, with_prior=with_prior)


def test(case: Case) -> list[Finding]:
    """Parameters on bounds, little redundancy, undetermined combinations, and parameters that are poorly determined."""
    record, seen = case.record, case.once(determined)
    traded = {name for trade_off in seen.trade_offs for name in trade_off.names}
    # Without an anchor all lengths slide to bounds in stage 1, which the scale fix undoes.
    sides = on_bounds(record, final=True) | (on_bounds(record) if is_anchored(record) else {})
    many = many_on_bounds(record) and len(sides.keys() - traded) >= len(record.names) / 3
    findings = [_many(case, sides)] if many else []
    for code, (says, costs, advice) in _ON_BOUNDS.items() if not findings else ():
        names = [name for name in sides if (name in traded) == (code == "weak-on-bounds")]
        if not names:
            continue
        effect = case.once(effect_of_bounds) if code == "on-bounds" else Effect({}, 0.0)
        names.sort(key=lambda name: -effect.gains.get(name, 0.0))
        says = says.format(names=shorten([f"{name} ({sides[name]})" for name in names]))
        doubt = f"on a bound: {shorten(names, 3)}"
        finding = Finding(code, says, costs, advice, "doubt", doubt, concerns=tuple(names))
        # Where a fixed length sets another scale than the lengths, that is what takes the others to their bounds.
        findings.append(finding._replace(explains=None if record.scale_set_by else effect.share or None))
    findings += [*_redundancy(record), *(Finding("undetermined", sentence) for sentence in seen.sentences())]
    # Named above are those that the same capture could not determine without noise either, and near-degenerate ones.
    open_parts = np.flatnonzero(np.abs(seen.null).max(axis=1, initial=0.0) > _TOGETHER)
    named = traded | {record.names[i] for i in open_parts}
    half_width = (record.upper - record.lower) / 2
    most = np.where(np.isfinite(half_width), SHARE_OF_BOUNDS * half_width, np.inf)
    loose = ~np.asarray(record.determined) | (np.sqrt(np.diag(record.covariance)) > most)
    names = [name for name, is_loose in zip(record.names, loose, strict=True) if is_loose and name not in named]
    if names:
        findings.append(
            Finding(
                "poorly-determined",
                f"Poorly determined individually: {shorten(names, 12)}. These parameters are strongly correlated, or "
                "their standard uncertainty exceeds a quarter of the distance between their bounds.",
                "Tip and length uncertainties remain valid.",
                "Fix some of these parameters (--held), or record poses that separate them.",
                concerns=tuple(names),
            )
        )
    return findings


def _many(case: Case, sides: dict[str, str]) -> Finding:
    """So many parameters that the data determine are on a bound that the arm is not that of the data."""
    mistake, widen = case.once(mistake_in_data), "Widen the bounds (--length-bound-mm, --angle-bound-deg)."
    return Finding(
        "many-on-bounds",
        f"{len(sides)} of {len(case.record.names)} parameters are on a bound, so either the bounds are too narrow, or "
        "the data do not match the arm.",
        advice=f"{widen} {TRY_ALL}" if mistake is None else mistake.says,
        severity="doubt",
        doubt=f"on a bound: {shorten(sorted(sides), 3)}",
        concerns=tuple(sides) if mistake is None else mistake.concerns,
    )


class Effect(NamedTuple):
    """What bounds do to the residuals."""

    gains: dict[str, float]  # parameter on a bound -> drop of the sum of squares if this bound were wider
    share: float  # of all that is explained, by bounds or causes, that these bounds explain


@by_equations
def effect_of_bounds(case: Case) -> Effect:
    """What the parameters that ended on a bound would explain if they were free."""
    free = [name for name in case.record.names if name != case.equations.anchor]
    columns = [free.index(name) for name in on_bounds(case.record, final=True) if name in free]
    if not case.testable or not columns:
        return Effect({}, 0.0)
    rows, relations = case.chunks
    blocks = [*(part.block("") for part in rows), *relations]
    without = Residuals.of([_without(block, columns) for block in blocks])
    by = np.concatenate([block.shared[:, columns] for block in blocks])
    tests = Candidates.of(without, [by[:, [i]] for i in range(len(columns))]).tests(without)
    gains = {free[i]: test.gain for i, test in zip(columns, tests, strict=True)}
    # With what causes explain of the rest, whose parts add up to 1 as well.
    left = case.left.cost / max(without.cost, 1e-300)
    return Effect(gains, (1 - left) / max(1 - left * case.once(selection).remaining, 1e-300))


def _without(block: Block, columns: list[int]) -> Block:
    return block._replace(shared=np.delete(block.shared, columns, axis=1))


def _redundancy(record: CalibrationRecord) -> Iterator[Finding]:
    capture, unknown = record.recording.capture, len(record.names) - 1
    if capture.observations:
        return
    redundancy = 3 * sum(size - 1 for size in capture.sizes) - unknown
    if redundancy < unknown / 2:
        yield Finding(
            "little-redundancy",
            f"There are only {redundancy} more equations than unknowns, so the residuals are small even if the errors "
            "are large.",
            advice="Record more poses.",
        )
    if len(capture.lengths) == 1 and record.method != REPEATABILITY and not record.scale_set_by:
        (length,) = capture.lengths
        yield Finding(
            "one-reference-length",
            "With a single reference length, the residual of this length is zero by construction.",
            advice="Hold out a second reference length as a check.",
            concerns=(f"{length.start} - {length.end}",),
        )
