"""What a capture can determine, and what it cannot: rank, null space in parameter names, and how well the rest is seen."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..data.capture import Capture, ReferenceLength
from ..data.noise import Noise
from ..kinematics.arm import Arm, jacobian_at, neighbouring_arm
from ..kinematics.independence import equations, nearly_parallel
from ..kinematics.inverse_kinematics import project_to_centroids, project_to_targets
from ..kinematics.parameters import Parameters
from ..model.measurement import Measurement, check_joints
from .covariance import linearised
from .propagation import joint_weights

_RANK = 1e-8  # singular values below this, of the largest, are zero
_PRESENT = 1e-4  # of a direction's largest component: smaller ones are left out of its name
_NAMED, _TOLD = 6, 4


class Observability(NamedTuple):
    """What a capture says of the free parameters of an arm, as NumPy arrays.

    Derivatives are in natural steps (1 mm, 1 mrad) and, where the noise is given, in its standard deviations; else in mm.
    ``singular`` are their singular values, the largest first. ``null`` ``(p, nullity)`` are directions that change nothing
    that was recorded, each named in ``unseen``; those in ``never`` no capture of this kind can see.
    """

    names: tuple[str, ...]
    poses: int
    singular: Float[np.ndarray, " p"]
    condition: float  # of the identifiable part, columns scaled to the same norm
    null: Float[np.ndarray, "p nullity"]
    unseen: tuple[str, ...]
    never: tuple[bool, ...]
    remedy: str  # what else to record; empty where that would not help
    parallel: tuple[int, ...]  # joints, from 1, whose axis is nearly parallel to the next, with beta not free

    @property
    def rank(self) -> int:
        """Number of independent directions that are determined."""
        return len(self.names) - self.null.shape[1]

    @property
    def indices(self) -> dict[str, float]:
        """Observability indices O1 to O5 (Borm and Menq 1991; Driels and Pathre 1990; Nahvi et al. 1994; Nahvi and Hollerbach
        1996; Sun and Hollerbach 2008), larger is better; all 0 where a direction is not determined.

        O1 = (prod s)^(1/L) / sqrt(m), O2 = s_L / s_1, O3 = s_L, O4 = s_L^2 / s_1, O5 = 1 / sum(1 / s), for the L singular
        values s_1 >= ... >= s_L of m poses.
        """
        s = self.singular
        if self.rank < len(self.names):
            return dict.fromkeys(("O1", "O2", "O3", "O4", "O5"), 0.0)
        return {
            "O1": float(np.exp(np.mean(np.log(s))) / np.sqrt(self.poses)),
            "O2": float(s[-1] / s[0]),
            "O3": float(s[-1]),
            "O4": float(s[-1] ** 2 / s[0]),
            "O5": float(1 / np.sum(1 / s)),
        }

    def sentences(self) -> list[str]:
        """What a user should know, one sentence each: directions that nothing determines, and what would."""
        found = []
        hopeless = [text for text, never in zip(self.unseen, self.never, strict=True) if never]
        open_now = [text for text, never in zip(self.unseen, self.never, strict=True) if not never]
        if hopeless:
            found.append(f"No measurement of this kind tells these apart: {'; '.join(hopeless)}. Hold one of each (--held).")
        if open_now:
            remedy = f" {self.remedy}" if self.remedy else " Hold one of each (--held)."
            told = (
                "; ".join(open_now)
                if len(open_now) <= _TOLD
                else f"{len(open_now)} combinations of {len(self.names)} parameters"
            )
            found.append(f"Not determined by these data: {told}.{remedy}")
        for i in self.parallel:
            found.append(
                f"Axes {i} and {i + 1} are nearly parallel, where d_{i} and d_{i + 1} trade off and a small tilt has no D-H "
                f"parameters: hold d_{i} and free beta_{i} (--free beta_{i})."
            )
        return found


def observability(arm: Arm, capture: Capture, space: Parameters | None = None, *, noise: Noise | None = None) -> Observability:
    """What the poses and reference lengths of a capture determine of the free parameters (default: the paper's).

    The poses are first moved onto their sockets by this arm, a few mm at most, so that an arm that is not yet calibrated is
    judged by its geometry and not by its errors. Raises `InputError` where capture and arm do not fit.
    """
    space = Parameters.free_of(arm) if space is None else space
    check_joints(capture, space)
    if noise is not None:
        noise.check(arm.joints)
    base = space.arm(space.vector(arm))
    spectrum = _spectrum(base, base, capture, space, noise)
    if spectrum.rank < len(space.names):
        # A nominal arm may stand in a special position (a probe on the last axis) that the real one does not share.
        beside = neighbouring_arm(base, space.names)
        other = _spectrum(beside, base, capture, space, noise)
        if other.rank > spectrum.rank:
            base, spectrum = beside, other
    rank, p = spectrum.rank, len(space.names)
    null, unseen = _named(_complement(spectrum.vectors[:rank], p), base, space)
    never = tuple(bool(x) for x in _never(null, base, space))
    return Observability(
        names=space.names,
        poses=sum(capture.sizes),
        singular=spectrum.singular,
        condition=spectrum.condition,
        null=null,
        unseen=unseen,
        never=never,
        remedy="" if all(never) else _remedy(base, capture, space, p - sum(never)),
        parallel=tuple(i for i in nearly_parallel(arm) if _tilts(space, i)),
    )


class _Spectrum(NamedTuple):
    singular: Float[np.ndarray, " p"]
    vectors: Float[np.ndarray, "r p"]
    rank: int
    condition: float


def _spectrum(arm: Arm, stands: Arm, capture: Capture, space: Parameters, noise: Noise | None) -> _Spectrum:
    rows = _rows(arm, capture, space, project_to_centroids(arm, capture, stands), noise)
    _, singular, vectors = np.linalg.svd(rows, full_matrices=False)
    singular = np.concatenate([singular, np.zeros(len(space.names) - len(singular))])
    rank = int(np.sum(singular > _RANK * max(singular[0], 1e-300)))
    norms = np.linalg.norm(rows, axis=0)
    equal = np.linalg.svd(rows / np.where(norms > 0, norms, 1), compute_uv=False)[:rank]
    return _Spectrum(singular, vectors, rank, float(equal[0] / equal[-1]) if rank else np.inf)


def _tilts(space: Parameters, i: int) -> bool:
    """Whether the angle between the near-parallel axes i and i + 1 is identified, with plain D-H."""
    return f"beta_{i}" not in space.names and f"alpha_{i}" in space.names


def _rows(
    arm: Arm, capture: Capture, space: Parameters, q: Float[np.ndarray, "N n"], noise: Noise | None
) -> Float[np.ndarray, "rows p"]:
    """All equations, one a row, in natural steps; whitened where the noise is given."""
    scale = np.asarray(space.scale)
    if noise is None:
        poses, lengths = equations(arm, capture, space.names, q)
        return np.concatenate([poses.reshape(-1, len(scale)), lengths]) * scale
    moved = Capture({name: q[capture.owner == i] for i, name in enumerate(capture.names)}, capture.lengths)
    measurement = Measurement.of(moved).weighted(arm.geometry, noise)
    return np.asarray(whitened_equations(arm, space, measurement))


@eqx.filter_jit
def whitened_equations(arm: Arm, space: Parameters, measurement: Measurement) -> Float[Array, "rows p"]:
    """Derivatives of everything measured by the free parameters, in natural steps and in standard deviations; the measurement
    carries its weights."""
    linear = linearised(arm, space, measurement, jnp.zeros(len(space.names), dtype=bool))
    lengths = joint_weights(arm, measurement, jnp.zeros(())).whitening @ linear.lengths
    return jnp.concatenate([linear.counted.reshape(linear.counted.shape[0], -1).T, lengths])


def _complement(seen: Float[np.ndarray, "r p"], p: int) -> Float[np.ndarray, "p nullity"]:
    """Orthonormal basis of what is not in the span of orthonormal rows."""
    whole, _ = np.linalg.qr(np.concatenate([seen.T, np.eye(p)], axis=1))
    return whole[:, len(seen) :] - seen.T @ (seen @ whole[:, len(seen) :])


def _named(
    null: Float[np.ndarray, "p nullity"], arm: Arm, space: Parameters
) -> tuple[Float[np.ndarray, "p nullity"], tuple[str, ...]]:
    """The null space by directions of few parameters, and their names: the scale apart from the rest."""
    if not null.shape[1]:
        return null, ()
    left, texts, directions = null, [], []
    values = np.asarray(space.vector(arm)) * space.lengths
    scale_direction = np.where([name == "d_1" for name in space.names], 0.0, values)
    size = np.linalg.norm(scale_direction)
    if size > 0 and np.linalg.norm(scale_direction - null @ (null.T @ scale_direction)) < 1e-6 * size:
        texts.append("all lengths together: the scale")
        directions.append(scale_direction / size)
        # The others are told without the longest link, of which the scale has most.
        pivot = int(np.argmax(np.abs(scale_direction)))
        left = null - np.outer(scale_direction, null[pivot] / scale_direction[pivot])
        left = np.linalg.svd(left, full_matrices=False)[0][:, : null.shape[1] - 1]
    for direction in _sparse(left).T:
        weights = np.abs(direction) / np.abs(direction).max()
        order = [i for i in np.argsort(-weights, kind="stable") if weights[i] > _PRESENT]
        texts.append(_text([space.names[i] for i in sorted(order)]))
        directions.append(direction / np.linalg.norm(direction))
    return np.stack(directions, axis=1), tuple(texts)


def _sparse(null: Float[np.ndarray, "p r"]) -> Float[np.ndarray, "p r"]:
    """The same space by vectors that are each zero at the other vectors' leading parameters (reduced echelon form)."""
    rows = null.T.copy()
    for i in range(len(rows)):
        rest = np.abs(rows[i:])
        # The parameter that this space moves most leads; rows are exchanged, so that it is in row i.
        column = int(np.argmax(np.linalg.norm(rows[i:], axis=0)))
        row = i + int(np.argmax(rest[:, column]))
        rows[[i, row]] = rows[[row, i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    return rows.T


def _text(names: list[str]) -> str:
    if len(names) == 1:
        return f"{names[0]} (changes nothing that is measured)"
    shown = names if len(names) <= _NAMED else [*names[: _NAMED - 1], f"{len(names) - _NAMED + 1} more"]
    return f"{', '.join(shown[:-1])} and {shown[-1]} trade off"


def _never(null: Float[np.ndarray, "p nullity"], arm: Arm, space: Parameters) -> np.ndarray:
    """Which directions move the tip, in whatever pose, only as if the whole arm were moved: no socket and no length shows that."""
    if not null.shape[1]:
        return np.zeros(0, dtype=bool)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (100, arm.joints))
    moved = jacobian_at(arm, q, space.names) * np.asarray(space.scale) @ null  # (100, 3, nullity)
    tips = np.asarray(arm.position(q))
    rotations = np.cross(np.eye(3)[None, :, :], tips[:, None, :]).transpose(0, 2, 1)
    rigid = np.concatenate([np.broadcast_to(np.eye(3), (100, 3, 3)), rotations * 1e-3], axis=2).reshape(300, 6)
    moved = moved.reshape(300, -1)
    left = moved - rigid @ np.linalg.lstsq(rigid, moved, rcond=None)[0]
    return np.linalg.norm(left, axis=0) < 1e-6 * np.sqrt(300)


def _remedy(arm: Arm, capture: Capture, space: Parameters, wanted: int) -> str:
    """What further data would let everything be seen that can be: tried out, the least effort first."""
    random = np.random.default_rng(0)
    limits = np.array(arm.limits if arm.limits is not None else [(-np.pi, np.pi)] * arm.joints)
    draw = lambda count: random.uniform(limits[:, 0], limits[:, 1], (count, arm.joints))  # noqa: E731
    far = {f"\0{i}": q[None] for i, q in enumerate(draw(4))}
    one = [ReferenceLength("\0000", "\0001", 1.0)]
    two = [*one, ReferenceLength("\0002", "\0003", 1.0)]
    again = {f"\0 {name}": _varied(arm, np.asarray(q)[0], random) for name, q in list(capture.sockets.items())[:1]}
    length = "a second position of the reference length" if capture.lengths else "a reference length"
    for text, sockets, lengths in (
        (f"{length[0].upper()}{length[1:]} would determine them.", far, one),
        ("Reference lengths at two more positions would determine them.", far, two),
        ("More poses in a socket, as different as possible, would determine them.", again, []),
        (f"More poses in a socket, and {length}, would determine them.", again | far, one),
    ):
        more = Capture({**capture.sockets, **sockets}, [*capture.lengths, *lengths])
        rows = _rows(arm, more, space, project_to_centroids(arm, more), None)
        values = np.linalg.svd(rows, compute_uv=False)
        if np.sum(values > _RANK * values[0]) >= wanted:
            return text
    return ""


def _varied(arm: Arm, q: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Poses that hold the tip where ``q`` holds it."""
    poses = q + random.uniform(-1.5, 1.5, (60, arm.joints))
    poses, reached = project_to_targets(arm, poses, np.tile(np.asarray(arm.position(q)), (60, 1)))
    return poses[reached] if reached.any() else q[None]
