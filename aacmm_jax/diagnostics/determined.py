"""What the data of a calibration determine, and what nothing checks: parameters on a bound or poorly determined,
few equations, and a single reference length."""

from collections.abc import Iterator

import numpy as np

from ..calibration.record import REPEATABILITY, CalibrationRecord
from ..core.numpy_or_jax import to_numpy
from ..core.text import shorten
from ..kinematics.independence import SHARE_OF_BOUNDS
from ..kinematics.parameters import Bounds, Parameters
from ..uncertainty.identifiability import Observability, observability, rms_of_noise
from .findings import Case, Finding
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
        "Widen the bounds, unless they are true limits of these parameters.",
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
    findings = []
    for code, (says, costs, advice) in _ON_BOUNDS.items():
        names = [name for name in sides if (name in traded) == (code == "weak-on-bounds")]
        if names and not many_on_bounds(record):
            says = says.format(names=shorten([f"{name} ({sides[name]})" for name in names]))
            doubt = f"on a bound: {shorten(sorted(names), 3)}"
            findings.append(Finding(code, says, costs, advice, "doubt", doubt, concerns=tuple(names)))
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
