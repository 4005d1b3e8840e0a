"""How far the observations of a capture are from their geometry by one arm: the geometry is fitted, the arm is not.

Sockets are observations like any other. Where nothing but sockets was observed and every coordinate of a tip weighs the
same, their positions are the means of their tips, and nothing is iterated.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_array
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import AnyArray, namespace, set_at, stop_gradient
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Parameters
from ..model.elimination import Args, observed_model, observed_rows, with_linear_geometry
from ..model.observed import Observed
from ..model.rows import PointRows, Whitening, rows_at, whitening_of
from ..solver.arrow import split
from ..uncertainty.linear_propagation import variances_of_functions
from ..uncertainty.linearisation import Linearisation
from ..uncertainty.tip_errors import ArmErrors, arm_errors, covariance_of_noise, covariance_of_sigma, scatter_of
from .bounded_fit import fit

_MAX_STEPS = 300
_LEAST = 1e-4  # smallest standard uncertainty of what is certified, of a tip coordinate's standard deviation
_SMALLEST = 1e-300  # mm^2: the derivative of the root of 0 is infinite
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
    sigma: Float[AnyArray, ""]  # standard deviation of a tip coordinate, mm
    redundant: bool  # whether there are more equations than numbers are fitted; otherwise nothing shows the scatter

    @property
    def geometry(self) -> Float[AnyArray, " g"]:
        """The numbers of the geometry."""
        return self.linear.z[1:]

    def variances_between(
        self, ends: tuple[tuple[str, str], ...], directions: Float[AnyArray, "l 3"]
    ) -> Float[AnyArray, " l"]:
        """Variances of the distances between positions, along unit vectors, by an arm without errors but the noise of
        its readings."""
        xp, observed = namespace(self.linear.z, directions), self.linear.observed
        influence = self.linear.influence(np.concatenate([[True], ~self.free]))
        positions, pull = observed.positions, xp.zeros((len(ends), len(self.free)))
        for side, along in enumerate((-directions, directions)):
            index = np.array([positions[pair[side]] for pair in ends])
            pull = set_at(pull, (np.arange(len(ends))[:, None], index), along)
        head, components = split(pull * observed.steps[None, :], observed.layout.shared, observed.layout.classes)
        return variances_of_functions(influence, xp.concatenate([xp.zeros((len(ends), 1)), head], axis=1), components)


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
    free = np.concatenate([np.full(len(units), name not in kept) for name, units in observed.blocks.items()])
    spare = observed.equations - len(observed.ends) - int(free.sum())
    layout = observed.layout
    alike = noise is None and not kept and not layout.shared and layout.linear == len(layout.classes)
    vector = xp.asarray(space.vector())
    if alike:
        z = xp.concatenate([vector, xp.zeros(len(free))])
    else:
        start = observed.split(observed.start(space, vector)) | dict(kept)
        z = xp.concatenate([vector, *(start[name] for name in observed.blocks)])

    def weighted(z: Any, first: bool) -> tuple[PointRows, list[ArmErrors], Any, Whitening]:
        point = rows_at(space, observed, z)
        errors = arm_errors(point, observed)
        if first or alike:
            values = xp.concatenate([xp.reshape(part.values[:_POSITION_ROWS], (-1,)) for part in point.rows])
            sigma = xp.sqrt(xp.sum(values**2) / (max(spare, 1) if alike else len(values)) + _SMALLEST)
        else:
            sigma = scatter_of(point.rows, errors, max(spare, 1))
        of_arm = [
            covariance_of_sigma(error, sigma) if noise is None else covariance_of_noise(error, noise)
            for error in errors
        ]
        whitening = whitening_of(point.rows, observed, of_arm, xp.maximum(_LEAST * sigma, 1e-12))
        return point, errors, sigma, whitening._replace(lengths=xp.zeros(len(observed.ends)))

    # With the weights of the start, and with those of that geometry.
    equal = Whitening((None,) * len(layout.groups), np.zeros(0), {})
    whitening = equal if alike else weighted(z, first=True)[-1]
    for _ in range(1 if alike else 2):
        z = _fitted(Args(space, observed, whitening), z, np.concatenate([[False], free]))
        point, errors, sigma, whitening = weighted(z, first=False)
    return GeometryFit(Linearisation.of(observed, space, z, point, errors, whitening, None), free, sigma, spare > 0)


def _fitted(args: Args, z: Float[AnyArray, " z"], free: np.ndarray) -> Float[AnyArray, " z"]:
    """One least squares of the free numbers; positions in which the rows are linear are no unknowns of it."""
    xp, observed = namespace(z, args), args.observed
    layout = observed.layout
    count = len(free) - sum(number * size for number, size in layout.classes[len(layout.classes) - layout.linear :])
    if not free[count:].all():  # a position that is kept
        count = len(free)
    if count < len(free):
        args = args._replace(linear=stop_gradient(z[count:]))
    z, free = z[:count], free[:count]
    if free.any():
        sides = xp.where(free, -np.inf, z), xp.where(free, np.inf, z)
        steps = xp.asarray(np.concatenate([[1.0], observed.steps])[:count])
        z = fit(observed_rows, observed_model, z, args, sides, steps, _MAX_STEPS).parameters
    return z if args.linear is None else with_linear_geometry(z, args)[0]


def described(found: GeometryFit) -> ObservedEvaluation:
    """Residuals of all observations by an arm whose geometry is fitted."""
    linear, observed = found.linear, found.linear.observed
    xp = namespace(linear.z)
    parts = observed.split(found.geometry)
    residuals = observed.by_observation([part.values for part in linear.point.rows])
    normalised = linear.white()
    return ObservedEvaluation(
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


def _rms(xp: Any, rows: Float[AnyArray, "r m"]) -> Float[AnyArray, ""]:
    """Root mean square length of the columns; NaN where they have no rows."""
    return xp.sqrt(xp.mean(xp.sum(rows**2, axis=0))) if rows.shape[0] else xp.asarray(np.nan)
