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
from ..model.elimination import Args, observed_model, observed_rows
from ..model.observed import Observed
from ..model.rows import PointRows, Whitening, rows_at, whitening_of
from ..uncertainty.linear_propagation import geometry_covariance
from ..uncertainty.linearisation import Linearisation
from ..uncertainty.tip_errors import ArmErrors, arm_errors, covariance_of_noise, covariance_of_sigma, scatter_of
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

    linear: Linearisation  # of one parameter, which does not change; lengths do not take part
    free: np.ndarray  # which numbers of the geometry are fitted
    sigma: Float[AnyArray, ""]

    @property
    def geometry(self) -> Float[AnyArray, " g"]:
        """The numbers of the geometry."""
        return self.linear.z[1:]


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
    spare = max(observed.equations - len(observed.ends) - int(free.sum()), 1)

    def weighted(z: Any, first: bool) -> tuple[PointRows, list[ArmErrors], Any, Whitening]:
        point = rows_at(space, observed, z)
        errors = arm_errors(point, observed)
        if first:
            values = xp.concatenate([xp.reshape(part.values[:_POSITION_ROWS], (-1,)) for part in point.rows])
            sigma = xp.sqrt(xp.mean(values**2)) + 1e-9
        else:
            sigma = scatter_of(point.rows, errors, spare)
        of_arm = [
            covariance_of_sigma(error, sigma) if noise is None else covariance_of_noise(error, noise)
            for error in errors
        ]
        whitening = whitening_of(point.rows, observed, of_arm, xp.maximum(_LEAST * sigma, 1e-12))
        return point, errors, sigma, whitening._replace(lengths=xp.zeros(len(observed.ends)))

    whitening = weighted(z, first=True)[-1]
    for _ in range(2):  # with the weights of the start, and with those of that geometry
        args = Args(space, observed, whitening)
        z = fit(observed_rows, observed_model, z, args, sides, steps, _MAX_STEPS).parameters
        point, errors, sigma, whitening = weighted(z, first=False)
    return GeometryFit(Linearisation.of(observed, space, z, point, errors, whitening, None), free[1:], sigma)


@compiled(jit=eqx.filter_jit)
def evaluate_observations(
    arm: Arm, observed: Observed, kept: Mapping[str, AnyArray], noise: Noise | None
) -> tuple[ObservedEvaluation, Float[AnyArray, " l"], Float[AnyArray, " l"]]:
    """Residuals of all observations by an arm, the reference lengths as it measures them, and u of their errors."""
    found = fit_geometry(arm, observed, kept, noise)
    linear = found.linear
    xp = namespace(linear.z)
    parts = observed.split(found.geometry)
    residuals = observed.by_observation([part.values for part in linear.point.rows])
    normalised = linear.white()
    measured = u = xp.zeros(0)
    if observed.ends:
        between = xp.stack([parts[end] - parts[start] for start, end in observed.ends])
        measured = xp.sqrt(xp.sum(between**2, axis=1))
        u = xp.sqrt(_of_lengths(found, between / measured[:, None]) + observed.u**2)
    evaluation = ObservedEvaluation(
        names=tuple(observation.name for observation in observed.observations),
        kinds=tuple(observation.kind for observation in observed.observations),
        residuals=tuple(residuals),
        normalised=tuple(normalised),
        rms=xp.stack([_rms(xp, values[:_POSITION_ROWS]) for values in residuals]),
        rms_angle=xp.stack([_rms(xp, values[_POSITION_ROWS:]) for values in residuals]),
        reduced_chi=xp.stack([xp.sqrt(xp.mean(white**2)) for white in normalised]),
        sigma=found.sigma,
        geometry={name: parts[name] for name in observed.names},
    )
    return evaluation, measured, u


def _of_lengths(found: GeometryFit, directions: Float[AnyArray, "l 3"]) -> Float[AnyArray, " l"]:
    """Variances of the distances between positions that the geometry has, by an arm without errors but the noise of
    its readings."""
    xp, observed, variances = namespace(directions), found.linear.observed, []
    influence = found.linear.influence(np.concatenate([[True], ~found.free]))
    covariance, positions = influence.covariance(), observed.positions
    for (start, end), along in zip(observed.ends, directions, strict=True):
        index = np.concatenate([positions[start], positions[end]])
        both = geometry_covariance(observed.layout, covariance, 1, index) * np.outer(*(observed.steps[index],) * 2)
        pull = xp.concatenate([-along, along])
        variances.append(pull @ both @ pull)
    return xp.stack(variances)


def _rms(xp: Any, rows: Float[AnyArray, "r m"]) -> Float[AnyArray, ""]:
    """Root mean square length of the columns; NaN where they have no rows."""
    return xp.sqrt(xp.mean(xp.sum(rows**2, axis=0))) if rows.shape[0] else xp.asarray(np.nan)
