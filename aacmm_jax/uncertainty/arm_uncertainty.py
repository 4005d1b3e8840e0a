"""The uncertainty of a calibrated arm: of its parameters, of a tip, of a length."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..core.arrays import Numbers, is_concrete
from ..core.distributions import student_quantile
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace, numpy_if_known
from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import Arm, checked_readings
from ..kinematics.chain import joint_motion
from ..kinematics.corrected_arm import with_further_corrections
from ..kinematics.parameters import Parameters
from .shared_errors import SharedErrors
from .shared_kinds import PLACES, SUCCESSIVE, VISITS


class Uncertainty(eqx.Module):
    """Standard uncertainties of a calibrated arm, in mm and rad.

    They are the calibration's contribution; with ``reading=True`` the noise of the readings is added, as given to the
    calibration or as estimated by it, and the errors that poses in one place share (``shared``). Functions of the
    readings that the model was found to lack count in both: they move every pose. What depends on a direction that the
    data do not determine is infinitely uncertain. Fixed parameters count as exact, and so does the base frame (``d_1``
    and ``theta_1`` only define it).

    Example:
        >>> uncertainty = aj.uncertainty_of(result)
        >>> u = dict(zip(uncertainty.names, uncertainty.u))
        >>> print(f"u(a_3) = {u['a_3']:.4f} mm")
        u(a_3) = 0.0020 mm
        >>> start, end = capture.sockets["A"][0], capture.sockets["B"][0]
        >>> print(f"u of the length between two poses: {uncertainty.length(start, end):.4f} mm")
        u of the length between two poses: 0.0067 mm
    """

    arm: Arm
    covariance: Float[AnyArray, "p p"]
    open: Float[AnyArray, "p p"]  # projector onto undetermined directions, natural steps
    noise: Noise
    u_k: Float[AnyArray, ""] | None
    shared: SharedErrors | None = eqx.field(default=None, kw_only=True)
    names: tuple[str, ...] = eqx.field(static=True)
    degrees_of_freedom: float = eqx.field(static=True)  # degrees of freedom; infinite where the noise was given

    @property
    def space(self) -> Parameters:
        """The free parameters."""
        return Parameters(self.arm, self.names)

    @property
    def complete(self) -> "Uncertainty":
        """The same with the coefficients of the functions that the model lacks as further parameters, which are 0."""
        shared = self.shared
        if shared is None or not shared.names:
            return self
        xp, k = namespace(self), len(shared.names)
        crossed = shared.follow @ shared.moments
        above = xp.concatenate([self.covariance, crossed], axis=1)
        below = xp.concatenate([crossed.T, shared.moments], axis=1)
        return Uncertainty(
            arm=with_further_corrections(self.arm, shared.names),
            covariance=xp.concatenate([above, below]),
            open=xp.asarray(np.pad(np.asarray(self.open), (0, k))),
            noise=self.noise,
            u_k=self.u_k,
            shared=shared.without_functions(),
            names=(*self.names, *shared.names),
            degrees_of_freedom=self.degrees_of_freedom,
        )

    @property
    def in_one_place(self) -> Float[AnyArray, ""] | float:
        """Standard deviation of a tip coordinate by errors that the poses of one visit to a place share, mm."""
        return 0.0 if self.shared is None else self.shared.sd_of(PLACES, VISITS, SUCCESSIVE)

    @property
    @numpy_if_known
    def u(self) -> Float[AnyArray, " p"]:
        """Standard uncertainty of each free parameter; infinite where only a combination is determined.

        0 on a bound, unless the data hardly determine the direction that it ends (`active_bounds`).
        """
        xp = namespace(self)
        alone = xp.sqrt(xp.diagonal(self.covariance))
        return xp.where(xp.diagonal(self.open) > 1e-6, np.inf, alone)

    @property
    @numpy_if_known
    def correlation(self) -> Float[AnyArray, "p p"]:
        """Correlation of the free parameters; 0 with those whose uncertainty is 0."""
        xp = namespace(self)
        u = xp.sqrt(xp.diagonal(self.covariance))
        safe = xp.where(u > 0, u, 1.0)
        return self.covariance / (safe[:, None] * safe[None, :])

    def most_correlated(self, count: int = 45) -> np.ndarray:
        """Indices of the parameters that are correlated most with another, in their order; all of few."""
        strength = np.abs(np.asarray(self.correlation) - np.eye(len(self.names))).max(axis=1, initial=0.0)
        return np.sort(np.argsort(-strength, kind="stable")[:count])

    def correlated(self, least: float = 0.9) -> list[tuple[str, str, float]]:
        """Pairs of parameters with at least this correlation, the strongest first: (name, name, correlation)."""
        if not 0 <= least <= 1:
            raise InputError(f"least is {least:g}; give a correlation between 0 and 1.")
        table = np.asarray(self.correlation)
        pairs = [(i, j) for i in range(len(table)) for j in range(i) if abs(table[i, j]) >= least]
        found = [(self.names[j], self.names[i], float(table[i, j])) for i, j in pairs]
        return sorted(found, key=lambda entry: -abs(entry[2]))

    def factor(self, level: float = 0.95) -> float:
        """Coverage factor of a level: Student's t for the degrees of freedom (JCGM 100, annex G)."""
        if not 0 < level < 1:
            raise InputError(f"level is {level:g}; give a probability between 0 and 1, for example 0.95.")
        return float(student_quantile(0.5 + level / 2, self.degrees_of_freedom))

    @numpy_if_known
    def tip(self, q: Numbers, *, reading: bool = False) -> Float[AnyArray, "... 3 3"]:
        """Covariance of the tip's position in the base frame at joint angles ``(..., n)``, mm^2."""
        q = self._checked(q)
        whole = self.complete
        covariance = whole.covariance_of_functions(whole.derivatives(q))
        return covariance + self._reading(q) if reading else covariance

    @numpy_if_known
    def length(self, start: Numbers, end: Numbers, *, reading: bool = False) -> Float[AnyArray, "..."]:
        """Standard uncertainty of the distance between the tips at two poses, ``(..., n)`` each, mm."""
        xp = namespace(self, start, end, reading)
        start, end = self._checked(start), self._checked(end)
        try:
            np.broadcast_shapes(start.shape, end.shape)
        except ValueError as error:
            raise InputError(
                f"the poses have shapes {start.shape} and {end.shape}; give as many ends as starts."
            ) from error
        between = self.arm.position(end) - self.arm.position(start)
        if is_concrete(between) and np.any(np.linalg.norm(between, axis=-1) < 1e-6):
            raise InputError(
                "both poses put the tip in the same place, so there is no length between them; give others."
            )
        direction, whole = between / xp.linalg.norm(between, axis=-1, keepdims=True), self.complete
        along = xp.einsum("...c,...cp->...p", direction, whole.derivatives(end) - whole.derivatives(start))
        variance = whole.covariance_of_functions(along[..., None, :])[..., 0, 0]
        if reading:
            both = self._reading(start) + self._reading(end)
            variance = variance + xp.einsum("...c,...cd,...d->...", direction, both, direction)
        return xp.sqrt(variance)

    def derivatives(self, q: Float[AnyArray, "... n"]) -> Float[AnyArray, "... 3 p"]:
        """Derivatives of the tip by the free parameters."""
        return self.arm.jacobian(q, self.names)

    def covariance_of_functions(self, derivatives: Float[AnyArray, "... k p"]) -> Float[AnyArray, "... k k"]:
        """Covariance of functions of the parameters with these derivatives; infinite where they follow what is open."""
        xp = namespace(self, derivatives)
        covariance = derivatives @ self.covariance @ xp.swapaxes(derivatives, -1, -2)
        return xp.where(self._is_open(derivatives)[..., None], np.inf, covariance)

    def _checked(self, q: Numbers) -> Float[AnyArray, "... n"]:
        q = checked_readings(self.arm, q)
        if is_concrete(q) and not np.all(np.isfinite(np.asarray(q))):
            raise InputError("a joint angle is not finite; give angles in rad.")
        return q

    def _reading(self, q: Float[AnyArray, "... n"]) -> Float[AnyArray, "... 3 3"]:
        xp = namespace(self, q)
        flat = q.reshape(-1, q.shape[-1])
        geometry = self.arm.geometry
        covariance = xp.moveaxis(tip_covariances(geometry, joint_motion(geometry, flat), self.noise), -1, 0)
        return covariance.reshape(*q.shape[:-1], 3, 3) + self.in_one_place**2 * xp.asarray(np.eye(3))

    def _is_open(self, derivatives: Float[AnyArray, "... k p"]) -> Bool[AnyArray, "... k"]:
        """Which rows follow an undetermined direction."""
        xp = namespace(self, derivatives)
        inside = derivatives @ (self.space.scale[:, None] * self.open)
        return xp.sqrt(xp.sum(inside**2, axis=-1)) > _LEAST_COMPONENT


# An undetermined direction is uncertain by 10 mm or 10 mrad at least: this component of it by 0.1 um.
_LEAST_COMPONENT = 1e-5
