"""Which numbers of an arm are free, and within what bounds."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import Numbers, as_array, is_concrete, joined
from ..core.errors import InputError
from .arm import Arm, is_length, locate, natural_steps, parameter_names, replace, with_values
from .independence import independent_names
from .inverse_kinematics import SocketPoses


class Parameters(eqx.Module):
    """The free parameters of an arm, in order, and the arm that supplies the held ones.

    ``vector(arm)`` reads them into ``(p,)`` (mm and rad mixed); ``arm(vector)`` writes them back.
    """

    base: Arm
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def free_of(cls, arm: Arm, *, held: Iterable[str] | None = None, free: Iterable[str] = ()) -> "Parameters":
        """Free parameters of an arm.

        By default the 4n - 3 of Cheng et al. 2018 in their order: everything but ``d_1``, ``theta_1`` (they move the
        base frame), ``a_n``, ``alpha_n`` (redundant with the probe), ``probe_x`` and ``probe_y``. ``held`` replaces that
        list: everything else of alpha, a, d, theta and probe is then free. ``free`` releases more, beta included.

        Raises `InputError` for a name that the arm has not, or one that is both held and free.
        """
        n = arm.joints
        free = (free,) if isinstance(free, str) else tuple(free)
        if held is None:
            held = ("theta_1", "d_1", f"a_{n}", f"alpha_{n}", "probe_x", "probe_y")
            released = set(free)
            held = [name for name in held if name not in released]
        held, free = _unique_names(arm, held, "held"), _unique_names(arm, free, "free")
        for name in free:
            if name in held:
                raise InputError(f"parameter '{name}' is named as held and as free; name it once.")
        if arm.beta is None and any(name.startswith("beta_") for name in (*held, *free)):
            arm = replace(arm, beta=jnp.zeros_like(arm.alpha))
        wanted = [name for name in parameter_names(arm) if name not in held and (name in free or not name.startswith("beta_"))]
        if not wanted:
            raise InputError("every parameter is held, so nothing is left to identify; hold fewer.")
        return cls(base=arm, names=tuple(wanted))

    @classmethod
    def independent(cls, arm: Arm, capture: SocketPoses) -> "Parameters":
        """A largest set of free parameters that a capture can determine; what is redundant is held at its nominal value.

        For the paper's arm with a reference length these are its 21; without, the longest link is held too. Where neighbouring
        axes are nearly parallel, d of the first is held and Hayati's beta freed in its place.
        """
        base, names = independent_names(arm, capture)
        if not names:
            raise InputError("the capture determines no parameter at all; record more poses in its sockets.")
        return cls(base=base, names=tuple(name for name in parameter_names(base) if name in names))

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the parameters that are not free."""
        return tuple(name for name in parameter_names(self.base) if name not in self.names)

    @property
    def lengths(self) -> np.ndarray:
        """Boolean mask ``(p,)``: which free parameters are lengths."""
        return np.array([is_length(name) for name in self.names])

    @property
    def scale(self) -> Float[Array, " p"]:
        """Natural step of each free parameter ``(p,)``: 1 mm for a length, 1 mrad for an angle."""
        return jnp.asarray(natural_steps(self.names))

    def indices(self) -> tuple[tuple[str, int], ...]:
        """Kind and 0-based index of each free parameter."""
        return tuple(locate(self.base, name) for name in self.names)

    def index(self, name: str) -> int:
        """Position of a free parameter; `InputError` where it is not free."""
        if name not in self.names:
            locate(self.base, name)
            raise InputError(f"parameter '{name}' is held, not free; free it, or name a free one, such as '{self.names[0]}'.")
        return self.names.index(name)

    def vector(self, arm: Arm | None = None) -> Float[Array, "... p"]:
        """The free parameters of an arm (by default the base arm) as ``(..., p)``, mm and rad."""
        arm = self.base if arm is None else arm
        known = is_concrete(*arm.geometry)
        tools: Any = np if known else jnp  # see `joined`
        values = {kind: tools.asarray(getattr(arm, kind)) for kind in ("alpha", "a", "d", "theta", "probe")}
        values["beta"] = tools.zeros_like(values["alpha"]) if arm.beta is None else tools.asarray(arm.beta)
        return joined(tools.broadcast_arrays(*(values[kind][..., i] for kind, i in self.indices())), axis=-1, new=True)

    def arm(self, vector: Numbers) -> Arm:
        """The base arm with its free parameters taken from ``(p,)``. Use ``vmap`` for a batch of vectors."""
        vector = as_array(vector, "vector")
        if vector.shape[-1:] != (len(self.names),):
            raise InputError(
                f"vector has shape {vector.shape}, but {len(self.names)} parameters are free; give one value each."
            )
        changes = with_values(self.base.geometry, vector, self.indices())
        return replace(self.base, **changes)


