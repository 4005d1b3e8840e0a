"""The scale anchor of stage 1: a free length kept at its start, or fixed lengths that determine the scale well."""

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..core.arguments import shown
from ..core.arrays import is_concrete
from ..core.errors import InputError
from ..core.text import shorten
from ..data.noise import Noise
from ..kinematics.arm import (
    Arm,
    is_length,
    is_single,
    jacobian_at,
    natural_steps,
    neighbouring_arm,
    parameter_names,
    value_of,
)
from ..kinematics.parameters import Parameters, based_on
from ..kinematics.workspace import total_link_length
from ..model.scale import Partners

# Fixed lengths set the scale where repeatability with them would determine it to this relative standard uncertainty ...
_LARGEST_UNCERTAINTY = 1e-4
# ... with 200 equations to spare (about 70 poses) and, where the noise is not given, tips that scatter by so many mm.
_EQUATIONS = 200
_SCATTER = 0.02
_CONFIGURATIONS = 100
_LEAST_SHARE = 0.05  # of the longest link: a shorter length hardly changes the scale
_EXACT = 1e-9  # residual, relative to the column, below which free lengths replace a fixed one exactly


class ScaleAnchor(NamedTuple):
    """What sets the scale in stage 1, and how stage 2 changes it; static, so that it may fix a compiled program."""

    hold: str | None  # free length that stage 1 keeps at its start
    # Length that stage 2 adjusts where it has to identify again; None without a free length, or where neither an anchor
    # nor the values of the arm are known.
    adjusted: str | None
    set_by: tuple[str, ...]  # fixed lengths that determine the scale well, so that stage 2 changes nothing
    # Fixed lengths that free ones replace exactly in stage 2; None where some have no such partner, or are not known.
    partners: Partners | None

    @property
    def can_scale(self) -> bool:
        """Whether stage 2 changes the arm: not where fixed lengths set the scale, or no length is free."""
        return not self.set_by and self.adjusted is not None


def scale_anchor(space: Parameters, arm: Arm, hold: str | None, noise: Noise | None = None) -> ScaleAnchor:
    """What sets the scale of stage 1.

    ``hold`` names a free length, or is None for no anchor. "longest" is the longest free link, but for one case: no
    anchor where fixed lengths determine the scale well, to 1e-4 by repeatability alone (0.02 mm, 70 poses). It is
    judged by how much a common change of these lengths moves the tips once the free parameters have adapted: d_3 = 750
    mm, known from a drawing, sets the scale; probe_x = 0.6 mm does not, and d_7 with a free probe along the same axis
    not at all.

    Raises `InputError` for an angle, a parameter that is not free, or "longest" with an arm whose values are traced.
    """
    space = based_on(space, arm)
    arm = space.base
    known = is_concrete(*jax.tree.leaves(arm))
    lengths = [name for name in space.names if is_length(name)]
    if not isinstance(hold, str | None):
        raise InputError(f"hold is {shown(hold)}; give the name of a length, 'longest' or None.")
    if hold not in (None, "longest") and hold not in lengths:
        space.index(hold)
        example = f", for example '{lengths[0]}'" if lengths else ", or leave out hold, since no length is free"
        raise InputError(f"hold is '{hold}', which is an angle; hold a length{example}.")
    if hold == "longest" and (not lengths or len(space.names) == 1):
        hold = None
    if hold == "longest" and not known:
        raise InputError(
            "hold='longest' needs an arm with known values; where the arm itself is traced, name the length to hold."
        )
    fixed = fixed_lengths(arm, space)
    one = _first(arm) if known and fixed else None
    columns = None if one is None else _columns_of_both(one, space, fixed)
    set_by = ()
    if one is not None and columns is not None and hold in (None, "longest"):
        set_by = fixed if _sets_scale(one, columns, space, fixed, noise) else ()
    longest = _longest_link(lengths, arm if known else None)
    if hold == "longest":
        hold = None if set_by else longest
    partners = _partners(arm, columns, space, fixed) if columns is not None else None if fixed else ((), ())
    adjusted = hold if hold is not None and _carries_scale(hold, longest, arm if known else None) else longest
    return ScaleAnchor(hold, None if hold is None and not known else adjusted, set_by, partners)


def scale_set_by_clause(names: tuple[str, ...]) -> str:
    """The beginning of a warning about fixed lengths that set the scale."""
    verbs = "is fixed and already sets" if len(names) == 1 else "are fixed and already set"
    return f"{shorten(names)} {verbs} the scale"


def fixed_lengths(arm: Arm, space: Parameters) -> tuple[str, ...]:
    """Fixed lengths that the scale concerns: all but ``d_1`` and, where values are known, those that are zero."""
    names = [name for name in parameter_names(arm) if is_length(name) and name not in ("d_1", *space.names)]
    if not is_concrete(*jax.tree.leaves(arm)):
        return tuple(names)
    return tuple(name for name in names if np.any(value_of(arm, name) != 0))


