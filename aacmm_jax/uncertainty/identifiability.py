"""What a capture determines: rank, undetermined and near-degenerate directions, observability indices."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arguments import check_finite, checked_arguments, items_of
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture, ReferenceLength, check_one_capture
from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import Arm, check_columns, correction_names, joint_limits, neighbouring_arm, with_arrays
from ..kinematics.chain import joint_motion
from ..kinematics.independence import generic_poses, nearly_parallel, tip_movements
from ..kinematics.inverse_kinematics import project_to_targets
from ..kinematics.near_degeneracy import TradeOff, trade_offs
from ..kinematics.parameters import Bounds, Parameters
from .correction_limits import by_more_sockets, why_undetermined
from .null_space import complement, named_directions, structural
from .observed_identifiability import Agreeing

_RANK = 1e-8  # singular values below this, of the largest, are zero
_NAMED = 4
_FOLLOWS = 1e-3  # part of a direction, above which a parameter belongs to it


class Observability(NamedTuple):
    """What a capture determines of the free parameters of an arm, as NumPy arrays.

    Derivatives are in natural steps (1 mm, 1 mrad) and, where the noise is given, in its standard deviations; else in
    mm. ``null`` ``(p, nullity)`` are directions that change nothing that was recorded.

    Example:
        >>> found = aj.observability(arm, capture, space)
        >>> print(found.rank, len(found.undetermined), f"{found.condition:.0f}")
        21 0 18
    """

    names: tuple[str, ...]
    poses: int
    singular: Float[np.ndarray, " p"]  # singular values, the largest first
    condition: float  # of the identifiable part, columns scaled to the same norm
    null: Float[np.ndarray, "p nullity"]
    undetermined: tuple[str, ...]  # names of the directions of ``null``
    structural: tuple[bool, ...]  # whether no capture of this kind can determine them
    remedy: str  # what else to record; empty if that would not help
    parallel: tuple[int, ...]  # joints, from 1, whose axis is nearly parallel to the next, with beta not free
    trade_offs: tuple[TradeOff, ...] = ()  # near-degenerate directions, the weakest first
    # What a prior determines, and these data do not or hardly; without coefficients of joint corrections, many of which
    # no data tell apart: that is what their prior is for.
    by_prior: tuple[str, ...] = ()
    # Why coefficients of joint corrections are among what is not determined: one sentence for each joint and cause.
    corrections: tuple[str, ...] = ()

    @property
    def rank(self) -> int:
        """Number of independent directions that the data determine."""
        return _rank(self.singular)

    @property
    def indices(self) -> dict[str, float]:
        """Observability indices O1 to O5, larger is better; all 0 if a direction is not determined.

        O1 = (prod s)^(1/L) / sqrt(m), O2 = s_L / s_1, O3 = s_L, O4 = s_L^2 / s_1, O5 = 1 / sum(1 / s), for the L
        singular values s_1 >= ... >= s_L of m poses. Sources: Borm and Menq 1991; Driels and Pathre 1990; Nahvi et
        al. 1994; Nahvi and Hollerbach 1996; Sun and Hollerbach 2008.
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
        """What a user should know, one sentence each: directions that are not or hardly determined, and what to do."""
        sentences = []
        always = [text for text, never in zip(self.undetermined, self.structural, strict=True) if never]
        now = [text for text, never in zip(self.undetermined, self.structural, strict=True) if not never]
        if always:
            sentences.append(
                f"No measurement of this kind can separate: {'; '.join(always)}. Fix one of each (--held)."
            )
        if now:
            remedy = f" {self.remedy}" if self.remedy else " Fix one of each (--held)."
            count = f"{len(now)} combinations of {len(self.names)} parameters"
            sentences.append(
                f"Not determined by these data: {'; '.join(now) if len(now) <= _NAMED else count}.{remedy}"
            )
        if self.by_prior:
            texts = list(self.by_prior[:_NAMED])
            if len(self.by_prior) > _NAMED:
                texts.append(f"{len(self.by_prior) - _NAMED} more combinations")
            sentences.append(f"Determined by the prior and not, or hardly, by these data: {'; '.join(texts)}.")
        if self.trade_offs:
            texts = [trade_off.text for trade_off in self.trade_offs[:_NAMED]]
            if len(self.trade_offs) > _NAMED:
                texts.append(f"{len(self.trade_offs) - _NAMED} more combinations")
            first = ", ".join(trade_off.names[0] for trade_off in self.trade_offs)
            sentences.append(
                f"Hardly determined by these data: {'; '.join(texts)}. Fix one of each, such as {first} (--held); "
                "wider bounds do not help."
            )
        sentences += self.corrections
        for i in self.parallel:
            sentences.append(
                f"Axes {i} and {i + 1} are nearly parallel, where d_{i} and d_{i + 1} trade off and a small tilt has "
                f"no D-H parameters: fix d_{i} and free beta_{i} (--free beta_{i})."
            )
        return sentences


