"""The residual of every pose by a calibrated arm, beside the standard uncertainty that is predicted for it.

With rows in standard deviations of the noise, A their derivatives by the parameters less what the geometry follows of
them, G those by the geometry, C the covariance of the parameters and F that of the geometry for given parameters, the
rows of a pose have the covariance I + A C A^T + G F G^T where neither the arm nor the geometry was fitted to it. Where
both were, it is I - A S A^T - G F G^T, with the inverse S of the information that these rows have on the parameters;
functions of the readings that the model lacks add what the parameters do not follow of them.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.arrays import Numbers
from ..core.linear_algebra import rows_times
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.observations.observation import OTHER_UNITS
from ..data.observations.pixels import Pixels
from ..model.elimination import followed
from ..model.layout import unknowns_of
from ..model.observed import Observed
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.kept_geometry import KeptGeometry, fitted_geometry, head_of
from ..uncertainty.linearisation import Linearisation, ObservationRows
from ..uncertainty.shared_kinds import SUCCESSIVE, VISITS
from .evaluation import fit_geometry
from .reprojection import reprojection
from .task import without_lengths

USED, HELD_OUT = "used", "held out"
_NULL = 1e-10  # eigenvalues of the information on the parameters below this, of the largest, are zero
_LEAST = 1e-6  # mm: smallest standard uncertainty of what is certified


class PoseResiduals(NamedTuple):
    """Residuals pose by pose; m poses.

    Example:
        >>> rows = aj.residuals_of(record)
        >>> print(rows.observation[0], rows.pose[0], rows.use[0], f"{rows.distance[0]:.3f} mm")
        A 1 used 0.013 mm
    """

    observation: tuple[str, ...]  # socket or other observation of each pose
    pose: Int[np.ndarray, " m"]  # its number there, from 1, held-out poses included
    use: tuple[str, ...]  # "used" or "held out"
    residual: Float[np.ndarray, "m 3"]  # in the base frame, mm; of a distance or plane, along what it measures
    distance: Float[np.ndarray, " m"]  # of the tip from the geometry, mm; NaN for the only pose of a socket
    angle: Float[np.ndarray, " m"]  # size of the residuals that are measured in rad; NaN where there are none
    pixels: Float[np.ndarray, " m"]  # of those in px: root mean square distance of the corners of an image
    u: Float[np.ndarray, " m"]  # predicted standard uncertainty of ``distance``, mm

    def select(self, rows: Numbers) -> "PoseResiduals":
        """Some of the poses, by index or mask."""
        chosen = np.arange(len(self.pose))[np.asarray(rows)]
        return PoseResiduals._make(
            column[chosen] if isinstance(column, np.ndarray) else tuple(column[i] for i in chosen) for column in self
        )

    def used_as(self, use: str) -> "PoseResiduals":
        """The poses that were used, or those that were held out."""
        return self.select(np.array(self.use, dtype=str) == use)


def residuals_by_pose(
    uncertainty: Uncertainty, capture: Capture, used: Bool[np.ndarray, " m"], geometry: Mapping[str, Numbers]
) -> PoseResiduals:
    """The residual of every pose of a capture by a calibrated arm, found and predicted.

    Args:
        uncertainty: the calibrated arm and its uncertainty, from `uncertainty_of`.
        capture: its poses, the used and the held-out ones.
        used: which poses the arm was calibrated with, sockets first.
        geometry: parts of the unknown geometry that the calibration found, which the held-out poses are compared with;
            the others are fitted to the arm.

    Returns:
        The residuals in the order of the capture; poses are numbered within it.
    """
    model, uncertainty = len(uncertainty.names), to_numpy(to_numpy(uncertainty).complete)
    kept_names = () if uncertainty.kept is None else uncertainty.kept.names
    observed = to_numpy(Observed.of(without_lengths(capture), uncertainty.arm, shared=kept_names))
    held = None if uncertainty.kept is None else uncertainty.kept.select(observed.blocks)
    geometry = geometry if held is None else {**geometry, **held.parts}
    noise, space = noise_of_poses(uncertainty), uncertainty.space
    given = {name: np.asarray(geometry[name], dtype=float) for name in observed.blocks if name in geometry}
    if len(given) < len(observed.blocks):
        numbers = np.asarray(fit_geometry(uncertainty.arm, observed, given, noise).geometry)
    else:
        numbers = np.concatenate([given[name] for name in observed.blocks])
    z = np.concatenate([np.asarray(space.vector()), numbers])
    linear = Linearisation.at(observed, space, z, noise=noise, least=_LEAST)
    # What the geometry that is kept is known from: not the held-out poses.
    kept = np.array([all(name in given for name in unknowns_of(part)) for part in observed.observations])
    fitted = used | ~np.repeat(kept, [part.q.shape[0] for part in observed.observations])
    weights = [np.concatenate([fitted[observed.slices[number]] for number in group.members]).astype(float)
               for group in observed.layout.groups]  # fmt: skip
    linear = linear._replace(weights=[*weights, *linear.weights[len(weights) :]])
    *derivatives, information = _derivatives(linear, held)
    of_used = _covariance_of_used(uncertainty, information[:model, :model])
    of_kept = np.zeros((0, 0)) if held is None else np.asarray(held.covariance)
    rows, found = [], observed.split(numbers)
    for part, by_parameters, by_geometry in zip(linear.parts(), *derivatives, strict=True):
        masks = used[part.poses], fitted[part.poses]
        derivatives = np.asarray(by_parameters), np.asarray(by_geometry)
        of_part = _of_part((uncertainty, of_used, of_kept), part, masks, *derivatives)
        if isinstance(part.observation, Pixels):  # of the corners themselves
            of_part = of_part._replace(pixels=reprojection(uncertainty.arm, part.observation, found).rms_by_image)
        rows.append(of_part)
    return _concatenated(rows)


def _covariance_of_used(uncertainty: Uncertainty, information: Float[np.ndarray, "q q"]) -> Float[np.ndarray, "p p"]:
    """What is added to the covariance of used poses: less S; and that of the functions that the model lacks, the last
    parameters of the complete uncertainty, with what the parameters follow of them."""
    covariance, model = np.asarray(uncertainty.covariance), len(information)
    fitted = np.zeros_like(covariance)
    steps = np.asarray(uncertainty.space.scale)[:model]
    fitted[:model, :model] = np.outer(steps, steps) * np.linalg.pinv(information, rcond=_NULL, hermitian=True)
    moments = covariance[model:, model:]
    follow = np.concatenate([covariance[:model, model:] @ np.linalg.pinv(moments), np.eye(len(moments))])
    return follow @ moments @ follow.T - fitted


def noise_of_poses(uncertainty: Uncertainty) -> Noise:
    """The noise of poses that were not calibrated with, in which what the poses of a visit share counts as seating."""
    noise, shared = uncertainty.noise, uncertainty.shared
    if shared is None:
        return noise
    return eqx.tree_at(lambda n: n.seating, noise, np.hypot(noise.seating, shared.sd_of(VISITS, SUCCESSIVE)))


def _derivatives(linear: Linearisation, kept: KeptGeometry | None) -> tuple[list[AnyArray], list[AnyArray], np.ndarray]:
    """Of the whitened rows of each observation, with the poses last: A, by mm and rad of the numbers that are kept and
    of the parameters; and G times a root of F. And the information on the parameters, in natural steps."""
    influence, observed, head = linear.influence(), linear.observed, head_of(linear, kept)
    root, follow = fitted_geometry(influence, head)
    by_parameters, by_geometry = [], []
    for number in range(len(observed.layout.groups)):
        fitted, given = head.split(np.asarray(influence.rows[number]))
        by_parameters.append(given - np.einsum("gp,grm->prm", follow, fitted))
        of_geometry, own = [np.einsum("gb,grm->brm", root, fitted)], influence.own_rows(number)
        if own is not None:
            block = influence.blocks[number]
            values, vectors = np.linalg.eigh(np.asarray(influence.d_inverses[block.class_index]))
            roots = np.sqrt(np.maximum(values, 0.0))[:, None, :] * vectors
            of_geometry.append(np.asarray(followed(np.asarray(own), roots, block.sizes)))
        by_geometry.append(np.concatenate(of_geometry))
    steps, information = np.asarray(linear.space.scale), np.asarray(influence.information) @ head.given
    whole = head.given.T @ information - information[head.fitted].T @ follow
    on_parameters = np.outer(steps, steps) * whole[-len(steps) :, -len(steps) :]
    return observed.by_observation(by_parameters), observed.by_observation(by_geometry), on_parameters


def _of_part(
    covariances: tuple[Uncertainty, Float[np.ndarray, "p p"], Float[np.ndarray, "k k"]],
    part: ObservationRows,
    masks: tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " m"]],
    by_parameters: Float[np.ndarray, "q r m"],
    by_geometry: Float[np.ndarray, "g r m"],
) -> PoseResiduals:
    """The poses of one observation. ``covariances`` are those of the parameters for held-out and for used poses, and of
    the geometry that is kept; ``masks`` the poses that the arm, and those that the geometry was fitted to."""
    observation, by_tip, (used, fitted) = part.observation, np.asarray(part.by_tip), masks
    values, m = np.asarray(part.values), len(used)
    position, moved = (np.asarray(observation.in_mm(rows, by_tip)) for rows in (values, by_tip))
    to_mm = np.moveaxis(np.linalg.inv(np.asarray(part.root)), 0, -1)
    to_mm = np.moveaxis(np.asarray(observation.in_mm(to_mm, by_tip)), -1, 0)
    a, g = np.moveaxis(by_parameters, -1, 0).swapaxes(1, 2), np.moveaxis(by_geometry, -1, 0).swapaxes(1, 2)
    by_arm, by_place, count = to_mm @ a, to_mm @ g, len(covariances[2])
    by_arm, by_kept = by_arm[..., count:], by_arm[..., :count]
    of_arm = np.empty((m, by_arm.shape[1], by_arm.shape[1]))
    of_arm[used] = rows_times(by_arm[used], covariances[1]) @ by_arm[used].swapaxes(1, 2)
    of_arm[~used] = covariances[0].covariance_of_functions(by_arm[~used])
    of_place = np.where(fitted, -1.0, 1.0)[:, None, None] * (by_place @ by_place.swapaxes(1, 2))
    of_kept = by_kept @ covariances[2] @ by_kept.swapaxes(1, 2)
    variances = to_mm @ to_mm.swapaxes(1, 2) + of_arm + of_place + of_kept
    u = np.sqrt(np.maximum(np.einsum("mcc->m", variances), 0.0))
    angle, pixels = (
        observation.other_sizes(values) if observation.other_unit == unit else np.full(m, np.nan)
        for unit in OTHER_UNITS
    )
    alone = observation.kind == "socket" and m == 1 and bool(fitted.all())
    distance = np.full(m, np.nan) if alone else np.linalg.norm(position, axis=0)
    return PoseResiduals(
        (observation.name,) * m,
        np.arange(1, m + 1),
        tuple(USED if of_pose else HELD_OUT for of_pose in used),
        np.einsum("cxm,cm->mx", moved, position),
        distance,
        np.asarray(angle),
        np.asarray(pixels),
        np.full(m, np.nan) if alone else u,
    )


def _concatenated(parts: Sequence[PoseResiduals]) -> PoseResiduals:
    columns: Any = zip(*parts, strict=True)
    return PoseResiduals._make(
        np.concatenate(column) if isinstance(column[0], np.ndarray) else sum(column, ()) for column in columns
    )


def joined_rows(used: PoseResiduals, held_out: PoseResiduals) -> PoseResiduals:
    """Both in one table, observation by observation; the used poses have the numbers that the held-out ones leave."""
    names, numbers = np.array(used.observation, dtype=object), used.pose.copy()
    for name in dict.fromkeys(held_out.observation):
        taken = held_out.pose[np.array(held_out.observation, dtype=object) == name]
        free = np.setdiff1d(np.arange(1, int(np.sum(names == name)) + len(taken) + 1), taken)
        numbers[names == name] = free
    rows = _concatenated([used._replace(pose=numbers), held_out])
    order = {name: i for i, name in enumerate(dict.fromkeys(rows.observation))}
    return rows.select(np.lexsort((rows.pose, np.array([order[name] for name in rows.observation]))))