def _longest_link(lengths: list[str], arm: Arm | None) -> str | None:
    links = [name for name in lengths if not name.startswith("probe") and name != "d_1"] or lengths
    if not links or arm is None:
        return links[0] if links else None
    return max(links, key=lambda name: np.abs(value_of(arm, name)).max())


def _carries_scale(name: str, longest: str | None, arm: Arm | None) -> bool:
    """Whether changing this length changes the scale: not ``d_1``, and not one that is nearly zero."""
    if name == "d_1" or longest is None or arm is None:
        return name != "d_1"
    size, largest = (float(np.abs(value_of(arm, other)).max()) for other in (name, longest))
    return size >= _LEAST_SHARE * largest


def _first(arm: Arm) -> Arm:
    """One arm of a batch, which may be one in some of its parameters only."""
    if is_single(arm):
        return arm
    with jax.ensure_compile_time_eval():
        return jax.tree.map(lambda leaf: leaf.reshape(-1, leaf.shape[-1])[0], arm)


def _columns_of_both(arm: Arm, space: Parameters, fixed: tuple[str, ...]) -> list[Float[np.ndarray, "rows k"]]:
    """Derivatives of the tips by free parameters and fixed lengths at random configurations, less what they have in
    common: of the nominal arm and of a neighbouring one, which has no special position."""
    names, found = (*space.names, *fixed), []
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (_CONFIGURATIONS, arm.joints))
    with jax.ensure_compile_time_eval():
        for one in (arm, neighbouring_arm(arm, space.names)):
            columns = jacobian_at(one, q, names)
            found.append((columns - columns.mean(axis=0)).reshape(-1, len(names)))
    return found


def _sets_scale(
    arm: Arm, columns: list[np.ndarray], space: Parameters, fixed: tuple[str, ...], noise: Noise | None
) -> bool:
    """Whether repeatability determines the scale well, given the fixed lengths.

    A common relative change of the fixed lengths is imitated by the free parameters as well as they can; the residual,
    in mm at the tip, is what repeatability sees of the scale. The nominal arm may be in a special position that the
    real one does not share, so the smaller of two residuals counts: at the nominal arm, and at a neighbouring one.
    """
    sizes = []
    values = np.array([value_of(arm, name) for name in fixed])
    for rows in columns:
        free = rows[:, : len(space.names)] * natural_steps(space.names)
        scaling = rows[:, len(space.names) :] @ values
        residual = scaling - free @ np.linalg.lstsq(free, scaling, rcond=1e-10)[0]
        sizes.append(float(np.sqrt(np.mean(residual**2))))
    return _scatter(arm, noise) <= _LARGEST_UNCERTAINTY * math.sqrt(_EQUATIONS) * min(sizes)


def _scatter(arm: Arm, noise: Noise | None) -> float:
    """Standard deviation of a tip coordinate, mm, as the noise has it for a tip at half of the arm's reach."""
    if noise is None or not is_concrete(noise.encoder, noise.seating):
        return _SCATTER
    encoder = float(np.sqrt(np.mean(np.asarray(noise.encoder) ** 2)))
    return math.hypot(encoder * total_link_length(arm) / 2, float(noise.seating))


def _partners(arm: Arm, columns: list[np.ndarray], space: Parameters, fixed: tuple[str, ...]) -> Partners | None:
    """Free lengths that replace the fixed ones exactly, whatever the free angles are.

    Tips are linear in the lengths, so the weights are a linear least squares; that they serve two arms with different
    free angles shows that they follow from the fixed angles alone (alpha_n = 0 makes d_n and probe_z one).
    """
    angles = [name for name in parameter_names(arm) if not is_length(name) and name not in space.names]
    if any(np.ptp(value_of(arm, name)) > 0 for name in angles):
        return None  # the arms of this batch have different fixed angles
    free = tuple(name for name in space.names if is_length(name) and name != "d_1")
    rows = np.concatenate(columns)
    replaceable = rows[:, [space.names.index(name) for name in free]]
    wanted = rows[:, len(space.names) :]
    weights = np.linalg.lstsq(replaceable, wanted, rcond=1e-10)[0] if free else np.zeros((0, len(fixed)))
    if np.any(np.linalg.norm(wanted - replaceable @ weights, axis=0) > _EXACT * np.linalg.norm(wanted, axis=0) + 1e-12):
        return None
    weights = np.where(np.abs(weights) < _EXACT, 0.0, weights)
    by_name = dict(zip(free, weights.tolist(), strict=True))
    return fixed, tuple(tuple(by_name.get(name, [0.0] * len(fixed))) for name in space.names)
