"""How a calibration without a region of joint space predicts that region, for many regions at little cost.

The calibration without it is one Gauss-Newton step away from the calibration of everything, by the normal equations
less the region's part of them (case deletion: Cook and Weisberg 1982, section 3.6). Weights and the learned standard
deviations of the prior stay: a few numbers, which one region hardly changes.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..calibration.record import CalibrationRecord
from ..core.arguments import items_of
from ..core.errors import InputError
from ..core.linear_algebra import inverse_cholesky
from ..core.text import common_labels
from ..data.capture import Capture, names_in
from ..diagnostics.equations import Equations, equations_of
from .cross_validation import groups_of

_GROUPS = 3  # of placements or stations, fewer of which say nothing of the scatter between them
_POSES = 5  # in a region, at least
_MOVES = 0.02  # rad or mm: the least travel of a joint that has halves
_RIDGE = 1e-12  # of a unit diagonal
_NOTHING = 1e-12  # mm^2: what is fitted exactly has no error to compare


class Region(NamedTuple):
    """Poses that are left out together."""

    label: str
    poses: Bool[np.ndarray, " M"]  # of all, sockets first


class UnseenRegion(NamedTuple):
    """Errors of the poses of a region, of a calibration without it."""

    label: str
    poses: int
    mean_square: float  # distance from the geometry, mm^2
    ratio: float  # mean of (error / predicted standard deviation)^2 over coordinates


def regions_of(
    capture: Capture, patterns: Iterable[str] | None = None, joints: int | None = None
) -> tuple[Region, ...]:
    """The regions to leave out: groups by name; or placements, stations and the like, where there are at least three;
    or either half of each joint's travel, of the first ``joints`` columns of readings.

    Raises:
        InputError: A pattern names nothing or everything, or there are too few poses.
    """
    names = names_in(capture)
    sizes = [*capture.sizes, *(observation.q.shape[0] for observation in capture.observations)]
    owner = np.repeat(np.array(names), sizes)
    if patterns is not None:
        members = {pattern: names_in(capture.select(pattern)) for pattern in items_of(patterns, "regions")}
        regions = [Region(pattern, np.isin(owner, group)) for pattern, group in members.items()]
    elif len(groups := groups_of(capture)) >= _GROUPS:
        labelled = zip(common_labels(groups), groups, strict=True)
        regions = [Region(label, np.isin(owner, group)) for label, group in labelled]
    else:
        regions = _halves(np.asarray(capture.readings)[:, :joints])
    whole = [region.label for region in regions if region.poses.all()]
    if whole:
        raise InputError(f"nothing is left without '{whole[0]}', so nothing can be calibrated; leave out less.")
    regions = [region for region in regions if _POSES <= region.poses.sum() <= len(owner) - _POSES]
    if len(regions) < 2:
        raise InputError(
            "models are compared by regions that they have not seen, and these poses make fewer than two; record more."
        )
    return tuple(regions)


def _halves(q: Float[np.ndarray, "M n"]) -> list[Region]:
    halves = []
    for joint in np.flatnonzero(np.ptp(q, axis=0) > _MOVES):
        upper = q[:, joint] >= np.median(q[:, joint])
        halves += [Region(f"joint {joint + 1}, lower half", ~upper), Region(f"joint {joint + 1}, upper half", upper)]
    return halves


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
    size, parts = shared + sum(rows.own.shape[2] for rows in equations.rows), []
    for rows in equations.rows:
        (m, r), k = rows.residual.shape, rows.own.shape[2]
        white = np.zeros((m, r, size))
        white[..., :shared], white[..., first : first + k] = rows.shared, rows.own
        first += k
        parts.append((
            *(white.reshape(-1, size), rows.residual.ravel(), np.repeat(rows.poses, r)),
            (rows.in_mm @ white).reshape(-1, size),
            np.einsum("mcr,mr->mc", rows.in_mm, rows.residual).ravel(),
            *(rows.in_mm @ rows.in_mm.swapaxes(1, 2), rows.poses),
        ))  # fmt: skip
    relations = [np.pad(block.shared, ((0, 0), (0, size - shared))) for block in equations.relations]
    return _Dense(
        *(np.concatenate(part) for part in zip(*parts, strict=True)),
        relations=np.concatenate([np.zeros((0, size)), *relations]),
        relation_residual=np.concatenate([np.zeros(0), *(block.residual for block in equations.relations)]),
        geometry=np.arange(size) >= parameters,
    )


def unseen_regions(
    record: CalibrationRecord, regions: Iterable[Region], equations: Equations | None = None
) -> tuple[UnseenRegion, ...]:
    """Errors of each region, of a calibration without it; geometry that only the region shows is fitted to its poses.

    Of a calibration of everything, with observations or a prior. Reference lengths with an end that only the region
    shows are left out with it.
    """
    dense = _dense(
        equations_of(record) if equations is None else equations, len(record.names) - (record.hold is not None)
    )
    whole = dense.white.T @ dense.white, dense.white.T @ dense.residual
    return tuple(_without(dense, *whole, region) for region in regions)


def _without(
    dense: _Dense, gram: Float[np.ndarray, "P P"], gradient: Float[np.ndarray, " P"], region: Region
) -> UnseenRegion:
    out, left = region.poses[dense.pose], region.poses[dense.poses]
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
    return UnseenRegion(region.label, poses, float(np.sum(errors[seen] ** 2)) / max(poses, 1), ratio)
