"""What a capture determines: rank, undetermined and near-degenerate directions, observability indices."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.arguments import check_finite, checked_arguments, items_of
from ..core.numpy_or_jax import to_numpy
from ..core.text import listed
from ..data.capture import Capture, ReferenceLength, check_one_capture
from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import (
    Arm,
    check_columns,
    correction_names,
    jacobian_at,
    joint_limits,
    neighbouring_arm,
    with_arrays,
)
from ..kinematics.chain import Geometry, joint_motion
from ..kinematics.independence import (
    TradeOff,
    generic_poses,
    nearly_parallel,
    reduced_echelon,
    rigid_motions,
    tip_movements,
    trade_offs,
)
from ..kinematics.inverse_kinematics import project_to_targets
from ..kinematics.parameters import Bounds, Parameters
from .observed_identifiability import Agreeing, why_undetermined

_RANK = 1e-8  # singular values below this, of the largest, are zero
_NAMED, _PARAMETERS_NAMED, _PARTS_NAMED = 4, 6, 3  # directions in a sentence, and parts of one
_FOLLOWS = 1e-3  # part of a direction, above which a parameter belongs to it
_PRESENT = 1e-4  # of a direction's largest component: smaller ones are left out of its name
_MOVED = 1e-4  # of the same: parts of the geometry that change less do not follow
_CONFIGURATIONS = 100


class Observability(NamedTuple):
    """What a capture determines of the free parameters of an arm, as NumPy arrays.

    Derivatives are in natural steps (1 mm, 1 mrad) and, where the noise is given, in its standard deviations; else in
    mm. ``null`` ``(p, nullity)`` are directions that change nothing that was recorded.

    Example:
        >>> analysis = aj.observability(arm, capture, space)
        >>> print(analysis.rank, len(analysis.undetermined), f"{analysis.condition:.0f}")
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
        return int(np.sum(self.singular > _RANK * self.singular.max(initial=1e-300)))

    @property
    def indices(self) -> dict[str, float]:
        """Observability indices O1 to O5, larger is better; all 0 if a direction is not determined.

        O1 = (prod s)^(1/L) / sqrt(m), O2 = s_L / s_1, O3 = s_L, O4 = s_L^2 / s_1, O5 = 1 / sum(1 / s), for the L
        singular values s_1 >= ... >= s_L of m poses. Sources: Borm and Menq 1991; Driels and Pathre 1990; Nahvi et
        al. 1994; Nahvi and Hollerbach 1996; Sun and Hollerbach 2008.
        """
        s = self.singular
        if self.rank < len(self.names) or not self.names:
            return dict.fromkeys(("O1", "O2", "O3", "O4", "O5"), 0.0)
        return {
            "O1": float(np.exp(np.mean(np.log(s))) / np.sqrt(self.poses)),
            "O2": float(s[-1] / s[0]),
            "O3": float(s[-1]),
            "O4": float(s[-1] ** 2 / s[0]),
            "O5": float(1 / np.sum(1 / s)),
        }

    def sentences(self) -> list[str]:
        """What a user should know, one sentence each: directions that are not or poorly determined, and what to do."""
        sentences = []
        pairs = list(zip(self.undetermined, self.structural, strict=True))
        always, now = ([text for text, never in pairs if never == wanted] for wanted in (True, False))
        if always:
            sentences.append(
                f"Not determined by any measurement of this kind: {'; '.join(always)}. Fix one parameter of each "
                "combination (--held)."
            )
        if now:
            remedy = self.remedy or "Fix one parameter of each combination (--held)."
            sentences.append(f"Not determined by these data: {_first(now)}. {remedy}")
        if self.by_prior:
            sentences.append(
                f"Determined by the prior, and hardly or not at all by these data: {_first(self.by_prior)}."
            )
        if self.trade_offs:
            texts = _first([trade_off.text for trade_off in self.trade_offs])
            first = ", ".join(trade_off.names[0] for trade_off in self.trade_offs)
            sentences.append(
                f"Poorly determined by these data: {texts}. Fix one parameter of each combination, such as {first} "
                "(--held); wider bounds do not help."
            )
        sentences += self.corrections
        for i in self.parallel:
            sentences.append(
                f"Axes {i} and {i + 1} are nearly parallel, so d_{i} and d_{i + 1} trade off, and the D-H "
                f"parameters cannot describe a small tilt between the axes: fix d_{i} and free beta_{i} (--free "
                f"beta_{i})."
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
    with_prior: Iterable[str] = (),
) -> Observability:
    """What the poses, reference lengths and other observations of a capture determine of the free parameters.

    The poses are first moved to their socket's centroid, or onto the geometry of their observation, by this arm, a few
    mm at most, so that the errors of an arm that is not yet calibrated do not look like information. For
    near-degenerate directions see `kinematics.independence`.

    Args:
        arm: The arm, nominal or calibrated.
        capture: Poses, reference lengths and other observations, whose unknown geometry is eliminated.
        space: The free parameters; by default those of ``bounds``, else those of `Parameters.free_of`.
        noise: Of readings and seat, if known: the equations are then weighted by it.
        sigma: Standard deviation of a tip coordinate, mm, such as that of the residuals; with ``noise`` it follows from
            that. With it near-degenerate is also what the data determine hardly better than the bounds.
        bounds: Bounds that ``sigma`` is compared with; by default of +-10 mm and +-17.5 mrad, the default of
            `Bounds.around`.
        with_prior: Names of parameters that a prior determines: what the data leave open of them is told apart.

    Raises:
        InputError: Capture and arm do not fit.

    Example:
        >>> one_socket = aj.simulate(arm, {"A": (400, 200, 300)}, poses=30)
        >>> analysis = aj.observability(arm, one_socket, space)
        >>> print(analysis.rank, "of", len(analysis.names))
        20 of 21
        >>> print(analysis.undetermined[0])
        all lengths together: the scale
        >>> print(analysis.remedy)
        A reference length would determine these parameters.
    """
    if space is None:
        space = Parameters.free_of(arm) if bounds is None else bounds.space
    check_one_capture(capture)
    check_finite(arm=arm, capture=capture, noise=noise)
    check_columns(space.base, capture.columns)
    if not space.names:  # only geometry is identified
        nothing = np.zeros(0)
        return Observability((), len(capture.readings), nothing, 1.0, np.zeros((0, 0)), (), (), "", ())
    arm, capture, space, noise, bounds = to_numpy((arm, capture, space, noise, bounds))
    if noise is not None:
        noise.check(arm.joints)
        readings = np.concatenate([capture.q, *(observation.q for observation in capture.observations)])
        sigma = rms_of_noise(arm.geometry, readings, noise)
    # Fixed values are those of the arm, not of the space's base.
    base = with_arrays(arm, beta=np.zeros_like(arm.alpha)) if arm.beta is None and space.base.beta is not None else arm
    spectrum = _Spectrum.of(base, capture, space.names, noise)
    if spectrum.null.shape[1]:
        # A nominal arm may have an exact alignment (a probe on the last axis) that the real one does not share.
        other = _Spectrum.of(neighbouring_arm(base, space.names), capture, space.names, noise, targets_of=base)
        spectrum = other if other.null.shape[1] < spectrum.null.shape[1] else spectrum
    return _of_spectrum(spectrum, spectrum.trade_offs(sigma, bounds), set(items_of(with_prior, "with_prior")), arm)


