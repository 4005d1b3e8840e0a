"""The null space of what was measured, by combinations of few parameters that have names."""

import numpy as np
from jaxtyping import Bool, Float

from ..kinematics.arm import Arm, jacobian_at
from ..kinematics.independence import rigid_motions
from ..kinematics.near_degeneracy import reduced_echelon
from ..kinematics.parameters import Parameters

_PRESENT = 1e-4  # of a direction's largest component: smaller ones are left out of its name
_NAMED = 6
_CONFIGURATIONS = 100


def complement(rows: Float[np.ndarray, "r p"], p: int) -> Float[np.ndarray, "p nullity"]:
    """Orthonormal basis of the orthogonal complement of orthonormal rows."""
    basis, _ = np.linalg.qr(np.concatenate([rows.T, np.eye(p)], axis=1))
    return basis[:, len(rows) :] - rows.T @ (rows @ basis[:, len(rows) :])


def named_directions(
    null: Float[np.ndarray, "p nullity"], arm: Arm, space: Parameters
) -> tuple[Float[np.ndarray, "p nullity"], tuple[str, ...]]:
    """The null space by directions of few parameters, and their names; the scale is a direction of its own."""
    if not null.shape[1]:
        return null, ()
    rest, texts, directions = null, [], []
    values = np.asarray(space.vector(arm)) * space.lengths
    scale = np.where([name == "d_1" for name in space.names], 0.0, values)
    size = np.linalg.norm(scale)
    if size > 0 and np.linalg.norm(scale - null @ (null.T @ scale)) < 1e-6 * size:
        texts.append("all lengths together: the scale")
        directions.append(scale / size)
        # The other directions are named without the longest link, the largest component of the scale.
        pivot = int(np.argmax(np.abs(scale)))
        rest = null - np.outer(scale, null[pivot] / scale[pivot])
        rest = np.linalg.svd(rest, full_matrices=False)[0][:, : null.shape[1] - 1]
    for direction in reduced_echelon(rest)[0].T:
        weights = np.abs(direction) / np.abs(direction).max()
        order = [i for i in np.argsort(-weights, kind="stable") if weights[i] > _PRESENT]
        texts.append(_text([space.names[i] for i in sorted(order)]))
        directions.append(direction / np.linalg.norm(direction))
    return np.stack(directions, axis=1), tuple(texts)


def _text(names: list[str]) -> str:
    if len(names) == 1:
        return f"{names[0]} (changes nothing that is measured)"
    shown = names if len(names) <= _NAMED else [*names[: _NAMED - 1], f"{len(names) - _NAMED + 1} more"]
    return f"{', '.join(shown[:-1])} and {shown[-1]} trade off"


def structural(null: Float[np.ndarray, "p nullity"], arm: Arm, space: Parameters) -> Bool[np.ndarray, " nullity"]:
    """Which directions move the tip, in any pose, only as a rigid motion of the whole arm, which no capture shows."""
    if not null.shape[1]:
        return np.zeros(0, dtype=bool)
    count = _CONFIGURATIONS
    random = np.random.default_rng(0)
    q = random.uniform(-np.pi, np.pi, (count, arm.joints))
    if arm.thermometer:
        q = np.concatenate([q, random.uniform(10.0, 30.0, (count, 1))], axis=1)
    movements = (jacobian_at(arm, q, space.names) * np.asarray(space.scale) @ null).reshape(3 * count, -1)
    tips = np.asarray(arm.position(q))
    rigid = rigid_motions(tips).reshape(3 * count, 6)
    remaining = movements - rigid @ np.linalg.lstsq(rigid, movements, rcond=None)[0]
    return np.linalg.norm(remaining, axis=0) < 1e-6 * np.sqrt(3 * count)
