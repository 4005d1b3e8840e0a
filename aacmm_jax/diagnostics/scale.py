"""What fixes the scale of a calibrated arm, and whether k may be the scale of an arm."""

import math

from ..calibration.record import REPEATABILITY, CalibrationRecord
from ..calibration.results import PLAUSIBLE_SCALE, plausible
from ..calibration.scale_anchor import scale_set_by_clause
from ..core.text import shorten
from ..core.units import INCH, M
from .findings import Case, Finding
from .usability import on_bounds

ORDER, NEEDS = 70, "nothing"
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


def test(case: Case) -> list[Finding]:
    """At most one finding on k, and one where the arm could not be divided by it."""
    record = case.record
    findings = [finding] if (finding := _of_k(record)) is not None else []
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
        by_lengths = f" By the reference lengths, k = {k:.6f}." if math.isfinite(k) else ""
        return Finding(
            "nominal-scale",
            "The scale is taken from the nominal arm and assumed exact; all lengths carry its error." + by_lengths,
            severity="doubt",
            doubt="nothing that was measured set its scale",
        )
    if not math.isfinite(k):
        return None
    if not plausible(k):
        mistakes = (question for ratio, question in _MISTAKEN_UNITS.items() if abs(k / ratio - 1) < 0.1)
        low, high = PLAUSIBLE_SCALE
        return Finding(
            "implausible-scale",
            f"k = {k:.6g} is not plausible (expected {low:g} to {high:g}).",
            advice=next(mistakes, "Check units, sockets, lengths and arm."),
            severity="unusable",
            doubt="the reference lengths give the arm a scale that is not plausible",
        )
    if set_by and record.method == "two-stage":
        return Finding(
            "scale-set-by-fixed-lengths",
            f"{scale_set_by_clause(set_by)}, so the reference lengths changed nothing: by them the arm is {k:.6f} "
            f"times too large (u = {record.u_k:.2g}).",
            advice="Free one of these lengths, or use both with the joint solve (--method joint).",
            concerns=set_by,
        )
    sides = on_bounds(record)
    if record.hold is None and sides and not set_by:
        return Finding(
            "scale-stopped-by-bounds",
            f"Stage 1 ran with every length free and {'shrank' if k < 1 else 'stretched'} the arm to k = {k:.5f} until "
            f"a bound stopped it: {shorten([f'{name} ({side})' for name, side in sides.items()])}. The scale fix "
            "undoes that.",
            "The uncertainty of k takes these bounds as exact.",
            "Hold a length (--hold) to avoid it.",
            concerns=tuple(sides),
        )
    if record.hold is not None and abs(k - 1) > max(_SUSPICIOUS, 3 * record.u_k):
        return Finding(
            "scale-far-from-1",
            f"k = {k:.5f} is far from 1.",
            advice=f"Is {record.hold} at its nominal value, and is each reference length right?",
            concerns=(record.hold,),
        )
    return None
