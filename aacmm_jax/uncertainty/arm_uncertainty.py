"""The uncertainty of a calibrated arm: of its parameters, of a tip, of a length."""

from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..core.arrays import Numbers, is_concrete
from ..core.errors import InputError
from ..core.linear_algebra import quadratic_forms, rows_times, semidefinite_eigen
from ..core.numpy_or_jax import AnyArray, namespace, numpy_if_known, to_numpy
from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import Arm, checked_readings
from ..kinematics.chain import joint_motion
from ..kinematics.corrected_arm import with_further_corrections
from ..kinematics.parameters import Parameters
from .between_groups import BetweenGroups
from .covariance import SharedErrors
from .coverage import LEVEL
from .degrees_of_freedom import Components, Law, coverage_factor, degrees_of_freedom
from .kept_geometry import KeptGeometry
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
    # Parts of the covariance that do not rest on the scatter of single poses, but for functions of the readings.
    components: Components | None = eqx.field(default=None, kw_only=True)
    surplus_k: Float[AnyArray, ""] | None = eqx.field(default=None, kw_only=True)  # of u_k^2, by lengths that disagree
    names: tuple[str, ...] = eqx.field(static=True)
    scatter_degrees_of_freedom: float = eqx.field(static=True)  # of the noise; infinite where it was given
    lengths: int = eqx.field(static=True, default=0, kw_only=True)  # from which k was found
    # What an evaluation keeps of the geometry that the calibration found; None: everything is fitted.
    kept: KeptGeometry | None = eqx.field(default=None, kw_only=True)
    # How poses of groups that were held out agree with their prediction; None: no groups were.
    between: BetweenGroups | None = eqx.field(default=None, kw_only=True)

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
        arm, crossed = with_further_corrections(self.arm, shared.names), shared.follow @ shared.moments
        above = xp.concatenate([self.covariance, crossed], axis=1)
        below = xp.concatenate([crossed.T, shared.moments], axis=1)
        parts = shared.of_functions
        if self.components is not None:
            wider = xp.pad(self.components.matrices, ((0, 0), (0, k), (0, k)))
            parts = Components(self.components.names, wider, self.components.law).joined(parts)
        return replace(
            self,
            arm=to_numpy(arm) if xp is np else arm,
            covariance=xp.concatenate([above, below]),
            open=xp.asarray(np.pad(np.asarray(self.open), (0, k))),
            shared=shared.without_functions(),
            components=parts,
            names=(*self.names, *shared.names),
        )

    @property
    def in_one_place(self) -> Float[AnyArray, ""] | float:
        """Standard deviation of a tip coordinate by errors that the poses of one visit to a place share, mm."""
        return 0.0 if self.shared is None else self.shared.sd_of(PLACES, VISITS, SUCCESSIVE)

    @property
    @numpy_if_known
    def u(self) -> Float[AnyArray, " p"]:
        """Standard uncertainty of each free parameter; infinite where only a combination is determined.

        0 on a bound, unless the data hardly determine the direction that it ends (`linearisation.of_active_bounds`).
        """
        xp = namespace(self)
        return xp.where(xp.diagonal(self.open) > 1e-6, np.inf, xp.sqrt(xp.diagonal(self.covariance)))

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
        entries = [(self.names[j], self.names[i], float(table[i, j])) for i, j in pairs]
        return sorted(entries, key=lambda entry: -abs(entry[2]))

    @property
    def scatter(self) -> Law:
        """How well the variance by the scatter of single poses is known."""
        return Law.of(np.array([self.scatter_degrees_of_freedom]))

    @property
    def law(self) -> Law:
        """How well the variances of `parts` are known: the first elsewhere than in the groups that taught the model, if
        the data chose it."""
        scatter = self.scatter
        if self.between is not None and self.between.chosen:
            scatter = self.between.law(self.scatter_degrees_of_freedom)
        return scatter if self.components is None else scatter.joined(self.components.law)

    def parts(self, derivatives: Float[AnyArray, "... p"]) -> Float[AnyArray, "... c"]:
        """Variances of quantities with these derivatives by the parameters: by the scatter, then by `components`."""
        xp = namespace(self, derivatives)
        whole = quadratic_forms(derivatives, self.covariance)[..., None]
        if self.components is None:
            return whole
        others = self.components.variances(derivatives)
        return xp.concatenate([whole - xp.sum(others, axis=-1, keepdims=True), others], axis=-1)

    def _of_parameters(self) -> tuple[Float[np.ndarray, "p c"], Law]:
        whole = to_numpy(self).complete
        return np.asarray(whole.parts(np.eye(len(whole.names))[: len(self.names)])), whole.law

    def factor(self, level: float = LEVEL) -> Float[np.ndarray, " p"]:
        """Coverage factor of the U of each parameter: Student's t, for as many degrees of freedom as what its
        uncertainty rests on gives it (`uncertainty.degrees_of_freedom`)."""
        return coverage_factor(level, *self._of_parameters())

    @property
    def degrees_of_freedom(self) -> Float[np.ndarray, " p"]:
        """Effective degrees of freedom of the uncertainty of each parameter."""
        return degrees_of_freedom(*self._of_parameters())

    def expanded(self, level: float = LEVEL) -> Float[np.ndarray, " p"]:
        """Expanded uncertainty of each parameter, mm and rad; infinite where only a combination is determined."""
        return self.factor(level) * np.asarray(self.u)

    def expanded_of(self, derivatives: Float[np.ndarray, "... p"], level: float = LEVEL) -> Float[np.ndarray, "..."]:
        """Expanded uncertainty of functions of the free parameters with these derivatives."""
        whole = to_numpy(self).complete
        wider = np.pad(derivatives, [*((0, 0),) * (derivatives.ndim - 1), (0, len(whole.names) - len(self.names))])
        return whole.expanded_by_parts(np.asarray(whole.parts(wider)), level)

    def expanded_by_parts(self, parts: Float[AnyArray, "... c"], level: float = LEVEL) -> Float[np.ndarray, "..."]:
        """Expanded uncertainty of quantities of the `complete` uncertainty with these variances of their parts."""
        parts = np.asarray(parts)
        u = np.sqrt(np.maximum(np.sum(parts, axis=-1), 0.0))
        return np.asarray(coverage_factor(level, parts, to_numpy(self).complete.law) * u)

    def expanded_by_scatter(
        self, u: Float[np.ndarray, "..."], stated: Float[np.ndarray, "..."], level: float = LEVEL
    ) -> Float[np.ndarray, "..."]:
        """Expanded uncertainty of what the scatter of single poses and a stated u make uncertain, ``u`` together, such
        as the error of a reference length by the arm as it is."""
        variances = np.stack([np.maximum(u**2 - stated**2, 0.0), stated**2], axis=-1)
        return coverage_factor(level, variances, self.scatter.joined(Law.of(np.array([np.inf])))) * u

    def expanded_k(self, level: float = LEVEL) -> float:
        """Expanded uncertainty of k; NaN without one."""
        if self.u_k is None:
            return float("nan")
        square, surplus = float(self.u_k) ** 2, 0.0 if self.surplus_k is None else float(self.surplus_k)
        law = Law.of(np.array([self.scatter_degrees_of_freedom, max(self.lengths - 1, 1)]))
        return float(coverage_factor(level, np.array([square - surplus, surplus]), law) * np.sqrt(square))

    @numpy_if_known
    def tip(self, q: Numbers, *, reading: bool = False) -> Float[AnyArray, "... 3 3"]:
        """Covariance of the tip's position in the base frame at joint angles ``(..., n)``, mm^2."""
        q = self._checked(q)
        whole = self.complete
        covariance = whole.covariance_of_functions(whole.derivatives(q))
        if reading:
            covariance = covariance + self._noise(q) + self.in_one_place**2 * namespace(self, q).asarray(np.eye(3))
        return covariance

    def expanded_tip(self, q: Numbers, *, level: float = LEVEL, reading: bool = False) -> Float[np.ndarray, "..."]:
        """Expanded uncertainty of the tip at joint angles ``(..., n)``, along its most uncertain direction, mm."""
        return self.expanded_by_parts(self.tip_parts(q, reading=reading), level)

    @numpy_if_known
    def tip_parts(self, q: Numbers, *, reading: bool = False) -> Float[AnyArray, "... c"]:
        """Variances of the tip along the direction in which it is most uncertain, part by part, mm^2."""
        xp, q = namespace(self, q, reading), self._checked(q)
        covariance = self.tip(q, reading=reading)
        finite = xp.all(xp.isfinite(covariance), axis=(-1, -2))
        direction = semidefinite_eigen(xp.where(finite[..., None, None], covariance, 0.0))[1][..., 0]
        parts = self._parts_along(direction, self.complete.derivatives(q), (q,) if reading else ())
        return xp.where(finite[..., None], parts, np.inf)

    @numpy_if_known
    def length(self, start: Numbers, end: Numbers, *, reading: bool = False) -> Float[AnyArray, "..."]:
        """Standard uncertainty of the distance between the tips at two poses, ``(..., n)`` each, mm."""
        return namespace(self, start, end).sqrt(self.length_parts(start, end, reading=reading).sum(axis=-1))

    def expanded_length(
        self, start: Numbers, end: Numbers, *, level: float = LEVEL, reading: bool = False
    ) -> Float[np.ndarray, "..."]:
        """Expanded uncertainty of the distance between the tips at two poses, ``(..., n)`` each, mm."""
        return self.expanded_by_parts(self.length_parts(start, end, reading=reading), level)

    @numpy_if_known
    def length_parts(self, start: Numbers, end: Numbers, *, reading: bool = False) -> Float[AnyArray, "... c"]:
        """Variances of the distance between the tips at two poses, part by part, mm^2."""
        xp = namespace(self, start, end, reading)
        start, end = self._checked(start), self._checked(end)
        try:
            np.broadcast_shapes(start.shape, end.shape)
        except ValueError as error:
            raise InputError(
                f"the poses have shapes {start.shape} and {end.shape}; give the same number of ends as of starts."
            ) from error
        between = self.arm.position(end) - self.arm.position(start)
        if is_concrete(between) and np.any(np.linalg.norm(between, axis=-1) < 1e-6):
            raise InputError(
                "both poses put the tip at the same point, so the length between them is zero; give other poses."
            )
        direction, whole = between / xp.linalg.norm(between, axis=-1, keepdims=True), self.complete
        derivatives = whole.derivatives(end) - whole.derivatives(start)
        return self._parts_along(direction, derivatives, (start, end) if reading else ())

    def _parts_along(
        self, direction: Float[AnyArray, "... 3"], derivatives: Float[AnyArray, "... 3 k"], read: tuple[AnyArray, ...]
    ) -> Float[AnyArray, "... c"]:
        """Variances along a direction of what has these derivatives by the `complete` parameters, with the noise of
        each pose that is ``read``, and what the poses of its place share; infinite where it follows what is open."""
        xp, whole = namespace(self, direction), self.complete
        parts = whole.parts_of_functions(xp.einsum("...c,...cp->...p", direction, derivatives))
        if not read:
            return parts
        noise: AnyArray = sum((self._noise(q) for q in read[1:]), self._noise(read[0]))
        added = [xp.einsum("...c,...cd,...d->...", direction, noise, direction)]
        for name in () if whole.components is None else whole.components.names:
            in_place = 0.0 if whole.shared is None else whole.shared.sd_of(name)
            added.append(xp.zeros_like(added[0]) + len(read) * in_place**2)
        return parts + xp.stack(added, axis=-1)

    def derivatives(self, q: Float[AnyArray, "... n"]) -> Float[AnyArray, "... 3 p"]:
        """Derivatives of the tip by the free parameters."""
        return self.arm.jacobian(q, self.names)

    def covariance_of_functions(self, derivatives: Float[AnyArray, "... k p"]) -> Float[AnyArray, "... k k"]:
        """Covariance of functions of the parameters with these derivatives; infinite where they follow what is open."""
        xp = namespace(self, derivatives)
        covariance = rows_times(derivatives, self.covariance) @ xp.swapaxes(derivatives, -1, -2)
        return xp.where(self._is_open(derivatives)[..., None], np.inf, covariance)

    def parts_of_functions(self, derivatives: Float[AnyArray, "... p"]) -> Float[AnyArray, "... c"]:
        """`parts` of functions of the parameters with these derivatives; infinite where they follow what is open."""
        is_open = self._is_open(derivatives[..., None, :])
        return namespace(self, derivatives).where(is_open, np.inf, self.parts(derivatives))

    def _checked(self, q: Numbers) -> Float[AnyArray, "... n"]:
        q = checked_readings(self.arm, q)
        if is_concrete(q) and not np.all(np.isfinite(np.asarray(q))):
            raise InputError("a joint angle is not finite; give angles in rad.")
        return q

    def _noise(self, q: Float[AnyArray, "... n"]) -> Float[AnyArray, "... 3 3"]:
        xp = namespace(self, q)
        flat = q.reshape(-1, q.shape[-1])
        geometry = self.arm.geometry
        covariance = xp.moveaxis(tip_covariances(geometry, joint_motion(geometry, flat), self.noise), -1, 0)
        return covariance.reshape(*q.shape[:-1], 3, 3)

    def _is_open(self, derivatives: Float[AnyArray, "... k p"]) -> Bool[AnyArray, "... k"]:
        """Which rows follow an undetermined direction."""
        xp = namespace(self, derivatives)
        if xp is np and not np.any(self.open):
            return np.zeros(derivatives.shape[:-1], dtype=bool)
        inside = rows_times(derivatives, self.space.scale[:, None] * self.open)
        return xp.sqrt(xp.sum(inside**2, axis=-1)) > _LEAST_COMPONENT


# An undetermined direction is uncertain by 10 mm or 10 mrad at least: this component of it by 0.1 um.
_LEAST_COMPONENT = 1e-5
