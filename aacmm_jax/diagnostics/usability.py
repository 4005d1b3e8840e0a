"""Whether a result can be used at all: the solve ended at a minimum, with residuals that an arm can have.

Where they are larger than usual, mistakes in the readings are looked for, as ``aacmm arm --check`` does. What was
recorded is blamed only where that finds one; else the reason is what the residuals themselves show.
"""

import numpy as np

from ..calibration.record import SCALE_REFUSED, CalibrationRecord
from ..calibration.results import active_names
from ..core.text import listed, shorten
from ..kinematics.parameters import Parameters
from .contradictions import session_metrics
from .culprits import missing
from .equations import EXACT
from .findings import RECORD_DIRECTIONS, Case, Finding, findings_of
from .joint_travel import standing_rows
from .mistakes import mistake_in_data
from .noisy_encoders import noisiest_joint
from .pose_residuals import distances_of
from .residual_tests import SURE

ORDER, NEEDS = 10, "nothing"
_APART = 5.0  # RMS of a session among others, over that which it has alone, beyond which they are not of one arm
_MOST, _FEW = 0.5, 0.05  # part of the squared residuals that a few poses have, where they are the reason
_PLAY = "play in the joints, or another effect that the model does not describe"


def test(case: Case) -> list[Finding]:
    """A solve that did not end, and residuals that no arm has."""
    record, findings = case.record, _standing(case.record)
    if not record.converged and not record.reason.startswith(SCALE_REFUSED):  # that is said by another finding
        findings.append(Finding("not-converged", record.reason, severity="unusable"))
    if record.residual > record.largest_usual_residual:
        findings.append(_of_residuals(case))
    return findings


def _standing(record: CalibrationRecord) -> list[Finding]:
    """Joints that moved too little, where that leaves free parameters undetermined for which there is no prior."""
    nominal = record.recording.nominal
    rows = [] if record.prior is not None else standing_rows(nominal.arm, record.recording.capture)
    rows = [row for row in rows if not set(row["lost"]).isdisjoint(record.names)]
    if not rows:
        return []
    joints = f"{'joint' if len(rows) == 1 else 'joints'} {listed([str(row['joint']) for row in rows])}"
    lost = [name for row in rows for name in row["lost"] if name in record.names]
    return [
        Finding(
            "standing-joints",
            f"{joints.capitalize()} moved too little in these poses, so that {shorten(lost, 6)} cannot be identified.",
            advice="Let every joint move over most of its travel, or hold these parameters (--held).",
            severity="doubt" if record.converged else "unusable",
            doubt=f"{joints} moved too little",
            concerns=tuple(f"joint {row['joint']}" for row in rows),
        )
    ]


def _of_residuals(case: Case) -> Finding:
    """Residuals that are larger than usual: no arm has them, a mistake explains them, or the arm itself has them."""
    record = case.record
    if record.recording.capture.observations:
        worst = int(np.argmax(record.observed.rms_after))
        names, rms = (record.observed.names[worst],), record.observed.rms_after[worst]
        subject = f"Poses of {names[0]} are {rms:.3g} mm RMS from their geometry"
    else:
        names, rms = (), float(record.evaluations()["calibrated"].repeatability.rms)
        subject = f"The poses of a socket disagree by {rms:.3g} mm RMS"
    largest, usual = record.largest_plausible_residual, record.largest_usual_residual
    limit = f"at most {largest:.2g} mm is plausible" if record.implausible_residual else f"{usual:.2g} mm is usual"
    finding = Finding(
        "implausible-residuals", f"{subject}, but {limit} for this arm.", severity="unusable", concerns=names
    )
    if mistake := case.once(mistake_in_data):
        check = "Check the columns, units, signs, sockets and the arm. " if mistake.of_readings else ""
        # It stands before the solve that did not end, since it is the reason.
        finding = finding._replace(advice=f"{check}{mistake.says}", concerns=mistake.concerns or names, explains=1.0)
        if record.implausible_residual or mistake.of_readings:
            says = f"{subject}, but {limit} for this arm, so the data do not match the arm."
            return finding._replace(says=says, doubt="the data do not match the arm")
        doubt = f"large residuals, most likely {mistake.says.removeprefix('Likely cause: ').rstrip('.')}"
        return finding._replace(code="large-residuals", severity="doubt", doubt=doubt)
    reason = case.once(likely_reason)
    record_sides = reason == _PLAY and "directions" not in record.recording.nominal.arm.recorded
    finding = finding._replace(advice=f"Most likely: {reason}.{f' {RECORD_DIRECTIONS}' if record_sides else ''}")
    if record.implausible_residual:
        return finding._replace(doubt=f"residuals are too large for this arm; most likely {reason}")
    return finding._replace(code="large-residuals", severity="doubt", doubt=f"large residuals, most likely {reason}")


