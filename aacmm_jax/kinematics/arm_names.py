"""Names of an arm's parameters: where each is, and which are lengths."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..core.arguments import shown
from ..core.errors import InputError, nearest

LENGTHS = ("a", "d", "probe")
AXES = ("x", "y", "z")
_LENGTH_STEP, _ANGLE_STEP = 1.0, 1e-3  # comparable at the tip of an arm of about 1 m


def probe_names(tips: int) -> list[str]:
    """Names of the coordinates of the tips: ``probe_x|y|z`` of the first, ``probe2_x`` of the second."""
    return [f"probe{'' if tip == 1 else tip}_{axis}" for tip in range(1, tips + 1) for axis in AXES]


def located(
    joints: int, corrections: tuple[str, ...], name: str, tips: int = 1, extra: tuple[str, ...] = ()
) -> tuple[str, int]:
    """`locate` for an arm with so many joints, corrections of these names, and so many tips."""
    kinds = ("alpha", "a", "d", "theta", "beta", *extra)
    kind, _, index = name.rpartition("_") if isinstance(name, str) else ("", "", "")
    if (kind == "probe" or name in corrections) and index in AXES:
        return kind, AXES.index(index)
    if tips > 1 and name in (probes := probe_names(tips)):
        return "probe", probes.index(name)
    if name in corrections:
        return "coefficients", corrections.index(name)
    if kind in kinds and index.isdecimal() and str(int(index)) == index and 1 <= int(index) <= joints:
        return kind, int(index) - 1
    names = [*(f"{k}_{i}" for k in kinds for i in range(1, joints + 1)), *probe_names(tips)]
    given = name if isinstance(name, str) else shown(name)
    raise InputError(f"unknown parameter '{given}' of a {joints}-joint arm{nearest(given, [*names, *corrections])}")


def is_length(name: str) -> bool:
    """Whether a parameter name is a length (a, d, probe) and not an angle."""
    kind = name.rpartition("_")[0]
    return kind in LENGTHS or (kind.startswith("probe") and kind[5:].isdecimal())


def natural_steps(names: Sequence[str]) -> Float[np.ndarray, " p"]:
    """Natural step of each named parameter: 1 mm for a length, 1 mrad for an angle."""
    return np.where([is_length(name) for name in names], _LENGTH_STEP, _ANGLE_STEP)
