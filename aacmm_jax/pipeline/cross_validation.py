"""Cross-validation: the arm identified without some of the sockets or observations, and evaluated on those left out.

For many regions of joint space at little cost, `unseen_regions`: the calibration without a region is one Gauss-Newton
step away from the calibration of everything, by the normal equations less the region's part of them (case deletion:
Cook and Weisberg 1982, section 3.6). Weights and the learned standard deviations of the prior stay: a few numbers,
which one region hardly changes.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..calibration.agreement import CrossValidation, LeftOut
from ..calibration.evaluation import evaluate, fit_geometry
from ..calibration.pose_table import noise_of_poses
from ..calibration.prediction import unseen_errors
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..calibration.scale_anchor import fixes_scale
from ..calibration.task import without_lengths
from ..core.arguments import checked_arguments, items_of, with_options
from ..core.blas_threads import one_blas_thread
from ..core.errors import InputError
from ..core.linear_algebra import inverse_cholesky
from ..core.numpy_or_jax import to_numpy
from ..core.text import common_labels
from ..data.capture import Capture, names_in, part_of
from ..data.noise import Noise
from ..diagnostics.equations import Equations, equations_of
from ..diagnostics.pose_residuals import distances_of, rms
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds
from ..model.observed import Observed
from ..uncertainty.arm_uncertainty import Uncertainty
from .single import CalibrationOptions, calibrate, with_joint_model

_HALVINGS = 2  # of joint space into regions
_POSES_A_REGION = 10
_GROUPS = 3  # of placements or stations, fewer of which say nothing of the scatter between them
_POSES = 5  # in a region, at least
_MOVES = 0.02  # rad or mm: the least travel of a joint that has halves
_RIDGE = 1e-12  # of a unit diagonal
_NOTHING = 1e-12  # mm^2: what is fitted exactly has no error to compare


_Part = tuple[Capture, Capture, tuple[str, ...]]  # what remains, what is left out, and its names


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
        parts = _parts_of(capture)
        return len(parts) > 1 and all(_determines(rest, parameters) for rest, _, _ in parts)
    if sum(any(length.start in group for length in capture.lengths) for group in groups) < 2:
        return False
    poses = [sum(capture.sizes[capture.names.index(name)] - 1 for name in group) for group in groups]
    return 3 * (sum(poses) - max(poses)) >= parameters


def _parts_of(capture: Capture) -> list[_Part]:
    """Group by group or, of one group of observations only, by these where they divide one recording, or by regions of
    joint space."""
    groups = groups_of(capture)
    if len(groups) > 1 or not capture.observations:
        return _parts(capture, groups)
    # As the column of `group` in a manifest divides it, such as by parts of the workspace: all share all geometry.
    parts = {tuple(observation.unknowns) for observation in capture.observations}
    enough = not capture.sizes and all(len(o.q) >= _POSES_A_REGION for o in capture.observations)
    if len(parts) == 1 and enough and len(capture.observations) >= _GROUPS:
        return _parts(capture, [(observation.name,) for observation in capture.observations])
    if capture.sizes or any(len(o.q) < 2**_HALVINGS * _POSES_A_REGION for o in capture.observations):
        return []
    regions = [_regions(np.asarray(observation.q)) for observation in capture.observations]

    def only(number: int, inside: bool) -> Capture:
        pairs = zip(capture.observations, regions, strict=True)
        return Capture({}, [], [o.select(np.flatnonzero((region == number) == inside)) for o, region in pairs])

    of = f"{capture.observations[0].name}, " if len(capture.observations) == 1 else ""
    return [(only(i, False), only(i, True), (f"{of}region {i + 1}",)) for i in range(2**_HALVINGS)]


def _regions(q: Float[np.ndarray, "m n"]) -> np.ndarray:
    """A number for the region of joint space of each pose: halved again and again across its widest joint."""
    numbers = np.zeros(len(q), dtype=int)
    for count in 2 ** np.arange(_HALVINGS):
        for number in range(count):
            inside = np.flatnonzero(numbers == number)
            widest = int(np.argmax(np.ptp(q[inside], axis=0)))
            order = inside[np.argsort(q[inside, widest], kind="stable")]
            numbers[order[len(order) // 2 :]] += count
    return numbers


def _parts(capture: Capture, groups: Iterable[tuple[str, ...]]) -> list[_Part]:
    every = names_in(capture)
    rests = [tuple(name for name in every if name not in group) for group in groups]
    return [(part_of(capture, rest), part_of(capture, group), group) for rest, group in zip(rests, groups, strict=True)]


def _determines(capture: Capture, parameters: int) -> bool:
    """Whether the scale is determined, and enough rows are there for the parameters and the geometry."""
    observed = Observed.of(capture, None)
    return fixes_scale(capture) and observed.equations >= parameters + len(observed.steps)


@checked_arguments
@with_options(CalibrationOptions)
@one_blas_thread
def cross_validate(
    arm: Arm, capture: Capture, bounds: Bounds, *, groups: Iterable[str] | None = None, **options: Any
) -> CrossValidation:
    """Calibrate once without each group of sockets and observations, and evaluate the result on that group.

    A group is what reference lengths or a shared unknown geometry join: a placement, all that one station measured, a
    sphere. Where all is one group without sockets, such as the points of one station, its observations are left out
    one at a time, if there are at least three of at least ten poses each and all share the same geometry (parts of the
    workspace, by ``group`` in a manifest), or regions of joint space if not. The geometry of what was left out is
    fitted to the arm.

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
    count = len(bounds.space.names)
    if groups is not None:
        patterns = items_of(groups, "groups")
        chosen = [names_in(capture.select(pattern)) for pattern in patterns]
        for pattern, group in zip(patterns, chosen, strict=True):
            _check_some_left(pattern, len(group) < len(names_in(capture)))
        parts = _parts(capture, chosen)
        for pattern, (rest, _, _) in zip(patterns, parts, strict=True):
            if not _determines(rest, count):
                raise InputError(
                    f"without '{pattern}', no data fix the scale, or too few poses are left for the parameters; "
                    "leave out less."
                )
    elif can_cross_validate(capture, count):
        parts = _parts_of(capture)
    elif capture.observations and not capture.sizes and len(groups_of(capture)) == 1:
        raise InputError(
            f"cross-validation of one observation holds out {2**_HALVINGS} regions of joint space, which needs at "
            f"least {2**_HALVINGS * _POSES_A_REGION} poses, and enough of them without any region; record "
            "more poses, or turn cross-validation off (--no-cross-validate)."
        )
    else:
        raise InputError(
            "cross-validation holds out sockets together with their reference lengths, so at least two groups of "
            "sockets must each contain a reference length (or observations that fix the scale), and the poses "
            "without the largest group must be enough for the parameters; measure the reference length in another "
            "place too, or turn cross-validation off (--no-cross-validate)."
        )
    left_out = []
    for rest, left, names in parts:
        result = calibrate(arm, rest, bounds, **given._asdict())
        left_out.append(left_out_group(uncertainty_of(to_numpy(result)), left, bool(result.converged), names, arm))
    return CrossValidation(tuple(left_out))


