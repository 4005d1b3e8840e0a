"""Which parameters data determine: a choice of independent columns of derivatives, without near-degenerate ones.

A matrix of derivatives has full rank as soon as no combination of parameters leaves the tips exactly where they are.
Full rank does not show how well a combination is determined: a probe 0.6 mm off the last axis gives ``theta_6`` a rank
of its own, but 1 mrad of it moves no tip by more than 0.3 um once ``a_6`` and the probe have followed. So directions
are judged by size.

Let m be the RMS movement of the tips (mm) per natural step (1 mm or 1 mrad) along a direction, after the best
imitation by all other free parameters. Then

* without knowledge of the noise, the direction is near-degenerate where m < 2 um per step (`LEAST_MOVEMENT`): over
  the default half-width of a bound (10 mm, 17.5 mrad) it moves the tips by less than 35 um, about the single-point
  repeatability of a good arm, and less than the errors that the Denavit-Hartenberg model leaves (0.1 mm in robots).
  Such errors are alike in neighbouring poses, so that more poses do not average them away. Well-conditioned arms have
  10 um per step and more in their weakest direction (the arms of Cheng et al. 2018: 20 um);
* where the noise is known, also where its standard uncertainty u exceeds half of the half-width h of its bounds: with
  independent normal errors of covariance W^-1, u^2 = 1 / (v^T J^T W J v). A parameter with a rectangular distribution
  over its bounds has u = h / sqrt(3) = 0.58 h (JCGM 100, 4.3.7): there the data add little to what the bounds say
  anyway.
"""

import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import independent_columns
from ..core.numpy_or_jax import in_chunks
from ..core.text import listed
from .arm import (
    NEARLY_PARALLEL,
    Arm,
    JointLimits,
    check_columns,
    correction_names,
    is_length,
    jacobian_at,
    joint_limits,
    natural_steps,
    neighbouring_arm,
    probe_names,
    tips_of,
    with_arrays,
    with_chains,
)
from .corrections import unit_of_coefficient
from .inverse_kinematics import SocketPoses, project_to_centroids, project_to_targets
from .robots import chains_of, mount_names

LEAST_MOVEMENT = 2e-3  # mm at the tips per natural step
SHARE_OF_BOUNDS = 0.5  # of a half-width, that a standard uncertainty may reach
_OFF_AXIS = 5.0  # mm
_INDEPENDENT = 1e-6  # least share of a column that the columns chosen before it do not imitate
_SOCKETS, _STARTS = 6, 40  # of generic data: 240 configurations, one compiled program
_ZERO = 1e-8  # singular values below this, of the largest, are zero: exact degeneracy, which is named elsewhere
_PARTNER = 0.05  # of the largest partner of a parameter: smaller ones are not named
_PARTNERS_NAMED = 3
_EQUAL = 1e-6  # relative differences below this are rounding

Readings = Float[np.ndarray, "m n"]
PoseRows = Float[np.ndarray, "N 3 p"]
LengthRows = Float[np.ndarray, "l p"]


def equations(arm: Arm, capture: SocketPoses, names: Sequence[str], q: Readings) -> tuple[PoseRows, LengthRows]:
    """Derivatives of tips less their socket's mean, and of reference lengths, at configurations; mm per mm or rad."""
    starts = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])

    def socket_means(values: Float[np.ndarray, "N ..."]) -> Float[np.ndarray, "s ..."]:
        return np.add.reduceat(values, starts, axis=0) / np.reshape(capture.sizes, (-1, *(1,) * (values.ndim - 1)))

    columns, ends = jacobian_at(arm, q, names), capture.ends()
    means, centroids = socket_means(columns), socket_means(in_chunks(lambda rows: np.asarray(arm.position(rows)), q))
    between = centroids[ends[:, 1]] - centroids[ends[:, 0]]
    directions = between / np.linalg.norm(between, axis=1, keepdims=True)  # d|b - a| = e . (db - da), e from a to b
    lengths = np.einsum("lc,lcp->lp", directions, means[ends[:, 1]] - means[ends[:, 0]])
    return columns - means[capture.owner], lengths


