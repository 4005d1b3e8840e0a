"""A largest set of parameters that data determine: a choice of independent columns of derivatives."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..core.linear_algebra import independent_columns
from ..core.numpy_or_jax import in_chunks
from .arm import (
    LENGTHS,
    Arm,
    check_columns,
    correction_names,
    jacobian_at,
    joint_limits,
    locate,
    natural_steps,
    neighbouring_arm,
    with_arrays,
)
from .inverse_kinematics import SocketPoses, project_to_centroids, project_to_targets
from .near_degeneracy import trade_offs

_OFF_AXIS = 5.0  # mm
_INDEPENDENT = 1e-6  # least share of a column that the columns chosen before it do not imitate
_SOCKETS, _STARTS = 6, 40  # of generic data: 240 configurations, one compiled program
NEARLY_PARALLEL = 0.02  # |sin alpha|, about 1 degree


def equations(
    arm: Arm, capture: SocketPoses, names: Sequence[str], q: Float[np.ndarray, "N n"]
) -> tuple[Float[np.ndarray, "N 3 p"], Float[np.ndarray, "l p"]]:
    """Derivatives of tips less their socket's mean, and of reference lengths, at configurations; mm per mm or rad."""
    columns = jacobian_at(arm, q, names)
    means = _socket_means(columns, capture)
    centroids = _socket_means(in_chunks(lambda rows: np.asarray(arm.position(rows)), q), capture)
    ends = capture.ends()
    between = centroids[ends[:, 1]] - centroids[ends[:, 0]]
    directions = between / np.linalg.norm(between, axis=1, keepdims=True)  # d|b - a| = e . (db - da), e from a to b
    lengths = np.einsum("lc,lcp->lp", directions, means[ends[:, 1]] - means[ends[:, 0]])
    return columns - means[capture.owner], lengths