def likely_reason(case: Case) -> str:
    """What residuals that are larger than usual, and that no mistake in the readings explains, most likely come from:
    bounds, a few poses, one observation, an arm that was held, one joint, bending, or play."""
    record, capture = case.record, case.record.recording.capture
    # Bounds that nobody stated were widened as far as that helped.
    if (sides := on_bounds(record, final=True)) and "bounds" in record.recording.nominal.stated:
        return f"bounds that are too narrow (reached: {shorten(sorted(sides), 3)})"
    distances = distances_of(capture, record.evaluations()["calibrated"])
    squares, names = [np.asarray(part) ** 2 for part in distances], [part.name for part in capture.parts]
    total = sum(map(np.sum, squares))
    worst = max(range(len(squares)), key=lambda i: squares[i].max(initial=0.0))
    few = max(1, int(_FEW * sum(map(len, squares))))
    if np.sort(np.concatenate(squares))[-few:].sum() > _MOST * total:
        return f"errors of a few poses, the largest in {names[worst]} pose {int(np.argmax(squares[worst])) + 1}"
    worst = max(range(len(squares)), key=lambda i: squares[i].sum())
    if squares[worst].sum() > _MOST * total and len(squares[worst]) < _MOST * sum(map(len, squares)):
        return f"errors in {names[worst]}"
    if not record.implausible_residual:
        if not record.names:
            return "errors of the arm's parameters, all of which were held"
        # What equations linear in the residuals tell, which must be small for that.
        noisiest = case.once(noisiest_joint)
        joints = [encoder.joint for encoder in record.noisy_encoders]
        joints += [noisiest.joint] if noisiest is not None and noisiest.probability < SURE else []
        if joints:
            return f"play or a loose encoder in joint {joints[0]}"
        bending = [str(term.joint) for term in case.once(missing) if term.kind == "gravity"]
        if bending:
            return f"bending under gravity (joint {shorten(bending)})"
        return _PLAY
    return (
        "another arm than the one named, rows that belong to other sockets or positions, or measured values that are "
        "less certain than stated"
    )


def on_bounds(record: CalibrationRecord, final: bool = False) -> dict[str, str]:
    """Parameters that stage 1, or the final solve, left on a bound: name -> 'lower' or 'upper'."""
    active = record.active if final else record.active_stage1
    return active_names(Parameters(record.recording.nominal.arm, record.names), active)


def is_anchored(record: CalibrationRecord) -> bool:
    """Whether stage 1 was kept from sliding along the scale."""
    return record.hold is not None or bool(record.recording.capture.observations)


def many_on_bounds(record: CalibrationRecord) -> bool:
    """Whether so many parameters are on a bound that the arm is not that of the data."""
    return len(on_bounds(record)) >= max(len(record.names) / 3, 1) and is_anchored(record)


def why_unusable(record: CalibrationRecord) -> str | None:
    """Why a calibration is not to be used, in a few words; None where it may be used."""
    if record.converged and record.plausible_scale and record.residual <= record.largest_usual_residual:
        return None
    reasons = [finding.doubt or finding.says for finding in findings_of(record) if finding.severity == "unusable"]
    return reasons[0].rstrip(".") if reasons else None


def does_not_fit(record: CalibrationRecord) -> bool:
    """Whether a third of the parameters is on a bound, or sessions of one arm are far worse together than alone."""
    metrics = session_metrics(record).values()
    return many_on_bounds(record) or any(together > _APART * max(alone, EXACT) for _, together, alone in metrics)
