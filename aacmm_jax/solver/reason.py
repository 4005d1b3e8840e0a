"""Why a solve ended, alone or in a batch."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..core import _compat
from ..core.numpy_or_jax import AnyArray


class Reason(eqx.Enumeration):
    """Why a solve ended.

    Example:
        >>> print(result.result == aj.Reason.gradient)
        True
        >>> print(aj.Reason[result.result])
        Converged: the projected gradient is zero to the tolerance.
    """

    running = "The solve has not ended."
    gradient = "Converged: the projected gradient is zero to the tolerance."
    step = "Converged: the last step is below the tolerance."
    rounding = "Converged: no step can lower the cost by more than rounding error."
    max_steps = "Not converged: the step limit was reached; allow more steps or start closer."
    stalled = (
        "Not converged: no step lowers the cost, and the last point is not a minimum; is the residual smooth, and is "
        "its derivative correct?"
    )
    nonfinite = (
        "Not converged: the residual or its derivative is not finite at the start; check the data and the start."
    )


# Their numbers, which the steps of a solve compute with.
RUNNING, GRADIENT, STEP, ROUNDING, MAX_STEPS, STALLED, NONFINITE = (
    int(_compat.member_numbers(getattr(Reason, name)))
    for name in ("running", "gradient", "step", "rounding", "max_steps", "stalled", "nonfinite")
)


def reasons(numbers: Int[AnyArray, "*slots"]) -> Reason:
    """Reasons of a batch from their numbers."""
    return _compat.members(Reason.running, numbers)


def numbers_of(reason: Reason) -> Int[Array, "*slots"]:
    """The number of each reason of a batch."""
    return jnp.asarray(_compat.member_numbers(reason))
