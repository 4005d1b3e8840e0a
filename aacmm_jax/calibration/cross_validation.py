"""Cross-validation: the arm identified without some of the sockets or observations, and evaluated on those left out."""

import math
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..core.arguments import checked_arguments
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..data.noise import Noise, tip_covariances
from ..data.observations.observation import AbstractObservation
from ..data.observations.socket import Socket
from ..kinematics.arm import Arm
from ..kinematics.chain import sines_cosines
from ..kinematics.parameters import Bounds
from ..model.observed import Observed
from ..model.socket_sums import means_over_sockets, sums_over_sockets
from ..uncertainty.arm_uncertainty import Uncertainty
from .evaluation import evaluate
from .observed_evaluation import predicted_residuals
from .record import uncertainty_of
from .results import CrossValidation, LeftOut
from .single import calibrate

_REGIONS = 4  # a power of two
_POSES_A_REGION = 10


def groups_of(capture: Capture) -> tuple[tuple[str, ...], ...]:
    """Names of sockets and observations that are left out together: those that reference lengths join, and those that
    share an unknown geometry, such as the frame of a station."""
    names = [*capture.names, *(observation.name for observation in capture.observations)]
    shared: dict[str, list[str]] = {}
    for observation in capture.observations:
        for part in set(observation.unknowns) - set(observation.certified):
            shared.setdefault(part, []).append(observation.name)
    pairs = [(length.start, length.end) for length in capture.lengths]
    pairs += [(users[0], other) for users in shared.values() for other in users[1:]]
    group = {name: number for number, name in enumerate(names)}
    for start, end in pairs:
        old, new = group[end], group[start]
        group = {name: new if number == old else number for name, number in group.items()}
    return tuple(tuple(name for name in names if group[name] == wanted) for wanted in dict.fromkeys(group.values()))


def can_cross_validate(capture: Capture, parameters: int) -> bool:
    """Whether without any one group the scale is determined, and enough poses are left for so many parameters."""
    groups = groups_of(capture)
    if capture.observations:
        parts = _observed_parts(capture)
        return len(parts) > 1 and all(_determines(rest, parameters) for rest, _, _ in parts)
    with_lengths = {group for group in groups if any(length.start in group for length in capture.lengths)}
    if len(with_lengths) < 2:
        return False
    poses = {group: sum(capture.sizes[capture.names.index(name)] - 1 for name in group) for group in groups}
    return 3 * (sum(poses.values()) - max(poses.values())) >= parameters


def _observed_parts(capture: Capture) -> list[tuple[Capture, Capture, tuple[str, ...]]]:
    """What remains, what is left out, and its names: group by group or, of one group only, region by region."""
    groups = groups_of(capture)
    if len(groups) > 1:
        every = [name for group in groups for name in group]
        return [
            (part_of(capture, tuple(name for name in every if name not in group)), part_of(capture, group), group)
            for group in groups
        ]
    if capture.sizes or any(len(o.q) < _REGIONS * _POSES_A_REGION for o in capture.observations):
        return []
    regions = [_regions(np.asarray(observation.q)) for observation in capture.observations]

    def only(number: int, inside: bool) -> Capture:
        chosen = [
            observation.select(np.flatnonzero((region == number) == inside))
            for observation, region in zip(capture.observations, regions, strict=True)
        ]
        return Capture({}, [], chosen)

    return [
        (only(i, False), only(i, True), tuple(f"{o.name}, region {i + 1}" for o in capture.observations))
        for i in range(_REGIONS)
    ]


