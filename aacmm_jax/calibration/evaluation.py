"""Repeatability of an arm's sockets, errors of its reference lengths and residuals of its observations on a capture.

The geometry is fitted, the arm is given: the same solve as that of a calibration, with every parameter held
(`fit_geometry`). Sockets are observations like any other; where nothing but sockets was observed and every coordinate
of a tip weighs the same, their positions are the means of their tips.
"""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.arguments import check_finite, checked_arguments
from ..core.arrays import Numbers, as_array
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import AnyArray, compiled, namespace, to_jax, to_numpy
from ..data.capture import Capture, ReferenceLength
from ..data.noise import Noise
from ..data.observations.held import position_of
from ..data.observations.observation import OTHER_UNITS
from ..kinematics.arm import Arm, check_columns
from ..kinematics.parameters import Bounds, Parameters
from ..model.observed import Observed
from ..model.sockets import Repeatability, no_repeatability, repeatability, to_poses
from ..uncertainty.linear_propagation import variances_of_functions
from ..uncertainty.linearisation import Linearisation
from .solve import minimised
from .task import Task, begin, whitening_at


class ObservedEvaluation(eqx.Module):
    """How the observations of a capture agree with one arm; in their order, sockets first."""

    names: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    residuals: tuple[Float[AnyArray, "*batch _ _"], ...]  # rows and poses of each, in the units of the rows of its kind
    distances: tuple[Float[AnyArray, "*batch _"], ...]  # of the poses of each from the geometry, mm
    normalised: tuple[Float[AnyArray, "*batch _ _"], ...]  # the same in standard deviations, uncorrelated
    rms: Float[AnyArray, "*batch k"]  # root mean square distance of a pose from the geometry, mm
    rms_angle: Float[AnyArray, "*batch k"]  # of what is measured in rad: root mean square of a pose's residuals, or NaN
    rms_px: Float[AnyArray, "*batch k"]  # of what is measured in px
    reduced_chi: Float[AnyArray, "*batch k"]  # root mean square in standard deviations of a residual
    sigma: Float[AnyArray, "*batch"]  # standard deviation of a tip coordinate by these residuals, mm
    geometry: dict[str, Float[AnyArray, "*batch _"]]  # part of the unknown geometry -> its numbers, mm and rad


class Evaluation(eqx.Module):
    """Metrics of one arm on one capture, mm; of a batch of arms with its axes first.

    Example:
        >>> evaluation = aj.evaluate(result.arm, two_bars)
        >>> print(evaluation.error.round(3), "mm")
        [-0.003 -0.001] mm
        >>> print(evaluation.distances.shape)
        (60,)
    """

    repeatability: Repeatability
    measured: Float[AnyArray, "*batch l"]  # reference lengths as the arm measures them
    error: Float[AnyArray, "*batch l"]  # measured - calibrated value
    # u of error: the length's own u, and the scatter of the poses at its ends; NaN where unknown
    u: Float[AnyArray, "*batch l"]
    distances: Float[AnyArray, "*batch N"]  # of every pose's tip from its socket's position
    # Residuals of all observations; None of a capture of sockets alone, which `repeatability` describes, unless
    # geometry or noise is given.
    observed: ObservedEvaluation | None = None


@checked_arguments
def evaluate(
    arm: Arm, capture: Capture, *, geometry: Mapping[str, Numbers] | None = None, noise: Noise | None = None
) -> Evaluation:
    """Repeatability, length errors and residuals of an arm on a capture; nothing is fitted but the unknown geometry.

    Args:
        arm: an arm, or a batch of arms (every parameter ``(..., n)``).
        capture: joint readings by socket, rad, reference lengths, and other observations.
        geometry: parts of the geometry that are known already and are not fitted, mm and rad, such as the frame of a
            station and the place of a target by a calibration: ``result.observed.geometry``. Parts that this capture
            does not have are ignored.
        noise: standard deviations of readings and seat, which residuals are compared with; by default the scatter of
            these residuals.

    Returns:
        Metrics in mm; every array has the batch axes of the arm first.

    Raises:
        InputError: capture and arm differ in their number of joints, the capture is a batch, or the geometry is none of
            this capture.

    Example:
        >>> new = aj.simulate(true, {"C": (300, -400, 400)}, poses=20, noise=noise, seed=9)
        >>> for name, evaluated in {"nominal": arm, "calibrated": result.arm}.items():
        ...     print(f"{name}: DE {aj.evaluate(evaluated, new).repeatability.de:.3f} mm")
        nominal: DE 1.910 mm
        calibrated: DE 0.012 mm
    """
    check_columns(arm, capture.columns)
    if capture.q.ndim > 2:
        raise InputError("the capture is a batch; evaluate each capture of the batch separately, or use jax.vmap.")
    check_finite(noise=noise)
    observed = Observed.of(capture, arm, lengths=False)
    if not isinstance(geometry, Mapping | None):
        raise InputError("geometry must be a dictionary; give the geometry of a calibration: result.observed.geometry.")
    kept, given = {}, geometry or {}
    for name, units in observed.blocks.items():
        if name in given:
            kept[name] = as_array(given[name], name, like=np.zeros(0))
            if kept[name].shape != (len(units),):
                raise InputError(f"{name} has shape {kept[name].shape}; give ({len(units)},).")
    if given and not kept:
        first = next(iter(given))
        raise InputError(
            f"the capture has no '{first}' or other part of the given geometry{nearest(first, observed.blocks)}"
        )
    whole = bool(capture.observations) or bool(kept) or noise is not None
    subject = observed, *to_numpy((capture.lengths, kept, noise))
    shape = np.broadcast_shapes(*(leaf.shape[:-1] for leaf in jax.tree.leaves(arm)))
    if not shape:
        return to_jax(_evaluated(*to_numpy((arm, *subject)), capture.sizes, whole))
    work = partial(_evaluated, sizes=capture.sizes, whole=whole)
    for _ in shape:
        work = eqx.filter_vmap(work, in_axes=(0, *(None for _ in subject)))
    arm = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*shape, leaf.shape[-1])), arm)
    return work(arm, *subject)


