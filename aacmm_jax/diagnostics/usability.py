"""Whether a result can be used at all: the solve ended at a minimum, with residuals that an arm can have."""

import numpy as np

from ..calibration.record import CalibrationRecord
from ..calibration.results import active_names
from ..core.text import shorten
from ..kinematics.parameters import Parameters
from .contradictions import session_metrics
from .equations import EXACT
from .findings import Case, Finding
from .recorded import likely_cause

ORDER, NEEDS = 10, "nothing"
_APART = 5.0  # RMS of a session among others, over that which it has alone, beyond which they are not of one arm
_TRY_ALL = "aacmm arm ARM --check MANIFEST tries every order and sign of the columns, and zero offsets of the joints."


def test(case: Case) -> list[Finding]:
    """A solve that did not end, residuals that no arm has, and parameters most of which ended on a bound."""
    record, findings = case.record, []
    # Where a solve ended whose scale is not plausible, that is what is wrong.
    if not record.converged and (record.plausible_scale or not record.reason.startswith("Converged")):
        findings.append(Finding("not-converged", record.reason, severity="unusable"))
    if record.implausible_residual:
        if record.recording.capture.observations:
            worst = int(np.argmax(record.observed.rms_after))
            names, rms = (record.observed.names[worst],), record.observed.rms_after[worst]
            subject = f"Poses of {names[0]} are {rms:.3g} mm RMS from their geometry"
        else:
            names, rms = (), float(record.evaluations()["calibrated"].repeatability.rms)
            subject = f"The poses of a socket disagree by {rms:.3g} mm RMS"
        findings.append(
            Finding(
                "implausible-residuals",
                f"{subject}, but at most {record.largest_plausible_residual:.2g} mm is plausible for this arm, so "
                "the data do not match the arm.",
                advice=f"Check the columns, units, signs, sockets and the arm. {case.once(cause_or_check)}",
                severity="unusable",
                doubt="the data do not match the arm",
                concerns=names,
            )
        )
    elif record.plausible_scale and many_on_bounds(record):
        sides = on_bounds(record)
        findings.append(
            Finding(
                "many-on-bounds",
                f"{len(sides)} of {len(record.names)} parameters are on a bound, so the data do not match the arm.",
                advice=(
                    f"Check the unit, the order of the columns, the sockets and the arm. {case.once(cause_or_check)}"
                ),
                severity="doubt",
                doubt=f"on a bound: {shorten(sorted(sides), 3)}",
                concerns=tuple(sides),
            )
        )
    return findings


def cause_or_check(case: Case) -> str:
    """The likely cause of data that do not fit; else what finds it."""
    recording = case.record.recording
    return likely_cause(recording.nominal.arm, recording.capture) or _TRY_ALL


def on_bounds(record: CalibrationRecord, final: bool = False) -> dict[str, str]:
    """Parameters that stage 1, or the final solve, left on a bound: name -> 'lower' or 'upper'."""
    active = record.active if final else record.active_stage1
    return active_names(Parameters(record.recording.nominal.arm, record.names), active)


def is_anchored(record: CalibrationRecord) -> bool:
    """Whether stage 1 was kept from sliding along the scale."""
    return record.hold is not None or bool(record.recording.capture.observations)


def many_on_bounds(record: CalibrationRecord) -> bool:
    """Whether so many parameters are on a bound that the arm is not that of the data."""
    return len(on_bounds(record)) >= len(record.names) / 3 and is_anchored(record)


def does_not_fit(record: CalibrationRecord) -> bool:
    """Whether a third of the parameters is on a bound, or sessions of one arm are far worse together than alone."""
    metrics = session_metrics(record).values()
    return many_on_bounds(record) or any(together > _APART * max(alone, EXACT) for _, together, alone in metrics)
