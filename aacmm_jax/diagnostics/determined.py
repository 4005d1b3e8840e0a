"""What the data of a calibration determine, and what nothing checks: few equations, and a single reference length."""

import numpy as np

from ..calibration.record import REPEATABILITY, CalibrationRecord
from ..core.numpy_or_jax import to_numpy
from ..core.text import shorten
from ..data.noise import tip_covariances
from ..kinematics.chain import joint_motion
from ..kinematics.parameters import Bounds, Parameters
from ..uncertainty.identifiability import Observability, observability
from .findings import Case, Finding

ORDER, NEEDS = 95, "fit"
_TOGETHER = 1e-3  # part of an undetermined direction, from which a parameter belongs to it


def determined(case: Case) -> Observability:
    """What the data of a calibration determine about the calibrated arm, given its noise and bounds."""
    record = case.record
    arm, capture = record.calibrated.arm, record.recording.capture
    space = Parameters(arm, record.names)
    geometry, noise = to_numpy((arm.geometry, record.noise))
    covariances = tip_covariances(geometry, joint_motion(geometry, np.asarray(capture.readings)), noise)
    sigma = float(np.sqrt(np.trace(np.asarray(covariances)).mean() / 3))
    known = () if record.prior is None else record.prior.known
    bounds = Bounds(space, record.lower, record.upper)
    return observability(arm, capture, space, sigma=sigma, bounds=bounds, known=known)


def test(case: Case) -> list[Finding]:
    """Little redundancy, undetermined combinations, and parameters that are hardly known."""
    record, seen = case.record, case.once(determined)
    findings = [] if record.recording.capture.observations else _redundancy(record)
    findings += [Finding("undetermined", sentence) for sentence in seen.sentences()]
    weak = [name for name, single in zip(record.names, record.determined, strict=True) if not single]
    # Named above are those that the same capture could not determine without noise either, and near-degenerate ones.
    named = {record.names[i] for i in np.flatnonzero(np.abs(seen.null).max(axis=1, initial=0.0) > _TOGETHER)}
    named |= {name for trade_off in seen.trade_offs for name in trade_off.names}
    weak = [name for name in weak if name not in named]
    if weak:
        findings.append(
            Finding(
                "determined-together",
                f"Strongly correlated, individually almost undetermined: {shorten(weak, 12)}.",
                "Tip and length uncertainties remain valid.",
                "Hold some of them constant (--held).",
                concerns=tuple(weak),
            )
        )
    u, width = np.sqrt(np.diag(record.covariance)), (record.upper - record.lower) / 2
    most = np.where(np.isfinite(width), 0.5 * width, np.inf)
    loose = [
        name
        for name, single, own_u, largest in zip(record.names, record.determined, u, most, strict=True)
        if single and name not in named and own_u > largest
    ]
    if loose:
        findings.append(
            Finding(
                "hardly-determined",
                f"Hardly determined, with a standard uncertainty over half of what the bounds allow: {shorten(loose)}.",
                advice="Fix some (--held), or record poses that separate them.",
                concerns=tuple(loose),
            )
        )
    return findings


def _redundancy(record: CalibrationRecord) -> list[Finding]:
    capture, unknown, findings = record.recording.capture, len(record.names) - 1, []
    redundancy = 3 * sum(size - 1 for size in capture.sizes) - unknown
    if redundancy < unknown / 2:
        findings.append(
            Finding(
                "little-redundancy",
                f"Only {redundancy} more equations than unknowns, which makes the residuals small whatever the errors "
                "are.",
                advice="Record more poses.",
            )
        )
    if len(capture.lengths) == 1 and record.method != REPEATABILITY and not record.scale_set_by:
        (length,) = capture.lengths
        findings.append(
            Finding(
                "one-reference-length",
                "With a single reference length its residual is zero by construction.",
                advice="Hold a second one out as a check.",
                concerns=(f"{length.start} - {length.end}",),
            )
        )
    return findings
