"""How probable a model of the joints makes what was measured, after every parameter and scale has been integrated out.

The equations are linear at the solution, and what is known of a learned scale is that its log variance is expected with
the variance 9 (`uncertainty.evidence`), so that all integrals are Gaussian (Laplace's method; MacKay 1992; Kass and
Raftery 1995, Journal of the American Statistical Association 90, section 4.1). Constants that all models of a capture
have in common are left out: of the geometry, which has no prior, and of reference lengths and certified values.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ..calibration.results import PriorMetrics
from ..diagnostics.equations import PRIOR, Equations, Rows

_EXPECTED_VARIANCE = 9.0  # of a log variance that is expected
_SMALL = 1e-9  # singular value, relative to the largest


def log_evidence(equations: Equations, prior: PriorMetrics, expected: Mapping[str, float]) -> float:
    """Logarithm of the evidence of one of several models of the same capture, to be compared with that of others.

    Args:
        equations: Those of the calibration, with the rows of its prior.
        prior: What the calibration says of the prior.
        expected: The standard deviation that is expected of each learned group, in its unit.
    """
    found = -_scales(prior, expected)
    information, squares, of_own = 0.0, 0.0, 0.0
    for rows in equations.rows:
        shared, of = _eliminated(rows)
        information, of_own = information + shared.T @ shared, of_own + of
        squares += float(np.sum(rows.residual**2))
        found -= _log_of_noise(rows)
    for block in equations.relations:
        information = information + block.shared.T @ block.shared
        squares += float(np.sum(block.residual**2))
        if block.fixture == PRIOR:
            found += float(np.sum(np.log(np.linalg.norm(block.shared, axis=1))))
    return found - 0.5 * (squares + of_own + float(np.linalg.slogdet(information)[1]))


def _eliminated(rows: Rows) -> tuple[Float[np.ndarray, "R s"], float]:
    """Derivatives by what observations share, with the geometry of this one eliminated; log determinant of what is
    eliminated."""
    shared, own = (part.reshape(rows.residual.size, part.shape[2]) for part in (rows.shared, rows.own))
    basis, sizes, _ = np.linalg.svd(own, full_matrices=False)
    known = sizes > _SMALL * sizes.max(initial=1e-300)
    basis = basis[:, known]
    return shared - basis @ (basis.T @ shared), float(2 * np.sum(np.log(sizes[known])))


def _log_of_noise(rows: Rows) -> float:
    """Log of the product of the standard deviations of the rows, by what one of them is in mm."""
    sizes = np.linalg.svd(rows.in_mm, compute_uv=False)
    return float(np.sum(np.log(sizes[sizes > _SMALL * sizes.max(initial=1e-300)])))


def _scales(prior: PriorMetrics, expected: Mapping[str, float]) -> float:
    """What learned scales cost: being away from what is expected, and having been chosen by the data."""
    found = 0.0
    for group, sd, effective, learned in zip(
        prior.groups, np.asarray(prior.sd), np.asarray(prior.effective), prior.learned, strict=True
    ):
        if learned:
            away = 2 * np.log(sd / expected[group])
            # Each parameter that the data determine adds 1/2 to the curvature by the log variance.
            found += 0.5 * (away**2 / _EXPECTED_VARIANCE + np.log1p(0.5 * effective * _EXPECTED_VARIANCE))
    return float(found)