def left_out_group(
    uncertainty: Uncertainty,
    left: Capture,
    converged: bool,
    names: tuple[str, ...] | None = None,
    nominal: Arm | None = None,
) -> LeftOut:
    """How a calibrated arm, and the nominal one, agree with a capture that the arm was not identified from, under its
    names or others."""
    errors = unseen_errors(uncertainty, left)
    poses, lengths = errors.of(errors.parts), errors.of_lengths()
    of_lengths, of_noise = lengths.degrees_of_freedom, errors.noise_degrees_of_freedom
    columns = poses.count, poses.rms, poses.predicted, errors.length_error, errors.length_u, converged
    by_nominal = None if nominal is None else rms_by(nominal, left, noise_of_poses(uncertainty))
    freedom, distances = (poses.degrees_of_freedom, of_lengths, of_noise), np.concatenate([*errors.distances.values()])
    return LeftOut(names or names_in(left), *columns, *freedom, by_nominal, distances)


def rms_by(arm: Arm, left: Capture, noise: Noise) -> float | None:
    """RMS distance of poses from the geometry that fits an arm best in them, mm, without sockets of one pose; None
    where there is no other."""
    left = without_lengths(left)
    by_part = enumerate(distances_by(arm, left, left, noise))
    counted = [distances for i, distances in by_part if len(distances) > 1 or i >= len(left.sizes)]
    return rms(np.concatenate(counted)) if counted else None


