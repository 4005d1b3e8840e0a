"""The equations of a calibration at its solution, with columns of errors that poses may share."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration.record import CalibrationRecord
from ..calibration.stages import Sensitivities
from .equations import LEAST_U, PRIOR, Rows, lengths_in_solve
from .group_test import Block
from .length_consistency import lengths_of_sockets
from .residual_tests import Residuals

_EXPLAINED = 1e-3  # part of a column that the model leaves, below which it counts as the model's own


class SharedProblem(NamedTuple):
    """The equations of a calibration, and how its parameters follow its data."""

    record: CalibrationRecord
    rows: list[Rows]
    left: Residuals
    sensitivities: Sensitivities
    lengths: Float[np.ndarray, "l k"] | None  # whitening of the lengths between means of sockets, their last rows

    def moved(self, patterns: Float[np.ndarray, "M c"]) -> Float[np.ndarray, "R k"]:
        """Columns of tips that move by a pattern over the poses, along x, y and z each."""
        blocks = [
            np.einsum("mra,mc->mrca", part.by_tip, patterns[part.poses]).reshape(part.residual.size, -1)
            for part in self.rows
        ]
        return self._columns(blocks, np.einsum("laN,Nc->lca", self.sensitivities.lengths, patterns))

    def turned(
        self, values: Float[np.ndarray, "M k"], joints: np.ndarray, steps: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, "R k"]:
        """Columns of joints that turn by functions of the readings times a step."""
        arm, q = self.record.calibrated.arm, np.asarray(self.record.recording.capture.readings)
        natural = np.array([1.0 if i + 1 in arm.prismatic else 1e-3 for i in range(arm.joints)])
        factors = values * (steps / natural[joints])
        blocks = [
            (part.extra[..., joints] * factors[part.poses][:, None]).reshape(part.residual.size, -1)
            for part in self.rows
        ]
        of_lengths = np.zeros((len(self.sensitivities.lengths), len(steps)))
        if len(of_lengths):
            names = [f"{'d' if i + 1 in arm.prismatic else 'theta'}_{i + 1}" for i in range(arm.joints)]
            slopes = np.einsum("laN,Naj->ljN", self.sensitivities.lengths, np.asarray(arm.jacobian(q, names)))
            of_lengths = np.einsum("lkN,Nk->lk", slopes[:, joints], values * steps)
        return self._columns(blocks, of_lengths)

    def _columns(self, blocks: list[np.ndarray], of_lengths: np.ndarray) -> np.ndarray:
        whole = np.zeros((len(self.left.values), blocks[0].shape[1]))
        poses = np.concatenate(blocks)
        whole[: len(poses)] = poses
        if self.lengths is not None:
            whole[-len(self.lengths) :] = self.lengths @ of_lengths.reshape(len(of_lengths), -1)
        return self.left.unexplained(whole)

    def by_patterns(self, patterns: Float[np.ndarray, "M c"]) -> Float[np.ndarray, "p k"]:
        """How the parameters follow `moved`."""
        by_tips = np.einsum("paN,Nc->pca", self.sensitivities.tips, patterns)
        return by_tips.reshape(len(by_tips), -1)

    def by_functions(self, values: Float[np.ndarray, "M k"], joints: np.ndarray) -> Float[np.ndarray, "p k"]:
        """How the parameters follow `turned`, by coefficients in their own units."""
        return np.einsum("pkN,Nk->pk", self.sensitivities.joints[:, joints], values)


def problem_of_poses(
    record: CalibrationRecord, rows: list[Rows], prior: list[Block], sensitivities: Callable[[], Sensitivities]
) -> SharedProblem:
    """The equations of the poses, and of a prior."""
    left = Residuals.of([*(part.block("") for part in rows), *prior])
    return SharedProblem(record, rows, left, sensitivities(), None)


def scale_of_lengths(record: CalibrationRecord, relations: list[Block]) -> Block:
    """That the lengths together say how large the arm is.

    Residuals of sockets are in proportion to the arm: where all lengths are free, a smaller arm would take them away.
    """
    lengths = record.recording.capture.lengths
    weights = np.array([float(length.value) / max(float(length.u), LEAST_U) for length in lengths])
    block = next(block for block in relations if block.fixture != PRIOR)
    shared = weights @ block.shared[: len(weights)] / np.linalg.norm(weights)
    return Block(PRIOR, None, np.zeros(1), shared[None], np.zeros((1, 0)))


def with_lengths(problem: SharedProblem, relations: list[Block]) -> SharedProblem:
    """The same with what lengths and certified values say, of all but the scale.

    Fixed lengths or a prior may contradict the scale of all lengths, which errors of single places do not explain.
    """
    record, rows = problem.record, problem.rows
    blocks, size = [*(part.block("") for part in rows), *relations], sum(part.residual.size for part in rows)
    values = np.array([float(length.value) for length in record.recording.capture.lengths])
    if lengths_in_solve(record) or not len(values):
        u = np.maximum([float(length.u) for length in record.recording.capture.lengths], LEAST_U)
        return problem._replace(left=_without_scale(Residuals.of(blocks), size, values / u))
    related = lengths_of_sockets(record, rows)
    if related is None:
        return problem
    whitening = np.linalg.inv(np.linalg.cholesky(related.covariance))
    residual, shared = whitening @ related.relations.residual, whitening @ related.relations.shared
    blocks.append(related.relations._replace(residual=residual, shared=shared))
    if related.scale is not None:
        # Residuals are in proportion to the arm: where every length is free, a shorter scale anchor, and all else in
        # proportion, takes them away. That is no error of the anchor, so its column is taken at right angles to them.
        of_rows, r = related.scale[0], problem.left.values[: len(related.scale[0])]
        of_rows = of_rows - r * (r @ of_rows) / max(float(r @ r), 1e-300)
        blocks = _with_column(blocks, of_rows, whitening @ related.scale[1])
    left = _without_scale(Residuals.of(blocks), size, whitening @ values)
    return problem._replace(left=left, lengths=whitening)


def _without_scale(left: Residuals, first: int, by_scale: Float[np.ndarray, " l"]) -> Residuals:
    """With the scale of the lengths, which begin at a row, as one more unknown."""
    column = np.zeros((len(left.values), 1))
    column[first : first + len(by_scale), 0] = by_scale
    unknown = np.linalg.norm(left.unexplained(column)) > _EXPLAINED * np.linalg.norm(column)
    return left.extended(column) if unknown else left


def _with_column(blocks: list[Block], of_rows: np.ndarray, of_lengths: np.ndarray) -> list[Block]:
    """With the scale anchor, which the lengths determine, as one more unknown."""
    parts = np.split(np.concatenate([of_rows, of_lengths]), np.cumsum([len(b.residual) for b in blocks])[:-1])
    return [b._replace(shared=np.column_stack([b.shared, part])) for b, part in zip(blocks, parts, strict=True)]
