"""Errors that poses share, as random effects: what a calibration keeps of them (`diagnostics.shared_errors`)."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, namespace
from .degrees_of_freedom import Components, Law


class SharedErrors(eqx.Module):
    """Errors that poses share and the model of a calibration does not have, as its residuals show them.

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
