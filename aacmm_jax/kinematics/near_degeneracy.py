"""Near-degenerate parameters: combinations that have full rank but hardly move the tips.

A matrix of derivatives has full rank as soon as no combination of parameters leaves the tips exactly where they are.
That says nothing of how well the combination is determined: a probe 0.6 mm off the last axis gives ``theta_6`` a rank
of its own, but 1 mrad of it moves no tip by more than 0.3 um once ``a_6`` and the probe have followed. So directions
are judged by size.

Let m be the RMS movement of the tips (mm) per natural step (1 mm or 1 mrad) along a direction, after the best
imitation by all other free parameters. Then

* without knowledge of the noise, the direction is near-degenerate where m < 2 um per step (`LEAST_MOVEMENT`): over
  the default half-width of a bound (10 mm, 17.5 mrad) it moves the tips by less than 35 um, about the single-point
  repeatability of a good arm, and less than the errors that the Denavit-Hartenberg model leaves (0.1 mm in robots).
  Such errors are alike in neighbouring poses, so that more poses do not average them away. Well-conditioned arms have
  10 um per step and more in their weakest direction (the arms of Cheng et al. 2018: 20 um);
* where the noise is known, also where its standard uncertainty u exceeds half of the half-width h of its bounds: with
  independent normal errors of covariance W^-1, u^2 = 1 / (v^T J^T W J v). A parameter with a rectangular distribution
  over its bounds has u = h / sqrt(3) = 0.58 h (JCGM 100, 4.3.7): there the data add little to what the bounds say
  anyway.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.text import listed
from .arm import is_length
from .corrections.kinds import unit_of_coefficient

LEAST_MOVEMENT = 2e-3  # mm at the tips per natural step
SHARE_OF_BOUNDS = 0.5  # of a half-width, that a standard uncertainty may reach
_ZERO = 1e-8  # singular values below this, of the largest, are zero: exact degeneracy, which is named elsewhere
_PARTNER = 0.05  # of the largest partner of a parameter: smaller ones are not named
_PARTNERS_NAMED = 3
_EQUAL = 1e-6  # relative differences below this are rounding


class TradeOff(NamedTuple):
    """A near-degenerate direction: a parameter and those that imitate it. Amounts in natural steps (1 mm, 1 mrad)."""

    names: tuple[str, ...]  # the parameter to fix, then those that imitate it, the strongest first
    amounts: tuple[float, ...]  # how much of each imitates one step of the first; 1 for the first
    movement: float  # what one step moves the tips after the imitation, RMS, mm
    u: float  # standard uncertainty of the first from the data, in steps; infinite where the noise is not known
    half_width: float  # of the bounds of the first, in steps; infinite where not known

    @property
    def text(self) -> str:
        """The trade-off in words."""
        (first, *others), movement = self.names, f"{1e3 * self.movement:.2g} um"
        step = _step(first)
        text = f"one {step} of {first} changes the tips by {movement}"
        if others:
            pairs = list(zip(self.amounts[1:], others, strict=True))[:_PARTNERS_NAMED]
            imitation = listed(f"{amount:.2g} {_step(name)} of {name}" for amount, name in pairs)
            text = f"{first} and {others[0]} trade off: 1 {step} of {first} is imitated by {imitation}"
            text += f" to within {movement}"
        if np.isfinite(self.u):  # half-widths are known where the noise is
            text += f" (u = {self.u:.3g} {step}, bounds +-{self.half_width:.3g} {step})"
        return text


def trade_offs(
    movements: Float[np.ndarray, "r p"],
    names: Sequence[str],
    *,
    whitened: Float[np.ndarray, "w p"] | None = None,
    half_widths: Float[np.ndarray, " p"] | None = None,
) -> tuple[TradeOff, ...]:
    """Near-degenerate directions of a linearised identification, the weakest first.

    Args:
        movements: Rows whose sum of squares along a direction is the squared RMS movement, mm, per natural step.
        names: The parameters of the columns.
        whitened: The same equations in standard deviations, where the noise is known.
        half_widths: Of the bounds, in natural steps; needed with ``whitened``.
    """
    units = np.ones(len(names)) if half_widths is None else np.where(half_widths > 0, half_widths, 1e-12)
    rows = movements if whitened is None else whitened
    # One uncertainty in units of the bounds: the singular values of the scaled rows are its inverse.
    _, singular, vectors = np.linalg.svd(rows * units, full_matrices=False)
    singular, vectors = singular[singular > _ZERO * max(singular[0], 1e-300)], vectors[: len(singular)] * units
    vectors = vectors[: len(singular)] / np.linalg.norm(vectors[: len(singular)], axis=1, keepdims=True)
    weak = np.linalg.norm(movements @ vectors.T, axis=0) < LEAST_MOVEMENT
    if whitened is not None:
        weak |= singular * SHARE_OF_BOUNDS < 1
    if not weak.any():
        return ()
    leading = reduced_echelon(vectors[weak].T)[1]
    fixed = np.isin(np.arange(len(names)), leading)
    # The best imitation of one step of each by all that do not lead a trade-off themselves.
    imitations = np.linalg.lstsq(rows[:, ~fixed], rows[:, leading], rcond=_ZERO)[0].T
    directions = np.zeros((len(leading), len(names)))
    directions[:, ~fixed], directions[np.arange(len(leading)), leading] = -imitations, 1.0

    def trade_off(i: int, direction: Float[np.ndarray, " p"]) -> TradeOff:
        largest = np.abs(np.delete(direction, i)).max(initial=0.0)
        by_size = [int(j) for j in np.argsort(-np.abs(direction), kind="stable")]
        order = [j for j in by_size if j != i and abs(direction[j]) > _PARTNER * largest]
        return TradeOff(
            names=tuple(names[j] for j in (i, *order)),
            amounts=(1.0, *(float(-direction[j]) for j in order)),
            movement=float(np.linalg.norm(movements @ direction)),
            u=np.inf if whitened is None else float(1 / max(np.linalg.norm(whitened @ direction), 1e-300)),
            half_width=np.inf if half_widths is None else float(half_widths[i]),
        )

    weakest = [trade_off(i, direction) for i, direction in zip(leading, directions, strict=True)]
    return tuple(sorted(weakest, key=lambda item: item.movement))


def reduced_echelon(basis: Float[np.ndarray, "p r"]) -> tuple[Float[np.ndarray, "p r"], list[int]]:
    """The same space by vectors that are each 0 at the other vectors' leading parameters, and these parameters.

    Orthonormal vectors of the same space give the same result, whatever a processor's rounding made of them: the
    parameter that the remaining space changes most leads, and of equal ones the first.
    """
    rest, leading = basis.copy(), []
    for _ in range(basis.shape[1]):
        sizes = np.linalg.norm(rest, axis=1)
        leading.append(int(np.argmax(sizes > (1 - _EQUAL) * sizes.max())))
        direction = rest[leading[-1]] / sizes[leading[-1]]
        rest -= np.outer(rest @ direction, direction)
    return basis @ np.linalg.inv(basis[leading]), leading


def _step(name: str) -> str:
    """The natural step of a parameter; 0.001 in the unit of a coefficient of a joint correction."""
    unit = unit_of_coefficient(name)
    return "mm" if is_length(name) else "per mille" if unit == "1" else unit.replace("rad", "mrad") or "mrad"