@checked_arguments
def observability(
    arm: Arm,
    capture: Capture,
    space: Parameters | None = None,
    *,
    noise: Noise | None = None,
    sigma: float | None = None,
    bounds: Bounds | None = None,
    known: Iterable[str] = (),
) -> Observability:
    """What the poses, reference lengths and other observations of a capture determine of the free parameters.

    The poses are first moved to their socket's centroid, or onto the geometry of their observation, by this arm, a few
    mm at most, so that the errors of an arm that is not yet calibrated do not look like information. For
    near-degenerate directions see `kinematics.near_degeneracy`.

    Args:
        arm: The arm, nominal or calibrated.
        capture: Poses, reference lengths and other observations, whose unknown geometry is eliminated.
        space: The free parameters; by default those of ``bounds``, else those of `Parameters.free_of`.
        noise: Of readings and seat, if known: the equations are then weighted by it.
        sigma: Standard deviation of a tip coordinate, mm, such as that of the residuals; with ``noise`` it follows from
            that. With it near-degenerate is also what the data determine hardly better than the bounds.
        bounds: Bounds that ``sigma`` is compared with; by default of +-10 mm and +-17.5 mrad, the default of
            `Bounds.around`.
        known: Names of parameters that a prior determines: what the data leave open of them is told apart.

    Raises:
        InputError: Capture and arm do not fit.

    Example:
        >>> one_socket = aj.simulate(arm, {"A": (400, 200, 300)}, poses=30)
        >>> found = aj.observability(arm, one_socket, space)
        >>> print(found.rank, "of", len(found.names))
        20 of 21
        >>> print(found.sentences()[0])
        Not determined by these data: all lengths together: the scale. A reference length would determine them.
    """
    if space is None:
        space = Parameters.free_of(arm) if bounds is None else bounds.space
    check_one_capture(capture)
    check_finite(arm=arm, capture=capture, noise=noise)
    check_columns(space.base, capture.columns)
    arm, capture, space, noise, bounds = to_numpy((arm, capture, space, noise, bounds))
    if noise is not None:
        noise.check(arm.joints)
        q = np.concatenate([capture.q, *(observation.q for observation in capture.observations)])
        covariances = tip_covariances(arm.geometry, joint_motion(arm.geometry, q), noise)
        sigma = float(np.sqrt(np.trace(np.asarray(covariances)).mean() / 3))
    # Fixed values are those of the arm, not of the space's base.
    base = with_arrays(arm, beta=np.zeros_like(arm.alpha)) if arm.beta is None and space.base.beta is not None else arm
    space = Parameters(base, space.names)
    spectrum = _spectrum(base, base, capture, space, noise)
    if spectrum.rank < len(space.names):
        # A nominal arm may have an exact alignment (a probe on the last axis) that the real one does not share.
        neighbour = neighbouring_arm(base, space.names)
        other = _spectrum(neighbour, base, capture, space, noise)
        if other.rank > spectrum.rank:
            base, spectrum = neighbour, other
    rank, p = spectrum.rank, len(space.names)
    known = items_of(known, "known")
    open_directions, of_prior = _without_known(complement(spectrum.vectors[:rank], p), space, known)
    null, undetermined = named_directions(open_directions, base, space)
    always = tuple(bool(x) for x in structural(null, base, space))
    undetermined = spectrum.agreeing.named(undetermined, null)
    weak = _trade_offs(spectrum, space, sigma, bounds)
    q = np.concatenate([capture.q, *(observation.q for observation in capture.observations)])
    sockets = 0 if capture.observations else len(capture.names)
    unknown = [(_chief(one, space, 0.5), _chief(one, space, _FOLLOWS)) for one in np.abs(null.T)]
    # Of a trade-off, the parameter to fix, or its strongest partner where that is no coefficient.
    leads = [one for one in weak if not set(one.names) & set(known)]
    unknown += [(one.names[: 1 + (one.names[0] not in correction_names(base))], one.names) for one in leads]
    reasons, others = why_undetermined(base, q, unknown, sockets)
    functions = set(correction_names(base)) & set(known)
    rows = [name in functions for name in space.names]
    by_prior = named_directions(of_prior[:, ~np.any(np.abs(of_prior[rows]) > _FOLLOWS, axis=0)], base, space)[1]
    return Observability(
        names=space.names,
        poses=sum(capture.sizes) + sum(observation.q.shape[0] for observation in capture.observations),
        singular=spectrum.singular,
        condition=spectrum.condition,
        null=null,
        undetermined=undetermined,
        structural=always,
        remedy="" if all(always) or not null.shape[1] else _remedy(base, capture, space, p - sum(always)),
        parallel=tuple(i for i in nearly_parallel(arm) if _lacks_beta(space, i)),
        trade_offs=tuple(one for one in weak if not set(one.names) & set(known)),
        by_prior=(
            *by_prior,
            *(one.text for one in weak if set(one.names) & set(known) and not set(one.names) & functions),
        ),
        corrections=reasons + _by_more_sockets(base, capture, space, others),
    )


