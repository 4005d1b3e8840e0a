"""What a capture shows so far: the calibration after every pose, wrong poses, and which pose to take next.

The arm is calibrated from all poses by the engine (`pipeline.calibrate`), with the noise that is usual for it and with
the bounds of its parameters as a prior, so that the first pose counts already. Everything else is linear algebra with
the rows at that solution: with whitened residuals e and derivatives X of a pose and the covariance C of all unknowns, H
= X C X^T, e of a pose that was used has the covariance I - H, and d = e^T (I - H)^-1 e is the square of its deletion
residual (Cook and Weisberg 1982), which an F test compares with all others. A pose that is left out has I + H.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..calibration.evaluation import fit_geometry
from ..calibration.scale_anchor import fixes_scale
from ..calibration.task import without_lengths
from ..core.distributions import f_tail, student_quantile
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters
from ..kinematics.priors import Prior, default_prior
from ..model.observed import Observed
from ..pipeline.single import calibrate, identify
from ..planning.designs import Candidates
from ..planning.kit_placement import residual_vectors, rows_by_pose, rows_of_relations
from ..planning.placement import LEAST_POSES
from ..planning.problem import PRIOR, PlanOptions
from ..uncertainty.coverage import LEVEL
from ..uncertainty.linearisation import Linearisation
from .candidates import Pool, Search
from .limits import progress
from .places import Setup, TakenPose, capture_of
from .proposals import NextPose, Proposals

_FREEDOM = 4.0  # degrees of freedom that the usual noise counts
_WRONG, _RIGHT = 1e-3, 0.05  # probability, times the number of poses, of an outlier; probability of one that fits again
_ENDLESS = 1e9  # degrees of freedom of a known noise
_NEWER = 0.8  # of the largest ratio, from which the newest pose is the outlier
_OPEN = 1e-3  # eigenvalue of I - H below which nothing else shows an error of the pose
_LEAST_U = 1e-4  # mm: smallest standard uncertainty of what is certified
_ROUNDS = 3  # of leaving out poses
_STEPS = 30  # of a calibration, which begins at the one before; few poses hardly determine where it ends


class PoseResidual(NamedTuple):
    """The tip of a pose, its residual, mm, the size that the residual is expected to have (NaN where nothing else shows
    it), and whether it is an outlier, which the calibration leaves out."""

    tip: Float[np.ndarray, " 3"]
    residual: Float[np.ndarray, " 3"]
    expected: float
    outlier: bool


class Guidance(NamedTuple):
    """The calibration of the poses so far. U is the expanded uncertainty of a length, the largest over the
    volume, mm."""

    arm: Arm  # as calibrated so far
    poses: Mapping[int, PoseResidual]  # by number
    positions: Mapping[str, Float[np.ndarray, " 3"]]  # of places, as found
    u_length: float | None
    u_after_ten: float | None
    limits: str  # what limits U, as a sentence
    stop: bool  # whether the target is met
    sentences: tuple[str, ...]  # findings
    again: TakenPose | None  # the newest pose, where it is an outlier
    known: Candidates  # the candidates and what is known so far
    ahead: tuple[int, ...]  # the candidates that are planned


class Guide:
    """Guides one capture; called after every pose, in one thread.

    Args:
        setup: The arm and the places.
        target: U of a length that is asked for, mm; None: no end.
        options: As for `Search`.

    Raises:
        InputError: As `Search` does.
    """

    def __init__(self, setup: Setup, target: float | None = None, options: PlanOptions | None = None):
        self.setup, self.target = setup, target
        self.search = Search(setup, options)
        self._wrong: frozenset[int] = frozenset()
        self._taken: list[TakenPose] = []  # those that count, in order
        self._newest, self._start, self._ahead = 0, None, list(self.search.planned)
        arm, given = self.search.problem.arm, setup.specification
        usual = {} if arm.corrections is None else {k: float(v) for k, v in default_prior(arm).sd.items()}
        widths = usual | {"lengths": given.length, "angles": given.angle} | dict(given.override)
        self._prior = Prior({name: width for name, width in widths.items() if width > 0})

    def calibrated(self, poses: Sequence[TakenPose]) -> Guidance | None:
        """The calibration of the poses so far; None where there are none, or they determine none yet."""
        poses = [pose for pose in poses if not pose.excluded]
        self._taken = sorted(poses, key=lambda pose: pose.number)
        if not poses:
            self._ahead = list(self.search.planned)
            return None
        last = self._taken[-1]
        wrong = self._wrong & {pose.number for pose in poses}
        # Poses that do not determine where their thing stands wait for others in it, those of the last pose first.
        waiting = [pose for pose in poses if self._thing(pose) == self._thing(last)]
        determined, solution = poses, None
        while solution is None and determined:
            try:
                solution = self._solved(determined, wrong)
            except InputError:
                determined = [pose for pose in determined if self._thing(pose) != self._thing(waiting[0])]
                waiting = determined[-1:]
        if solution is None:
            self._drop_taken(last)
            return None
        poses, newest = determined, last.number
        for _ in range(_ROUNDS):
            outliers = solution.outliers(newest)
            if outliers == wrong:
                break
            try:
                solution, wrong = self._solved(poses, outliers), outliers
            except InputError:  # the others alone determine too little to say that
                break
        self._wrong = wrong
        return self._guidance(poses, solution, last)

    def next_pose(
        self, guidance: Guidance | None, q: Float[np.ndarray, " n"] | None, place: str | None = None,
        skipped: Sequence[NextPose] = (),
    ) -> NextPose | None:  # fmt: skip
        """The pose to take next from the present readings ``q``, in ``place`` where that is given; an outlier is taken
        again first. None where none is left that was not ``skipped``."""
        ahead, known = self._ahead or self.search.planned, self.search.pool().candidates
        arm, positions, again = self.search.problem.arm, dict[str, Any](), None
        if guidance is not None:
            ahead, known, again = guidance.ahead, guidance.known, guidance.again
            arm, positions = guidance.arm, guidance.positions
        proposals = Proposals(self.search, known, arm, positions, self._taken, q, skipped)
        if guidance is not None and again is not None and place in (None, again.place):
            away = float(np.linalg.norm(guidance.poses[again.number].residual))
            once_more = proposals.again(again, f"Pose {again.number} is {away:.2g} mm off: take it again.")
            if once_more is not None:
                return once_more
        return proposals.best(ahead, place)

    def _solved(self, poses: Sequence[TakenPose], wrong: frozenset[int]) -> "_Solution":
        """The calibration without wrong poses, and the rows of all poses at it."""
        problem = self.search.problem
        whole, numbers = capture_of(self.setup, poses)
        kept = [pose for pose in poses if pose.number not in wrong]
        capture = capture_of(self.setup, kept)[0] if wrong and kept else whole
        endless = np.full(len(problem.space.names), np.inf)
        bounds, options = Bounds(problem.space, -endless, endless), {"start": self._start, "noise": problem.noise}
        options |= {"prior": self._prior, "replace_noise": False, "max_steps": _STEPS}
        if capture.lengths or fixes_scale(capture):
            result = calibrate(problem.arm, capture, bounds, **options, shared_errors=False, undetermined="ignore")
        else:  # the longest link is held: a prior would let a smaller arm, with smaller residuals, win in time
            result = identify(problem.arm, capture, bounds, **options)
        vector = np.asarray(result.parameters)
        self._start = vector if np.all(np.isfinite(vector)) else None
        arm = to_numpy(result.arm)
        observed = to_numpy(Observed.of(whole, arm))
        geometry = {name: np.asarray(values) for name, values in result.observed.geometry.items()}
        if any(name not in geometry for name in observed.blocks):
            alone = to_numpy(Observed.of(without_lengths(whole), arm))
            near = {name: values for name, values in geometry.items() if name in alone.blocks}
            geometry = alone.split(np.asarray(fit_geometry(arm, alone, near, problem.noise).geometry))
        z = np.concatenate([vector, *(geometry[name] for name in observed.blocks)])
        linear = Linearisation.at(
            observed, Parameters(arm, problem.space.names), z, noise=problem.noise, least=_LEAST_U
        )
        session = whole.sessions[-1] if whole.sessions else ""
        probe = f"probe of {session}" if len(whole.sessions) > 1 else ""
        if self._start is not None:
            self.search.follow(vector, arm, geometry, session, probe)
        pool = self.search.pool(session, probe)
        return _Solution.of(pool, self._widths(), linear, np.array(numbers), wrong)

    def _widths(self) -> Float[np.ndarray, " p"]:
        """Standard deviations of the prior in natural steps."""
        space = self.search.problem.space
        prior = self._prior.of(space.names, np.asarray(space.vector()))
        sd = np.full(len(space.names), np.inf)
        if prior is not None:
            sd[prior.index] = np.asarray(prior.sd)[prior.index]
        return sd / np.asarray(space.scale)

    def _thing(self, pose: TakenPose) -> str:
        return self.setup.place(pose.place).thing.name

    def _guidance(self, poses: Sequence[TakenPose], solution: "_Solution", newest: TakenPose) -> Guidance:
        self._drop_taken(newest)
        used = [pose for pose in poses if pose.number not in self._wrong and pose.session == newest.session]
        counts = np.array([sum(pose.place == place.name for pose in used) for place in self.setup.places])
        found = progress(
            self.search, solution.known, solution.taken, solution.scale, self._ahead,
            np.maximum(LEAST_POSES - counts, 0), self.target, self.search.lacking(self._taken),
        )  # fmt: skip
        self._ahead = found.ahead
        by_number = solution.residuals()
        positions: dict[str, Any] = {}
        for place in self.setup.places:
            own = [pose for pose in used if pose.place == place.name]
            if own and place.position is not None:
                positions[place.name] = np.mean([by_number[pose.number].tip for pose in own], axis=0)
        again = newest if newest.number in self._wrong else None
        return Guidance(
            arm=solution.linear.space.base, poses=by_number, positions=positions, u_length=found.u,
            u_after_ten=found.u_after_ten, limits=found.limits, stop=found.met,
            sentences=(*self._sentences(poses, by_number), *self.search.unreached.values()), again=again,
            known=solution.known, ahead=tuple(found.ahead),
        )  # fmt: skip

    def _sentences(self, poses: Sequence[TakenPose], found: Mapping[int, PoseResidual]) -> list[str]:
        wrong = [pose for pose in poses if pose.number in self._wrong]
        return [
            f"Pose {pose.number} in {pose.place} is {np.linalg.norm(found[pose.number].residual):.2g} mm off and is "
            f"left out; {found[pose.number].expected:.1g} mm is expected."
            for pose in wrong
        ]

    def _drop_taken(self, newest: TakenPose) -> None:
        """Take from the plan the pose that was taken, or else the one that is worth least."""
        if newest.number <= self._newest or newest.number in self._wrong or not self._ahead:
            self._newest = max(newest.number, self._newest)
            return
        self._newest = newest.number
        pool, ahead = self.search.pool(), np.array(self._ahead)
        away = self.search.away(pool.q[ahead], newest.q[: pool.q.shape[1]])
        elsewhere = np.array([self.setup.places[i].name != newest.place for i in pool.place[ahead]])
        self._ahead.pop(int(np.argmin(away + 1e3 * elsewhere)))


class _Solution(NamedTuple):
    """A calibration: the rows of all poses, and what is known of all unknowns, those of candidates among them."""

    linear: Linearisation
    numbers: Int[np.ndarray, " m"]
    used: Bool[np.ndarray, " m"]
    known: Candidates
    taken: Float[np.ndarray, "P P"]  # information of the poses alone
    white: Float[np.ndarray, "m r"]
    h: Float[np.ndarray, "m r r"]  # covariance of the rows by the unknowns
    equations: Int[np.ndarray, " m"]
    squares: float  # of the used residuals, with the usual noise
    freedom: float
    scale: float  # factor of U and standard uncertainties by the usual noise

    @classmethod
    def of(
        cls, pool: Pool, widths: np.ndarray, linear: Linearisation, numbers: np.ndarray, wrong: frozenset[int]
    ) -> "_Solution":
        """Of rows at a solution."""
        p, count = len(widths), pool.candidates.rows.shape[2]
        # Unknowns of the candidates first, then those of other sessions.
        index, size = np.arange(len(linear.z)), count
        for name, at in linear.observed.positions.items():
            there = pool.columns.get(name)
            size += len(at) if there is None else 0
            index[p + at] = np.arange(size - len(at), size) if there is None else there

        def wider(rows: np.ndarray) -> np.ndarray:
            whole = np.zeros((*rows.shape[:-1], size))
            whole[..., index] = rows
            return whole

        rows, used = wider(rows_by_pose(linear)[0]), ~np.isin(numbers, list(wrong))
        relations = wider(rows_of_relations(linear)[0])
        relations = relations[np.any(relations[:, count:] != 0, axis=1)]
        base = PRIOR * np.eye(size)
        base[:count, :count] = pool.candidates.base
        base[np.arange(p), np.arange(p)] += widths**-2.0
        flat = rows[used].reshape(-1, size)
        taken = flat.T @ flat
        known = pool.known(base + relations.T @ relations + taken)
        parts = linear.parts()
        white = np.zeros(rows.shape[:2])
        for part in parts:
            residual = np.asarray(part.white)
            white[part.poses, : len(residual)] = residual.T
        h = np.einsum("mrp,msp->mrs", rows @ np.linalg.inv(known.base), rows)
        equations = np.concatenate([part.observation.pose_equations for part in parts])
        squares = _FREEDOM + float(np.sum(white[used] ** 2))
        freedom = _FREEDOM + float(np.sum(equations[used]) - np.trace(h[used], axis1=1, axis2=2).sum())
        factor = float(student_quantile(0.5 + LEVEL / 2, freedom)) * np.sqrt(squares / freedom)
        return cls(linear, numbers, used, known, taken, white, h, equations, squares, freedom, float(factor))

    def outliers(self, newest: int) -> frozenset[int]:
        """Numbers of the poses that do not fit: those left out that still do not, and the worst of the others."""
        sign = np.where(self.used, -1.0, 1.0)[:, None, None]
        values, vectors = np.linalg.eigh(np.eye(self.h.shape[1]) + sign * self.h)
        seen = values > _OPEN
        along = np.einsum("mrk,mr->mk", vectors, self.white)
        squares = np.sum(np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0), axis=1)
        count = np.maximum(seen.sum(axis=1) - (self.h.shape[1] - self.equations), 0)
        ratios, probabilities = np.zeros(len(squares)), np.ones(len(squares))
        for i in np.flatnonzero(count):
            own = (squares[i], count[i]) if self.used[i] else (0.0, 0)
            freedom = max(self.freedom - own[1], 1.0)
            ratios[i] = squares[i] / count[i] / (max(self.squares - own[0], _FREEDOM) / freedom)
            # What the usual noise explains is no outlier, however small the residuals of all others are.
            if f_tail(squares[i] / count[i], int(count[i]), _ENDLESS) < _RIGHT:
                probabilities[i] = f_tail(ratios[i], int(count[i]), freedom)
        still = {
            int(n) for n, p, used in zip(self.numbers, probabilities, self.used, strict=True) if not used and p < _RIGHT
        }
        wrong = self.used & (probabilities * len(squares) < _WRONG)
        if wrong.any():
            worst = int(np.argmax(np.where(wrong, ratios, 0.0)))
            last = np.flatnonzero(wrong & (self.numbers == newest))
            if len(last) and ratios[last[0]] > _NEWER * ratios[worst]:
                worst = int(last[0])
            still.add(int(self.numbers[worst]))
        return frozenset(still)

    def residuals(self) -> dict[int, PoseResidual]:
        """The residual of every pose, mm."""
        found, tips = {}, np.asarray(self.linear.point.forward.tip).T
        sd, residual = np.sqrt(self.squares / self.freedom), residual_vectors(self.linear)
        for part in self.linear.parts():
            rows, (observation, by_tip) = len(part.values), (part.observation, np.asarray(part.by_tip))
            to_mm = np.moveaxis(np.linalg.inv(np.asarray(part.root)), 0, -1)
            to_mm = np.moveaxis(np.asarray(observation.in_mm(to_mm, by_tip)), -1, 0)
            sign = np.where(self.used[part.poses], -1.0, 1.0)[:, None, None]
            covariance = np.eye(rows) + sign * self.h[part.poses, :rows, :rows]
            u = sd * np.sqrt(np.maximum(np.einsum("mca,mab,mcb->m", to_mm, covariance, to_mm), 0.0))
            for i, at in enumerate(range(part.poses.start, part.poses.stop)):
                number = int(self.numbers[at])
                found[number] = PoseResidual(tips[at], residual[at], float(u[i]), not bool(self.used[at]))
        return found