@compiled(jit=eqx.filter_jit)
def _evaluated(
    arm: Arm,
    observed: Observed,
    lengths: tuple[ReferenceLength, ...],
    kept: Mapping[str, AnyArray],
    noise: Noise | None,
    sizes: tuple[int, ...],
    whole: bool,
) -> Evaluation:
    """`evaluate` with the observations of a capture, of which the first are its sockets of so many poses; and with the
    residuals of all of them, where these are wanted (``whole``)."""
    fitted = fit_geometry(arm, observed, kept, noise)
    linear, geometry = fitted.linear, fitted.geometry
    xp = namespace(linear.z)
    metrics, distances, measured, u = no_repeatability(fitted.sigma), xp.zeros(0), xp.zeros(0), xp.zeros(0)
    nominal = xp.stack([length.value for length in lengths]) if lengths else xp.zeros(0)
    if sizes:
        tips = linear.point.forward.tip[:, : sum(sizes)]
        metrics = repeatability(tips.T, sizes)
        sockets = observed.observations[: len(sizes)]
        index = np.array([observed.positions[position_of(socket.name)] for socket in sockets])
        distances = xp.sqrt(xp.sum((tips - to_poses(geometry[index.T], sizes)) ** 2, axis=0))
    if lengths:
        ends = [(position_of(length.start), position_of(length.end)) for length in lengths]
        measured, pull = observed.distances(geometry, ends)
        # By an arm without errors but the noise of its readings, where anything shows that.
        influence = linear.influence(np.concatenate([[True], ~fitted.free]))
        scatter = variances_of_functions(influence, *observed.by_unknowns(pull, 1))
        scatter = scatter if fitted.redundant or noise is not None else np.nan
        u = xp.sqrt(scatter + xp.stack([length.u for length in lengths]) ** 2)
    described = None
    if whole:
        parts, normalised = observed.split(geometry), linear.white()
        residuals = observed.by_observation([part.values for part in linear.point.rows])
        squares = observed.by_observation(observed.squared_distances(linear.point.rows))
        by_unit = {unit: [] for unit in OTHER_UNITS}
        for observation, values in zip(observed.observations, residuals, strict=True):
            for unit, of_unit in by_unit.items():
                seen = observation.other_unit == unit
                share = observation.other_counts / observation.other_counts.sum()
                of_poses = observation.other_sizes(values) ** 2 if seen else xp.full(len(share), np.nan)
                of_unit.append(xp.sqrt(xp.sum(share * of_poses)))
        described = ObservedEvaluation(
            names=tuple(observation.name for observation in observed.observations),
            kinds=tuple(observation.kind for observation in observed.observations),
            residuals=tuple(residuals),
            distances=tuple(map(xp.sqrt, squares)),
            normalised=tuple(normalised),
            rms=xp.stack([xp.sqrt(xp.mean(square)) for square in squares]),
            rms_angle=xp.stack(by_unit["rad"]),
            rms_px=xp.stack(by_unit["px"]),
            reduced_chi=xp.stack(
                [
                    xp.sqrt(xp.sum(white**2) / float(observation.pose_equations.sum()))
                    for observation, white in zip(observed.observations, normalised, strict=True)
                ]
            ),
            sigma=fitted.sigma,
            geometry={name: parts[name] for name in observed.names},
        )
    return Evaluation(metrics, measured, measured - nominal, u, distances, described)


class GeometryFit(NamedTuple):
    """The geometry that fits one arm best."""

    linear: Linearisation  # of one parameter, which does not change
    free: np.ndarray  # which numbers of the geometry are fitted
    sigma: Float[AnyArray, ""]  # standard deviation of a tip coordinate, mm
    redundant: bool  # whether there are more equations than numbers are fitted; otherwise nothing shows the scatter

    @property
    def geometry(self) -> Float[AnyArray, " g"]:
        """The numbers of the geometry."""
        return self.linear.z[1:]


def fit_geometry(arm: Arm, observed: Observed, kept: Mapping[str, AnyArray], noise: Noise | None) -> GeometryFit:
    """Fit the unknown geometry, except for the parts that are kept, to the tips of an arm.

    ``observed`` has no reference lengths: they are to be measured. Where the noise is not given, tips are taken to
    scatter as much as these residuals do.
    """
    space = Parameters(arm, ("d_1",))
    vector = namespace(arm, observed, kept, noise).asarray(space.vector())
    noise_model = "estimated" if noise is None else "given"
    task = Task(observed, Bounds(space, vector, vector), vector, noise, noise_model, kept=kept)
    z, state, _, _ = minimised(task, begin(task))
    linear = Linearisation.of(observed, space, z, state.point, state.errors, whitening_at(task, state), None)
    return GeometryFit(linear, task.fitted[1:], state.sigma, observed.equations > task.fitted.sum())