def _without_known(
    null: Float[np.ndarray, "p nullity"], space: Parameters, known: Iterable[str]
) -> tuple[Float[np.ndarray, "p open"], Float[np.ndarray, "p by_prior"]]:
    """Undetermined directions that concern no known parameter, and the others."""
    rows = null[[name in known for name in space.names]]
    if not rows.size:
        return null, null[:, :0]
    _, sizes, directions = np.linalg.svd(rows)
    rank = int(np.sum(sizes > 1e-6))
    return null @ directions[rank:].T, null @ directions[:rank].T


class _Spectrum(NamedTuple):
    rows: Float[np.ndarray, "w p"]  # of everything, natural steps; whitened where the noise is known
    movements: Float[np.ndarray, "m p"]  # rows whose sum of squares is the mean square movement of the tips, mm
    singular: Float[np.ndarray, " p"]
    vectors: Float[np.ndarray, "r p"]
    rank: int
    condition: float
    agreeing: Agreeing


def _spectrum(arm: Arm, targets_of: Arm, capture: Capture, space: Parameters, noise: Noise | None) -> _Spectrum:
    agreeing = Agreeing.of(capture, Parameters(arm, space.names), targets_of)
    plain = agreeing.eliminated()
    rows = plain if noise is None else agreeing.eliminated(noise)
    # Each pose has as many rows on average: only their number of poses counts.
    poses = plain.poses * np.sqrt(len(plain.poses) / len(agreeing.observed.q))
    return _decomposed(
        np.concatenate([rows.poses, rows.relations]), tip_movements(poses[:, None], plain.relations), agreeing
    )


def _decomposed(rows: Float[np.ndarray, "w p"], movements: Float[np.ndarray, "m p"], agreeing: Agreeing) -> _Spectrum:
    p = rows.shape[1]
    _, singular, vectors = np.linalg.svd(rows, full_matrices=False)
    singular = np.concatenate([singular, np.zeros(p - len(singular))])
    rank = _rank(singular)
    norms = np.linalg.norm(rows, axis=0)
    scale = np.where(norms > _RANK * norms.max(), norms, 1.0)  # others are rounding
    equal = np.linalg.svd(rows / scale, compute_uv=False)[:rank]
    condition = float(equal[0] / equal[-1]) if rank else np.inf
    return _Spectrum(rows, movements, singular, vectors, rank, condition, agreeing)


def _rank(singular: Float[np.ndarray, " p"]) -> int:
    return int(np.sum(singular > _RANK * max(singular[0], 1e-300)))


def _trade_offs(
    spectrum: _Spectrum, space: Parameters, sigma: float | None, bounds: Bounds | None
) -> tuple[TradeOff, ...]:
    if sigma is None or not sigma > 0:
        return trade_offs(spectrum.movements, space.names)
    rows = spectrum.agreeing.eliminated(sigma=sigma)
    whitened = np.concatenate([rows.poses, rows.relations])
    default = np.where(space.lengths, 10.0, 17.5)
    half = default
    if bounds is not None:
        half = np.asarray(bounds.upper - bounds.lower) / 2 / np.asarray(space.scale)
        half = np.where(np.isfinite(half), half, default)
    return trade_offs(spectrum.movements, space.names, whitened=whitened, half_widths=half)


