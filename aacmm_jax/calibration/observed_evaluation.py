"""How far the observations of a capture are from their geometry by one arm: the geometry is fitted, the arm is not."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_array
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import AnyArray, compiled, namespace
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Parameters
from ..model.observed import (
    Linear,
    Observed,
    Whitening,
    linear_rows,
    observed_model,
    observed_rows,
    whitening_of,
)
from ..uncertainty import observed_covariance as propagation
from ..uncertainty.covariance import inverse_information
from .bounded_fit import fit

_MAX_STEPS = 300
_LEAST = 1e-4  # smallest standard uncertainty of what is certified, of a tip coordinate's standard deviation
_POSITION_ROWS = 3  # of a kind that also has orientations; these rows come after the position


class ObservedEvaluation(eqx.Module):
    """How the observations of a capture agree with one arm; in their order, sockets first."""

    names: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    residuals: tuple[Float[AnyArray, "*batch _ _"], ...]  # rows and poses of each, mm; of orientations rad
    normalised: tuple[Float[AnyArray, "*batch _ _"], ...]  # the same in standard deviations, uncorrelated
    rms: Float[AnyArray, "*batch k"]  # root mean square distance of a pose from the geometry, mm
    rms_angle: Float[AnyArray, "*batch k"]  # root mean square angle, rad; NaN where no orientation was measured
    reduced_chi: Float[AnyArray, "*batch k"]  # root mean square in standard deviations of a residual
    sigma: Float[AnyArray, "*batch"]  # standard deviation of a tip coordinate by these residuals, mm
    geometry: dict[str, Float[AnyArray, "*batch _"]]  # part of the unknown geometry -> its numbers, mm and rad


class GeometryFit(NamedTuple):
    """The geometry that fits one arm best."""

    observed: Observed
    space: Parameters  # of one parameter, which does not change
    free: np.ndarray  # which numbers are fitted
    z: Float[AnyArray, " z"]
    linear: list[Linear]
    sigma: Float[AnyArray, ""]
    whitening: Whitening

    @property
    def geometry(self) -> Float[AnyArray, " g"]:
        """The numbers of the geometry."""
        return self.z[1:]

    def covariance(self) -> Float[AnyArray, "g g"]:
        """Of the geometry, by an arm without errors but the noise of its readings; 0 for what is kept."""
        xp = namespace(self.z)
        model = observed_model(self.z, (self.space, self.observed, self.whitening, None))
        steps = np.where(self.free, np.concatenate([[1.0], self.observed.steps]), 0.0)
        inverse, _, _ = inverse_information(model.gram * steps[:, None] * steps[None, :], xp.asarray(~self.free))
        return (inverse * steps[:, None] * steps[None, :])[1:, 1:]


def checked_geometry(observed: Observed, geometry: Mapping[str, Numbers] | None) -> dict[str, AnyArray]:
    """The parts of a given geometry that these observations have, or `InputError` where there is none."""
    if geometry is None:
        return {}
    if not isinstance(geometry, Mapping):
        raise InputError("geometry is no dictionary; give that of a calibration: result.observed.geometry.")
    known = {}
    for name, units in observed.blocks.items():
        if name in geometry:
            known[name] = as_array(geometry[name], name, like=np.zeros(0))
            if known[name].shape != (len(units),):
                raise InputError(f"{name} has shape {known[name].shape}; give ({len(units)},).")
    if geometry and not known:
        first = next(iter(geometry))
        raise InputError(
            f"the capture has no '{first}' or other part of this geometry{nearest(first, observed.blocks)}"
        )
    return known


def fit_geometry(arm: Arm, observed: Observed, kept: Mapping[str, AnyArray], noise: Noise | None) -> GeometryFit:
    """Fit the unknown geometry, except for the parts that are kept, to the tips of an arm.

    Reference lengths do not take part: they are to be measured. Where the noise is not given, tips are taken to
    scatter as much as these residuals do.
    """
    space = Parameters(arm, ("d_1",))
    xp = namespace(arm, observed, kept, noise)
    vector = xp.asarray(space.vector())
    start = observed.split(observed.start(space, vector)) | dict(kept)
    z = xp.concatenate([vector, *(start[name] for name in observed.blocks)])
    free = np.concatenate(
        [[False], *(np.full(len(units), name not in kept) for name, units in observed.blocks.items())]
    )
    sides = xp.where(free, -np.inf, z), xp.where(free, np.inf, z)
    steps = xp.asarray(np.concatenate([[1.0], observed.steps]))
    equations = observed.equations - len(observed.ends)

    def weighted(z: Any, first: bool) -> tuple[list[Linear], Any, Whitening]:
        linear = linear_rows(space, observed, z)
        errors = propagation.arm_errors(observed.forward(space, z[:1], z[1:]), linear, observed)
        if first:
            values = xp.concatenate([xp.reshape(part.rows.values[:_POSITION_ROWS], (-1,)) for part in linear])
            sigma = xp.sqrt(xp.mean(values**2)) + 1e-9
        else:
            sigma = propagation.scatter_of(linear, errors, max(equations - int(free.sum()), 1))
        of_arm = [
            propagation.covariance_of_sigma(error, sigma)
            if noise is None
            else propagation.covariance_of_noise(error, noise)
            for error in errors
        ]
        whitening = whitening_of(linear, observed, of_arm, xp.maximum(_LEAST * sigma, 1e-12))
        return linear, sigma, whitening._replace(lengths=xp.zeros(len(observed.ends)))

    _, _, whitening = weighted(z, first=True)
    for _ in range(2):  # with the weights of the start, and with those of that geometry
        args = (space, observed, whitening, None)
        z = fit(observed_rows, observed_model, z, args, sides, steps, _MAX_STEPS).parameters
        linear, sigma, whitening = weighted(z, first=False)
    return GeometryFit(observed, space, free, z, linear, sigma, whitening)


@compiled(jit=eqx.filter_jit)
def evaluate_observations(
    arm: Arm, observed: Observed, kept: Mapping[str, AnyArray], noise: Noise | None
) -> tuple[ObservedEvaluation, Float[AnyArray, " l"], Float[AnyArray, " l"]]:
    """Residuals of all observations by an arm, the reference lengths as it measures them, and u of their errors."""
    found = fit_geometry(arm, observed, kept, noise)
    xp = namespace(found.z)
    parts = observed.split(found.geometry)
    residuals = [part.rows.values for part in found.linear]
    normalised = [
        xp.einsum("mab,bm->am", root, values) for root, values in zip(found.whitening.roots, residuals, strict=True)
    ]
    measured = u = xp.zeros(0)
    if observed.ends:
        between = xp.stack([parts[end] - parts[start] for start, end in observed.ends])
        measured = xp.sqrt(xp.sum(between**2, axis=1))
        direction = between / measured[:, None]
        unit, positions = np.eye(len(observed.steps)), observed.positions
        pull = np.stack([unit[positions[end]] - unit[positions[start]] for start, end in observed.ends])
        rows = xp.einsum("lc,lcg->lg", direction, xp.asarray(pull))
        u = xp.sqrt(xp.einsum("lg,gh,lh->l", rows, found.covariance(), rows) + observed.u**2)
    evaluation = ObservedEvaluation(
        names=tuple(observation.name for observation in observed.observations),
        kinds=tuple(observation.kind for observation in observed.observations),
        residuals=tuple(residuals),
        normalised=tuple(normalised),
        rms=xp.stack([_rms(xp, values[:_POSITION_ROWS]) for values in residuals]),
        rms_angle=xp.stack([_rms(xp, values[_POSITION_ROWS:]) for values in residuals]),
        reduced_chi=xp.stack([xp.sqrt(xp.mean(white**2)) for white in normalised]),
        sigma=found.sigma,
        geometry=parts,
    )
    return evaluation, measured, u


def _rms(xp: Any, rows: Float[AnyArray, "r m"]) -> Float[AnyArray, ""]:
    """Root mean square length of the columns; NaN where they have no rows."""
    return xp.sqrt(xp.mean(xp.sum(rows**2, axis=0))) if rows.shape[0] else xp.asarray(np.nan)
