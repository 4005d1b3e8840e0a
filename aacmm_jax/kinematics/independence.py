"""Which parameters a capture can tell apart at all: the tips' derivatives, made consistent, and a choice of independent ones."""

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.arrays import in_chunks
from ..core.errors import InputError
from .arm import LENGTHS, Arm, jacobian_at, locate, neighbouring_arm, replace
from .inverse_kinematics import SocketPoses, project_to_centroids

_OFF_AXIS = 5.0  # mm
_INDEPENDENT = 1e-6  # of a column's size must stand apart from the columns chosen before it
NEARLY_PARALLEL = 0.02  # |sin alpha|, about 1 degree


def equations(
    arm: Arm, capture: SocketPoses, names: Sequence[str], q: Float[np.ndarray, "N n"]
) -> tuple[Float[np.ndarray, "N 3 p"], Float[np.ndarray, "l p"]]:
    """Derivatives of what a capture determines: tips less their socket's mean, and reference lengths; poses at ``q``."""
    columns = jacobian_at(arm, q, names)
    owner, sizes = capture.owner, np.asarray(capture.sizes, dtype=float)
    starts = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    means = np.add.reduceat(columns, starts, axis=0) / sizes[:, None, None]
    tips = in_chunks(lambda rows: np.asarray(arm.position(rows)), q)
    centroids = np.add.reduceat(tips, starts, axis=0) / sizes[:, None]
    ends = capture.ends()
    between = centroids[ends[:, 1]] - centroids[ends[:, 0]]
    directions = between / np.linalg.norm(between, axis=1, keepdims=True)
    lengths = np.einsum("lc,lcp->lp", directions, means[ends[:, 1]] - means[ends[:, 0]])
    return columns - means[owner], lengths


def nearly_parallel(arm: Arm) -> list[int]:
    """Joints, from 1, whose axis is nearly parallel to the next: there plain D-H is singular (Hayati and Mirmirani 1985)."""
    return [i + 1 for i in range(arm.joints - 1) if abs(np.sin(float(arm.alpha[i]))) < NEARLY_PARALLEL]


def independent_names(arm: Arm, capture: SocketPoses) -> tuple[Arm, tuple[str, ...]]:
    """A largest set of parameters that a capture determines, in the package's order, and the arm (with beta where needed).

    Taken one after the other, and held where those taken before can imitate them: nonzero lengths first, then angles, lengths
    that are nominally zero, the probe and the last link; the longest link comes last of all, so that it is held where no
    reference length fixes the scale. Where neighbouring axes are nearly parallel, ``d_i`` is held and ``beta_i`` freed.
    """
    if arm.joints != capture.joints:
        raise InputError(
            f"the capture has {capture.joints} columns, but the arm has {arm.joints} joints; give one column a joint."
        )
    parallel = nearly_parallel(arm)
    if parallel and arm.beta is None:
        arm = replace(arm, beta=jnp.zeros_like(arm.alpha))
    order = _order(arm, parallel)
    taken: tuple[str, ...] = ()
    for _ in range(5):
        # Out of a special position, but with what is held at its nominal value, which may make others redundant in its turn.
        beside = neighbouring_arm(arm, taken or tuple(order))
        before, taken = taken, _independent(beside, arm, capture, order)
        if taken == before or not taken:
            break
    return arm, taken


def _independent(arm: Arm, stands: Arm, capture: SocketPoses, order: list[str]) -> tuple[str, ...]:
    """Those whose columns stand apart from the columns of those before them; poses hold sockets where another arm puts them."""
    poses, lengths = equations(arm, capture, order, project_to_centroids(arm, capture, stands))
    rows = np.concatenate([poses.reshape(-1, len(order)), lengths])
    basis = np.zeros((rows.shape[0], 0))
    taken = []
    for name, whole in zip(order, rows.T, strict=True):
        column = whole
        for _ in range(2):  # twice is enough for orthogonality to rounding
            column = column - basis @ (basis.T @ column)
        least = 1e-7 * (1.0 if locate(arm, name)[0] in LENGTHS else 1e3)  # small at the tip for steps of 1 mm and 1 mrad
        size = float(np.linalg.norm(column))
        if size > max(_INDEPENDENT * float(np.linalg.norm(whole)), least) and basis.shape[1] < rows.shape[0]:
            taken.append(name)
            basis = np.hstack([basis, column[:, None] / size])
    return tuple(taken)


def _order(arm: Arm, parallel: list[int]) -> list[str]:
    n = arm.joints
    values = {kind: np.asarray(getattr(arm, kind)) for kind in ("a", "d")}
    lengths = [(f"{kind}_{i}", values[kind][i - 1]) for i in range(1, n) for kind in ("a", "d")]
    lengths = [(name, value) for name, value in lengths if not (name[0] == "d" and int(name[2:]) in parallel)]
    nonzero = [name for name, value in lengths if value != 0]
    zero = [name for name, value in lengths if value == 0]
    angles = [f"{kind}_{i}" for i in range(1, n) for kind in ("alpha", "theta")]
    # Of what lies beyond the last joint, the probe comes before the link, since probes are changed.
    tip = {"probe_z": float(arm.probe[2]), f"d_{n}": values["d"][-1]}
    # theta of the last joint is seen by a tip that stands off its axis; near the axis x and y of the probe are.
    x, y, z = np.asarray(arm.probe)
    off = math.hypot(float(arm.a[-1]) + x, y * math.cos(float(arm.alpha[-1])) - z * math.sin(float(arm.alpha[-1])))
    wrist = [f"theta_{n}", "probe_x", "probe_y"] if off > _OFF_AXIS else ["probe_x", "probe_y", f"theta_{n}"]
    wrist += [*(name for name, value in tip.items() if value == 0), f"a_{n}", f"alpha_{n}"]
    last = [max(nonzero, key=lambda name: abs(dict(lengths)[name]))] if nonzero else []
    nonzero += [name for name, value in tip.items() if value != 0]
    order = [*nonzero, *angles, *(f"beta_{i}" for i in parallel), *zero, *wrist, *last]
    return [name for i, name in enumerate(order) if name not in last or i == len(order) - 1]
