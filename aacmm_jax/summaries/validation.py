"""Errors on data that a calibration has not seen, beside those that its uncertainty predicts; for ``--json`` too."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..calibration.left_out import LEVEL, CrossValidation, LeftOut
from ..calibration.prediction import Agreement
from ..core.text import shorten


def cross_validation_summary(validation: CrossValidation) -> dict[str, Any]:
    """All groups together, and every group, the most improbable first; mm."""
    chance = [min(filter(math.isfinite, group.probabilities), default=math.nan) for group in validation.groups]
    order = sorted(range(len(chance)), key=lambda i: chance[i] if math.isfinite(chance[i]) else 2.0)
    return {
        "groups": len(order),
        "rms_mm": finite(validation.rms),
        "rms_predicted_mm": finite(validation.rms_predicted),
        "length_error_rms_mm": finite(validation.length_rms),
        "length_u_mm": finite(validation.length_u),
        "excess": finite(validation.excess),
        "surprising": validation.surprising,
        "left_out": [
            {"group": validation.labels[i]}
            | _group(validation.groups[i])
            | {"probability": finite(chance[i]), "disagrees": i in validation.disagreeing}
            for i in order
        ],
    }


def _group(group: LeftOut) -> dict[str, Any]:
    known = np.isfinite(group.length_u)
    return {
        "members": list(group.sockets),
        "poses": group.poses,
        "converged": group.converged,
        "rms_mm": finite(group.rms),
        "rms_predicted_mm": finite(group.rms_predicted),
        "lengths": len(group.length_error),
        "length_error_rms_mm": _root_mean_square(group.length_error),
        "length_u_mm": _root_mean_square(group.length_u) if known.all() else None,
    }


def contradicted_prediction(validation: CrossValidation) -> list[str]:
    """A sentence on groups whose errors exceed what their prediction allows, where there are any."""
    if not validation.surprising:
        return []
    count = len(validation.disagreeing)
    named = _disagreement(validation)
    if 0 < count < len(validation.groups) / 2:
        others = len(validation.groups) - count
        return [
            f"Held out one after the other, some groups disagree with the others by more than predicted: {named}; the "
            f"other {others} agree. Look for what differs there (a socket or tool that moved, a wrong length, poses "
            "far from all others)."
        ]
    pairs = (
        ("poses", validation.rms, validation.rms_predicted),
        ("reference lengths", validation.length_rms, validation.length_u),
    )
    ratios = [
        f"{name} {error:.3g} mm RMS, {error / predicted:.1f} times the predicted {predicted:.3g} mm"
        for name, error, predicted in pairs
        if predicted > 0 and math.isfinite(error)
    ]
    return [
        f"Held out one after the other, placements have larger errors than predicted: {'; '.join(ratios)}"
        + (f"; worst in {named}" if named else "")
        + ". Errors of neighbouring poses are alike, as of effects outside the D-H model (compliant joints, eccentric "
        "encoders). Use the cross-validated values; every u of this calibration is too small."
    ]


def _disagreement(validation: CrossValidation) -> str:
    """The most improbable groups: by how much their poses, or else their lengths, exceed the prediction."""
    found = []
    for i in validation.disagreeing:
        label, group = validation.labels[i], validation.groups[i]
        poses, lengths = group.probabilities
        if not lengths < poses:
            ratio = group.rms / group.rms_predicted
            found.append(f"{label} ({group.rms:.3g} mm RMS, {ratio:.1f} times its prediction)")
        else:
            error = _root_mean_square(group.length_error)
            found.append(f"{label} (lengths off by {error:.3g} mm, {group.length_ratio:.1f} times their u)")
    return shorten(found, 3)


def agreement_row(agreement: Agreement) -> dict[str, Any]:
    """Errors found and predicted of some poses, mm and in standard deviations."""
    return {
        "poses": agreement.count,
        "rms_mm": finite(agreement.rms),
        "rms_predicted_mm": finite(agreement.predicted),
        "reduced_chi": finite(agreement.reduced_chi),
        "rms_angle_rad": finite(agreement.rms_angle),
        "probability": finite(agreement.probability),
    }


def surprise(
    poses: Agreement, lengths: Agreement, parts: dict[str, Agreement], refitted: Callable[[], Agreement | None]
) -> list[str]:
    """A sentence on unseen data that scatter more than predicted, by more than chance does in one case of a hundred.

    ``parts`` are the sockets and observations, of which the most improbable are named; ``refitted`` says how all poses
    agree where the place of the probe is fitted to them: where that removes most of the excess, it is the cause.
    """
    found = []
    tested = sum(math.isfinite(agreement.probability) for agreement in (poses, lengths))
    if poses.probability < LEVEL / max(tested, 1):
        improbable = sorted(
            (part.probability, name) for name, part in parts.items() if part.probability < LEVEL / len(parts)
        )
        worst = [
            f"{name} ({parts[name].rms:.3g} mm, {parts[name].rms / parts[name].predicted:.1f} times)"
            for _, name in improbable[:3]
        ]
        found.append(
            f"poses are {poses.rms:.3g} mm RMS from their geometry, {poses.rms / poses.predicted:.1f} times the "
            f"predicted {poses.predicted:.3g} mm" + (f", most of all in {', '.join(worst)}" if worst else "")
        )
    if lengths.probability < LEVEL / max(tested, 1):
        found.append(
            f"reference lengths err by {lengths.rms / lengths.predicted:.1f} times their standard uncertainty (RMS)"
        )
    if not found:
        return []
    again = refitted() if poses.probability < LEVEL else None
    cause = (
        "The arm or its probe has changed since (a remounted tip), these data have errors of their own, or the model "
        "misses effects that poses of the calibration did not show: its uncertainties do not hold here."
    )
    # Most of the excess: more than half of it, in squares.
    if again is not None and poses.rms**2 - again.rms**2 > (poses.rms**2 - poses.predicted**2) / 2:
        cause = (
            f"With the probe's place in the last frame fitted to them, they are {again.rms:.3g} mm RMS: the tip was "
            "remounted, or is another one. Calibrate such data as a session with a probe of its own (aacmm calibrate "
            "A.h5 B.h5)."
        )
    return [f"Data that the calibration has not seen disagree with it by more than chance: {'; '.join(found)}. {cause}"]


def no_better(nominal: float | None, calibrated: float | None) -> list[str]:
    """A sentence where the calibration has not improved the RMS distance of held-out poses, mm."""
    if nominal is None or calibrated is None or calibrated < nominal:
        return []
    return [
        f"On data that it has not seen, the calibrated arm is no better than the nominal one: {calibrated:.3g} mm RMS "
        f"instead of {nominal:.3g} mm."
    ]


def finite(value: float) -> float | None:
    """A number as JSON can hold it."""
    return float(value) if math.isfinite(value) else None


def _root_mean_square(values: np.ndarray) -> float | None:
    return finite(float(np.sqrt(np.mean(np.square(values))))) if len(values) else None
