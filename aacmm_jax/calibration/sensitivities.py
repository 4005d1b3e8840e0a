"""How the parameters of a calibration follow errors of its tips and joints, at its solution."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray
from ..uncertainty.linearisation import Linearisation


class Sensitivities(NamedTuple):
    """Derivatives of the parameters (mm and rad, in the order of ``space.names``) by errors of M poses, those of
    sockets first, and what lengths between sockets' means owe to them."""

    tips: Float[np.ndarray, "p 3 M"]  # by displacements of the tip, mm
    joints: Float[np.ndarray, "p n M"]  # by errors of the joints, rad (mm of prismatic ones)
    lengths: Float[np.ndarray, "l 3 M"]  # of measured lengths by the tips, where positions of sockets are means


def sensitivities_of_rows(
    linear: Linearisation,
    rows: Sequence[Float[AnyArray, "p _ _"]],
    lengths: Float[np.ndarray, "l 3 M"],
) -> Sensitivities:
    """Of parameters that follow the whitened rows of every group so."""
    joints = [
        np.einsum("pbm,bnm->pnm", one, error.by_readings)
        for one, error in zip(_of_residuals(linear, rows), linear.errors, strict=False)
    ]
    by_joints = np.concatenate(linear.observed.by_observation(joints), axis=2)
    return Sensitivities(tips_of_rows(linear, rows), by_joints, lengths)


def tips_of_rows(linear: Linearisation, rows: Sequence[Float[AnyArray, "q _ _"]]) -> Float[np.ndarray, "q 3 M"]:
    """Derivatives by the tips, of what follows the whitened rows so."""
    tips = [
        np.einsum("qbm,bcm->qcm", one, part.by_tip)
        for one, part in zip(_of_residuals(linear, rows), linear.point.rows, strict=False)
    ]
    return np.concatenate(linear.observed.by_observation(tips), axis=2)


def _of_residuals(linear: Linearisation, rows: Sequence[Float[AnyArray, "q _ _"]]) -> list[Float[np.ndarray, "q _ _"]]:
    """Derivatives by the residuals before they are whitened."""
    roots = [np.asarray(root) for root in linear.whitening.roots]
    return [np.einsum("qam,mab->qbm", one, root) for one, root in zip(rows, roots, strict=False)]
