"""Repeatability of an arm's sockets, errors of its reference lengths and residuals of its observations on a capture."""

from collections.abc import Mapping
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.arguments import check_finite, checked_arguments
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, compiled, namespace, to_jax, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.observations.socket import position_of
from ..kinematics.arm import Arm, check_columns
from ..model.metrics import Repeatability, no_repeatability, repeatability
from ..model.observed import Observed
from ..model.socket_sums import to_poses
from .observed_evaluation import ObservedEvaluation, checked_geometry, described, fit_geometry


class Evaluation(eqx.Module):
    """Metrics of one arm on one capture, mm; of a batch of arms with its axes first.

    Example:
        >>> found = aj.evaluate(result.arm, two_bars)
        >>> print(found.error.round(3), "mm")
        [-0.003 -0.001] mm
        >>> print(found.distances.shape)
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
        >>> for name, one in {"nominal": arm, "calibrated": result.arm}.items():
        ...     print(f"{name}: DE {aj.evaluate(one, new).repeatability.de:.3f} mm")
        nominal: DE 1.910 mm
        calibrated: DE 0.012 mm
    """
    check_columns(arm, capture.columns)
    if capture.q.ndim > 2:
        raise InputError("the capture is a batch; evaluate its captures one by one, or map over them with jax.vmap.")
    check_finite(noise=noise)
    observed, lengths = Observed.of(capture, arm, lengths=False), _Lengths.of(capture)
    kept = checked_geometry(observed, geometry)
    whole = bool(capture.observations) or bool(kept) or noise is not None
    subject = observed, lengths, *to_numpy((kept, noise))
    shape = np.broadcast_shapes(*(leaf.shape[:-1] for leaf in jax.tree.leaves(arm)))
    if not shape:
        return to_jax(_evaluated(*to_numpy((arm, *subject)), capture.sizes, whole))
    work = partial(_evaluated, sizes=capture.sizes, whole=whole)
    for _ in shape:
        work = eqx.filter_vmap(work, in_axes=(0, *(None for _ in subject)))
    arm = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*shape, leaf.shape[-1])), arm)
    return work(arm, *subject)


class _Lengths(eqx.Module):
    """The reference lengths of a capture, which are measured and not fitted."""

    nominal: Float[AnyArray, " l"]  # mm
    u: Float[AnyArray, " l"]
    ends: tuple[tuple[str, str], ...] = eqx.field(static=True)  # names of the positions

    @classmethod
    def of(cls, capture: Capture) -> "_Lengths":
        lengths = to_numpy(capture.lengths)
        ends = tuple((position_of(length.start), position_of(length.end)) for length in lengths)
        if not lengths:
            return cls(np.zeros(0), np.zeros(0), ends)
        xp = namespace(lengths)
        return cls(xp.stack([length.value for length in lengths]), xp.stack([length.u for length in lengths]), ends)


@compiled(jit=eqx.filter_jit)
def _evaluated(
    arm: Arm,
    observed: Observed,
    lengths: _Lengths,
    kept: Mapping[str, AnyArray],
    noise: Noise | None,
    sizes: tuple[int, ...],
    whole: bool,
) -> Evaluation:
    """`evaluate` with the observations of a capture, of which the first are its sockets of so many poses; and with the
    residuals of all of them, where these are wanted (``whole``)."""
    found = fit_geometry(arm, observed, kept, noise)
    xp, positions = namespace(found.linear.z), observed.positions
    unknown = not found.redundant and noise is None
    metrics, distances, measured, u = no_repeatability(found.sigma), xp.zeros(0), xp.zeros(0), xp.zeros(0)
    if sizes:
        tips = found.linear.point.forward.tip[:, : sum(sizes)]
        metrics = repeatability(tips.T, sizes)
        index = np.array([positions[position_of(one.name)] for one in observed.observations[: len(sizes)]])
        distances = xp.sqrt(xp.sum((tips - to_poses(found.geometry[index.T], sizes)) ** 2, axis=0))
    if lengths.ends:
        start, end = (np.array([positions[pair[side]] for pair in lengths.ends]) for side in (0, 1))
        between = found.geometry[end] - found.geometry[start]
        measured = xp.sqrt(xp.sum(between**2, axis=1))
        scatter = found.variances_between(lengths.ends, between / measured[:, None])
        u = xp.sqrt((np.nan if unknown else scatter) + lengths.u**2)
    return Evaluation(metrics, measured, measured - lengths.nominal, u, distances, described(found) if whole else None)
