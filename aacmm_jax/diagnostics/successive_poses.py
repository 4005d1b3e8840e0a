"""Residuals of successive poses that are autocorrelated: their errors are not those of single poses."""

from typing import NamedTuple

import numpy as np

from ..uncertainty.shared_kinds import SUCCESSIVE, VISITS
from .findings import Case, Finding, chance_text
from .missing_terms import explained, missing
from .residual_tests import LEVEL, Residuals, block_diagonal, form_of_poses, form_test

ORDER, NEEDS = 64, "fit"


class Successive(NamedTuple):
    """Whether residuals of successive poses of one socket or observation are alike."""

    correlation: float
    probability: float


def test(case: Case) -> list[Finding]:
    """The finding, where the correlation is significant."""
    successive = case.once(successive_of)
    if successive is None or successive.probability >= LEVEL:
        return []
    shared = set() if case.record.shared is None else set(case.record.shared.kinds)
    return [
        Finding(
            "successive-poses",
            f"Residuals of successive poses are autocorrelated (correlation {successive.correlation:.2f}, "
            f"{chance_text(successive.probability)}): a seat that shifts at each visit, or errors that the model "
            "lacks.",
            "The stated uncertainties include what they share, as estimated from the residuals."
            if shared & {VISITS, SUCCESSIVE}
            else "Such poses count as independent, so every stated uncertainty is too small.",
            severity="doubt",
            probability=successive.probability,
        )
    ]


def successive_of(case: Case) -> Successive | None:
    """Errors of the tip that successive poses of one observation share (a score test of their covariance)."""
    if not case.shows_noise:
        return None
    rows = case.chunks[0]
    # Half a correlation with the pose before, half with the one after: the derivative of the covariance by it.
    kernel = [np.kron(np.eye(len(part.poses), k=1) + np.eye(len(part.poses), k=-1), np.eye(3)) / 2 for part in rows]
    if not any(np.any(matrix) for matrix in kernel):
        return None
    left = case.left
    if case.once(missing):
        with_terms, relations = case.once(explained)
        left = Residuals.of([*(part.block("") for part in with_terms), *relations])
    columns = [block_diagonal(part.by_tip) for part in rows]
    test = form_test(left, form_of_poses(left, columns, kernel), relative=True)
    product = total = 0.0
    for part, own in zip(rows, left.slices, strict=False):
        tips = np.einsum("mrc,mr->mc", part.by_tip, left.values[own].reshape(part.residual.shape))
        product += float(np.sum(tips[1:] * tips[:-1]))
        total += float(np.sum(tips[1:] ** 2) + np.sum(tips[:-1] ** 2)) / 2
    return Successive(product / total if total else 0.0, test.probability)
