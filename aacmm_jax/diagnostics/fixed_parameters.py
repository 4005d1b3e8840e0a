"""Which parameters to fix so that a capture determines all others: one complete list for ``--held``."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from ..data.capture import Capture
from ..kinematics.arm import is_length, parameter_names, value_of
from ..kinematics.parameters import Bounds, Parameters
from ..uncertainty.identifiability import observability
from .joint_travel import lost_by_standing

_SHARE = 0.1  # of the largest component of a direction: a parameter with less does not stand for it
_ROUNDING = 1e-6


def fixed_parameters(bounds: Bounds, capture: Capture, joints: Sequence[int], sigma: float) -> tuple[str, ...]:
    """Parameters whose values should be fixed: those that are, and one of each combination that is not determined.

    Of what cannot be separated, angles and lengths that are nominally zero are fixed first, those of these joints
    before others: another length, fixed at its nominal value, would set the scale beside what was measured.

    Args:
        bounds: The free parameters as a calibration would take them, and their bounds.
        capture: The poses.
        joints: Joints, from 1, whose parameters are fixed rather than others'.
        sigma: Standard deviation of a tip coordinate, mm, by which combinations are hardly determined.

    Returns:
        The names of all fixed parameters, in the arm's order.
    """
    arm = bounds.space.base
    own = {f"{kind}_{joint}" for kind in ("alpha", "a", "d", "theta", "beta") for joint in joints}

    def rank(name: str) -> tuple[bool, bool]:
        return is_length(name) and abs(float(value_of(arm, name))) > _ROUNDING, name not in own

    # First as if they stood exactly still, since it is little, and mostly noise, that a small movement says.
    order = sorted(bounds.space.names, key=rank, reverse=True)
    lost = {name for part in lost_by_standing(arm, capture, joints, order) for name in part}
    names = [name for name in bounds.space.names if name not in lost]
    scaled = bool(capture.lengths) or any(one.fixes_scale for one in capture.observations)
    for _ in bounds.space.names:
        space = Parameters(arm, tuple(names))
        found = observability(arm, capture, space, sigma=sigma, bounds=_of(bounds, space))
        null = found.null if scaled else _without_scale(found.null, space)
        if null.shape[1]:
            fixed = _leading(null, names, rank)
        elif found.trade_offs:
            weak = found.trade_offs[0]
            amounts = np.abs(weak.amounts)
            enough = [
                name for name, amount in zip(weak.names, amounts, strict=True) if amount >= _SHARE * amounts.max()
            ]
            fixed = [min(enough, key=rank)]
        else:
            break
        if len(fixed) == len(names):
            break
        names = [name for name in names if name not in fixed]
    added = {name for name in bounds.space.names if name not in names}
    usual = {name for name in bounds.space.held if not name.startswith(("beta_", "gravity_"))}
    return tuple(name for name in parameter_names(arm) if name in usual | added)


def _of(bounds: Bounds, space: Parameters) -> Bounds:
    rows = [bounds.space.names.index(name) for name in space.names]
    return Bounds(space, np.asarray(bounds.lower)[rows], np.asarray(bounds.upper)[rows])


def _leading(
    null: Float[np.ndarray, "p k"], names: Sequence[str], rank: Callable[[str], tuple[bool, bool]]
) -> list[str]:
    """As many parameters as there are directions, each in what those before it leave of them."""
    rest, found = null.copy(), []
    for _ in range(null.shape[1]):
        sizes = np.linalg.norm(rest, axis=1)
        first = min(np.flatnonzero(sizes > _SHARE * sizes.max()).tolist(), key=lambda i: (*rank(names[i]), -sizes[i]))
        direction = rest[first] / sizes[first]
        rest = rest - np.outer(rest @ direction, direction)
        found.append(names[first])
    return found


def _without_scale(null: Float[np.ndarray, "p k"], space: Parameters) -> Float[np.ndarray, "p left"]:
    """Directions beside that of all lengths together, which nothing sets in such captures."""
    scale = np.where(space.lengths, np.asarray(space.vector(space.base)), 0.0)
    scale = scale / max(float(np.linalg.norm(scale)), _ROUNDING)
    basis, sizes, _ = np.linalg.svd(null - np.outer(scale, scale @ null), full_matrices=False)
    return basis[:, sizes > _ROUNDING]