def distances_by(arm: Arm, fitted: Capture, poses: Capture, noise: Noise | None) -> tuple[Float[np.ndarray, " m"], ...]:
    """Distances of poses, mm, of each socket, then of each observation, from the geometry that fits an arm best in the
    poses of ``fitted``."""
    arm, fitted, poses = to_numpy((arm, fitted, poses))
    observed = to_numpy(Observed.of(fitted, arm, lengths=False))
    geometry = observed.split(np.asarray(fit_geometry(arm, observed, {}, noise).geometry))
    return distances_of(poses, evaluate(arm, poses, geometry=geometry))


def _check_some_left(pattern: str, some: bool) -> None:
    if not some:
        raise InputError(f"'{pattern}' leaves out all data, so no data are left to calibrate from; leave out less.")


Region = Bool[np.ndarray, " M"]  # poses that are left out together; of all, sockets first


class UnseenRegion(NamedTuple):
    """Errors of the poses of a region, of a calibration without it."""

    label: str
    poses: int
    mean_square: float  # distance from the geometry, mm^2
    ratio: float  # mean of (error / predicted standard deviation)^2 over coordinates


def regions_of(capture: Capture, patterns: Iterable[str] | None = None, joints: int | None = None) -> dict[str, Region]:
    """The regions to leave out: groups by name; or placements, stations and the like, where there are at least three;
    or either half of each joint's travel, of the first ``joints`` columns of readings.

    Raises:
        InputError: A pattern names nothing or everything, or there are too few poses.
    """
    sizes = [*capture.sizes, *(observation.q.shape[0] for observation in capture.observations)]
    owner, groups = np.repeat(np.array(names_in(capture)), sizes), groups_of(capture)
    if patterns is not None:
        members = {pattern: names_in(capture.select(pattern)) for pattern in items_of(patterns, "regions")}
        regions = {pattern: np.isin(owner, group) for pattern, group in members.items()}
    elif len(groups) >= _GROUPS:
        labelled = zip(common_labels(groups), groups, strict=True)
        regions = {label: np.isin(owner, group) for label, group in labelled}
    else:
        q, regions = np.asarray(capture.readings)[:, :joints], {}
        for joint in np.flatnonzero(np.ptp(q, axis=0) > _MOVES):
            upper = q[:, joint] >= np.median(q[:, joint])
            regions |= {f"joint {joint + 1}, lower half": ~upper, f"joint {joint + 1}, upper half": upper}
    for label, poses in regions.items():
        _check_some_left(label, not poses.all())
    regions = {label: poses for label, poses in regions.items() if _POSES <= poses.sum() <= len(owner) - _POSES}
    if len(regions) < 2:
        raise InputError(
            "models are compared on regions that are held out, but these poses form fewer than two regions; record "
            "more poses."
        )
    return regions


class _Dense(NamedTuple):
    """All equations of a calibration, by all unknowns: what is shared, then the geometry of each observation."""

    white: Float[np.ndarray, "R P"]  # derivatives of all rows of poses, in standard deviations
    residual: Float[np.ndarray, " R"]
    pose: np.ndarray  # of each row, its number among all poses
    moved: Float[np.ndarray, "M3 P"]  # derivatives of the position of each pose, mm
    errors: Float[np.ndarray, " M3"]
    noise: Float[np.ndarray, "M 3 3"]  # its covariance
    poses: np.ndarray  # the number of each among all poses
    relations: Float[np.ndarray, "l P"]
    relation_residual: Float[np.ndarray, " l"]
    geometry: Bool[np.ndarray, " P"]  # which unknowns are no parameters


