"""The equations of a calibration at its solution, observation by observation, for tests of groups of them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..calibration.record import CalibrationRecord
from ..calibration.task import without_lengths
from ..core.numpy_or_jax import to_numpy
from ..data.noise import Noise
from ..kinematics.arm import by_joint, is_length, value_of
from ..kinematics.parameters import Parameters
from ..model.observed import Observed
from ..uncertainty.linearisation import Linearisation
from .group_test import Block

PRIOR = "prior"  # name of its rows
PROBE = ("probe_x", "probe_y", "probe_z")
LEAST_U = 1e-6  # mm: smallest standard deviation of a length or certified value
_MOST_POSES = 2000  # that tests of residuals look at: more would only find errors that do not matter
_CHUNK = 100  # poses of one observation that are kept together
EXACT = 1e-6  # mm: smaller residuals are rounding errors of a simulation without noise


class Rows(NamedTuple):
    """The m poses of one observation, r rows each, in standard deviations and natural steps."""

    name: str
    residual: Float[np.ndarray, "m r"]
    shared: Float[np.ndarray, "m r s"]  # derivatives by the parameters, and by the geometry of several observations
    own: Float[np.ndarray, "m r k"]  # by the geometry of this observation alone
    extra: Float[np.ndarray, "m r e"]  # by what may be wrong in some of the poses: `Equations.extra`
    in_mm: Float[np.ndarray, "m 3 r"]  # the residual's position in mm
    by_tip: Float[np.ndarray, "m r 3"]  # derivatives by the tip's position
    poses: Int[np.ndarray, " m"]  # their numbers among all poses: sockets first, then other observations

    def block(self, group: str | None, extra: Sequence[int] = (), concerned: bool = True) -> Block:
        """For the test; with columns of ``extra`` after the shared ones, which are 0 where it is not concerned."""
        shared = np.concatenate([self.shared, self.extra[..., list(extra)] * concerned], axis=2)
        flat = (array.reshape(self.residual.size, array.shape[2]) for array in (shared, self.own))
        return Block(self.name, group, self.residual.ravel(), *flat)

    def at(self, poses: "slice | np.ndarray") -> "Rows":
        """Some of the poses."""
        return Rows(self.name, *(part[poses] for part in self[1:]))

    def squares(self, step: Float[np.ndarray, " s"]) -> Float[np.ndarray, " m"]:
        """Squared distance of each pose from the geometry, mm^2, after a step; its own geometry follows."""
        moved = self.residual + self.shared @ step
        own = self.own.reshape(self.residual.size, self.own.shape[2])
        moved = moved - self.own @ (np.linalg.pinv(own) @ moved.ravel())
        return np.sum(np.einsum("mcr,mr->mc", self.in_mm, moved) ** 2, axis=1)


class Equations(NamedTuple):
    """All equations of a calibration."""

    rows: list[Rows]  # of the observations, sockets first; sockets with one pose are not among them
    relations: list[Block]  # of reference lengths and certified values, which belong to no group
    extra: tuple[str, ...]  # zeros of the joints, and the probe
    steps: Float[np.ndarray, " e"]  # their natural steps, rad and mm

    def blocks(self, members: Sequence[str] = (), names: Sequence[str] = ()) -> list[Block]:
        """All in one group; with some of ``extra`` as unknowns that only certain observations have."""
        columns = [self.extra.index(name) for name in names]
        blocks = [rows.block("", columns, rows.name in members) for rows in self.rows]
        return [*blocks, *wider(self.relations, len(columns))]

    def grouped(self, groups: Mapping[str, str | None]) -> list[Block]:
        """By the group of each observation."""
        return [*(rows.block(groups[rows.name]) for rows in self.rows), *self.relations]


def equations_of(record: CalibrationRecord) -> Equations:
    """The equations of a calibration, linear at its solution; as weighted by its robust loss."""
    kinds = by_joint(record.calibrated.arm, "theta", "d")  # where a reading is added
    extra = (*(f"{kind}_{i}" for i, kind in enumerate(kinds, start=1)), *PROBE)
    in_solve = lengths_in_solve(record)
    # The length that the equations keep: none where anything but repeatability says what the scale is.
    scaled = record.prior is not None or any(o.fixes_scale for o in record.recording.capture.observations)
    anchor = None if in_solve else record.hold if scaled else scale_anchor_of(record)
    names = tuple(name for name in record.names if name != anchor)
    every = (*names, *(name for name in extra if name not in names))
    linear = linearisation_of(record, every, noise=record.noise, lengths=in_solve)
    observed, p, free = linear.observed, len(every), len(names)
    steps, columns = np.asarray(linear.steps), np.array([every.index(name) for name in extra])
    # The geometry that several observations, reference lengths or certified values depend on.
    related = {end for ends in observed.ends for end in ends} | observed.certified().keys()
    private = [observed.positions[part] for part in observed.blocks if part in related]
    common = np.unique(np.concatenate([np.arange(observed.layout.shared), *private]).astype(int))
    rows = []
    for part in linear.parts():
        weight = np.sqrt(np.asarray(part.weight))
        root = weight[:, None, None] * np.asarray(part.root)
        by = np.moveaxis(np.asarray(part.by_head) * weight, (0, 1, 2), (2, 1, 0)) * steps[: linear.height]
        own = np.moveaxis(np.asarray(part.by_private) * weight, (0, 1, 2), (2, 1, 0)) * steps[p + part.private]
        among = np.isin(part.private, common)
        # A socket with one pose shows no scatter; only lengths in the solve need it.
        if not in_solve and len(weight) == 1 and np.sum(~among) == 3:
            continue
        shared = np.zeros((*by.shape[:2], free + len(common)))
        shared[..., :free] = by[..., :free]
        shared[..., free : free + observed.layout.shared] = by[..., p:]
        shared[..., free + np.searchsorted(common, part.private[among])] = own[..., among]
        rows.append(
            Rows(
                part.observation.name,
                (np.asarray(part.white) * weight).T,
                shared,
                own[..., ~among],
                by[..., columns],
                np.linalg.pinv(root)[:, :3],
                root @ np.moveaxis(np.asarray(part.by_tip), -1, 0),
                np.arange(part.poses.start, part.poses.stop),
            )
        )
    derivatives, residual, u = linear.relations()
    u = np.maximum(u, LEAST_U)
    chosen = np.concatenate([np.arange(free), p + common])
    relations = [Block("", None, residual / u, (derivatives * steps)[:, chosen] / u[:, None], np.zeros((len(u), 0)))]
    if record.prior is not None:
        mean, weight = np.asarray(record.prior.mean), np.asarray(record.prior.weight)
        stated = np.flatnonzero(weight)
        residual = weight[stated] * (np.asarray(linear.z)[:free] - mean)[stated]
        by = np.eye(len(chosen))[stated] * (weight * steps[:free])[stated][:, None]
        relations.append(Block(PRIOR, None, residual, by, np.zeros((len(stated), 0))))
    natural = np.array([1.0 if is_length(name) else 1e-3 for name in extra])
    return Equations(rows, relations if len(u) else relations[1:], extra, natural)


def in_chunks(equations: Equations) -> tuple[list[Rows], list[Block]]:
    """The equations of poses in chunks, or of very many an even choice of these, and those of relations.

    Unknowns of an observation that is divided become shared ones.
    """
    added = sum(rows.own.shape[2] for rows in equations.rows if len(rows.poses) > _CHUNK)
    chunks, position = [], 0
    for rows in equations.rows:
        shared = np.pad(rows.shared, ((0, 0), (0, 0), (0, added)))
        if len(rows.poses) <= _CHUNK:
            chunks.append(rows._replace(shared=shared))
            continue
        width = rows.own.shape[2]
        shared[..., rows.shared.shape[2] + position :][..., :width] = rows.own
        position += width
        whole = rows._replace(shared=shared, own=rows.own[..., :0])
        chunks += [whole.at(slice(start, start + _CHUNK)) for start in range(0, len(rows.poses), _CHUNK)]
    step = -(-sum(len(rows.poses) for rows in chunks) // _MOST_POSES)
    return chunks[:: max(step, 1)], wider(equations.relations, added)


def residual_rms(rows: Sequence[Rows]) -> float:
    """Root mean square of a coordinate of the residuals, mm."""
    squares = [np.einsum("mcr,mr->mc", part.in_mm, part.residual).ravel() ** 2 for part in rows]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def wider(relations: Sequence[Block], added: int) -> list[Block]:
    """Relations where there are further shared unknowns, of which they say nothing."""
    return [block._replace(shared=np.pad(block.shared, ((0, 0), (0, added)))) for block in relations]


def linearisation_of(
    record: CalibrationRecord, names: Sequence[str], *, noise: Noise | None, lengths: bool = True
) -> Linearisation:
    """A calibration linear at its solution, by some parameters, weighted by the noise, or where that is None by the
    scatter of its tips; with reference lengths as relations, or without."""
    capture = record.recording.capture if lengths else without_lengths(record.recording.capture)
    arm = record.calibrated.arm
    observed, arm, noise = to_numpy((Observed.of(capture, arm), arm, noise))
    space, metrics = Parameters(arm, tuple(names)), record.observed
    geometry = [np.asarray(metrics.geometry[part]) for part in observed.blocks]
    z, sigma = np.concatenate([np.asarray(space.vector()), *geometry]), np.asarray(metrics.sigma)
    linear = Linearisation.at(observed, space, z, noise=noise, sigma=sigma, least=LEAST_U)
    weights = [np.asarray(weight) for weight in metrics.weights]
    if all(np.all(weight == 1) for weight in weights):
        return linear
    of_groups = [np.concatenate([weights[number] for number in group.members]) for group in observed.layout.groups]
    return linear._replace(weights=[*of_groups, *linear.weights[len(of_groups) :]])


def lengths_in_solve(record: CalibrationRecord) -> bool:
    """Whether reference lengths took part in the least squares, and not only as the scale afterwards."""
    return record.final_method == "joint" and bool(record.recording.capture.lengths)


def scale_anchor_of(record: CalibrationRecord) -> str | None:
    """The length that is kept, because residuals of sockets vanish where the whole arm shrinks."""
    lengths = [name for name in record.names if is_length(name)]
    if record.hold is not None or record.scale_set_by or not lengths:
        return record.hold
    return max(lengths, key=lambda name: abs(value_of(record.calibrated.arm, name)))
