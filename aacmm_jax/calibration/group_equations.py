"""The equations of a calibration at its solution, observation by observation, for tests of groups of them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import by_joint, is_length, value_of
from ..kinematics.parameters import Parameters
from ..model.measurement import Measurement
from ..model.observed import Observed, certified_and_lengths, linear_rows, whitened, whitening_of
from ..uncertainty.group_test import Block
from ..uncertainty.tip_errors import arm_errors, covariance_of_noise
from .record import CalibrationRecord

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
        found = [rows.block("", columns, rows.name in members) for rows in self.rows]
        return [*found, *wider(self.relations, len(columns))]

    def grouped(self, groups: Mapping[str, str | None]) -> list[Block]:
        """By the group of each observation."""
        return [*(rows.block(groups[rows.name]) for rows in self.rows), *self.relations]


def equations_of(record: CalibrationRecord) -> Equations:
    """The equations of a calibration, linear at its solution; as weighted by its robust loss."""
    kinds = by_joint(record.calibrated.arm, "theta", "d")  # where a reading is added
    extra = (*(f"{kind}_{i}" for i, kind in enumerate(kinds, start=1)), *PROBE)
    steps = np.array([1.0 if is_length(name) else 1e-3 for name in extra])
    if record.observed is None:
        return Equations(_of_sockets(record, extra), [], extra, steps)
    rows, relations = _of_observations(record, extra)
    return Equations(rows, relations, extra, steps)


def equations_in_chunks(record: CalibrationRecord) -> tuple[list[Rows], list[Block]]:
    """The equations of poses in chunks, or of very many an even choice of these, and those of relations.

    Unknowns of an observation that is divided become shared ones.
    """
    equations = equations_of(record)
    divided = [each for each in equations.rows if len(each.poses) > _CHUNK]
    added = sum(each.own.shape[2] for each in divided)
    chunks, position = [], 0
    for each in equations.rows:
        shared = np.pad(each.shared, ((0, 0), (0, 0), (0, added)))
        if len(each.poses) <= _CHUNK:
            chunks.append(each._replace(shared=shared))
            continue
        width = each.own.shape[2]
        shared[..., each.shared.shape[2] + position :][..., :width] = each.own
        position += width
        whole = each._replace(shared=shared, own=each.own[..., :0])
        for start in range(0, len(each.poses), _CHUNK):
            of = slice(start, start + _CHUNK)
            chunks.append(whole._replace(**{name: getattr(whole, name)[of] for name in Rows._fields if name != "name"}))
    step = -(-sum(len(each.poses) for each in chunks) // _MOST_POSES)
    return chunks[:: max(step, 1)], wider(equations.relations, added)


def residual_rms(rows: Sequence[Rows]) -> float:
    """Root mean square of a coordinate of the residuals, mm."""
    squares = [np.einsum("mcr,mr->mc", each.in_mm, each.residual).ravel() ** 2 for each in rows]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def wider(relations: Sequence[Block], added: int) -> list[Block]:
    """Relations where there are further shared unknowns, of which they say nothing."""
    return [block._replace(shared=np.pad(block.shared, ((0, 0), (0, added)))) for block in relations]


def _of_sockets(record: CalibrationRecord, extra: tuple[str, ...]) -> list[Rows]:
    """Of sockets whose positions are eliminated: thousands of them must not take seconds."""
    capture = record.recording.capture
    arm = record.calibrated.arm
    arm, measurement, noise = to_numpy((arm, Measurement.of(capture, arm), record.noise))
    names = tuple(name for name in record.names if name != scale_anchor_of(record))
    every = (*names, *(name for name in extra if name not in names))
    slopes = np.asarray(arm.jacobian(measurement.q, every)) * np.asarray(Parameters(arm, every).scale)
    weights = measurement.weighted(arm.geometry, noise).weights
    assert weights is not None
    root = np.moveaxis(np.asarray(weights.root), -1, 0)
    tips = np.asarray(measurement.centred(np.asarray(arm.position(measurement.q))))
    residual, by = np.einsum("nab,nb->na", root, tips), root @ slopes
    columns = [every.index(name) for name in extra]
    inverse, found, end = np.linalg.inv(root), [], 0
    for name, size in zip(capture.names, capture.sizes, strict=True):
        end += size
        of = slice(end - size, end)
        if size > 1:
            shared = by[of][..., : len(names)]
            extra_of, poses = by[of][..., columns], np.arange(end - size, end)
            found.append(Rows(name, residual[of], shared, root[of], extra_of, inverse[of], root[of], poses))
    return found


def _of_observations(record: CalibrationRecord, extra: tuple[str, ...]) -> tuple[list[Rows], list[Block]]:
    assert record.observed is not None
    arm = record.calibrated.arm
    observed, arm, noise = to_numpy((Observed.of(record.recording.capture, arm), arm, record.noise))
    names = tuple(name for name in record.names if name != record.hold)
    every = (*names, *(name for name in extra if name not in names))
    space, p, free = Parameters(arm, every), len(every), len(names)
    geometry = [np.asarray(record.observed.geometry[part]) for part in observed.blocks]
    z = np.concatenate([np.asarray(space.vector()), *geometry])
    linear = linear_rows(space, observed, z)
    errors = arm_errors(observed.forward(space, z[:p], z[p:]), linear, observed)
    whitening = whitening_of(
        linear, observed, [covariance_of_noise(error, noise) for error in errors], np.array(LEAST_U)
    )
    steps = np.concatenate([np.asarray(space.scale), observed.steps])
    common = np.concatenate([np.arange(free), p + _common(observed)])
    columns = np.array([every.index(name) for name in extra])
    rows = []
    for name, part, root, weights, of in zip(
        record.observed.names, linear, whitening.roots, record.observed.weights, observed.slices, strict=True
    ):
        root = np.sqrt(np.asarray(weights))[:, None, None] * np.asarray(root)
        own = np.array([i for i in part.indices if i >= p and i not in common], dtype=int)
        white, by = _in_columns(part, root, steps)
        in_mm = np.linalg.pinv(root)[:, :3]
        by_tip = root @ np.moveaxis(np.asarray(part.rows.by_tip), -1, 0)
        poses = np.arange(of.start, of.stop)
        rows.append(Rows(name, white, by(common), by(own), by(columns), in_mm, by_tip, poses))
    derivatives, u = certified_and_lengths(observed, z, p)
    parts = observed.split(z[p:])
    residual = [np.linalg.norm(parts[end] - parts[start]) for start, end in observed.ends] - np.asarray(
        observed.nominal
    )
    residual = [residual, *(parts[name] - np.asarray(value) for name, (value, _) in observed.certified().items())]
    u = np.maximum(u, LEAST_U)
    every_row = Block(
        "", None, np.concatenate(residual) / u, (derivatives * steps)[:, common] / u[:, None], np.zeros((len(u), 0))
    )
    return rows, [*([every_row] if len(u) else []), *_of_prior(record, z, steps[:free], len(common))]


def _of_prior(record: CalibrationRecord, z: np.ndarray, steps: np.ndarray, shared: int) -> list[Block]:
    """The rows of the prior, which belong to no group."""
    prior = record.prior
    if prior is None:
        return []
    mean, weight = np.asarray(prior.mean), np.asarray(prior.weight)
    known = np.flatnonzero(weight)
    residual = weight[known] * (z[: len(steps)] - mean)[known]
    derivatives = np.eye(shared)[known] * (weight * steps)[known][:, None]
    return [Block(PRIOR, None, residual, derivatives, np.zeros((len(known), 0)))]


def _in_columns(part: tuple, root: np.ndarray, steps: np.ndarray):
    """Whitened residuals ``(m, r)``, and their derivatives by chosen unknowns ``(m, r, k)``; 0 by the others."""
    white, jacobian = whitened(part, root)
    position = {int(index): i for i, index in enumerate(part.indices)}

    def by(chosen: np.ndarray) -> np.ndarray:
        found = np.zeros((*white.T.shape, len(chosen)))
        for column, index in enumerate(chosen):
            if int(index) in position:
                found[..., column] = np.asarray(jacobian[position[int(index)]]).T * steps[index]
        return found

    return np.asarray(white).T, by


def _common(observed: Observed) -> np.ndarray:
    """Indices of the geometry that several observations, reference lengths or certified values depend on."""
    users: dict[str, int] = {}
    for observation in observed.observations:
        for part in observation.unknowns:
            users[part] = users.get(part, 0) + 1
    alone = {part for part, number in users.items() if number == 1}
    alone -= {end for ends in observed.ends for end in ends} | observed.certified().keys()
    chosen = [rows for part, rows in observed.positions.items() if part not in alone]
    return np.concatenate(chosen) if chosen else np.zeros(0, dtype=int)


def scale_anchor_of(record: CalibrationRecord) -> str | None:
    """The length that is kept, because residuals of sockets vanish where the whole arm shrinks."""
    lengths = [name for name in record.names if is_length(name)]
    if record.hold is not None or record.scale_set_by or not lengths:
        return record.hold
    return max(lengths, key=lambda name: abs(value_of(record.calibrated.arm, name)))
