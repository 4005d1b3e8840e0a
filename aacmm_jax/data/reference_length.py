"""Reference lengths: certified distances between two sockets."""

from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.arguments import Range, checked, shown
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray
from ..kinematics.corrections import REFERENCE_TEMPERATURE

_LENGTH = Annotated[Float[AnyArray, ""], Range(above=0, unit="mm")]
_UNCERTAINTY = Annotated[Float[AnyArray, ""], Range(least=0, unit="mm")]
_TEMPERATURES = (-50.0, 100.0)  # C; room temperatures in kelvins are outside
_LARGEST_EXPANSION = 1e-3  # 1/K: plastics expand by up to 2e-4


def check_temperatures(where: str, temperatures: Float[np.ndarray, "..."]) -> None:
    """Raise `InputError` where temperatures are not in degrees Celsius; ``where`` names what has them."""
    low, high = _TEMPERATURES
    wrong = temperatures[~((temperatures >= low) & (temperatures <= high))]
    if wrong.size:
        raise InputError(
            f"{where} has a temperature of {wrong.flat[0]:g} C, which is not between {low:g} and {high:g}; give "
            "degrees Celsius."
        )


class ReferenceLength(eqx.Module):
    """A physical artefact: the certified distance between two sockets.

    Args:
        start: Name of the socket at one end.
        end: Name of the socket at the other end.
        value: Calibrated length, scalar, mm.
        u: Standard uncertainty (k = 1) of ``value``, scalar, mm.

    Raises:
        InputError: Where both ends are one socket, ``value`` is not positive or ``u`` is negative.

    Example:
        >>> bar = aj.ReferenceLength("A", "B", value=500.012, u=0.002)
        >>> print(aj.Capture({"A": [q, q + 0.1], "B": [q + 0.2]}, lengths=[bar]).lengths[0].u)
        0.002
    """

    start: str = eqx.field(static=True)
    end: str = eqx.field(static=True)
    value: Float[AnyArray, ""]
    u: Float[AnyArray, ""]

    def __init__(self, start: str, end: str, value: Numbers, u: Numbers = 0.0):
        for name in (start, end):
            if not isinstance(name, str):
                raise InputError(f"an end of a reference length is {shown(name)}; give the name of a socket.")
        self.start, self.end = start, end
        where = f"reference length '{start}' to '{end}'"
        if start == end:
            raise InputError(f"{where} joins a socket to itself; name two different sockets.")
        self.value = checked(value, _LENGTH, where)
        self.u = checked(u, _UNCERTAINTY, f"u of {where}")

    @classmethod
    def at_temperature(
        cls,
        start: str,
        end: str,
        value: float,
        u: float = 0.0,
        *,
        expansion: float,
        temperature: float,
        u_expansion: float = 0.0,
        u_temperature: float = 0.0,
    ) -> "ReferenceLength":
        """A length that is certified at 20 C and was measured at another temperature: value (1 + expansion (T - 20)).

        Args:
            start: Name of the socket at one end.
            end: Name of the socket at the other end.
            value: Calibrated length at 20 C, mm.
            u: Standard uncertainty of ``value``, mm.
            expansion: Coefficient of thermal expansion of the artefact, 1/K.
            temperature: Of the artefact when it was measured, C.
            u_expansion: Standard uncertainty of ``expansion``, 1/K.
            u_temperature: Standard uncertainty of ``temperature``, K.

        Raises:
            InputError: As of a `ReferenceLength`; or the temperature is not in C, or the expansion not in 1/K.
        """
        where = f"reference length '{start}' to '{end}'"
        check_temperatures(where, np.asarray(temperature, dtype=float))
        if not (abs(expansion) <= _LARGEST_EXPANSION and 0 <= u_expansion <= _LARGEST_EXPANSION):
            raise InputError(
                f"{where} has an expansion of {expansion:g} /K with u = {u_expansion:g} /K, and no artefact expands by "
                f"more than {_LARGEST_EXPANSION:g} /K; give 1/K, 11.5e-6 for steel."
            )
        if not 0 <= u_temperature < np.inf:
            raise InputError(f"{where} has u_temperature = {u_temperature:g} K; give zero or a positive number.")
        warmer = temperature - REFERENCE_TEMPERATURE
        parts = (u, value * warmer * u_expansion, value * expansion * u_temperature)
        return cls(start, end, value * (1 + expansion * warmer), float(np.linalg.norm(parts)))
