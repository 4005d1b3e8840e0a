"""How well an order, signs and zeros of joint readings fit an arm, whose parameters may leave their nominal values as
those of real arms do."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..core.rotations import fitted_frame, rotation_matrix
from ..core.units import DEG
from ..data.noise import Noise, at_tip
from ..kinematics.arm import Arm, by_joint, is_length, joint_limits, locate, parameter_names, value_of, with_values
from ..kinematics.chain import forward_pass, joint_motion
from ..kinematics.jacobian import rotation_columns, stacked_jacobian_columns
from .reading_search import Evidence, Hypothesis

# Standard deviations: of a real arm's parameters from nominal ones (lengths relative to the arm's size), of the tips.
_LENGTH, _PROBE, _TWIST, _TIP = 0.004, 0.03, 0.5 * DEG, 5e-4
_TIGHT, _FREE = 1.5 * DEG, math.pi / 2  # likewise of zeros
_ZERO = 4 * DEG  # a smaller error of a zero is left to calibration
# Residuals that a real arm leaves once its parameters are adjusted: a part of its size, or, where that is more, so many
# times what the noise of its class moves a tip at full reach.
_EXPLAINED, _SCATTER = 0.003, 3.0
_STEPS = 20
_FITTED = 120, 24  # poses of a fit, in all and in one socket
_MARGIN = 3 * DEG  # of readings beyond their limits
_EXACT = 1e-5  # of the arm's size: residuals below it do not differ
_NEARLY = 1.5  # the factor up to which residuals with fewer changed zeros are as good
_AS_GOOD = 2.0  # the factor by which residuals of two explanations must differ to tell them apart


class Explanation(NamedTuple):
    """One order, set of signs and zeros, and units that fit the readings to the arm.

    Reading i of the arm is ``signs[i] * (angle * q[:, order[i]]) + offsets[i]``; points are ``length`` times those that
    were given.

    Example:
        >>> readings = capture.q[:20] * np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])
        >>> check = aj.diagnostics.check_readings(arm, readings, positions=true.position(capture.q[:20]))
        >>> print(check.best.signs, f"{check.best.rms:.1f} mm instead of {check.given.rms:.0f} mm")
        (1, 1, -1, 1, 1, 1) 2.2 mm instead of 431 mm
    """

    order: tuple[int, ...]  # the recorded column of each joint, from 0
    signs: tuple[int, ...]
    offsets: tuple[float, ...]  # rad; exact multiples of a quarter where they are within 4 degrees
    angle: float  # 1, DEG (degrees were taken for radians) or 1 / DEG
    length: float  # 1, or the unit that positions are in, mm
    rms: float  # residual of the nominal arm, mm
    rms_fitted: float  # of the most probable arm, with what its changes of parameters cost, mm
    outside: int  # readings outside the joint limits
    mirrored: bool = False  # whether it has the tip in the mirror image of the best explanation's positions

    @property
    def hypothesis(self) -> Hypothesis:
        """Order, signs, zeros and units."""
        return Hypothesis(*self[:5])

    @property
    def changes(self) -> int:
        """Number of mistakes that it names."""
        return self.hypothesis.changes


class ReadingFit:
    """Residuals of hypotheses, with nominal and with adjusted parameters."""

    def __init__(self, arm: Arm, evidence: Evidence, size: float, free_tip: bool, usual: Noise | None = None):
        self.arm, self.evidence, self.size, self.lever, self.free_tip = arm, evidence, size, size / 4, free_tip
        # A smaller residual is left by a real arm, once its parameters are adjusted.
        scatter = 0.0 if usual is None else math.sqrt(3) * math.hypot(*at_tip(usual, arm, size))
        self.explained = max(_EXPLAINED * size, _SCATTER * scatter)
        self._few = evidence.thinned(*_FITTED)
        names = parameter_names(arm)
        self._nominal = np.array([value_of(arm, name) for name in names], dtype=float)
        self._indices = tuple(locate(arm, name) for name in names)
        self._deviations = np.where([is_length(name) for name in names], _LENGTH * size, _TWIST)
        self._zeros = np.array([name.startswith("theta") for name in names])
        self._tip = np.array([name.startswith("probe") for name in names])
        self._deviations[self._tip] = size / 2 if free_tip else _PROBE * size
        rows = (3 if evidence.rotations is None else 6) * len(self._few.q)
        unknown = 0 if evidence.in_base else 6 if evidence.own_frame else 3 * (1 + int(self._few.owner.max()))
        self._enough = rows - unknown >= 3 * arm.joints
        # The residual of parameters that deviate from nominal ones by as much as those of real arms do.
        self._typical = _TIP * size * math.sqrt(min(rows, len(names)) / len(self._few.q))
        self._low, self._high = (np.full(arm.joints, x) for x in (-np.inf, np.inf))
        if arm.limits is not None:
            self._low, self._high = np.asarray(joint_limits(arm, None)).T

    def as_good_as(self, rms: float) -> float:
        """Residuals up to here are as good as these."""
        return _AS_GOOD * rms + self._typical

    def explanation(self, hypothesis: Hypothesis) -> Explanation:
        """With the zeros as they are in the hypothesis."""
        rms = _rms(self._residual(self.evidence, self._nominal, hypothesis)[0], len(self.evidence.q))
        return Explanation(*hypothesis, rms, self._adjusted(hypothesis, _TIGHT)[1], self.outside(hypothesis))

    def _outside(self, readings: Float[np.ndarray, "m n"]) -> np.ndarray:
        return (readings < self._low - _MARGIN) | (readings > self._high + _MARGIN)

    def outside(self, hypothesis: Hypothesis) -> int:
        """Readings beyond the arm's limits, where it has some."""
        if self.arm.limits is None:
            return 0
        readings = hypothesis.readings(self.evidence.q)
        # A reading may be whole revolutions away.
        middle = (self._low + self._high) / 2
        return int(np.sum(self._outside(readings - 2 * np.pi * np.round((readings - middle) / (2 * np.pi)))))

    def within_limits(self, explanation: Explanation) -> Explanation:
        """The same with zeros whole revolutions away: as many readings as can be are then within the joint limits, and
        of these the zeros are the smallest."""
        readings, offsets = explanation.hypothesis.readings(self.evidence.q), np.array(explanation.offsets)
        turns = 2 * np.pi * (np.arange(-2, 3)[:, None] - np.round(offsets / (2 * np.pi)))  # (5, n)
        outside = np.array([np.sum(self._outside(readings + turn), axis=0) for turn in turns])
        for i in np.flatnonzero(by_joint(self.arm, True, False)):
            offsets[i] += turns[np.lexsort((np.abs(offsets[i] + turns[:, i]), outside[:, i]))[0], i]
        return explanation._replace(offsets=tuple(offsets.tolist()))

    def with_free_zeros(self, hypothesis: Hypothesis) -> tuple[Float[np.ndarray, " n"], float]:
        """Changes of the zeros that fit best, rad, and the residual with them; none where there are too few poses."""
        zeros, rms = self._adjusted(hypothesis, _FREE if self._enough else _TIGHT)
        return self._enough * zeros, rms

    def needed_zeros(self, hypothesis: Hypothesis, zeros: Float[np.ndarray, " n"], rms: float) -> Explanation:
        """The explanation with as few changed zeros as are needed, the largest first."""
        offsets = np.array(hypothesis.offsets)
        waiting = [i for i in np.argsort(-np.abs(zeros)).tolist() if abs(zeros[i]) > _ZERO]
        while True:
            changed = self.explanation(hypothesis._replace(offsets=tuple(offsets.tolist())))
            if changed.rms_fitted <= _NEARLY * rms + _EXACT * self.size or not waiting:
                return changed
            joint = waiting.pop(0)
            offsets[joint] = _rounded(float(offsets[joint]) + float(zeros[joint]))

    def with_fitted_zeros(self, hypothesis: Hypothesis) -> tuple[Hypothesis, Float[np.ndarray, " n"], float]:
        """The hypothesis with the zeros that fit best, but for those of the first and the last joint, which base and
        mount take up; none that are still needed; and the residual."""
        zeros, rms = self.with_free_zeros(hypothesis)
        zeros[[0, -1]] = 0
        offsets = tuple(map(_rounded, (np.array(hypothesis.offsets) + zeros).tolist()))
        return hypothesis._replace(offsets=offsets), 0 * zeros, rms

    def with_tip_found(self, explanation: Explanation) -> float:
        """The residual of the nominal arm with the tip where it fits best in the last frame, mm."""
        vector, tip, poses = self._nominal.copy(), np.flatnonzero(self._tip), len(self.evidence.q)
        residual, columns = self._residual(self.evidence, vector, explanation.hypothesis)
        best = _rms(residual, poses)
        for _ in range(_STEPS):
            vector[tip] -= np.linalg.lstsq(columns[:, tip], residual, rcond=1e-10)[0]
            residual, columns = self._residual(self.evidence, vector, explanation.hypothesis)
            before, best = best, min(best, _rms(residual, poses))
            if best > 0.99 * before:
                break
        return best

    def _adjusted(self, hypothesis: Hypothesis, zero: float) -> tuple[Float[np.ndarray, " n"], float]:
        """The most probable arm, whose zeros have this standard deviation: the changes of its zeros and its residual.

        The residual counts how improbable the change of each parameter is, too: with changes that no real arm has,
        many wrong readings can be fitted. The method of Levenberg and Marquardt.
        """
        deviations = np.where(self._zeros, zero, self._deviations)
        sigma, change, damping = _TIP * self.size, np.zeros(len(self._nominal)), 1e-3
        residual, columns = self._residual(self._few, self._nominal, hypothesis)
        cost = np.sum(residual**2) / sigma**2
        for _ in range(_STEPS):
            rows = np.concatenate([columns * deviations / sigma, np.eye(len(change)), damping * np.eye(len(change))])
            right = np.concatenate([-residual / sigma, -change, np.zeros(len(change))])
            new = change + np.linalg.lstsq(rows, right, rcond=None)[0]
            tried = self._residual(self._few, self._nominal + new * deviations, hypothesis)
            new_cost = np.sum(tried[0] ** 2) / sigma**2 + np.sum(new**2)
            if not new_cost < cost:
                damping *= 10
                continue
            done = cost - new_cost < 1e-3 * cost
            change, cost, (residual, columns), damping = new, new_cost, tried, damping / 10
            if done:
                break
        return (change * deviations)[self._zeros], sigma * math.sqrt(cost / len(self._few.q))

    def _residual(
        self, recorded: Evidence, vector: Float[np.ndarray, " p"], hypothesis: Hypothesis
    ) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r p"]]:
        """Residuals, mm, and their derivatives, with the unknown geometry eliminated."""
        evidence, geometry = recorded.scaled(1.0, hypothesis.length), to_numpy(self.arm.geometry)
        geometry = geometry._replace(**with_values(geometry, vector, self._indices))
        forward = forward_pass(geometry, joint_motion(geometry, hypothesis.readings(recorded.q)))
        tips = np.asarray(forward.tip).T
        columns = np.moveaxis(np.asarray(stacked_jacobian_columns(forward, self._indices)), -1, 0).swapaxes(1, 2)
        if evidence.points is None:
            residual, columns = (part - _means(part, evidence.owner) for part in (tips, columns))
            return residual.ravel(), columns.reshape(residual.size, -1)
        flat = columns.reshape(tips.size, -1)
        if evidence.own_frame:
            residual, basis = _aligned(tips, evidence.points)
            return residual.ravel(), flat - basis @ (basis.T @ flat)
        residual = (tips - evidence.points).ravel()
        if evidence.rotations is None:
            return residual, flat
        from scipy.spatial.transform import Rotation  # takes long to import

        frames = np.stack(forward.frame, axis=1).T.swapaxes(1, 2)
        turned = Rotation.from_matrix(frames @ evidence.rotations.swapaxes(1, 2)).as_rotvec().ravel()
        by_angles = np.moveaxis(np.asarray(rotation_columns(forward, self._indices)), -1, 0).swapaxes(1, 2)
        rows = self.lever * by_angles.reshape(turned.size, -1)
        return np.concatenate([residual, self.lever * turned]), np.concatenate([flat, rows])


