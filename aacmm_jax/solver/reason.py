"""Why a solve ended, alone or in a batch."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..core import _compat


class Reason(eqx.Enumeration):
    """Why a solve ended."""

    running = "It has not ended."
    gradient = "Converged: the projected gradient is zero to the tolerance."
    step = "Converged: the last step is below the tolerance."
    rounding = "Converged: no step can lower the cost by more than rounding error."
    max_steps = "Not converged: the step limit was reached; allow more steps or start closer."
    stalled = "Not converged: no step lowers the cost although the gradient is not zero; is the residual smooth?"
    nonfinite = (
        "Not converged: the residual or its derivative is not finite at the start; check the data and the start."
    )


def reasons(numbers: Int[Array, "*slots"]) -> Reason:
    """Reasons of a batch from their numbers."""
    return _compat.members(Reason.running, numbers)


def numbers_of(reason: Reason) -> Int[Array, "*slots"]:
    """The number of each reason of a batch."""
    return jnp.asarray(_compat.member_numbers(reason))


def either(predicate: Bool[Array, "*slots"], one: Reason, other: Reason) -> Reason:
    """Element by element, one reason or the other."""
    return reasons(jnp.where(predicate, numbers_of(one), numbers_of(other)))