def _of_spectrum(spectrum: "_Spectrum", weak: tuple[TradeOff, ...], with_prior: set[str], arm: Arm) -> Observability:
    """Which directions are open, why, and what would determine them; told apart what a prior determines."""
    base, names, null = spectrum.arm, spectrum.names, spectrum.null
    functions = set(correction_names(base))
    # Undetermined directions that concern no parameter with a prior, and the others.
    _, sizes, turned = np.linalg.svd(null[[name in with_prior for name in names]])
    split = int(np.sum(sizes > 1e-6))
    null, of_prior = null @ turned[split:].T, null @ turned[:split].T
    by_functions = of_prior[[name in functions & with_prior for name in names]]
    of_prior = of_prior[:, ~np.any(np.abs(by_functions) > _FOLLOWS, axis=0)]
    null, undetermined = spectrum.named(null)
    structural = spectrum.structural(null)
    weak_by_prior = [trade_off for trade_off in weak if with_prior.intersection(trade_off.names)]
    weak = tuple(trade_off for trade_off in weak if not with_prior.intersection(trade_off.names))
    groups = []
    for direction in np.abs(null.T):
        chief, every = (np.array(names)[direction > share * direction.max()] for share in (0.5, _FOLLOWS))
        groups.append((tuple(chief.tolist()), tuple(every.tolist())))
    # Of a trade-off, the parameter to fix, or its strongest partner where that is no coefficient.
    groups += [(trade_off.names[: 1 + (trade_off.names[0] not in functions)], trade_off.names) for trade_off in weak]
    reasons, unexplained = why_undetermined(base, np.asarray(spectrum.agreeing.linear.observed.q), groups)
    return Observability(
        names=names,
        poses=len(spectrum.agreeing.linear.observed.q),
        singular=spectrum.singular,
        condition=spectrum.condition,
        null=null,
        undetermined=undetermined,
        structural=tuple(structural.tolist()),
        remedy="" if structural.all() else spectrum.remedy(int(structural.sum())),
        # Whether the angle between nearly parallel axes is identified without Hayati's beta.
        parallel=tuple(i for i in nearly_parallel(arm) if f"beta_{i}" not in names and f"alpha_{i}" in names),
        trade_offs=weak,
        by_prior=(
            *spectrum.named(of_prior)[1],
            *(trade_off.text for trade_off in weak_by_prior if not with_prior & functions & set(trade_off.names)),
        ),
        corrections=reasons + spectrum.by_more_sockets(unexplained),
    )