def _regions(q: Float[np.ndarray, "m n"]) -> np.ndarray:
    """A number for the region of joint space of each pose: halved again and again across its widest joint."""
    numbers = np.zeros(len(q), dtype=int)
    regions = 1
    while regions < _REGIONS:
        for number in range(regions):
            inside = np.flatnonzero(numbers == number)
            widest = int(np.argmax(np.ptp(q[inside], axis=0)))
            order = inside[np.argsort(q[inside, widest], kind="stable")]
            numbers[order[len(order) // 2 :]] += regions
        regions *= 2
    return numbers


def _determines(capture: Capture, parameters: int) -> bool:
    """Whether the scale is determined, and enough rows are there for the parameters and the geometry."""
    fixed = bool(capture.lengths) or any(observation.fixes_scale for observation in capture.observations)
    observed = Observed.of(capture)
    return fixed and observed.equations >= parameters + len(observed.steps)


@checked_arguments
def cross_validate(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    *,
    method: Literal["two-stage", "joint"] | None = None,
    hold: str | None = "longest",
    noise: Noise | None = None,
) -> CrossValidation:
    """Calibrate once without each group of sockets and observations, and evaluate the result on that group.

    A group is what reference lengths or a shared unknown geometry join: a placement, all that one station measured, a
    sphere. Where all is one group without sockets, such as the points of one station, regions of joint space are left
    out instead. The geometry of what was left out is fitted to the arm.

    Where errors exceed what the uncertainty predicts, the model misses an effect (elastic joints, eccentric encoders)
    that poses similar to those identified from do not show.

    Args:
        arm: the nominal arm.
        capture: sockets, reference lengths and other observations.
        bounds: box of the free parameters ``(p,)``, mm and rad.
        method: as for `calibrate`.
        hold: the scale anchor of stage 1, as for `calibrate`.
        noise: standard deviations of readings and seat, as for `calibrate`.

    Returns:
        Errors of each group, found and predicted, mm.

    Raises:
        InputError: fewer than two groups determine the scale, or too few poses are left without one of them.
    """
    if not can_cross_validate(capture, len(bounds.space.names)):
        raise InputError(
            "cross-validation leaves sockets out with their reference lengths, so it needs two groups of sockets that "
            "each hold a length (or observations that fix the scale), and without the largest of them poses enough for "
            "the parameters; place the reference length somewhere else too, or leave cross-validation out "
            "(--no-cross-validate)."
        )
    if capture.observations:
        parts = _observed_parts(capture)
        return CrossValidation(tuple(_left_out(arm, *part, bounds, noise) for part in parts))
    found = []
    for group in groups_of(capture):
        rest = part_of(capture, tuple(name for name in capture.names if name not in group))
        result = calibrate(arm, rest, bounds, method=method, hold=hold, noise=noise, check_identifiability=False)
        left = part_of(capture, group)
        found.append(_evaluated(uncertainty_of(result), left, group, bool(result.converged)))
    return CrossValidation(tuple(found))


def part_of(capture: Capture, names: tuple[str, ...]) -> Capture:
    """Sockets and observations by their exact names, which `Capture.select` would take for patterns."""
    lengths = [length for length in capture.lengths if length.start in names and length.end in names]
    others = [observation for observation in capture.observations if observation.name in names]
    sockets = {name: q for name, q in capture.sockets.items() if name in names}
    return Capture(sockets, lengths, others, sessions=capture.sessions)


def _left_out(
    arm: Arm, rest: Capture, left: Capture, group: tuple[str, ...], bounds: Bounds, noise: Noise | None
) -> LeftOut:
    """A calibration from observations without a group, tried on it."""
    result = calibrate(arm, rest, bounds, noise=noise, check_identifiability=False)
    uncertainty, observed = to_numpy((uncertainty_of(result), Observed.of(left)))
    found = evaluate(uncertainty.arm, left if left.observations else _as_observed(left), noise=uncertainty.noise)
    assert found.observed is not None
    predicted = predicted_residuals(uncertainty, observed)
    distances = [np.sum(np.asarray(residuals)[:3] ** 2, axis=0) for residuals in found.observed.residuals]
    return LeftOut(
        sockets=group,
        poses=len(observed.q),
        rms=float(np.sqrt(np.concatenate(distances).mean())),
        rms_predicted=predicted.rms,
        length_error=np.asarray(found.error),
        length_u=predicted.length_u,
        converged=bool(result.converged),
    )


def _as_observed(capture: Capture) -> Capture:
    """The same with its sockets among the observations."""
    sockets: list[AbstractObservation] = [Socket(name, q) for name, q in capture.sockets.items()]
    return Capture({}, capture.lengths, sockets)


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