def _rounded(offset: float) -> float:
    """The zero, or the quarter of a revolution near which it is."""
    offset = math.remainder(float(offset), 2 * math.pi)
    quarter = round(offset / (math.pi / 2)) * (math.pi / 2)
    return quarter if abs(offset - quarter) < _ZERO else offset


def _means(values: Float[np.ndarray, "m ..."], owner: np.ndarray) -> Float[np.ndarray, "m ..."]:
    """The mean of each pose's socket."""
    sizes = np.bincount(owner)
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    return (np.add.reduceat(values, starts) / sizes.reshape(-1, *(1,) * (values.ndim - 1)))[owner]


def _aligned(
    tips: Float[np.ndarray, "m 3"], points: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "r 6"]]:
    """Residuals of the tips from points that are moved rigidly to fit, and an orthonormal basis of rigid movements."""
    frame = np.asarray(fitted_frame(points.T, tips.T))
    placed = points @ np.asarray(rotation_matrix(frame[:3])).T + frame[3:]
    centred = placed - placed.mean(axis=0)
    turns = [np.cross(axis, centred).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(points)) for axis in np.eye(3)]
    return tips - placed, np.linalg.qr(np.stack([*turns, *shifts], axis=1))[0]


def _rms(residual: Float[np.ndarray, " r"], poses: int) -> float:
    return float(np.sqrt(np.sum(residual**2) / poses))