def _lacks_beta(space: Parameters, i: int) -> bool:
    """Whether the angle between the nearly parallel axes i and i + 1 is identified without Hayati's beta."""
    return f"beta_{i}" not in space.names and f"alpha_{i}" in space.names


def _chief(direction: Float[np.ndarray, " p"], space: Parameters, share: float) -> tuple[str, ...]:
    """Parameters with at least this share of the largest component of a direction."""
    return tuple(space.names[i] for i in np.flatnonzero(direction > share * direction.max()))


def _by_more_sockets(arm: Arm, capture: Capture, space: Parameters, names: tuple[str, ...]) -> tuple[str, ...]:
    """A sentence on which of these coefficients poses in more sockets would determine, where some do."""
    if not names or capture.observations:
        return ()
    # The zero byte keeps the invented sockets apart from those of the capture.
    generic = generic_poses(arm)
    parts = np.split(np.asarray(generic.q), np.cumsum(generic.sizes)[:-1])
    others = {f"\0{i}": q for i, q in enumerate(parts)}
    more = Capture({**capture.sockets, **others}, capture.lengths)
    spectrum = _spectrum(arm, arm, more, space, None)
    lost = complement(spectrum.vectors[: spectrum.rank], len(space.names))
    left = {space.names[i] for i in np.flatnonzero(np.any(np.abs(lost) > _FOLLOWS, axis=1))}
    left |= {trade_off.names[0] for trade_off in _trade_offs(spectrum, space, None, None)}
    determined = [name for name in names if name not in left]
    return (by_more_sockets(determined),) if determined else ()


def _remedy(arm: Arm, capture: Capture, space: Parameters, rank: int) -> str:
    """Which further data would give that rank: tried one after the other, the least effort first."""
    random = np.random.default_rng(0)
    limits = np.asarray(joint_limits(arm, None))
    # The zero byte keeps the invented sockets apart from those of the capture.
    q = random.uniform(limits[:, 0], limits[:, 1], (4, arm.joints))
    temperature = np.asarray(capture.readings)[: len(q), arm.joints :][:1]
    q = np.concatenate([q, np.repeat(temperature, len(q), axis=0)], axis=1)
    more_sockets = {f"\0{i}": row[None] for i, row in enumerate(q)}
    one_length = [ReferenceLength("\0000", "\0001", 1.0)]
    two_lengths = [*one_length, ReferenceLength("\0002", "\0003", 1.0)]
    more_poses = {}
    for first, readings in list(capture.sockets.items())[:1]:
        more_poses = {f"\0 {first}": _other_configurations(arm, np.asarray(readings)[0], random)}
    warmer = {}
    if capture.columns > arm.joints:
        warmer = {f"\0 {name}": _warmer_too(np.asarray(readings)) for name, readings in capture.sockets.items()}
    length = "a second position of the reference length" if capture.lengths else "a reference length"
    for text, sockets, lengths in (
        ("Poses in the same sockets at other temperatures would determine them.", warmer, []),
        (f"{length[0].upper()}{length[1:]} would determine them.", more_sockets, one_length),
        ("Reference lengths at two more positions would determine them.", more_sockets, two_lengths),
        ("More poses in a socket, as different as possible, would determine them.", more_poses, []),
        (f"More poses in a socket, and {length}, would determine them.", more_poses | more_sockets, one_length),
    ):
        if not sockets:
            continue
        more = Capture({**capture.sockets, **sockets}, [*capture.lengths, *lengths], capture.observations)
        if _spectrum(arm, arm, more, space, None).rank >= rank:
            return text
    return ""


def _warmer_too(q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "2*m n"]:
    """The same configurations, and once more 10 K warmer."""
    warmer = q.copy()
    warmer[:, -1] += 10.0
    return np.concatenate([q, warmer])


def _other_configurations(arm: Arm, q: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Other configurations with the tip where ``q`` has it."""
    starts = np.tile(q, (60, 1))
    starts[:, : arm.joints] += random.uniform(-1.5, 1.5, (60, arm.joints))
    configurations, reached = project_to_targets(arm, starts, np.tile(np.asarray(arm.position(q)), (60, 1)))
    return configurations[reached] if reached.any() else q[None]
