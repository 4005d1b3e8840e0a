"""Cross-validation: the arm identified without some of the sockets, and evaluated on those left out."""

import math
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..core.arguments import checked_arguments
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture, check_sockets_only
from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import Arm
from ..kinematics.chain import sines_cosines
from ..kinematics.parameters import Bounds
from ..model.socket_sums import means_over_sockets, sums_over_sockets
from ..uncertainty.arm_uncertainty import Uncertainty
from .evaluation import evaluate
from .record import uncertainty_of
from .results import CrossValidation, LeftOut
from .single import calibrate


def groups_of(capture: Capture) -> tuple[tuple[str, ...], ...]:
    """Groups of sockets that reference lengths join, which are left out together."""
    group = list(range(len(capture.names)))
    for start, end in capture.ends():
        old, new = group[end], group[start]
        group = [new if number == old else number for number in group]
    return tuple(
        tuple(name for name, number in zip(capture.names, group, strict=True) if number == wanted)
        for wanted in dict.fromkeys(group)
    )


def can_cross_validate(capture: Capture, parameters: int) -> bool:
    """Whether without any one group a reference length is left, and enough poses for so many parameters."""
    groups = groups_of(capture)
    with_lengths = {group for group in groups if any(length.start in group for length in capture.lengths)}
    if len(with_lengths) < 2:
        return False
    poses = {group: sum(capture.sizes[capture.names.index(name)] - 1 for name in group) for group in groups}
    return 3 * (sum(poses.values()) - max(poses.values())) >= parameters


@checked_arguments
def cross_validate(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    *,
    method: Literal["two-stage", "joint"] = "two-stage",
    hold: str | None = "longest",
    noise: Noise | None = None,
) -> CrossValidation:
    """Calibrate once without each group of sockets that reference lengths join, and evaluate the result on that group.

    Where errors exceed what the uncertainty predicts, the model misses an effect (elastic joints, eccentric encoders)
    that poses similar to those identified from do not show.

    Args:
        arm: the nominal arm.
        capture: sockets and reference lengths.
        bounds: box of the free parameters ``(p,)``, mm and rad.
        method: as for `calibrate`.
        hold: the scale anchor of stage 1, as for `calibrate`.
        noise: standard deviations of readings and seat, as for `calibrate`.

    Returns:
        Errors of each group, found and predicted, mm.

    Raises:
        InputError: fewer than two groups hold a reference length, or too few poses are left without one of them.
    """
    check_sockets_only(capture, "cross-validation")
    if not can_cross_validate(capture, len(bounds.space.names)):
        raise InputError(
            "cross-validation leaves sockets out with their reference lengths, so it needs two groups of sockets that "
            "each hold a length, and without the largest of them poses enough for the parameters; place the reference "
            "length somewhere else too, or leave cross-validation out (--no-cross-validate)."
        )
    found = []
    for group in groups_of(capture):
        rest = _part(capture, tuple(name for name in capture.names if name not in group))
        result = calibrate(arm, rest, bounds, method=method, hold=hold, noise=noise, check_identifiability=False)
        left = _part(capture, group)
        found.append(_evaluated(uncertainty_of(result), left, group, bool(result.converged)))
    return CrossValidation(tuple(found))


def _part(capture: Capture, names: tuple[str, ...]) -> Capture:
    """Sockets by their exact names, which `Capture.select` would take for patterns."""
    lengths = [length for length in capture.lengths if length.start in names and length.end in names]
    return Capture({name: q for name, q in capture.sockets.items() if name in names}, lengths)


def _evaluated(uncertainty: Uncertainty, left: Capture, group: tuple[str, ...], converged: bool) -> LeftOut:
    evaluation = evaluate(uncertainty.arm, left)
    predicted, length_u = predicted_errors(uncertainty, left)
    return LeftOut(
        sockets=group,
        poses=sum(size for size in left.sizes if size > 1),
        rms=float(evaluation.repeatability.rms),
        rms_predicted=predicted,
        length_error=np.asarray(evaluation.error),
        length_u=length_u,
        converged=converged,
    )


def predicted_errors(uncertainty: Uncertainty, capture: Capture) -> tuple[float, Float[np.ndarray, " l"]]:
    """Predictions of an arm's uncertainty and the readings' noise for a capture that it was not identified from, mm:
    the RMS distance from the sockets' centroids, and the standard uncertainty of the error of every reference
    length."""
    uncertainty, capture = to_numpy((uncertainty, capture))
    arm, owner = uncertainty.arm, capture.owner
    sizes = np.asarray(capture.sizes, dtype=float)
    slopes = np.asarray(uncertainty.derivatives(capture.q))
    means = np.moveaxis(np.asarray(means_over_sockets(np.moveaxis(slopes, 0, -1), capture.sizes)), -1, 0)
    centred = slopes - means[owner]
    reading = np.asarray(tip_covariances(arm.geometry, sines_cosines(capture.q), uncertainty.noise))
    squares = np.trace(uncertainty.covariance_of_functions(centred), axis1=1, axis2=2)
    squares = squares + np.einsum("ccN->N", reading) * (1 - 1 / sizes[owner])
    scattered = sizes[owner] > 1
    centroids = means_over_sockets(np.asarray(arm.position(capture.q)).T, capture.sizes).T
    ends = capture.ends()
    between = centroids[ends[:, 1]] - centroids[ends[:, 0]]
    direction = between / np.linalg.norm(between, axis=1, keepdims=True)
    along = np.einsum("lc,lcp->lp", direction, means[ends[:, 1]] - means[ends[:, 0]])
    of_means = np.moveaxis(np.asarray(sums_over_sockets(reading, capture.sizes)) / sizes**2, -1, 0)
    scatter = np.einsum("lc,lcd,ld->l", direction, of_means[ends[:, 0]] + of_means[ends[:, 1]], direction)
    own = np.array([float(length.u) for length in capture.lengths])
    variance = np.asarray(uncertainty.covariance_of_functions(along[:, None, :]))[:, 0, 0] + scatter + own**2
    return math.sqrt(squares[scattered].mean()) if scattered.any() else math.nan, np.sqrt(variance)