def _unique_names(arm: Arm, names: Iterable[str], what: str) -> tuple[str, ...]:
    if isinstance(names, str):
        names = (names,)
    names = tuple(names)
    for name in names:
        locate(arm, name)
        if names.count(name) > 1:
            raise InputError(f"parameter '{name}' is named twice in {what}; name it once.")
    return names


class Bounds(eqx.Module):
    """A box for the free parameters: ``lower`` and ``upper`` are ``(p,)``, mm and rad; infinities are allowed.

    Raises `InputError` where a lower bound is above its upper one, or shapes do not fit.
    """

    space: Parameters
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]

    def __init__(self, space: Parameters, lower: Numbers, upper: Numbers):
        self.space = space
        self.lower = as_array(lower, "lower")
        self.upper = as_array(upper, "upper")
        for what, bound in (("lower", self.lower), ("upper", self.upper)):
            if bound.shape[-1:] != (len(space.names),):
                raise InputError(f"{what} has shape {bound.shape}, but {len(space.names)} parameters are free; give one each.")
        if is_concrete(self.lower, self.upper):
            wrong = ~(np.asarray(self.lower) <= np.asarray(self.upper))  # also true for NaN
            if wrong.any():
                i = int(np.argwhere(wrong)[0][-1])
                low, high = np.asarray(self.lower)[..., i].ravel()[0], np.asarray(self.upper)[..., i].ravel()[0]
                raise InputError(
                    f"bounds of {space.names[i]} are {low:g} to {high:g}; the lower must be a number not above the upper."
                )

    @classmethod
    def around(
        cls,
        arm: Arm,
        space: Parameters,
        *,
        length: float = 10.0,
        angle: float = 0.0175,
        override: Mapping[str, float] | None = None,
    ) -> "Bounds":
        """A box centred on an arm: half-widths for lengths (mm), for angles (rad) and, by name, for single parameters.

        The defaults are the paper's: 10 mm and about 1 degree.
        """
        widths = np.where(space.lengths, float(length), float(angle))
        for name, width in (override or {}).items():
            widths[space.index(name)] = float(width)
        if not np.all(widths >= 0):
            i = int(np.argmin(widths >= 0))
            raise InputError(f"half-width of {space.names[i]} is {widths[i]:g}; give zero or a positive number.")
        centre = space.vector(arm)
        centre = np.asarray(centre) if is_concrete(centre) else centre
        return cls(space, centre - widths, centre + widths)

    def active(self, vector: Float[Array, "... p"]) -> "Array":
        """Which parameters of ``(..., p)`` sit on a bound: -1 on the lower, +1 on the upper, 0 inside."""
        on_lower, on_upper = vector <= self.lower, vector >= self.upper
        return jnp.where(on_lower, -1, jnp.where(on_upper, 1, 0))


def perturbed_arm(space: Parameters, *, length: float, angle: float, seed: int = 0) -> Arm:
    """An arm that differs from the space's base: free lengths by up to ``length`` mm, free angles by up to ``angle`` rad.

    Uniform and independent; what the maker's tolerances might have left.
    """
    for what, value in (("length", length), ("angle", angle)):
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"the deviation of a free {what} is {value:g}; it must be zero or positive.")
    width = jnp.where(jnp.asarray(space.lengths), length, angle)
    shift = jax.random.uniform(jax.random.key(seed), width.shape, minval=-1.0, maxval=1.0)
    return space.arm(space.vector() + width * shift)