def rigid_motions(tips: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3 6"]:
    """How tips move with the whole arm: by 1 mm along each axis, and by 1 mrad about each axis of the base; mm."""
    rotations = np.cross(np.eye(3)[None, :, :], tips[:, None, :]).transpose(0, 2, 1)
    return np.concatenate([np.broadcast_to(np.eye(3), (len(tips), 3, 3)), rotations * 1e-3], axis=2)


def tip_movements(poses: Float[np.ndarray, "N r p"], lengths: LengthRows) -> Float[np.ndarray, "m p"]:
    """`equations` as rows whose sum of squares is the mean square over the poses plus that over the lengths."""
    return np.concatenate(
        [poses.reshape(-1, poses.shape[-1]) / math.sqrt(len(poses)), lengths / math.sqrt(max(len(lengths), 1))]
    )


def _determining(
    arm: Arm, capture: SocketPoses, names: Sequence[str], q: Any, change: Callable = np.asarray
) -> tuple[PoseRows, LengthRows]:
    """`equations` of the sockets at readings q, and the like of other observations, at readings that are changed."""
    blocks: list[Any] = [np.zeros((0, 3, len(names)))]
    lengths = np.zeros((0, len(names)))
    if capture.sizes:
        *blocks, lengths = equations(arm, capture, names, q)
    for observed in _with_common_frames(capture.observations) if arm.chains else capture.observations:
        readings = change(observed.q)
        tips, columns = np.asarray(arm.position(readings)), jacobian_at(arm, readings, names)
        # A frame that is not known imitates motions of the whole arm, a scale all tips, a target its probe. What these
        # explain is projected out of the columns: what is left is what the positions say of the parameters.
        unknown = [rigid_motions(tips)]
        if not observed.fixes_scale:
            unknown.append(tips[:, :, None] * 1e-3)
        if observed.target:
            unknown.append(jacobian_at(arm, readings, probe_names(tips_of(arm))))
        rows = columns.reshape(-1, len(names))
        basis, sizes, _ = np.linalg.svd(np.concatenate(unknown, axis=2).reshape(len(rows), -1), full_matrices=False)
        basis = basis[:, sizes > 1e-10 * sizes[0]]
        blocks.append((rows - basis @ (basis.T @ rows)).reshape(columns.shape))
    return np.concatenate(blocks), lengths


def _with_common_frames(observations: Sequence[Any]) -> list[Any]:
    """Observations of a robot, those that have some unknown geometry in common as one: in the frame of one instrument
    they say where the bases of two chains are."""
    groups: list[tuple[set[str], list[Any]]] = []
    for observation in observations:
        names = {name for name in observation.unknowns if not name.startswith("offset of ")}
        joined = [group for group in groups if group[0] & names]
        groups = [group for group in groups if group not in joined]
        members = [member for _, some in joined for member in some]
        groups.append((names.union(*(some for some, _ in joined)), [*members, observation]))
    return [
        SimpleNamespace(
            q=np.concatenate([np.asarray(member.q) for member in members]),
            fixes_scale=any(member.fixes_scale for member in members),
            target=any(member.target for member in members),
        )
        for _, members in groups
    ]


def _independent(order: list[str], rows: Float[np.ndarray, "r p"]) -> tuple[str, ...]:
    """The parameters whose columns those before them do not imitate."""
    # 1e-7 mm at the tip for a step of 1 mm, and of 1 mrad: less is rounding of a column that is 0.
    least = np.maximum(_INDEPENDENT * np.linalg.norm(rows, axis=0), 1e-7 / natural_steps(order))
    return tuple(order[i] for i in independent_columns(rows, least))


def determined_at(
    arm: Arm, capture: SocketPoses, order: Sequence[str], change: Callable[[Readings], Readings]
) -> tuple[str, ...]:
    """The first of these parameters that are independent at the poses of a capture, once ``change`` has made other
    readings of them. Tips that do not meet in their socket then are no matter: what imitates what stays the same."""

    def changed(q: Any) -> Readings:
        return change(np.array(q)[:, : arm.joints + bool(arm.chains)])

    poses, lengths = _determining(arm, capture, order, changed(capture.q) if capture.sizes else None, changed)
    return _independent(list(order), np.concatenate([poses.reshape(-1, len(order)), lengths]))


def nearly_parallel(arm: Arm) -> list[int]:
    """Joints, from 1, whose axis is nearly parallel to the next, where D-H is singular (Hayati and Mirmirani 1985)."""
    if arm.chains:
        pairs = [(chain, i) for chain in chains_of(arm).values() for i in nearly_parallel(chain.arm)]
        return sorted({int(chain.names[f"d_{i}"].rpartition("_")[2]) for chain, i in pairs})
    return [i + 1 for i in range(arm.joints - 1) if abs(np.sin(float(arm.alpha[i]))) < NEARLY_PARALLEL]


def independent_names(arm: Arm, capture: SocketPoses) -> tuple[Arm, tuple[str, ...]]:
    """A largest set of parameters that a capture determines, and the arm (with beta where needed).

    Parameters are taken one after the other (`_order`), and fixed where those taken before can imitate them, and at
    last the first parameter of every near-degenerate combination. Observations besides sockets count as positions of
    the tip in an unknown frame.
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
            before, taken = taken, _independent(order, np.concatenate([poses.reshape(-1, len(order)), lengths]))
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


def _order(arm: Arm, parallel: list[int]) -> list[str]:
    """Parameters in the order in which they are preferred.

    Nonzero lengths come first, then angles, lengths that are nominally zero, the probe and the last link. Before the
    longest link come the coefficients of corrections, since a harmonic may imitate a zero offset, but not replace it;
    the longest link is last of all, so that it is fixed where neither a reference length, another observation nor a
    prismatic joint fixes the scale. The orders of a robot's chains are merged, after the parameters of bases. Where
    neighbouring axes are nearly parallel, ``d_i`` is fixed and ``beta_i`` is
    free. Of a prismatic joint i, ``a_i`` and ``d_(i+1)`` are fixed rather than others, and ``theta_i`` next to a
    parallel axis: three angles and ``theta`` of the joint before it, or after it, are all that the orientation of the
    next axis has.
    """
    if arm.chains:
        ranks: dict[str, float] = {}
        for chain in chains_of(arm).values():
            own = _order(chain.arm, nearly_parallel(chain.arm))
            for rank, name in enumerate(own, start=1):
                ranks.setdefault(chain.names[name], rank / len(own))
        bases = [name for chain in chains_of(arm).values() for name in mount_names(chain)]
        return [*bases, *sorted(ranks, key=ranks.__getitem__)]
    n, (x, y, z) = arm.joints, np.asarray(arm.probe)
    values = {kind: np.asarray(getattr(arm, kind)) for kind in ("a", "d")}
    pairs = [(kind, i) for i in range(1, n) for kind in ("a", "d") if kind == "a" or i not in parallel]
    lengths = {f"{kind}_{i}": values[kind][i - 1] for kind, i in pairs}
    late = {name for i in arm.prismatic for name in (f"a_{i}", f"d_{i + 1}")}
    late |= {f"theta_{i}" for i in arm.prismatic if {i - 1, i} & set(parallel)}
    early = [name for name in lengths if name not in late]
    nonzero, zero = [name for name in early if lengths[name] != 0], [name for name in early if lengths[name] == 0]
    longest = max(nonzero, key=lambda name: abs(lengths[name]), default="")
    angles = [f"{kind}_{i}" for i in range(1, n) for kind in ("alpha", "theta")]
    # Of what lies beyond the last joint, the probe comes before the link, since probes are changed.
    tip = {"probe_z": float(z), f"d_{n}": values["d"][-1]}
    # theta of the last joint is determined by a tip off its axis; near the axis x and y of the probe are.
    off = math.hypot(float(arm.a[-1]) + x, y * math.cos(float(arm.alpha[-1])) - z * math.sin(float(arm.alpha[-1])))
    wrist = [f"theta_{n}", "probe_x", "probe_y"] if off > _OFF_AXIS else ["probe_x", "probe_y", f"theta_{n}"]
    order = [*nonzero, *(name for name, value in tip.items() if value != 0)]
    order += [name for name in angles if name not in late]
    order += [*(f"beta_{i}" for i in parallel), *zero, *wrist, *(name for name, value in tip.items() if value == 0)]
    order += [f"a_{n}", f"alpha_{n}", *(name for name in (*lengths, *angles) if name in late)]
    order += [name for name in correction_names(arm) if not name.startswith("gravity_")]
    return [*(name for name in dict.fromkeys(order) if name != longest), *([longest] if longest else [])]


def poses_in_sockets(q: Float[np.ndarray, "N n"], sizes: tuple[int, ...]) -> SocketPoses:
    """Poses, socket after socket, with a reference length that joins the first two sockets, or a socket to itself."""
    owner, ends = np.repeat(np.arange(len(sizes)), sizes), np.array([[0, min(1, len(sizes) - 1)]])
    return SimpleNamespace(q=q, columns=q.shape[1], sizes=sizes, owner=owner, observations=(), ends=lambda: ends)


def generic_poses(arm: Arm, limits: JointLimits | None = None) -> SocketPoses:
    """What a thorough calibration would record, without noise: poses in several sockets and one reference length.

    The sockets are where configurations of a fixed seed within the limits (default: the arm's own) put the tip.
    """
    random = np.random.default_rng(0)
    limits = np.asarray(joint_limits(arm, None)) if limits is None else limits
    if arm.chains:  # positions of all tips in one frame
        q = random.uniform(limits[:, 0], limits[:, 1], (_SOCKETS * _STARTS, arm.joints))
        q = with_chains(arm, q)
        seen = SimpleNamespace(q=q, unknowns={"frame": ()}, fixes_scale=True, target="")
        return SimpleNamespace(q=q[:0], columns=q.shape[1], sizes=(), owner=(), observations=(seen,), ends=None)
    first = random.uniform(limits[:, 0], limits[:, 1], (_SOCKETS, arm.joints))
    owner = np.repeat(np.arange(_SOCKETS), _STARTS)
    starts = random.uniform(limits[:, 0], limits[:, 1], (len(owner), arm.joints))
    q, arrived = project_to_targets(arm, starts, np.asarray(arm.position(first))[owner], limits)
    sockets = [np.concatenate([first[i : i + 1], q[arrived & (owner == i)]]) for i in range(_SOCKETS)]
    return poses_in_sockets(np.concatenate(sockets), tuple(len(socket) for socket in sockets))


class TradeOff(NamedTuple):
    """A near-degenerate direction: a parameter and those that imitate it. Amounts in natural steps (1 mm, 1 mrad)."""

    names: tuple[str, ...]  # the parameter to fix, then those that imitate it, the strongest first
    amounts: tuple[float, ...]  # how much of each imitates one step of the first; 1 for the first
    movement: float  # what one step moves the tips after the imitation, RMS, mm
    u: float  # standard uncertainty of the first from the data, in steps; infinite where the noise is not known
    half_width: float  # of the bounds of the first, in steps; infinite where not known

    @property
    def text(self) -> str:
        """The trade-off in words."""
        (first, *others), movement = self.names, f"{1e3 * self.movement:.2g} um"
        step = _step(first)
        text = f"a change of 1 {step} in {first} moves the tips by only {movement}"
        if others:
            pairs = list(zip(self.amounts[1:], others, strict=True))[:_PARTNERS_NAMED]
            imitation = listed(f"{amount:.2g} {_step(name)} of {name}" for amount, name in pairs)
            text = f"{first} and {others[0]} trade off: 1 {step} of {first} has the same effect as {imitation}"
            text += f" to within {movement}"
        if np.isfinite(self.u):  # half-widths are known where the noise is
            text += f" (u = {self.u:.3g} {step}, bounds +-{self.half_width:.3g} {step})"
        return text


def _step(name: str) -> str:
    """The natural step of a parameter; 0.001 in the unit of a coefficient of a joint correction."""
    unit = unit_of_coefficient(name)
    return "mm" if is_length(name) else "per mille" if unit == "1" else unit.replace("rad", "mrad") or "mrad"


def trade_offs(
    movements: Float[np.ndarray, "r p"],
    names: Sequence[str],
    *,
    whitened: Float[np.ndarray, "w p"] | None = None,
    half_widths: Float[np.ndarray, " p"] | None = None,
) -> tuple[TradeOff, ...]:
    """Near-degenerate directions of a linearised identification, the weakest first.

    Args:
        movements: Rows whose sum of squares along a direction is the squared RMS movement, mm, per natural step.
        names: The parameters of the columns.
        whitened: The same equations in standard deviations, where the noise is known.
        half_widths: Of the bounds, in natural steps; needed with ``whitened``.
    """
    units = np.ones(len(names)) if half_widths is None else np.where(half_widths > 0, half_widths, 1e-12)
    rows = movements if whitened is None else whitened
    # One uncertainty in units of the bounds: the singular values of the scaled rows are its inverse.
    _, singular, vectors = np.linalg.svd(rows * units, full_matrices=False)
    singular = singular[singular > _ZERO * max(singular[0], 1e-300)]
    vectors = vectors[: len(singular)] * units
    vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    weak = np.linalg.norm(movements @ vectors.T, axis=0) < LEAST_MOVEMENT
    if whitened is not None:
        weak |= singular * SHARE_OF_BOUNDS < 1
    if not weak.any():
        return ()
    leading = reduced_echelon(vectors[weak].T)[1]
    fixed = np.isin(np.arange(len(names)), leading)
    # The best imitation of one step of each by all that do not lead a trade-off themselves.
    imitations = np.linalg.lstsq(rows[:, ~fixed], rows[:, leading], rcond=_ZERO)[0].T
    directions = np.zeros((len(leading), len(names)))
    directions[:, ~fixed], directions[np.arange(len(leading)), leading] = -imitations, 1.0
    weakest = []
    for i, direction in zip(leading, directions, strict=True):
        largest = np.abs(np.delete(direction, i)).max(initial=0.0)
        by_size = [int(j) for j in np.argsort(-np.abs(direction), kind="stable")]
        order = [j for j in by_size if j != i and abs(direction[j]) > _PARTNER * largest]
        u = np.inf if whitened is None else float(1 / max(np.linalg.norm(whitened @ direction), 1e-300))
        half_width = np.inf if half_widths is None else float(half_widths[i])
        amounts = (1.0, *(float(-direction[j]) for j in order))
        movement = float(np.linalg.norm(movements @ direction))
        weakest.append(TradeOff(tuple(names[j] for j in (i, *order)), amounts, movement, u, half_width))
    return tuple(sorted(weakest, key=lambda trade_off: trade_off.movement))


def reduced_echelon(basis: Float[np.ndarray, "p r"]) -> tuple[Float[np.ndarray, "p r"], list[int]]:
    """The same space by vectors that are each 0 at the other vectors' leading parameters, and these parameters.

    The parameter that the remaining space changes most leads, and of equal ones the first, so that a processor's
    rounding does not decide.
    """
    rest, leading = basis.copy(), []
    for _ in range(basis.shape[1]):
        sizes = np.linalg.norm(rest, axis=1)
        leading.append(int(np.argmax(sizes > (1 - _EQUAL) * sizes.max())))
        direction = rest[leading[-1]] / sizes[leading[-1]]
        rest -= np.outer(rest @ direction, direction)
    return basis @ np.linalg.inv(basis[leading]), leading
