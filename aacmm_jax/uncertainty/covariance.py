"""The covariance of parameters, and models of the errors behind it."""

from typing import Literal, NamedTuple

from jaxtyping import Bool, Float

from ..core.linear_algebra import inverse_positive_definite, semidefinite_eigen
from ..core.numpy_or_jax import AnyArray, namespace
from ..data.noise import Noise
from .degrees_of_freedom import Components

# Models of the tips' errors. "given": encoders and seat as stated. "estimated": encoders and seat, both standard
# deviations estimated from the residuals. "common": one variance for every coordinate of every tip. "robust": each
# pose's own residual, corrected for its leverage (a jackknife), whatever the errors are, as long as poses are
# independent.
NoiseModel = Literal["given", "estimated", "common", "robust"]
NOISE_MODELS = ("given", "estimated", "common", "robust")

# Parts of a covariance: what certificates and instruments state, and the disagreement of the lengths beyond that.
STATED, DISAGREEMENT = "stated", "disagreement of lengths"
# A direction whose standard uncertainty exceeds 10 mm or 10 mrad is not determined, whatever its eigenvalue.
_LEAST_INFORMATION = 1e-2
_NULL = 1e-12  # eigenvalues of the information below this, of the largest, are zero


class ParameterCovariance(NamedTuple):
    """Covariance of the free parameters, and what the data leave open."""

    matrix: Float[AnyArray, "p p"]
    determined: Bool[AnyArray, " p"]  # one by one, and not only in combination with others
    open: Float[AnyArray, "p p"]  # projector onto the directions that are not determined, in natural steps
    noise: Noise  # given, or as estimated: one encoder for all
    # Its parts that do not rest on the scatter of single poses; None: there is none.
    components: Components | None = None

    def without(self, name: str) -> "ParameterCovariance":
        """Less one of its parts."""
        if self.components is None or name not in self.components.names:
            return self
        part = self.components.matrices[self.components.names.index(name)]
        return self._replace(matrix=self.matrix - part, components=self.components.without(name))


def inverse_information(
    information: Float[AnyArray, "p p"], fixed: Bool[AnyArray, " p"]
) -> tuple[Float[AnyArray, "p p"], Float[AnyArray, "p p"], Bool[AnyArray, " p"]]:
    """Inverse on the identifiable subspace, the projector onto the undetermined directions, and which parameters are
    determined one by one; natural steps. A poorly determined direction keeps its large variance, which does not affect
    the others.
    """
    xp = namespace(information, fixed)
    free = ~fixed
    information = information + xp.diag(xp.where(fixed, 1.0 + xp.max(xp.abs(information)), 0.0))
    # Only masks and a basis come from the eigenvectors: their derivative is infinite where eigenvalues repeat.
    values, vectors = semidefinite_eigen(information)
    informed = values > _NULL * values[0]
    seen, lost = xp.where(informed[None, :], vectors, 0.0), xp.where(informed[None, :], 0.0, vectors)
    inner = seen.T @ information @ seen + xp.diag(xp.where(informed, 0.0, 1.0))
    inverse = seen @ inverse_positive_definite(inner) @ seen.T
    hardly = xp.where((values > _LEAST_INFORMATION)[None, :] & informed[None, :], 0.0, vectors)
    determined = fixed | (xp.sum(hardly**2, axis=1) < 1e-6)
    return xp.where(free[:, None] & free[None, :], inverse, 0.0), lost @ lost.T, determined
