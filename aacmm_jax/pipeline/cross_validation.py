"""Cross-validation: the arm identified without some of the sockets or observations, and evaluated on those left out."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from ..calibration.joint_model import with_joint_model
from ..calibration.left_out import CrossValidation, LeftOut
from ..calibration.prediction import unseen_errors
from ..calibration.record import uncertainty_of
from ..calibration.results import Calibration
from ..core.arguments import checked_arguments, items_of, with_options
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture, names_in, part_of
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds
from ..model.observed import Observed
from .single import CalibrationOptions, calibrate

_REGIONS = 4  # a power of two
_POSES_A_REGION = 10


def groups_of(capture: Capture) -> tuple[tuple[str, ...], ...]:
    """Names of sockets and observations that are left out together: those that reference lengths join, and those that
    share an unknown geometry, such as the frame of a station."""
    names = names_in(capture)
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
        return _parts(capture, groups)
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
    observed = Observed.of(capture, None)
    return fixed and observed.equations >= parameters + len(observed.steps)


@checked_arguments
@with_options(CalibrationOptions)
def cross_validate(
    arm: Arm, capture: Capture, bounds: Bounds, *, groups: Iterable[str] | None = None, **options: Any
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
        groups: what to leave out instead, each as a name or a shell pattern: ``["monday/*", "tuesday/*"]``.
        options: as for `calibrate`, like all arguments that are not named here; nothing is said of what data do not
            determine, and bad poses of what is left out count in full, whatever the loss is.

    Returns:
        Errors of each group, found and predicted, mm.

    Raises:
        InputError: fewer than two groups determine the scale, or too few poses are left without one of them.

    Example:
        >>> left_out = aj.cross_validate(arm, two_bars, bounds)
        >>> print(left_out.labels)
        ['A, B', 'C, D']
        >>> print(f"error {left_out.rms:.3f} mm, predicted {left_out.rms_predicted:.3f} mm")
        error 0.016 mm, predicted 0.016 mm
    """
    given = CalibrationOptions(**options)
    arm, bounds, prior = with_joint_model(arm, capture, bounds, given.model, given.prior)
    given = given._replace(model=None, prior=prior, undetermined="ignore")
    if groups is not None:
        parts = _chosen(capture, groups, len(bounds.space.names))
    elif can_cross_validate(capture, len(bounds.space.names)):
        parts = _observed_parts(capture) if capture.observations else _parts(capture, groups_of(capture))
    else:
        raise InputError(
            "cross-validation leaves sockets out with their reference lengths, so it needs two groups of sockets that "
            "each hold a length (or observations that fix the scale), and without the largest of them poses enough for "
            "the parameters; place the reference length somewhere else too, or leave cross-validation out "
            "(--no-cross-validate)."
        )
    return CrossValidation(
        tuple(_left_out(calibrate(arm, rest, bounds, **given._asdict()), left, group) for rest, left, group in parts)
    )


def _parts(capture: Capture, groups: Iterable[tuple[str, ...]]) -> list[tuple[Capture, Capture, tuple[str, ...]]]:
    """What remains, what is left out, and its names, group by group."""
    every = names_in(capture)
    return [
        (part_of(capture, tuple(name for name in every if name not in group)), part_of(capture, group), group)
        for group in groups
    ]


def _chosen(
    capture: Capture, patterns: Iterable[str], parameters: int
) -> list[tuple[Capture, Capture, tuple[str, ...]]]:
    """The same of groups by name, or `InputError` where one leaves too little."""
    given = items_of(patterns, "groups")
    groups = [names_in(capture.select(pattern)) for pattern in given]
    for pattern, group in zip(given, groups, strict=True):
        if len(group) == len(names_in(capture)):
            raise InputError(f"nothing is left without '{pattern}', so nothing can be calibrated; leave out less.")
    parts = _parts(capture, groups)
    for pattern, (rest, _, _) in zip(given, parts, strict=True):
        if not _determines(rest, parameters):
            raise InputError(
                f"without '{pattern}' nothing fixes the scale, or too few poses are left for the parameters; leave out "
                "less."
            )
    return parts


def _left_out(result: Calibration, left: Capture, names: tuple[str, ...]) -> LeftOut:
    """How a calibration without a group agrees with it."""
    found = unseen_errors(uncertainty_of(to_numpy(result)), left)
    poses, lengths = found.of(found.parts), found.of_lengths()
    return LeftOut(
        sockets=names,
        poses=poses.count,
        rms=poses.rms,
        rms_predicted=poses.predicted,
        length_error=found.length_error,
        length_u=found.length_u,
        converged=bool(result.converged),
        rms_degrees_of_freedom=poses.degrees_of_freedom,
        length_degrees_of_freedom=lengths.degrees_of_freedom,
        noise_degrees_of_freedom=found.noise_degrees_of_freedom,
    )
