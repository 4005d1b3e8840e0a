"""Which parameters a capture can tell apart at all: the tips' derivatives, made consistent, and a choice of independent ones."""

import math
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..core.errors import InputError
from ..data.capture import Capture
from ..data.simulation import approach
from .arm import LENGTHS, Arm, locate, replace
from .parameters import Parameters

_BLOCK = 256  # poses at a time: one compiled program for captures of every size
_SETTLED = 1e-6  # mm
_OFF_AXIS = 5.0  # mm
_INDEPENDENT = 1e-6  # of a column's size must stand apart from the columns chosen before it
NEARLY_PARALLEL = 0.02  # |sin alpha|, about 1 degree


def settled(arm: Arm, capture: Capture, stands: Arm | None = None) -> Float[np.ndarray, "N n"]:
    """The poses of a capture moved, as little as possible, until each tip rests in its socket's centroid by this arm; or by the
    arm that ``stands`` in its place.

    A nominal arm that is mm off scatters the tips, and scattered tips make directions look determined that are not: turning
    the whole arm about its base moves them.
    """
    q = np.asarray(capture.q)
    owner = capture.owner
    by = arm if stands is None else stands
    tips = in_blocks(lambda rows: np.asarray(by.position(rows)), q)
    sizes = np.asarray(capture.sizes)
    sums = np.stack([np.bincount(owner, weights=tips[:, axis]) for axis in range(3)], axis=1)
    targets = (sums / sizes[:, None])[owner]
    moved, reached = moved_onto(arm, q, targets)
    return np.where(reached[:, None], moved, q)


def moved_onto(
    arm: Arm, q: Float[np.ndarray, "N n"], targets: Float[np.ndarray, "N 3"], limits: Float[np.ndarray, "n 2"] | None = None
) -> tuple[Float[np.ndarray, "N n"], Bool[np.ndarray, " N"]]:
    """Poses moved by least steps until the tip is at its target, within limits (default: none), and which of them arrived."""
    allowed = jnp.asarray(np.tile([-np.inf, np.inf], (arm.joints, 1)) if limits is None else limits)

    def moved(rows: np.ndarray) -> np.ndarray:
        found, distance = approach(arm.geometry, jnp.asarray(rows[:, :-3]), jnp.asarray(rows[:, -3:]), allowed)
        return np.hstack([np.asarray(found), np.asarray(distance)[:, None]])

    found = in_blocks(moved, np.hstack([q, targets]))
    return found[:, :-1], found[:, -1] <= _SETTLED


def columns_at(arm: Arm, q: Float[np.ndarray, "N n"], names: Sequence[str]) -> Float[np.ndarray, "N 3 p"]:
    """Derivatives of the tips by named parameters at poses."""
    return in_blocks(lambda rows: np.asarray(arm.jacobian(rows, names)), q)


def equations(
    arm: Arm, capture: Capture, names: Sequence[str], q: Float[np.ndarray, "N n"]
) -> tuple[Float[np.ndarray, "N 3 p"], Float[np.ndarray, "l p"]]:
    """Derivatives of what a capture determines: tips less their socket's mean, and reference lengths; poses at ``q``."""
    columns = columns_at(arm, q, names)
    owner, sizes = capture.owner, np.asarray(capture.sizes, dtype=float)
    starts = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    means = np.add.reduceat(columns, starts, axis=0) / sizes[:, None, None]
    tips = in_blocks(lambda rows: np.asarray(arm.position(rows)), q)
    centroids = np.add.reduceat(tips, starts, axis=0) / sizes[:, None]
    ends = capture.ends()
    between = centroids[ends[:, 1]] - centroids[ends[:, 0]]
    directions = between / np.linalg.norm(between, axis=1, keepdims=True)
    lengths = np.einsum("lc,lcp->lp", directions, means[ends[:, 1]] - means[ends[:, 0]])
    return columns - means[owner], lengths


def jittered(arm: Arm, space: Parameters) -> Arm:
    """The arm beside itself by about 1 mm and 1 mrad: out of a special position that only the nominal arm has."""
    step = np.random.default_rng(0).normal(size=len(space.names)) * np.asarray(space.scale)
    return space.arm(np.asarray(space.vector(arm)) + step)


def nearly_parallel(arm: Arm) -> list[int]:
    """Joints, from 1, whose axis is nearly parallel to the next: there plain D-H is singular (Hayati and Mirmirani 1985)."""
    return [i + 1 for i in range(arm.joints - 1) if abs(np.sin(float(arm.alpha[i]))) < NEARLY_PARALLEL]


def independent_names(arm: Arm, capture: Capture) -> tuple[Arm, tuple[str, ...]]:
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
        beside = jittered(arm, Parameters(arm, taken or tuple(order)))
        before, taken = taken, _independent(beside, arm, capture, order)
        if taken == before or not taken:
            break
    return arm, taken


def _independent(arm: Arm, stands: Arm, capture: Capture, order: list[str]) -> tuple[str, ...]:
    """Those whose columns stand apart from the columns of those before them; poses hold sockets where another arm puts them."""
    poses, lengths = equations(arm, capture, order, settled(arm, capture, stands))
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


def in_blocks(work: Callable[[np.ndarray], np.ndarray], rows: np.ndarray) -> np.ndarray:
    """``work`` on whole blocks of rows; the last is filled up with its first row."""
    pieces = []
    for first in range(0, len(rows), _BLOCK):
        block = rows[first : first + _BLOCK]
        filled = np.concatenate([block, np.repeat(block[:1], _BLOCK - len(block), axis=0)])
        pieces.append(work(filled)[: len(block)])
    return np.concatenate(pieces)
