"""Errors on data that a calibration has not seen, and those that its uncertainty predicts, as ``--json`` has them."""

import math
from typing import Any

import numpy as np

from ..calibration.prediction import Agreement, CrossValidation, LeftOut


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


def finite(value: float) -> float | None:
    """A number as JSON can hold it."""
    return float(value) if math.isfinite(value) else None


def _root_mean_square(values: np.ndarray) -> float | None:
    return finite(float(np.sqrt(np.mean(np.square(values))))) if len(values) else None
