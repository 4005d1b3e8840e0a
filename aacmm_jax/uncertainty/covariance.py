"""The covariance of parameters, and models of the errors behind it: of single poses, and shared by several."""

from typing import Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..core.linear_algebra import inverse_positive_definite, semidefinite_eigen
from ..core.numpy_or_jax import AnyArray, namespace
from ..data.noise import Noise
from .degrees_of_freedom import Components, Law

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
    if not len(information):
        return information, information, fixed
    free = ~fixed
    both = free[:, None] & free[None, :]
    # What is fixed is known: nothing of it may remain in the equations of the others.
    information = xp.where(both, information, xp.diag(xp.where(fixed, 1.0 + xp.max(xp.abs(information)), 0.0)))
    # Only masks and a basis come from the eigenvectors: their derivative is infinite where eigenvalues repeat.
    values, vectors = semidefinite_eigen(information)
    informed = values > _NULL * values[0]
    seen, null = xp.where(informed[None, :], vectors, 0.0), xp.where(informed[None, :], 0.0, vectors)
    inner = seen.T @ information @ seen + xp.diag(xp.where(informed, 0.0, 1.0))
    inverse = seen @ inverse_positive_definite(inner) @ seen.T
    undetermined = xp.where((values > _LEAST_INFORMATION)[None, :] & informed[None, :], 0.0, vectors)
    determined = fixed | (xp.sum(undetermined**2, axis=1) < 1e-6)
    return xp.where(both, inverse, 0.0), null @ null.T, determined


class SharedErrors(eqx.Module):
    """Shared errors: errors that several poses have in common and that the model of a calibration does not describe, as
    its residuals show them.

    Its covariance contains them. Functions of the readings that joints follow besides the model ("gravity",
    "harmonics=1") move other poses too: a tip errs by J dz + sum of J_joint phi(q) c, with dz = ``follow`` c.
    """

    kinds: tuple[str, ...] = eqx.field(static=True)  # "visits", "successive poses", "places", and groups of functions
    units: tuple[str, ...] = eqx.field(static=True)  # of each standard deviation
    names: tuple[str, ...] = eqx.field(static=True)  # coefficients of the functions, as of `kinematics.corrections`
    sd: Float[AnyArray, " g"]  # of each kind
    moments: Float[AnyArray, "k k"]  # second moments of the coefficients about 0, which the calibrated arm has
    follow: Float[AnyArray, "p k"]  # derivatives of the parameters by the coefficients, mm and rad
    correlation_length: Float[AnyArray, ""]  # of successive poses, where visits are not marked; NaN otherwise
    # What each kind adds to the covariance of the parameters, or, of functions, to the moments of the coefficients when
    # the logarithm of its variance grows; and how well the variances are known.
    added: Float[AnyArray, "e p p"]
    by_group: Float[AnyArray, "f k k"]
    law: Law  # of all kinds

    def without_functions(self) -> "SharedErrors":
        """Those that move the tips of poses alike."""
        count = len(self.added)
        return SharedErrors(
            kinds=self.kinds[:count],
            units=self.units[:count],
            names=(),
            sd=self.sd[:count],
            moments=np.zeros((0, 0)),
            follow=self.follow[:, :0],
            correlation_length=self.correlation_length,
            added=self.added,
            by_group=np.zeros((0, 0, 0)),
            law=self.law.of_parts(slice(count)),
        )

    @property
    def of_tips(self) -> Components | None:
        """What errors of the tip add to the covariance of the parameters."""
        count = len(self.added)
        return Components(self.kinds[:count], self.added, self.law.of_parts(slice(count))) if count else None

    @property
    def of_functions(self) -> Components:
        """By how much the covariance of parameters and coefficients grows with the logarithm of each variance."""
        xp, count = namespace(self), len(self.added)
        by_coefficients = xp.concatenate([self.follow, xp.asarray(np.eye(len(self.names)))])
        grown = by_coefficients @ self.by_group @ by_coefficients.T
        return Components(self.kinds[count:], grown, self.law.of_parts(slice(count, None)))

    def sd_of(self, *kinds: str) -> Float[AnyArray, ""] | float:
        """Standard deviation of a tip coordinate by effects of some kinds, mm; 0 without."""
        return sum((self.sd[i] ** 2 for i, kind in enumerate(self.kinds) if kind in kinds), 0.0) ** 0.5