def rms_of_noise(geometry: Geometry, q: Float[np.ndarray, "N n"], noise: Noise) -> float:
    """RMS standard deviation of a tip coordinate by the noise of readings and seat, mm."""
    covariances = np.asarray(tip_covariances(geometry, joint_motion(geometry, q), noise))
    return float(np.sqrt(np.trace(covariances).mean() / 3))


def _first(texts: Sequence[str]) -> str:
    more = [f"{len(texts) - _NAMED} more combinations"] if len(texts) > _NAMED else []
    return "; ".join([*texts[:_NAMED], *more])


def _some(items: list[str], most: int, more: str) -> list[str]:
    return items if len(items) <= most else [*items[: most - 1], f"{len(items) - most + 1} {more}"]


class _Spectrum(NamedTuple):
    """Singular values of the derivatives of all that was observed, by the parameters in natural steps."""

    arm: Arm
    capture: Capture
    space: Parameters
    agreeing: Agreeing
    movements: Float[np.ndarray, "m p"]  # rows whose sum of squares is the mean square movement of the tips, mm
    geometry: Float[np.ndarray, "g p"]  # how the unknown geometry follows
    singular: Float[np.ndarray, " p"]
    null: Float[np.ndarray, "p nullity"]
    condition: float

    @classmethod
    def of(
        cls,
        arm: Arm,
        capture: Capture,
        names: tuple[str, ...],
        noise: Noise | None = None,
        targets_of: Arm | None = None,
    ) -> "_Spectrum":
        space = Parameters(arm, names)
        agreeing = Agreeing.of(capture, space, targets_of)
        plain = agreeing.eliminated()
        whitened = plain if noise is None else agreeing.eliminated(noise)
        # Each pose has as many rows on average: only their number of poses counts.
        poses = plain.poses * np.sqrt(len(plain.poses) / len(agreeing.linear.observed.q))
        # With as many rows of zeros as there are parameters all singular values and vectors are there.
        p = len(names)
        rows = np.concatenate([whitened.poses, whitened.relations, np.zeros((p, p))])
        rows = np.linalg.qr(rows, mode="r")  # of the same singular values and vectors, and far fewer
        _, singular, vectors = np.linalg.svd(rows)
        rank = int(np.sum(singular > _RANK * max(singular[0], 1e-300)))
        norms = np.linalg.norm(rows, axis=0)
        scale = np.where(norms > _RANK * norms.max(), norms, 1.0)  # others are rounding
        equal = np.linalg.svd(rows / scale, compute_uv=False)[:rank]
        condition = float(equal[0] / equal[-1]) if rank else np.inf
        movements = tip_movements(poses[:, None], plain.relations)
        return cls(arm, capture, space, agreeing, movements, plain.geometry, singular, vectors[rank:].T, condition)

    @property
    def names(self) -> tuple[str, ...]:
        return self.space.names

    def named(self, null: Float[np.ndarray, "p k"]) -> tuple[Float[np.ndarray, "p k"], tuple[str, ...]]:
        """Part of the null space by directions of few parameters, and their names, with the parts of the geometry that
        follow them; the scale is a direction of its own."""
        if not null.shape[1]:
            return null, ()
        rest, texts, directions = null, [], []
        scale = np.asarray(self.space.vector(self.arm)) * self.space.lengths
        scale = np.where([name == "d_1" for name in self.names], 0.0, scale)
        size = np.linalg.norm(scale)
        if size > 0 and np.linalg.norm(scale - null @ (null.T @ scale)) < 1e-6 * size:
            texts.append("all lengths together: the scale")
            directions.append(scale / size)
            # The other directions are named without the longest link, the largest component of the scale.
            pivot = int(np.argmax(np.abs(scale)))
            rest = null - np.outer(scale, null[pivot] / scale[pivot])
            rest = np.linalg.svd(rest, full_matrices=False)[0][:, : null.shape[1] - 1]
        for direction in reduced_echelon(rest)[0].T:
            size, followers = np.abs(direction).max(), self.geometry @ direction
            names = [name for name, x in zip(self.names, np.abs(direction), strict=True) if x > _PRESENT * size]
            parts = [name for name, at in self.agreeing.parts if np.abs(followers[at]).max() > _MOVED * size]
            items = _some(names, _PARAMETERS_NAMED, "more")
            items += _some(parts, _PARTS_NAMED, "more parts of the geometry")
            alone = f"{items[0]} (has no effect on the measurements)"
            texts.append(f"{listed(items)} trade off" if len(items) > 1 else alone)
            directions.append(direction / np.linalg.norm(direction))
        return np.stack(directions, axis=1), tuple(texts)

    def structural(self, null: Float[np.ndarray, "p k"]) -> Bool[np.ndarray, " k"]:
        """Which directions move the tip, in any pose, only as a rigid motion of the whole arm, which no capture
        shows."""
        random = np.random.default_rng(0)
        q = random.uniform(-np.pi, np.pi, (_CONFIGURATIONS, self.arm.joints))
        q = np.hstack([q, self.arm.beside.drawn(_CONFIGURATIONS, random)])
        rows = 3 * _CONFIGURATIONS
        movements = (jacobian_at(self.arm, q, self.names) * np.asarray(self.space.scale) @ null).reshape(rows, -1)
        rigid = rigid_motions(np.asarray(self.arm.position(q))).reshape(rows, 6)
        remaining = movements - rigid @ np.linalg.lstsq(rigid, movements, rcond=None)[0]
        return np.linalg.norm(remaining, axis=0) < 1e-6 * np.sqrt(rows)

    def trade_offs(self, sigma: float | None = None, bounds: Bounds | None = None) -> tuple[TradeOff, ...]:
        """Near-degenerate directions; by a standard deviation of tips also those that data determine hardly better
        than bounds do."""
        if sigma is None or not sigma > 0:
            return trade_offs(self.movements, self.names)
        rows = self.agreeing.eliminated(sigma)
        half = default = np.where(self.space.lengths, 10.0, 17.5)
        if bounds is not None:
            half = np.asarray(bounds.upper - bounds.lower) / 2 / np.asarray(self.space.scale)
            half = np.where(np.isfinite(half), half, default)
        whitened = np.concatenate([rows.poses, rows.relations])
        return trade_offs(self.movements, self.names, whitened=whitened, half_widths=half)

    def with_more(
        self, sockets: dict[str, Float[np.ndarray, "_ _"]], lengths: Sequence[ReferenceLength] = ()
    ) -> "_Spectrum":
        """With invented sockets, which have what was recorded beside the first pose's readings where they lack it."""
        capture, joints = self.capture, self.arm.joints
        beside, more = np.asarray(capture.readings)[:1, joints:], dict(capture.sockets)
        for name, q in sockets.items():
            more[name] = np.concatenate([q, np.repeat(beside, len(q), axis=0)], axis=1)[:, : capture.columns]
        capture = Capture(more, [*capture.lengths, *lengths], capture.observations)
        return _Spectrum.of(self.arm, capture, self.names)

    def by_more_sockets(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """A sentence on which of these coefficients poses in more sockets would determine, where some do."""
        if not names or self.capture.observations:
            return ()
        generic = generic_poses(self.arm)
        parts = np.split(np.asarray(generic.q), np.cumsum(generic.sizes)[:-1])
        spectrum = self.with_more({f"\0{i}": q for i, q in enumerate(parts)})
        left = {name for name, row in zip(self.names, np.abs(spectrum.null), strict=True) if np.any(row > _FOLLOWS)}
        left |= {trade_off.names[0] for trade_off in spectrum.trade_offs()}
        determined = [name for name in names if name not in left]
        if not determined:
            return ()
        return (f"Poses in more sockets, distributed over the whole workspace, would determine {listed(determined)}.",)

    def remedy(self, left: int) -> str:
        """Which further data would leave so many directions open: one after the other, the least effort first."""
        arm, capture, random = self.arm, self.capture, np.random.default_rng(0)
        low, high = np.asarray(joint_limits(arm, None)).T
        # The zero byte keeps the invented sockets apart from those of the capture.
        more_sockets = {f"\0{i}": row[None] for i, row in enumerate(random.uniform(low, high, (4, arm.joints)))}
        lengths = [ReferenceLength("\0000", "\0001", 1.0), ReferenceLength("\0002", "\0003", 1.0)]
        more_poses, warmer = {}, {}
        for name, q in capture.sockets.items():
            first = np.tile(np.asarray(q)[:1], (60, 1))
            if not more_poses:  # other configurations with the tip in the same place
                starts = first.copy()
                starts[:, : arm.joints] += random.uniform(-1.5, 1.5, (60, arm.joints))
                moved, reached = project_to_targets(arm, starts, np.asarray(arm.position(first)))
                more_poses[f"\0 {name}"] = moved[reached] if reached.any() else first[:1]
            if "thermometer" in arm.beside.names(capture.columns):
                shift = 10.0 * (np.arange(capture.columns) == capture.columns - 1)  # K
                warmer[f"\0 {name}"] = np.concatenate([q, q + shift])
        length = "a second position of the reference length" if capture.lengths else "a reference length"
        for text, sockets, added in (
            ("Poses in the same sockets at other temperatures", warmer, []),
            (f"{length[0].upper()}{length[1:]}", more_sockets, lengths[:1]),
            ("Reference lengths at two more positions", more_sockets, lengths),
            ("More poses in a socket, as different as possible,", more_poses, []),
            (f"More poses in a socket, and {length},", more_poses | more_sockets, lengths[:1]),
        ):
            if sockets and self.with_more(sockets, added).null.shape[1] <= left:
                return f"{text} would determine these parameters."
        return ""