def rigid_motions(tips: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3 6"]:
    """How tips move with the whole arm: by 1 mm along each axis, and by 1 mrad about each axis of the base; mm."""
    rotations = np.cross(np.eye(3)[None, :, :], tips[:, None, :]).transpose(0, 2, 1)
    return np.concatenate([np.broadcast_to(np.eye(3), (len(tips), 3, 3)), rotations * 1e-3], axis=2)


def determined_at(
    arm: Arm,
    capture: SocketPoses,
    order: Sequence[str],
    change: Callable[[Float[np.ndarray, "m n"]], Float[np.ndarray, "m n"]],
) -> tuple[str, ...]:
    """The first of these parameters that are independent at the poses of a capture, once ``change`` has made other
    readings of them. Tips that do not meet in their socket then are no matter: what imitates what stays the same."""

    def changed(q: Any) -> Float[np.ndarray, "m n"]:
        return change(np.array(q)[:, : arm.joints])

    poses, lengths = _determining(arm, capture, order, changed(capture.q) if capture.sizes else None, changed)
    return _independent(arm, list(order), np.concatenate([poses.reshape(-1, len(order)), lengths]))


def _determining(
    arm: Arm, capture: SocketPoses, names: Sequence[str], q: Any, change: Callable = np.asarray
) -> tuple[Float[np.ndarray, "N 3 p"], Float[np.ndarray, "l p"]]:
    """`equations` of the sockets at readings q, and the like of other observations, at readings that are changed."""
    blocks, lengths = [np.zeros((0, 3, len(names)))], np.zeros((0, len(names)))
    if capture.sizes:
        *blocks, lengths = equations(arm, capture, names, q)
    blocks += [_of_positions(arm, observed, names, change(observed.q)) for observed in capture.observations]
    return np.concatenate(blocks), lengths


def _of_positions(
    arm: Arm, observed: Any, names: Sequence[str], q: Float[np.ndarray, "m n"]
) -> Float[np.ndarray, "m 3 p"]:
    """Derivatives of tips that were measured in an unknown frame, less what that frame, an unknown place of a target
    and, where nothing fixes it, the scale imitate."""
    tips = np.asarray(arm.position(q))
    # A frame that is not known imitates motions of the whole arm, a scale all tips, a target its probe. What these
    # explain is projected out of the columns: what is left is what the positions say of the parameters.
    unknown = [rigid_motions(tips)]
    if not observed.fixes_scale:
        unknown.append(tips[:, :, None] * 1e-3)
    if observed.target:
        unknown.append(jacobian_at(arm, q, ("probe_x", "probe_y", "probe_z")))
    columns = jacobian_at(arm, q, names)
    rows = columns.reshape(-1, len(names))
    basis, sizes, _ = np.linalg.svd(np.concatenate(unknown, axis=2).reshape(len(rows), -1), full_matrices=False)
    basis = basis[:, sizes > 1e-10 * sizes[0]]
    return (rows - basis @ (basis.T @ rows)).reshape(columns.shape)


def _socket_means(values: Float[np.ndarray, "N ..."], capture: SocketPoses) -> Float[np.ndarray, "s ..."]:
    starts = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    sums = np.add.reduceat(values, starts, axis=0)
    return sums / np.reshape(capture.sizes, (-1, *(1,) * (values.ndim - 1)))


def nearly_parallel(arm: Arm) -> list[int]:
    """Joints, from 1, whose axis is nearly parallel to the next, where D-H is singular (Hayati and Mirmirani 1985)."""
    return [i + 1 for i in range(arm.joints - 1) if abs(np.sin(float(arm.alpha[i]))) < NEARLY_PARALLEL]


def independent_names(arm: Arm, capture: SocketPoses) -> tuple[Arm, tuple[str, ...]]:
    """A largest set of parameters that a capture determines, and the arm (with beta where needed).

    Parameters are taken one after the other, and fixed where those taken before can imitate them: nonzero lengths
    first, then angles, lengths that are nominally zero, the probe and the last link; the longest link comes last of
    all, so that it is fixed where neither a reference length, another observation nor a prismatic joint fixes the
    scale. Before it come the coefficients of corrections, since a harmonic may imitate a zero offset, but not replace
    it. Observations besides sockets count as positions of the tip in an unknown frame. Where neighbouring
    axes are nearly parallel, ``d_i`` is fixed and ``beta_i`` is free. Of a prismatic joint i, ``a_i`` and ``d_(i+1)``
    are fixed rather than others, and ``theta_i`` next to a parallel axis: three angles and ``theta`` of the joint
    before it, or after it, are all that the orientation of the next axis has. At last the first parameter of every
    near-degenerate combination is fixed (`near_degeneracy`).
    """
    check_columns(arm, capture.columns)
    parallel = nearly_parallel(arm)
    if parallel and arm.beta is None:
        arm = with_arrays(arm, beta=np.zeros_like(arm.alpha))
    order = _order(arm, parallel)
    taken: tuple[str, ...] = ()
    while order:
        for _ in range(5):
            # Without the exact alignments of the nominal arm. Fixed parameters keep their nominal values, which may
            # make others redundant, so the choice is repeated.
            neighbour = neighbouring_arm(arm, taken or tuple(order))
            q = project_to_centroids(neighbour, capture, arm) if capture.sizes else None
            poses, lengths = _determining(neighbour, capture, order, q)
            rows = np.concatenate([poses.reshape(-1, len(order)), lengths])
            before, taken = taken, _independent(neighbour, order, rows)
            if taken == before or not taken:
                break
        columns = [order.index(name) for name in taken]
        rows = (tip_movements(poses, lengths) * natural_steps(order))[:, columns]
        weak = {trade_off.names[0] for trade_off in trade_offs(rows, taken)} if taken else set()
        if not weak:
            break
        # What a parameter of a weak combination stood for may be what another, so far redundant, determines well.
        order = [name for name in order if name not in weak]
    return arm, taken


def tip_movements(poses: Float[np.ndarray, "N r p"], lengths: Float[np.ndarray, "l p"]) -> Float[np.ndarray, "m p"]:
    """`equations` as rows whose sum of squares is the mean square over the poses plus that over the lengths."""
    return np.concatenate(
        [poses.reshape(-1, poses.shape[-1]) / math.sqrt(len(poses)), lengths / math.sqrt(max(len(lengths), 1))]
    )


@dataclass
class PosesInSockets:
    """`SocketPoses` with a reference length that joins the first two sockets, or a socket to itself."""

    q: Float[np.ndarray, "N n"]
    sizes: tuple[int, ...]
    observations: tuple[Any, ...] = ()

    @property
    def columns(self) -> int:
        """Number of columns of the readings."""
        return self.q.shape[1]

    @property
    def owner(self) -> Int[np.ndarray, " N"]:
        """Index of the socket of each pose."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)

    def ends(self) -> Int[np.ndarray, "l 2"]:
        """Socket indices of both ends of the length."""
        return np.array([[0, min(1, len(self.sizes) - 1)]])


def generic_poses(arm: Arm, limits: Float[np.ndarray, "n 2"] | None = None) -> SocketPoses:
    """What a thorough calibration would record, without noise: poses in several sockets and one reference length.

    The sockets are where random configurations within the limits (default: the arm's own) put the tip; the same arm
    always gets the same.
    """
    random = np.random.default_rng(0)
    limits = np.asarray(joint_limits(arm, None)) if limits is None else limits
    first = random.uniform(limits[:, 0], limits[:, 1], (_SOCKETS, arm.joints))
    owner = np.repeat(np.arange(_SOCKETS), _STARTS)
    starts = random.uniform(limits[:, 0], limits[:, 1], (len(owner), arm.joints))
    q, arrived = project_to_targets(arm, starts, np.asarray(arm.position(first))[owner], limits)
    sockets = [np.concatenate([first[i : i + 1], q[arrived & (owner == i)]]) for i in range(_SOCKETS)]
    return PosesInSockets(np.concatenate(sockets), tuple(len(socket) for socket in sockets))


def _independent(arm: Arm, order: list[str], rows: Float[np.ndarray, "r p"]) -> tuple[str, ...]:
    """The parameters whose columns those before them do not imitate."""
    steps = np.array([1.0 if locate(arm, name)[0] in LENGTHS else 1e3 for name in order])
    # 1e-7 mm at the tip for a step of 1 mm, and of 1 mrad: less is rounding of a column that is 0.
    least = np.maximum(_INDEPENDENT * np.linalg.norm(rows, axis=0), 1e-7 * steps)
    return tuple(order[i] for i in independent_columns(rows, least))


def _order(arm: Arm, parallel: list[int]) -> list[str]:
    n = arm.joints
    values = {kind: np.asarray(getattr(arm, kind)) for kind in ("a", "d")}
    pairs = [(kind, i) for i in range(1, n) for kind in ("a", "d") if kind == "a" or i not in parallel]
    lengths = [(f"{kind}_{i}", values[kind][i - 1]) for kind, i in pairs]
    late = {name for i in arm.prismatic for name in (f"a_{i}", f"d_{i + 1}")}
    late |= {f"theta_{i}" for i in arm.prismatic if {i - 1, i} & set(parallel)}
    nonzero = [name for name, value in lengths if value != 0 and name not in late]
    zero = [name for name, value in lengths if value == 0 and name not in late]
    angles = [f"{kind}_{i}" for i in range(1, n) for kind in ("alpha", "theta") if f"{kind}_{i}" not in late]
    # Of what lies beyond the last joint, the probe comes before the link, since probes are changed.
    tip = {"probe_z": float(arm.probe[2]), f"d_{n}": values["d"][-1]}
    # theta of the last joint is determined by a tip off its axis; near the axis x and y of the probe are.
    x, y, z = np.asarray(arm.probe)
    off = math.hypot(float(arm.a[-1]) + x, y * math.cos(float(arm.alpha[-1])) - z * math.sin(float(arm.alpha[-1])))
    wrist = [f"theta_{n}", "probe_x", "probe_y"] if off > _OFF_AXIS else ["probe_x", "probe_y", f"theta_{n}"]
    wrist += [*(name for name, value in tip.items() if value == 0), f"a_{n}", f"alpha_{n}"]
    last = [max(nonzero, key=lambda name: abs(dict(lengths)[name]))] if nonzero else []
    nonzero += [name for name, value in tip.items() if value != 0]
    order = [*nonzero, *angles, *(f"beta_{i}" for i in parallel), *zero, *wrist]
    order += [name for name in (*dict(lengths), *(f"theta_{i}" for i in range(1, n))) if name in late]
    corrections = [name for name in correction_names(arm) if not name.startswith("gravity_")]
    order = [*dict.fromkeys(order), *corrections, *last]
    return [name for i, name in enumerate(order) if name not in last or i == len(order) - 1]
