"""What was recorded: readings outside the arm's limits, repeated poses, and standard uncertainties that nothing has."""

import math
from collections.abc import Iterator

import numpy as np

from ..core.text import shorten
from ..core.units import UM
from ..data.capture import Capture
from ..data.observations.observation import stated_u
from ..data.recording import Recording
from ..kinematics.chain import reading_units
from .corrections import likely_cause
from .findings import Case, Finding

ORDER, NEEDS = 80, "nothing"
_TOLERANCE = math.radians(0.01)  # beyond a limit: more than the noise of any encoder
# mm. An interferometer reaches 0.1 um in a metre; seats, probes and trackers of arms are far from it. Beyond 1 mm a
# length or point says less than the nominal arm does.
SMALLEST_U, LARGEST_U = 1e-4, 1.0


def test(case: Case) -> list[Finding]:
    """Of the capture of a calibration."""
    return of_recording(case.record.recording)


def findings_of_capture(recording: Recording) -> list[Finding]:
    """What should be read about a capture before it is calibrated.

    Args:
        recording: The capture, and the nominal arm.

    Returns:
        The likely cause where the nominal arm is far off, and what is wrong with readings and uncertainties.

    Example:
        >>> print(aj.diagnostics.findings_of_capture(recording))
        []
    """
    mistake = likely_cause(recording.nominal.arm, recording.capture) if recording.true is None else None
    causes = [] if mistake is None else [Finding("likely-cause", mistake.says, concerns=mistake.concerns)]
    return [*causes, *of_recording(recording)]


def of_recording(recording: Recording) -> list[Finding]:
    """Of what was recorded; a simulation keeps within the limits but for its noise, and may have exact lengths."""
    capture, simulated = recording.capture, recording.true is not None
    repeated = [Finding("repeated", sentence) for sentence in capture.repeated.sentences()]
    if simulated:
        return repeated
    exact = [f"{length.start} - {length.end}" for length in capture.lengths if float(length.u) == 0]
    findings = [*outside_limits(recording), *repeated]
    if exact:
        says = f"These lengths are treated as exact, because their u is 0: {shorten(exact)}."
        advice = "Give the standard uncertainty of each length."
        findings.append(Finding("exact-lengths", says, advice=advice, concerns=tuple(exact)))
    return findings + _implausible_uncertainties(capture)


def outside_limits(recording: Recording) -> Iterator[Finding]:
    """Readings outside the joint limits: a wrong unit, or exchanged columns."""
    arm, q = recording.nominal.arm, np.asarray(recording.capture.readings)
    units = reading_units(arm.geometry)
    for joint, limits in enumerate(arm.limits or ()):
        tolerance = _TOLERANCE * units[joint]
        outside = int(np.sum((q[:, joint] < limits[0] - tolerance) | (q[:, joint] > limits[1] + tolerance)))
        if outside:
            slides = joint + 1 in arm.prismatic
            low, high = (f"{x if slides else math.degrees(x):.0f}" for x in limits)
            yield Finding(
                "outside-limits",
                f"Joint {joint + 1}: {outside} of {len(q)} readings lie outside its limits, {low} to {high} "
                f"{'mm' if slides else 'deg'}.",
                advice="Are the unit and the order of the columns right?",
                concerns=(f"joint {joint + 1}",),
            )


def _implausible_uncertainties(capture: Capture) -> list[Finding]:
    """Of standard uncertainties that nothing which measures arms has: most likely of another unit than mm."""
    stated = [(f"[[length]] {length.start} - {length.end}", length.u) for length in capture.lengths]
    stated += [(f"[[{part.table}]] {part.name}", stated_u(part)) for part in capture.observations]
    positive = [(where, values[values > 0]) for where, u in stated for values in [np.asarray(u, dtype=float).ravel()]]
    least = [(where, values.min() / UM) for where, values in positive if len(values) and values.min() < SMALLEST_U]
    most = [(where, values.max() / UM) for where, values in positive if len(values) and values.max() > LARGEST_U]
    small = [f"{where} (u = {u:.3g} um)" for where, u in least]
    large = [f"{where} (u = {u:,.0f} um)" for where, u in most]
    return [
        Finding(
            code,
            f"{says}: {shorten(texts)}.",
            advice=f"u must be in mm; was it given in {unit}?",
            concerns=tuple(texts),
        )
        for code, texts, says, unit in (
            ("small-u", small, "u < 0.1 um is implausibly small", "m"),
            ("large-u", large, "u > 1 mm is implausibly large", "um"),
        )
        if texts
    ]