def _dense(equations: Equations, parameters: int) -> _Dense:
    first = shared = equations.rows[0].shared.shape[2]
    size, parts = shared + sum(rows.private.shape[2] for rows in equations.rows), []
    for rows in equations.rows:
        (m, r), k = rows.residual.shape, rows.private.shape[2]
        white = np.zeros((m, r, size))
        white[..., :shared], white[..., first : first + k] = rows.shared, rows.private
        first += k
        in_mm = np.pad(rows.in_mm, ((0, 0), (0, 3 - rows.in_mm.shape[1]), (0, 0)))  # of fewer rows a pose
        parts.append((
            *(white.reshape(-1, size), rows.residual.ravel(), np.repeat(rows.poses, r)),
            (in_mm @ white).reshape(-1, size),
            np.einsum("mcr,mr->mc", in_mm, rows.residual).ravel(),
            *(in_mm @ in_mm.swapaxes(1, 2), rows.poses),
        ))  # fmt: skip
    relations = [np.pad(block.shared, ((0, 0), (0, size - shared))) for block in equations.relations]
    return _Dense(
        *(np.concatenate(part) for part in zip(*parts, strict=True)),
        relations=np.concatenate([np.zeros((0, size)), *relations]),
        relation_residual=np.concatenate([np.zeros(0), *(block.residual for block in equations.relations)]),
        geometry=np.arange(size) >= parameters,
    )


def unseen_regions(
    record: CalibrationRecord, regions: Mapping[str, Region], equations: Equations | None = None
) -> tuple[UnseenRegion, ...]:
    """Errors of each region, of a calibration without it; geometry that only the region shows is fitted to its poses.

    Of a calibration of everything, with observations or a prior. Reference lengths with an end that only the region
    shows are left out with it.
    """
    equations = equations_of(record) if equations is None else equations
    dense = _dense(equations, len(record.names) - (record.hold is not None))
    whole = dense.white.T @ dense.white, dense.white.T @ dense.residual
    return tuple(_without(dense, *whole, *region) for region in regions.items())


def _without(
    dense: _Dense, gram: Float[np.ndarray, "P P"], gradient: Float[np.ndarray, " P"], label: str, region: Region
) -> UnseenRegion:
    out, left = region[dense.pose], region[dense.poses]
    gone = dense.white[out]
    lost = dense.geometry & ~np.any(dense.white[~out] != 0, axis=0)
    kept = ~lost
    related = ~np.any(dense.relations[:, lost] != 0, axis=1)
    rows, values = dense.relations[related][:, kept], dense.relation_residual[related]
    information = (gram - gone.T @ gone)[np.ix_(kept, kept)] + rows.T @ rows
    slope = (gradient - gone.T @ dense.residual[out])[kept] + rows.T @ values
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    root = inverse_cholesky(scale[:, None] * information * scale + _RIDGE * np.eye(len(scale))) * scale
    step = -root.T @ (root @ slope)
    moved, noise = dense.moved[np.repeat(left, 3)], dense.noise[left]
    errors, of_parameters = dense.errors[np.repeat(left, 3)] + moved[:, kept] @ step, moved[:, kept] @ root.T
    variance = np.diagonal(noise, axis1=1, axis2=2).ravel()
    if lost.any():
        basis, sizes, _ = np.linalg.svd(moved[:, lost], full_matrices=False)
        basis = basis[:, sizes > 1e-9 * sizes.max(initial=1e-300)]
        errors = errors - basis @ (basis.T @ errors)
        of_parameters = of_parameters - basis @ (basis.T @ of_parameters)
        crossed = (noise @ basis.reshape(len(noise), 3, -1)).reshape(basis.shape)
        variance = variance + np.sum(basis * (basis @ (basis.T @ crossed) - 2 * crossed), axis=1)
    variance = variance + np.sum(of_parameters**2, axis=1)
    seen = variance > _NOTHING
    poses = int(seen.reshape(-1, 3).any(axis=1).sum())
    ratio = float(np.mean(errors[seen] ** 2 / variance[seen])) if poses else np.nan
    return UnseenRegion(label, poses, float(np.sum(errors[seen] ** 2)) / max(poses, 1), ratio)
